"""Springs of free fingers and joints, and what motors and cones leave of the springs and of slow
changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from held import (
    FAST,
    GRASP,
    HOME,
    JOINTS,
    KINEMATICS,
    NO_POSTURE,
    NO_SPRINGS,
    PERIOD,
    made,
    updated,
)
from numpy.testing import assert_allclose
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.control import HandController, HandControllerSettings
from grasp_env.sim import HandDescription, HandKinematics


@pytest.mark.parametrize("soft", [0.0, 0.03])
def test_springs_of_weak_motors_have_what_forces_leave(soft):
    """Motors that can just balance a load do so, whatever the springs want. The springs stay whole
    where other forces make room for them; else the motors limit them."""
    whole = cut = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        load = rng.standard_normal(6) * np.repeat([1.0, 0.03], 3) + [0, -2, 0, 0, 0, 0]
        target = rng.standard_normal(3) * rng.choice([2e-4, 3e-3])
        plain, state = made(torsional_friction=soft, **NO_SPRINGS)
        state.wrench[:] = load
        updated(plain, state, 30)
        assert plain.status == "holding"
        weak = 1.05 * np.abs(plain.torques).max()
        pulls, torques = [], []
        for limits in (None, weak * np.ones(JOINTS)):
            controller, state = made(limits, torsional_friction=soft, **NO_POSTURE)
            state.wrench[:] = load
            updated(controller, state, 30)
            state.target[:3] = target
            updated(controller, state, 3)
            assert controller.status == "holding"
            pulls.append(controller.force - controller.arrays()["optimal"])
            torques.append(np.abs(controller.torques).max())
        assert torques[1] <= weak * (1.0 + 1e-9)
        # sums of a dozen products
        if np.abs(pulls[1] - pulls[0]).max() < 1e-9:
            whole += torques[0] > weak
        else:
            cut += 1
    assert whole > 0
    assert cut > 10


def test_springs_of_overloaded_motors_never_push_back():
    """Springs shrink, some to zero, and never pull the other way."""
    left = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        target = 1e-3 * rng.standard_normal(3)
        weak = rng.uniform(0.02, 0.3, JOINTS)
        pulls = []
        for limits in (None, weak):
            controller, state = made(limits, **NO_POSTURE)
            updated(controller, state, 30)
            state.target[:3] = target
            updated(controller, state)
            pulls.append((controller.force - controller.arrays()["optimal"]).ravel())
        if controller.status == "overloaded":
            assert pulls[1] @ pulls[0] >= -1e-12
            left += not pulls[1].any()
    assert left > 3


def test_slow_forces_do_not_overload_motors_that_can_balance():
    """A force may change by 1 mN in an update. Where that would keep torques beyond their limits, it
    changes faster."""
    plain, state = made(**NO_SPRINGS)
    updated(plain, state, 50)
    limits = 1.2 * np.abs(plain.torques).max() * np.ones(JOINTS)
    faster = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        slow, state = made(limits, force_rate=1.0, **NO_SPRINGS)
        load = state.wrench.copy()
        updated(slow, state, 5)
        before = slow.force.copy()
        state.wrench[:] = load + rng.standard_normal(6) * np.repeat([1.0, 0.02], 3)
        updated(slow, state)
        fresh, _ = made(limits, **NO_SPRINGS)
        updated(fresh, state, 50)
        if fresh.status != "holding":
            continue
        assert slow.status == "holding"
        least = np.linalg.pinv(GRASP.matrix) @ (state.wrench - load)
        faster += np.abs(slow.force - before).max() > 1e-2 + np.abs(least).max()
    assert faster > 3


def posture_alone(
    hand: HandDescription, angles: np.ndarray, touching: np.ndarray, rates: np.ndarray | float = 0.0
) -> np.ndarray:
    """Torques (M,) of the springs of the posture: with them, less without."""
    out = []
    kinematics = HandKinematics(hand)
    for stiffness in (1e-3, 0.0):
        controller = HandController()
        options = {**FAST, **NO_SPRINGS, "posture_stiffness": stiffness, "reach_limit": 0.0}
        controller.configure(hand, HandControllerSettings(**options))
        state = controller.new_state()
        state.angles = np.array(hand.home)
        state.touching[:] = touching
        tips = kinematics.tips(state.angles)
        inward = np.mean(tips, axis=0) - tips
        state.normals[:] = inward / np.linalg.norm(inward, axis=1)[:, None]
        state.positions[:] = tips + 0.01 * state.normals
        controller.activate(state)
        state.angles = angles
        state.rates[:] = rates
        updated(controller, state, 2)
        out.append(controller.torques.copy())
    return out[0] - out[1]


def test_the_posture_of_touching_fingers_is_kept_without_rolling():
    """Joints move without moving the contact points: the springs of 1e-3 N m/rad draw them back, and
    30 times as stiff ones turn back the last links."""
    hand = HandDescription.allegro()
    kinematics = HandKinematics(hand)
    home = np.array(hand.home)
    tips = kinematics.tips(home)
    inward = np.mean(tips, axis=0) - tips
    touch = tips + 0.01 * inward / np.linalg.norm(inward, axis=1)[:, None]
    moves = np.concatenate([kinematics.jacobian(home, k, touch[k]) for k in range(4)])
    free = null_space(moves)
    assert free.shape == (16, 4)
    frames, _ = kinematics.links(home)
    for way in free.T:
        step = 1e-4 * way
        torques = posture_alone(hand, home + step, np.ones(4))
        turned, _ = kinematics.links(home + step)
        square = 0.0
        for link in kinematics.tip_links:
            turn = Rotation.from_matrix(turned[link] @ frames[link].T).as_rotvec()
            square += turn @ turn
        expected = -1e-3 * (step @ step + 30.0 * square)
        # the contact points move in second order
        assert step @ torques == pytest.approx(expected, rel=1e-2)
        assert_allclose(moves @ torques, 0.0, atol=1e-3 * np.abs(torques).max())


def test_joints_are_drawn_back_from_their_ends():
    """Within 0.2 rad of an end, 100 times as stiff as towards the home posture, and without moving
    the tips."""
    hand = HandDescription.allegro()
    kinematics = HandKinematics(hand)
    home = np.array(hand.home)
    lower, upper = np.array(kinematics.lower), np.array(kinematics.upper)
    angles = home.copy()
    angles[[1, 6]] = upper[1] - 0.05, lower[6] + 0.08
    room = np.minimum(0.2, 0.25 * (upper - lower))
    beyond = np.clip(angles, lower + room, upper - room) - angles
    assert np.count_nonzero(beyond) >= 2
    pull = 1e-3 * (home - angles + 100.0 * beyond)
    moves = np.concatenate([kinematics.jacobian(angles, k) for k in range(4)])
    free = null_space(moves)
    torques = posture_alone(hand, angles, np.zeros(4))
    # 1e-10 m^2 stands on the diagonal of the system, whose numbers are about 1e-3 m^2
    assert_allclose(torques, free @ (free.T @ pull), atol=1e-4 * np.abs(pull).max())


def test_a_home_posture_near_an_end_is_kept():
    """Fingers that need it would move others, whose links would touch the object."""
    hand = HandDescription.allegro()
    near = np.array(hand.home)
    near[[1, 6]] = hand.links[1].upper - 0.05, hand.links[6].lower + 0.08
    hand = replace(hand, home=tuple(near.tolist()))
    assert np.abs(posture_alone(hand, near, np.zeros(4))).max() < 1e-12
    # nearer to the end it is drawn back as far as home
    angles = near.copy()
    angles[1] += 0.03
    pull = np.zeros(16)
    pull[1] = -1e-3 * (1.0 + 100.0) * 0.03
    moves = np.concatenate([HandKinematics(hand).jacobian(angles, k) for k in range(4)])
    free = null_space(moves)
    torques = posture_alone(hand, angles, np.zeros(4))
    assert_allclose(torques, free @ (free.T @ pull), atol=1e-4 * np.abs(pull).max())


def test_a_wrist_is_kept_a_hundred_times_as_stiff():
    """A wrist that gives way moves every finger."""
    allegro = HandDescription.allegro()
    below = "palm"
    base = replace(
        allegro.links[0], name="wrist", joint="wrist_joint", parent=below, collision=(), visual=()
    )
    rest = [
        replace(link, parent="wrist" if link.parent == below else link.parent)
        for link in allegro.links
    ]
    hand = replace(allegro, links=(base, *rest), home=(0.0, *allegro.home))
    home = np.array(hand.home)
    away = home + np.array([0.01, *[0.0] * 16])
    kinematics = HandKinematics(hand)
    free = null_space(np.concatenate([kinematics.jacobian(away, k) for k in range(4)]))
    pull = np.zeros(17)
    pull[0] = -1e-3 * 100.0 * 0.01
    torques = posture_alone(hand, away, np.zeros(4))
    assert_allclose(torques, free @ (free.T @ pull), atol=1e-4 * np.abs(pull).max())


def test_free_joints_are_critically_damped():
    """Each by its own inertia, under springs of posture and rolling of 31e-3 N m/rad together,
    without moving the tips."""
    hand = HandDescription.allegro()
    kinematics = HandKinematics(hand)
    home = np.array(hand.home)
    rates = np.random.default_rng(0).standard_normal(16)
    inertia = 1.0 / kinematics.mobility(home)[1]
    assert (2.0 * np.sqrt(31e-3 * inertia) < inertia / PERIOD).all()
    free = null_space(np.concatenate([kinematics.jacobian(home, k) for k in range(4)]))
    pull = -2.0 * np.sqrt(31e-3 * inertia) * rates
    torques = posture_alone(hand, home, np.zeros(4), rates)
    # 1e-10 m^2 stands on the diagonal of the system, whose numbers are about 1e-3 m^2
    assert_allclose(torques, free @ (free.T @ pull), atol=1e-4 * np.abs(pull).max())


@pytest.mark.parametrize(("late", "heavy"), [(0.0, 1.0), (0.0, 10.0), (0.01, 1.0), (0.2, 10.0)])
def test_a_reaching_finger_is_critically_damped_as_far_as_delays_allow(late, heavy):
    """For tips of at least 30 g; the sampled damper stays below mass / time."""
    hand = KINEMATICS.hand
    links = [
        replace(link, mass=heavy * link.mass, inertia=tuple(heavy * np.array(link.inertia)))
        for link in hand.links
    ]
    hand = replace(hand, links=tuple(links))
    controller, state = made(hand=hand, joint_delay=late, reach_limit=1e3, **NO_POSTURE)
    updated(controller, state, 5)
    state.touching[0] = 0.0
    updated(controller, state, 5)
    own = KINEMATICS.carries[0]
    jacobian = KINEMATICS.jacobian(state.angles, 0)[:, own]
    before = controller.torques[own].copy()
    speed = np.array([1e-3, -2e-3, 3e-3])
    state.rates[own] = np.linalg.solve(jacobian, speed)
    updated(controller, state)
    force = np.linalg.solve(jacobian.T, controller.torques[own] - before)
    mass = 1.0 / HandKinematics(hand).mobility(HOME)[0][0]
    assert (mass > 0.03) == (heavy > 1.0)
    wanted = 2.0 * np.sqrt(60.0 * max(0.03, mass))
    stable = mass / (PERIOD + late)
    assert (stable < wanted) == (late > 0.0)
    # differences of torques of 1 N m, and sums of a dozen products
    assert_allclose(force, -min(wanted, stable) * speed, rtol=1e-6)


@pytest.mark.parametrize("way", [(0.0, 0.0, 0.0), (1e-3, -2e-3, 3e-3)])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.02, -0.01, 0.03)])
def test_fingers_that_hold_their_places_squeeze(way, turn):
    """Places are on the target, 12.5 mm behind tips that touch: 10 N of the 40 N each by 800
    N/m."""
    controller, state = made()
    tips = KINEMATICS.tips(HOME)
    state.positions[:] = tips + KINEMATICS.hand.fingertips[0].radius * GRASP.normals
    controller.activate(state)
    controller.hold = core.Hold.place
    rotation = Rotation.from_rotvec(turn)
    state.target[:3], state.target[3:7] = way, rotation.as_quat()
    updated(controller, state)
    places = rotation.apply(tips + 0.0125 * GRASP.normals) + way
    expected = np.zeros(JOINTS)
    for finger in range(4):
        force = 800.0 * (places - tips)[finger]
        expected += KINEMATICS.jacobian(HOME, finger).T @ force
    # sums of a dozen products
    assert_allclose(controller.torques, expected, atol=1e-9)


def test_goals_that_are_given_stay():
    """A finger that lands elsewhere still reaches for its goal; the others for where they landed."""
    _, state = made()
    controller = HandController()
    controller.configure(KINEMATICS.hand, HandControllerSettings(**FAST))
    goals = controller.arrays()["goals"]
    goals[1] = 0.01, 0.02, 0.03
    controller.arrays()["inwards"][1] = 0.0, 0.0, 1.0
    controller.activate(state)
    updated(controller, state, 5)
    expected = GRASP.positions.copy()
    expected[1] = 0.01, 0.02, 0.03
    np.testing.assert_array_equal(goals, expected)


@pytest.mark.parametrize("hold", [core.Hold.squeeze, core.Hold.place, core.Hold.direct])
def test_only_optimal_forces_have_springs_of_the_grip(hold):
    controller, state = made(**NO_POSTURE)
    state.target[:3] = 0.0, 3e-4, 0.0
    updated(controller, state)
    grip = controller.arrays()["optimal"]
    assert np.abs(controller.force - grip).max() > 0.1
    controller.hold = hold
    updated(controller, state)
    assert_allclose(controller.force, grip, atol=1e-12)
