"""Checks of the arguments of public calls, and the array aliases.

Numbers that pass are float64, finite, of the right shape and within `ranges`. Each fault is an `InvalidInputError` that names the argument,
what was given and what is allowed; `AllFaults` collects several.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterable
from numbers import Real
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env import ranges
from grasp_env.core import LARGEST, all_finite
from grasp_env.errors import GraspError, GraspWarning, InvalidInputError, UnknownNameError, shown
from grasp_env.ranges import Range

Array: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.int64]
"""Numbers of fingers, contacts, links."""
Wrench: TypeAlias = Array
"""(6,): force [N] then moment about the object origin [N m], object frame, acting ON the object."""
ContactForces: TypeAlias = Array
"""(N, 3): force of each finger on the object [N] as (normal, o, t) in that contact's frame."""
Shape: TypeAlias = tuple[int | None, ...]
"""Shape of an array; None: any length."""
T = TypeVar("T")

_FLOAT = np.dtype(np.float64)
_KINDS = {"U": "text is", "S": "bytes are", "b": "true or false are", "c": "complex are", "M": "dates are", "m": "times are", "V": "records are"}  # fmt: skip


def as_array(
    value: ArrayLike,
    shape: Shape | None,
    name: str,
    within: Range | None = None,
    *,
    finite: bool = True,
    copy: bool = True,
) -> Array:
    """Return `value` as a new finite float64 array of `shape`, contiguous.

    Args:
        value: numbers.
        shape: of the array, None in it: any length; None: any shape.
        name: of the argument, for messages.
        within: range of every number.
        finite: False accepts infinities and nan.
        copy: False returns an array that needs no conversion as it is.

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
    """Return a finite wrench (6,) [N, N m] with components up to 1e12; see `as_array`."""
    return checked_size(as_array(value, (6,), name), name)


def checked_size(wrench: Array, name: str = "wrench") -> Array:
    """Return finite wrenches (..., 6); raise an `InvalidInputError` for components beyond 1e12 N and N m."""
    if wrench.size and np.abs(wrench).max() > LARGEST:
        raise InvalidInputError(f"{name} must have components up to {LARGEST:g} N and N m, got {shown(wrench)}")
    return wrench


def positive(value: Any, name: str, within: Range = ranges.POSITIVE) -> float:
    """Return a float > 0 within a range, or raise an `InvalidInputError`.

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
    if not 0.0 < number < math.inf:
        raise InvalidInputError(f"{name} must be finite and > 0, got {number}")
    if not within.low <= number <= within.high:
        raise InvalidInputError(f"{name} must lie within {within}, got {shown(value)}")
    return number


def number(value: Any, name: str, within: Range = ranges.FINITE) -> float:
    """Return a finite float within a range, or raise an `InvalidInputError`."""
    found = as_number(value)
    if found is None or not within.low <= found <= within.high:
        raise InvalidInputError(f"{name} must be a number within {within}, got {shown(value)}")
    return found


def whole(value: Any, name: str, least: int, most: int = ranges.SEED) -> int:
    """Return an integer from `least` to `most`, or raise an `InvalidInputError`; 2.0 is not an integer.

    Example:
        >>> whole(-1, "seed", 0)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: seed must be an integer >= 0, got -1
    """
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)
    if not is_integer or value < least:
        raise InvalidInputError(f"{name} must be an integer >= {least}, got {shown(value)}")
    if value > most:
        raise InvalidInputError(f"{name} must be an integer from {least} to {most}, got {shown(value)}")
    return int(value)


def generator(seed: Any, name: str = "seed") -> np.random.Generator:
    """Return the random generator of an integer seed >= 0, or raise an `InvalidInputError`."""
    return np.random.default_rng(whole(seed, name, 0))


def choice(value: Any, kind: str, allowed: Iterable[str], hint: str = "") -> str:
    """Return one of some names, or raise an `UnknownNameError`."""
    names = tuple(allowed)
    if not isinstance(value, str) or value not in names:
        raise UnknownNameError(kind, value, names, hint)
    return str(value)


def flag(value: Any, name: str) -> bool:
    """Return True or False, or raise an `InvalidInputError`."""
    if not isinstance(value, bool | np.bool_):
        raise InvalidInputError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def instance(value: Any, kind: type[T], name: str, or_none: bool = False) -> Any:
    """Return an object of a class (or None, if that is allowed), or raise an `InvalidInputError`."""
    if not isinstance(value, kind) and not (or_none and value is None):
        what = f"{'an' if kind.__name__[0] in 'AEIO' else 'a'} {kind.__name__}{' or None' if or_none else ''}"
        raise InvalidInputError(f"{name} must be {what}, got {shown(value)}")
    return value


