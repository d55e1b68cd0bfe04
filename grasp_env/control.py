"""The force loop: contacts and wrench in, joint torques out, at the control rate; optimised once per agent step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env import control_kernels as at
from grasp_env._check import Array, Indices
from grasp_env.config import EnvConfig
from grasp_env.control_kernels import DIRECT, LOST, OPTIMISED, REACH, SQUEEZE
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, RankDeficientGraspError
from grasp_env.estimation import ESTIMATOR_STATE, estimate_wrench, keep_factor
from grasp_env.follow import follow
from grasp_env.force import ForceSolution, InitialForceRule, Objective, OfflineBasis
from grasp_env.force.pipeline import ForcePipeline
from grasp_env.grasp.contact import contact_frames
from grasp_env.grasp.grasp import Grasp
from grasp_env.sim.objects import ObjectDescription
from grasp_env.sim.scene import Scene
from grasp_env.sim.snapshot import Snapshot
from grasp_env.solver import GeneralPipeline, make_pipeline

RELEASE = 2
"""Control ticks without force after which a finger no longer counts as in contact."""
REACH_STIFFNESS, REACH_FORCE, REACH_LIMIT = 60.0, 0.3, 1.0
"""Of a finger that reaches for its place: [N/m], force against the object [N], the most on its way [N]."""
POSTURE_STIFFNESS, POSTURE_LOSS = 0.01, 0.001
"""[N m/rad] and [N m s/rad] by which the joints of a redundant hand return to their rest posture."""
STABLE = 0.3
"""Most bandwidth times delay: critically damped feedback oscillates from 0.65 on."""
TIP_MASS = 0.03
"""[kg] that a reaching fingertip moves, roughly: only sets its damping."""
_NO_BASIS, _NO_FRAMES = np.zeros((0, 0)), np.zeros((0, 3, 3))


@dataclass(frozen=True, eq=False)
class ContactSet:
    """What the fingers of one set need, made for the nominal contacts.

    Attributes:
        fingers: (n,) int64.
        pipeline: None where these contacts cannot balance every wrench.
        squeeze: (3n,) an internal force with a total normal force of 1 N, contact frames.
        divisor, weights, basis, basis_frames: of the compiled tick.
    """

    fingers: Indices
    pipeline: ForcePipeline | GeneralPipeline | None
    squeeze: Array
    divisor: Array
    weights: Array
    basis: Array
    basis_frames: Array


class ForceLoop:
    """Optimises the contact forces once per agent step and holds the object in between.

    Between two optimisations the optimal force follows the wrench and the contacts by the tangent correction
    (one 6 x 6 system), so that pose feedback acts at the control rate. Fingers without contact reach for their places; when
    one slips off or lands the forces are optimised over the contacts that exist.

    Attributes:
        iterations, trials: of all optimisations since the environment set them to 0.
        solution: the last optimisation; None before the first, after one that failed, and for controllers without any.
        closure: whether the contacts of now can balance the wrench.
        wrench: (6,) that the forces balance [N, N m], object frame.
        force: (N, 3) commanded contact forces [N], contact frames; frames: (N, 3, 3) columns (n, o, t), object frame.
        fingers: (n,) in contact, as far as the controller knows.
        friction: that the solver believes in.
        settling: whether the hand is still taking over the object, which every controller leaves to the optimised one.
        contact_changes: how often the set of fingers in contact changed.
    """

    def __init__(self, config: EnvConfig, initial_force: str | InitialForceRule) -> None:
        self.config = config
        self.initial_force = initial_force
        # a user's rule without a start says so; a named one has none where the grasp is being lost
        named = (InfeasibleStartError,) if isinstance(initial_force, str) else ()
        self._lost_closure = (InfeasibleWrenchError, RankDeficientGraspError, *named)
        self.objective = Objective(config.force_weight, config.barrier_weight)
        self.dt = 1.0 / config.control_rate
        self._estimating = config.wrench == "estimated"
        self.settling = False

    def begin(self, scene: Scene) -> None:
        """A new object or a new grasp: everything that depends on it."""
        item, hand = scene.config.object, scene.config.hand
        self.goals, self.inwards = np.array(scene.config.contact_points), scene.config.contact_normals
        self.count, joints = hand.finger_count, hand.joint_count
        self.friction = (
            item.friction * hand.tip_friction * (1.0 + self.config.friction_error) * self.config.friction_margin
        )
        self.belief = believe(self.config, item)
        self._springs = self.belief.copy()
        self._springs[at.REACH_GAIN], self._springs[at.REACH_LIMIT] = self.config.pd_stiffness, np.inf
        self._springs[at.REACH_DAMPING] = self.config.pd_damping
        self._hand = (scene.tree_numbers, scene.tree_indices, np.array(hand.home))
        self._depths = np.full(self.count, self.config.squeeze / self.count / self.config.pd_stiffness)
        self._sets: dict[int, ContactSet] = {}
        self._command = np.zeros(at.command_size(self.count, joints))
        forces = at.COMMAND + joints
        self.wrench = self._command[at.WRENCH : at.WRENCH + 6]
        self._torques = self._command[at.COMMAND : forces]
        self.force = self._command[forces : forces + 3 * self.count].reshape(-1, 3)
        self.frames = self._command[forces + 3 * self.count : forces + 12 * self.count].reshape(-1, 3, 3)
        self._object = (item.mass, np.array(item.inertia_matrix))
        self._estimator, self._estimate = np.zeros(ESTIMATOR_STATE), np.zeros(6)
        self._keep = keep_factor(self.config.estimator_time, self.dt)
        self.reset()

    def reset(self) -> None:
        """Forgets the episode: the next solve starts as the first ever did."""
        self._command[:] = 0.0
        self.solution: ForceSolution | None = None
        self.closure = True
        self.fingers = np.zeros(0, dtype=np.int64)
        self.contact_changes = 0
        self._mask = 0
        self._apart, self._missing = [0] * self.count, False
        self._adjustment: Array | None = None
        self.iterations = self.trials = 0
        self._fresh = True
        self._mode, self._given, self._given_frames = OPTIMISED, np.zeros(0), _NO_FRAMES
        self._estimator[:] = 0.0
        self._changed = False
        for made in self._sets.values():
            if made.pipeline is not None:
                made.pipeline.reset()

    @property
    def repaired(self) -> int:
        """Control ticks in which the tangent correction left the solver's cones and was repaired."""
        return int(self._command[at.REPAIRED])

    @property
    def peak_torque(self) -> float:
        """The largest so far [N m]."""
        return float(self._command[at.PEAK])

    def see(self, buffer: Array, snapshot: Snapshot, external: Array, gravity: Array, target: Array) -> None:
        """What is known at this control tick; call before `optimise` and `command`.

        Args:
            buffer, snapshot: the scene as it is seen.
            external: (6,) external wrench [N, N m], object frame, as it would be measured.
            gravity: (3,) [m/s^2], world frame.
            target: (19,) the wanted motion, see `task.Plan`.
        """
        self._buffer, self._seen = buffer, snapshot
        if self._estimating:
            estimate_wrench(
                self._estimator, snapshot.rotation, snapshot.linear, snapshot.angular, snapshot.points, snapshot.forces,
                *self._object, gravity, self.dt, self._keep, self._estimate,
            )  # fmt: skip
            external = self._estimate
        self._told, self._gravity, self._target = external, gravity, target
        mask = int(snapshot.mask[0])
        if mask != self._mask or self._missing:
            self._count_contacts(mask)

    def optimise(self, adjustment: Array | None = None) -> ForceSolution | None:
        """The paper's pipeline on the contacts as they are now.

        Args:
            adjustment: (3N - 6,) null-space coordinates [N] added to the initial force, then repaired; None: none.

        Returns:
            None where the contacts cannot balance the wrench: `closure` is then False and the last forces are kept, inside the cones.

        Raises:
            GraspError: a start rule of the user's that does not fit.
        """
        self.solution, self._changed, self._adjustment = (
            None,
            False,
            adjustment,
        )  # nothing stale is left when this raises
        made = self._set(self._mask)
        self.fingers = made.fingers
        if made.pipeline is None:
            self._lose()
            return None
        seen = self._seen
        self.balance()
        if len(made.fingers) == self.count:
            points, normals = seen.points, seen.normals
        else:
            points, normals = seen.points[made.fingers], seen.normals[made.fingers]
            if adjustment is not None:
                adjustment = self._projected(adjustment, made)
        try:
            if adjustment is None and isinstance(made.pipeline, ForcePipeline):
                self.solution = made.pipeline.solve_ready(points, normals, self.wrench)
            else:
                self.solution = made.pipeline.solve(points, normals, self.wrench, adjust=adjustment)
        except self._lost_closure:
            self._lose()
            return None
        self.closure = True
        self.iterations += self.solution.iterations
        self.trials += self.solution.trials
        self._mode, self._given, self._given_frames = OPTIMISED, made.pipeline.x, made.pipeline.frames
        return self.solution

    def hold(self) -> None:
        """What the hand does at rest, before the first command: contacts, frames, measured forces."""
        seen = self._seen
        self.fingers = np.flatnonzero(seen.touching)
        self.frames[:] = contact_frames(seen.normals)
        self.force[:] = np.einsum("nji,nj->ni", self.frames, seen.forces)
        self.balance()
        self._estimator[:] = 0.0  # its first tick is yet to come

    def balance(self) -> None:
        """Only the wrench to balance, as `optimise` would take it."""
        at.balance(self._buffer, self._hand[1], self._target, self._told, self._gravity, self.belief, self.wrench)

    def reach(self) -> list[float]:
        """Joint torques (M,) [N m] of the next control tick with which all fingers reach for their places."""
        return self._tick(self._set(0))

    def command(self, given: Array | None = None) -> list[float]:
        """Joint torques (M,) [N m] of the next control tick.

        Args:
            given: (N, 3) forces to command instead of optimised ones [N], contact frames.
        """
        # all controllers start from the same grasp: the optimised one closes the hand
        controller = "optimised" if self.settling else self.config.controller
        if given is not None or controller != "optimised":
            made = self._set(self._mask)
            self.fingers = made.fingers
            if given is not None:
                self._mode, self._given = DIRECT, given[made.fingers].reshape(-1)
            elif controller == "pd":
                self._mode, self._given = REACH, self._depths
            else:
                self._mode, self._given = SQUEEZE, self.config.squeeze * made.squeeze
        elif self._changed:
            self.optimise(self._adjustment)
        return self._tick(self._sets[self._mask])

    def follow(self, scene: Scene, external: Array, target: Array) -> list[float] | None:
        """`see` and `command` as at the last tick, of the scene as it is, in one compiled call.

        Returns:
            Joint torques (M,) [N m]; None where the contacts changed, or the scene diverged: `see` and `command` know what to do.
        """
        if self._missing:
            return None
        joints, pose, velocity, contacts = scene.answers()
        made = self._sets[self._mask]
        followed = follow(
            id(joints), id(pose), id(velocity), id(contacts), target, external, self._mask, *scene.observed, scene.reading,
            scene.finger_of_link, scene.buffer, self._hand[2], self._gravity,
            self._springs if self._mode == REACH else self.belief, self._mode, made.fingers, self._given, self._given_frames,
            made.divisor, made.weights, made.basis, made.basis_frames, self.goals, self.inwards, self._command,
        )  # fmt: skip
        if not followed:
            return None
        scene.seen()
        self._told, self._target = external, target
        return self._torques.tolist()

    def _tick(self, made: ContactSet) -> list[float]:
        command = self._command
        at.tick(
            *self._hand, self._buffer, self._target, self._told, self._gravity,
            self._springs if self._mode == REACH else self.belief, self._mode, made.fingers, self._given, self._given_frames,
            made.divisor, made.weights, made.basis, made.basis_frames, self.goals, self.inwards, self._fresh, command,
        )  # fmt: skip
        self._fresh = self._changed = False
        return self._torques.tolist()

    def _count_contacts(self, mask: int) -> None:
        """Which fingers count as in contact: those that touch, and those that did a moment ago."""
        held = 0
        for finger in range(self.count):
            bit = 1 << finger
            self._apart[finger] = 0 if mask & bit else self._apart[finger] + 1
            if mask & bit or (self._mask & bit and self._apart[finger] <= RELEASE):
                held |= bit
        self._missing = held != mask
        if held != self._mask:
            self.contact_changes += self._mask != 0
            self._mask, self._changed = held, True

    def _projected(self, adjustment: Array, made: ContactSet) -> Array | None:
        """The adjustment of all fingers in the internal forces of those that are left."""
        everything = self._set((1 << self.count) - 1).pipeline
        if everything is None or made.pipeline is None:
            return None
        forces = (everything.reference @ adjustment).reshape(-1, 3)[made.fingers]
        return made.pipeline.reference.T @ forces.reshape(-1)

    def _lose(self) -> None:
        """No force closure: the last forces of the fingers in contact, balanced as far as their cones let them."""
        self.closure = False
        self._mode, self._given = LOST, self.force[self.fingers].reshape(-1)

    def _set(self, mask: int) -> ContactSet:
        made = self._sets.get(mask)
        if made is None:
            made = self._sets[mask] = self._make_set([finger for finger in range(self.count) if mask >> finger & 1])
        return made

    def _make_set(self, fingers: list[int]) -> ContactSet:
        config, index = self.config, np.array(fingers, dtype=np.int64)
        divisor = np.ones((len(fingers), 3))
        divisor[:, 0] = self.friction
        weights = self.objective.weights(len(fingers))
        alone = np.tile([1.0 / max(len(fingers), 1), 0.0, 0.0], len(fingers))
        try:
            if len(fingers) < 3:
                raise RankDeficientGraspError(f"{len(fingers)} contacts")
            nominal = Grasp.from_contacts(self.goals[index], self.inwards[index], self.friction)
            rest = nominal.to_force(OfflineBasis.of(nominal, self.objective).cone_forces[12])
        except (RankDeficientGraspError, InfeasibleStartError):
            return ContactSet(index, None, alone, divisor, weights, _NO_BASIS, _NO_FRAMES)
        pipeline = make_pipeline(nominal, config, self.initial_force)
        held = pipeline.held if isinstance(pipeline, ForcePipeline) else pipeline
        squeeze = rest.reshape(-1) / float(rest[:, 0].sum())
        return ContactSet(index, pipeline, squeeze, divisor, weights, held.basis, held.basis_frames)


