"""All errors of the project, which also derive from the matching builtins.

A message states what was given, what is allowed and the remedy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from reprlib import Repr
from typing import Any

_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
_LONG = 1000  # number of entries or bytes that a message does not show


class _ShortRepr(Repr):
    """A `Repr` whose time does not grow with what it shows."""

    def repr1(self, x: Any, level: int) -> str:
        if (
            isinstance(x, dict | set | frozenset | bytes | bytearray | memoryview)
            and len(x) > _LONG
        ):
            return f"a {type(x).__name__} of length {len(x)}"
        return super().repr1(x, level)


_SHORT = _ShortRepr()
_SHORT.maxlevel = 4
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxset = _SHORT.maxarray = 12
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 200


def shown(value: object) -> str:
    """Return a short repr without addresses, for messages; it never fails, and is always fast.

    Example:
        >>> shown([1.0, "a"]), shown(10**10_000), shown([0.0] * 1000)[-10:]
        ("[1.0, 'a']", 'an int too long to show', ' 0.0, ...]')
        >>> shown(object())
        '<object object>'
    """
    try:
        shape = getattr(value, "shape", None)
        dtype = getattr(value, "dtype", None)
        if isinstance(shape, tuple) and dtype is not None:  # an array: its numbers if they are few
            if math.prod(max(length, 1) for length in shape) > 36:
                return f"{type(value).__name__} of shape {tuple(shape)} and type {dtype!s:.100}"
            numbers = getattr(value, "tolist", None)
            value = value if numbers is None else numbers()
        try:
            text = _SHORT.repr(value)
        except ValueError:  # more digits than Python writes
            return "an int too long to show"
        return text if type(value) is str else _ADDRESS.sub("", text)
    except Exception:  # what the user's own class raises
        return f"an object of class {type(value).__name__:.100}"


def alike(given: object, allowed: Iterable[str]) -> str:
    """Return " did you mean NAME?" for the allowed name closest to `given`, or "".

    Example:
        >>> alike("Newtn", ["conic", "newton"]), alike("simplex", ["conic", "newton"])
        (" did you mean 'newton'?", '')
    """
    from difflib import get_close_matches  # slow to import

    if not isinstance(given, str) or len(given) > 100:
        return ""
    names = {name.lower(): name for name in allowed}
    matches = get_close_matches(given.lower(), names, 1)
    return f" did you mean {names[matches[0]]!r}?" if matches else ""


class GraspError(ValueError):
    """Base class of all errors of this project."""


class InvalidInputError(GraspError):
    """An argument has the wrong shape, is not finite, or lies outside its range."""


class NoGraspError(InvalidInputError):
    """No place of the palm was found from which a hand grasps an object.

    Args:
        message: what was tried.
        nearest: the `NearestMiss` of the search, whose `draw` shows it; None if no finger found a
            contact.
    """

    def __init__(self, message: str, nearest: Any = None) -> None:
        super().__init__(message)
        self.nearest = nearest


class UnknownNameError(GraspError, KeyError):
    """A method, rule, preset or option name does not exist.

    Args:
        kind: kind of name, for the message.
        given: the wrong name.
        allowed: the existing names.
        hint: end of the message.
    """

    def __init__(self, kind: str, given: object, allowed: Iterable[str], hint: str = "") -> None:
        self.given = given
        self.allowed = tuple(allowed)
        meant = alike(given, self.allowed)
        super().__init__(
            f"unknown {kind} {shown(given)}:{meant} choose one of {', '.join(map(repr, self.allowed))}{hint}"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # process pools pickle errors, and the given object may not be picklable
        given = self.given if isinstance(self.given, str) else shown(self.given)
        return _restore, (type(self), *self.args, {"given": given, "allowed": self.allowed})

    def __str__(self) -> str:  # KeyError would print the repr of the message
        return str(self.args[0])


class UnknownSettingError(UnknownNameError, TypeError):
    """A keyword is not a setting; the message is that of Python's own TypeError.

    Args:
        given: the keyword; without `allowed` the whole message, as `gymnasium.make` raises a
            TypeError again.
        allowed: the existing settings.
        likely: settings of other records that may be meant.
    """

    def __init__(self, given: str, allowed: Iterable[str] = (), likely: Iterable[str] = ()) -> None:
        self.given, self.allowed = given, tuple(allowed)
        listed = " or ".join(map(repr, likely))
        meant = f" did you mean {listed}?" if listed else alike(given, self.allowed)
        message = f"got an unexpected keyword argument {shown(given)}:{meant} settings are {', '.join(map(repr, self.allowed))}"
        GraspError.__init__(self, message if self.allowed else given)


def _restore(kind: type[GraspError], message: str, attributes: dict[str, Any]) -> GraspError:
    error = kind.__new__(kind, message)
    error.__dict__.update(attributes)
    return error


class GraspWarning(UserWarning):
    """Input is valid but looks like a mistake; `grasp_env.grasp.advise` gives more advice."""


class RankDeficientGraspError(GraspError):
    """rank(G) < 6: the contacts cannot balance every wrench, whatever their forces."""


class InfeasibleWrenchError(GraspError):
    """No force strictly inside the friction cones balances the wrench.

    Attributes:
        solution: the `ForceSolution` with status `INFEASIBLE` and its `certificate`.
    """

    def __init__(
        self, message: str, solution: Any = None, tell: Callable[[], str] | None = None
    ) -> None:
        """`tell` builds an empty `message` on first use, so raising is cheap in a control loop."""
        super().__init__(message)
        self.solution, self._tell = solution, tell

    def __str__(self) -> str:
        message = str(self.args[0])
        return self._tell() if not message and self._tell is not None else message

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.solution)


class UnsupportedProblemError(GraspError):
    """The method does not support a contact, limit or option; the message names one that does."""


class InfeasibleStartError(GraspError):
    """An initial-force rule has no balanced, strictly feasible force for this grasp and wrench."""


class NotConvergedError(GraspError, RuntimeError):
    """A solve did not reach its tolerance; `solution` is a `ForceSolution` or None, `message` why."""

    def __init__(self, message: str, solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution


class ModelFileError(GraspError, OSError):
    """A saved model is missing, damaged, or of another schema."""


class GraspFileError(GraspError, OSError):
    """A grasp file cannot be read or written, has another format, or describes no valid grasp."""


class MissingExtraError(GraspError, ImportError):
    """Optional packages are not installed; the message has the command that installs them."""


class SimulationError(GraspError, RuntimeError):
    """The simulator diverged, was closed, or does not support the request."""
