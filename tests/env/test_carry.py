"""Between two solves of the control loop: the optimum followed, repaired, clipped, as the control tick does."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from env.test_solver import NOMINAL, contacts, grasp_of, some_wrench
from golden.pipeline import pipeline_of
from oracles.carry import CARRIED, CLIPPED, REPAIRED, carry, turn
from oracles.newton import combine, tangent_correction
from oracles.phi import phi
from problems import PAPER_WRENCH

from grasp_env.force import ForceOptimizer, Objective, Status
from grasp_env.grasp import Grasp

WEIGHTS = {count: Objective().weights(count) for count in NOMINAL}


@pytest.mark.parametrize("count", NOMINAL)
def test_carry_follows_the_optimum(count: int) -> None:
    rng = np.random.default_rng(count)
    pipeline = pipeline_of(NOMINAL[count], method="newton", tolerance=1e-8)
    force = np.empty((count, 3))
    for _ in range(20):
        points, normals = contacts(rng, count)
        wrench = some_wrench(rng)
        pipeline.solve(points, normals, wrench)
        held = [array.copy() for array in pipeline.core.arrays().values()]
        points, wrench = points + 1e-5 * rng.standard_normal((count, 3)), wrench + 1e-3 * rng.standard_normal(6)
        assert pipeline.core.carry(points, normals, wrench, force) == CARRIED
        for array, before in zip(pipeline.core.arrays().values(), held, strict=True):
            np.testing.assert_array_equal(array, before)
        grasp = grasp_of(count, points, normals)
        assert grasp.residual(force, wrench) < 1e-9
        # to first order the current optimum
        best = ForceOptimizer(grasp, method="newton", tolerance=1e-10).solve(wrench)
        np.testing.assert_allclose(force, best.force, atol=1e-2)
        # the current tangent correction, exactly: the tangents turn by less than rounding shows
        x = tangent_correction(pipeline.x, grasp.cone_matrix, wrench, WEIGHTS[count])
        np.testing.assert_allclose(grasp.to_cone(force), x, atol=1e-5)


def test_carry_repairs_and_clips() -> None:
    grasp = NOMINAL[4]
    pipeline = pipeline_of(grasp)
    points, normals, force = grasp.positions.copy(), grasp.normals.copy(), np.empty((4, 3))
    pipeline.solve(points, normals, np.zeros(6))
    heavy = 20.0 * PAPER_WRENCH
    assert pipeline.core.carry(points, normals, heavy, force) == REPAIRED
    assert grasp.residual(force, heavy) < 1e-9
    assert grasp.cone_margin(force) > 0.0
    # friction cones that no balanced force of any combination is in: a wrench along which the basis does not reach
    outside = np.tile([1.0, 2.0, 0.0], 4)
    outcome, out, _ = carry(pipeline.x, outside, grasp.cone_matrix, heavy, WEIGHTS[4])
    assert outcome == CLIPPED
    pipeline.core.set_basis(np.zeros((13, 12)), np.ascontiguousarray(grasp.frames))
    assert pipeline.core.carry(points, normals, heavy, force) == CLIPPED
    for clipped in (out, grasp.to_cone(force)):
        u, o, t = clipped.reshape(-1, 3).T
        assert (u >= 1.04 * np.hypot(o, t)).all()
    np.testing.assert_allclose(grasp.to_cone(force), out, rtol=0, atol=1e-9 * np.abs(out).max())


@pytest.mark.parametrize("count", NOMINAL)
def test_carry_step_by_step(count: int) -> None:
    rng = np.random.default_rng(count)
    pipeline = pipeline_of(NOMINAL[count], method="newton")
    held, seen, force = SimpleNamespace(**pipeline.core.arrays()), set(), np.empty((count, 3))
    divisor = pipeline.grasp.models.cone_divisor
    for jump in (1e-3, 0.1, 1.0, 10.0, 100.0) * 4:
        points, normals = contacts(rng, count)
        wrench = some_wrench(rng)
        pipeline.solve(points, normals, wrench)
        points, normals = contacts(rng, count)
        wrench = wrench + jump * some_wrench(rng)
        now = grasp_of(count, points, normals)
        x = turn(held.x, divisor, held.frames, now.frames)
        combined = turn(combine(held.basis, wrench), divisor, held.basis_frames, now.frames)
        outcome, first, last = carry(x, combined, now.cone_matrix, wrench, WEIGHTS[count])
        assert pipeline.core.carry(points, normals, wrench, force) == outcome
        made, way = now.to_cone(force), last - first
        part = float(np.clip((made - first) @ way / max(float(way @ way), 1e-300), 0.0, 1.0))
        # a system of condition up to 1e7, solved in two frames
        np.testing.assert_allclose(made, first + part * way, rtol=0, atol=1e-7 * np.abs(last).max())
        assert phi(made, WEIGHTS[count]) <= phi(first, WEIGHTS[count]) * (1.0 + 1e-6)
        seen.add(outcome)
    assert seen >= {CARRIED, REPAIRED}


@pytest.mark.parametrize("count", NOMINAL)
def test_a_force_that_is_not_held_is_carried_alike(count: int) -> None:
    """`carry_from` of what is held, in place or not, gives the bits of `carry`, and leaves what is held alone."""
    rng = np.random.default_rng(count)
    pipeline = pipeline_of(NOMINAL[count], method="newton")
    for jump in (1e-3, 1.0, 100.0):
        points, normals = contacts(rng, count)
        solution = pipeline.solve(points, normals, some_wrench(rng))
        then, frames = solution.force.copy(), pipeline.frames.copy()
        held, wanted, made = (
            [array.copy() for array in pipeline.core.arrays().values()],
            np.empty((count, 3)),
            np.empty((count, 3)),
        )
        points, normals = contacts(rng, count)
        wrench = jump * some_wrench(rng)
        outcome = pipeline.core.carry(points, normals, wrench, wanted)
        assert pipeline.core.carry_from(points, normals, wrench, then, frames, made) == outcome
        # force times scale, as it was held
        np.testing.assert_allclose(made, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
        pipeline.core.carry_from(points, normals, wrench, then, frames, then)
        np.testing.assert_array_equal(then, made)
        for array, before in zip(pipeline.core.arrays().values(), held, strict=True):
            np.testing.assert_array_equal(array, before)


def test_carry_without_an_optimum_is_the_carried_combination() -> None:
    grasp = NOMINAL[4]
    pipeline, force = pipeline_of(grasp), np.empty((4, 3))
    assert np.isnan(pipeline.x).all()
    assert pipeline.core.carry(grasp.positions.copy(), grasp.normals.copy(), PAPER_WRENCH.copy(), force) == REPAIRED
    np.testing.assert_allclose(force, ForceOptimizer(grasp, method="reduced_flow").start(PAPER_WRENCH), atol=1e-12)


def test_frames_that_switch_axes_carry_the_force_along() -> None:
    # a normal close to where the default tangents jump from e_x to e_y
    def about_y(angle: float) -> tuple[np.ndarray, np.ndarray]:
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return NOMINAL[4].positions @ rotation.T, NOMINAL[4].normals @ rotation.T

    points, normals = about_y(1.11)
    grasp = Grasp.from_contacts(points, normals, 0.4)
    turned = about_y(1.13)[1]
    after = Grasp.from_contacts(points, turned, 0.4)
    assert abs(grasp.frames[0, :, 1] @ after.frames[0, :, 1]) < 0.5
    pipeline = pipeline_of(grasp, initial="previous", method="newton", tolerance=1e-8)
    wrench = 0.2 * PAPER_WRENCH
    before = pipeline.solve(points, normals, wrench)
    force = np.empty((4, 3))
    assert pipeline.core.carry(points, turned, wrench.copy(), force) == CARRIED
    frames = after.frames.copy()
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", frames, force),
        grasp.to_object_frame(before.force),
        atol=0.05 * before.force[:, 0].max(),
    )
    x = turn(grasp.to_cone(before.force), pipeline.grasp.models.cone_divisor, grasp.frames, frames)
    back = turn(x, pipeline.grasp.models.cone_divisor, frames, grasp.frames)
    np.testing.assert_allclose(back, grasp.to_cone(before.force), rtol=1e-3, atol=1e-3)
    assert pipeline.solve(points, turned, wrench).status is Status.OPTIMAL
    np.testing.assert_array_equal(pipeline.frames, after.frames)
