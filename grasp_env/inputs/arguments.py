"""Checks of the arguments of public calls, and the array aliases.

Each fault is an `InvalidInputError` that names the argument, what was given and what is allowed.
`AllFaults` collects several.
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

from grasp_env.core import LARGEST, all_finite
from grasp_env.errors import GraspError, GraspWarning, InvalidInputError, UnknownNameError, shown
from grasp_env.inputs import ranges
from grasp_env.inputs.ranges import Range

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


def unit_vectors(vectors: Array) -> Array:
    """Return vectors (..., D) over their lengths."""
    return vectors / np.sqrt((vectors**2).sum(axis=-1, keepdims=True))


def as_array(
    value: ArrayLike,
    shape: Shape | None,
    name: str,
    within: Range | None = None,
    *,
    finite: bool = True,
    copy: bool = True,
    used: np.ndarray | None = None,
) -> Array:
    """Return `value` as a finite, contiguous, aligned float64 array of `shape` (None: any).

    The array is new, and its numbers lie in the range `within`. `finite=False` accepts infinities
    and nan; `copy=False` returns an array that needs no conversion as it is. Rows that a mask
    `used` (N,) leaves out may hold any numbers.
    """
    if type(value) is np.ndarray and value.dtype is _FLOAT:
        convert = np.array if copy or not value.flags.aligned else np.asarray
        array = convert(value, order="C")
    else:
        array = _converted(value, shape, name)
    if shape is not None and (
        array.ndim != len(shape)
        or any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True))
    ):
        raise InvalidInputError(f"{name} must have shape {_text(shape)}, got {array.shape}")
    checked = array if used is None else array[used]
    if finite and not all_finite(checked):
        raise InvalidInputError(f"{name} must be finite, got {shown(array)}")
    if (
        within is not None
        and checked.size
        and not (checked.min() >= within.low and checked.max() <= within.high)
    ):
        worst = checked[~((checked >= within.low) & (checked <= within.high))].flat[0]
        raise InvalidInputError(
            f"{name} must lie within {within}, got {worst:g}{'' if array.ndim == 0 else ' in it'}"
        )
    return array


def _converted(value: Any, shape: Shape | None, name: str) -> Array:
    """Return a new float64 array of anything that numpy reads as real numbers."""
    try:
        array: Any = np.asarray(value)
        # the usual case: a new array that needs no conversion
        if type(value) is list and array.dtype is _FLOAT:
            return array
        if np.ma.is_masked(value):  # `asarray` reads what the mask hides
            why = "masked entries are not numbers"
        elif array.dtype.kind == "O":  # fractions, large integers, None
            entries: Any = [as_number(entry) for entry in array.flat]
            if None not in entries:
                return np.reshape(entries, array.shape)
            why = "not all of them are"
        elif array.dtype.kind in "iuf":
            # numpy would convert text and booleans, too, and complex numbers in part
            return np.array(array, dtype=np.float64, order="C")
        else:
            why = f"they are of type {array.dtype}"
    except Exception as error:  # numpy's own
        why = str(error).partition("\n")[0].rstrip(".")[:200]
    raise InvalidInputError(
        f"{name} must be numbers of shape {_text(shape)}: {why}, got {shown(value)}"
    )


def _text(shape: Shape | None) -> str:
    """Return a shape as Python writes it, with N for any length."""
    return "(...)" if shape is None else str(shape).replace("None", "N")


def as_wrench(value: ArrayLike, name: str = "wrench") -> Wrench:
    """Return a wrench (6,) [N, N m], checked by `as_array` and `checked_size`."""
    return checked_size(as_array(value, (6,), name), name)


def checked_size(wrench: Array, name: str = "wrench") -> Array:
    """Return finite wrenches (..., 6), with components up to `core.LARGEST` N and N m."""
    if wrench.size and np.abs(wrench).max() > LARGEST:
        raise InvalidInputError(
            f"{name} must have components up to {LARGEST:g} N and N m, got {shown(wrench)}"
        )
    return wrench


def as_wrenches(value: ArrayLike) -> Array:
    """Return finite wrenches (..., 6) of any size."""
    wrenches = as_array(value, None, "wrench", ranges.SIZE)
    if wrenches.shape[-1:] != (6,):
        raise InvalidInputError(
            f"wrench must have shape (6,) or (..., 6), force [N] then moment [N m], got {wrenches.shape}"
        )
    return wrenches


def as_number(value: Any) -> float | None:
    """Return a real number, also that of an array without axes, as a float, or None.

    A number that is too large becomes infinite.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if not isinstance(value, Real) or isinstance(value, bool):
        return None
    number: Any = value
    try:
        return float(number)
    except OverflowError:
        return math.inf if number > 0 else -math.inf


