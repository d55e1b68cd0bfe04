"""The force loop: contacts and wrench in, joint torques out, at the control rate; optimised once per agent step."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from grasp_env import core
from grasp_env._check import Array, Indices
from grasp_env.config import EnvConfig
from grasp_env.control.sensing import NoiseRows, late_ticks, sensor_settings
from grasp_env.control.solver import ContactSolver, make_solver
from grasp_env.core import Hold
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, RankDeficientGraspError
from grasp_env.force import ForceLimits, ForceSolution, InitialForceRule, Objective, OfflineBasis, optimize_force
from grasp_env.force.initial import rule_name
from grasp_env.grasp.grasp import Grasp
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.objects.description import ObjectDescription
from grasp_env.sim.scene import Scene
from grasp_env.sim.snapshot import Snapshot

LIMITED_ITERATIONS = 200
"""Most steps of Newton within the torque limits in one tick; it takes 5 to 15."""
RELEASE = 2
"""Control ticks without force after which a finger no longer counts as in contact."""
REACH_STIFFNESS, REACH_FORCE, REACH_LIMIT = 60.0, 0.3, 1.0
"""Of a finger that reaches for its place: [N/m], force against the object [N], the most on its way [N]."""
POSTURE_STIFFNESS, POSTURE_LOSS = 0.01, 0.001
"""[N m/rad] and [N m s/rad] by which the joints of a redundant hand return to their rest posture."""
REACH_MASS = 0.03
"""[kg] of the lightest tip for which reaching is critically damped; heavier ones are, too."""
SPRINGY, LOSSY = 0.5, 1.0
"""Most of stiffness * dt^2 / mass and of damping * dt / mass: with what is sampled, a light link swings up from 4 and from 2 on."""
STABLE = 0.3
"""Most bandwidth times delay: critically damped feedback oscillates from 0.65 on."""


@dataclass(frozen=True, eq=False)
class ContactSet:
    """What the fingers of one set need, made for the nominal contacts.

    Attributes:
        fingers: (n,) int64.
        solver: None where these contacts cannot balance every wrench, or by torsion only.
        soft: whether torsion helps: solved by the general program within all limits at every control tick.
        squeeze: (3n,) an internal force with a total normal force of 1 N, contact frames.
    """

    fingers: Indices
    solver: ContactSolver | None
    squeeze: Array
    soft: bool = False


class ForceLoop:
    """Optimises the contact forces once per agent step and holds the object in between.

    Between two optimisations the optimal force follows the wrench and the contacts by the tangent correction
    (one 6 x 6 system), so that pose feedback acts at the control rate. Fingers without contact reach for their places; when
    one slips off or lands the forces are optimised over the contacts that exist.

    Attributes:
        iterations, trials: of all optimisations since `begin_step`.
        solution: the last optimisation; None before the first, after one that failed, and for controllers without any.
        closure: whether the current contacts can balance the wrench.
        seen: what the controller sees of the scene.
        wrench: (6,) that the forces balance [N, N m], object frame.
        torques: (M,) of the joints, commanded [N m].
        force: (N, 3) commanded contact forces [N], contact frames; frames: (N, 3, 3) columns (n, o, t), object frame.
        friction, torsional_friction: that the solver believes in; the latter in metres, above 0 contacts are soft.
    """

    def __init__(self, config: EnvConfig, initial_force: str | InitialForceRule) -> None:
        self.config = config
        self.initial_force = initial_force
        # a user's rule without a start says so; a named one has none where the grasp is being lost
        named = (InfeasibleStartError,) if isinstance(initial_force, str) else ()
        self._lost_closure = (InfeasibleWrenchError, RankDeficientGraspError, *named)
        self.objective = Objective(config.solver.force_weight, config.solver.barrier_weight)
        self.dt = 1.0 / config.controller.rate
        self._noise: NoiseRows | None = None

    def __repr__(self) -> str:
        return f"ForceLoop({self.config.solver.method} from {rule_name(self.initial_force)})"

    def begin(self, scene: Scene) -> None:
        """A new object or a new grasp: everything that depends on it."""
        item, hand = scene.config.object, scene.config.hand
        self.count = hand.finger_count
        self.scene = scene
        believed = (
            hand.tip_friction * (1.0 + self.config.controller.friction_error) * self.config.controller.friction_margin
        )
        self.friction, self.torsional_friction = item.friction * believed, item.torsional_friction * believed
        self._core = core.Controller.make(
            scene.core,
            control_settings(self.config, item, self.friction, scene.kinematics),
            sensor_settings(self.config),
        )
        self.settling = True  # until the hand holds the object
        arrays = self._core.arrays()
        self.wrench, self.force, self.frames, self.torques = (
            arrays[name] for name in ("wrench", "force", "frames", "torques")
        )
        # joints that the tips leave free stay as the grasp was planned: from far away they would be drawn to their limits
        arrays["home"][:] = scene.config.start_angles or hand.home
        arrays["goals"][:] = scene.config.contact_points
        arrays["inwards"][:] = scene.config.contact_normals
        arrays["depths"][:] = self.config.controller.squeeze / self.count / self.config.controller.pd_stiffness
        self._sets: dict[int, ContactSet] = {}
        self._noise = None
        self.reset()

    def reset(self, rng: np.random.Generator | None = None) -> None:
        """Forgets the episode: the next solve starts as the first ever did.

        Args:
            rng: where noise is drawn from (one number, whatever the settings); None: the last one goes on.
        """
        self.scene.look()
        self._core.reset()
        self.seen = Snapshot(**self._core.seen())
        if rng is not None:
            noise = np.random.default_rng(int(rng.integers(2**63)))
            self._noise = None if self._core.exact else NoiseRows(noise, 3 + 3 * self.count)
        self.solution: ForceSolution | None = None
        self.closure, self._general = True, False
        self._adjustment: Array | None = None
        self.begin_step()
        for made in self._sets.values():
            if made.solver is not None:
                made.solver.reset()

    @property
    def settling(self) -> bool:
        """Whether the hand is still taking over the object, which every controller leaves to the optimised one and exact sensors."""
        return self._settling

    @settling.setter
    def settling(self, value: bool) -> None:
        self._settling = self._core.perfect = value

    @property
    def fingers(self) -> Indices:
        """(n,) in contact, as far as the controller knows."""
        return self._set(self._core.mask).fingers

    @property
    def contact_changes(self) -> int:
        """How often the set of fingers in contact changed."""
        return self._core.changes

    @property
    def repaired(self) -> int:
        """Control ticks in which the tangent correction left the solver's cones and was repaired."""
        return self._core.repaired

    def begin_step(self) -> None:
        """An agent's step begins: iterations, trials and `effort` are counted anew."""
        self.iterations = self.trials = self._shared = 0
        self._core.begin_step()

    @property
    def limited(self) -> int:
        """Iterations of Newton within the torque limits since `begin_step`, where the method's force exceeded them."""
        return self._core.effort.limited + self._shared

    @property
    def effort(self) -> core.Effort:
        """What the motors were asked since `begin_step`."""
        return self._core.effort

    @property
    def peak_torque(self) -> float:
        """The largest so far [N m]."""
        return self._core.peak

    def outcome(self, target: Array, error: Array, measured: Array) -> core.Outcome:
        """How the object is held, by the truth; see `core.Controller.outcome`."""
        return self._core.outcome(target, error, measured)

    def tick(
        self,
        external: Array,
        gravity: Array,
        target: Array,
        due: bool,
        adjustment: Array | None = None,
        given: Array | None = None,
    ) -> list[float]:
        """One control tick: observes the scene, optimises where that is due or the contacts have changed, and commands.

        Args:
            external: (6,) external wrench [N, N m], object frame, as a perfect sensor would tell it.
            gravity: (3,) [m/s^2], world frame, as known.
            target: (19,) the wanted motion, see `env.plan.Plan`.
            due: whether the agent's step begins.
            adjustment: of `optimise`.
            given: (N, 3) forces to command instead of optimised ones [N], contact frames.

        Returns:
            Joint torques (M,) [N m].
        """
        core, noise = self._core, self._noise
        self.scene.look()
        core.see(external, gravity, target, None if noise is None else noise())
        if due:
            self._adjustment = adjustment
        if due or core.changed:
            # all controllers start from the same grasp: the optimised one closes the hand
            controller = "optimized" if self._settling else self.config.controller.kind
            if given is None and controller == "optimized":
                self.optimise(self._adjustment)
            else:
                self._hold(controller, given)
        elif self._general:  # what the core does not carry along
            self.optimise()
        torques = core.command()
        if core.unkept:  # a joint that fingers share
            within = self._solve_generally(self._set(core.mask))
            if within is not None:
                self._shared += within.iterations
                torques = core.command()
        return torques

    def _see(self, external: Array, gravity: Array, target: Array) -> None:
        noise = self._noise
        self._core.see(external, gravity, target, None if noise is None else noise())

    def optimise(self, adjustment: Array | None = None) -> ForceSolution | None:
        """The paper's pipeline on the contacts as they are now.

        Args:
            adjustment: (3N - 6,) null-space coordinates [N] added to the initial force, then repaired; None: none.

        Returns:
            None where the contacts cannot balance the wrench: `closure` is then False and the last forces are kept, inside the cones.

        Raises:
            GraspError: a start rule of the user's that does not fit.
        """
        self.solution, self._adjustment = None, adjustment  # nothing stale is left when this raises
        made = self._set(self._core.mask)
        self._general = made.soft
        if made.soft:
            return self._took(self._solve_generally(made), made)
        if made.solver is None:
            return self._took(None, made)
        points, normals = self.seen.points, self.seen.normals
        if len(made.fingers) < self.count:
            points, normals = points[made.fingers], normals[made.fingers]
            if adjustment is not None:
                adjustment = self._projected(adjustment, made)
        try:
            self.solution = made.solver.solve(points, normals, self.wrench, adjustment)
        except self._lost_closure:
            return self._took(None, made)
        self._core.give(Hold.optimised, self._core.mask, None)
        return self._took(self.solution, made)

    def _took(self, solution: ForceSolution | None, made: ContactSet) -> ForceSolution | None:
        """What an optimisation ended with, counted; None: the contacts cannot balance the wrench."""
        self.solution = solution
        if solution is None:
            self._lose(made)
            return None
        self.closure = True
        self.iterations += solution.iterations
        self.trials += solution.trials
        return solution

    def _solve_generally(self, made: ContactSet) -> ForceSolution | None:
        """Gives the forces of Newton within all limits, on soft contacts too and for joints that fingers share; None: there are none."""
        config, fingers = self.config, made.fingers
        soft = {"contact_model": "soft", "torsional_friction": self.torsional_friction} if made.soft else {}
        try:
            grasp = Grasp.from_contacts(self.seen.points[fingers], self.seen.normals[fingers], self.friction, **soft)
            solution = optimize_force(
                grasp, self.wrench, method="newton", limits=self.limits(fingers), elastic=True, tolerance=config.solver.tolerance,
                force_weight=config.solver.force_weight, barrier_weight=config.solver.barrier_weight, max_iterations=config.solver.max_iterations,
            )  # fmt: skip
        except (InfeasibleWrenchError, RankDeficientGraspError, InfeasibleStartError):
            return None
        force, torsion = (np.ascontiguousarray(part, dtype=float) for part in (solution.force, solution.torsion))
        self._core.give(Hold.direct, self._core.mask, force.reshape(-1), torsion)
        return solution

    def limits(self, fingers: Indices) -> ForceLimits:
        """The motors' limits on the forces of some fingers (n,) at the current contacts: what their links' weight leaves."""
        seen, kinematics = self.seen, self.scene.kinematics
        jacobian = np.empty((len(fingers), 6, len(seen.angles)))
        _, y, z = seen.rotation.T
        for row, finger in zip(jacobian, fingers, strict=True):
            link, touch = int(kinematics.tip_links[finger]), seen.touch[finger]
            at, at_y, at_z = (
                seen.rotation.T @ kinematics.link_jacobian(seen.angles, link, point)
                for point in (touch, touch + y, touch + z)
            )
            row[:3] = at
            # omega x y = (-omega_z, 0, omega_x), omega x z = (omega_y, -omega_x, 0)
            row[3:] = (at_y - at)[2], (at_z - at)[0], (at - at_y)[0]
        return ForceLimits(
            jacobian=jacobian[:, :, kinematics.motors], torque_limit=kinematics.torque_limits[kinematics.motors],
            torque_bias=seen.gravity_torques[kinematics.motors],
        )  # fmt: skip

    def rest(self, external: Array, gravity: Array, target: Array) -> None:
        """What the hand does at rest, before the first tick: contacts, frames, measured forces as the commanded ones."""
        self._see(external, gravity, target)
        self._core.rest()
        self._core.rewind()

    def reach(self, gravity: Array, target: Array) -> list[float]:
        """Joint torques (M,) [N m] of the next control tick with which all fingers reach for their places."""
        self.scene.look()
        self._see(np.zeros(6), gravity, target)
        self._set(0)
        self._core.give(Hold.optimised, 0, None)
        return self._core.command()

    def _hold(self, controller: str, given: Array | None) -> None:
        """What a controller that does not optimise has the fingers in contact do."""
        mask = self._core.mask
        made = self._set(mask)
        if given is not None:
            self._core.give(Hold.direct, mask, np.ascontiguousarray(given[made.fingers].reshape(-1)))
        elif controller == "pd":
            self._core.give(Hold.place, mask, None)
        else:
            self._core.give(Hold.squeeze, mask, self.config.controller.squeeze * made.squeeze)

    def _projected(self, adjustment: Array, made: ContactSet) -> Array | None:
        """The adjustment of all fingers in the internal forces of those that are left."""
        everything = self._set((1 << self.count) - 1).solver
        if everything is None or made.solver is None:
            return None
        forces = (everything.reference @ adjustment).reshape(-1, 3)[made.fingers]
        return made.solver.reference.T @ forces.reshape(-1)

    def _lose(self, made: ContactSet) -> None:
        """No force closure: the last forces of the fingers in contact, balanced as far as their cones let them."""
        self.closure = False
        self._core.give(Hold.lost, self._core.mask, self.force[made.fingers].reshape(-1))

    def _set(self, mask: int) -> ContactSet:
        made = self._sets.get(mask)
        if made is None:
            made = self._sets[mask] = self._make_set([finger for finger in range(self.count) if mask >> finger & 1])
            self._core.add_set(mask, None if made.solver is None else made.solver.core)
        return made

    def _make_set(self, fingers: list[int]) -> ContactSet:
        index, scene = np.array(fingers, dtype=np.int64), self.scene.config
        alone = np.tile([1.0 / max(len(fingers), 1), 0.0, 0.0], len(fingers))
        if self.torsional_friction > 0.0 and len(fingers) > 1:
            return ContactSet(index, None, alone, soft=True)
        try:
            if len(fingers) < 3:
                raise RankDeficientGraspError(f"{len(fingers)} contacts")
            points, normals = np.array(scene.contact_points)[index], scene.contact_normals[index]
            nominal = Grasp.from_contacts(points, normals, self.friction)
            rest = nominal.to_force(OfflineBasis.of(nominal, self.objective).cone_forces[12])
        except (RankDeficientGraspError, InfeasibleStartError):
            return ContactSet(index, None, alone)
        solver = make_solver(nominal, self.config, self.initial_force)
        return ContactSet(index, solver, rest.reshape(-1) / float(rest[:, 0].sum()))


