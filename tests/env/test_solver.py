"""The control loop's compiled solves against the general path: `Grasp.from_contacts`, `ForceOptimizer`, `null_space_basis`, `Repair`."""

from __future__ import annotations

import numpy as np
import pytest
from golden.pipeline import pipeline_of
from problems import PAPER_WRENCH, random_grasp

from grasp_env.control.solver import ContactSolver
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, RankDeficientGraspError
from grasp_env.force import ForceOptimizer, Repair, Status
from grasp_env.grasp import Grasp, null_space_basis, presets
from grasp_env.quality import feasibility

NOMINAL = {3: presets.tripod(), 4: presets.paper_cuboid(), 5: presets.five_finger_cuboid()}
SMALL = (1e-3, 0.02)
"""[m], [1] by which contacts and normals move: what rolling and sliding make of them between two steps."""


def contacts(rng: np.random.Generator, count: int, size: tuple[float, float] = SMALL) -> tuple[np.ndarray, np.ndarray]:
    grasp = NOMINAL[count]
    normals = grasp.normals + size[1] * rng.standard_normal((count, 3))
    return (
        grasp.positions + size[0] * rng.standard_normal((count, 3)),
        normals / np.linalg.norm(normals, axis=1)[:, None],
    )


def some_wrench(rng: np.random.Generator) -> np.ndarray:
    return rng.standard_normal(6) * np.array([3.0, 3.0, 3.0, 0.05, 0.05, 0.05])


def grasp_of(count: int, points: np.ndarray, normals: np.ndarray) -> Grasp:
    return Grasp.from_contacts(points, normals, NOMINAL[count].friction)


@pytest.mark.parametrize("initial", ["linear_combination", "previous"])
@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
@pytest.mark.parametrize("count", NOMINAL)
def test_the_optimum_of_the_general_path(count: int, method: str, initial: str) -> None:
    rng = np.random.default_rng(count)
    pipeline = pipeline_of(NOMINAL[count], method=method, initial=initial)
    for _ in range(20):
        points, normals = contacts(rng, count)
        wrench = some_wrench(rng)
        grasp = grasp_of(count, points, normals)
        solution = pipeline.solve(points, normals, wrench)
        known = ForceOptimizer(grasp, method="newton", tolerance=1e-9).solve(wrench)
        assert (solution.status, solution.method, solution.initial) == (Status.OPTIMAL, method, initial)
        assert grasp.residual(solution.force, wrench) < 1e-9
        assert grasp.cone_margin(solution.force) > 0.0
        assert solution.optimality_gap <= 1e-4
        assert solution.lower_bound <= known.objective * (1.0 + 1e-9)
        assert solution.objective <= known.objective * (1.0 + 1.1e-4)
        # Phi is flat at its least: a gap of 1e-4 is a hundredth of the force
        np.testing.assert_allclose(solution.force, known.force, atol=0.05 * np.abs(known.force).max())
        np.testing.assert_allclose(solution.multipliers, known.multipliers, atol=0.05 * np.abs(known.multipliers).max())
        np.testing.assert_array_equal(solution.wrench, wrench)
        assert grasp.residual(solution.initial_force, wrench) < 1e-9
        assert grasp.cone_margin(solution.initial_force) > 0.0
        np.testing.assert_array_equal(pipeline.frames, grasp.frames)
        np.testing.assert_allclose(pipeline.x, grasp.to_cone(solution.force), rtol=1e-14)
        assert solution.cone_margin == pytest.approx(grasp.cone_margin(solution.force), abs=1e-12)
        assert solution.equilibrium_residual < 1e-11
        assert not solution.force.flags.writeable


@pytest.mark.parametrize("count", NOMINAL)
def test_on_the_nominal_contacts_the_steps_of_the_general_path(count: int) -> None:
    grasp = NOMINAL[count]
    solution = pipeline_of(grasp).solve(grasp.positions, grasp.normals, PAPER_WRENCH)
    general = ForceOptimizer(grasp, method="reduced_flow").solve(PAPER_WRENCH)
    assert (solution.iterations, solution.trials) == (general.iterations, general.trials)
    np.testing.assert_allclose(solution.force, general.force, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.initial_force, general.initial_force, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.multipliers, general.multipliers, rtol=0, atol=1e-5)
    assert solution.lower_bound == pytest.approx(general.lower_bound, rel=1e-9)


