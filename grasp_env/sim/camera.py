"""Pictures of a scene, drawn without a display by PyBullet's software renderer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.sim.client import bullet
from grasp_env.sim.hand import Vector3
from grasp_env.sim.scene import Scene


@dataclass(frozen=True)
class CameraConfig:
    """Where the camera stands and what it delivers.

    Attributes:
        width: Of the picture [pixels].
        height: Of the picture [pixels].
        eye: Position of the camera [m], world frame.
        target: Point in the middle of the picture [m], world frame.
        field_of_view: Vertical opening [degrees].
        light: Direction towards the light, world frame.
        object_opacity: Below 1 the object lets the tips behind it be seen; drawing takes twice
            the time then.
        supersampling: Rendered pixels per delivered pixel along each side; 1 is fastest, 3 smooth.
    """

    width: int = 480
    height: int = 480
    eye: Vector3 = (0.37, 0.10, 0.39)
    target: Vector3 = (0.0, 0.046, 0.0)
    field_of_view: float = 34.0
    light: Vector3 = (0.6, 1.0, 0.7)
    object_opacity: float = 0.6
    supersampling: int = 1

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.supersampling) < 1:
            raise InvalidInputError(
                f"width={self.width}, height={self.height} and supersampling={self.supersampling} must be at least 1"
            )
        if not 0.0 <= self.object_opacity <= 1.0:
            raise InvalidInputError(f"object_opacity={self.object_opacity} must be in [0, 1]")


class Camera:
    """Takes pictures of one scene; make it when the first picture is wanted.

    Args:
        scene: The scene to look at.
        config: View and size.
    """

    def __init__(self, scene: Scene, config: CameraConfig | None = None) -> None:
        self.config = config = config or CameraConfig()
        self._scene = scene
        self._view = bullet.computeViewMatrix(config.eye, config.target, (0.0, 1.0, 0.0))
        self._projection = bullet.computeProjectionMatrixFOV(
            config.field_of_view, config.width / config.height, 0.05, 3.0
        )

    def capture(self) -> np.ndarray:
        """The scene now, (height, width, 3) uint8.

        Raises:
            SimulationError: The scene is closed.
        """
        opacity = self.config.object_opacity
        image = self._render()
        if opacity < 1.0:  # the renderer knows only drawn and not drawn: blend the two
            with self._scene.object_hidden():
                image = opacity * image + (1.0 - opacity) * self._render()
        return image.round().astype(np.uint8)

    def _render(self) -> np.ndarray:
        """One picture at the delivered size, (height, width, 3) float."""
        config, factor = self.config, self.config.supersampling
        width, height = factor * config.width, factor * config.height
        pixels = bullet.getCameraImage(
            width, height, self._view, self._projection, lightDirection=config.light, shadow=1,
            renderer=bullet.ER_TINY_RENDERER, flags=bullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._scene.client.number,
        )[2]  # fmt: skip
        image = np.asarray(pixels, dtype=np.uint8).reshape(height, width, 4)[:, :, :3]
        if factor == 1:
            return image.astype(float)
        return image.reshape(config.height, factor, config.width, factor, 3).mean(axis=(1, 3))
