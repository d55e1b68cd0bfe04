"""The force loop: contacts and wrench in, joint torques out, at the control rate."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from grasp_env import core
from grasp_env.config import EnvConfig
from grasp_env.control.sensing import NoiseRows, joint_ticks, late_ticks, sensor_settings
from grasp_env.core import Hold
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, RankDeficientGraspError
from grasp_env.force import ForceOptimizer, ForceSolution, Margin
from grasp_env.force.initial import (
    CompiledRule,
    InitialForceRule,
    StartRequest,
    refused_start,
    rule_name,
    rule_start,
)
from grasp_env.force.margin import shifted
from grasp_env.force.objective import Objective
from grasp_env.force.options import FLOWS
from grasp_env.force.record import CODE, REFUSED, RESULTS
from grasp_env.force.rules import RULES, initial_rule
from grasp_env.force.saved import is_saved, saved_rule
from grasp_env.force.solution import GIVEN, STATUSES
from grasp_env.grasp.grasp import Grasp
from grasp_env.grasp.null_space import reference_basis
from grasp_env.inputs.arguments import Array, Indices, warn
from grasp_env.sim.objects.description import ObjectDescription
from grasp_env.sim.scene import Scene
from grasp_env.sim.snapshot import Snapshot

FOLLOW_ITERATIONS = 200
"""Largest number of iterations at a tick between agent steps; Newton takes 1 to 15."""
STALE = 0.02
"""Largest age of measurements beyond their known delay [s]."""
MAX_BANDWIDTH = 0.3
"""Largest bandwidth times delay; critically damped feedback oscillates from 0.65 on."""


class AgentRequest(NamedTuple):
    """Request of an agent for one step. Every member is optional.

    Attributes:
        adjustment: (max(3N - 6, 1),) [N] along internal forces of the planned contacts, added to
            the start, which is then repaired.
        residual: (N, 3) [N], contact frames, added to the optimal forces; the nearest balanced ones
            within the margin are commanded.
        margin: (2,) share of friction and preload [N] of the margin, in place of the settings'.
        forces: (N, 3) forces to command instead of optimised ones [N], contact frames.
    """

    adjustment: Array | None = None
    residual: Array | None = None
    margin: Array | None = None
    forces: Array | None = None


NOTHING = AgentRequest()
"""The request of a step without an agent."""


class ForceLoop:
    """Optimises the contact forces at every agent step and holds the object in between.

    It wires the compiled `HandController` to a simulated hand with its sensors: two compiled calls
    are one control tick, from a reading to joint torques. The environment's docstring describes
    what it does.

    Attributes:
        controller: the controller of the hand.
        hand: the simulated hand beside it: its sensors, and what is true of the hold.
        optimizer: the method, made for the planned contacts of all fingers.
        seen: the scene as the controller measures it.
        wrench: (6,) wrench that the forces balance [N, N m], object frame.
        torques: (M,) commanded joint torques [N m].
        force, frames: (N, 3) commanded contact forces [N] and (N, 3, 3) their frames, as in
            `ForceSolution`.
        margin: the margin of the solver.
        friction: coefficient that forces may use: the assumed one, within the margin.
    """

    def __init__(self, config: EnvConfig, initial_force: str | InitialForceRule) -> None:
        self.config = config
        self._saved = isinstance(initial_force, str) and is_saved(initial_force)
        if isinstance(initial_force, str) and self._saved:
            initial_force = saved_rule(initial_force)
        self.initial_force = initial_force
        # our rules have no start while the grasp is being lost; a user's rule must have one
        self._ours = isinstance(initial_force, str) or self.learned
        unstarted = (InfeasibleStartError,) if self._ours else ()
        self._lost_closure = (InfeasibleWrenchError, RankDeficientGraspError, *unstarted)
        self.dt = 1.0 / config.controller.rate
        self._noise: NoiseRows | None = None

    def __repr__(self) -> str:
        return f"ForceLoop({self.config.solver.method} from {rule_name(self.initial_force)})"

    @property
    def learned(self) -> bool:
        """True if a network finds the start, which depends on where the contacts are."""
        return isinstance(self.initial_force, CompiledRule)

    def begin(self, scene: Scene, held: bool = False) -> None:
        """Prepare everything that depends on the object and the grasp.

        Args:
            scene: The scene.
            held: The hand holds the object: assume the friction of the episode, with its error, and
                for a learned start the contacts as they are. Otherwise those planned and the true
                friction: the hand takes hold of the object without errors.

        Raises:
            GraspError: the planned contacts cannot hold an object.
        """
        item = scene.config.object
        hand = scene.config.hand
        config = self.config
        controller = config.controller
        self.count = hand.finger_count
        self.scene = scene
        assumed = hand.tip_friction * (1.0 + (controller.friction_error if held else 0.0))
        self._friction = item.friction * assumed
        self._torsional_friction = item.torsional_friction * assumed
        self.margin = Margin(controller.friction_margin, controller.preload)
        self.friction = self._friction * self.margin.friction
        points = np.array(scene.config.contact_points)
        normals = scene.config.contact_normals
        grasp = self.grasp(points, normals)
        nominal = grasp
        if held and self.learned:
            now = scene.look()
            nominal = self.grasp(now.points, now.normals)
        self.optimizer = make_optimizer(nominal, self.margin, config, self.initial_force)
        known = getattr(self.initial_force, "n_contacts", self.count)
        if self._saved and known != self.count and not held:
            warn(
                f"the fitted start {config.solver.initial_force} knows {known} contacts, the hand has {self.count}: "
                "the solver uses its own start; fit one with `grasp fit --env`"
            )
        settings = control_settings(config)
        settings.remembers = self.optimizer.remembers
        # soft tips on one line have an internal force more
        directions = reference_basis(grasp)[:, : adjustment_size(self.count)]
        settings.directions = directions.reshape(-1).tolist()
        # free joints stay in the planned posture: a far home would draw them to their limits
        home = scene.config.start_angles or hand.home
        tree = scene.kinematics.tree
        motors = core.Calibration.newton_metres(tree)
        self.controller = core.HandController()
        self.controller.configure(tree, settings, motors, home, self.optimizer.core)
        self.hand = core.SimulatedHand.make(
            scene.core,
            self.controller,
            self.optimizer.core,
            hand.tip_friction / assumed,
            believed_body(config, item),
            sensor_settings(config),
        )
        self._settling = True  # until the hand holds the object
        arrays = self.controller.arrays()
        names = ("wrench", "force", "frames", "torques", "solution")
        self.wrench, self.force, self.frames, self.torques, self._row = (
            arrays[name] for name in names
        )
        self._seen = [arrays[name] for name in ("positions", "normals", "preload")]
        arrays["goals"][:] = points
        arrays["inwards"][:] = normals
        self._noise = None
        self.reset()

    def grasp(self, points: Array, normals: Array) -> Grasp:
        """Return the grasp of points and inward normals (N, 3), with the assumed friction."""
        if not self._torsional_friction > 0.0:
            return Grasp.from_contacts(points, normals, self._friction)
        soft = {"contact_model": "soft", "torsional_friction": self._torsional_friction}
        return Grasp.from_contacts(points, normals, self._friction, **soft)

    def reset(self, rng: np.random.Generator | None = None) -> None:
        """Forget the episode; `rng` draws one seed for the noise (None: keep the current noise)."""
        self.scene.look()
        self.hand.reset()
        self.settling = self._settling
        self.seen = Snapshot(**self.hand.seen())
        if rng is not None:
            noise = np.random.default_rng(int(rng.integers(2**63)))
            self._noise = None if self.hand.exact else NoiseRows(noise, 3 + 3 * self.count)
        self._start: StartRequest | None = None  # of a Python rule
        self.begin_step()

    @property
    def settling(self) -> bool:
        """True until the hand has taken over the object, by optimised forces and exact sensors."""
        return self._settling

    @settling.setter
    def settling(self, value: bool) -> None:
        self._settling = self.hand.perfect = value
        self._hold(Hold.optimized if value else HOLDS[self.config.controller.kind])

    def _hold(self, hold: Hold) -> None:
        self._held = self.controller.hold = hold
        self._needs_rule = hold == Hold.optimized and not self.optimizer.core_finds_start

    @property
    def solution(self) -> ForceSolution | None:
        """The method's last solution, or None."""
        if self.controller.code not in RESULTS:
            return None
        row, names = self._row.copy(), self.optimizer.names
        if self._start is not None:
            self._start.mark(row)
            names = names.of_start(GIVEN, self._start.name)
        return ForceSolution(row, names)

    @property
    def status(self) -> str:
        """Status of the method's last solve, the value of a `Status`; empty without a solution."""
        code = self.controller.code
        return STATUSES[code].value if code in RESULTS else ""

    @property
    def closure(self) -> bool:
        """True if the contacts could balance the wrench at the last tick."""
        return self.controller.closure

    @property
    def fingers(self) -> Indices:
        """Numbers (n,) of the fingers in contact, as the controller measures them."""
        mask = self.controller.mask
        return np.array([k for k in range(self.count) if mask >> k & 1], dtype=np.int64)

    def begin_step(self) -> None:
        """Begin an agent's step."""
        self.hand.begin_step()

    @property
    def effort(self) -> core.Effort:
        """Iterations of the solvers and use of the motors since the agent's step began."""
        return self.controller.effort

    def costs(self) -> tuple[float, float, float]:
        """Return the costs of force, torque and change of force, 0 to 1, of the agent's step."""
        costs = self.hand.costs()
        return costs.force, costs.torque, costs.change

    def outcome(self, target: Array, error: Array, measured: Array) -> core.Outcome:
        """Return the true state of the hold; see `core.SimulatedHand.outcome`."""
        return self.hand.outcome(target, error, measured)

    def step_info(self, outcome: core.Outcome, measured: Array) -> dict[str, Any]:
        """Return the entries of `info` from the core; see `core.SimulatedHand.step_info`."""
        return self.hand.step_info(outcome, measured)

    def tick(
        self,
        external: Array,
        gravity: Array,
        target: Array,
        due: bool,
        asked: AgentRequest = NOTHING,
    ) -> list[float]:
        """Run one control tick and return the joint torques (M,) [N m].

        Args:
            external: (6,) true external wrench [N, N m], object frame.
            gravity: (3,) gravity that the controller assumes [m/s^2], world frame.
            target: (19,) desired motion, see `env.plan.Plan`.
            due: True at the first tick of an agent's step.
            asked: what the agent asks of this step.
        """
        reading = self.scene.new_reading()
        if asked.forces is not None and self._held != Hold.direct:
            self._hold(Hold.direct)
        noise = None if self._noise is None else self._noise()
        by_rule = due and (self._needs_rule or self._moves_margin(asked))
        if due:
            self._start = None
        if by_rule:
            self._row[CODE] = REFUSED  # no stale solution is left if the rule fails
        if not self.hand.see(reading, external, gravity, target, noise):
            assert reading is not None  # earlier readings are finite
            raise self.scene.divergence_error(reading)
        if self._settling:
            self.controller.take_hold()
        if not due:
            return self.controller.act(False)
        return self._from_rule(asked) if by_rule else self._begin(asked, None)

    def _moves_margin(self, asked: AgentRequest) -> bool:
        """Return True if a learned start is asked for another friction than that of its network."""
        if asked.margin is None or not self.learned or self._held != Hold.optimized:
            return False
        return float(asked.margin[0]) != self.margin.friction

    def _begin(self, asked: AgentRequest, start: Array | None) -> list[float]:
        return self.controller.act(
            True, asked.adjustment, start, asked.forces, asked.residual, asked.margin
        )

    def _from_rule(self, asked: AgentRequest) -> list[float]:
        """Run the tick of a method with a Python start rule, on the measured contacts."""
        touching = self.fingers
        try:
            positions, normals, preload = (part[touching] for part in self._seen)
            grasp = Grasp.from_contacts(positions, normals, self._friction)
            share = self.margin.friction if asked.margin is None else float(asked.margin[0])
            margin = Margin(share, preload)
            problem = shifted(margin, grasp, self.wrench)
            start = rule_start(self.optimizer.initial, problem, self.optimizer.objective)
        except self._lost_closure:  # the method reports this from its own start
            self._start = None
            return self._begin(asked, None)
        force = np.zeros((self.count, 3))
        force[touching] = start.force
        self._start = start
        torques = self._begin(asked, force)
        if self.controller.code == REFUSED and not self._ours:
            raise refused_start(problem, start, None)
        return torques

    def rest(self, external: Array, gravity: Array, target: Array) -> None:
        """Set the state of the hand at rest: the measured forces become the commanded ones."""
        noise = None if self._noise is None else self._noise()
        self.hand.rest(external, gravity, target, noise)

    def reach(self, gravity: Array, target: Array) -> list[float]:
        """Return the torques (M,) [N m] of a tick in which all fingers reach for their places."""
        self._hold(Hold.reach)
        return self.tick(np.zeros(6), gravity, target, False)