def as_text(value: object) -> str | None:
    """Return text as a plain `str`; None if it is not text."""
    return str(value) if isinstance(value, str) else None


def as_list(value: Any) -> list[Any] | None:
    """Return the entries of a list or tuple; None if it is neither."""
    return list(value) if isinstance(value, list | tuple) else None


class AllFaults:
    """Collects the faults of several checks and raises them as one error at the end of the `with` block.

    Raises:
        GraspError: the single fault as it is, or an `InvalidInputError` with the texts of all.

    Example:
        >>> with AllFaults() as check:
        ...     mass = check(positive, 0.0, "mass")
        ...     size = check(positive, -1.0, "size")
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: mass must be finite and > 0, got 0.0; size must be finite and > 0, got -1.0
    """

    MOST_TEXTS = 40

    def __init__(self) -> None:
        """Start without faults."""
        self.faults: list[GraspError] = []

    def __enter__(self) -> AllFaults:
        return self

    def __call__(self, check: Callable[..., T], *given: Any, **options: Any) -> T:
        """Return `check(*given, **options)`; if it fails, keep its fault and return None, which is not used as the block then raises."""
        try:
            return check(*given, **options)
        except GraspError as fault:
            self.faults.append(fault)
            return None  # type: ignore[return-value]

    def add(self, *faults: str | GraspError) -> None:
        """Add faults that were found elsewhere: errors, or the texts of `InvalidInputError`s."""
        self.faults += [InvalidInputError(fault) if isinstance(fault, str) else fault for fault in faults]

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if len(self.faults) == 1 and error is None:
            raise self.faults[0]
        if self.faults:
            texts = list(dict.fromkeys(map(str, self.faults)))
            more = f"; and {len(texts) - self.MOST_TEXTS} more" if len(texts) > self.MOST_TEXTS else ""
            raise InvalidInputError("; ".join(texts[: self.MOST_TEXTS]) + more) from None


def call_user(
    function: Callable[..., Any], *given: Any, what: str, takes: str, fault: type[GraspError] = InvalidInputError
) -> Any:
    """Call a user's function; any failure becomes a `fault` that names `what` failed and what it `takes`."""
    try:
        return function(*given)
    except GraspError:
        raise
    except Exception as error:
        raise fault(f"{what} fails with {type(error).__name__}: {str(error)[:200]}; {takes}") from error


def as_number(value: Any) -> float | None:
    """Return a real number, or an array of one without axes, as a float (infinite if it is too large); None if it is neither."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if not isinstance(value, Real) or isinstance(value, bool | np.timedelta64):
        return None
    number: Any = value
    try:
        return float(number)
    except OverflowError:
        return math.inf if number > 0 else -math.inf


def warn(message: str) -> None:
    """Issue a `GraspWarning` at the line that called this package, also through Gymnasium."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(
        ("grasp_env.", "gymnasium.", "functools")
    ):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, GraspWarning, stacklevel=level)


def _converted(value: Any, shape: Shape | None, name: str) -> Array:
    """Return a new float64 array of anything that numpy reads as real numbers."""
    try:
        with np.errstate(all="ignore"):
            given = np.asarray(value)
            kind = given.dtype.kind
            why = f"{_KINDS[kind]} no number{'' if kind == 'U' else 's'}" if kind in _KINDS else ""
            if np.ma.is_masked(value):
                why = "masked entries are no numbers"
            if not why:
                _check_shape(given.shape, shape, name)
                if kind != "O":
                    return np.array(given, dtype=np.float64, order="C")
                each = [as_number(entry) for entry in given.flat]  # integers of any size, fractions
                if None not in each:
                    return np.array(each, dtype=np.float64).reshape(given.shape)
                why = "not all of it is numbers"
    except GraspError:
        raise
    except Exception as error:  # numpy's own
        why = str(error).partition("\n")[0].rstrip(".")[:200]
    raise InvalidInputError(f"{name} must be numbers of shape {_text(shape)}: {why}, got {shown(value)}")


def _check_shape(got: tuple[int, ...], shape: Shape | None, name: str) -> None:
    if shape is not None and got != shape:
        fits = len(got) == len(shape) and all(want in (None, have) for want, have in zip(shape, got, strict=True))
        if not fits:
            raise InvalidInputError(f"{name} must have shape {_text(shape)}, got {got}")
    if (shape is None or None in shape) and math.prod(got) > ranges.NUMBERS:
        raise InvalidInputError(f"{name} must hold at most {ranges.NUMBERS} numbers, got shape {got}")


def _text(shape: Shape | None) -> str:
    if shape is None:
        return "(...)"
    parts = ["N" if want is None else str(want) for want in shape]
    return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"
