"""The force loop: contacts -> G -> wrench to balance -> start + flow -> contact forces -> joint torques."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.config import EnvConfig
from grasp_env.force import ForceOptimizer, ForceSolution, OfflineBasis, Repair
from grasp_env.force.initial import InitialForceRule
from grasp_env.force.kernels import cone_slack
from grasp_env.force.start_kernels import best_on_segment, combine, tangent
from grasp_env.grasp import Grasp, null_space_basis, presets, reference_basis
from grasp_env.grasp.kernels import contact_geometry
from grasp_env.sim.scene import ObjectState, Scene

_NO_TANGENTS = np.zeros((0, 3))
"""Tangents by the default rule."""


class ForceLoop:
    """Optimises the contact forces once per agent step and holds the object in between.

    Between two optimisations the optimal force follows the wrench and the contacts by the tangent correction
    (one 6 x 6 system), so that pose feedback acts at the control rate.

    Attributes:
        grasp: the contacts of the last optimisation, with the solver's friction.
        solution: the last optimisation.
        force: (N, 3) the commanded contact forces [N], contact frames.
        wrench: (6,) the wrench that they balance [N, N m], object frame.
        repaired: control steps in which the tangent correction left the solver's cones and was repaired.
    """

    def __init__(self, config: EnvConfig, initial_force: str | InitialForceRule) -> None:
        self.config = config
        self.friction = np.full(4, config.friction * config.friction_margin)
        nominal = presets.paper_cuboid(self.friction)
        self.reference = reference_basis(nominal)
        self.optimizer = ForceOptimizer(
            nominal,
            initial=initial_force,
            method=config.method,
            force_weight=config.force_weight,
            barrier_weight=config.barrier_weight,
            tolerance=config.tolerance,
            max_iterations=config.max_iterations,
        )
        self._nominal = nominal
        self._cone_divisor = nominal.models.cone_divisor.copy()
        self._weights = self.optimizer.objective.weights(4)
        self._repair = Repair(self.optimizer.objective)
        damping = 2.0 * np.sqrt(config.position_gain * config.object_mass)
        inertia = config.object_mass * 0.1**2 / 6.0  # of a 0.1 m cube: only sets the damping
        self._gains = (
            config.position_gain,
            damping,
            config.rotation_gain,
            2.0 * np.sqrt(config.rotation_gain * inertia),
        )
        self._weight = config.object_mass * np.array(config.gravity)
        self.reset()

    def reset(self) -> None:
        """Forgets the episode: the next solve starts as the first ever did."""
        self.optimizer.previous = None
        self.optimizer.move_to(self._nominal)
        self.grasp = self._nominal
        self.solution: ForceSolution | None = None
        self.force = np.zeros((4, 3))
        self.wrench = np.zeros(6)
        self.repaired = 0

    def wrench_to_balance(self, state: ObjectState, external: Wrench) -> Wrench:
        """External wrench + gravity - pose feedback, (6,) [N, N m], object frame."""
        kp, kd, kr, kw = self._gains
        rotation = state.rotation
        feedback = kp * state.position + kd * state.linear_velocity
        turn = kr * rotation_vector(rotation) + kw * state.angular_velocity
        wrench = external.copy()
        wrench[:3] += rotation.T @ (self._weight + feedback)
        wrench[3:] += rotation.T @ turn
        return wrench

    def optimise(self, scene: Scene, external: Wrench, adjustment: Array | None = None) -> ForceSolution:
        """The paper's pipeline on the contacts as they are now.

        Args:
            scene: the simulation.
            external: (6,) external wrench [N, N m], object frame.
            adjustment: (6,) null-space coordinates [N] added to the initial force, then repaired; None: none.

        Raises:
            RankDeficientGraspError, InfeasibleWrenchError, InfeasibleStartError: the contacts cannot balance it.
        """
        self.solution = None  # nothing stale is left when this raises
        contacts = scene.contacts()
        self.grasp = Grasp.from_contacts(contacts.points, contacts.normals, self.friction)
        self.optimizer.move_to(self.grasp)
        self.wrench = self.wrench_to_balance(scene.state(), external)
        start = None
        if adjustment is not None and adjustment.any():
            basis = null_space_basis(self.grasp, self.reference)
            moved = self.optimizer.start(self.wrench) + (basis @ adjustment).reshape(-1, 3)
            start = self._repair(self.grasp, self.wrench, moved)
        self.solution = self.optimizer.solve(self.wrench, initial=start)
        self.force = self.solution.force
        return self.solution

    def torques(self, scene: Scene, external: Wrench) -> Array:
        """Joint torques (12,) [N m] for the next control step: the last optimum, carried along."""
        assert self.solution is not None, "call optimise first"
        contacts = scene.contacts()
        frames, _, cone_matrix = contact_geometry(contacts.points, contacts.normals, self._cone_divisor, _NO_TANGENTS)
        self.wrench = self.wrench_to_balance(scene.state(), external)
        x = self.grasp.to_cone(self.solution.force)
        moved = np.empty_like(x)
        if not tangent(x, cone_matrix, self.wrench, self._weights, moved):
            moved[:] = x
        if not cone_slack(moved) > 0.0:
            moved = self._repaired(moved, cone_matrix)
            self.repaired += 1
        self.force: ContactForces = self.grasp.to_force(moved)
        return scene.grasp_torques(np.einsum("nij,nj->ni", frames, self.force))

    def _repaired(self, moved: Array, cone_matrix: Array) -> Array:
        """Back into the cones: towards the offline basis' combination, which any wrench leaves strictly inside."""
        objective = self.optimizer.objective
        basis = OfflineBasis.of(self.grasp, objective)
        combined, safe, out = np.empty_like(moved), np.empty_like(moved), np.empty_like(moved)
        combine(basis.cone_forces, self.wrench, False, combined)
        balanced = tangent(combined, cone_matrix, self.wrench, self._weights, safe)  # G moved since
        if balanced and cone_slack(safe) > 0.0:
            best_on_segment(safe, moved, self._weights, out)
            return out
        # give up a little balance (the pose feedback takes it back), never the friction cone
        out[:] = moved
        out[0::3] = np.maximum(moved[0::3], 1.05 * np.hypot(moved[1::3], moved[2::3]))
        return out


def rotation_vector(rotation: Array) -> Array:
    """Axis times angle (3,) [rad] of a rotation matrix, world frame; exact below pi.

    Example:
        >>> rotation_vector(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])).round(4)
        array([0.    , 0.    , 1.5708])
    """
    twice_sine = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = 0.5 * float(np.sqrt(twice_sine @ twice_sine))
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1.0)
    angle = float(np.arctan2(sine, cosine))
    return 0.5 * twice_sine * (angle / sine if sine > 1e-9 else 1.0)
