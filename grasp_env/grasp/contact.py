"""Contact frames: the inward normal and two tangents (paper, Sec. II; right-handed, n x o = t)."""

from __future__ import annotations

import numpy as np

from grasp_env.core import TANGENT_SWITCH
from grasp_env.inputs.arguments import Array


def contact_frames(normals: Array) -> Array:
    """Return frames (N, 3, 3) with columns (n, o, t), object frame, of inward unit normals.

    o is the normalised projection of e_x on the tangent plane, or of e_y if |n . e_x| > 0.9;
    t = n x o.

    Example:
        >>> contact_frames(np.array([[0.0, 0.0, 1.0]]))[0].T   # rows: n, o, t
        array([[0., 0., 1.],
               [1., 0., 0.],
               [0., 1., 0.]])
    """
    along_x = np.abs(normals[:, 0]) > TANGENT_SWITCH
    axis = np.zeros_like(normals)
    axis[~along_x, 0] = 1.0
    axis[along_x, 1] = 1.0
    o = axis - normals * np.einsum("ij,ij->i", axis, normals)[:, None]
    o /= np.sqrt(np.einsum("ij,ij->i", o, o))[:, None]
    t: Array = np.cross(normals, o)  # pyright: ignore[reportAssignmentType]
    return np.stack([normals, o, t], axis=2)
