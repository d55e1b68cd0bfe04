"""Page of bare contacts: the user drags or sets load and contacts, and sees forces and proofs."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import trimesh

from grasp_env.errors import GraspError
from grasp_env.force.initial import InitialForceRule
from grasp_env.force.options import METHODS
from grasp_env.grasp import Grasp, advise
from grasp_env.grasp.contact import contact_frames
from grasp_env.inputs.arguments import Array
from training.program.live import look
from training.program.live.answer import STARTS, Answer, answer
from training.program.live.window import Window

SHAPES = ("cuboid", "sphere", "cylinder")
HINT = "**Drag** the purple ball (force), the pink ball (moment) or a contact; elsewhere the mouse turns the view."
NO_LIMIT = 50.0
"""End of the slider [N], which means no limit."""
_FORCE, _LOAD, _MOMENT = 0.55, 0.95, 0.62
"""Drawn lengths of the first contact force, load force and moment, in object extents."""


class BareContacts(Window):
    """Contacts on an object under a load. The controls hold all settings except the contacts.

    Args:
        port: port of the page.
        grasp: initial contacts: hard, with one friction.
        wrench: (6,) initial load [N, N m], object frame.
        method: optimisation method.
        rule: function from a name to a start rule.

    Attributes:
        positions: (N, 3) contact points [m].
        normals: (N, 3) inward normals.
        answer: displayed result.
    """

    def __init__(
        self,
        port: int,
        grasp: Grasp,
        wrench: Array,
        method: str,
        rule: Callable[[str], str | InitialForceRule],
    ) -> None:
        self._grasp = grasp
        self._name, self._mesh = body_of(grasp)
        self._rule = cache(rule)
        self._extent = float(self._mesh.extents.max())
        self.answer = answer(grasp, wrench, method)
        normals = self.answer.columns.get("normal, N", np.array([5.0]))
        self._force_scale = _FORCE / float(normals.max())
        force = np.linalg.norm(wrench[:3]) or 1.0
        moment = np.linalg.norm(wrench[3:]) or 0.1
        self._load_scales = np.array([[_LOAD / force], [_MOMENT / moment]])
        super().__init__(port, HINT)
        self._add_controls(wrench, method)
        self._add_load()
        self._replace_body(self._mesh, grasp.positions, grasp.normals)

    def draw(self) -> None:
        """Solve for the current controls and contacts, and draw the answer."""
        shape = self.shape.value
        count = int(self.count.value)
        if (shape, count) != self._drawn_body:
            mesh = self._mesh
            if shape != self._name:
                mesh = look.object_mesh(shape, (self._extent,) * 3)
            self._replace_body(mesh, *place_contacts(mesh, count))
        wrench = np.array([*self.force.value, *self.moment.value])
        friction = float(self.friction.value)
        limit = math.inf if self.limit.value >= NO_LIMIT else float(self.limit.value)
        forces = np.zeros_like(self.positions)
        advice = []
        try:
            grasp = Grasp.from_contacts(self.positions, self.normals, friction)
            start = self._rule(self.start.value)
            weight = 10.0**self.weight.value
            previous = self.answer.solution
            self.answer = answer(grasp, wrench, self.method.value, start, weight, limit, previous)
            advice = advise(grasp)
            if self.answer.solution is not None:
                forces = grasp.to_object_frame(self.answer.solution.force)
        except GraspError as error:
            self.answer = Answer("bad", "not solved", f"{error}")
        bad = self.answer.mood == "bad"
        twist = self.answer.twist
        names = [f"contact {k + 1}" for k in range(len(forces))] if self.answer.columns else []
        self.show(self.answer, names, advice)
        self._body.color = look.BAD if bad else look.BODY
        frames = contact_frames(self.normals)
        cones = np.full(len(forces), friction)
        self._contacts.draw(self.positions / self._extent, frames, forces, cones, bad)
        heads = self._load_scales * wrench.reshape(2, 3)
        self._load.points = np.stack([np.zeros((2, 3)), heads], axis=1)
        for ball, head in zip(self._balls, heads, strict=True):
            ball.position = head
        self._screw.visible = twist is not None
        if twist is not None:
            self._screw.points = look.screw(twist, self.positions.mean(axis=0), self._extent)

    def _replace_body(self, mesh: trimesh.Trimesh, positions: Array, normals: Array) -> None:
        self._drawn_body = self.shape.value, int(self.count.value)
        self.mesh = mesh
        self.positions = positions
        self.normals = normals
        _, self._body = look.add_body(self.scene, mesh, 1.0 / self._extent)
        self._contacts = look.Contacts(self.scene, len(positions), self._force_scale)
        for k, point in enumerate(self._contacts.points):
            self.on(point.on_drag, partial(self._drag_contact, k))

    def _reset(self, _: Any) -> None:
        for control, value in self._first:
            control.value = value
        self._replace_body(self._mesh, self._grasp.positions, self._grasp.normals)

    def _drag_load(self, control: Any, scale: Array, event: Any) -> None:
        """Move the ball at an arrow's head with the mouse, in the plane of the screen."""
        if event.phase == "start":  # the mouse hit the ball beside its centre
            self._offset = scale * np.array(control.value) - np.array(event.start_position)
        control.value = ((np.array(event.end_position) + self._offset) / scale).round(4)

    def _drag_contact(self, k: int, event: Any) -> None:
        """Move contact k to the point of the object under the mouse; beside the object it stays."""
        eye = np.array(event.client.camera.position)
        mouse = np.array(event.end_position)
        hit = cast_ray(self.mesh, self._extent * eye, self._extent * mouse)
        if hit is not None and k < len(self.positions):
            self.positions, self.normals = self.positions.copy(), self.normals.copy()
            self.positions[k], self.normals[k] = hit

    def _add_controls(self, wrench: Array, method: str) -> None:
        gui = self.gui
        friction = float(self._grasp.friction[0])
        with gui.add_folder("Load on the object"):
            self.force = gui.add_vector3("force, N", wrench[:3], step=0.1)
            self.moment = gui.add_vector3("moment, N m", wrench[3:], step=0.01)
        with gui.add_folder("Contacts"):
            self.shape = gui.add_dropdown("object", [*dict.fromkeys((self._name, *SHAPES))])
            self.count = gui.add_slider("number", 3, 8, 1, min(self._grasp.n_contacts, 8))
            ends = min(0.02, friction), max(1.5, friction)
            self.friction = gui.add_slider("friction", *ends, 0.01, friction)
            self.limit = gui.add_slider(
                "max normal force, N", 0.5, NO_LIMIT, 0.5, NO_LIMIT, hint="50: no limit"
            )
        with gui.add_folder("Solver"):
            self.method = gui.add_dropdown("method", [*METHODS], initial_value=method)
            self.start = gui.add_dropdown("start", ["internal_force", *STARTS])
            self.weight = gui.add_slider(
                "lambda, log10 N²", -6.0, 1.0, 0.1, -2.0, hint="more: further from slipping"
            )
        self.again = gui.add_button("Start again", color="gray")
        self.on(self.again.on_click, self._reset)
        contacts = (self.shape, self.count, self.friction, self.limit)
        solver = (self.method, self.start, self.weight)
        controls: list[Any] = [self.force, self.moment, *contacts, *solver]
        for control in controls:
            self.on(control.on_update)
        self._first = [(control, control.value) for control in controls]

    def _add_load(self) -> None:
        colors = look.LOAD, look.MOMENT
        self.look_at(np.array([-0.7, -0.6, -0.7]), np.array([0.7, 0.7, 0.7]))
        self._load: Any = self.scene.add_arrows("/load", np.zeros((2, 2, 3)), np.array(colors))
        self._balls = [
            self.scene.add_icosphere(f"/load/{k}", 0.052, color) for k, color in enumerate(colors)
        ]
        controls = (self.force, self.moment)
        for ball, control, scale in zip(self._balls, controls, self._load_scales, strict=True):
            self.on(ball.on_drag, partial(self._drag_load, control, scale))
        self._screw: Any = self.scene.add_arrows("/screw", np.zeros((6, 2, 3)), look.BAD)


