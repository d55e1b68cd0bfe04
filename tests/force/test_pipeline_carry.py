"""`ForcePipeline.carry` between two solves: the optimum followed, repaired, clipped, and its twin in the control tick."""

from __future__ import annotations

import numpy as np
import pytest
from force.test_pipeline import NOMINAL, contacts, grasp_of, some_wrench
from problems import PAPER_WRENCH

from grasp_env.carry_kernels import CARRIED, CLIPPED, REPAIRED, carry_or_repair, turn, write_contact_geometry
from grasp_env.force import ForceOptimizer, Status
from grasp_env.force.pipeline import ForcePipeline
from grasp_env.grasp import Grasp
from grasp_env.phi_kernels import combine, tangent


@pytest.mark.parametrize("count", NOMINAL)
def test_carry_follows_the_optimum(count: int) -> None:
    rng = np.random.default_rng(count)
    pipeline = ForcePipeline(NOMINAL[count], method="newton", tolerance=1e-8)
    force, x = np.empty((count, 3)), np.empty(3 * count)
    for _ in range(20):
        points, normals = contacts(rng, count)
        wrench = some_wrench(rng)
        pipeline.solve(points, normals, wrench)
        held = [array.copy() for array in pipeline.held]
        points, wrench = points + 1e-5 * rng.standard_normal((count, 3)), wrench + 1e-3 * rng.standard_normal(6)
        assert pipeline.carry(points, normals, wrench, force) == CARRIED
        for array, before in zip(pipeline.held, held, strict=True):
            np.testing.assert_array_equal(array, before)
        grasp = grasp_of(count, points, normals)
        assert grasp.residual(force, wrench) < 1e-9
        # to first order the optimum of now
        best = ForceOptimizer(grasp, method="newton", tolerance=1e-10).solve(wrench)
        np.testing.assert_allclose(force, best.force, atol=1e-2)
        # the tangent correction of now, exactly: the tangents turn by less than rounding shows
        assert tangent(pipeline.x, grasp.cone_matrix.copy(), wrench, pipeline.held.weights, x)
        np.testing.assert_allclose(grasp.to_cone(force), x, atol=1e-5)


def test_carry_repairs_and_clips() -> None:
    grasp = NOMINAL[4]
    pipeline = ForcePipeline(grasp)
    points, normals, force = grasp.positions.copy(), grasp.normals.copy(), np.empty((4, 3))
    pipeline.solve(points, normals, np.zeros(6))
    heavy = 20.0 * PAPER_WRENCH
    assert pipeline.carry(points, normals, heavy, force) == REPAIRED
    assert grasp.residual(force, heavy) < 1e-9
    assert grasp.cone_margin(force) > 0.0
    # friction cones that no balanced force of any combination is in: a wrench along which the basis does not reach
    x, out = pipeline.x.copy(), np.empty(12)
    assert carry_or_repair(x, np.zeros(12), pipeline.cone_matrix, heavy, pipeline.held.weights, out) == CLIPPED
    pipeline._core.set_basis(np.zeros((13, 12)), np.ascontiguousarray(grasp.frames))
    assert pipeline.carry(points, normals, heavy, force) == CLIPPED
    for clipped in (out, grasp.to_cone(force)):
        u, o, t = clipped.reshape(-1, 3).T
        assert (u >= 1.04 * np.hypot(o, t)).all()
    np.testing.assert_allclose(grasp.to_cone(force), out, rtol=0, atol=1e-9 * np.abs(out).max())


@pytest.mark.parametrize("count", NOMINAL)
def test_the_control_tick_carries_as_the_pipeline_does(count: int) -> None:
    """`carry_kernels`, step by step, against one call of the core."""
    rng = np.random.default_rng(count)
    pipeline = ForcePipeline(NOMINAL[count], method="newton")
    held, size, seen = pipeline.held, 3 * count, set()
    frames, matrix, cone_matrix = np.empty((count, 3, 3)), np.empty((6, size)), np.empty((6, size))
    x, combined, there, out = np.empty((4, size))
    force = np.empty((count, 3))
    for jump in (1e-3, 0.1, 1.0, 10.0, 100.0) * 4:
        points, normals = contacts(rng, count)
        wrench = some_wrench(rng)
        pipeline.solve(points, normals, wrench)
        points, normals = contacts(rng, count)
        wrench = wrench + jump * some_wrench(rng)
        write_contact_geometry(points, normals, held.divisor.copy(), held.tangents, frames, matrix, cone_matrix)
        now = grasp_of(count, points, normals)
        np.testing.assert_allclose(frames, now.frames, rtol=0, atol=3e-15)
        np.testing.assert_allclose(matrix, now.matrix, rtol=0, atol=3e-15)
        np.testing.assert_allclose(cone_matrix, now.cone_matrix, rtol=1e-14, atol=3e-15)
        turn(held.x, held.divisor.copy(), held.frames, frames, x)
        combine(held.basis, wrench, False, there)
        turn(there, held.divisor.copy(), held.basis_frames, frames, combined)
        outcome = carry_or_repair(x, combined, cone_matrix, wrench, held.weights, out)
        assert pipeline.carry(points, normals, wrench, force) == outcome
        # a system of condition up to 1e7, solved in two frames
        np.testing.assert_allclose(now.to_cone(force), out, rtol=0, atol=1e-7 * np.abs(out).max())
        seen.add(outcome)
    assert seen >= {CARRIED, REPAIRED}


def test_carry_without_an_optimum_is_the_carried_combination() -> None:
    grasp = NOMINAL[4]
    pipeline, force = ForcePipeline(grasp), np.empty((4, 3))
    assert np.isnan(pipeline.x).all()
    assert pipeline.carry(grasp.positions.copy(), grasp.normals.copy(), PAPER_WRENCH.copy(), force) == REPAIRED
    np.testing.assert_allclose(force, ForceOptimizer(grasp).start(PAPER_WRENCH), atol=1e-12)


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
    pipeline = ForcePipeline(grasp, initial="previous", method="newton", tolerance=1e-8)
    wrench = 0.2 * PAPER_WRENCH
    before = pipeline.solve(points, normals, wrench)
    force = np.empty((4, 3))
    assert pipeline.carry(points, turned, wrench.copy(), force) == CARRIED
    frames = after.frames.copy()
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", frames, force),
        grasp.to_object_frame(before.force),
        atol=0.05 * before.force[:, 0].max(),
    )
    x, back = np.empty(12), np.empty(12)
    turn(grasp.to_cone(before.force), pipeline.held.divisor, grasp.frames.copy(), frames, x)
    turn(x, pipeline.held.divisor, frames, grasp.frames.copy(), back)
    np.testing.assert_allclose(back, grasp.to_cone(before.force), rtol=1e-3, atol=1e-3)
    assert pipeline.solve(points, turned, wrench).status is Status.OPTIMAL
    np.testing.assert_array_equal(pipeline.frames, after.frames)
