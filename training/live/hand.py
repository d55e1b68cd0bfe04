"""The simulated hand on the page, in real time: pulled with the mouse, its object changed while it holds it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from viser import transforms

from grasp_env._check import Array
from grasp_env.config import EnvConfig
from grasp_env.errors import GraspError
from grasp_env.force import METHODS, RULES, InitialForceRule
from grasp_env.sim.hand.description import HANDS, HandDescription
from grasp_env.sim.objects.description import SHAPES_WITHOUT_MESH
from training.live import look
from training.live.parts import Bar, Contacts, furnish, on_drag, on_press, on_set, put
from training.live.playground import Playground, View
from training.live.question import STARTLESS, Mood
from training.live.shapes import item_mesh, looks

FRAME = 1.0 / 30.0
"""[s] between two drawings while nothing is dragged."""
_MOST_LATE = 0.1
"""[s] of simulation that one drawing catches up with; a slower machine shows slower motion."""
_TEXT_EVERY = 4
"""Drawings between two of the numbers, which nobody reads 30 times a second."""
_FORCE_LENGTH = 0.12
"""Drawn length of a newton, in the object's size."""


class HandPage:
    """The scene and the panel of the simulated hand.

    Args:
        server: the page.
        config: hand, object and method; the hand is placed where it can hold the object.
        rule: the start rule of a name.
    """

    every: float | None = FRAME

    def __init__(self, server: viser.ViserServer, config: EnvConfig, rule: Callable[[str], str | InitialForceRule] = str) -> None:  # fmt: skip
        self._server, self._rule = server, rule
        self._ground = Playground(config, rule(config.initial_force))
        self._given, self._config = config, self._ground.config
        self._placed, self._strength = self._ground.scene.config.hand, 1.0
        self._lock = threading.Lock()
        self._todo: dict[str, Callable[[], None]] = {}  # of the worker, who alone touches the simulation
        self._wake: Callable[[], None] = lambda: None
        self._zoom = 1.0 / max(self._ground.scene.config.object.extent)
        self._frames = 0
        self._mood: Mood | None = None
        self._red = False
        self._before = time.monotonic()
        self._make_scene()
        self._make_panel()

    def watch(self, wake: Callable[[], None]) -> None:
        """Who is told of every event."""
        self._wake = wake

    def draw(self) -> None:
        """Advances the simulation to now and draws it; called by one thread."""
        with self._lock:
            todo, self._todo = self._todo, {}
        for act in todo.values():
            act()
        now = time.monotonic()
        ticks = min(int((now - self._before) / self._ground.dt), int(_MOST_LATE / self._ground.dt))
        self._before = max(self._before + ticks * self._ground.dt, now - _MOST_LATE)
        self._ground.advance(ticks)
        view = self._ground.view()
        with self._server.atomic():
            self._move(view)
            if view.mood is not self._mood or self._frames % _TEXT_EVERY == 0:
                self._tell(view)
            self._mood, self._frames = view.mood, self._frames + 1
        self._server.flush()

    # what is set and dragged

    def _later(self, name: str, act: Callable[[], None]) -> None:
        """The worker does it before its next drawing; of several of one name the last."""
        with self._lock:
            self._todo.pop(name, None)  # the last of all, too
            self._todo[name] = act
        self._wake()

    def _pull(self, event: Any) -> None:
        """The object was grabbed where the mouse met it, and is pulled towards the mouse in the plane of the screen."""
        start, end = np.array(event.start_position) / self._zoom, np.array(event.end_position) / self._zoom
        if event.phase == "start":
            self._later("grab", lambda: self._grab(start))
        if event.phase == "end":
            self._later("pull", lambda: self._ground.release())
        else:
            self._later("pull", lambda: self._ground.pull(self._grip, end))

    def _grab(self, point: Array) -> None:
        snapshot = self._ground.scene.look()
        self._grip = snapshot.rotation.T @ (point - snapshot.position)

    def _change_object(self) -> None:
        mass, friction = float(self._mass.value), float(self._friction.value)
        self._later("object", lambda: self._ground.change_object(mass, friction))

    def _change_push(self) -> None:
        self._ground.most_push = float(self._push.value)

    def _reset(self) -> None:
        def act() -> None:
            self._ground.reset()
            item = self._ground.scene.config.object
            self._mass.value, self._friction.value = round(item.mass, 3), round(item.friction, 3)

        self._later("reset", act)

    def _rebuild(self) -> None:
        settings = {"shape": self._shape.value, "method": self._method.value, "initial_force": self._start.value}
        self._strength = 0.01 * self._motors.value
        self._later("rebuild", lambda: self._build(settings))

    def _build(self, settings: dict[str, str]) -> None:
        """Another object or solver: the hand takes hold anew; where it cannot, it keeps what it has, and says why."""
        same = settings["shape"] == self._config.shape
        hand = self._placed if same else self._given.hand
        size = self._config.size if same else self._given.size if settings["shape"] == self._given.shape else ()
        start = settings["initial_force"]
        named = start if start in (*RULES, "previous") else "linear_combination"
        try:
            config = replace(
                self._config,
                hand=hand,
                size=size,
                shape=settings["shape"],
                method=settings["method"],
                initial_force=named,
            )
            ground = Playground(
                config, None if settings["method"] in STARTLESS else self._rule(start), self._ground.most_push
            )
        except GraspError as error:
            self._trouble = f"{error}"
            return
        self._trouble = ""
        self._ground.close()
        self._ground, self._config = ground, ground.config
        if not same:
            self._placed = _weaker(ground.scene.config.hand, 1.0 / self._strength)
        self._make_bodies()

    # the panel

    def _make_panel(self) -> None:
        gui, config = self._server.gui, self._config
        self._trouble = ""
        self._answer = gui.add_html("")
        with gui.add_folder("Pull the object with the mouse"):
            self._push = gui.add_slider("most pull, N", 1.0, 40.0, 0.5, self._ground.most_push, hint="of the spring between the object and the mouse")  # fmt: skip
            again = gui.add_button("Take hold again")
        with gui.add_folder("Object and hand"):
            shapes = [config.shape] if config.shape == "mesh" else [*SHAPES_WITHOUT_MESH]
            self._shape = gui.add_dropdown("shape", shapes, initial_value=config.shape)
            self._mass = gui.add_slider("mass, kg", 0.02, 1.0, 0.01, min(max(config.object_mass, 0.02), 1.0))
            self._friction = gui.add_slider("friction", 0.05, 1.2, 0.01, min(max(config.friction, 0.05), 1.2))
            self._motors = gui.add_slider(
                "motors, %", 2, 100, 1, 100, hint="of the torques that the hand's joints have"
            )
        with gui.add_folder("Solver"):
            self._method = gui.add_dropdown("method", [*METHODS], initial_value=config.method)
            self._start = gui.add_dropdown("start", [*look.STARTS], initial_value=config.initial_force)
        on_set(self._push, self._change_push)
        on_press(again, self._reset)
        on_set(self._mass, self._change_object)
        on_set(self._friction, self._change_object)
        for choice in (self._shape, self._motors, self._method, self._start):
            on_set(choice, self._rebuild)

    def _tell(self, view: View) -> None:
        names = self._ground.scene.config.hand.finger_names
        rows = [
            (name, f"{commanded:.2f}", f"{measured:.2f}", f"{margin:.2f}")
            for name, (commanded, measured), margin in zip(names, view.normals, view.margins, strict=True)
        ]
        rest = look.table(("normal force, N", "wanted", "felt", "margin"), rows, self._colours)
        margin = f"{view.torque_margin:.3f} N m" if math.isfinite(view.torque_margin) else "–"
        facts = [
            ("pulled with", f"{np.linalg.norm(view.push):.1f} N"),
            ("least torque margin", margin),
            ("moved, turned", f"{1e3 * view.drift:.2f} mm, {math.degrees(view.tilt):.2f}°"),
            ("iterations of the last tick", str(view.iterations)),
            ("simulated", f"{view.time:.1f} s"),
        ]
        rest += look.table((), facts)
        advice = [self._trouble] if self._trouble else []
        self._answer.content = look.said(view.status, view.words, look.MOODS[view.mood], rest, advice)
        status = "" if view.mood is Mood.GOOD else view.status
        if self._status.text != status:
            self._status.text = status

    # the scene

    def _make_scene(self) -> None:
        scene, zoom = self._server.scene, self._zoom
        corners = self._corners(self._ground.view())
        low, high = zoom * corners.min(axis=0), zoom * corners.max(axis=0)
        bars = (
            Bar("force of a finger", look.QUIET, _FORCE_LENGTH, "N"),
            Bar("your pull", look.LOAD, _FORCE_LENGTH, "N"),
        )
        size = float(np.linalg.norm(high - low))
        furnish(self._server, 0.5 * (low + high), 0.82 * size, float(low[1]) - 0.2, bars)
        self._arrow = scene.add_arrows("/pull/arrow", np.zeros((1, 2, 3)), look.LOAD, shaft_radius=0.022, head_radius=0.055, head_length=0.11, visible=False)  # fmt: skip
        self._status = scene.add_label("/status", "", position=(0.0, float(high[1]) + 0.15, 0.0), anchor="bottom-center", font_screen_scale=1.3)  # fmt: skip
        self._make_bodies()

    def _corners(self, view: View) -> Array:
        """Of all that is drawn, world frame [m]."""
        hand, item = self._ground.scene.config.hand, self._ground.scene.config.object
        points = [np.asarray(item_mesh(item).vertices) @ view.rotation.T + view.position]
        points += [corners for corners, _, _ in looks(hand.palm)]
        for link, frame, origin in zip(hand.links, view.frames, view.origins, strict=True):
            points += [corners @ frame.T + origin for corners, _, _ in looks(link)]
        return np.vstack(points)

    def _make_bodies(self) -> None:
        """Hand, object and contacts; those of before are replaced."""
        scene, zoom, config = self._server.scene, self._zoom, self._ground.scene.config
        scene.remove_by_name("/hand")
        links = {link.name: link for link in config.hand.links}
        tips = np.array([links[tip.link].color for tip in config.hand.fingertips])
        alike = len(np.unique(tips, axis=0)) < len(tips)  # hands from files have one colour: their contacts get ours
        self._colours = look.colours(len(tips)) if alike else np.array([look.tint(color) for color in tips], np.uint8)
        self._links = []
        for k, body in enumerate((config.hand.palm, *config.hand.links)):
            frame = scene.add_frame(f"/hand/{k}", show_axes=False)
            for part, (corners, faces, color) in enumerate(looks(body)):
                scene.add_mesh_simple(f"/hand/{k}/{part}", zoom * corners, faces, color=look.tint(color), opacity=0.5 if k == 0 else 0.72, flat_shading=len(faces) <= 200)  # fmt: skip
            self._links += [] if k == 0 else [frame]
        mesh = item_mesh(config.object)
        self._object = scene.add_frame("/object", show_axes=False)
        self._body = scene.add_mesh_simple("/object/body", zoom * mesh.vertices, mesh.faces, color=look.BODY, opacity=0.45, flat_shading=config.object.shape in ("cuboid", "mesh"))  # fmt: skip
        edges = look.sharp_edges(mesh)
        scene.add_line_segments("/object/edges", zoom * (edges if len(edges) else np.zeros((1, 2, 3))), look.EDGES, thickness=1.6, thickness_units="screen")  # fmt: skip
        on_drag(self._body, self._pull)
        self._red = False
        self._contacts = Contacts(scene, self._colours, _FORCE_LENGTH)

    def _move(self, view: View) -> None:
        zoom = self._zoom
        for node, rotation, origin in zip(self._links, view.frames, view.origins, strict=True):
            _place(node, rotation, zoom * origin)
        _place(self._object, view.rotation, zoom * view.position)
        bad = view.mood is Mood.BAD
        friction = np.where(view.active, view.friction, 0.0)  # no cone where nothing touches
        self._contacts.draw(zoom * view.points, view.inwards, view.forces, friction, look.BAD if bad else None)
        if self._red != bad:
            self._body.color, self._red = look.BAD if bad else look.BODY, bad
        pulled = bool(view.push.any())
        if self._arrow.visible != pulled:
            self._arrow.visible = pulled
        if pulled:
            put(self._arrow, points=np.array([[zoom * view.grip, zoom * view.grip + _FORCE_LENGTH * view.push]]))


def _weaker(hand: str | HandDescription, strength: float) -> HandDescription:
    """The hand with a part of its torques."""
    described = HANDS[hand]() if isinstance(hand, str) else hand
    return replace(
        described, links=tuple(replace(link, torque_limit=strength * link.torque_limit) for link in described.links)
    )


def _place(node: Any, rotation: Array, origin: Array) -> None:
    put(node, position=origin, wxyz=transforms.SO3.from_matrix(rotation).wxyz)
