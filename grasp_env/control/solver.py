"""The force optimisation of a control loop on contacts that move: one compiled call where there is one, else a `ForceOptimizer`."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env._check import Array, Wrench
from grasp_env.config import EnvConfig
from grasp_env.errors import InfeasibleStartError
from grasp_env.force import (
    AdaptiveStep,
    ForceOptimizer,
    ForceSolution,
    InitialForceRule,
    Objective,
    OfflineBasis,
    Repair,
)
from grasp_env.force.basis import core_contacts
from grasp_env.force.record import CODE, REFUSED, STALLED, record_size
from grasp_env.grasp.advice import warn_of
from grasp_env.grasp.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis

METHODS = ("reduced_flow", "newton")
STARTS = ("linear_combination", "previous")
"""What `CompiledPipeline` knows; all else is `GeneralPipeline`'s."""


class CompiledPipeline:
    """Optimal forces of hard contacts that move a little from call to call: frames, G, start, solve and certificates in one compiled call.

    The start is the paper's combination of the 12 offline optima of the nominal grasp, taken to the contacts of now by the tangent
    correction; where that leaves the cones, or Phi grows by more than a factor of two, the 12 optima are computed again for the
    contacts of now. A result depends on the nominal grasp and the calls since `reset`, on nothing else. What is refused goes to a
    `ForceOptimizer` on the grasp of now.

    Attributes:
        core: holds the last optimum, from where the control loop carries it on.
        x: (3N,) the last optimum, cone coordinates [N]; nan: none. frames: (N, 3, 3) its contact frames. Overwritten in place.
        reference: (3N, 3N - 6) directions of `adjust`, object frame.
    """

    def __init__(self, grasp: Grasp, options: dict[str, Any]) -> None:
        """Computes the offline basis.

        Args:
            grasp: the nominal grasp, with frames by the default rule.
            options: of a `ForceOptimizer`: weights, tolerance and max_iterations, a method and a start of those above.

        Raises:
            InfeasibleStartError: the nominal grasp has no force closure.
        """
        warn_of(grasp)
        self.grasp, self._initial = grasp, options["initial"]
        self._options = {name: value for name, value in options.items() if name != "initial"}
        self.objective = Objective(options["force_weight"], options["barrier_weight"])
        self.reference = reference_basis(grasp)
        self.core = core.Pipeline.make(
            core_contacts(grasp, self.objective, np.zeros((0, 3))), options["tolerance"], options["max_iterations"],
            OfflineBasis.of(grasp, self.objective).cone_forces, np.ascontiguousarray(grasp.frames), self._initial == "previous",
            np.ascontiguousarray(self.reference),
            AdaptiveStep().parameters() if options["method"] == "reduced_flow" else None,
        )  # fmt: skip
        arrays = self.core.arrays()
        self.x, self.frames = arrays["x"], arrays["frames"]
        self._cone_matrix, self._size = arrays["cone_matrix"], record_size(grasp.n_contacts)

    def reset(self) -> None:
        """Forgets all calls: the next solve gives the bits that the first ever gave."""
        self.core.reset()

    def solve(self, points: Array, normals: Array, wrench: Wrench, adjust: Array | None = None) -> ForceSolution:
        """The optimal force on the contacts of now, in frames by the default rule.

        Args:
            points: (N, 3) contact points [m], object frame. All arrays are C-contiguous float64.
            normals: (N, 3) inward unit normals, object frame.
            wrench: (6,) external wrench on the object [N, N m], object frame.
            adjust: (3N - 6,) coordinates [N] in `null_space_basis(grasp of now, self.reference)` of an internal force added to
                the start, which is then repaired (`Repair`); None: none.

        Raises:
            RankDeficientGraspError, InfeasibleWrenchError, InfeasibleStartError: the contacts cannot balance the wrench.
                Nothing stale is left: `x` is nan then.
        """
        record = np.empty(self._size)
        if self.core.solve(points, normals, wrench, adjust, record) > STALLED:
            return self._general(points, normals, wrench, adjust, record)
        return self._solution(record)

    def _solution(self, record: Array) -> ForceSolution:
        return ForceSolution(record, self._options["method"], self._initial)

    def _general(
        self, points: Array, normals: Array, wrench: Wrench, adjust: Array | None, record: Array
    ) -> ForceSolution:
        """What the core left: first once more with a new basis, then a `ForceOptimizer`."""
        self.core.forget()
        grasp = Grasp.from_contacts(points, normals, self.grasp.models.friction)
        if record[CODE] == REFUSED:
            with suppress(InfeasibleStartError):  # no force closure: the optimizer says so
                basis = OfflineBasis.of(grasp, self.objective).cone_forces
                self.core.set_basis(basis, np.ascontiguousarray(grasp.frames))
                if self.core.solve(points, normals, wrench, adjust, record) <= STALLED:
                    return self._solution(record)
        optimizer, start = ForceOptimizer(grasp, **self._options), None
        if adjust is not None:
            start = _adjusted(optimizer, self.reference, wrench, adjust)
        solution = optimizer.solve(wrench, initial=start)
        self.x[:], self.frames[:], self._cone_matrix[:] = grasp.to_cone(solution.force), grasp.frames, grasp.cone_matrix
        return solution


