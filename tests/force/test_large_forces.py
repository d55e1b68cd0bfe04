"""Newton where forces exceed their distance to the cones by up to 1e8, and where contacts hardly span the wrenches."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.problem import closed_grasps
from grasp_env.force import Objective, Status, optimize_force

OBJECTIVE = Objective()


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
@pytest.mark.parametrize("size", [1e2, 1e3, 1e4, 1e5])
def test_every_wrench_of_a_closed_grasp_is_solved(size: float, tolerance: float) -> None:
    """Optimal in less than 60 steps, with certificates that hold when they are computed again; crawling took thousands."""
    for count in (3, 4, 5, 7, 12):
        rng = np.random.default_rng(count)
        for grasp in closed_grasps(rng, count, 4):
            for moment in (0.0, 0.05, 1.0):
                wrench = np.concatenate([rng.standard_normal(3), moment * rng.standard_normal(3)])
                wrench *= size / np.linalg.norm(wrench)
                found = optimize_force(grasp, wrench, method="newton", tolerance=tolerance)
                assert found.status is Status.OPTIMAL
                assert found.iterations < 60
                x = grasp.to_cone(found.force)
                value = OBJECTIVE.value(x)
                # u^2 - s^2 is known to a rounding of u^2: Phi beside it to 1e-12 here
                assert found.objective == pytest.approx(value, rel=1e-11)
                # moments about the origin instead of the contacts' centre: the last digits take multipliers out of the dual cones
                bound = OBJECTIVE.lower_bound((1.0 - 1e-10) * found.multipliers, grasp.cone_matrix, wrench)
                assert value - bound <= 2.0 * tolerance * value + 1e-11 * value
                assert grasp.cone_margin(found.force) > 0.0
                assert grasp.residual(found.force, wrench) <= 1e-13 * np.abs(found.force).max()
