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
    """Stiffness (N,) [N/m] of sampled springs: 0.5 / (mobility * time^2) at most; a delay counts one
    and a half times."""
    mobility, _ = bench.kinematics.mobility(bench.kinematics.home)
    return np.minimum(wanted, 0.5 / (mobility * (PERIOD + 1.5 * late) ** 2))


@pytest.mark.parametrize("late", [0.0, 0.002])
def test_springs_draw_the_tips_to_their_places_on_the_target(late):
    """A target that has moved by 0.1 mm pulls each tip with its stiffness, and no more than the
    largest force."""
    bench = Bench(grip_stiffness=1500.0, grip_force=0.5, joint_delay=late)
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
    assert_allclose(np.linalg.norm(bench.springs[pushed], axis=1), 0.5, rtol=1e-9)


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


def test_what_springs_pull_for_long_stays_inside_the_cones():
    """The preload grows until forces and springs together use no more than all of the friction."""
    bench = Bench(preload=0.2)
    bench.state.target[:3] = 0.0, 2e-4, 0.0
    bench.run(300)
    assert (bench.arrays["preload"] >= 0.2 - 1e-12).all()
    assert ((bench.arrays["preload"] > 0.3) & (bench.arrays["preload"] < 1.0)).any()
    assert (bench.used(bench.controller.force) <= 1.0 + 1e-6).all()
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


@pytest.mark.parametrize("moment", [0.0, 0.05])
def test_a_single_finger_does_not_stop_an_object_from_turning(moment):
    """It holds what pushes straight against it, alone."""
    bench = Bench()
    bench.state.touching[1:] = 0.0
    push = -2.0 * GRASP.normals[0]
    bench.state.wrench[:] = *push, *np.cross(GRASP.positions[0], push)
    bench.state.wrench[4] += moment
    bench.controller.activate(bench.state)
    bench.run(5)
    assert bench.controller.status == ("slipping" if moment else "holding")


def test_a_preload_counts_where_nothing_balances():
    """Forces with a preload are those of the load with it, besides it."""
    forces = []
    pushes = np.column_stack([GRASP.normals, np.cross(GRASP.positions, GRASP.normals)])
    for preload in (0.0, 0.7):
        bench = Bench(preload=preload, grip_stiffness=0.0, grip_damping=0.0)
        bench.state.touching[0] = 0.0  # three fingers of one side
        bench.state.wrench[:] = 0.1, -0.5, -0.3, 0.0, 0.01, 0.02
        if not preload:
            bench.state.wrench[:] += 0.7 * pushes[1:].sum(axis=0)
        bench.controller.activate(bench.state)
        bench.run(30)
        assert bench.controller.status == "slipping"
        forces.append(bench.controller.force[1:] - [preload, 0.0, 0.0])
    assert np.abs(forces[0]).max() > 1e-2
    # two solves to 1e-4
    assert_allclose(forces[1], forces[0], atol=1e-3 * np.abs(forces[0]).max())


@pytest.mark.parametrize("friction", [0.05, 0.1, 0.2])
def test_smooth_objects_get_the_normal_force_that_they_need(friction):
    """At once: the limit of moderate forces grows as the friction falls."""
    bench = Bench(friction=friction, grip_stiffness=0.0, grip_damping=0.0, force_rate=1e6)
    assert bench.controller.status == "holding"
    assert GRASP.residual(bench.controller.force, bench.state.wrench) < 1e-8
    # sides carry 2 N with a share of 0.8 of the friction
    assert bench.controller.force[:, 0].sum() >= 2.0 / (0.8 * friction) - 1e-6


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


def needed(bench: Bench) -> np.ndarray:
    """Normal force (N,) [N] with which the springs use all of the friction."""
    spring = bench.controller.force - bench.arrays["optimal"]
    return np.hypot(spring[:, 1], spring[:, 2]) / FRICTION - spring[:, 0]


