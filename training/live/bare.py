"""Bare contacts on the page: what can be dragged and set, and how the answer is drawn."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser

from grasp_env._check import Array
from grasp_env.force import METHODS, InitialForceRule
from grasp_env.grasp import Grasp
from training.live import look
from training.live.body import SHAPES, Body, body_of, shaped
from training.live.parts import Bar, Contacts, furnish, on_drag, on_press, on_set, put
from training.live.question import STARTLESS, Answer, Answers, Mood, Question, screw

FORCE, TURN = slice(0, 3), slice(3, 6)
"""Of a wrench."""
_COUNTS = (3, 8)
_NO_LIMIT = 50.0
"""[N] at the end of the slider: no limit."""
_LOAD_LENGTH, _FORCE_LENGTH = 0.95, 0.55
"""Of the first load's arrow and the longest of the first forces, in extents of the object."""


@dataclass(frozen=True, eq=False)
class Scales:
    """Lengths of the page, fixed for a session, in extents of the object: one scale for all forces.

    Attributes:
        zoom: [1/m].
        force, load, moment: of a finger's force [1/N], of the load's force [1/N] and of its moment [1/(N m)].
    """

    zoom: float
    force: float
    load: float
    moment: float


class BarePage:
    """The scene and the panel of bare contacts.

    Args:
        server: the page.
        question: what is asked first.
        rule: the start rule of a name.
    """

    every: float | None = None

    def __init__(self, server: viser.ViserServer, question: Question, rule: Callable[[str], str | InitialForceRule] = str) -> None:  # fmt: skip
        self._server = server
        self._first = self._question = question
        self._ask, self._lock = Answers(rule), threading.Lock()
        self._body = self._first_body = _body_of(question)
        self._wake: Callable[[], None] = lambda: None
        answer = self._ask(question)
        self._scales = _scales(question, answer, self._body)
        self._grips: dict[str, Array] = {}
        self._red, self._dragged = False, np.zeros(0)
        self._shown: tuple[Body, int] | None = None
        self._nodes: dict[str, Any] = {}
        self._make_scene()
        self._make_panel()

    def watch(self, wake: Callable[[], None]) -> None:
        """Who is told of every event."""
        self._wake = wake

    @property
    def question(self) -> Question:
        """What is asked now."""
        with self._lock:
            return self._question

    def draw(self) -> None:
        """Asks and draws what is asked now; called by one thread."""
        with self._lock:
            question, body = self._question, self._body
        answer = self._ask(question)
        with self._server.atomic():
            if self._shown != (body, len(question.positions)):
                self._make_bodies(body, question)
                self._red = False
            self._draw_contacts(question, answer)
            self._draw_load(question)
            self._draw_screw(question, answer)
            self._tell(question, answer)
            if question.wrench is self._dragged:  # the numbers follow the mouse, and leave alone who types them
                self._show_load(question.wrench)
        self._server.flush()

    # what is set and dragged

    def _change(self, **values: Any) -> None:
        with self._lock:
            self._question = replace(self._question, **values)
        self._wake()

    def _stand(self, body: Body, count: int) -> None:
        positions, normals = body.placed(count)
        with self._lock:
            self._body = body
            self._question = replace(self._question, positions=positions, normals=normals)
        self._wake()

    def _reset(self) -> None:
        with self._lock:
            self._question, self._body = self._first, self._first_body
        self._show_settings()
        self._wake()

    def _pull(self, name: str, event: Any, scale: float, part: slice) -> None:
        """A ball at the head of an arrow of the load was dragged in the plane of the screen."""
        end = np.array(event.end_position)
        if event.phase == "start":
            self._grips[name] = scale * self.question.wrench[part] - np.array(event.start_position)
        head = end + self._grips.get(name, np.zeros(3))
        wrench = self.question.wrench.copy()
        wrench[part] = head / scale
        self._dragged = wrench
        self._change(wrench=wrench)

    def _slide(self, event: Any) -> None:
        """A contact was dragged: it goes where the ray from the eye meets the object."""
        k, zoom = event.instance_index, self._scales.zoom
        question = self.question
        if k is None or k >= len(question.positions):
            return
        eye = np.array(event.client.camera.position) / zoom
        place, inward = self._body.under(eye, np.array(event.end_position) / zoom)
        positions, normals = question.positions.copy(), question.normals.copy()
        positions[k], normals[k] = place, inward
        self._change(positions=positions, normals=normals)

    # the panel

    def _make_panel(self) -> None:
        gui, question = self._server.gui, self._question
        self._answer = gui.add_html("")
        with gui.add_folder("Load on the object"):
            self._force = gui.add_vector3("force, N", tuple(question.wrench[:3]), step=0.1, hint="or drag the ball at the purple arrow")  # fmt: skip
            self._moment = gui.add_vector3("moment, N m", tuple(question.wrench[3:]), step=0.01, hint="or drag the ball at the pink arrow")  # fmt: skip
        with gui.add_folder("Contacts"):
            names = [*SHAPES] if self._body.name in SHAPES else [self._body.name, *SHAPES]
            self._shape = gui.add_dropdown("object", names, initial_value=self._body.name)
            self._count = gui.add_slider(
                "number", *_COUNTS, 1, min(max(len(question.positions), _COUNTS[0]), _COUNTS[1])
            )
            self._friction = gui.add_slider("friction", 0.02, 1.5, 0.01, min(max(question.friction, 0.02), 1.5))
            self._limit = gui.add_slider(
                "most normal force, N", 0.5, _NO_LIMIT, 0.5, _NO_LIMIT, marks=((_NO_LIMIT, "none"),)
            )
        with gui.add_folder("Solver"):
            self._method = gui.add_dropdown("method", [*METHODS], initial_value=question.method)
            self._start = gui.add_dropdown("start", [*look.STARTS], initial_value=question.start)
            self._weight = gui.add_slider("lambda, log10 N²", -6.0, 1.0, 0.1, math.log10(question.barrier_weight), hint="more: further inside the cones, with more squeeze")  # fmt: skip
        again = gui.add_button("Start again", color="gray")
        on_set(self._force, lambda: self._wrench_set())
        on_set(self._moment, lambda: self._wrench_set())
        on_set(self._shape, lambda: self._stand(self._body_named(self._shape.value), len(self.question.positions)))
        on_set(self._count, lambda: self._stand(self._body, int(self._count.value)))
        on_set(self._friction, lambda: self._change(friction=float(self._friction.value)))
        on_set(self._limit, lambda: self._change(max_normal=self._limit_value()))
        on_set(self._method, lambda: self._change(method=self._method.value))
        on_set(self._start, lambda: self._change(start=self._start.value))
        on_set(self._weight, lambda: self._change(barrier_weight=10.0**self._weight.value))
        on_press(again, self._reset)

    def _wrench_set(self) -> None:
        self._change(wrench=np.array([*self._force.value, *self._moment.value]))

    def _limit_value(self) -> float:
        return math.inf if self._limit.value >= _NO_LIMIT else float(self._limit.value)

    def _body_named(self, name: str) -> Body:
        return self._first_body if name == self._first_body.name else shaped(name, self._first_body.extent)

    def _show_load(self, wrench: Array) -> None:
        self._force.value = wrench[:3].round(3)
        self._moment.value = wrench[3:].round(4)

    def _show_settings(self) -> None:
        question = self.question
        self._show_load(question.wrench)
        self._shape.value, self._count.value = self._body.name, len(question.positions)
        self._friction.value, self._limit.value = question.friction, min(question.max_normal, _NO_LIMIT)
        self._method.value, self._start.value = question.method, question.start
        self._weight.value = math.log10(question.barrier_weight)

    def _tell(self, question: Question, answer: Answer) -> None:
        colour = look.MOODS[answer.mood]
        rest = ""
        if np.isfinite(answer.microseconds):
            rows = [
                (f"contact {k + 1}", f"{normal:.2f}", f"{margin:.2f}")
                for k, (normal, margin) in enumerate(zip(answer.normal_forces, answer.margins, strict=True))
            ]
            rest = look.table(("", "normal, N", "margin, N"), rows, look.colours(len(rows)))
            start = "" if question.method in STARTLESS else f" from {question.start}"
            facts = [
                ("total normal force", f"{answer.normal_forces.sum():.2f} N"),
                ("iterations", str(answer.iterations)),
                ("certified gap", f"{100.0 * answer.gap:.1g} %" if math.isfinite(answer.gap) else "–"),
                ("optimum within", f"{answer.bound:.6g} … {answer.objective:.6g}"),
                ("one solve", f"{answer.microseconds:.1f} µs"),
            ]
            rest += look.table((), facts) + f'<p style="opacity:.62">{question.method}{start}</p>'
        self._answer.content = look.said(answer.status, answer.words, colour, rest, answer.advice)
        self._nodes["status"].text = "" if answer.mood is Mood.GOOD else answer.status

    # the scene

    def _make_scene(self) -> None:
        scales, scene, nodes = self._scales, self._server.scene, self._nodes
        bars = (
            Bar("force of a finger", look.QUIET, scales.force, "N"),
            Bar("load's force", look.LOAD, scales.load, "N"),
            Bar("load's moment", look.MOMENT, scales.moment, "N m"),
        )
        furnish(self._server, np.array([0.0, -0.05, 0.0]), 2.0, -0.72, bars)
        corners, faces = look.ball()
        for name, colour, part, scale, thick in (("load", look.LOAD, FORCE, scales.load, 1.0), ("moment", look.MOMENT, TURN, scales.moment, 0.62)):  # fmt: skip
            nodes[name] = scene.add_arrows(f"/{name}/arrow", np.zeros((1, 2, 3)), colour, shaft_radius=0.02 * thick, head_radius=0.05 * thick, head_length=0.1 * thick)  # fmt: skip
            grip = nodes[f"{name} grip"] = scene.add_mesh_simple(f"/{name}/grip", 0.052 * corners, faces, color=colour)
            on_drag(grip, lambda event, name=name, scale=scale, part=part: self._pull(name, event, scale, part))
        nodes["turn"] = scene.add_line_segments("/moment/turn", np.zeros((36, 2, 3)), look.MOMENT, thickness=0.016)
        nodes["screw"] = scene.add_arrows("/screw/axis", np.zeros((1, 2, 3)), look.BAD, shaft_radius=0.016, head_radius=0.05, head_length=0.12, visible=False)  # fmt: skip
        nodes["turns"] = scene.add_line_segments("/screw/turns", np.zeros((48, 2, 3)), look.BAD, thickness=0.024, visible=False)  # fmt: skip
        nodes["tip"] = scene.add_arrows("/screw/tip", np.zeros((1, 2, 3)), look.BAD, shaft_radius=0.01, head_radius=0.06, head_length=0.12, visible=False)  # fmt: skip
        nodes["status"] = scene.add_label("/status", "", position=(0.0, 0.92, 0.0), anchor="bottom-center", font_screen_scale=1.3)  # fmt: skip

    def _make_bodies(self, body: Body, question: Question) -> None:
        """What another object or another number of contacts needs anew."""
        scene, nodes, zoom = self._server.scene, self._nodes, self._scales.zoom
        if self._shown is None or self._shown[0] is not body:
            edges = look.sharp_edges(body.mesh)
            nodes["body"] = scene.add_mesh_simple("/object/body", zoom * body.mesh.vertices, body.mesh.faces, color=look.BODY, opacity=0.36,
                                                  flat_shading=body.name != "sphere", cast_shadow=True)  # fmt: skip
            nodes["edges"] = scene.add_line_segments("/object/edges", zoom * (edges if len(edges) else np.zeros((1, 2, 3))), look.EDGES, thickness=1.6, thickness_units="screen")  # fmt: skip
        self._contacts = Contacts(scene, look.colours(len(question.positions)), self._scales.force)
        on_drag(self._contacts.points, self._slide)
        self._shown = body, len(question.positions)

    def _draw_contacts(self, question: Question, answer: Answer) -> None:
        bad = answer.mood is Mood.BAD
        friction = np.full(len(question.positions), question.friction)
        self._contacts.draw(
            self._scales.zoom * question.positions, question.normals, answer.forces, friction, look.BAD if bad else None
        )
        if self._red != bad:
            self._nodes["body"].color, self._red = look.BAD if bad else look.BODY, bad

    def _draw_load(self, question: Question) -> None:
        nodes, scales = self._nodes, self._scales
        for name, scale, part in (("load", scales.load, FORCE), ("moment", scales.moment, TURN)):
            head = scale * question.wrench[part]
            nodes[f"{name} grip"].position = tuple(head)
            put(nodes[name], points=np.array([[np.zeros(3), head]]))
        moment = question.wrench[TURN]
        size = float(np.linalg.norm(moment))
        nodes["turn"].visible = size > 1e-9
        if size > 1e-9:
            put(nodes["turn"], points=look.arc(0.7 * scales.moment * moment, moment / size, 0.13, 4.8))

    def _draw_screw(self, question: Question, answer: Answer) -> None:
        nodes, zoom, twist = self._nodes, self._scales.zoom, answer.twist
        for name in ("screw", "turns", "tip"):
            nodes[name].visible = twist is not None
        if twist is None:
            return
        point, axis, turning, sliding = screw(twist, question.positions.mean(axis=0))
        at = zoom * point
        length = 0.85 if sliding >= 0.0 else -0.85
        put(nodes["screw"], points=np.array([[at - length * axis, at + length * axis]]))
        rate = turning / zoom  # against the sliding, at the object's size
        nodes["turns"].visible = nodes["tip"].visible = rate > 0.05
        ring = look.arc(at, axis, 0.34, min(5.2, 4.0 * rate + 0.6), 48)
        put(nodes["turns"], points=ring)
        tangent = ring[-1, 1] - ring[-1, 0]
        put(nodes["tip"], points=np.array([[ring[-1, 1], ring[-1, 1] + 0.13 * tangent / np.linalg.norm(tangent)]]))


def _body_of(question: Question) -> Body:
    return body_of(Grasp.from_contacts(question.positions, question.normals, question.friction))


def _scales(question: Question, answer: Answer, body: Body) -> Scales:
    """Of the first question: its arrows are to be seen at once."""
    load, moment = (float(np.linalg.norm(question.wrench[part])) for part in (FORCE, TURN))
    most = float(np.linalg.norm(answer.forces, axis=1).max(initial=0.0))
    return Scales(1.0 / body.extent, _FORCE_LENGTH / (most or 5.0), _LOAD_LENGTH / (load or 1.0), 0.65 * _LOAD_LENGTH / (moment or 0.1))  # fmt: skip