class GeneralPipeline:
    """What `CompiledPipeline` does, for every method and start rule: slower, with the same attributes."""

    def __init__(self, grasp: Grasp, options: dict[str, Any]) -> None:
        self.grasp = grasp
        self._optimizer = ForceOptimizer(grasp, **options)
        self._starts = options["method"] != "conic"
        self._carrier = CompiledPipeline(grasp, {**options, "method": "newton", "initial": None})
        self.core, self.reference = self._carrier.core, self._carrier.reference

    def reset(self) -> None:
        """Forgets all calls."""
        self._optimizer.forget()
        self._carrier.reset()

    def solve(self, points: Array, normals: Array, wrench: Wrench, adjust: Array | None = None) -> ForceSolution:
        """See `CompiledPipeline.solve`; methods without a start ignore `adjust`."""
        optimizer, start = self._optimizer, None
        grasp = Grasp.unchecked(points, normals, self.grasp.models)
        if adjust is not None and self._starts:
            start = _adjusted(optimizer, self.reference, wrench, adjust)
        solution = optimizer.solve(np.array(wrench), positions=points, normals=normals, initial=start)
        self._carrier.x[:] = _inside(grasp.to_cone(solution.force))
        self._carrier.frames[:] = grasp.frames
        return solution


def make_pipeline(
    grasp: Grasp, config: EnvConfig, initial_force: str | InitialForceRule
) -> CompiledPipeline | GeneralPipeline:
    """The solver of the settings for contacts near those of `grasp`."""
    options: dict[str, Any] = {
        "initial": initial_force,
        "method": config.method,
        "force_weight": config.force_weight,
        "barrier_weight": config.barrier_weight,
        "tolerance": config.tolerance,
        "max_iterations": config.max_iterations if config.iteration_budget is None else config.iteration_budget,
    }
    if isinstance(initial_force, str) and initial_force in STARTS and config.method in METHODS:
        return CompiledPipeline(grasp, options)
    if config.method == "conic":
        options["initial"] = None
    return GeneralPipeline(grasp, options)


def _adjusted(optimizer: ForceOptimizer, reference: Array, wrench: Wrench, adjust: Array) -> Array:
    """(N, 3) the optimizer's start with an internal force added, repaired."""
    grasp = optimizer.grasp
    moved = optimizer.start(wrench) + (null_space_basis(grasp, reference) @ adjust).reshape(-1, 3)
    return Repair(optimizer.objective)(grasp, wrench, moved)


def _inside(x: Array) -> Array:
    """Cone coordinates moved strictly inside the cones: exact optima touch them, and cannot be carried along from there."""
    blocks = x.reshape(-1, 3)
    tangential = np.hypot(blocks[:, 1], blocks[:, 2])
    out = blocks.copy()
    out[:, 0] = np.maximum(blocks[:, 0], 1.001 * tangential + 1e-3)
    return out.reshape(-1)
