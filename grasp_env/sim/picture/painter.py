"""Interface of renderers, one for each physics engine."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from PIL import Image, ImageOps

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.picture.annotation import WRENCH_COLOR, WRENCH_STRETCH, Annotation
from grasp_env.sim.picture.view import View
from grasp_env.sim.scene import Scene

BACKGROUND_DEPTH = 0.99999  # least OpenGL depth of the background
AMBIENT, DIFFUSE, SPECULAR = 0.62, 0.42, 0.08  # intensities of light
LIGHT = (0.5, 1.0, 0.6)  # direction towards the light, world frame


class Painter(Protocol):
    """Renderer of hand and object in their poses; `EngineSettings.painter` names its class."""

    @classmethod
    def of_scene(cls, scene: Scene) -> Painter:
        """Make a painter of a scene and of what it loads later."""
        ...

    @classmethod
    def of_hand(cls, hand: HandDescription, angles: Array) -> Painter:
        """Make a painter of a hand alone, with its joints at `angles` (M,) [rad]."""
        ...

    def shoot(
        self, view: View, factor: int = 1, shadows: bool = False
    ) -> tuple[Image.Image, Array]:
        """Render hand and object before a light background; return the picture and OpenGL's depth.

        Both have `factor` pixels per pixel of the view along each side.

        Raises:
            SimulationError: The scene is closed, or this machine cannot render.
        """
        ...

    def object_hidden(self) -> AbstractContextManager[None]:
        """Hide the object in pictures while the block runs."""
        ...

    def show(self, annotation: Annotation) -> None:
        """Draw the fingers' forces and the wrench's as lines in the window, if there is one."""

    def close(self) -> None:
        """Free the renderer, but not the scene."""


def before_background(pixels: Any, depth: Any) -> tuple[Image.Image, Array]:
    """Put pixels (H, W, 3) with their depth (H, W) before the background."""
    height, width = depth.shape
    mask = Image.fromarray(depth < BACKGROUND_DEPTH)
    return Image.composite(Image.fromarray(pixels), _background(width, height), mask), depth


def lines_of(annotation: Annotation) -> list[tuple[Array, Array, Array]]:
    """Return start [m], end [m] and colour of a line for each finger's force and the wrench's.

    Lines of inactive fingers have no length.
    """
    starts = annotation.points - annotation.scale * annotation.active[:, None] * annotation.forces
    tip = annotation.center + WRENCH_STRETCH * annotation.scale * annotation.wrench[:3]
    wrench = annotation.center, tip, np.divide(WRENCH_COLOR, 255.0)
    return [*zip(starts, annotation.points, annotation.colors, strict=True), wrench]


@lru_cache(maxsize=4)
def _background(width: int, height: int) -> Image.Image:
    # nearly white at the top and light grey at the bottom
    return ImageOps.colorize(
        Image.linear_gradient("L").resize((width, height)), (253, 253, 254), (226, 231, 238)
    )