def control_settings(
    config: EnvConfig, item: ObjectDescription, friction: float, kinematics: HandKinematics
) -> core.ControlSettings:
    """The controller's belief, the object without its payload, and all gains."""
    tips, joints = kinematics.mobility(kinematics.home)
    dt = 1.0 / config.controller.rate
    made = core.ControlSettings()
    made.body = believed_body(config, item)
    made.friction = friction
    made.reach = [
        stable_spring(
            REACH_STIFFNESS, 2.0 * math.sqrt(REACH_STIFFNESS * max(REACH_MASS, 1.0 / each)), REACH_LIMIT, each, dt
        )
        for each in tips
    ]
    made.spring = core.Spring(config.controller.pd_stiffness, config.controller.pd_damping, np.inf)
    made.reach_depth = REACH_FORCE / REACH_STIFFNESS
    made.posture = [
        stable_spring(
            POSTURE_STIFFNESS, max(POSTURE_LOSS, 2.0 * math.sqrt(POSTURE_STIFFNESS / max(each, 1.0))), np.inf, each, dt
        )
        for each in joints
    ]
    made.set_limited(config.solver.tolerance, LIMITED_ITERATIONS)
    made.most_change = config.controller.force_rate / config.controller.rate
    made.release = RELEASE
    return made


def stable_spring(stiffness: float, damping: float, limit: float, mobility: float, dt: float) -> core.Spring:
    """A spring and damper for what moves by `mobility` [1/kg], [1/(kg m^2)], as soft as sampling every `dt` [s] asks."""
    if not mobility > 0.0:
        return core.Spring(0.0, 0.0, limit)
    return core.Spring(min(stiffness, SPRINGY / (mobility * dt**2)), min(damping, LOSSY / (mobility * dt)), limit)


def believed_body(config: EnvConfig, item: ObjectDescription) -> core.Body:
    """The object and the pose feedback, critically damped and no faster than the delay of the sensors allows."""
    late = late_ticks(config) / config.controller.rate
    most = STABLE / late if late > 0.0 else np.inf
    return critically_damped(
        item, min(config.controller.position_bandwidth, most), min(config.controller.rotation_bandwidth, most)
    )


def critically_damped(item: ObjectDescription, push: float, turn: float) -> core.Body:
    """An object with pose feedback of two bandwidths [rad/s]."""
    made = core.Body()
    made.mass, made.inertia = item.mass, item.inertia_matrix.reshape(-1).tolist()
    made.position_gain, made.position_damping = item.mass * push**2, 2.0 * item.mass * push
    made.rotation_gain, made.rotation_damping = turn**2, 2.0 * turn
    return made