def run(pipeline: ContactSolver, count: int, seed: int, size: tuple[float, float]) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    forces = []
    for k in range(12):
        points, normals = contacts(rng, count, size)
        adjust = rng.standard_normal(3 * count - 6) if k % 3 == 2 else None
        forces.append(pipeline.solve(points, normals, some_wrench(rng), adjust=adjust)._record.copy())
    return forces


@pytest.mark.parametrize("size", [SMALL, (3e-3, 0.1)], ids=["small", "with new bases"])
@pytest.mark.parametrize("initial", ["linear_combination", "previous"])
def test_results_depend_on_the_calls_since_reset_alone(initial: str, size: tuple[float, float]) -> None:
    pipeline = pipeline_of(NOMINAL[4], initial=initial)
    first = run(pipeline, 4, 0, size)
    run(pipeline, 4, 1, size)
    pipeline.reset()
    again, fresh = run(pipeline, 4, 0, size), run(pipeline_of(NOMINAL[4], initial=initial), 4, 0, size)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, fresh)


def test_far_contacts_get_a_basis_of_their_own() -> None:
    grasp = NOMINAL[4]
    pipeline = pipeline_of(grasp)
    held = pipeline.core.arrays()
    rng, before = np.random.default_rng(0), held["basis"].copy()
    for _ in range(20):
        points, normals = contacts(rng, 4, (5e-3, 0.1))
        pipeline.reset()
        assert pipeline.solve(points, normals, some_wrench(rng)).status is Status.OPTIMAL
        if not (held["basis"] == before).all():
            break
    else:
        pytest.fail("no contacts were far")
    np.testing.assert_array_equal(held["basis_frames"], pipeline.frames)
    for k in range(6):
        unit = np.zeros(6)
        unit[k] = 1.0
        x = held["basis"][k].reshape(-1, 3)
        assert np.abs(held["cone_matrix"] @ x.reshape(-1) + unit).max() < 1e-9
        assert (x[:, 0] > np.hypot(x[:, 1], x[:, 2])).all()
    pipeline.reset()
    np.testing.assert_array_equal(held["basis"], before)


@pytest.mark.parametrize("initial", ["linear_combination", "previous"])
@pytest.mark.parametrize("count", NOMINAL)
def test_an_adjustment_is_the_formula_of_the_general_path(count: int, initial: str) -> None:
    rng = np.random.default_rng(count)
    pipeline = pipeline_of(NOMINAL[count], method="newton", initial=initial)
    for _ in range(10):
        points, normals = contacts(rng, count)
        wrench = some_wrench(rng)
        grasp = grasp_of(count, points, normals)
        adjust = rng.standard_normal(grasp.null_dimension)
        pipeline.reset()
        start = pipeline.solve(points, normals, wrench).initial_force
        pipeline.reset()
        solution = pipeline.solve(points, normals, wrench, adjust=adjust)
        moved = start + (null_space_basis(grasp, pipeline.reference) @ adjust).reshape(-1, 3)
        on_segment = moved if grasp.cone_margin(moved) > 0.0 else start
        got = solution.initial_force
        objective = pipeline.objective
        # on the segment from the start to the moved force, and no worse than either
        line = (moved - start).reshape(-1)
        along = float((got - start).reshape(-1) @ line / (line @ line))
        np.testing.assert_allclose(got, start + along * (moved - start), atol=1e-9)
        assert -1e-9 <= along <= 1.0 + 1e-9
        assert objective.value(grasp.to_cone(got)) <= objective.value(grasp.to_cone(on_segment)) * (1.0 + 1e-12)


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7, 8, 9])
def test_an_adjustment_is_along_the_basis_of_any_number_of_contacts(count: int) -> None:
    """Every single coordinate, on contacts up to 6 degrees and 2 mm away."""
    rng = np.random.default_rng(count)
    while True:
        nominal = random_grasp(rng, count)
        if feasibility(nominal, np.zeros(6)).margin > 0.02:
            break
    pipeline, turned = pipeline_of(nominal, method="newton"), 0.1 * rng.standard_normal((count, 3))
    points = nominal.positions + 2e-3 * rng.standard_normal((count, 3))
    normals = (nominal.normals + turned) / np.linalg.norm(nominal.normals + turned, axis=1)[:, None]
    now = Grasp.from_contacts(points, normals, nominal.friction)
    wrench, basis = 0.1 * some_wrench(rng), null_space_basis(now, pipeline.reference)
    start = pipeline.solve(points, normals, wrench).initial_force
    for k, coordinate in enumerate(np.eye(now.null_dimension)):
        best = start
        for sign in (-0.1, 0.1):  # one of them makes Phi fall
            pipeline.reset()
            pipeline.solve(points, normals, wrench)  # with the basis of its own, where it asks for one
            made = pipeline.solve(points, normals, wrench, adjust=sign * coordinate).initial_force
            best = made if np.abs(made - start).max() > np.abs(best - start).max() else best
        moved = (best - start).reshape(-1)
        along = float(basis[:, k] @ moved)
        assert abs(along) > 1e-4
        np.testing.assert_allclose(moved, along * basis[:, k], rtol=0, atol=1e-10)


