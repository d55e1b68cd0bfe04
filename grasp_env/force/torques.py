"""Contact forces as joint torques: tau = J^T f + bias."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import ranges
from grasp_env._check import Array, as_array
from grasp_env.errors import InvalidInputError
from grasp_env.grasp.grasp import Grasp, as_grasp


def joint_torques(
    jacobian: ArrayLike, force: ArrayLike, bias: ArrayLike | None = None, *, torsion: ArrayLike | None = None
) -> Array:
    """Torques of the hand's joints that press the fingers on the object with `force`.

    Virtual work: bias aside, tau . qd = f . (J qd). f is the finger's force ON the object, as everywhere in this
    package, so tau is what the motors exert.

    Args:
        jacobian: (N, 3, J) or (3N, J) joint speeds -> velocity of each fingertip's contact point, in the SAME frame as
            `force`: contact frames (normal, o, t) unless you use another one for both; see `contact_jacobian`.
            (N, 4, J): the fourth row is the fingertip's angular velocity about the normal. [m] for hinges.
        force: (N, 3) contact forces [N].
        bias: (J,) torques that act besides the grasp, e.g. those that carry the hand's weight [N m]; None: zero.
        torsion: (N,) torsions about the normals of soft contacts [N m]; needs a Jacobian (N, 4, J).

    Returns:
        (J,) torques [N m] (forces [N] of sliding joints).

    Raises:
        InvalidInputError: shapes that do not fit, values that are not finite, or torsions without a row for them.

    Example:
        >>> joint_torques([[[0.0, 0.1], [0.0, 0.0], [0.0, 0.0]]], [[2.0, 0.0, 0.0]], bias=[0.5, 0.0])
        array([0.5, 0.2])
    """
    pushed = as_array(force, (None, 3), "force", ranges.SIZE)
    jac = checked_jacobian(jacobian, len(pushed))
    torques = np.einsum("nij,ni->j", jac[:, :3], pushed)
    if torsion is not None:
        if jac.shape[1] == 3:
            raise InvalidInputError(
                f"torsion needs a jacobian of shape (N, 4, J), got {jac.shape}: add the fingertips' angular velocities about "
                "the normals as fourth rows, or leave torsion out"
            )
        torques += as_array(torsion, (len(pushed),), "torsion", ranges.SIZE) @ jac[:, 3]
    return torques if bias is None else torques + as_array(bias, torques.shape, "bias", ranges.BIAS)


def contact_jacobian(grasp: Grasp, object_frame_jacobian: ArrayLike) -> Array:
    """A Jacobian in object coordinates turned into the contact frames of `grasp`.

    Args:
        grasp: the contacts.
        object_frame_jacobian: (N, 3, J) or (3N, J) joint speeds -> velocities of the contact points, object coordinates
            (axes only: the velocity is the fingertip's, relative to whatever carries the hand). (N, 6, J): with the
            fingertips' angular velocities in rows 3 to 5, for soft contacts.

    Returns:
        (N, 3, J), rows along (normal, o, t); from (N, 6, J) (N, 4, J), the fourth row about the normal.

    Raises:
        InvalidInputError: a shape that does not fit the grasp, or values that are not finite.

    Example:
        >>> from grasp_env.grasp import presets
        >>> thumb_up = np.zeros((4, 3, 1))
        >>> thumb_up[0, 2] = 0.08          # the joint moves the thumb by 0.08 m/rad along z, its normal
        >>> contact_jacobian(presets.paper_cuboid(), thumb_up)[0, :, 0]
        array([0.08, 0.  , 0.  ])
    """
    jac = checked_jacobian(object_frame_jacobian, as_grasp(grasp).n_contacts, rows=(3, 6), name="object_frame_jacobian")
    turned = np.einsum("nik,nij->nkj", grasp.frames, jac[:, :3])
    if jac.shape[1] == 3:
        return turned
    return np.concatenate([turned, np.einsum("ni,nij->nj", grasp.normals, jac[:, 3:])[:, None]], axis=1)


def checked_jacobian(
    jacobian: ArrayLike, count: int | None = None, rows: tuple[int, int] = (3, 4), name: str = "jacobian"
) -> Array:
    """A finite Jacobian as (N, rows, J), from that shape or from (3N, J); `count`: N, None for any.

    Raises:
        InvalidInputError: another shape, or values that are not finite.
    """
    jac = as_array(jacobian, None, name, ranges.LEVER)
    shape = jac.shape
    if jac.ndim == 2 and jac.size and len(jac) % 3 == 0:
        jac = jac.reshape(-1, 3, jac.shape[1])
    if jac.ndim != 3 or jac.shape[1] not in rows or 0 in jac.shape or count not in (None, len(jac)):
        n = "N" if count is None else str(count)
        flat = "3N" if count is None else str(3 * count)
        raise InvalidInputError(
            f"{name} must have shape ({n}, {rows[0]}, J), ({flat}, J) or ({n}, {rows[1]}, J) for {n} contacts and J >= 1 "
            f"joints, got {shape}"
        )
    if len(jac) > ranges.CONTACTS or jac.shape[2] > ranges.JOINTS:
        raise InvalidInputError(
            f"{name} must be that of at most {ranges.CONTACTS} contacts and {ranges.JOINTS} joints, got shape {shape}"
        )
    return jac