def cast_ray(mesh: trimesh.Trimesh, eye: Array, through: Array) -> tuple[Array, Array] | None:
    """Return where the ray `eye` to `through` (3,) enters a convex mesh, and the inward normal."""
    along = through - eye
    normals = mesh.face_normals
    ahead = np.einsum("ij,ij->i", mesh.triangles_center - eye, normals)
    closing = normals @ along
    with np.errstate(divide="ignore", invalid="ignore"):
        passed = ahead / closing
    enters = np.where(closing < -1e-12, passed, -np.inf)
    leaves = np.where(closing > 1e-12, passed, np.inf)
    face = int(np.argmax(enters))
    if not 0.0 <= enters[face] <= leaves.min():
        return None
    return eye + enters[face] * along, -normals[face]


def place_contacts(mesh: trimesh.Trimesh, count: int) -> tuple[Array, Array]:
    """Return contacts (N, 3) [m] and inward normals (N, 3): one at the back, the rest in front."""
    around = 2.0 * np.pi * np.arange(count - 1) / (count - 1) + 0.5 * np.pi
    front = np.column_stack(
        [0.62 * np.cos(around), 0.62 * np.sin(around), np.full(count - 1, 0.785)]
    )
    centre = mesh.bounds.mean(axis=0)
    hits = [
        cast_ray(mesh, centre + 10.0 * mesh.scale * direction, centre)
        for direction in np.vstack([[[0.0, 0.0, -1.0]], front])
    ]
    points, normals = zip(*(hit for hit in hits if hit is not None), strict=True)
    return np.array(points), np.array(normals)


def body_of(grasp: Grasp) -> tuple[str, trimesh.Trimesh]:
    """Return name and mesh of the body under the contacts: a shape if one fits, else their hull."""
    extent = 2.0 * float(np.abs(grasp.positions).max())
    for shape in SHAPES:
        mesh = look.object_mesh(shape, (extent, extent, extent))
        planes = (mesh.triangles_center * mesh.face_normals).sum(axis=1)
        heights = grasp.positions @ mesh.face_normals.T - planes
        outward = mesh.face_normals[heights.argmax(axis=1)]
        on_surface = np.abs(heights.max(axis=1)).max() < 2e-3 * extent
        if on_surface and (outward * grasp.normals).sum(axis=1).max() < -0.995:
            return shape, mesh
    # points beside each contact in its tangent plane, since contacts in one plane have no hull
    away = 0.02 * float(np.ptp(grasp.positions, axis=0).max()) * grasp.frames
    points = [grasp.positions + sign * away[:, :, k] for sign in (-1.0, 1.0) for k in (1, 2)]
    return "hull of the contacts", trimesh.convex.convex_hull(np.vstack(points))
