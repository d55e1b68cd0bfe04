"""The force optimisation of a control loop on contacts that move: one compiled call where there is one, else a `ForceOptimizer`."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.config import EnvConfig
from grasp_env.force import ForceOptimizer, ForceSolution, InitialForceRule, Repair
from grasp_env.force.pipeline import PIPELINE_METHODS, STARTS, ForcePipeline
from grasp_env.grasp.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis


class GeneralPipeline:
    """What `ForcePipeline` does, for every method and start rule: slower, with the same attributes.

    Attributes:
        core: a pipeline of the core that holds the last optimum, from where the control loop carries it on.
        reference: (3N, 3N - 6) directions of `adjust`, object frame.
    """

    def __init__(self, grasp: Grasp, options: dict[str, Any]) -> None:
        self.grasp = grasp
        self._optimizer = ForceOptimizer(grasp, **options)
        self._starts = options["method"] != "conic"
        self.reference = reference_basis(grasp)
        self._repair = Repair(self._optimizer.objective)
        weights = {name: options[name] for name in ("force_weight", "barrier_weight")}
        self._carrier = ForcePipeline(grasp, method="newton", **weights)
        self.core = self._carrier.core

    def reset(self) -> None:
        """Forgets all calls."""
        self._optimizer.previous = None
        self._optimizer.move_to(self.grasp)
        self._carrier.reset()

    def solve(self, points: Array, normals: Array, wrench: Wrench, *, adjust: Array | None = None) -> ForceSolution:
        """See `ForcePipeline.solve`; methods without a start ignore `adjust`."""
        optimizer = self._optimizer
        grasp = Grasp.unchecked(points, normals, self.grasp.models)
        optimizer.move_to(grasp)
        start = None
        if adjust is not None and self._starts:
            basis = null_space_basis(grasp, self.reference)
            moved = optimizer.start(wrench) + (basis @ adjust).reshape(-1, 3)
            start = self._repair(grasp, wrench, moved)
        solution = optimizer.solve(np.array(wrench), initial=start)
        self._carrier.x[:] = _inside(grasp.to_cone(solution.force))
        self._carrier.frames[:] = grasp.frames
        return solution


def make_pipeline(
    grasp: Grasp, config: EnvConfig, initial_force: str | InitialForceRule
) -> ForcePipeline | GeneralPipeline:
    """The solver of the settings for contacts near those of `grasp`."""
    options: dict[str, Any] = {
        "initial": initial_force,
        "method": config.method,
        "force_weight": config.force_weight,
        "barrier_weight": config.barrier_weight,
        "tolerance": config.tolerance,
        "max_iterations": config.max_iterations if config.iteration_budget is None else config.iteration_budget,
    }
    named = isinstance(initial_force, str) and initial_force in STARTS
    if named and config.method in PIPELINE_METHODS:
        return ForcePipeline(grasp, **options)
    if config.method == "conic":
        options["initial"] = None
    return GeneralPipeline(grasp, options)


def _inside(x: Array) -> Array:
    """Cone coordinates moved strictly inside the cones: exact optima touch them, and cannot be carried along from there."""
    blocks = x.reshape(-1, 3)
    tangential = np.hypot(blocks[:, 1], blocks[:, 2])
    out = blocks.copy()
    out[:, 0] = np.maximum(blocks[:, 0], 1.001 * tangential + 1e-3)
    return out.reshape(-1)
