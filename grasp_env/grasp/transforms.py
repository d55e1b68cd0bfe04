"""Rigid changes of frame for wrenches and grasps, other moment points, and weights.

The pose of frame B in frame A is (rotation R, translation p): the columns of R are the axes of B in
A's coordinates, and p is the origin of B in A [m]. A point has x_A = R x_B + p. The inverse pose is
(R.T, -R.T @ p).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.errors import InvalidInputError
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, Wrench, as_array, as_wrenches, positive

ROTATION_TOLERANCE = 1e-6
"""Largest difference of R^T R from the identity, enough for single precision."""
GRAVITY: tuple[float, float, float] = (0.0, 0.0, -9.81)
"""Gravitational acceleration in a world whose z axis points up [m/s^2]."""


def transform_wrench(wrench: ArrayLike, rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Express wrenches in another frame (the adjoint of Murray, Li, Sastry 1994).

    F_A = R F_B and m_A = R m_B + p x F_A.

    Args:
        wrench: (..., 6) force [N] and moment about the origin of B [N m], in B's coordinates.
        rotation: (3, 3) R, columns are the axes of B in A.
        translation: (3,) p, the origin of B in A [m].

    Returns:
        (..., 6) force and moment about the origin of A, in A's coordinates.

    Raises:
        InvalidInputError: wrong shapes, values that are not finite, or a matrix that is not a
            rotation.

    Example:
        >>> transform_wrench([0, 0, -2, 0, 0, 0], np.eye(3), [0.1, 0, 0])   # a weight of 2 N hangs at x = 0.1 m
        array([ 0. ,  0. , -2. ,  0. ,  0.2,  0. ])
    """
    force, moment = _split(wrench)
    turn = checked_rotation(rotation)
    shift = as_array(translation, (3,), "translation", ranges.SIZE)
    force_a = force @ turn.T
    return np.concatenate([force_a, moment @ turn.T + np.cross(shift, force_a)], -1)


def transformed(grasp: Grasp, rotation: ArrayLike, translation: ArrayLike) -> Grasp:
    """Return the contacts of a grasp in frame B in another frame A.

    The tangents are rotated too, so contact forces (normal, o, t) keep their components:
    `transformed(grasp, R, p).wrench(f)` equals `transform_wrench(grasp.wrench(f), R, p)` for every
    f. `rotation` and `translation` are as in `transform_wrench`.

    Raises:
        InvalidInputError: as in `transform_wrench`, or a translation so long that moments about A's
            origin are lost in rounding.

    Example:
        >>> from grasp_env.grasp import presets
        >>> transformed(presets.tripod(), np.eye(3), [0, 0, 0.1]).positions[0]
        array([0.04, 0.  , 0.1 ])
    """
    turn = checked_rotation(rotation)
    models = as_grasp(grasp).models
    return Grasp.from_contacts(
        grasp.positions @ turn.T + as_array(translation, (3,), "translation", ranges.SIZE),
        grasp.normals @ turn.T,
        models.friction,
        contact_model=models.names,
        torsional_friction=models.torsional_friction if "soft" in models.names else None,
        tangents=grasp.frames[:, :, 1] @ turn.T,
    )


def wrench_about(wrench: ArrayLike, point: ArrayLike) -> Array:
    """Express `wrench` (..., 6) [N, N m] with moments about `point` (3,) [m]: m' = m - p x F.

    The axes stay the same.

    Example:
        >>> wrench_about([0, 0, -2, 0, 0.2, 0], [0.1, 0, 0])   # the weight has no moment about where it hangs
        array([ 0.,  0., -2.,  0.,  0.,  0.])
    """
    force, moment = _split(wrench)
    return np.concatenate(
        [force, moment - np.cross(as_array(point, (3,), "point", ranges.SIZE), force)], -1
    )


def gravity_wrench(
    mass: float,
    com: ArrayLike = (0.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
    gravity: ArrayLike = GRAVITY,
) -> Wrench:
    """Return the weight of the object as an external wrench for `optimize_force`.

    Args:
        mass: mass of the object, > 0 [kg].
        com: (3,) centre of mass [m], object frame.
        rotation: (3, 3) orientation of the object, columns are its axes in world coordinates; None:
            aligned with the world.
        gravity: (3,) gravitational acceleration in world coordinates [m/s^2].

    Returns:
        (6,) force [N] and moment about the object origin [N m], object frame.

    Raises:
        InvalidInputError: a mass <= 0, or as in `transform_wrench`.

    Example:
        >>> gravity_wrench(0.2, com=[0.01, 0, 0])
        array([ 0.    ,  0.    , -1.962 ,  0.    ,  0.01962,  0.    ])
    """
    force = positive(mass, "mass", ranges.MASS) * as_array(gravity, (3,), "gravity", ranges.SIZE)
    if rotation is not None:
        force = checked_rotation(rotation).T @ force
    return np.concatenate([force, np.cross(as_array(com, (3,), "com", ranges.SIZE), force)])


def checked_rotation(rotation: ArrayLike, name: str = "rotation") -> Array:
    """Return a rotation matrix (3, 3), made orthonormal to rounding.

    Raises:
        InvalidInputError: not (3, 3), not finite, not orthonormal to 1e-6, or a reflection.
    """
    matrix = as_array(rotation, (3, 3), name, ranges.SIZE)
    gram = matrix.T @ matrix
    off = float(np.abs(gram - np.eye(3)).max())
    if not off <= ROTATION_TOLERANCE:
        raise InvalidInputError(
            f"{name} must be a rotation: R^T R misses the identity by {off:.3g}, at most {ROTATION_TOLERANCE:g} is "
            f"allowed, got {matrix.tolist()}: make its columns orthonormal (u @ vt of its singular value decomposition)"
        )
    if np.linalg.det(matrix) < 0.0:
        raise InvalidInputError(
            f"{name} is a reflection (determinant -1), got {matrix.tolist()}: change the sign of one axis; the frames "
            "must both be right-handed"
        )
    # one Newton step to the nearest rotation; exact rotations do not change
    return matrix @ (1.5 * np.eye(3) - 0.5 * gram)


def _split(wrench: ArrayLike) -> tuple[Array, Array]:
    checked = as_wrenches(wrench)
    return checked[..., :3], checked[..., 3:]
