"""The ranges: within them calls answer and balance, beyond them they refuse in words."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from grasp_env.errors import GraspError, InvalidInputError
from grasp_env.force import AdaptiveStep, ForceLimits, Objective, Status, optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.inputs import ranges
from grasp_env.inputs.ranges import Range
from grasp_env.quality import WrenchBall

CUBOID = presets.paper_cuboid()
PAPER = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
RANGED: dict[str, tuple[Range, Callable[[float], Any]]] = {
    "friction": (ranges.FRICTION, CUBOID.with_friction),
    "force_weight": (ranges.FORCE_WEIGHT, lambda x: Objective(force_weight=x)),
    "force_weight of each": (ranges.FORCE_WEIGHT, lambda x: Objective([1.0, x])),
    "barrier_weight": (ranges.BARRIER_WEIGHT, lambda x: Objective(barrier_weight=x)),
    "tolerance": (
        ranges.TOLERANCE,
        lambda x: optimize_force(CUBOID, PAPER, method="newton", tolerance=x),
    ),
    "max_normal": (ranges.NORMAL_FORCE, lambda x: ForceLimits(max_normal=x)),
    "min_normal": (ranges.LEAST_NORMAL_FORCE, lambda x: ForceLimits(min_normal=x)),
    "torque_limit": (
        ranges.TORQUE,
        lambda x: ForceLimits(jacobian=np.ones((4, 3, 2)), torque_limit=x),
    ),
    "torque_bias": (
        ranges.BIAS,
        lambda x: ForceLimits(jacobian=np.ones((4, 3, 1)), torque_limit=1.0, torque_bias=[x]),
    ),
    "first": (ranges.STEP, lambda x: AdaptiveStep(first=x)),
    "shrink": (ranges.SHRINK, lambda x: AdaptiveStep(shrink=x)),
    "force": (ranges.BALL, lambda x: WrenchBall(x, 1.0)),
    "positions": (
        ranges.LENGTH,
        lambda x: Grasp.from_contacts(CUBOID.positions * (x / CUBOID.length), CUBOID.normals, 0.4),
    ),
}


@pytest.mark.parametrize("name", RANGED)
def test_a_range_holds_its_ends_and_is_told_beyond(name):
    within, call = RANGED[name]
    # a length is a root of a sum: its last digit is rounded
    inner = 1e-12 if name == "positions" else 0.0
    low = within.low * (1.0 + inner)
    high = within.high * (1.0 - inner)
    call(low)
    call(high)
    for beyond in (high * 1.1, low / 1.1 if low > 0.0 else low * 1.1 - 0.1):
        with pytest.raises(InvalidInputError) as caught:
            call(beyond)
        # a sign, an end of (0, 1) or infinity has words of its own
        assert (
            str(within) in str(caught.value)
            or "> 0" in str(caught.value)
            or ">= 0" in str(caught.value)
            or "(0, 1)" in str(caught.value)
        )


CORNERS = {
    "newton": {"method": "newton"},
    "conic": {"method": "conic"},
    "max": {"method": "conic", "criterion": "max"},
    "reduced_flow": {"method": "reduced_flow", "max_iterations": 300},
}


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("method", CORNERS)
def test_optimal_is_balanced_everywhere_within_the_ranges(method, limited):
    """At random corners of the ranges no answer is called optimal that misses the wrench, or leaves
    a cone or a limit, by plain numpy."""
    rng = np.random.default_rng([3, *method.encode(), limited])

    def drawn(within: Range) -> float:
        end = rng.random()
        if end < 0.3:
            return within.low if end < 0.15 else within.high
        return float(np.exp(rng.uniform(np.log(within.low), np.log(within.high))))

    optimal = 0
    for _ in range(150):
        size = drawn(Range(1e-7, 1e6)) if rng.random() < 0.3 else 1.0
        gamma = (
            drawn(Range(1e-12, 500.0)) * size
            if rng.random() < 0.4 and method != "reduced_flow"
            else 0.0
        )
        soft = {"contact_model": "soft", "torsional_friction": gamma} if gamma else {}
        far = drawn(Range(1e-3, 4e3)) * size * rng.standard_normal(3) * (rng.random() < 0.3)
        options: dict[str, Any] = dict(CORNERS[method])
        if method not in ("conic", "max"):
            options |= {
                "force_weight": drawn(ranges.FORCE_WEIGHT),
                "barrier_weight": drawn(ranges.BARRIER_WEIGHT),
            }
        if rng.random() < 0.3:
            options["tolerance"] = drawn(Range(1e-16, 1.0))
        load = (
            PAPER
            * [1, 1, 1, size, size, size]
            * drawn(Range(1e-300 if rng.random() < 0.2 else 1e-6, 1e6))
        )
        load[3:] += np.cross(far, load[:3])
        if limited and method != "reduced_flow":
            most = float(
                np.clip(np.abs(load[:3]).max() * 10.0 ** rng.uniform(-1.0, 6.0), 1e-6, 1e12)
            )
            options |= {"limits": ForceLimits(max_normal=most), "elastic": bool(rng.random() < 0.5)}
        try:
            grasp = Grasp.from_contacts(
                CUBOID.positions * size + far, CUBOID.normals, drawn(ranges.FRICTION), **soft
            )
            solution = optimize_force(grasp, load, **options)
        except GraspError:
            continue
        force = solution.force
        torsion = solution.torsion
        largest = float(np.abs(solution.force).max())
        assert not np.isnan(
            [*force.flat, solution.objective, solution.lower_bound, solution.cone_margin]
        ).any()
        outside = np.hypot(*force[:, 1:].T) / grasp.friction - force[:, 0]
        assert (
            max(outside.max(), (np.abs(torsion) - gamma * force[:, 0]).max() / (gamma or 1.0))
            <= 1e-12 * largest + 1e-300
        )
        if solution.status not in (Status.OPTIMAL, Status.LIMITS_EXCEEDED):
            continue
        optimal += 1
        missed = grasp.residual(force, load, torsion)
        asked = np.abs(grasp.unit_frame @ load).max()
        # the rounding of a squeeze, of moments about a far origin, of large torsions is a part of
        # the balance
        digits = 1e-14 * (1.0 + np.linalg.norm(grasp.centre) / grasp.length + gamma / grasp.length)
        lost = 1e-15 * np.abs(load[3:]).max() / grasp.length
        assert missed <= 1e-8 * asked + digits * largest + lost
        if solution.status is Status.OPTIMAL:
            assert (
                force[:, 0].max() <= options["limits"].max_normal * (1.0 + 1e-9)
                if "limits" in options
                else True
            )
            tolerance = options.get("tolerance", 1e-6 if options["method"] == "conic" else 1e-4)
            assert solution.optimality_gap <= max(tolerance, 1e-15) or asked < 1e-280
    assert optimal > 60
