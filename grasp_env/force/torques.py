"""Contact forces as joint torques: tau = J^T f + bias."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.errors import InvalidInputError
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, as_array


def joint_torques(
    jacobian: ArrayLike,
    force: ArrayLike,
    bias: ArrayLike | None = None,
    *,
    moment: ArrayLike | None = None,
) -> Array:
    """Return the joint torques with which the fingers exert `force` on the object.

    By virtual work tau . qd = f . (J qd), apart from the bias. f is the force of the finger ON the
    object, so tau is the torque of the motors. Give Jacobian, force and moment in one frame. In
    the frame of the contacts' positions the force is `solution.object_force`.

    Args:
        jacobian: (N, 3, J) or (3N, J), joint speeds -> velocity of each contact point, relative to
            the base of the hand; (N, 6, J) with the fingertip's angular velocity in rows 3 to 5.
            The unit is [m] for revolute joints.
        force: (N, 3) contact forces [N].
        bias: (J,) torques in addition to those of the grasp, such as for the hand's weight [N m];
            None: zero.
        moment: (N, 3) moments of soft contacts about their contact points [N m],
            `solution.torsion[:, None] * grasp.normals`; needs a Jacobian (N, 6, J).

    Returns:
        (J,) torques [N m]; forces [N] for prismatic joints.

    Raises:
        InvalidInputError: shapes that do not match, or values that are not finite.

    Example:
        >>> joint_torques([[[0.0, 0.1], [0.0, 0.0], [0.0, 0.0]]], [[2.0, 0.0, 0.0]], bias=[0.5, 0.0])
        array([0.5, 0.2])
    """
    forces = as_array(force, (None, 3), "force", ranges.SIZE)
    jac = checked_jacobian(jacobian, len(forces))
    torques = np.einsum("nij,ni->j", jac[:, :3], forces)
    if moment is not None:
        if jac.shape[1] == 3:
            raise InvalidInputError(
                f"moment needs a jacobian of shape (N, 6, J), got {jac.shape}: add the fingertips' angular velocities as rows 3 to 5, "
                "or leave moment out"
            )
        torques += np.einsum(
            "nij,ni->j", jac[:, 3:], as_array(moment, forces.shape, "moment", ranges.SIZE)
        )
    return torques if bias is None else torques + as_array(bias, torques.shape, "bias", ranges.BIAS)


def checked_jacobian(
    jacobian: ArrayLike, count: int | None = None, used: np.ndarray | None = None
) -> Array:
    """Return a Jacobian as (N, 3, J) or (N, 6, J), also from (3N, J).

    It must have `count` contacts (None: any); `used` is as in `as_array`.
    """
    jac = as_array(jacobian, None, "jacobian", finite=False)
    shape = jac.shape
    if jac.ndim == 2 and jac.size and len(jac) % 3 == 0:
        jac = jac.reshape(-1, 3, jac.shape[1])
    if (
        jac.ndim != 3
        or jac.shape[1] not in (3, 6)
        or 0 in jac.shape
        or count not in (None, len(jac))
    ):
        n = "N" if count is None else str(count)
        flat = "3N" if count is None else str(3 * count)
        raise InvalidInputError(
            f"jacobian must have shape ({n}, 3, J), ({flat}, J) or ({n}, 6, J) for {n} contacts and J >= 1 joints, got {shape}"
        )
    as_array(jac, None, "jacobian", ranges.LEVER, copy=False, used=used)
    if len(jac) > ranges.CONTACTS or jac.shape[2] > ranges.JOINTS:
        raise InvalidInputError(
            f"jacobian must have at most {ranges.CONTACTS} contacts and {ranges.JOINTS} joints, got shape {shape}"
        )
    return jac