def believe(config: EnvConfig, item: ObjectDescription) -> Array:
    """The controller's belief (`control_kernels`): the object without its payload, and all gains."""
    b = np.zeros(at.BELIEF)
    inertia = item.inertia_matrix
    b[at.MASS], b[at.INERTIA : at.INERTIA + 9] = item.mass, inertia.reshape(-1)
    late = np.ceil(config.sensor_delay * config.control_rate - 1e-9) / config.control_rate
    most = STABLE / late if late > 0.0 else np.inf
    push, turn = min(config.position_bandwidth, most), min(config.rotation_bandwidth, most)
    b[at.POSITION_GAIN], b[at.POSITION_DAMPING] = item.mass * push**2, 2.0 * item.mass * push
    b[at.ROTATION_GAIN], b[at.ROTATION_DAMPING] = turn**2, 2.0 * turn  # by the inertia
    b[at.REACH_GAIN], b[at.REACH_LIMIT], b[at.REACH_DEPTH] = REACH_STIFFNESS, REACH_LIMIT, REACH_FORCE / REACH_STIFFNESS
    b[at.REACH_DAMPING] = 2.0 * np.sqrt(b[at.REACH_GAIN] * TIP_MASS)
    b[at.POSTURE_GAIN], b[at.POSTURE_DAMPING] = POSTURE_STIFFNESS, POSTURE_LOSS
    b[at.MOST_CHANGE] = config.force_rate / config.control_rate
    return b