def test_a_short_pull_hardly_raises_the_preload():
    """Springs are filtered within 0.03 s: an update counts as 1/31."""
    bench = Bench()
    bench.state.target[:3] = 0.0, 3e-4, 0.0
    bench.run()
    assert (needed(bench) > 0.3).any()
    # the same few sums and products
    expected = np.maximum(needed(bench), 0.0) * PERIOD / (PERIOD + 0.03)
    assert_allclose(bench.arrays["preload"], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("given", [0.1, 0.7, 2.0])
def test_a_preload_that_carries_the_springs_is_enough(given):
    """It is the larger of what is given and what the springs need, at most 1 N."""
    for way in (1.5e-4, 6e-4):
        bench = Bench(preload=given)
        bench.state.target[:3] = 0.0, way, 0.0
        bench.run(300)
        need = needed(bench)
        assert ((need > 0.3) & (need < 0.9)).all() if way < 3e-4 else (need > 1.1).all()
        # the springs settle within 1 s, the filter is 0.03 s behind: 3 % of them
        expected = np.maximum(given, np.minimum(need, 1.0))
        assert_allclose(bench.arrays["preload"], expected, rtol=0.04)


def test_a_finger_that_lands_has_forgotten_its_springs():
    bench = Bench(preload=0.1)
    bench.state.target[:3] = 0.0, 5e-4, 0.0
    bench.run(300)
    assert (bench.arrays["preload"] > 0.2).all()
    bench.state.touching[3] = 0.0
    bench.run(10)
    bench.state.target[:3] = 0.0
    bench.state.touching[3] = 1.0
    bench.run()
    assert bench.arrays["preload"][3] == pytest.approx(0.1)


def test_a_finger_without_contact_has_no_spring():
    """It still counts for two updates more."""
    bench = Bench()
    bench.state.target[:3] = 0.0, 3e-4, 0.0
    bench.run()
    assert np.linalg.norm(bench.springs, axis=1).min() > 0.1
    bench.state.touching[3] = 0.0
    bench.run()
    assert bench.controller.mask == 0b1111
    assert_allclose(bench.springs[3], 0.0, atol=1e-12)
    assert np.linalg.norm(bench.springs[:3], axis=1).min() > 0.1


def test_taking_hold_makes_places_of_where_the_tips_are():
    """The springs of an object that has moved against the hand are at rest again."""
    bench = Bench(grip_damping=0.0)
    bench.state.object[:3] = 0.0, 3e-4, 1e-4
    bench.state.target[:3] = 0.0, 6e-4, 2e-4
    bench.run()
    pulled = bench.springs
    assert np.linalg.norm(pulled, axis=1).min() > 0.1
    bench.state.target[:3] = bench.state.object[:3]
    bench.run()
    assert np.linalg.norm(bench.springs, axis=1).min() > 0.1
    bench.controller.take_hold()
    bench.run()
    assert_allclose(bench.springs, 0.0, atol=1e-9)


def test_a_pose_that_is_wrong_once_hardly_moves_the_places():
    """The object seems to be 0.5 m away for an update: places follow by 5 mm within 1 s, 5 um."""
    bench = Bench(grip_damping=0.0)
    for part in (bench.state.object, bench.state.target):
        part[:3] = 0.0, 0.3, -0.4
    bench.run()
    for part in (bench.state.object, bench.state.target):
        part[:3] = 0.0
    bench.run()
    pulls = np.linalg.norm(bench.springs, axis=1)
    # a thousandth of what is wrong has settled; others lose what pulls them from the object
    expected = stiffness(bench, 1500.0) * 5e-3 * PERIOD / (PERIOD + 1.0)
    assert (pulls <= expected * (1.0 + 1e-6)).all()
    assert pulls.max() > 0.99 * expected.min()


@pytest.mark.parametrize("angle", [0.0, 1.0])
def test_a_turned_target_pulls_the_tips_around_it(angle):
    """The object is turned by an angle as a whole, the target by 2 mrad more; a tip that turns
    against it would roll."""
    bench = Bench(grip_damping=0.0)
    whole = Rotation.from_rotvec([0.3 * angle, -angle, 0.6 * angle])
    bench.state.object[3:7] = bench.state.target[3:7] = whole.as_quat()
    bench.controller.activate(bench.state)
    bench.run()
    assert_allclose(bench.springs, 0.0, atol=1e-9)
    more = np.array([0.0, 1e-3, 2e-3])
    bench.state.target[3:7] = (Rotation.from_rotvec(more) * whole).as_quat()
    bench.run()
    tips = bench.kinematics.tips(bench.kinematics.home)
    radius = bench.kinematics.hand.fingertips[0].radius
    normals = whole.apply(GRASP.normals.copy())
    way = np.cross(more, tips) - radius * np.cross(normals, more)
    expected = whole.inv().apply(stiffness(bench, 1500.0)[:, None] * way)
    pushed = np.einsum("ni,ni->n", expected, GRASP.normals) > 0.0
    assert pushed.any()
    # second order in the angle: 1500 N/m, 0.2 m, 4e-6
    assert_allclose(bench.springs[pushed], expected[pushed], atol=2e-3)
    assert np.linalg.norm(expected[pushed], axis=1).max() > 0.1


def test_damping_acts_on_the_turning_of_the_target():
    bench = Bench(grip_stiffness=0.0, grip_damping=1.0)
    bench.state.target[10:13] = 0.1, -0.2, 0.3
    bench.run()
    expected = np.cross(bench.state.target[10:13], bench.kinematics.tips(bench.kinematics.home))
    pushed = np.einsum("ni,ni->n", expected, GRASP.normals) >= 0.0
    assert pushed.any()
    # sums and products of three numbers
    assert_allclose(bench.springs[pushed], expected[pushed], rtol=1e-9, atol=1e-12)


def test_contacts_that_come_and_go_leave_the_places_of_the_others():
    """Not all of them begin anew where an object is that has moved against the hand."""
    bench = Bench(grip_damping=0.0, force_rate=1e6)
    bench.state.object[:3] = 0.0, -3e-4, 0.0
    bench.state.target[:3] = 0.0, 3e-4, 0.0
    bench.run()
    before = bench.springs[:3]
    assert np.linalg.norm(before, axis=1).min() > 0.1
    for touching in (0.0, 1.0):
        bench.state.touching[3] = touching
        bench.run(5)
        # places settle within 1 s: 0.5 % in 5 updates
        assert_allclose(bench.springs[:3], before, rtol=0.012, atol=1e-9)
    assert bench.controller.changes == 2


@pytest.mark.parametrize("preload", [1.0, 2.0])
def test_a_finger_that_lands_does_not_shake_the_others(preload):
    """It begins with 0.13 N, its first preload and 0.01 N of friction. Forces change by 0.1 N in an
    update and by what balances those, with levers of up to three."""
    bench = Bench(preload=preload, force_rate=100.0, grip_stiffness=0.0, grip_damping=0.0)
    bench.state.touching[3] = 0.0
    bench.run(300)
    bench.state.touching[3] = 1.0
    for _ in range(30):
        before = bench.controller.force.copy()
        bench.run()
        assert np.abs(bench.controller.force - before).max() < 0.1 + 3.0 * 0.13
        assert bench.controller.status == "holding"


def test_a_controller_is_configured_once():
    controller = core.HandController()
    for call in (lambda: controller.arrays(), lambda: controller.closure, lambda: controller.code):
        with pytest.raises(ValueError, match="configure the controller first"):
            call()
    bench = Bench()
    with pytest.raises(ValueError, match="make a new one"):
        bench.controller.configure(bench.kinematics.hand)
