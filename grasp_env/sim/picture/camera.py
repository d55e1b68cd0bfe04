"""Pictures of a scene, drawn without a display by PyBullet's software renderer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import Array
from grasp_env.errors import InvalidInputError
from grasp_env.sim.bullet import Bullet
from grasp_env.sim.client import bullet
from grasp_env.sim.hand.description import Vector3
from grasp_env.sim.picture.annotation import Annotation
from grasp_env.sim.picture.overlay import draw
from grasp_env.sim.picture.pixels import BACKGROUND_DEPTH, gradient, put_background, see_through, smooth_edges
from grasp_env.sim.picture.view import View
from grasp_env.sim.scene import Scene

_LIGHT = {
    "lightDirection": (0.5, 1.0, 0.6),
    "lightColor": (1.0, 1.0, 1.0),
    "lightAmbientCoeff": 0.62,
    "lightDiffuseCoeff": 0.42,
    "lightSpecularCoeff": 0.08,
}
_TOP, _BOTTOM = (253, 253, 254), (226, 231, 238)
DIRECTION = (0.72, 0.11, 0.72)
"""From the object towards the camera where nothing else is asked: from the front, the right and a little above."""
_TIP = 0.025  # [m] across of a fingertip
_SURVEY = 160  # pixels along the longer side of the picture that finds where things are
_SURVEY_DISTANCE = 1.2  # [m] from the nominal object, far enough for hands of half a metre


@dataclass(frozen=True)
class CameraConfig:
    """How the camera looks at the scene and what it delivers.

    Attributes:
        width: Of the picture [pixels].
        height: Of the picture [pixels].
        direction: From the object towards the camera, world frame; not vertical. None: `DIRECTION`, turned about the vertical
            where more of the contacts are seen so.
        field_of_view: Vertical opening [degrees].
        margin: Part of the width and of the height left free beside and above hand and object.
        footer: Part of the height left free below them, where annotations have their text.
        arrows: [m] about the object's centre that is in the picture, too.
        object_opacity: Below 1 the object lets the tips behind it be seen; drawing takes twice
            the time then.
        supersampling: Rendered pixels per delivered pixel along each side; 1 is fastest (edges
            are smoothed afterwards), 3 finest.

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
        if min(self.width, self.height, self.supersampling) < 1:
            raise InvalidInputError(
                f"width={self.width}, height={self.height} and supersampling={self.supersampling} must be at least 1"
            )
        if not 0.0 <= self.object_opacity <= 1.0:
            raise InvalidInputError(f"object_opacity={self.object_opacity} must be in [0, 1]")
        if not (0.0 <= self.margin <= 0.4 and 0.0 <= self.footer <= 0.5):
            raise InvalidInputError(f"margin={self.margin} must be in [0, 0.4] and footer={self.footer} in [0, 0.5]")
        if not 0.0 <= self.arrows <= 1.0:
            raise InvalidInputError(f"arrows={self.arrows} must be in [0, 1] m")
        if not 1.0 <= self.field_of_view <= 120.0:
            raise InvalidInputError(f"field_of_view={self.field_of_view} must be in [1, 120] degrees")
        if self.direction is not None and (
            not np.isfinite(self.direction).all() or np.hypot(self.direction[0], self.direction[2]) < 1e-3
        ):
            raise InvalidInputError(f"direction={self.direction} must be finite and not vertical (y is up)")


