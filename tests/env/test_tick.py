"""One control tick of the core against the optimizer."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from hands import hand_alone, kinematics_alone, scene_alone
from numpy.testing import assert_allclose, assert_array_equal
from oracles.elastic import elastic
from oracles.phi import phi
from problems import PAPER_WRENCH
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.force import ForceLimits, ForceOptimizer, Objective, Status
from grasp_env.force.record import CODE, CONVERGED, INFEASIBLE, RANK_LOST
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.null_space import reference_basis
from grasp_env.task.motion import resting_target

GRASP = presets.paper_cuboid()
SOFT = Grasp.from_contacts(
    GRASP.positions, GRASP.normals, GRASP.friction, contact_model="soft", torsional_friction=0.02
)
WEIGHTS = Objective().weights(4)
TARGET = resting_target(1)[0]
STILL = np.zeros(3)
SOFTNESS = 1e-2  # of the core
TICK = 1e-3  # [s]
MOTOR = 12.0  # [N m] of each joint of the hand


class Loop:
    """A control loop on contacts that are written by hand, without gravity: the wrench to balance
    is the external one."""

    def __init__(
        self,
        tolerance: float = 1e-10,
        squeeze: float = 0.0,
        grasp: Grasp = GRASP,
        most_change: float = 1e9,
        **options: Any,
    ) -> None:
        self.scene, self.views = scene_alone()
        settings = core.HandControllerSettings()
        settings.set_follow(tolerance, options.get("max_iterations", 200))
        settings.directions = reference_basis(GRASP).reshape(-1).tolist()
        settings.force_rate = most_change / TICK
        settings.squeeze = squeeze
        sensors = core.SensorSettings()
        sensors.tick = TICK
        self.optimizer = ForceOptimizer(grasp, tolerance=tolerance, **options)
        self.hand, self.core = hand_alone(
            self.scene, 4, settings, sensors, grasp=grasp, tolerance=tolerance, **options
        )
        self.arrays = self.core.arrays()
        self.place(GRASP.positions, GRASP.normals)
        self.hand.reset()

    def place(
        self, positions: np.ndarray, normals: np.ndarray, touching: tuple[int, ...] = (1, 1, 1, 1)
    ) -> None:
        """Set the contacts of the next tick."""
        self.views.points[:], self.views.normals[:], self.views.touching[:] = (
            positions,
            normals,
            touching,
        )
        self.grasp = Grasp.from_contacts(positions, normals, GRASP.friction)

    def scatter(
        self, positions: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Turn the object and bend the fingers at random; return the Jacobian (4, 6, 12) of the
        contacts, object frame, and the torques (12,) that carry the hand."""
        views = self.views
        turn = Rotation.from_rotvec([0.3, -0.5, 0.4]).as_matrix()  # object frame to world frame
        views.rotation[:] = turn
        views.angles[:] = rng.uniform(-0.5, 0.5, 12)
        kinematics = kinematics_alone()
        jacobian = np.zeros((4, 6, 12))
        frames, origins = kinematics.links(views.angles)
        axes = [frames[j] @ kinematics.hand.links[j].axis for j in range(12)]
        for j in range(12):
            arm = turn @ positions[j // 3] - origins[j]
            jacobian[j // 3, :3, j] = turn.T @ np.cross(axes[j], arm)
            jacobian[j // 3, 3:, j] = turn.T @ axes[j]
        return jacobian, kinematics.gravity_torques(views.angles, (0.0, -9.81, 0.0))

    def act(
        self,
        wrench: np.ndarray,
        due: bool,
        adjustment: np.ndarray | None = None,
        given: np.ndarray | None = None,
    ) -> list[float]:
        """Run a tick; return the joint torques."""
        assert self.hand.see(None, wrench, STILL, TARGET, None)
        return self.core.act(due, adjustment, None, given)

    def tick(
        self, wrench: np.ndarray, due: bool, adjustment: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the commanded force (N, 3)."""
        self.torques = self.act(np.array(wrench), due, adjustment)
        return self.arrays["force"].copy()

    def sees(self, touching: tuple[int, ...]) -> bool:
        """Return True if the loop counts these fingers as touching; for two ticks it keeps one that
        lost its force."""
        return self.core.mask == sum(2**i for i in range(4) if touching[i])


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
    [
        *product(("reduced_flow", "newton"), ("linear_combination", "previous")),
        ("newton", None),
        ("conic", None),
    ],
)
def test_an_agents_step_is_a_call_of_the_optimizer(method, initial):
    loop = Loop(tolerance=1e-6, method=method, initial=initial)
    for positions, normals, wrench in path(0, 10):
        loop.place(positions, normals)
        force = loop.tick(wrench, True)
        alone = loop.optimizer.solve(wrench, positions=positions, normals=normals)
        assert_array_equal(force, alone.force)
        assert_array_equal(loop.arrays["solution"], alone._record)
        assert loop.core.closure
        assert (loop.core.effort.followed, loop.core.effort.limited) == (0, 0)


def test_between_steps_commands_are_optima():
    """For moving contacts and any touching fingers, Newton from the last command ends at the
    current optimum, also after lost closure."""
    loop = Loop(tolerance=1e-12)
    newton = ForceOptimizer(GRASP, tolerance=1e-12)
    loop.tick(PAPER_WRENCH, True)
    for k, (positions, normals, wrench) in enumerate(path(1, 35)):
        touching = ((1, 1, 1, 1), (1, 1, 0, 1), (1, 1, 1, 1), (1, 1, 0, 0), (1, 1, 1, 1))[
            min(k // 7, 4)
        ]
        loop.place(positions, normals, touching)
        force = loop.tick(wrench, False)
        if not loop.sees(touching):
            continue
        assert loop.core.closure == (sum(touching) > 2)
        if loop.core.closure:
            best = newton.solve(
                wrench,
                positions=positions,
                normals=normals,
                contacts=np.array(touching, dtype=bool),
            )
            # forces agree to the root of the gap
            assert_allclose(force, best.force, atol=1e-6 * np.abs(best.force).max())
    assert loop.core.changes == 4
    assert loop.core.effort.followed > 30
    assert loop.arrays["solution"][CODE] == CONVERGED


@pytest.mark.parametrize("due", [True, False])
def test_changes_of_forces_are_bounded(due):
    """From 5 N at each finger to the optimum, on contacts that stay: balance requires no change, so
    the bound is that of the force."""
    most = 0.05
    loop = Loop(most_change=most)
    loop.core.hold = core.Hold.direct
    best = ForceOptimizer(GRASP, tolerance=1e-10).solve(PAPER_WRENCH).force
    internal = ForceOptimizer(GRASP, tolerance=1e-10).solve(np.zeros(6)).force
    before = best + 2.0 * internal
    loop.act(PAPER_WRENCH, True, given=before)
    loop.core.hold = core.Hold.optimized
    way = np.abs(before - best).max()
    ticks = 0
    assert way > 10.0 * most
    while (left := np.abs(before - best).max()) > 1e-3 * way:
        force = loop.tick(PAPER_WRENCH, due)
        # a whole step, or what is left; the last command is balanced to 1e-9 of it, and its optimum
        # is known to 1e-6
        assert np.abs(force - before).max() == pytest.approx(min(most, left), abs=1e-5 * way)
        assert loop.grasp.residual(force, PAPER_WRENCH) < 1e-9
        before = force
        ticks = ticks + 1
    assert ticks == np.ceil(way / most)


def test_the_deepest_overlap_counts():
    """A gap is negative where a tip is inside the object; distance from it does not count."""
    loop = Loop()
    told = []
    gaps = [
        (0.02, 0.01, 0.03, 0.004),
        (0.01, -1e-4, 0.0, 0.02),
        (-3e-4, -2e-4, 0.05, 0.0),
        (1e-5, -2e-4, 0.01, 0.0),
        (0.01,) * 4,
    ]
    for now in gaps:
        loop.views.gaps[:] = now
        loop.tick(PAPER_WRENCH, True)
        told.append(loop.hand.outcome(TARGET, np.empty(12), np.empty((4, 3))).overlap)
    assert told == [0.0, 1e-4, 3e-4, 3e-4, 3e-4]
    loop.hand.reset()
    assert loop.hand.outcome(TARGET, np.empty(12), np.empty((4, 3))).overlap == 0.0


def test_adjustments_are_added_and_repaired():
    """The start is the force of least Phi between the method's own and the adjusted one, balanced."""
    loop = Loop(method="newton", initial="linear_combination", max_iterations=0)
    basis = reference_basis(GRASP)
    rng = np.random.default_rng(3)
    adjusted = 0
    for positions, normals, wrench in path(2, 20):
        loop.place(positions, normals)
        own = loop.tick(wrench, True)
        shift = rng.uniform(-3.0, 3.0, 6)
        made = loop.tick(wrench, True, shift)
        grasp = loop.grasp
        wanted = own + np.einsum("nji,nj->ni", grasp.frames, (basis @ shift).reshape(4, 3))
        cone = grasp.to_cone(wanted)
        cone = cone - np.linalg.pinv(grasp.cone_matrix) @ (grasp.cone_matrix @ cone + wrench)
        begin = grasp.to_cone(own)
        x = grasp.to_cone(made)
        way = cone - begin
        part = float((x - begin) @ way / (way @ way))
        # the least change is one of forces where the oracle's is one of cone coordinates: they
        # agree along internal forces
        assert_allclose(x, begin + part * way, atol=2e-2 * np.abs(way).max())
        assert -1e-9 < part < 1.0 + 1e-9
        assert grasp.residual(made, wrench) < 1e-9
        assert phi(x, WEIGHTS) <= phi(begin, WEIGHTS) * (1.0 + 1e-12)
        adjusted += part > 0.01
    assert adjusted > 3


@pytest.mark.parametrize("grasp", [GRASP, SOFT], ids=["hard", "soft"])
@pytest.mark.parametrize("due", [True, False])
def test_forces_are_found_within_the_limits(due, grasp):
    """Torques, of torsion too, of the optimum where these are within the limits, else of Newton
    within them, else of the least excess."""
    soft = grasp is SOFT
    loop = Loop(method="newton" if soft else "reduced_flow", tolerance=1e-8, grasp=grasp)
    rng = np.random.default_rng(5)
    ended = set()
    for k, (positions, normals, wrench) in enumerate(path(6, 40)):
        if not due:  # from a command before it
            loop.tick(wrench, True)
        loop.place(positions, normals)
        jacobian, carried = loop.scatter(positions, rng)
        load = (4.0 + 1.0 * k) * wrench
        now = {"positions": positions, "normals": normals}
        limits = ForceLimits(
            jacobian=jacobian if soft else jacobian[:, :3].copy(),
            torque_limit=MOTOR,
            torque_bias=carried,
        )
        best = ForceOptimizer(grasp, tolerance=1e-10, limits=limits, elastic=True).solve(
            load, **now
        )
        free = ForceOptimizer(grasp, tolerance=1e-10).solve(load, **now)
        torsion = free.torsion[:, None] * normals if soft else np.zeros((4, 3))
        pushed = np.concatenate([free.object_force, torsion], axis=1)
        wanted = carried + np.einsum("nrj,nr->j", jacobian, pushed)
        fits = np.abs(wanted).max() <= MOTOR
        loop.hand.begin_step()
        force = loop.tick(load, due)
        assert np.abs(loop.torques).max() <= MOTOR
        unique = fits or best.status is not Status.LIMITS_EXCEEDED
        if unique:
            assert_allclose(loop.torques, wanted if fits else best.torques, atol=2e-3 * MOTOR)
        if not soft:
            solved = (free if fits else best).force
            assert not unique or np.abs(force - solved).max() <= 1e-3 * np.abs(solved).max()
            assert (loop.core.effort.limited > 0) == (not fits)
            torques = carried + np.einsum(
                "nrj,nr->j", jacobian[:, :3], np.einsum("nij,nj->ni", loop.grasp.frames, force)
            )
            assert loop.core.effort.saturated == (np.abs(torques).max() > MOTOR * (1.0 + 1e-9))
            assert_allclose(loop.torques, np.clip(torques, -MOTOR, MOTOR), atol=1e-9)
            assert np.abs(torques).max() / MOTOR - 1.0 <= best.limit_excess * 1.02 + 1e-6
            assert loop.grasp.residual(force, load) < 1e-7
        ended.add("free" if fits else best.status.name)
    assert ended == {"free", "OPTIMAL", "LIMITS_EXCEEDED"}


@pytest.mark.parametrize("touching", [(1, 0, 0, 0), (0, 1, 1, 1)])
def test_lost_closure_is_the_elastic_answer(touching):
    """One finger, or the three of one side: inside the cones, with the least imbalance."""
    loop = Loop(method="reduced_flow")
    codes = set()
    loop.core.hold = core.Hold.direct  # begin from forces outside their cones
    loop.act(PAPER_WRENCH, True, given=np.tile([1.0, 3.0, -2.0], (4, 1)))
    loop.core.hold = core.Hold.optimized
    for k, (positions, normals, wrench) in enumerate(path(7, 8)):
        loop.place(positions, normals, touching)
        force = loop.tick(wrench, k % 2 == 0)
        if not loop.sees(touching):
            continue
        if k % 2 == 0:
            codes.add(int(loop.arrays["solution"][CODE]))
        here = np.flatnonzero(touching)
        assert (loop.core.closure, loop.core.status) == (False, "slipping")
        assert not force[np.array(touching) == 0].any()
        points = positions[here]
        frames = loop.grasp.frames[here]
        centre = points.mean(axis=0)
        spread = np.sqrt(((points - centre) ** 2).sum(axis=1).mean()) or 1.0
        columns = [
            np.concatenate([frame[:, a], np.cross((point - centre) / spread, frame[:, a])])
            / (0.4 if a == 0 else 1.0)
            for point, frame in zip(points, frames, strict=True)
            for a in range(3)
        ]
        unit = np.concatenate([wrench[:3], (wrench[3:] - np.cross(centre, wrench[:3])) / spread])
        start = np.tile([1.0, 0.0, 0.0], len(here))
        wanted = elastic(start, np.column_stack(columns), unit, WEIGHTS[here], SOFTNESS)
        x = (force[here] * [0.4, 1.0, 1.0]).reshape(-1)
        assert_allclose(x, wanted, atol=1e-4 * np.abs(wanted).max())
    assert codes
    assert codes <= {INFEASIBLE, RANK_LOST}


def test_two_contacts_balance_all_but_the_moment_about_their_line():
    loop = Loop(method="reduced_flow")
    pivoted = 0
    for k, (positions, normals, wrench) in enumerate(path(7, 12)):
        loop.place(positions, normals, (1, 1, 0, 0))
        load = 0.1 * wrench
        force = loop.tick(load, k % 2 == 0)
        if loop.core.status != "pivoting":
            continue
        pushed = np.einsum("nij,nj->ni", loop.grasp.frames, force)[:2]
        missed = load[:3] + pushed.sum(axis=0)
        turning = load[3:] + np.cross(positions[:2], pushed).sum(axis=0)
        turning -= np.cross(positions[0], missed)
        line = positions[1] - positions[0]
        line /= np.linalg.norm(line)
        assert_allclose(missed, 0.0, atol=1e-9)
        assert_allclose(turning, (turning @ line) * line, atol=1e-9)
        assert abs(turning @ line) > 1e-4
        assert not loop.core.closure
        pivoted += 1
    assert pivoted > 5


@pytest.mark.parametrize("fingers", [(1, 1, 1, 1), (1, 1, 1, 0)])
def test_squeezes_are_internal_and_balanced(fingers):
    """20 N of the internal force of the contacts at first, turned with the frames."""
    loop = Loop(squeeze=20.0)
    loop.core.hold = core.Hold.squeeze
    here = np.flatnonzero(fingers)
    rest = None
    for positions, normals, wrench in path(9, 6):
        loop.place(positions, normals, fingers)
        force = loop.tick(wrench, True)
        if not loop.sees(fingers):
            continue
        if rest is None:
            solver = ForceOptimizer(loop.grasp, tolerance=1e-10)
            rest = solver.solve(np.zeros(6), contacts=np.array(fingers, dtype=bool)).force
            rest = 20.0 / rest[:, 0].sum() * rest
        matrix = loop.grasp.matrix.reshape(6, 4, 3)[:, here].reshape(6, -1)
        given = rest[here].reshape(-1)
        expected = given - np.linalg.pinv(matrix) @ (matrix @ given + wrench)
        # 1e-9 of the largest entry stands on the diagonal of the system
        assert_allclose(force[here].reshape(-1), expected, atol=1e-4)
        assert not force[np.array(fingers) == 0].any()


@pytest.mark.parametrize("fingers", [(1, 0, 0, 0), (0, 1, 1, 1)])
def test_a_squeeze_of_fingers_without_internal_force_presses_inwards(fingers):
    """Equally, as far as these contacts can then balance."""
    loop = Loop(squeeze=20.0)
    loop.core.hold = core.Hold.squeeze
    here = np.flatnonzero(fingers)
    loop.place(GRASP.positions, GRASP.normals, fingers)
    while not loop.sees(fingers):
        force = loop.tick(0.1 * PAPER_WRENCH, True)
    assert loop.core.status == "given"
    matrix = loop.grasp.matrix.reshape(6, 4, 3)[:, here].reshape(6, -1)
    given = np.tile([20.0 / len(here), 0.0, 0.0], len(here))
    expected = given - np.linalg.pinv(matrix) @ (matrix @ given + 0.1 * PAPER_WRENCH)
    # 1e-9 of the largest entry stands on the diagonal of the system
    assert_allclose(force[here].reshape(-1), expected, atol=1e-4)


def test_soft_forces_on_their_way_balance():
    """Torsions go the same share of their way as forces; they are what torques leave."""
    loop = Loop(method="newton", grasp=SOFT, most_change=0.05)
    jacobian, carried = loop.scatter(GRASP.positions, np.random.default_rng(2))
    twisted = PAPER_WRENCH + 0.1 * np.eye(6)[5]
    loop.tick(twisted, True)
    largest = 0.0
    for wrench in (PAPER_WRENCH, PAPER_WRENCH - (twisted - PAPER_WRENCH)):
        for _ in range(20):
            force = loop.tick(wrench, False)
            pushes = np.einsum("nij,nj->ni", loop.grasp.frames, force)
            rest = loop.torques - carried - np.einsum("nrj,nr->j", jacobian[:, :3], pushes)
            turns = np.einsum("nrj,nr->jn", jacobian[:, 3:], GRASP.normals)
            torsion, *_ = np.linalg.lstsq(turns, rest, rcond=None)
            assert_allclose(turns @ torsion, rest, atol=1e-9)
            moment = np.cross(GRASP.positions, pushes).sum(axis=0) + torsion @ GRASP.normals
            # the last command is balanced to 1e-9 of it
            assert_allclose(pushes.sum(axis=0), -wrench[:3], atol=1e-6)
            assert_allclose(moment, -wrench[3:], atol=1e-7)
            largest = max(largest, np.abs(torsion).max())
    assert largest > 1e-3


def test_the_fastest_touching_tip_slips():
    loop = Loop()
    for slip, touching, most in (
        ((0.1, 0.4, 0.2, 0.3), (1, 1, 1, 1), 0.4),
        ((0.1, 0.4, 0.2, 0.3), (1, 0, 1, 0), 0.2),
        ((0.1, 0.4, 0.2, 0.3), (0, 0, 0, 0), 0.0),
    ):
        loop.views.slip[:] = slip
        loop.place(GRASP.positions, GRASP.normals, touching)
        loop.tick(PAPER_WRENCH, True)
        found = loop.hand.outcome(TARGET, np.empty(12), np.empty((4, 3)))
        assert found.slip == most


def test_a_push_that_carries_the_object_hides_no_stray_force():
    """Stray forces are relative to the weight at least, and to a larger load."""
    scene, views = scene_alone()
    body = core.Body()
    body.mass = 0.2
    hand, _ = hand_alone(scene, 4, body=body)
    weight = 0.2 * 9.81
    views.stray[0] = 1.0
    for push, load in ((0.0, weight), (weight, weight), (-weight, 2.0 * weight)):
        hand.reset()
        views.stray[0] = 1.0
        hand.see(None, np.array([0.0, push, 0.0, 0.0, 0.0, 0.0]), STILL, TARGET, None)
        found = hand.outcome(TARGET, np.empty(12), np.empty((4, 3)))
        assert found.stray == 1.0
        assert found.stray_share == pytest.approx(1.0 / load)
