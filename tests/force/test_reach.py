"""Contacts that cannot balance wrenches of every direction: two hard ones, contacts on a line, one,
frictionless ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from force.clarabel_reference import Reference

from grasp_env.errors import InfeasibleWrenchError, RankDeficientGraspError
from grasp_env.force import ForceLimits, ForceOptimizer, Status, optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility, force_closure, quality

KINDS = ("one", "two", "line", "frictionless", "soft")
OUT = {"one": 3, "two": 1, "line": 1, "frictionless": 1, "soft": 1}
"""Dimension of the wrenches out of reach; at least that."""


def random_contacts(rng: np.random.Generator, kind: str) -> Grasp:
    """Contacts of 1 to 100 mm somewhere, with a rank below 6."""
    count = {
        "one": 1,
        "two": 2,
        "line": int(rng.integers(3, 6)),
        "frictionless": int(rng.integers(3, 6)),
        "soft": 2,
    }[kind]
    size = 10.0 ** rng.uniform(-3, -1)
    middle = rng.standard_normal(3) * 0.2
    line = rng.standard_normal(3)
    line /= np.linalg.norm(line)
    along = rng.uniform(-1.0, 1.0, count) if count > 2 else np.array([-1.0, 1.0])[:count]
    positions = middle + size * along[:, None] * line
    towards = np.sign(-along)[:, None] * line
    if kind == "frictionless":
        positions = middle + size * rng.standard_normal((count, 3))
        towards = rng.standard_normal((count, 3))
        towards[:, 2] = 0.0  # no force along z
    if kind == "soft":  # both press across the line: no torsion about it
        across = np.cross(line, rng.standard_normal(3))
        towards = np.array([across, -across]) / np.linalg.norm(across)
    else:
        towards = towards + 0.2 * rng.standard_normal((count, 3)) * (kind != "frictionless")
    normals = towards / np.linalg.norm(towards, axis=1)[:, None]
    options: dict[str, Any] = {"contact_model": "frictionless"} if kind == "frictionless" else {}
    if kind == "soft":
        options = {"contact_model": "soft", "torsional_friction": 0.1 * size}
    return Grasp.from_contacts(positions, normals, rng.uniform(0.2, 1.0, count), **options)


def wrench_within(rng: np.random.Generator, grasp: Grasp) -> np.ndarray:
    """A wrench that a force strictly inside the cones balances."""
    normal = rng.uniform(0.5, 5.0, grasp.n_contacts)
    angle = rng.uniform(0.0, 2.0 * np.pi, grasp.n_contacts)
    reach = rng.uniform(0.0, 0.8, grasp.n_contacts)
    side = reach * normal * grasp.friction
    torsion = rng.uniform(-0.8, 0.8, grasp.n_contacts) * normal * grasp.models.torsional_friction
    return -grasp.wrench(
        np.column_stack([normal, side * np.cos(angle), side * np.sin(angle)]), torsion
    )


def transmitted(grasp: Grasp) -> np.ndarray:
    """G of the forces and torsions that the contacts transmit, (6, 4N)."""
    return np.concatenate(
        [grasp.matrix * grasp.models.transmitted.reshape(-1), grasp.torsion_matrix], axis=1
    )


def assert_proof(grasp: Grasp, twist: np.ndarray) -> None:
    """No force does any work along the twist."""
    sent = transmitted(grasp)
    assert np.abs(twist @ sent).max() <= 1e-12 * (np.abs(twist) @ np.abs(sent)).max()


def out_of_reach(grasp: Grasp) -> np.ndarray:
    """Wrenches (K, 6) of size one that no forces make, orthogonal to the others in the unit frame."""
    axes, sizes, _ = np.linalg.svd(grasp.unit_frame @ transmitted(grasp))
    lost = axes[:, np.sum(sizes > 1e-9 * sizes[0]) :]
    return np.linalg.solve(grasp.unit_frame, lost).T


def test_one_contact_has_one_force():
    rng = np.random.default_rng(0)
    for _ in range(12):
        grasp = random_contacts(rng, "one")
        wrench = wrench_within(rng, grasp)
        for method in ("newton", "conic"):
            found = optimize_force(grasp, wrench, method=method)
            assert found.status is Status.OPTIMAL
            np.testing.assert_allclose(found.object_force[0], -wrench[:3], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_wrenches_within_reach_have_the_optimum_of_another_solver(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(12):
        grasp = random_contacts(rng, kind)
        assert grasp.rank <= 6 - OUT[kind]
        wrench = wrench_within(rng, grasp)
        judge = Reference(grasp)
        for options in (
            {"method": "newton"},
            {"method": "conic"},
            {"method": "conic", "criterion": "max"},
        ):
            found = optimize_force(grasp, wrench, **options)
            assert found.status is Status.OPTIMAL
            assert (
                judge.residual(found.force, found.torsion, wrench)
                < 1e-9 * np.abs(judge.load(wrench)).max() + 1e-12
            )
            assert judge.violation(found.force, found.torsion) < 1e-12
            if found.method == "newton":
                best, _ = judge.least_phi(wrench)
                assert found.objective == pytest.approx(
                    judge.phi(found.force, found.torsion), rel=1e-9
                )
            else:
                best = judge.solve(wrench, options.get("criterion", "sum")).objective
            assert found.objective == pytest.approx(
                best, rel=2e-4 if found.method == "newton" else 2e-6
            )
            assert found.lower_bound <= best * (1.0 + 1e-6)
        assert feasibility(grasp, wrench).feasible


@pytest.mark.parametrize("kind", KINDS)
def test_wrenches_out_of_reach_have_a_proof(kind):
    """The twist moves no contact; without that part the wrench is balanced."""
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(12):
        grasp = random_contacts(rng, kind)
        lost = out_of_reach(grasp)
        assert len(lost) == 6 - grasp.rank >= OUT[kind]
        within = wrench_within(rng, grasp)
        wrench = (
            within
            + 1e-3
            * np.linalg.norm(grasp.unit_frame @ within)
            * rng.standard_normal(len(lost))
            @ lost
        )
        for method in ("newton", "conic"):
            with pytest.raises(
                InfeasibleWrenchError, match=f"out of reach: rank.G. = {grasp.rank} < 6"
            ) as caught:
                optimize_force(grasp, wrench, method=method)
            assert_proof(grasp, caught.value.solution.certificate)
            assert caught.value.solution.certificate @ wrench > 0.0
        assert not feasibility(grasp, wrench).feasible
        np.testing.assert_allclose(
            grasp.within_reach(wrench), within, atol=1e-12 * np.abs(within).max()
        )
        np.testing.assert_array_equal(
            grasp.within_reach(grasp.within_reach(wrench)).round(12), within.round(12)
        )
        assert optimize_force(grasp, grasp.within_reach(wrench)).status is Status.OPTIMAL


def test_limits_batches_and_masks_take_such_contacts():
    rng = np.random.default_rng(0)
    pinch = Grasp.from_contacts([[0, 0.03, 0], [0, -0.03, 0]], [[0, -1, 0], [0, 1, 0]], 0.8)
    loads = np.array([wrench_within(rng, pinch) for _ in range(20)])
    whole = presets.paper_cuboid()
    there = {"positions": np.vstack([pinch.positions, np.full((2, 3), np.nan)])}
    there["normals"] = np.vstack([pinch.normals, np.full((2, 3), np.nan)])
    for method in ("newton", "conic"):
        alone = [optimize_force(pinch, load, method=method) for load in loads]
        for batch in (
            optimize_forces(pinch, loads, method=method),
            optimize_forces([pinch] * 20, loads, method=method),
        ):
            assert batch.codes.tolist() == [0] * 20
            np.testing.assert_array_equal(batch.force, [each.force for each in alone])
        masked = ForceOptimizer(whole, method=method)
        for load, each in zip(loads, alone, strict=True):
            found = masked.solve(
                load, **there, friction=[0.8, 0.8, np.nan, np.nan], contacts=[1, 1, 0, 0]
            )
            assert found.status is Status.OPTIMAL
            np.testing.assert_allclose(
                found.object_force[:2], each.object_force, atol=1e-3 * np.abs(each.force).max()
            )
            assert not found.force[2:].any()
        most = (
            0.9 * alone[0].force[:, 0].max()
            if method == "conic"
            else 1.2 * alone[0].force[:, 0].max()
        )
        limits = ForceLimits(max_normal=most)
        judge = Reference(pinch, ForceLimits(max_normal=most))
        if method == "newton":
            found = optimize_force(pinch, loads[0], method=method, limits=limits)
            assert judge.violation(found.force, found.torsion) < 1e-12
        else:  # the least largest force is above the limit
            with pytest.raises(InfeasibleWrenchError) as caught:
                optimize_force(pinch, loads[0], method=method, limits=limits)
            proof = caught.value.solution
            assert judge.proof(proof.certificate, loads[0], proof.limit_multipliers) > -1e-12


def test_previous_solutions_and_given_forces_start_there_too():
    pinch = Grasp.from_contacts([[0, 0.03, 0], [0, -0.03, 0]], [[0, -1, 0], [0, 1, 0]], 0.8)
    optimizer = ForceOptimizer(pinch, initial="previous")
    load = np.array([0.3, 2.0, -1.0, 0.001, 0.0, 0.002])
    first = optimizer.solve(load)
    again = optimizer.solve(1.01 * load)
    assert again.initial == "previous"
    assert again.objective == pytest.approx(optimize_force(pinch, 1.01 * load).objective, rel=1e-4)
    assert optimize_force(pinch, load, initial=first.force).status is Status.OPTIMAL
    with pytest.raises(InfeasibleWrenchError, match="out of reach"):
        optimizer.solve(load + 0.01 * np.eye(6)[4])
    assert optimizer.solve(load).status is Status.OPTIMAL


def test_they_have_no_closure_and_what_needs_it_says_so():
    for kind in KINDS:
        grasp = random_contacts(np.random.default_rng(3), kind)
        closed = force_closure(grasp)
        assert not closed
        assert closed.twist is not None
        assert closed.error < 1e-12
        assert_proof(grasp, closed.twist)
        with pytest.raises(RankDeficientGraspError, match="< 6"):
            grasp.pseudoinverse  # noqa: B018
    pinch = random_contacts(np.random.default_rng(3), "two")
    found = quality(pinch)
    assert (found.closure_margin, found.epsilon_sum.lower, found.epsilon_max.upper) == (
        0.0,
        0.0,
        0.0,
    )
    assert found.isotropy < 1e-12
    for method in ("reduced_flow", "full_flow"):
        with pytest.raises(
            RankDeficientGraspError,
            match="'newton' and 'conic' solve the wrenches that are within reach",
        ):
            optimize_force(pinch, np.zeros(6), method=method)
    with pytest.raises(RankDeficientGraspError, match="0 contacts"):
        ForceOptimizer(presets.tripod()).solve(np.zeros(6), contacts=[False] * 3)