def adjustment_size(tips: int) -> int:
    """Return the number of internal forces along which an agent adjusts the start."""
    return max(3 * tips - 6, 1)


HOLDS = {"optimized": Hold.optimized, "constant_squeeze": Hold.squeeze, "pd": Hold.place}
"""The behaviour of the fingers in contact under each kind of controller."""


def make_optimizer(
    grasp: Grasp, margin: Margin, config: EnvConfig, initial_force: str | InitialForceRule
) -> ForceOptimizer:
    """Return the configured method for contacts near those of `grasp`.

    On soft contacts, which the flows do not support, Newton replaces them.
    """
    soft = grasp.contacts.soft
    solver = config.solver
    method = solver.method
    initial = initial_force
    if soft and method in FLOWS:
        method = "newton"
    if method == "conic" or (soft and initial != "previous"):
        initial = None
    elif isinstance(initial, str) and initial in RULES and initial != "linear_combination":
        # made for the contacts of each call, not for the planned ones
        initial = initial_rule(initial, Objective(solver.force_weight, solver.barrier_weight))
    return ForceOptimizer(
        grasp,
        method=method,
        initial=initial,
        margin=margin,
        force_weight=solver.force_weight,
        barrier_weight=None if method == "conic" else solver.barrier_weight,
        tolerance=solver.tolerance,
        max_iterations=solver.max_iterations,
    )


