"""One control tick of the core against the general path: the method at an agent's step, Newton after it, the motors' limits, lost closure."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from hands import controller_alone, scene_alone
from oracles.elastic import elastic
from oracles.phi import phi
from problems import PAPER_WRENCH
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.force import ForceLimits, ForceOptimizer, Objective, Status
from grasp_env.force.record import CODE, CONVERGED, INFEASIBLE, LIMIT, RANK_LOST, REFUSED
from grasp_env.grasp import Grasp, presets, reference_basis
from grasp_env.task.motion import resting_target

GRASP = presets.paper_cuboid()
WEIGHTS = Objective().weights(4)
TARGET = resting_target(1)[0]
STILL = np.zeros(3)
SOFTNESS = 1e-2  # of the core
MOTOR = 12.0  # [N m] of each joint of the hand


class Loop:
    """A control loop on contacts that are written by hand; there is no gravity, so that the wrench to balance is the one told."""

    def __init__(
        self,
        tolerance: float = 1e-10,
        most_change: float = np.inf,
        squeeze: float = 0.0,
        grasp: Grasp = GRASP,
        **options: Any,
    ) -> None:
        self.scene, self.views = scene_alone()
        settings = core.ControlSettings()
        settings.set_follow(tolerance, options.get("max_iterations", 200))
        settings.directions = reference_basis(GRASP).reshape(-1).tolist()
        settings.most_change, settings.squeeze = most_change, squeeze
        self.optimizer = ForceOptimizer(grasp, tolerance=tolerance, **options)
        self.core = controller_alone(self.scene, 4, settings, grasp=grasp, tolerance=tolerance, **options)
        self.arrays = self.core.arrays()
        self.place(GRASP.positions, GRASP.normals)
        self.core.reset()

    def place(self, positions: np.ndarray, normals: np.ndarray, touching: tuple[int, ...] = (1, 1, 1, 1)) -> None:
        """The contacts of the next tick."""
        self.views.points[:], self.views.normals[:], self.views.touching[:] = positions, normals, touching
        self.grasp = Grasp.from_contacts(positions, normals, GRASP.friction)

    def scatter(self, positions: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Three joints a finger at odd places, a turned object: the Jacobian (4, 6, 12), object frame, and what the links' weight takes (12,)."""
        views, turn = (
            self.views,
            Rotation.from_rotvec([0.3, -0.5, 0.4]).as_matrix(),
        )  # the object's frame to the world's
        views.rotation[:] = turn
        views.touch[:] = positions @ turn.T
        views.axes[:] = np.tile(np.eye(3), (4, 1))
        views.origins[:] = np.repeat(views.touch, 3, axis=0) + rng.uniform(-0.1, 0.1, (12, 3))
        views.gravity_torques[:] = rng.uniform(-0.2, 0.2, 12) * MOTOR
        jacobian = np.zeros((4, 6, 12))
        for j in range(12):
            jacobian[j // 3, :3, j] = turn.T @ np.cross(views.axes[j], views.touch[j // 3] - views.origins[j])
            jacobian[j // 3, 3:, j] = turn.T @ views.axes[j]
        return jacobian, views.gravity_torques.copy()

    def tick(self, wrench: np.ndarray, due: bool, adjustment: np.ndarray | None = None) -> np.ndarray:
        """The commanded force (N, 3)."""
        self.torques = self.core.tick(None, np.array(wrench), STILL, TARGET, None, due, adjustment, None)
        return self.arrays["force"].copy()


def path(seed: int, count: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Contacts that move by a millimetre and a degree a tick, and a wrench that changes with them."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        normals = GRASP.normals + 0.02 * rng.standard_normal((4, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        wrench = PAPER_WRENCH + rng.standard_normal(6) * np.repeat([1.0, 0.02], 3)
        out.append((GRASP.positions + 1e-3 * rng.standard_normal((4, 3)), normals, wrench))
    return out


@pytest.mark.parametrize(
    ("method", "initial"),
    [*product(("reduced_flow", "newton"), ("linear_combination", "previous", None)), ("conic", None)],
)
def test_an_agents_step_is_a_call_of_the_optimizer(method: str, initial: str | None) -> None:
    loop = Loop(tolerance=1e-6, method=method, initial=initial)
    for positions, normals, wrench in path(0, 10):
        loop.place(positions, normals)
        force = loop.tick(wrench, True)
        alone = loop.optimizer.solve(wrench, positions=positions, normals=normals)
        row = loop.arrays["solution"]
        np.testing.assert_array_equal(force, alone.force)
        np.testing.assert_array_equal(row, alone._record)
        assert loop.core.closure
        assert (loop.core.effort.followed, loop.core.effort.limited) == (0, 0)


def test_between_two_steps_the_command_is_the_optimum() -> None:
    """Whatever moved, and whichever fingers touch: Newton from the last command ends at the current optimum."""
    loop, newton = Loop(), ForceOptimizer(GRASP, tolerance=1e-12)
    loop.tick(PAPER_WRENCH, True)
    for k, (positions, normals, wrench) in enumerate(path(1, 30)):
        touching = (1, 1, 1, 1) if k < 10 or k >= 20 else (1, 1, 0, 1)
        loop.place(positions, normals, touching)
        force = loop.tick(wrench, False)
        if loop.core.mask != sum(2**i for i in range(4) if touching[i]):
            continue  # for two ticks a finger that lost its force counts as touching
        best = newton.solve(wrench, positions=positions, normals=normals, contacts=np.array(touching, dtype=bool))
        np.testing.assert_allclose(force, best.force, atol=1e-6 * np.abs(best.force).max())
        assert loop.core.closure
    assert loop.core.changes == 2
    assert loop.core.effort.followed > 30
    assert loop.arrays["solution"][CODE] == CONVERGED


def test_an_adjustment_is_added_to_the_start_and_repaired() -> None:
    """The start is the force of least Phi between the method's own and the adjusted one, balanced."""
    loop = Loop(method="newton", initial="linear_combination", max_iterations=0)
    basis, rng, adjusted = reference_basis(GRASP), np.random.default_rng(3), 0
    for positions, normals, wrench in path(2, 20):
        loop.place(positions, normals)
        own = loop.tick(wrench, True)
        shift = rng.uniform(-3.0, 3.0, 6)
        made = loop.tick(wrench, True, shift)
        grasp = loop.grasp
        wanted = own + np.einsum("nji,nj->ni", grasp.frames, (basis @ shift).reshape(4, 3))
        cone = grasp.to_cone(wanted)
        cone = cone - np.linalg.pinv(grasp.cone_matrix) @ (grasp.cone_matrix @ cone + wrench)
        begin, x = grasp.to_cone(own), grasp.to_cone(made)
        way = cone - begin
        part = float((x - begin) @ way / (way @ way))
        # the least change is one of forces where the oracle's is one of cone coordinates: they agree along internal forces
        np.testing.assert_allclose(x, begin + part * way, atol=2e-2 * np.abs(way).max())
        assert -1e-9 < part < 1.0 + 1e-9
        assert grasp.residual(made, wrench) < 1e-9
        assert phi(x, WEIGHTS) <= phi(begin, WEIGHTS) * (1.0 + 1e-12)
        adjusted += part > 0.01
    assert adjusted > 3


@pytest.mark.parametrize("due", [True, False])
def test_what_the_motors_cannot_make_is_found_within_their_limits(due: bool) -> None:
    """Joints at odd places: the optimum where its torques are within the limits, else Newton within them, else the least excess."""
    loop, rng, ended = Loop(method="reduced_flow", tolerance=1e-8), np.random.default_rng(5), set()
    for k, (positions, normals, wrench) in enumerate(path(6, 40)):
        if not due:  # from a command before it
            loop.tick(wrench, True)
        loop.place(positions, normals)
        jacobian, carried = loop.scatter(positions, rng)
        jacobian, load = jacobian[:, :3].copy(), (5.0 + 5.0 * k) * wrench
        limits = ForceLimits(jacobian=jacobian, torque_limit=MOTOR, torque_bias=carried)
        now = {"positions": positions, "normals": normals}
        best = ForceOptimizer(GRASP, tolerance=1e-10, limits=limits, elastic=True).solve(load, **now)
        free = ForceOptimizer(GRASP, tolerance=1e-10).solve(load, **now)
        loop.core.begin_step()
        force = loop.tick(load, due)
        torques = carried + np.einsum("nrj,nr->j", jacobian, np.einsum("nij,nj->ni", loop.grasp.frames, force))
        fits = np.abs(carried + np.einsum("nrj,nr->j", jacobian, free.object_force)).max() <= MOTOR
        wanted = free if fits else best
        if wanted.status is not Status.LIMITS_EXCEEDED:  # whose force is not unique
            np.testing.assert_allclose(force, wanted.force, atol=1e-3 * np.abs(wanted.force).max())
        assert (loop.core.effort.limited > 0) == (not fits)
        assert loop.core.effort.saturated == (np.abs(torques).max() > MOTOR * (1.0 + 1e-9))
        np.testing.assert_allclose(loop.torques, np.clip(torques, -MOTOR, MOTOR), atol=1e-9)
        assert np.abs(torques).max() / MOTOR - 1.0 <= best.limit_excess * 1.02 + 1e-6
        assert loop.grasp.residual(force, load) < 1e-7
        ended.add("free" if fits else wanted.status.name)
    assert ended == {"free", "OPTIMAL", "LIMITS_EXCEEDED"}


@pytest.mark.parametrize("due", [True, False])
def test_torsion_of_soft_contacts_counts_in_the_motors_limits(due: bool) -> None:
    """Torques of the same optimum, torsion included: free, or within the limits."""
    torsion = {"contact_model": "soft", "torsional_friction": 0.02}
    soft = Grasp.from_contacts(GRASP.positions, GRASP.normals, GRASP.friction, **torsion)
    loop, rng, ended = Loop(method="newton", tolerance=1e-8, grasp=soft), np.random.default_rng(5), set()
    for k, (positions, normals, wrench) in enumerate(path(6, 40)):
        if not due:
            loop.tick(wrench, True)
        loop.place(positions, normals)
        jacobian, carried = loop.scatter(positions, rng)
        load, now = (5.0 + 5.0 * k) * wrench, {"positions": positions, "normals": normals}
        limits = ForceLimits(jacobian=jacobian, torque_limit=MOTOR, torque_bias=carried)
        best = ForceOptimizer(soft, tolerance=1e-10, limits=limits, elastic=True).solve(load, **now)
        free = ForceOptimizer(soft, tolerance=1e-10).solve(load, **now)
        pushed = np.concatenate([free.object_force, free.torsion[:, None] * normals], axis=1)
        torques = carried + np.einsum("nrj,nr->j", jacobian, pushed)
        fits = np.abs(torques).max() <= MOTOR
        loop.tick(load, due)
        if fits or best.status is Status.OPTIMAL:
            wanted = torques if fits else best.torques
            np.testing.assert_allclose(loop.torques, wanted, atol=2e-3 * MOTOR)
        ended.add("free" if fits else best.status.name)
    assert ended == {"free", "OPTIMAL", "LIMITS_EXCEEDED"}


@pytest.mark.parametrize("touching", [(1, 1, 0, 0), (1, 0, 0, 0), (0, 1, 1, 1)])
def test_lost_closure_is_the_elastic_answer(touching: tuple[int, ...]) -> None:
    """Thumb and one finger, one finger, or the three of one side: inside the cones, missing balance least."""
    loop = Loop(method="reduced_flow")
    loop.core.hold = core.Hold.direct  # forces outside their cones, from where it begins
    given = np.tile([1.0, 3.0, -2.0], (4, 1))
    loop.core.tick(None, PAPER_WRENCH, STILL, TARGET, None, True, None, given)
    loop.core.hold = core.Hold.optimized
    codes = set()
    for k, (positions, normals, wrench) in enumerate(path(7, 8)):
        loop.place(positions, normals, touching)
        force = loop.tick(wrench, k % 2 == 0)
        if loop.core.mask != sum(2**i for i in range(4) if touching[i]):
            continue
        if k % 2 == 0:
            codes.add(int(loop.arrays["solution"][CODE]))
        here = np.flatnonzero(touching)
        assert not loop.core.closure
        assert not force[np.flatnonzero(np.array(touching) == 0)].any()
        points, frames = positions[here], loop.grasp.frames[here]
        centre = points.mean(axis=0)
        spread = np.sqrt(((points - centre) ** 2).sum(axis=1).mean()) or 1.0
        columns = [
            np.concatenate([frames[k][:, a], np.cross((points[k] - centre) / spread, frames[k][:, a])])
            / (0.4 if a == 0 else 1.0)
            for k in range(len(here))
            for a in range(3)
        ]
        matrix = np.column_stack(columns)
        unit = np.concatenate([wrench[:3], (wrench[3:] - np.cross(centre, wrench[:3])) / spread])
        start = np.tile([1.0, 0.0, 0.0], len(here))
        wanted = elastic(start, matrix, unit, WEIGHTS[here], SOFTNESS)
        x = (force[here] * [0.4, 1.0, 1.0]).reshape(-1)
        np.testing.assert_allclose(x, wanted, atol=1e-4 * np.abs(wanted).max())
    assert codes <= {INFEASIBLE, RANK_LOST}
    assert codes


def test_a_found_closure_goes_on_at_once() -> None:
    loop = Loop()
    loop.tick(PAPER_WRENCH, True)
    for _ in range(4):
        loop.place(GRASP.positions, GRASP.normals, (1, 1, 0, 0))
        loop.tick(PAPER_WRENCH, False)
    assert not loop.core.closure
    loop.place(GRASP.positions, GRASP.normals)
    force = loop.tick(PAPER_WRENCH, False)
    assert loop.core.closure
    np.testing.assert_allclose(force, ForceOptimizer(GRASP, tolerance=1e-10).solve(PAPER_WRENCH).force, atol=1e-5)


def test_a_start_of_the_callers_must_be_balanced_and_inside() -> None:
    loop = Loop(method="newton")
    start = ForceOptimizer(GRASP).start(PAPER_WRENCH)
    for force, code in ((start, CONVERGED), (start + 1.0, REFUSED)):
        loop.core.see(None, PAPER_WRENCH, STILL, TARGET, None)
        loop.core.act(True, None, np.ascontiguousarray(force), None)
        assert loop.core.code == code
        assert loop.core.closure == (code == CONVERGED)
    np.testing.assert_array_equal(loop.arrays["solution"][CODE], REFUSED)


def test_the_budget_holds_for_every_tick() -> None:
    loop = Loop(method="reduced_flow", max_iterations=3)
    for k, (positions, normals, wrench) in enumerate(path(10, 10)):
        loop.place(positions, normals)
        loop.core.begin_step()
        force = loop.tick(5.0 * wrench, k % 2 == 0)
        effort = loop.core.effort
        assert effort.iterations + effort.followed == 3  # to 1e-10 it takes more
        assert loop.grasp.residual(force, 5.0 * wrench) < 1e-7
        assert loop.grasp.cone_margin(force) > 0.0
    assert loop.arrays["solution"][CODE] == LIMIT


@pytest.mark.parametrize("due", [True, False])
def test_forces_change_no_faster_than_asked(due: bool) -> None:
    """A finger that lands takes over its share by 0.01 N a tick, while every command balances the wrench."""
    loop = Loop(method="newton", most_change=0.01)
    loop.place(GRASP.positions, GRASP.normals, (1, 1, 1, 0))
    loop.tick(PAPER_WRENCH, True)
    loop.place(GRASP.positions, GRASP.normals)
    force, best = loop.tick(PAPER_WRENCH, due), ForceOptimizer(GRASP, tolerance=1e-10).solve(PAPER_WRENCH).force
    for tick in range(200):
        assert loop.grasp.residual(force, PAPER_WRENCH) < 1e-9
        before, force = force, loop.tick(PAPER_WRENCH, due)
        change = np.abs(force - before).max()
        assert change <= 0.01 * (1.0 + 1e-6)
        if np.abs(force - best).max() < 1e-4:
            assert tick > 5
            return
    pytest.fail("the finger never takes over its share")


def test_a_reset_forgets() -> None:
    loop, first = Loop(method="newton", initial="previous"), []
    for _ in range(2):
        loop.core.reset()
        forces = []
        for k, (positions, normals, wrench) in enumerate(path(8, 12)):
            loop.place(positions, normals)
            forces.append(loop.tick(wrench, k % 5 == 0))
        first.append(np.array(forces))
    np.testing.assert_array_equal(*first)


def test_a_squeeze_is_an_internal_force_and_the_least_change_that_balances() -> None:
    """For all fingers and for three: 20 N of the planned contacts' internal force, turned with the frames."""
    loop = Loop(squeeze=20.0)
    for fingers in ((1, 1, 1, 1), (1, 1, 1, 0)):
        loop.core.reset()
        loop.core.hold = core.Hold.squeeze
        here = np.flatnonzero(fingers)
        rest = ForceOptimizer(GRASP, tolerance=1e-10).solve(np.zeros(6), contacts=np.array(fingers, dtype=bool)).force
        rest = 20.0 / rest[:, 0].sum() * rest
        for positions, normals, wrench in path(9, 6):
            loop.place(positions, normals, fingers)
            force = loop.tick(wrench, True)
            matrix = loop.grasp.matrix.reshape(6, 4, 3)[:, here].reshape(6, -1)
            given = rest[here].reshape(-1)
            expected = given - np.linalg.pinv(matrix) @ (matrix @ given + wrench)
            # 1e-9 of the largest entry stands on the diagonal of the system
            np.testing.assert_allclose(force[here].reshape(-1), expected, atol=1e-4)
            assert not force[np.array(fingers) == 0].any()
