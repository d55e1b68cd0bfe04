"""Where a camera stands: from points in the world to pixels, and the distance at which all of them are in the picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import Array
from grasp_env.sim.hand.description import Vector3

NEAR_PLANE = 0.05
"""Nothing nearer to the camera is drawn [m]."""

FAR_PLANE = 5.0
"""Nothing farther from the camera is drawn [m]."""


@dataclass(frozen=True)
class View:
    """A pinhole camera that keeps the world's y axis upright.

    Attributes:
        eye: Position of the camera [m], world frame.
        target: Point in the middle of the picture [m], world frame.
        field_of_view: Vertical opening [degrees].
        width: Of the picture [pixels].
        height: Of the picture [pixels].

    Example:
        >>> view = View((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 90.0, 200, 100)
        >>> view.project([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]).tolist()
        [[100.0, 50.0], [150.0, 0.0]]
    """

    eye: Vector3
    target: Vector3
    field_of_view: float
    width: int
    height: int

    @cached_property
    def axes(self) -> Array:
        """Right, up and towards the camera, (3, 3): rows are unit vectors in the world frame."""
        back = np.subtract(self.eye, self.target)
        right = np.cross((0.0, 1.0, 0.0), back)
        axes = np.array([right, np.cross(back, right), back])
        return axes / np.linalg.norm(axes, axis=1)[:, None]

    @property
    def view_matrix(self) -> list[float]:
        """World to camera as OpenGL and PyBullet want it: 16 numbers, column after column."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.axes
        matrix[:3, 3] = -self.axes @ np.array(self.eye)
        return matrix.T.ravel().tolist()

    @property
    def projection_matrix(self) -> list[float]:
        """Camera to clip space as OpenGL and PyBullet want it: 16 numbers, column after column."""
        depth = NEAR_PLANE - FAR_PLANE
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 1] = self._focal * self.height / self.width, self._focal
        matrix[2, 2:] = (FAR_PLANE + NEAR_PLANE) / depth, 2.0 * FAR_PLANE * NEAR_PLANE / depth
        matrix[3, 2] = -1.0
        return matrix.T.ravel().tolist()

    def depth(self, points: ArrayLike) -> Array:
        """Distance in front of the camera along its axis [m], (N,), of points (N, 3) [m], world frame."""
        return (np.asarray(self.eye) - np.asarray(points, dtype=float)) @ self.axes[2]

    def project(self, points: ArrayLike) -> Array:
        """Pixels of points.

        Args:
            points: (N, 3) [m], world frame; points behind the camera are taken as just in front of it.

        Returns:
            (N, 2) pixels to the right and down from the top left corner of the picture, inside it or not.
        """
        axes = self.axes
        local = (np.asarray(points, dtype=float) - np.array(self.eye)) @ axes.T
        scale = 0.5 * self.height * self._focal / np.maximum(-local[:, 2], NEAR_PLANE)
        return np.column_stack([0.5 * self.width + scale * local[:, 0], 0.5 * self.height - scale * local[:, 1]])

    def unproject(self, depth: Array) -> Array:
        """World points (H, W, 3) [m] of the centres of the pixels of OpenGL's depth buffer (H, W)."""
        rows, columns = depth.shape
        along = FAR_PLANE * NEAR_PLANE / (FAR_PLANE - (FAR_PLANE - NEAR_PLANE) * depth)
        right = (2.0 * (np.arange(columns) + 0.5) / columns - 1.0) * self.width / self.height / self._focal
        up = (1.0 - 2.0 * (np.arange(rows) + 0.5) / rows) / self._focal
        local = np.stack(
            [along * right, along * up[:, None], -along],
            axis=-1,
        )
        return local @ self.axes + np.array(self.eye)

    def fitted(self, points: Array, margin: float, below: float) -> View:
        """The same direction and opening, moved so that all points are in the picture and in its middle.

        Args:
            points: (N, 3) [m], world frame.
            margin: part of the width and of the height left free on the left, on the right and above.
            below: part of the height left free below; `margin + below` and `2 margin` are less than 1.
        """
        axes = self.axes
        local = points @ axes.T
        slope = np.array([self.width / self.height, 1.0]) / self._focal  # of the sides of what the camera sees
        # x + s_high z <= c_x + s_high c_z and x - s_low z >= c_x - s_low c_z for every point, and the same for y
        high = slope * (1.0 - 2.0 * margin)
        low = slope * (1.0 - 2.0 * np.array([margin, below]))
        above = (local[:, :2] + high * local[:, 2:]).max(axis=0)
        under = (local[:, :2] - low * local[:, 2:]).min(axis=0)
        back = max(float(((above - under) / (high + low)).max()), float(local[:, 2].max()) + 2.0 * NEAR_PLANE)
        across = 0.5 * (above - high * back + under + low * back)
        eye = np.append(across, back) @ axes
        target = eye - axes[2]
        return View(tuple(eye.tolist()), tuple(target.tolist()), self.field_of_view, self.width, self.height)

    @cached_property
    def _focal(self) -> float:
        """Half the height of the picture over the tangent of half the opening: 1 / tan."""
        return float(1.0 / np.tan(0.5 * np.radians(self.field_of_view)))
