"""MuJoCo's own renderer, which needs OpenGL but no display."""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from PIL import Image

from grasp_env.errors import SimulationError
from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.files.meshes import read_looks
from grasp_env.sim.mjcf import OBJECT_GROUP, link_name, looks_mjcf
from grasp_env.sim.mujoco_api import mujoco
from grasp_env.sim.objects.description import ObjectDescription
from grasp_env.sim.picture.painter import Painter, before_background
from grasp_env.sim.picture.view import FAR_PLANE, NEAR_PLANE, View
from grasp_env.sim.scene import Scene

_BACKENDS = ("egl", "osmesa", "glfw", "cgl")  # modules of MuJoCo that make an OpenGL context
_MAX_SHAPES = 10_000


class MujocoPainter(Painter):
    """Renderer with a model of its own of the visual shapes; see `Painter`."""

    def __init__(self, scene: Scene | None = None) -> None:
        self._scene = scene
        self._drawn: object = None  # `scene.core` for which the model was built
        self._option = mujoco.MjvOption()
        self._gl = _gl_context()
        self._contexts: list[Any] = []  # at most one: MuJoCo's OpenGL objects of the current model
        self._clean = weakref.finalize(self, _free, self._gl, self._contexts)
        self._clean.atexit = False  # MuJoCo's own clean-up may run first

    @classmethod
    def of_scene(cls, scene: Scene) -> MujocoPainter:
        """See `Painter`."""
        return cls(scene)

    @classmethod
    def of_hand(cls, hand: HandDescription, angles: Array) -> MujocoPainter:
        """See `Painter`."""
        painter = cls()
        painter._build(hand)
        painter._place(angles)
        return painter

    def shoot(
        self, view: View, factor: int = 1, shadows: bool = False
    ) -> tuple[Image.Image, Array]:
        """See `Painter`."""
        self._gl.make_current()
        self._follow()
        width = factor * view.width
        height = factor * view.height
        (context,), scene = self._contexts, self._shapes
        if (context.offWidth, context.offHeight) != (width, height):
            mujoco.mjr_resizeOffscreen(width, height, context)
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._option,
            None,
            mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL.value,
            scene,
        )
        slope = float(view.slope[1])
        for camera in scene.camera:  # of both eyes: MuJoCo takes their mean
            camera.pos = view.eye
            camera.forward = -view.axes[2]
            camera.up = view.axes[1]
            camera.frustum_near = NEAR_PLANE
            camera.frustum_far = FAR_PLANE
            camera.frustum_center = 0.0
            camera.frustum_top = NEAR_PLANE * slope
            camera.frustum_bottom = -NEAR_PLANE * slope
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        pixels = np.empty((height, width, 3), np.uint8)
        depth = np.empty((height, width), np.float32)
        frame = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(frame, scene, context)
        mujoco.mjr_readPixels(pixels, depth, frame, context)
        # OpenGL's rows go upwards
        return before_background(np.ascontiguousarray(pixels[::-1]), depth[::-1])

    @contextmanager
    def object_hidden(self) -> Iterator[None]:
        """See `Painter`."""
        self._option.geomgroup[OBJECT_GROUP] = 0
        try:
            yield
        finally:
            self._option.geomgroup[OBJECT_GROUP] = 1

    def close(self) -> None:
        """See `Painter`."""
        self._clean()

    def _follow(self) -> None:
        """Update the model to the bodies and poses of the scene."""
        scene = self._scene
        if scene is None:
            return
        # see `Simulator.read`: angles, rates, position, quaternion x, y, z, w
        reading = scene.simulator.read()
        if scene.core is not self._drawn:
            self._build(scene.config.hand, scene.config.object)
            self._drawn = scene.core
        joints = scene.config.hand.joint_count
        x, y, z, *turn = reading[2 * joints : 2 * joints + 7]
        self._place(np.array([*reading[:joints], x, y, z, turn[3], *turn[:3]]))

    def _build(self, hand: HandDescription, item: ObjectDescription | None = None) -> None:
        text, files = looks_mjcf(hand, item)
        spec = mujoco.MjSpec.from_string(text)
        meshes = read_looks(shape.file for shape in files.values())
        for name, shape in files.items():
            corners, faces = meshes[shape.file]
            spec.add_mesh(
                name=name,
                uservert=(corners * shape.size).ravel().tolist(),
                userface=faces.ravel().tolist(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        count = hand.joint_count
        joints = [self._model.joint(link_name(index)).qposadr[0] for index in range(count)]
        self._order = np.array([*joints, *range(count, self._model.nq)])
        self._shapes = mujoco.MjvScene(self._model, _MAX_SHAPES)
        self._gl.make_current()
        while self._contexts:
            self._contexts.pop().free()
        context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._contexts.append(context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)

    def _place(self, state: Array) -> None:
        """Set joint angles, then position and quaternion (w first) of the object, if any."""
        self._data.qpos[self._order] = np.nan_to_num(state)  # not finite after divergence
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)


def _gl_context() -> Any:
    """Make an OpenGL context without a window, by the module in MUJOCO_GL or the best one."""
    name = os.environ.get("MUJOCO_GL", "").strip().lower()
    if name not in _BACKENDS:
        if sys.platform.startswith("linux"):
            name = "egl" if find_library("EGL") or not find_library("OSMesa") else "osmesa"
        else:
            name = "cgl" if sys.platform == "darwin" else "glfw"
    # PyTorch for CUDA installs triton; imported after Mesa's software renderer, its other version
    # of LLVM crashes Python
    if find_spec("triton"):
        import_module("triton")
    try:
        context = import_module(f"mujoco.{name}").GLContext(1, 1)
        context.make_current()
    except Exception as error:  # PyOpenGL and drivers raise many kinds of errors
        raise SimulationError(
            f"MuJoCo draws pictures with OpenGL, and {name} gives none here ({error}): on Debian or Ubuntu run `apt-get install libegl1 "
            "libgl1-mesa-dri`, or `apt-get install libosmesa6` and set MUJOCO_GL=osmesa; without pictures leave render_mode out"
        ) from error
    return context


def _free(gl: Any, contexts: list[Any]) -> None:
    gl.make_current()
    while contexts:
        contexts.pop().free()
    gl.free()
