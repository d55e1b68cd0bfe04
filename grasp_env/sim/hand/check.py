"""Checks of the numbers that describe a hand: what is refused, and what the message says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np

from grasp_env._check import as_array, as_list, as_text, is_a
from grasp_env.errors import InvalidInputError, shown

_MOST = 1e9
"""Of any number of a hand, in metres, kilograms, newton metres, radians."""
T = TypeVar("T")
Vector3: TypeAlias = tuple[float, float, float]
Inertia: TypeAlias = tuple[float, float, float, float, float, float]


def numbers(values: Any, count: int | None, name: str) -> tuple[float, ...]:
    """`count` finite numbers as a tuple of floats, so that every description can be hashed.

    Raises:
        InvalidInputError: Another count, no numbers, or not finite.
    """
    try:
        result = tuple(as_array(values, None, name, finite=False).tolist())
    except (InvalidInputError, TypeError):
        raise InvalidInputError(f"{name}={shown(values)} must be {count or 'a row of'} numbers") from None
    if np.ndim(result) != 1 or (count is not None and len(result) != count):
        raise InvalidInputError(f"{name}={shown(result)} must be {count or 'a row of'} numbers, not {len(result)}")
    if not all(map(math.isfinite, result)):
        raise InvalidInputError(f"{name}={shown(result)} must be finite numbers")
    if max(map(abs, result), default=0.0) > _MOST:
        raise InvalidInputError(f"{name}={shown(result)} must be numbers up to {_MOST:g}")
    return result


def positive(value: Any, name: str) -> float:
    """A finite number above 0, or `InvalidInputError`."""
    (number,) = numbers((value,), 1, name)
    if number <= 0.0:
        raise InvalidInputError(f"{name}={number} must be above 0")
    return number


def word(value: Any, name: str) -> str:
    """A name that is not empty, or `InvalidInputError`."""
    text = as_text(value)
    if text is None or not text.strip():
        raise InvalidInputError(f"{name}={shown(value)} must be a name of at least one letter")
    return text


def parts(values: Any, kind: type[T], name: str) -> tuple[T, ...]:
    """A row of `kind`s as a tuple, or `InvalidInputError`."""
    each = as_list(values)
    if each is None:
        raise InvalidInputError(f"{name}={shown(values)} must be a list of {kind.__name__}s")
    for value in each:
        if not is_a(value, kind):
            raise InvalidInputError(f"{name} must be a list of {kind.__name__}s, got {shown(value)} in it")
    return tuple(each)


def unit(values: Any, name: str) -> Vector3:
    """Three numbers of length 1, or `InvalidInputError`."""
    x, y, z = numbers(values, 3, name)
    length = math.sqrt(x * x + y * y + z * z)
    if abs(length - 1.0) > 1e-9:
        raise InvalidInputError(f"{name}={(x, y, z)} must have length 1, not {length:.6g}; normalise it")
    return x, y, z


def limits(lower: Any, upper: Any, name: str) -> tuple[float, float]:
    """A lower limit below an upper one, or -inf and inf together: a joint that turns without end."""
    if type(lower) is float and type(upper) is float and (lower, upper) == (-math.inf, math.inf):
        return -math.inf, math.inf
    low, high = numbers((lower, upper), 2, f"{name}: (lower, upper)")
    if low >= high:
        raise InvalidInputError(f"{name}: lower={low} must be below upper={high}; exchange them or widen the range")
    return low, high


def inertia_of(values: Any, name: str) -> Inertia:
    """The inertia of a body that can exist: positive, no principal moment above the sum of the others.

    Args:
        values: ixx, ixy, ixz, iyy, iyz, izz about the centre of mass [kg m^2].
        name: Of the link, for the message.

    Raises:
        InvalidInputError: No body has this inertia.
    """
    given = numbers(values, 6, f"{name}: inertia")
    moments = np.linalg.eigvalsh(inertia_matrix(given))
    if moments[0] <= 0.0:
        raise InvalidInputError(
            f"{name}: inertia={given} has the principal moments {moments.tolist()} kg m^2, all must be above 0; "
            "give ixx, ixy, ixz, iyy, iyz, izz about the centre of mass"
        )
    if moments[2] >= moments[0] + moments[1]:
        raise InvalidInputError(
            f"{name}: inertia={given} has the principal moments {moments.tolist()} kg m^2; in a body the largest is "
            "below the sum of the other two. Check units, signs and that it is about the centre of mass"
        )
    return given[0], given[1], given[2], given[3], given[4], given[5]


def nearest_inertia(values: Inertia, mass: float) -> Inertia | None:
    """The inertia of a body that is nearest to one that no body has; None where a body can have it.

    Args:
        values: As of `inertia_of`.
        mass: Of the body [kg]: no radius of gyration gets below 1 mm.
    """
    from scipy.optimize import nnls

    moments, axes = np.linalg.eigh(inertia_matrix(values))
    if moments[0] > 0.0 and moments[2] < moments[0] + moments[1]:
        return None
    least = max(mass * 1e-6, 1e-3 * float(moments[2]))
    sums = np.ones((3, 3)) - np.eye(3)  # moments are sums of the second moments along the other two axes
    seconds = nnls(sums, moments - 2.0 * least)[0] + least
    return inertia_numbers((axes * (sums @ seconds)) @ axes.T)


def inertia_matrix(values: Sequence[float]) -> np.ndarray:
    """(3, 3) of ixx, ixy, ixz, iyy, iyz, izz."""
    xx, xy, xz, yy, yz, zz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_numbers(matrix: np.ndarray) -> Inertia:
    """ixx, ixy, ixz, iyy, iyz, izz of (3, 3)."""
    xx, xy, xz = matrix[0].tolist()
    return xx, xy, xz, float(matrix[1, 1]), float(matrix[1, 2]), float(matrix[2, 2])


def with_rotor(values: Inertia, rotor: float) -> Inertia:
    """An inertia with that of a rotor [kg m^2] about all axes, see `HandDescription.with_rotors`."""
    return inertia_numbers(inertia_matrix(values) + rotor * np.eye(3))


def hull_corners(values: Any, name: str) -> tuple[Vector3, ...]:
    """Corners (K, 3) that span a volume, or `InvalidInputError`."""
    rows = as_array(values, (None, 3), f"{name}: corners")
    spread = np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)
    if len(rows) < 4 or not spread[2] > 1e-9 or np.abs(rows).max() > _MOST:
        raise InvalidInputError(f"{name}: {len(rows)} corners must be at least 4 points that do not lie in a plane")
    return tuple((x, y, z) for x, y, z in rows.tolist())
