"""Where newton starts on soft, elliptic and frictionless contacts and within limits, and what is refused there."""

from __future__ import annotations

import numpy as np
import pytest
from force.general_problems import CUBOID, LOAD, NAMES, PINCH, PROBLEMS, mixed, soft

from grasp_env.errors import GraspError, InfeasibleStartError, InvalidInputError, UnsupportedProblemError
from grasp_env.force import ForceLimits, ForceOptimizer, Status, optimize_force
from grasp_env.grasp import Grasp
from grasp_env.quality import feasibility


@pytest.mark.parametrize("name", NAMES)
def test_any_start_ends_at_the_same_optimum(name: str) -> None:
    grasp, load, limits = PROBLEMS[name]
    optimizer = ForceOptimizer(grasp, method="newton", limits=limits, tolerance=1e-9)
    want = optimizer.solve(load)
    deep = feasibility(grasp, load, limits)
    starts = [want, optimize_force(grasp, 1.05 * load, method="newton", limits=limits), "previous"]
    if not grasp.models.torsional_friction.any():
        starts += [deep.force, deep.force.tolist(), lambda g, w: feasibility(g, w, limits).force, "phase_one"]
    for start in starts:
        found = optimizer.solve(load, initial=start)
        assert found.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=2e-9)
        np.testing.assert_allclose(found.force, want.force, atol=1e-3)


def test_previous_of_a_soft_grasp_costs_fewer_steps() -> None:
    optimizer = ForceOptimizer(soft(), method="newton", initial="previous", limits=ForceLimits(max_normal=6.0))
    first = optimizer.solve(LOAD)
    again = optimizer.solve(LOAD)
    assert again.initial == "previous"
    assert again.iterations == 0
    assert optimizer.solve(1.01 * LOAD).iterations <= first.iterations
    # a jump that the old force does not survive
    assert optimizer.solve(-LOAD).status is Status.OPTIMAL


def test_arrays_as_starts_of_soft_grasps_have_no_torsion() -> None:
    squeeze = np.array([[2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    load = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    grasp = Grasp.from_contacts(
        [[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]], [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], 0.5, contact_model="soft",
        torsional_friction=0.005,
    )  # fmt: skip
    found = optimize_force(grasp, load, method="newton", initial=squeeze)
    assert found.status is Status.OPTIMAL
    assert found.objective == pytest.approx(optimize_force(grasp, load, method="newton").objective, rel=1e-4)


@pytest.mark.parametrize(
    "start",
    [
        np.ones((3, 3)),
        np.full((4, 3), np.nan),
        np.ones((4, 3)),
        -np.ones((4, 3)),
        np.zeros((4, 3)),
        "nonsense",
        3.0,
        lambda grasp, wrench: None,
        lambda grasp, wrench: np.ones((2, 2)),
        optimize_force(CUBOID, LOAD, method="newton"),
        optimize_force(PINCH, np.zeros(6), method="newton"),
    ],
    ids=lambda start: getattr(start, "method", None) or str(start)[:20],
)
def test_impossible_starts_are_explained(start) -> None:
    """On a grasp of five: starts of other numbers of contacts, outside, or unbalanced."""
    with pytest.raises(GraspError) as caught:
        optimize_force(mixed(), LOAD, method="newton", initial=start)
    assert len(str(caught.value)) > 20


def test_starts_that_break_a_limit_are_starts() -> None:
    free = optimize_force(CUBOID, LOAD, method="newton", barrier_weight=1.0)
    tight = ForceLimits(max_normal=0.9 * float(free.force[:, 0].max()))
    want = optimize_force(CUBOID, LOAD, method="newton", limits=tight, tolerance=1e-8)
    for start in (free.force, free):
        found = optimize_force(CUBOID, LOAD, method="newton", limits=tight, tolerance=1e-8, initial=start)
        assert found.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=1e-7)
        assert (found.force[:, 0] < tight.max_normal).all()


@pytest.mark.parametrize("shared", [False, True])
def test_a_given_force_has_to_be_balanced_and_inside(shared: bool) -> None:
    """Also where the general program is what solves: soft contacts, joints that fingers share."""
    limits = ForceLimits(jacobian=np.full((4, 3, 1), 0.01), torque_limit=0.5) if shared else None
    grasp = CUBOID if shared else soft()
    optimizer = ForceOptimizer(grasp, method="newton", limits=limits)
    good = feasibility(CUBOID, LOAD).force
    assert optimizer.solve(LOAD, initial=good).initial in ("given", "phase_one (given was replaced)")
    for bad, why in ((1.1 * good, "misses balance"), (-good, "misses balance|leaves the friction cones")):
        with pytest.raises(InfeasibleStartError, match=why):
            optimizer.solve(LOAD, initial=bad)


def test_weights_of_one_contact() -> None:
    for grasp, limits in ((CUBOID, None), (soft(), None), (CUBOID, ForceLimits(max_normal=9.0))):
        options = {"method": "newton", "limits": limits, "tolerance": 1e-8}
        plain = optimize_force(grasp, LOAD, **options)
        same = optimize_force(grasp, LOAD, force_weight=[1.0] * 4, barrier_weight=[0.01] * 4, **options)
        assert same.objective == pytest.approx(plain.objective, rel=1e-12)
        dear = optimize_force(grasp, LOAD, force_weight=[1.0, 1.0, 30.0, 1.0], **options)
        assert dear.force[2, 0] < plain.force[2, 0]
        wary = optimize_force(grasp, LOAD, barrier_weight=[0.01, 1.0, 0.01, 0.01], **options)
        reach = [s.force[1, 0] * grasp.friction[1] - np.hypot(*s.force[1, 1:]) for s in (plain, wary)]
        assert reach[1] > reach[0]
        with pytest.raises(InvalidInputError):
            optimize_force(grasp, LOAD, force_weight=[1.0] * 3, **options)


# what does not exist


@pytest.mark.parametrize("method", ["reduced_flow", "full_flow"])
@pytest.mark.parametrize("grasp", [PINCH, mixed()], ids=["pinch", "mixed"])
def test_flows_refuse_soft_contacts(method: str, grasp: Grasp) -> None:
    with pytest.raises(UnsupportedProblemError, match="newton"):
        optimize_force(grasp, LOAD, method=method)
