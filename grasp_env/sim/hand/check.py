"""Checks of the numbers and names that describe a hand; each raises an `InvalidInputError`."""

from __future__ import annotations

import math
from typing import Any, TypeAlias, TypeVar

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs import arguments
from grasp_env.inputs.arguments import as_array
from grasp_env.inputs.ranges import Range

LARGEST = 1e9  # number of a hand, in metres, kilograms, newton metres, radians
T = TypeVar("T")
Vector3: TypeAlias = tuple[float, float, float]


def numbers(values: Any, count: int | None, name: str) -> tuple[float, ...]:
    """Return `count` numbers (None: any) up to 1e9 as a tuple, which can be hashed."""
    return tuple(as_array(values, (count,), name, Range(-LARGEST, LARGEST)).tolist())


def positive(value: Any, name: str) -> float:
    """Return a number above 0 and up to 1e9."""
    return arguments.positive(value, name, Range(1e-300, LARGEST))


def word(value: Any, name: str) -> str:
    """Return a name that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise InvalidInputError(f"{name}={shown(value)} must be a name of at least one letter")
    return str(value)


def parts(values: Any, kind: type[T], name: str) -> tuple[T, ...]:
    """Return a list of objects of a class as a tuple."""
    if not isinstance(values, list | tuple):
        raise InvalidInputError(f"{name}={shown(values)} must be a list of {kind.__name__}s")
    for value in values:
        if not isinstance(value, kind):
            raise InvalidInputError(
                f"{name} must be a list of {kind.__name__}s, got {shown(value)} in it"
            )
    return tuple(values)


def unit(values: Any, name: str) -> Vector3:
    """Return a vector of length 1."""
    x, y, z = numbers(values, 3, name)
    length = math.sqrt(x * x + y * y + z * z)
    if abs(length - 1.0) > 1e-9:
        raise InvalidInputError(
            f"{name}={(x, y, z)} must have length 1, not {length:.6g}; normalise it"
        )
    return x, y, z


def limits(lower: Any, upper: Any, name: str) -> tuple[float, float]:
    """Return the lower and upper limit of a joint; -inf and inf if it has no limits."""
    if (lower, upper) == (-math.inf, math.inf):
        return -math.inf, math.inf
    low, high = numbers((lower, upper), 2, f"{name}: (lower, upper)")
    if low >= high:
        raise InvalidInputError(
            f"{name}: lower={low} must be below upper={high}; exchange them or widen the range"
        )
    return low, high


def hull_corners(values: Any, name: str) -> tuple[Vector3, ...]:
    """Return corners (K, 3) that span a volume."""
    rows = as_array(values, (None, 3), f"{name}: corners")
    spread = np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)
    if len(rows) < 4 or not spread[2] > 1e-9 or np.abs(rows).max() > LARGEST:
        raise InvalidInputError(
            f"{name}: {len(rows)} corners must be at least 4 points that do not lie in a plane"
        )
    return tuple((x, y, z) for x, y, z in rows.tolist())
