"""Geometry of a camera: projection to pixels, and the pose for which points fill the picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.inputs.arguments import Array, unit_vectors, whole
from grasp_env.sim.hand.description import Vector3

NEAR_PLANE, FAR_PLANE = 0.05, 5.0  # least and largest distance from the camera that is drawn [m]


def picture_size(size: int) -> int:
    """Return the height of a picture [pixels], or raise `InvalidInputError`."""
    return whole(size, "size", 16, 4096)


@dataclass(frozen=True)
class View:
    """A pinhole camera that keeps the world's y axis upright.

    Attributes:
        eye: Position of the camera [m], world frame.
        target: Point at the centre of the picture [m], world frame.
        field_of_view: Vertical opening angle [degrees].
        width, height: Size of the picture [pixels].

    Example:
        >>> view = View((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 90.0, 200, 100)
        >>> view.project([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]).round(9).tolist()
        [[100.0, 50.0], [150.0, 0.0]]
    """

    eye: Vector3
    target: Vector3
    field_of_view: float
    width: int
    height: int

    @cached_property
    def axes(self) -> Array:
        """Unit vectors to the right, upwards and towards the camera, rows (3, 3), world frame."""
        back = np.subtract(self.eye, self.target)
        right = np.cross((0.0, 1.0, 0.0), back)
        return unit_vectors(np.array([right, np.cross(back, right), back]))

    @cached_property
    def slope(self) -> Array:
        """Tangents of half the horizontal and vertical opening angles, (2,)."""
        return np.tan(0.5 * np.radians(self.field_of_view)) * np.array(
            [self.width / self.height, 1.0]
        )

    def depth(self, points: ArrayLike) -> Array:
        """Return the distances in front of the camera [m], (N,), of points (N, 3) [m], world frame."""
        return (self.eye - np.asarray(points, dtype=float)) @ self.axes[2]

    def project(self, points: ArrayLike) -> Array:
        """Return the pixels (N, 2), right and down from the top left corner, of points (N, 3) [m].

        They may be outside the picture. Points behind the camera are treated as just in front.
        """
        local = (np.asarray(points, dtype=float) - self.eye) @ self.axes.T
        shares = local[:, :2] / (np.maximum(-local[:, 2:], NEAR_PLANE) * self.slope)
        return (0.5 + shares * (0.5, -0.5)) * (self.width, self.height)

    def unproject(self, depth: Array) -> Array:
        """Return the points (H, W, 3) [m], world frame, of OpenGL's depth buffer (H, W)."""
        along = FAR_PLANE * NEAR_PLANE / (FAR_PLANE - (FAR_PLANE - NEAR_PLANE) * depth)
        down, right = ((np.arange(count) + 0.5) / count * 2.0 - 1.0 for count in depth.shape)
        across, up = np.meshgrid(self.slope[0] * right, -self.slope[1] * down)
        rays = np.dstack([across, up, np.full_like(up, -1.0)])
        return along[..., None] * rays @ self.axes + self.eye

    def fitted(self, points: Array, margin: float, below: float) -> View:
        """Return the view moved so that all points (N, 3) [m] are in the picture and centred.

        The share `margin` of width and height stays free on the left, on the right and above,
        `below` of the height below. Both their sum and `2 margin` are less than 1.
        """
        local = points @ self.axes.T
        # x + s_high z <= c_x + s_high c_z and x - s_low z >= c_x - s_low c_z for every point, and
        # the same for y
        high = self.slope * (1.0 - 2.0 * margin)
        low = self.slope * (1.0 - 2.0 * np.array([margin, below]))
        above = (local[:, :2] + high * local[:, 2:]).max(axis=0)
        under = (local[:, :2] - low * local[:, 2:]).min(axis=0)
        back = max(
            float(((above - under) / (high + low)).max()),
            float(local[:, 2].max()) + 2.0 * NEAR_PLANE,
        )
        across = 0.5 * (above - high * back + under + low * back)
        eye = np.append(across, back) @ self.axes
        return replace(self, eye=tuple(eye.tolist()), target=tuple((eye - self.axes[2]).tolist()))