def test_an_adjustment_on_the_nominal_contacts_to_the_last_digits() -> None:
    grasp = NOMINAL[4]
    pipeline, optimizer = pipeline_of(grasp), ForceOptimizer(grasp, method="reduced_flow")
    rng = np.random.default_rng(0)
    for scale in (0.01, 0.1, 1.0, 10.0):
        adjust = scale * rng.standard_normal(6)
        moved = optimizer.start(PAPER_WRENCH) + (null_space_basis(grasp, pipeline.reference) @ adjust).reshape(-1, 3)
        general = optimizer.solve(PAPER_WRENCH, initial=Repair()(grasp, PAPER_WRENCH, moved))
        solution = pipeline.solve(grasp.positions, grasp.normals, PAPER_WRENCH, adjust=adjust)
        np.testing.assert_allclose(solution.initial_force, general.initial_force, rtol=0, atol=1e-9)
        assert solution.iterations == general.iterations
        np.testing.assert_allclose(solution.force, general.force, rtol=0, atol=1e-7)


def test_errors_of_the_general_path() -> None:
    grasp = NOMINAL[4]
    pipeline = pipeline_of(grasp)
    line = np.outer(np.arange(4.0), [0.01, 0.0, 0.0])
    with pytest.raises(RankDeficientGraspError, match=r"rank\(G\) = [0-5] < 6 with 4 contacts"):
        pipeline.solve(line, grasp.normals, PAPER_WRENCH)
    same_side = np.tile([0.0, 0.0, 1.0], (4, 1))
    with pytest.raises(InfeasibleWrenchError) as caught:
        pipeline.solve(grasp.positions, same_side, PAPER_WRENCH)
    with pytest.raises(InfeasibleWrenchError) as expected:
        ForceOptimizer(grasp_of(4, grasp.positions, same_side)).solve(PAPER_WRENCH)
    assert str(caught.value) == str(expected.value)
    np.testing.assert_array_equal(caught.value.solution.certificate, expected.value.solution.certificate)
    assert np.isnan(pipeline.x).all()
    with pytest.raises(InfeasibleStartError):
        pipeline_of(grasp_of(4, grasp.positions, same_side))


def test_status_of_a_flow_cut_short() -> None:
    grasp = NOMINAL[4]
    pipeline = pipeline_of(grasp, max_iterations=3)
    solution = pipeline.solve(grasp.positions, grasp.normals, PAPER_WRENCH)
    general = ForceOptimizer(grasp, method="reduced_flow", max_iterations=3).solve(PAPER_WRENCH)
    assert (solution.status, solution.iterations) == (Status.ITERATION_LIMIT, 3)
    np.testing.assert_allclose(solution.force, general.force, rtol=1e-9)  # the same steps, another rounding
    np.testing.assert_allclose(pipeline.x, grasp.to_cone(solution.force), rtol=1e-12)
