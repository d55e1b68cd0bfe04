"""Camera that takes pictures of a scene without a display."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import number, whole
from grasp_env.inputs.ranges import Range
from grasp_env.sim.engine import class_of
from grasp_env.sim.hand.description import Vector3
from grasp_env.sim.picture.annotation import Annotation
from grasp_env.sim.picture.edges import smooth_edges
from grasp_env.sim.picture.overlay import draw
from grasp_env.sim.picture.painter import BACKGROUND_DEPTH, Painter
from grasp_env.sim.picture.view import View
from grasp_env.sim.scene import Scene

DIRECTION = (0.72, 0.11, 0.72)
"""Default direction from the object towards the camera: front right, a little above."""

_TIP = 0.025  # diameter of a fingertip [m]
_SURVEY = 160  # longer side of the picture that locates hand and object [pixels]
_SURVEY_DISTANCE = 1.2  # its distance from the nominal object, enough for hands of half a metre [m]

_RANGES = {
    "field_of_view": Range(1.0, 120.0, "degrees"),
    "margin": Range(0.0, 0.4),
    "footer": Range(0.0, 0.5),
    "arrows": Range(0.0, 1.0, "m"),
    "object_opacity": Range(0.0, 1.0),
}


@dataclass(frozen=True)
class CameraConfig:
    """View and size of a camera's pictures.

    Attributes:
        width, height: Size of the picture [pixels].
        direction: Direction from the object towards the camera, world frame, not vertical. None for
            `DIRECTION`, turned about the vertical if more contacts are visible then.
        field_of_view: Vertical opening angle [degrees].
        margin: Share of the width and of the height left free beside and above hand and object.
        footer: Share of the height left free below them for text.
        arrows: Distance from the object's centre along each axis that is also in the picture [m].
        object_opacity: Opacity of the object. Below 1 the tips behind it are visible, and drawing
            takes twice the time.
        supersampling: Rendered pixels per delivered pixel along each side; 1 is fastest, 3 is fine.

    Raises:
        InvalidInputError: A number is out of range, or the direction is vertical.

    Example:
        >>> CameraConfig(width=640, direction=(1.0, 0.3, 0.0)).height
        480
    """

    width: int = 480
    height: int = 480
    direction: Vector3 | None = None
    field_of_view: float = 26.0
    margin: float = 0.06
    footer: float = 0.19
    arrows: float = 0.0
    object_opacity: float = 0.6
    supersampling: int = 1

    def __post_init__(self) -> None:
        for name in ("width", "height", "supersampling"):
            whole(getattr(self, name), name, 1)
        for name, allowed in _RANGES.items():
            number(getattr(self, name), name, allowed)
        direction = DIRECTION if self.direction is None else self.direction
        if not np.isfinite(direction).all() or np.hypot(direction[0], direction[2]) < 1e-3:
            raise InvalidInputError(
                f"direction={self.direction} must be finite and not vertical (y is up)"
            )


class Camera:
    """Camera of one scene, whose picture hand and object fill.

    It moves only when the scene loads other bodies or `fit` is called.

    Args:
        scene: The scene.
        config: View and size.

    Attributes:
        painter: Renderer of the scene, see `Painter`.
        view: Current position and opening.

    Raises:
        SimulationError: This machine has no OpenGL, which MuJoCo's pictures need.

    Example:
        >>> scene = Scene(visuals=True)
        >>> camera = Camera(scene, CameraConfig(width=64, height=48))
        >>> camera.capture().shape
        (48, 64, 3)
        >>> scene.close()
    """

    def __init__(self, scene: Scene, config: CameraConfig | None = None) -> None:
        self.config = config or CameraConfig()
        self._scene = scene
        self.painter: Painter = class_of(scene.config.engine, "painter").of_scene(scene)
        self.fit()

    def __repr__(self) -> str:
        return f"Camera({self.config.width} x {self.config.height} pixels of {self._scene!r})"

    def fit(self) -> None:
        """Move the camera so that hand and object fill the picture.

        Raises:
            SimulationError: The scene is closed.
        """
        config = self.config
        shrink = _SURVEY / max(config.width, config.height)
        width = max(1, round(shrink * config.width))
        height = max(1, round(shrink * config.height))
        x, y, z = DIRECTION
        turns = 0.25 * np.pi * np.array([0, 1, -1, 2, -2, 3, -3, 4])
        directions = [
            (x * np.cos(turn) + z * np.sin(turn), y, z * np.cos(turn) - x * np.sin(turn))
            for turn in turns
        ]
        surveys = list[View]()
        for direction in directions if config.direction is None else [config.direction]:
            x, y, z = (_SURVEY_DISTANCE / np.linalg.norm(direction) * np.array(direction)).tolist()
            surveys.append(View((x, y, z), (0.0, 0.0, 0.0), 40.0, width, height))
        with self.painter.object_hidden():
            survey = max(surveys, key=self._contacts_seen)  # the first of the best
        _, depth = self.painter.shoot(survey)
        points = survey.unproject(depth)[depth < BACKGROUND_DEPTH]
        if config.arrows > 0.0:
            ends = config.arrows * np.vstack([np.eye(3), -np.eye(3)])
            points = np.vstack([points, self._scene.look().position + ends])
        self.view = View(
            survey.eye, survey.target, config.field_of_view, config.width, config.height
        )
        if len(points):
            self.view = self.view.fitted(points, config.margin, config.footer)
        self._fitted_to = self._scene.core

    def _contacts_seen(self, view: View) -> int:
        """Count the contacts that are hidden by nothing but their own tip."""
        scene = self._scene
        snapshot = scene.look()
        points = snapshot.position + np.array(scene.config.contact_points) @ snapshot.rotation.T
        _, depth = self.painter.shoot(view)
        columns, rows = view.project(points).astype(int).T
        inside = (columns >= 0) & (columns < view.width) & (rows >= 0) & (rows < view.height)
        front = view.unproject(depth)[rows[inside], columns[inside]]
        return int((view.depth(points[inside]) - view.depth(front) < _TIP).sum())

    def capture(self, annotation: Annotation | None = None) -> np.ndarray:
        """Take a picture of the current scene, (height, width, 3) uint8.

        Args:
            annotation: Forces, cones, wrench and text to draw over it; None for nothing.

        Raises:
            SimulationError: The scene is closed.
        """
        if self._scene.core is not self._fitted_to:
            self.fit()
        opacity = self.config.object_opacity
        factor = self.config.supersampling
        picture, depth = self.painter.shoot(self.view, factor, shadows=True)
        if opacity < 1.0:  # renderers have none: blend pictures with and without the object
            with self.painter.object_hidden():  # without shadows, which saves a tenth of the time
                behind, behind_depth = self.painter.shoot(self.view, factor)
            mixed = Image.blend(behind, picture, opacity)
            picture = Image.composite(mixed, picture, Image.fromarray(depth != behind_depth))
        picture = picture.reduce(factor) if factor > 1 else smooth_edges(picture)
        return np.array(picture if annotation is None else draw(picture, annotation, self.view))
