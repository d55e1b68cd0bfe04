"""Page of a simulated hand: the user pulls and changes the object that it holds."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from viser.transforms import SO3

from grasp_env.config import EnvConfig
from grasp_env.control.loop import ForceLoop
from grasp_env.env.stage import Stage
from grasp_env.errors import GraspError
from grasp_env.force.initial import InitialForceRule
from grasp_env.force.options import METHODS
from grasp_env.inputs.arguments import Array
from grasp_env.sim.objects.description import SHAPES_WITHOUT_MESH
from grasp_env.task.motion import resting_target
from training.program.live import look
from training.program.live.answer import STARTS, Answer, Mood
from training.program.live.window import Window

HINT = "**Drag** the object to pull it; elsewhere the mouse turns the view."
STIFFNESS = 400.0
"""Stiffness of the spring between the object and the mouse [N/m]."""
_MAX_LATE = 0.1
"""Longest simulated time per drawing [s]; a slower machine shows slower motion."""
_FORCE = 0.12
"""Drawn length of a newton, in the object's size."""


class SimulatedHand(Window):
    """Simulated hand that holds an object while a spring pulls it. The controls hold all settings.

    Args:
        port: port of the page.
        config: hand (a `HandDescription`), object and method; its task and disturbance are ignored.
        rule: function from a name to a start rule.

    Attributes:
        stage: the simulation.
        loop: its controller.
        time: simulated time [s].
        outcome: state of the grasp.
        grip: (3,) end of the spring at the object, object frame [m].
        mouse: (3,) its other end, world frame [m]; None: nothing pulls.

    Raises:
        GraspError: the hand cannot hold the object.
    """

    period: float | None = 1.0 / 30.0

    def __init__(
        self, port: int, config: EnvConfig, rule: Callable[[str], str | InitialForceRule]
    ) -> None:
        self._config = config.override(task="hold", disturbance="none", randomize=()).resolved()
        self._rule = rule
        self._target = resting_target(1)[0]
        self._trouble = []
        self._settings = config.object.shape, 100, config.solver.method, STARTS[0]
        self.stage, self.loop = self._simulation(*self._settings)
        super().__init__(port, HINT)
        self._add_controls()
        self._pull: Any = self.scene.add_arrows(
            "/pull", np.zeros((1, 2, 3)), look.LOAD, visible=False
        )
        self._add_bodies()

    def draw(self) -> None:
        """Apply the controls, simulate up to the present, and draw."""
        settings = self.shape.value, int(self.motors.value), self.method.value, self.start.value
        if settings != self._settings:
            self._settings = settings
            self._trouble = []
            try:
                simulation = self._simulation(*settings)
                self.stage.scene.close()
                self.stage, self.loop = simulation
                self._add_bodies()
            except GraspError as error:  # the hand cannot hold that object and keeps its own
                self._trouble = [f"{error}"]
        item = self.stage.scene.config.object
        if (self.mass.value, self.friction.value) != (item.mass, item.friction):
            self._change_object(self.mass.value, self.friction.value)
        late = min(time.monotonic() - self._until, _MAX_LATE)
        self.advance(int(late / self.loop.dt))
        self._until = time.monotonic() - late % self.loop.dt
        self._draw_scene()

    def pull(self) -> Array:
        """Return the spring's force (3,) on the object [N], world frame."""
        if self.mouse is None:
            return np.zeros(3)
        snapshot = self.stage.scene.look()
        force = STIFFNESS * (self.mouse - snapshot.position - snapshot.rotation @ self.grip)
        return force * min(1.0, self.max_pull.value / max(float(np.linalg.norm(force)), 1e-12))

    def advance(self, ticks: int) -> None:
        """Simulate a number of control ticks.

        The simulation stops once the object is more than a metre away.
        """
        config = self._config
        loop = self.loop
        scene = self.stage.scene
        ticks_per_step = config.controller.rate // config.agent.rate
        try:
            for _ in range(0 if self._gone else ticks):
                force = scene.look().rotation.T @ self.pull()
                wrench = np.array([*force, *np.cross(self.grip, force)])
                due = round(self.time / loop.dt) % ticks_per_step == 0
                if due:
                    loop.begin_step()
                scene.advance(loop.tick(wrench, scene.gravity, self._target, due), wrench.tolist())
                self.time += loop.dt
                self._open = 0.0 if loop.closure else self._open + loop.dt
            scene.look()
        except GraspError as error:
            self._trouble = [f"The simulation failed and the hand took hold again: {error}"]
            self._take_hold()
        self.outcome = loop.outcome(self._target, self._error, self._measured)
        drift = self.outcome.drift
        tilt = self.outcome.tilt
        limits = config.limits
        self._gone = drift > 1.0
        if self._lost:
            return
        if drift > (limits.max_drift or math.inf) or tilt > (limits.max_tilt or math.inf):
            self._lost = (
                f"It moved {1e3 * drift:.0f} mm and turned {math.degrees(tilt):.0f} degrees."
            )
        elif self._open > limits.max_contact_gap:
            self._lost = "The fingers that still touch it cannot balance the load."

    def status(self) -> tuple[Mood, str, str]:
        """Return mood, status and explanation, as of an `Answer`."""
        if self._lost:
            words = f"{self._lost} Take hold again; then pull less, or raise the friction."
            return "bad", "lost", words
        if not self.loop.closure:
            words = "The fingers that touch cannot balance this load: each keeps within its cone."
            return "warning", "slipping", words
        if self.loop.effort.saturated:
            words = "No force within the joints' torques balances this load."
            return "warning", "motors at their limit", words
        words = "The fingers balance gravity and the pull, every commanded force inside its cone."
        return "good", "held", words

    def _simulation(
        self, shape: str, motors: int, method: str, start: str
    ) -> tuple[Stage, ForceLoop]:
        hand: Any = self._config.hand
        links = tuple(
            replace(link, torque_limit=0.01 * motors * link.torque_limit) for link in hand.links
        )
        config = self._config.override(hand=replace(hand, links=links), shape=shape, method=method)
        loop = ForceLoop(config, "linear_combination" if method == "conic" else self._rule(start))
        return Stage(config, loop, False, False), loop

    def _change_object(self, mass: float, friction: float) -> None:
        """Change the object's mass [kg] and friction, in the simulation and in the controller."""
        self.stage.scene.change_object(mass, friction)
        self.loop.begin(self.stage.scene)
        self.loop.settling = False
        self.loop.rest(np.zeros(6), self.stage.scene.gravity, self._target)
        self._error, self._measured = np.zeros(12), np.zeros((self.loop.count, 3))
        self.advance(0)

    def _take_hold(self, _: Any = None) -> None:
        """Reset: the hand holds the object at rest, with its original mass and friction."""
        item = self.stage.episode.object
        self.stage.set(np.random.default_rng(0))
        self.time = self._open = 0.0
        self._lost = ""
        self._gone = False
        self._until = time.monotonic()
        self.grip = np.zeros(3)
        self.mouse = None
        self.mass.value = item.mass
        self.friction.value = item.friction
        self._change_object(item.mass, item.friction)

    def _drag(self, event: Any) -> None:
        """Grab the object under the mouse, and pull it in the plane of the screen."""
        snapshot = self.stage.scene.look()
        if event.phase == "start":
            self.grip = snapshot.rotation.T @ (
                np.array(event.start_position) / self._zoom - snapshot.position
            )
        self.mouse = None if event.phase == "end" else np.array(event.end_position) / self._zoom

    def _add_controls(self) -> None:
        """Add the controls; `draw` polls them."""
        gui, config = self.gui, self._config
        with gui.add_folder("Pull the object with the mouse"):
            self.max_pull = gui.add_slider("max pull, N", 1.0, 40.0, 0.5, 5.0)
            self.again = gui.add_button("Take hold again")
        with gui.add_folder("Object and hand"):
            self.shape = gui.add_dropdown(
                "shape", [*SHAPES_WITHOUT_MESH], initial_value=config.object.shape
            )
            self.mass = gui.add_slider("mass, kg", 0.02, 1.0, 0.01, config.object.mass)
            self.friction = gui.add_slider("friction", 0.05, 1.2, 0.01, config.object.friction)
            self.motors = gui.add_slider(
                "motors, %", 2, 100, 1, 100, hint="of the torques that the hand's joints have"
            )
        with gui.add_folder("Solver"):
            self.method = gui.add_dropdown("method", [*METHODS], initial_value=config.solver.method)
            self.start = gui.add_dropdown("start", [*STARTS])
        self.on(self.again.on_click, self._take_hold)

    def _add_bodies(self) -> None:
        """Take hold, and replace the drawn hand, object and contacts."""
        self._take_hold()
        snapshot = self.stage.scene.look()
        config = self.stage.scene.config
        zoom = self._zoom = 1.0 / max(config.object.extent)
        mesh = look.object_mesh(config.object.shape, config.object.size)
        self._object, self._body = look.add_body(self.scene, mesh, zoom)
        self.on(self._body.on_drag, self._drag)
        self._contacts = look.Contacts(self.scene, self.loop.count, _FORCE)
        self.scene.remove_by_name("/hand")
        self._links = []
        points = [mesh.vertices]
        poses = [(np.eye(3), np.zeros(3)), *zip(snapshot.frames, snapshot.origins, strict=True)]
        bodies = look.link_meshes((config.hand.palm, *config.hand.links))
        for k, (meshes, (rotation, origin)) in enumerate(zip(bodies, poses, strict=True)):
            self._links.append(self.scene.add_frame(f"/hand/{k}", show_axes=False))
            for i, (mesh, color) in enumerate(meshes):
                options = {"color": color, "opacity": 0.7, "flat_shading": len(mesh.faces) < 50}
                corners = zoom * mesh.vertices
                self.scene.add_mesh_simple(f"/hand/{k}/{i}", corners, mesh.faces, **options)
                points.append(mesh.vertices @ rotation.T + origin)
        self.look_at(zoom * np.vstack(points).min(axis=0), zoom * np.vstack(points).max(axis=0))

    def _draw_scene(self) -> None:
        loop = self.loop
        zoom = self._zoom
        snapshot = self.stage.scene.look()
        pull = self.pull()
        forces = np.where(np.isin(np.arange(loop.count), loop.fingers)[:, None], loop.force, 0.0)
        poses = [
            *zip(snapshot.frames, snapshot.origins, strict=True),
            (snapshot.rotation, snapshot.position),
        ]
        for node, (rotation, origin) in zip([*self._links[1:], self._object], poses, strict=True):
            node.wxyz = SO3.from_matrix(rotation).wxyz
            node.position = zoom * origin
        mood, status, words = self.status()
        self._body.color = look.BAD if mood == "bad" else look.BODY
        frames = snapshot.rotation @ loop.frames
        friction = np.where(forces.any(axis=1), loop.friction, 0.0)
        world_forces = np.einsum("nij,nj->ni", frames, forces)
        self._contacts.draw(zoom * snapshot.touch, frames, world_forces, friction, mood == "bad")
        grip = zoom * (snapshot.position + snapshot.rotation @ self.grip)
        self._pull.visible = bool(pull.any())
        self._pull.points = np.array([[grip, grip + _FORCE * pull]])
        normals = forces[:, 0] - loop.margin.preload
        margins = loop.friction * normals - np.hypot(forces[:, 1], forces[:, 2])
        columns = {
            "commanded, N": forces[:, 0],
            "measured, N": self._measured[:, 0],
            "margin, N": margins,
        }
        facts = {
            "pulled with": f"{np.linalg.norm(pull):.1f} N",
            "least torque margin": f"{loop.effort.margin:.3f} N m",
            "moved, turned": f"{1e3 * self.outcome.drift:.2f} mm, {math.degrees(self.outcome.tilt):.2f}°",
            "iterations of the last tick": f"{loop.effort.iterations}",
            "simulated": f"{self.time:.1f} s",
        }
        names = self.stage.kinematics.hand.finger_names
        self.show(Answer(mood, status, words, None, columns, facts), names, self._trouble)