class Camera:
    """Takes pictures of one scene; make it when the first picture is wanted.

    It stands where hand and object fill the picture, and moves only when the scene builds other bodies or `fit` is called.

    Args:
        scene: The scene to look at.
        config: View and size.

    Raises:
        InvalidInputError: Bullet does not simulate the scene.

    Example:
        >>> scene = Scene(visuals=True)
        >>> camera = Camera(scene, CameraConfig(width=64, height=48))
        >>> camera.capture().shape
        (48, 64, 3)
        >>> scene.close()
    """

    def __init__(self, scene: Scene, config: CameraConfig | None = None) -> None:
        self.config = config = config or CameraConfig()
        if not isinstance(scene.simulator, Bullet):
            raise InvalidInputError(
                f"pictures are drawn by Bullet, the scene's engine is {type(scene.simulator).__name__}"
            )
        self._scene = scene
        size = config.supersampling * config.height, config.supersampling * config.width
        self._background = gradient(size[1], size[0], _TOP, _BOTTOM)
        self.fit()

    def __repr__(self) -> str:
        return f"Camera({self.config.width} x {self.config.height} pixels of {self._scene!r})"

    def fit(self) -> None:
        """Stand where all that is drawn now fills the picture.

        Raises:
            SimulationError: The scene is closed.
        """
        config = self.config
        shrink = _SURVEY / max(config.width, config.height)
        width, height = max(1, round(shrink * config.width)), max(1, round(shrink * config.height))

        def survey_from(direction: Array) -> View:
            eye = _SURVEY_DISTANCE * direction / np.linalg.norm(direction)
            return View(tuple(eye.tolist()), (0.0, 0.0, 0.0), 40.0, width, height)

        if config.direction is None:
            with self._scene.simulator.object_hidden():
                survey = max(map(survey_from, _around()), key=self._contacts_seen)  # the first of the best
        else:
            survey = survey_from(np.array(config.direction))
        _, depth = self._shoot(survey, width, height, shadows=False)
        drawn = survey.unproject(depth)[depth < BACKGROUND_DEPTH]
        if config.arrows > 0.0:
            ends = config.arrows * np.vstack([np.eye(3), -np.eye(3)])
            drawn = np.vstack([drawn, self._scene.look().position + ends])
        wanted = View(survey.eye, survey.target, config.field_of_view, config.width, config.height)
        self.view = wanted.fitted(drawn, config.margin, config.footer) if len(drawn) else wanted
        self._fitted_to = self._scene.simulator.world

    def _contacts_seen(self, view: View) -> int:
        """How many contacts have at most their own tip before them."""
        scene = self._scene
        snapshot = scene.look()
        points = snapshot.position + np.array(scene.config.contact_points) @ snapshot.rotation.T
        _, depth = self._shoot(view, view.width, view.height, shadows=False)
        columns, rows = view.project(points).astype(int).T
        inside = (columns >= 0) & (columns < view.width) & (rows >= 0) & (rows < view.height)
        before = view.unproject(depth)[rows[inside], columns[inside]]
        return int((view.depth(points[inside]) - view.depth(before) < _TIP).sum())

    def capture(self, annotation: Annotation | None = None) -> np.ndarray:
        """The scene now, (height, width, 3) uint8.

        Args:
            annotation: What to draw over it: forces, cones, wrench and text; None: nothing.

        Raises:
            SimulationError: The scene is closed.
        """
        if self._scene.simulator.world is not self._fitted_to:
            self.fit()
        opacity, factor = self.config.object_opacity, self.config.supersampling
        image, depth = self._render(shadows=True)
        if opacity < 1.0:  # the renderer knows only drawn and not drawn: blend the two
            with self._scene.simulator.object_hidden():  # what is behind has no shadows: that saves a tenth of the time
                image = see_through(image, depth, *self._render(shadows=False), opacity)
        if factor > 1:
            split = image[..., :3].reshape(self.config.height, factor, self.config.width, factor, 3)
            image = split.mean(axis=(1, 3)).round().astype(np.uint8)
        else:
            image = smooth_edges(image)
        return image if annotation is None else draw(image, annotation, self.view)

    def project(self, points: ArrayLike) -> Array:
        """Pixels (N, 2), right and down, of points (N, 3) [m], world frame; see `View.project`."""
        return self.view.project(points)

    def _render(self, shadows: bool) -> tuple[np.ndarray, np.ndarray]:
        """One picture (H, W, 4) with background, `supersampling` times the delivered size, uint8, and its depth."""
        height, width, _ = self._background.shape
        pixels, depth = self._shoot(self.view, width, height, shadows)
        return put_background(pixels, depth, self._background), depth

    def _shoot(self, view: View, width: int, height: int, shadows: bool) -> tuple[np.ndarray, np.ndarray]:
        return shoot(self._scene.simulator.client.number, view, width, height, shadows)


def _around() -> Iterator[Array]:
    """`DIRECTION`, then turned about the vertical by ever more, in steps of 45 degrees."""
    x, y, z = DIRECTION
    for eighths in (0, 1, -1, 2, -2, 3, -3, 4):
        c, s = np.cos(0.25 * np.pi * eighths), np.sin(0.25 * np.pi * eighths)
        yield np.array([c * x + s * z, y, c * z - s * x])


def shoot(client: int, view: View, width: int, height: int, shadows: bool) -> tuple[np.ndarray, np.ndarray]:
    """Colours (height, width, 4) uint8 and OpenGL depth (height, width) float32 of what is drawn in a PyBullet server."""
    _, _, pixels, depth, _ = bullet.getCameraImage(
        width, height, view.view_matrix, view.projection_matrix, **_LIGHT, shadow=int(shadows),
        renderer=bullet.ER_TINY_RENDERER, flags=bullet.ER_NO_SEGMENTATION_MASK, physicsClientId=client,
    )  # fmt: skip
    pixels = np.ascontiguousarray(pixels, np.uint8).reshape(height, width, 4)
    return pixels, np.ascontiguousarray(depth, np.float32).reshape(height, width)
