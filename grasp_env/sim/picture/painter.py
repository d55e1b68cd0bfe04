"""Rendering of the bodies of a scene, one class for each physics engine."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from PIL import Image, ImageOps

from grasp_env._check import Array
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.picture.annotation import WRENCH_COLOR, WRENCH_STRETCH, Annotation
from grasp_env.sim.picture.view import View
from grasp_env.sim.scene import Scene

BACKGROUND_DEPTH = 0.99999
"""Pixels whose OpenGL depth is at least this show the background."""
AMBIENT, DIFFUSE, SPECULAR = 0.62, 0.42, 0.08
"""Parts of the light."""
LIGHT = (0.5, 1.0, 0.6)
"""Towards the light, world frame."""


class Painter(Protocol):
    """Draws hand and object where they are; named by `Engine.painter`."""

    @classmethod
    def of_scene(cls, scene: Scene) -> Painter:
        """Draws what this scene simulates, whatever it loads later."""
        ...

    @classmethod
    def of_hand(cls, hand: HandDescription, angles: Array) -> Painter:
        """Draws a hand alone, its joints at `angles` (M,) [rad]."""
        ...

    def shoot(self, view: View, factor: int = 1, shadows: bool = False) -> tuple[Image.Image, Array]:
        """Everything that can be seen, before a light background: the picture and its OpenGL depth.

        Both have `factor` pixels per pixel of the view along each side.

        Raises:
            SimulationError: The scene is closed, or nothing can be drawn on this machine.
        """
        ...

    def object_hidden(self) -> AbstractContextManager[None]:
        """Leaves the object out of pictures while the block runs; its physics stays."""
        ...

    def show(self, annotation: Annotation) -> None:
        """Draws the forces of the fingers and of the wrench as lines into the window; only engines that have one are asked."""
        ...

    def close(self) -> None:
        """Frees what was made to draw; the scene stays."""
        ...


def before_background(pixels: Any, depth: Any) -> tuple[Image.Image, Array]:
    """Pixels (H, W, 3) before the background where the depth (H, W) is that of nothing."""
    height, width = depth.shape
    picture = Image.fromarray(pixels)
    return Image.composite(picture, _background(width, height), Image.fromarray(depth < BACKGROUND_DEPTH)), depth


def lines_of(annotation: Annotation) -> list[tuple[Array, Array, Array]]:
    """Start [m], end [m] and colour of a line for each finger, from outside to its contact, and of one for the wrench's force.

    A contact that is not active has a line of no length.
    """
    starts = annotation.points - annotation.scale * annotation.active[:, None] * annotation.forces
    tip = annotation.center + WRENCH_STRETCH * annotation.scale * annotation.wrench[:3]
    return [
        *zip(starts, annotation.points, annotation.colors, strict=True),
        (annotation.center, tip, np.divide(WRENCH_COLOR, 255.0)),
    ]


@lru_cache(maxsize=4)
def _background(width: int, height: int) -> Image.Image:
    """Changes evenly from nearly white at the top to a light grey at the bottom."""
    return ImageOps.colorize(Image.linear_gradient("L").resize((width, height)), (253, 253, 254), (226, 231, 238))
