"""The one shape-and-finiteness check of the public boundaries, and the array aliases."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env.core import LARGEST, all_finite
from grasp_env.errors import InvalidInputError

Array: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.int64]
"""Numbers of fingers, contacts, links."""
Wrench: TypeAlias = Array
"""(6,): force [N] then moment about the object origin [N m], object frame, acting ON the object."""
ContactForces: TypeAlias = Array
"""(N, 3): force of each finger on the object [N] as (normal, o, t) in that contact's frame."""


def as_array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """Returns `value` as a finite float64 array of `shape` (None: any length).

    Raises:
        InvalidInputError: not numeric, another shape, or not finite.

    Example:
        >>> as_array([1, 2], (None,), "masses")
        array([1., 2.])
        >>> as_array([1, float("nan")], (2,), "masses")
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: masses must be finite, got [1.0, nan]
    """
    try:
        if not (type(value) is np.ndarray and value.dtype.kind == "f") and np.iscomplexobj(value):
            raise TypeError("complex")
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(f"{name} must be numbers of shape {_text(shape)}: {error}") from None
    if array.shape != shape and (
        array.ndim != len(shape)
        or any(want is not None and want != got for want, got in zip(shape, array.shape, strict=False))
    ):
        raise InvalidInputError(f"{name} must have shape {_text(shape)}, got {array.shape}")
    if not all_finite(array):
        raise InvalidInputError(f"{name} must be finite, got {array.tolist()}")
    return array


def as_wrench(value: ArrayLike, name: str = "wrench") -> Wrench:
    """(6,) finite wrench [N, N m] with components up to 1e12; see `as_array`."""
    wrench = as_array(value, (6,), name)
    if np.abs(wrench).max() > LARGEST:
        raise InvalidInputError(f"{name} must have components up to {LARGEST:g} N and N m, got {wrench.tolist()}")
    return wrench


def positive(value: Any, name: str) -> float:
    """A finite float > 0, or `InvalidInputError`."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InvalidInputError(f"{name} must be a number > 0, got {value!r}") from None
    if not np.isfinite(number) or number <= 0.0:
        raise InvalidInputError(f"{name} must be finite and > 0, got {number}")
    return number


def _text(shape: tuple[int | None, ...]) -> str:
    parts = ["N" if want is None else str(want) for want in shape]
    return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"
