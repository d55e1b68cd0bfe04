"""The grip of the hand's controller: springs of the fingertips, preloads, and what is done where no
force within the margin balances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hands import kinematics_alone
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.control import HandController, HandControllerSettings
from grasp_env.grasp import presets

PERIOD = 1e-3
GRASP = presets.paper_cuboid()
FRICTION = float(np.ravel(GRASP.friction)[0])
WEIGHT = np.array([0.0, -2.0, 0.0, 0.0, 0.0, 0.0])
PLAIN: dict[str, Any] = {
    "friction": FRICTION,
    "friction_margin": 0.8,
    "preload": 0.0,
    "torque_rate": 1e6,
    "posture_stiffness": 0.0,
    "posture_damping": 0.0,
    "tolerance": 1e-9,
}


class Bench:
    """A hand without a simulator: the contacts are those of the paper's cuboid, whatever the joints
    do."""

    def __init__(self, **settings: Any) -> None:
        self.kinematics = kinematics_alone()
        self.controller = HandController()
        options = HandControllerSettings(**{**PLAIN, **settings})
        self.controller.configure(self.kinematics.hand, options)
        self.state = self.controller.new_state()
        self.state.angles = np.array(self.kinematics.home)
        self.state.touching[:] = 1.0
        self.state.positions[:] = GRASP.positions
        self.state.normals[:] = GRASP.normals
        self.state.wrench[:] = WEIGHT
        self.controller.activate(self.state)
        self.arrays = self.controller.arrays()
        self.run()

    def run(self, updates: int = 1) -> None:
        """Update with the state at hand."""
        for _ in range(updates):
            self.controller.update(self.state, PERIOD)

    @property
    def springs(self) -> np.ndarray:
        """Forces (N, 3) [N] of the springs, object frame."""
        added = self.controller.force - self.arrays["optimal"]
        return np.einsum("nij,nj->ni", self.arrays["frames"], added)

    def used(self, force: np.ndarray) -> np.ndarray:
        """Share (N,) of the friction that forces (N, 3) use, contact frames."""
        return np.hypot(force[:, 1], force[:, 2]) / (FRICTION * force[:, 0])


def stiffness(bench: Bench, wanted: float, late: float = 0.0) -> np.ndarray:
    """Stiffness (N,) [N/m] of sampled springs: 0.5 / (mobility * time^2) at most."""
    mobility, _ = bench.kinematics.mobility(bench.kinematics.home)
    return np.minimum(wanted, 0.5 / (mobility * (PERIOD + late) ** 2))


@pytest.mark.parametrize("late", [0.0, 0.002])
def test_springs_draw_the_tips_to_their_places_on_the_target(late):
    """A target that has moved by 0.1 mm pulls each tip with its stiffness, and no more than the
    largest force."""
    bench = Bench(grip_stiffness=1500.0, joint_delay=late)
    assert_allclose(bench.springs, 0.0, atol=1e-12)
    way = np.array([3e-5, -8e-5, 4e-5])
    bench.state.target[:3] = way
    bench.run()
    # the pull away from the object takes at most half of the normal force
    normal = np.einsum("ni,ni->n", GRASP.normals, np.tile(way, (4, 1)))
    pushed = normal >= 0.0
    expected = stiffness(bench, 1500.0, late)[:, None] * way
    assert pushed.any()
    assert_allclose(bench.springs[pushed], expected[pushed], rtol=1e-9)
    bench.state.target[:3] = 1e3 * way
    bench.run()
    assert_allclose(np.linalg.norm(bench.springs[pushed], axis=1), 10.0, rtol=1e-9)


def test_a_spring_takes_at_most_half_of_a_normal_force():
    bench = Bench()
    bench.state.target[2] = 0.05  # away from the thumb
    before = bench.arrays["optimal"][:, 0].copy()
    bench.run()
    pull = np.einsum("ni,ni->n", bench.springs, GRASP.normals)
    assert (pull >= -0.5 * before - 1e-12).all()
    assert (pull < 0.0).any()


def test_damping_acts_on_the_speed_against_the_target():
    """Tips that move with the target feel nothing; tips at rest are drawn along with it."""
    bench = Bench(grip_stiffness=0.0, grip_damping=1.0)
    bench.state.target[7:10] = 0.01, 0.02, -0.01
    bench.run()
    normal = GRASP.normals @ bench.state.target[7:10]
    along = normal >= 0.0
    assert along.any()
    expected = np.tile(bench.state.target[7:10], (4, 1))
    assert_allclose(bench.springs[along], expected[along], rtol=1e-9)


def test_a_tip_that_rolls_is_not_drawn_back():
    """The link turns by 0.02 rad and its tip moves by radius times that: rolling without sliding."""
    bench = Bench(grip_damping=0.0)
    kinematics = bench.kinematics
    radius = kinematics.hand.fingertips[0].radius
    home = np.array(kinematics.home)
    frames, _ = kinematics.links(home)
    tips = kinematics.tips(home)
    link = int(kinematics.tip_links[0])
    rng = np.random.default_rng(0)
    for _ in range(20):
        angles = home.copy()
        angles[:3] += rng.uniform(-0.01, 0.01, 3)
        turned = Rotation.from_matrix(kinematics.links(angles)[0][link] @ frames[link].T)
        moved = kinematics.tips(angles)[0] - tips[0]
        rolled = radius * np.cross(GRASP.normals[0], turned.as_rotvec())
        # the object moves so that the tip has only rolled on it
        bench.state.angles = angles
        bench.state.object[:3] = bench.state.target[:3] = moved - rolled
        bench.run()
        # second order in the angle: 1500 N/m, 1 cm, 4e-4
        assert np.linalg.norm(bench.springs[0]) < 0.02 * 1500.0 * np.linalg.norm(rolled) + 1e-3
        bench.state.angles = home
        bench.state.object[:3] = bench.state.target[:3] = 0.0
        bench.run()


def test_what_springs_pull_for_long_stays_inside_the_margin():
    """The preload grows until forces and springs together use no more than the margin."""
    bench = Bench(preload=0.2)
    bench.state.target[:3] = 0.0, 3e-4, 0.0
    bench.run(300)
    assert (bench.arrays["preload"] >= 0.2 - 1e-12).all()
    assert (bench.arrays["preload"] > 0.3).any()
    assert (bench.used(bench.controller.force) <= 0.8 + 1e-6).all()
    optimal = bench.arrays["optimal"] - bench.arrays["preload"][:, None] * [1.0, 0.0, 0.0]
    assert (bench.used(optimal) <= 0.8 + 1e-9).all()
    assert GRASP.residual(bench.arrays["optimal"], bench.state.wrench) < 1e-8
    bench.state.target[:3] = 0.0
    bench.run(2000)
    assert_allclose(bench.arrays["preload"], 0.2, atol=1e-3)  # and falls again


def test_the_preload_of_a_finger_that_lands_grows():
    """100 N/s: 0.1 N in each update."""
    bench = Bench(preload=1.0, force_rate=100.0, grip_stiffness=0.0, grip_damping=0.0)
    assert_allclose(bench.arrays["preload"], 1.0)
    bench.state.touching[3] = 0.0
    bench.run(10)
    assert_allclose(bench.arrays["preload"], [1.0, 1.0, 1.0, 0.0])
    bench.state.touching[3] = 1.0
    for k in range(1, 15):
        bench.run()
        assert bench.arrays["preload"][3] == pytest.approx(min(1.0, 0.1 * k))
        assert bench.arrays["optimal"][3, 0] >= bench.arrays["preload"][3]
        assert bench.controller.status == "holding"


def test_less_than_the_margin_is_better_than_nothing():
    """Three fingers, and a small share of the friction: some wrenches need more than it, and are
    balanced inside the cones."""
    bench = Bench(friction_margin=0.4, grip_stiffness=0.0, grip_damping=0.0, force_rate=1e6)
    bench.state.touching[3] = 0.0
    bench.run(5)
    rng = np.random.default_rng(3)
    limits = {"holding": 0.4, "marginal": 1.0, "slipping": 0.4}
    seen = dict.fromkeys(limits, 0)
    for _ in range(60):
        bench.state.wrench[:] = rng.standard_normal(6) * np.repeat([0.1, 0.002], 3)
        bench.run(3)
        status = bench.controller.status
        force = bench.controller.force
        seen[status] += 1
        with np.errstate(invalid="ignore"):  # the free finger
            used = bench.used(force)
        assert_allclose(bench.controller.friction_used[:3], used[:3], atol=1e-12)
        assert used[:3].max() <= limits[status] + 1e-6
        balanced = GRASP.residual(force, bench.state.wrench) < 1e-6
        assert balanced == (status != "slipping")
        assert bench.controller.closure == balanced
    assert min(seen["holding"], seen["marginal"]) > 3, seen


def test_near_the_limit_of_balance_forces_stay_moderate():
    """Two fingers of one side and the thumb, and a wrench that they could balance with hundreds of
    newtons: the forces follow the load instead."""
    bench = Bench(grip_stiffness=0.0, grip_damping=0.0)
    bench.state.touching[:] = 1.0, 0.0, 0.0, 1.0
    bench.state.wrench[:] = 0.0
    bench.run(20)
    rng = np.random.default_rng(1)
    for _ in range(300):
        bench.state.wrench[:] = 0.05 * rng.standard_normal(6) * np.repeat([1.0, 0.05], 3)
        before = bench.controller.force[:, 0].sum()
        bench.run()
        load = (
            np.linalg.norm(bench.state.wrench[:3]) + np.linalg.norm(bench.state.wrench[3:]) / 0.03
        )
        total = bench.controller.force[:, 0].sum()
        assert total <= 5.0 * (before + load / (0.8 * FRICTION)) + 1.0


def test_springs_leave_the_motors_to_the_balanced_part():
    """Weak motors: with springs that take all they have, the forces still balance the wrench as
    well as without springs."""
    kinematics = kinematics_alone()
    plain = Bench(grip_stiffness=0.0, grip_damping=0.0)
    most = np.abs(plain.controller.torques).max()
    bench = Bench()
    bench.state.target[:3] = 0.0, 0.0, 0.1
    bench.run(5)
    limits = kinematics.torque_limits
    assert (np.abs(bench.controller.torques) <= limits + 1e-12).all()
    assert most < limits.min()
    assert GRASP.residual(bench.arrays["optimal"], bench.state.wrench) < 1e-7


def test_a_controller_is_configured_once():
    controller = core.HandController()
    for call in (lambda: controller.arrays(), lambda: controller.closure, lambda: controller.code):
        with pytest.raises(ValueError, match="configure the controller first"):
            call()
    bench = Bench()
    with pytest.raises(ValueError, match="make a new one"):
        bench.controller.configure(bench.kinematics.hand)
