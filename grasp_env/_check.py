"""The checks of the public boundaries, where numbers, names and objects enter, and the array aliases.

What passes them is float64, finite, of the right shape and within `ranges`; what does not is told in one `InvalidInputError`.
Text, booleans, complex numbers, dates and masked entries are no numbers, though numpy would make some of them.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from numbers import Real
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env import ranges
from grasp_env.core import LARGEST, all_finite
from grasp_env.errors import GraspError, GraspWarning, InvalidInputError, UnknownNameError, shown
from grasp_env.ranges import Range

if TYPE_CHECKING:
    from typing_extensions import TypeIs

Array: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.int64]
"""Numbers of fingers, contacts, links."""
Wrench: TypeAlias = Array
"""(6,): force [N] then moment about the object origin [N m], object frame, acting ON the object."""
ContactForces: TypeAlias = Array
"""(N, 3): force of each finger on the object [N] as (normal, o, t) in that contact's frame."""
Shape: TypeAlias = tuple[int | None, ...]
"""None: any length."""
T = TypeVar("T")

_FLOAT = np.dtype(np.float64)
_KINDS = {"U": "text", "S": "bytes", "b": "true or false", "c": "complex", "M": "dates", "m": "times", "V": "records"}


def as_array(
    value: ArrayLike,
    shape: Shape | None,
    name: str,
    within: Range | None = None,
    *,
    finite: bool = True,
    copy: bool = True,
) -> Array:
    """Returns `value` as a new finite float64 array of `shape`, contiguous.

    Args:
        value: numbers.
        shape: of the array, None in it: any length; None: any shape.
        name: for messages.
        within: where every number must lie.
        finite: whether infinite ones and nan are refused.
        copy: False: an array that is such already is not copied.

    Raises:
        InvalidInputError: not numbers, another shape, not finite, or out of range.

    Example:
        >>> as_array([1, 2], (None,), "masses")
        array([1., 2.])
        >>> as_array([1, float("nan")], (2,), "masses")
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: masses must be finite, got [1.0, nan]
        >>> as_array("0.4", (), "friction")
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: friction must be numbers of shape (): text is no number, got '0.4'
    """
    if type(value) is np.ndarray and value.dtype is _FLOAT:
        _check_shape(value.shape, shape, name)
        array = np.array(value, order="C", copy=True if copy else None)
    else:
        array = _converted(value, shape, name)
    if finite and not all_finite(array):
        raise InvalidInputError(f"{name} must be finite, got {shown(array)}")
    if within is not None and array.size and not (array.min() >= within.low and array.max() <= within.high):
        worst = array[~((array >= within.low) & (array <= within.high))].flat[0]
        raise InvalidInputError(f"{name} must lie within {within}, got {worst:g}{'' if array.ndim == 0 else ' in it'}")
    return array


def as_wrench(value: ArrayLike, name: str = "wrench") -> Wrench:
    """(6,) finite wrench [N, N m] with components up to 1e12; see `as_array`."""
    return checked_size(as_array(value, (6,), name), name)


def checked_size(wrench: Array, name: str = "wrench") -> Array:
    """Finite wrenches (..., 6) with components up to 1e12 N and N m.

    Raises:
        InvalidInputError: a larger one.
    """
    if wrench.size and np.abs(wrench).max() > LARGEST:
        raise InvalidInputError(f"{name} must have components up to {LARGEST:g} N and N m, got {shown(wrench)}")
    return wrench


def positive(value: Any, name: str, within: Range = ranges.POSITIVE) -> float:
    """A float > 0 within a range, or `InvalidInputError`.

    Example:
        >>> positive(1e300, "friction", ranges.FRICTION)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: friction must lie within 0.0001 to 10000, got 1e+300
    """
    if type(value) is float and within.low <= value <= within.high:
        return value
    number = as_number(value)
    if number is None:
        raise InvalidInputError(f"{name} must be a number > 0, got {shown(value)}")
    if not math.isfinite(number) or number <= 0.0:
        raise InvalidInputError(f"{name} must be finite and > 0, got {number}")
    if not within.low <= number <= within.high:
        raise InvalidInputError(f"{name} must lie within {within}, got {shown(value)}")
    return number


