"""The project's one error tree.

Every class is also the builtin that fits, so `except ValueError` and `except KeyError` keep working. A message
says what was given, what is allowed and how to mend it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from reprlib import Repr
from typing import Any

_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
_NAME = type.__dict__["__name__"]
"""Of any class, whatever its own class says."""
_SHORT = Repr()
_SHORT.maxlevel = 4
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxset = _SHORT.maxarray = 12
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 200


def shown(value: object) -> str:
    """What was given, for a message: its repr, shortened, without addresses, and never an error itself.

    Example:
        >>> shown([1.0, "a"]), shown(10**10_000), shown([0.0] * 1000)[-10:]
        ("[1.0, 'a']", 'an int too long to show', ' 0.0, ...]')
        >>> shown(object())
        '<object object>'
    """
    try:
        shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
        if isinstance(shape, tuple) and dtype is not None:  # an array: its numbers where they are few
            size = 1
            for length in shape:
                size *= length
            if not size <= 36:
                return f"{type(value).__name__} of shape {tuple(shape)} and type {dtype}"
            return _SHORT.repr(value.tolist())  # type: ignore[attr-defined]
        text = _SHORT.repr(value)
        return text if type(value) is str else _ADDRESS.sub("", text)
    except Exception:  # a repr of somebody else's
        if issubclass(type(value), int):
            return "an int too long to show"
        return f"an object of type {_NAME.__get__(type(value))}"


def alike(given: object, allowed: Iterable[str]) -> str:
    """A question, whether the allowed name that is most like the given one was meant; empty where none is like it.

    Example:
        >>> alike("Newtn", ["conic", "newton"]), alike("simplex", ["conic", "newton"])
        (" did you mean 'newton'?", '')
    """
    from difflib import get_close_matches  # where something went wrong only

    if type(given) is not str or len(given) > 100:
        return ""
    names = {name.lower(): name for name in allowed if type(name) is str}
    found = get_close_matches(given.lower(), names, 1)
    return f" did you mean {names[found[0]]!r}?" if found else ""


class GraspError(ValueError):
    """Base of every error this project raises on purpose."""


class InvalidInputError(GraspError):
    """An argument has the wrong shape, is not finite, or lies outside its range."""


class UnknownNameError(GraspError, KeyError):
    """A method, rule, preset or option name that does not exist.

    Args:
        kind: of name, for the message.
        given: the name.
        allowed: those that exist.
        hint: the end of the message.
    """

    def __init__(self, kind: str, given: object, allowed: Iterable[str], hint: str = "") -> None:
        self.given = given
        self.allowed = tuple(allowed)
        meant = alike(given, self.allowed)
        super().__init__(
            f"unknown {kind} {shown(given)}:{meant} choose one of {', '.join(map(repr, self.allowed))}{hint}"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # process pools send errors as pickles: what was given may have none, what is told of it has
        given = self.given if type(self.given) is str else shown(self.given)
        return _told, (type(self), *self.args, {"given": given, "allowed": self.allowed})

    def __str__(self) -> str:  # KeyError would print the repr of the message
        return str(self.args[0])


class UnknownSettingError(UnknownNameError, TypeError):
    """A keyword that is no setting; told as Python tells it of functions, which others' code looks for."""

    def __init__(self, given: str, allowed: Iterable[str] = (), likely: Iterable[str] = ()) -> None:
        """`given`: the keyword; without `allowed` the message itself, as `gymnasium.make` raises a TypeError again.

        `likely`: settings elsewhere that may be meant.
        """
        self.given, self.allowed = given, tuple(allowed)
        meant = (
            f" did you mean {' or '.join(map(repr, found))}?"
            if (found := tuple(likely))
            else alike(given, self.allowed)
        )
        named = f"got an unexpected keyword argument {shown(given)}:{meant} settings are {', '.join(map(repr, self.allowed))}"
        GraspError.__init__(self, named if self.allowed else given)


def _told(kind: type[GraspError], message: str, attributes: dict[str, Any]) -> GraspError:
    """An error of that kind as it was."""
    error = kind.__new__(kind, message)
    error.__dict__.update(attributes)
    return error


class GraspWarning(UserWarning):
    """Input that is valid but looks like a mistake; `grasp_env.grasp.advise` says more of contacts."""


class RankDeficientGraspError(GraspError):
    """rank(G) < 6: the contacts cannot balance every wrench, whatever their forces."""


class InfeasibleWrenchError(GraspError):
    """No force strictly inside the friction cones balances the wrench.

    Attributes:
        solution: the `ForceSolution` with status `INFEASIBLE` and, in `certificate`, the separating twist (6,).
    """

    def __init__(self, message: str, solution: Any = None, tell: Callable[[], str] | None = None) -> None:
        """`message`: "" for what `tell` says when it is asked: a control loop that goes on without it does not pay for it."""
        super().__init__(message)
        self.solution, self._tell = solution, tell

    def __str__(self) -> str:
        message = str(self.args[0])
        return self._tell() if not message and self._tell is not None else message

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.solution)


class UnsupportedProblemError(GraspError):
    """A method that does not know this kind of contact, limit or option; the message names one that does."""


class InfeasibleStartError(GraspError):
    """An initial-force rule has no balanced, strictly feasible force for this grasp and wrench."""


class NotConvergedError(GraspError, RuntimeError):
    """`ForceSolution.raise_for_status` on a solution that did not reach its tolerance.

    Args:
        message: what is told.
        solution: the one meant.

    Attributes:
        solution: that `ForceSolution`.
    """

    def __init__(self, message: str, solution: Any = None) -> None:
        """`message`: what happened."""
        super().__init__(message)
        self.solution = solution


class ModelFileError(GraspError, OSError):
    """A saved model that is missing, damaged, or of another schema."""


class GraspFileError(GraspError, OSError):
    """A grasp's file that cannot be read or written, is not of this format, or describes no valid grasp."""


class MissingExtraError(GraspError, ImportError):
    """Packages that the solver does without, and this needs, are not installed; the message has the command."""


class SimulationError(GraspError, RuntimeError):
    """The simulator diverged, was closed, or cannot do what was asked."""