def positive(value: Any, name: str, within: Range = ranges.POSITIVE) -> float:
    """Return a float > 0 within a range."""
    if not (as_number(value) or 0.0) > 0.0:
        raise InvalidInputError(f"{name} must be a number > 0, got {shown(value)}")
    return number(value, name, within)


def number(value: Any, name: str, within: Range = ranges.FINITE) -> float:
    """Return a float within a range."""
    result = as_number(value)
    if result is None or not within.low <= result <= within.high:
        must = "be a number" if result is None else "lie"
        raise InvalidInputError(f"{name} must {must} within {within}, got {shown(value)}")
    return result


def whole(value: Any, name: str, least: int, most: int = ranges.SEED) -> int:
    """Return an integer from `least` to `most`; 2.0 is none."""
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_integer or not least <= value <= most:
        allowed = f"from {least} to {most}" if is_integer and value > most else f">= {least}"
        raise InvalidInputError(f"{name} must be an integer {allowed}, got {shown(value)}")
    return int(value)


def generator(seed: Any, name: str = "seed") -> np.random.Generator:
    """Return the random generator of an integer seed >= 0."""
    return np.random.default_rng(whole(seed, name, 0))


def choice(value: Any, kind: str, allowed: Iterable[str], hint: str = "") -> str:
    """Return one of the `allowed` names, or raise an `UnknownNameError`."""
    names = tuple(allowed)
    if not isinstance(value, str) or value not in names:
        raise UnknownNameError(kind, value, names, hint)
    return str(value)


def flag(value: Any, name: str) -> bool:
    """Return True or False; 1 and 0 are errors."""
    if not isinstance(value, bool | np.bool_):
        raise InvalidInputError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def instance(value: Any, kind: type[T], name: str, or_none: bool = False) -> Any:
    """Return an object of a class, or None if that is allowed."""
    if not isinstance(value, kind) and not (or_none and value is None):
        article = "an" if kind.__name__[0] in "AEIO" else "a"
        what = f"{article} {kind.__name__}{' or None' if or_none else ''}"
        raise InvalidInputError(f"{name} must be {what}, got {shown(value)}")
    return value


class AllFaults:
    """Collects the faults of several checks for one error at the end of the `with` block."""

    MOST_TEXTS = 40

    def __init__(self) -> None:
        self.faults: list[GraspError] = []

    def __enter__(self) -> AllFaults:
        return self

    def __call__(self, check: Callable[..., T], *args: Any, **options: Any) -> T:
        """Return `check(*args, **options)`, or keep its fault and return None."""
        try:
            return check(*args, **options)
        except GraspError as fault:
            self.faults.append(fault)
            return None  # type: ignore[return-value]

    def add(self, *faults: str | GraspError) -> None:
        """Add errors, or the texts of `InvalidInputError`s."""
        self.faults += [
            InvalidInputError(fault) if isinstance(fault, str) else fault for fault in faults
        ]

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if len(self.faults) == 1 and error is None:
            raise self.faults[0]
        if self.faults:
            texts = list(dict.fromkeys(map(str, self.faults)))
            if len(texts) > self.MOST_TEXTS:
                texts[self.MOST_TEXTS :] = [f"and {len(texts) - self.MOST_TEXTS} more"]
            raise InvalidInputError("; ".join(texts)) from None


def call_user(
    function: Callable[..., Any],
    *args: Any,
    what: str,
    takes: str,
    fault: type[GraspError] = InvalidInputError,
) -> Any:
    """Call a user's function; any failure becomes a `fault` that names `what` and its `takes`."""
    try:
        return function(*args)
    except GraspError:
        raise
    except Exception as error:
        raise fault(
            f"{what} fails with {type(error).__name__}: {str(error)[:200]}; {takes}"
        ) from error


def warn(message: str) -> None:
    """Issue a `GraspWarning` at the line that called this package, also through Gymnasium."""
    level = 2
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(
        ("grasp_env.", "gymnasium.", "functools")
    ):
        level += 1
        frame = frame.f_back
    warnings.warn(message, GraspWarning, stacklevel=level)
