"""The force optimisation of a control loop on contacts that move."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env._check import Array, Wrench, is_a
from grasp_env.config import EnvConfig
from grasp_env.errors import InfeasibleStartError
from grasp_env.force import (
    RULES,
    ForceOptimizer,
    ForceSolution,
    InitialForceRule,
    Objective,
    OfflineBasis,
    Repair,
    initial_rule,
)
from grasp_env.force.basis import core_contacts
from grasp_env.force.record import REFUSED, STALLED, record_size, whole
from grasp_env.grasp.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis

METHODS = ("reduced_flow", "newton")
STARTS = ("linear_combination", "previous")
"""Methods and starts of the core's `Pipeline`; `ForceOptimizer` solves all others."""


class ContactSolver:
    """Optimal forces of hard contacts that move a little from call to call, held where the control loop carries them on.

    The paper's start, or the previous solution, and a method on Phi are one compiled call. That start is the combination of the 12
    offline optima of the nominal grasp, taken to the current contacts by the tangent correction; where that leaves the cones, or Phi grows
    by more than a factor of two, the 12 optima are computed again for the current contacts. All else, and what that call refuses, is
    `ForceOptimizer.solve` on the current contacts. A result depends on the nominal grasp and the calls since `reset`, on nothing else.

    Attributes:
        core: holds the last optimum, from where the control loop carries it on.
        x: (3N,) the last optimum, cone coordinates [N]; nan: none. frames: (N, 3, 3) its contact frames. Overwritten in place.
        reference: (3N, 3N - 6) directions of `adjust`, object frame.
    """

    def __init__(self, grasp: Grasp, options: dict[str, Any]) -> None:
        """Computes the offline basis.

        Args:
            grasp: the nominal grasp, with frames by the default rule.
            options: of a `ForceOptimizer`.

        Raises:
            InfeasibleStartError: the nominal grasp has no force closure.
        """
        initial = options["initial"]
        self.grasp, self._initial = grasp, initial
        self._compiled = options["method"] in METHODS and is_a(initial, str) and initial in STARTS
        self.objective = Objective(options["force_weight"], options["barrier_weight"])
        if self._compiled:  # what it refuses has neither this start nor a solution before
            options = {**options, "initial": None}
        elif is_a(initial, str) and initial in RULES:  # made for the contacts of the call, not for the nominal ones
            options = {**options, "initial": initial_rule(initial, self.objective)}
        self._optimizer = ForceOptimizer(grasp, **options)
        made = self._optimizer.options
        self.reference = reference_basis(grasp)
        self.core = core.Pipeline.make(
            core_contacts(grasp, self.objective, np.zeros((0, 3))), made.tolerance, made.max_iterations,
            OfflineBasis.of(grasp, self.objective).cone_forces, np.ascontiguousarray(grasp.frames), self._compiled and initial == "previous",
            np.ascontiguousarray(self.reference),
            made.step_rule.parameters() if self._compiled and made.flows else None,
        )  # fmt: skip
        arrays = self.core.arrays()
        self.x, self.frames, self._cone_matrix = arrays["x"], arrays["frames"], arrays["cone_matrix"]

    def reset(self) -> None:
        """Forgets all calls: the next solve gives the bits that the first ever gave."""
        self._optimizer.forget()
        self.core.reset()

    def solve(self, points: Array, normals: Array, wrench: Wrench, adjust: Array | None = None) -> ForceSolution:
        """The optimal force on the current contacts, in frames by the default rule.

        Args:
            points: (N, 3) contact points [m], object frame. All arrays are C-contiguous float64.
            normals: (N, 3) inward unit normals, object frame.
            wrench: (6,) external wrench on the object [N, N m], object frame.
            adjust: (3N - 6,) coordinates [N] in `null_space_basis(current grasp, self.reference)` of an internal force added to
                the start, which is then repaired (`Repair`); None: none. `conic`, which has no start, ignores it.

        Raises:
            RankDeficientGraspError, InfeasibleWrenchError, InfeasibleStartError: the contacts cannot balance the wrench.
                Nothing stale is left: `x` is nan then.
        """
        if self._compiled and (found := self._solve_compiled(points, normals, wrench, adjust)) is not None:
            return found
        self.core.forget()
        optimizer, start = self._optimizer, None
        grasp = Grasp.from_contacts(points, normals, self.grasp.models.friction)
        if adjust is not None and optimizer.method != "conic":
            moved = optimizer.start(wrench, positions=points, normals=normals)
            moved = moved + (null_space_basis(grasp, self.reference) @ adjust).reshape(-1, 3)
            start = Repair(self.objective)(grasp, wrench, moved)
        solution = optimizer.solve(wrench, positions=points, normals=normals, initial=start)
        self.x[:], self.frames[:] = _inside(grasp.to_cone(solution.force)), grasp.frames
        self._cone_matrix[:] = grasp.cone_matrix
        return solution

    def _solve_compiled(
        self, points: Array, normals: Array, wrench: Wrench, adjust: Array | None
    ) -> ForceSolution | None:
        """The core's call, where need be once more with the 12 optima of the current contacts; None: it has no solution."""
        record = np.zeros(record_size(self.grasp.n_contacts))
        code = self.core.solve(points, normals, wrench, adjust, record)
        if code == REFUSED:
            self.core.forget()
            grasp = Grasp.from_contacts(points, normals, self.grasp.models.friction)
            with suppress(InfeasibleStartError):  # no force closure: the optimizer says so
                basis = OfflineBasis.of(grasp, self.objective).cone_forces
                self.core.set_basis(basis, np.ascontiguousarray(grasp.frames))
                code = self.core.solve(points, normals, wrench, adjust, record)
        return (
            None if code > STALLED else ForceSolution(whole(record, self.frames), self._optimizer.method, self._initial)
        )


def make_solver(grasp: Grasp, config: EnvConfig, initial_force: str | InitialForceRule) -> ContactSolver:
    """The solver of the settings for contacts near those of `grasp`."""
    options: dict[str, Any] = {
        "initial": None if config.solver.method == "conic" else initial_force,
        "method": config.solver.method,
        "force_weight": config.solver.force_weight,
        "barrier_weight": config.solver.barrier_weight,
        "tolerance": config.solver.tolerance,
        "max_iterations": config.solver.max_iterations
        if config.solver.iteration_budget is None
        else config.solver.iteration_budget,
    }
    return ContactSolver(grasp, options)


def _inside(x: Array) -> Array:
    """Cone coordinates moved strictly inside the cones: exact optima touch them, and cannot be carried along from there."""
    blocks = x.reshape(-1, 3)
    tangential = np.hypot(blocks[:, 1], blocks[:, 2])
    out = blocks.copy()
    out[:, 0] = np.maximum(blocks[:, 0], 1.001 * tangential + 1e-3)
    return out.reshape(-1)