def control_settings(config: EnvConfig) -> core.HandControllerSettings:
    """Return the settings of the hand's controller."""
    controller, solver = config.controller, config.solver
    settings = core.HandControllerSettings()
    settings.rate = controller.rate
    settings.joint_delay = joint_ticks(config) / controller.rate
    settings.grip = core.Spring(
        controller.grip_stiffness, controller.grip_damping, controller.grip_force
    )
    settings.place = core.Spring(controller.pd_stiffness, controller.pd_damping, np.inf)
    iterations = min(solver.max_iterations, FOLLOW_ITERATIONS)
    settings.set_follow(solver.tolerance, iterations, solver.method == "conic")
    settings.squeeze = controller.squeeze
    settings.force_rate = controller.force_rate
    settings.torque_rate = controller.torque_rate
    settings.stale = STALE + max(late_ticks(config), joint_ticks(config)) / controller.rate
    return settings


def believed_body(config: EnvConfig, item: ObjectDescription) -> core.Body:
    """Return the object with critically damped pose feedback, no faster than the delay allows."""
    controller = config.controller
    late = late_ticks(config) / controller.rate
    most = MAX_BANDWIDTH / late if late > 0.0 else np.inf
    position = min(controller.position_bandwidth, most)
    return critically_damped(item, position, min(controller.rotation_bandwidth, most))


def critically_damped(item: ObjectDescription, push: float, turn: float) -> core.Body:
    """Return an object with pose feedback of two bandwidths [rad/s]."""
    body = core.Body()
    body.mass, body.inertia = item.mass, item.inertia_matrix.reshape(-1).tolist()
    body.position_gain = item.mass * push**2
    body.position_damping = 2.0 * item.mass * push
    body.rotation_gain = turn**2
    body.rotation_damping = 2.0 * turn
    return body