def number(value: Any, name: str, within: Range = ranges.FINITE) -> float:
    """A finite float within a range, or `InvalidInputError`."""
    found = as_number(value)
    if found is None or not within.low <= found <= within.high:
        raise InvalidInputError(f"{name} must be a number within {within}, got {shown(value)}")
    return found


def whole(value: Any, name: str, least: int, most: int = ranges.SEED) -> int:
    """An integer from `least` to `most`, or `InvalidInputError`; 2.0 is none.

    Example:
        >>> whole(-1, "seed", 0)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: seed must be an integer >= 0, got -1
    """
    found = None
    if is_a(value, int) and not is_a(value, bool):
        found = int.__index__(value)
    elif is_a(value, np.integer) and not is_a(value, np.timedelta64):
        found = np.integer.__int__(value)
    if found is None or found < least:
        raise InvalidInputError(f"{name} must be an integer >= {least}, got {shown(value)}")
    if found > most:
        raise InvalidInputError(f"{name} must be an integer from {least} to {most}, got {shown(value)}")
    return found


def generator(seed: Any, name: str = "seed") -> np.random.Generator:
    """Random numbers of an integer seed >= 0, or `InvalidInputError`."""
    return np.random.default_rng(whole(seed, name, 0))


def choice(value: Any, kind: str, allowed: Iterable[str], hint: str = "") -> str:
    """One of some names, or `UnknownNameError`: of any object, also of one that has no hash or is equal to everything."""
    names, given = tuple(allowed), as_text(value)
    if given is None or given not in names:
        raise UnknownNameError(kind, value, names, hint)
    return given


def flag(value: Any, name: str) -> bool:
    """True or False, or `InvalidInputError`."""
    if not is_a(value, bool | np.bool_):
        raise InvalidInputError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def instance(value: Any, kind: type[T], name: str, or_none: bool = False) -> Any:
    """`value` where it is a `kind` (or None, where that is allowed), or `InvalidInputError`."""
    if not is_a(value, kind) and not (or_none and value is None):
        what = f"{'an' if kind.__name__[0] in 'AEIO' else 'a'} {kind.__name__}{' or None' if or_none else ''}"
        raise InvalidInputError(f"{name} must be {what}, got {shown(value)}")
    return value


@overload
def is_a(value: object, kind: type[T]) -> TypeIs[T]: ...
@overload
def is_a(value: object, kind: Any) -> bool: ...
def is_a(value: object, kind: Any) -> bool:
    """Whether an object is of a class, by its own class alone: `isinstance` also asks the object, which may fail or lie.

    Example:
        >>> from unittest.mock import Mock
        >>> isinstance(Mock(spec=float), float), is_a(Mock(spec=float), float)
        (True, False)
    """
    return issubclass(type(value), kind)


def as_text(value: object) -> str | None:
    """Text as plain text, whatever a class of somebody else's makes of it; None: no text."""
    return value if type(value) is str else str.__str__(value) if is_a(value, str) else None


def as_list(value: Any) -> list[Any] | None:
    """What a list or tuple holds, whatever a class of somebody else's makes of it; None: neither."""
    kind: Any = type(value)
    base: Any = list if issubclass(kind, list) else tuple if issubclass(kind, tuple) else None
    return None if base is None else list(base.__iter__(value))


def together(*checks: Callable[[], Any]) -> list[Any]:
    """What the checks return; where several fail, one error tells of all.

    Raises:
        GraspError: the one failure as it is, or an `InvalidInputError` of them all.

    Example:
        >>> together(lambda: positive(0.0, "mass"), lambda: positive(-1.0, "size"))
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: mass must be finite and > 0, got 0.0; size must be finite and > 0, got -1.0
    """
    found: list[Any] = []
    faults: list[GraspError] = []
    for check in checks:
        try:
            found.append(check())
        except GraspError as error:
            faults.append(error)
    if len(faults) == 1:
        raise faults[0]
    if faults:
        told = list(dict.fromkeys(map(str, faults)))
        more = f"; and {len(told) - _MOST_TOLD} more" if len(told) > _MOST_TOLD else ""
        raise InvalidInputError("; ".join(told[:_MOST_TOLD]) + more)
    return found


_MOST_TOLD = 40


