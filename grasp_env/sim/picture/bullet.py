"""PyBullet's software renderer, which needs no display, and lines in its window."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from PIL import Image

from grasp_env.inputs.arguments import Array
from grasp_env.sim.bullet import joint_indices
from grasp_env.sim.client import Client, bullet
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.urdf import write_hand
from grasp_env.sim.objects.description import OBJECT_COLOR
from grasp_env.sim.picture.annotation import Annotation
from grasp_env.sim.picture.painter import (
    AMBIENT,
    DIFFUSE,
    LIGHT,
    SPECULAR,
    Painter,
    before_background,
    lines_of,
)
from grasp_env.sim.picture.view import FAR_PLANE, NEAR_PLANE, View
from grasp_env.sim.scene import Scene


class BulletPainter(Painter):
    """Renderer of the bodies in a PyBullet server; see `Painter`."""

    def __init__(self, client: Client, scene: Scene | None = None) -> None:
        self._client, self._scene = client, scene
        self._lines: list[int] = []  # PyBullet's numbers of lines in the window, drawn for `_world`
        self._world: object = None

    @classmethod
    def of_scene(cls, scene: Scene) -> BulletPainter:
        """See `Painter`; the scene needs `visuals`."""
        return cls(scene.simulator.client, scene)

    @classmethod
    def of_hand(cls, hand: HandDescription, angles: Array) -> BulletPainter:
        """See `Painter`."""
        client = Client()
        with tempfile.TemporaryDirectory() as folder:
            body = bullet.loadURDF(
                write_hand(hand, folder), useFixedBase=True, physicsClientId=client.number
            )
        for joint, angle in zip(
            joint_indices(client.number, body, hand), angles.tolist(), strict=True
        ):
            bullet.resetJointState(body, joint, angle, physicsClientId=client.number)
        return cls(client)

    def shoot(
        self, view: View, factor: int = 1, shadows: bool = False
    ) -> tuple[Image.Image, Array]:
        """See `Painter`."""
        width = factor * view.width
        height = factor * view.height
        _, _, pixels, depth, _ = bullet.getCameraImage(
            width,
            height,
            bullet.computeViewMatrix(view.eye, view.target, (0.0, 1.0, 0.0)),
            bullet.computeProjectionMatrixFOV(
                view.field_of_view, view.width / view.height, NEAR_PLANE, FAR_PLANE
            ),
            lightDirection=LIGHT,
            lightColor=(1.0, 1.0, 1.0),
            lightAmbientCoeff=AMBIENT,
            lightDiffuseCoeff=DIFFUSE,
            lightSpecularCoeff=SPECULAR,
            shadow=int(shadows),
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client.number,
        )
        colors = np.reshape(pixels, (height, width, 4)).astype(np.uint8)[..., :3]
        return before_background(np.ascontiguousarray(colors), np.reshape(depth, (height, width)))

    @contextmanager
    def object_hidden(self) -> Iterator[None]:
        """See `Painter`."""
        self._show_object(0.0)
        try:
            yield
        finally:
            self._show_object(1.0)

    def show(self, annotation: Annotation) -> None:
        """See `Painter`. The lines are drawn once in the server's window and then moved."""
        assert self._scene is not None
        if self._scene.simulator.world is not self._world:  # loaded bodies have no lines yet
            self._world = self._scene.simulator.world
            self._lines = []
        lines = lines_of(annotation)
        self._lines = [
            bullet.addUserDebugLine(
                start.tolist(),
                end.tolist(),
                color.tolist(),
                lineWidth=4.0,
                physicsClientId=self._client.number,
                replaceItemUniqueId=line,
            )
            for (start, end, color), line in zip(
                lines, self._lines or [-1] * len(lines), strict=True
            )
        ]

    def close(self) -> None:
        """See `Painter`."""
        if self._scene is None:
            self._client.close()

    def _show_object(self, opacity: float) -> None:
        assert self._scene is not None
        body = self._scene.simulator.world.object
        bullet.changeVisualShape(
            body, -1, rgbaColor=(*OBJECT_COLOR, opacity), physicsClientId=self._client.number
        )
