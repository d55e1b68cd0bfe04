"""What both pages are made of: the room, contacts with cones and forces, a legend, events in their order, recordings."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser

from grasp_env._check import Array
from grasp_env._files import replacing
from training.live import look

MOST_RECORDED = 120.0
"""[s] after which a recording ends by itself: what is later is not in it."""
_EYE = np.array([2.0, 1.15, 2.4])


@dataclass(frozen=True)
class Bar:
    """A line of the legend: a bar of a round number.

    Attributes:
        name: of what is drawn so long. colour: its own.
        scale: drawn length of one unit. unit: its name.
    """

    name: str
    colour: tuple[int, int, int]
    scale: float
    unit: str


def put(handle: Any, **values: Any) -> None:
    """Sets what has changed of a node, which is not made anew."""
    for name, value in values.items():
        made = value if getattr(value, "dtype", None) == np.uint8 else np.asarray(value, np.float32)
        if not np.array_equal(np.asarray(getattr(handle, name), made.dtype), made):
            setattr(handle, name, made)


def on_set(handle: Any, act: Callable[[], None]) -> None:
    """Calls `act` when somebody at the page sets `handle`, in the order of the events; what the program sets is none."""

    @handle.on_update
    async def _(event: Any) -> None:
        if event.client_id is not None:
            act()


def on_press(handle: Any, act: Callable[[], None]) -> None:
    """Calls `act` when a button is pressed."""

    @handle.on_click
    async def _(_: Any) -> None:
        act()


def on_drag(handle: Any, act: Callable[[Any], None]) -> None:
    """Calls `act` with every event of dragging `handle`, in their order."""

    @handle.on_drag
    async def _(event: Any) -> None:
        act(event)


def furnish(server: viser.ViserServer, centre: Array, size: float, floor: float, bars: Sequence[Bar]) -> None:
    """Light, floor, camera and legend around what fills a ball of diameter `size` about `centre`, in units of the scene."""
    scene, away = server.scene, _EYE / np.linalg.norm(_EYE)
    scene.set_up_direction("+y")
    scene.world_axes.visible = False
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(168, 176, 190), intensity=2.1)
    scene.add_light_directional("/light/sun", color=(255, 250, 242), intensity=2.0, position=(2.0, 6.0, 3.5), cast_shadow=True)  # fmt: skip
    camera, eye = server.initial_camera, centre + 2.15 * size * away
    camera.fov, camera.near = math.radians(36.0), 0.02
    camera.position, camera.look_at = eye, centre

    @server.on_client_connect
    async def _(client: viser.ClientHandle) -> None:
        if client.camera.aspect < 1.0:  # a narrow window: from farther away
            client.camera.position = centre + (eye - centre) / max(client.camera.aspect, 0.4)

    scene.add_grid("/floor", plane="xz", position=(0.0, floor, 0.0), width=10.0, height=10.0, cell_size=0.25, section_size=1.0,
                   cell_color=(226, 231, 238), section_color=(205, 212, 222), fade_distance=4.0 * size, fade_strength=1.6, shadow_opacity=0.16)  # fmt: skip
    front = np.array([away[0], 0.0, away[2]]) / np.hypot(away[0], away[2])
    right = np.cross([0.0, 1.0, 0.0], front)
    for row, bar in enumerate(bars):
        number = look.round_number(0.5 / bar.scale)
        start = np.array([0.0, floor + 0.02, 0.0]) + (0.3 * size + 0.085 * size * row) * front - 0.5 * size * right
        scene.add_arrows(f"/legend/{row}/bar", np.array([[start, start + number * bar.scale * right]]), bar.colour, shaft_radius=0.014, head_radius=0.036, head_length=0.08)  # fmt: skip
        scene.add_label(f"/legend/{row}/text", f"{number:g} {bar.unit} {bar.name}", position=start + (number * bar.scale + 0.07) * right, anchor="center-left", font_screen_scale=1.0)  # fmt: skip


class Contacts:
    """Contact points, inward normals, friction cones and force arrows of N contacts: made once, moved ever after.

    Args:
        scene: of the server.
        colours: (N, 3) uint8.
        force_scale: drawn length of a newton.
    """

    def __init__(self, scene: viser.SceneApi, colours: np.ndarray, force_scale: float) -> None:
        count = len(colours)
        self._colours, self._scale = colours, force_scale
        still, zero = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.zeros((count, 3))
        self._cones = scene.add_batched_meshes_simple("/contacts/cones", *look.cone(), still, zero, batched_scales=np.ones((count, 3)), batched_colors=colours,
                                                      opacity=0.4, side="double", lod="off", cast_shadow=False, receive_shadow=False)  # fmt: skip
        self.points = scene.add_batched_meshes_simple("/contacts/points", *look.ball(), still, zero, batched_scales=np.full((count, 3), 0.034),
                                                      batched_colors=colours, lod="off", cast_shadow=False)  # fmt: skip
        self._normals = scene.add_line_segments("/contacts/normals", np.zeros((count, 2, 3)), look.QUIET, thickness=1.6, thickness_units="screen")  # fmt: skip
        self._forces = scene.add_arrows("/contacts/forces", np.zeros((count, 2, 3)), colours, shaft_radius=0.017, head_radius=0.04, head_length=0.085)  # fmt: skip

    def draw(self, places: Array, normals: Array, forces: Array, friction: Array, colour: tuple[int, int, int] | None = None) -> None:  # fmt: skip
        """Draws contacts in scene units.

        Args:
            places: (N, 3). normals: (N, 3) inward. forces: (N, 3) on the object [N]. friction: (N,).
            colour: of all; None: their own.
        """
        colours = self._colours if colour is None else np.tile(np.array(colour, np.uint8), (len(places), 1))
        slope = look.CONE_HEIGHT * friction
        put(self._cones, batched_positions=places, batched_wxyzs=look.along(-normals), batched_colors=colours,
            batched_scales=np.column_stack([slope, slope, np.full(len(places), look.CONE_HEIGHT)]))  # fmt: skip
        put(self.points, batched_positions=places, batched_colors=colours)
        put(self._normals, points=np.stack([places, places + 0.16 * normals], axis=1))
        put(self._forces, points=np.stack([places - self._scale * forces, places], axis=1), colors=colours)
        shown = bool(forces.any())
        if self._forces.visible != shown:
            self._forces.visible = shown


class Recorder:
    """Records what is drawn, with its times, for one HTML file that needs neither server nor network.

    Args:
        server: what is recorded.
        path: the file.
        caption: said in the file's corner.
    """

    def __init__(self, server: viser.ViserServer, path: Path, caption: str) -> None:
        self.path, self._caption = path, caption
        self._serializer = server.get_scene_serializer()
        self._begin = self._last = time.monotonic()

    def frame(self) -> bool:
        """The next drawing begins now; False: the recording is full."""
        now = time.monotonic()
        self._serializer.insert_sleep(now - self._last)
        self._last = now
        return now - self._begin < MOST_RECORDED

    def save(self) -> None:
        """Ends it and writes the file, whole or not at all."""
        self._serializer.insert_sleep(min(time.monotonic() - self._last, 1.0))
        page = self._serializer.as_html()
        note = (
            '<div style="position:fixed;left:16px;top:14px;font:600 15px system-ui,sans-serif;color:#1f2937;pointer-events:none;z-index:9">'
            f"{html.escape(self._caption)}</div></body>"
        )
        page = page.replace("<title>Viser</title>", f"<title>{html.escape(self._caption)}</title>", 1)
        place = page.rindex("</body>")
        with replacing(self.path) as temporary:
            temporary.write_text(page[:place] + note + page[place + len("</body>") :], encoding="utf-8")