def called(
    function: Callable[..., Any], *given: Any, what: str, takes: str, fault: type[GraspError] = InvalidInputError
) -> Any:
    """Calls a user's function and returns its result; any failure becomes a `fault` that names `what` failed and what it `takes`."""
    try:
        return function(*given)
    except GraspError:
        raise
    except Exception as error:
        raise fault(f"{what} fails with {type(error).__name__}: {str(error)[:200]}; {takes}") from error


def as_number(value: Any) -> float | None:
    """A real number of any type, or an array of one without axes, as a float, infinite where it is too large; None: no number."""
    try:
        if is_a(value, np.ndarray) and value.ndim == 0:
            value = value.item()
        if not issubclass(type(value), Real) or is_a(value, bool | np.timedelta64):
            return None
        try:
            with np.errstate(all="ignore"):
                return float(value)
        except OverflowError:
            return math.inf if value > 0 else -math.inf
    except Exception:  # a number of somebody else's
        return None


def _converted(value: Any, shape: Shape | None, name: str) -> Array:
    """A new float64 array of anything that holds numbers."""

    def refuse(why: object) -> NoReturn:
        raise InvalidInputError(f"{name} must be numbers of shape {_text(shape)}: {why}, got {shown(value)}")

    try:
        if is_a(value, np.ndarray) and not is_a(value, np.ma.MaskedArray):
            value = np.ndarray.view(value, np.ndarray)
        kinds = _kinds(value)
        given = None if kinds is None else np.asarray(value)
    except Exception as error:  # numpy's, or of somebody else's __array__
        refuse(str(error).partition("\n")[0].rstrip(".")[:200])
    if given is None or kinds is None:
        refuse("nested too deep or too long")
    if is_a(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        refuse("masked entries are no numbers")
    kind = given.dtype.kind
    if kind in _KINDS:
        refuse(f"{_KINDS[kind]} {'is' if kind == 'U' else 'are'} no {'number' if kind == 'U' else 'numbers'}")
    _check_shape(given.shape, shape, name)
    if bool in kinds or np.bool_ in kinds:
        refuse("true and false are no numbers")  # numpy would take them for 1 and 0
    if kind == "O":  # integers of any size, fractions
        each = [as_number(number) for number in given.flat]
        if None in each:
            refuse("not all of it is numbers")
        return np.array(each, dtype=np.float64).reshape(given.shape)
    with np.errstate(all="ignore"):
        return np.array(given, dtype=np.float64, order="C")


def _kinds(value: Any) -> set[type] | None:
    """The classes of what nested lists hold; None where numpy is not to be asked: too deep, too long, or endless things inside."""
    kinds: set[type] = set()
    total, left = 0, [(value, 0)]
    while left:
        rows, depth = left.pop()
        each = as_list(rows)
        if each is not None:
            found = set(map(type, each))
            kinds |= found
            total += len(each)
            if not found <= _SINGLE:
                left.extend((entry, depth + 1) for entry in each if type(entry) not in _SINGLE)
        elif is_a(rows, np.ndarray):
            total += rows.size if depth else 0  # an array by itself is looked at, not read
        elif not is_a(rows, str | bytes) and hasattr(type(rows), "__len__"):
            with suppress(TypeError):  # a sparse matrix has no length, nor has a tensor without axes
                total += len(rows)
        if total > ranges.LISTED or depth > _DEEPEST:
            return None
    return kinds


_SINGLE = frozenset({float, int, bool, complex, str, bytes, type(None), np.float64, np.float32, np.int64, np.bool_})
_DEEPEST = 8
"""Lists in lists."""


def _check_shape(got: tuple[int, ...], shape: Shape | None, name: str) -> None:
    if (
        shape is not None
        and got != shape
        and (
            len(got) != len(shape)
            or any(want is not None and want != have for want, have in zip(shape, got, strict=False))
        )
    ):
        raise InvalidInputError(f"{name} must have shape {_text(shape)}, got {got}")
    if (shape is None or None in shape) and math.prod(got) > ranges.NUMBERS:
        raise InvalidInputError(f"{name} must hold at most {ranges.NUMBERS} numbers, got shape {got}")


def _text(shape: Shape | None) -> str:
    if shape is None:
        return "(...)"
    parts = ["N" if want is None else str(want) for want in shape]
    return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"


def warn(message: str) -> None:
    """Issues a `GraspWarning` at the line that called this package, be it through Gymnasium."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(
        ("grasp_env.", "gymnasium.", "functools")
    ):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, GraspWarning, stacklevel=level)
