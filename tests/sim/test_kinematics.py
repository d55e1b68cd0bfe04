"""Kinematics and dynamics against PyBullet; inverse kinematics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from engines import HAND_FLAGS, Client, bullet, joint_indices, needs_bullet
from hands import gripper, load_hand, mass_matrix
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.description import HANDS, FingerDescription, HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics

CROOKED = Path(__file__).parent / "assets" / "crooked_hand.urdf"
CROOKED_TIPS = ("pad_a", "finger_b_end", "finger_c_end")
ENDLESS = {"b_root": (-np.inf, np.inf)}
NOMINAL = np.array(
    [(0.0, 0.0, -0.06), (0.0, 0.03, 0.06), (-0.03, -0.02, 0.06), (0.03, -0.02, 0.06)]
)
GRAVITY = np.array([1.0, -9.0, 2.0])


def turned() -> HandDescription:
    """Return a hand with an oblique finger of four joints and an upright one of three."""
    skew = FingerDescription(
        "skew",
        (0.2, 0.1, 0.0),
        (2 / 3, 2 / 3, 1 / 3),
        (-2 / 3, 1 / 3, 2 / 3),
        link_lengths=(0.02, 0.09, 0.03, 0.05),
        link_masses=(0.05, 0.01, 0.04, 0.03),
        joint_lower=(-1, -1, -1, -1),
        joint_upper=(1, 2, 2, 2),
        home=(0, 0, 0.5, 0.5),
    )
    return HandDescription.of_fingers(
        [skew, FingerDescription("up", (0, 0.1, 0.2), (1, 0, 0), (0, 0, 1))]
    )


def crooked() -> HandDescription:
    return HandDescription.from_urdf(CROOKED, CROOKED_TIPS, joint_limits=ENDLESS)


MAKERS: dict[str, Callable[[], HandDescription]] = {
    "turned": turned,
    "crooked": crooked,
    "leap": HANDS["leap"],
}


@needs_bullet
@pytest.mark.parametrize("name", [*MAKERS, "original"])
def test_kinematics_and_dynamics_match_pybullet(name):
    """PyBullet loads hands that we write, and the original of a user's file with fixed joints."""
    client = Client()
    hand = crooked() if name == "original" else MAKERS[name]()
    number = client.number
    kinematics = HandKinematics(hand)
    zero = [0.0] * hand.joint_count
    if name == "original":
        body = bullet.loadURDF(
            str(CROOKED), useFixedBase=True, flags=HAND_FLAGS, physicsClientId=number
        )
    else:
        body = load_hand(number, hand)
    indices = joint_indices(number, body, hand)
    angles = np.random.default_rng(3).uniform(-0.6, 1.1, hand.joint_count)
    # PyBullet's dynamics number the moving joints only, in the order of their indices; arrays make
    # it crash
    columns = [sorted(indices).index(index) for index in indices]
    given = angles[np.argsort(columns)].tolist()
    frames, origins = kinematics.links(angles)
    for link, index in enumerate(indices):
        bullet.resetJointState(body, index, float(angles[link]), physicsClientId=number)
    for link, index in enumerate(indices):
        state = bullet.getLinkState(body, index, computeForwardKinematics=1, physicsClientId=number)
        # getLinkState rounds to single precision; the Jacobians below do not
        assert_allclose(origins[link], state[4], atol=3e-8)
        rotation = np.array(bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        assert_allclose(frames[link], rotation, atol=1e-6)
    for finger, link in enumerate(kinematics.tip_links.tolist()):
        # PyBullet measures the point from the link's origin along the principal axes of its inertia
        turn = bullet.getDynamicsInfo(body, indices[link], physicsClientId=number)[4]
        axes = np.array(bullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
        place = (axes.T @ hand.fingertips[finger].center).tolist()
        theirs, _ = bullet.calculateJacobian(body, indices[link], place, given, zero, zero, number)
        assert_allclose(
            np.array(theirs)[:, columns], kinematics.jacobian(angles, finger), atol=1e-12
        )
    bullet.setGravity(*GRAVITY, physicsClientId=number)
    theirs = bullet.calculateInverseDynamics(body, given, zero, zero, physicsClientId=number)
    assert_allclose(
        kinematics.gravity_torques(angles, GRAVITY), np.array(theirs)[columns], atol=1e-12
    )
    tips = kinematics.tips(angles)
    jacobian, weight = kinematics.statics(angles, tips, GRAVITY)
    assert_array_equal(
        jacobian, [kinematics.jacobian(angles, finger) for finger in range(len(tips))]
    )
    assert_array_equal(weight, kinematics.gravity_torques(angles, GRAVITY))
    total = mass_matrix(kinematics, angles)
    assert_allclose(kinematics.mass_matrix(angles), total, atol=1e-15)
    theirs = np.array(bullet.calculateMassMatrix(body, given, physicsClientId=number))
    # PyBullet finds principal axes to about 1e-8 of the inertia
    assert_allclose(theirs[np.ix_(columns, columns)], total, atol=1e-11)
    client.close()


def test_coupled_joints_add_to_their_drivers():
    """The oracle is the same hand without couplings; E holds the slopes of its angles, in the
    angles of the drivers."""
    hand = gripper(3, 3, coupled=True)
    links = [
        replace(link, mimic=link.mimic and replace(link.mimic, ratio=0.7, offset=0.1))
        for link in hand.links
    ]
    one, free = (
        HandKinematics(replace(hand, links=tuple(some)))
        for some in (links, [replace(link, mimic=None) for link in links])
    )
    angles = one.coupled(np.random.default_rng(3).uniform(-0.6, 1.1, hand.joint_count))
    ends = (
        np.array([one.coupled(angles + shift) for shift in np.eye(len(angles))]).T - angles[:, None]
    )
    near = {"rtol": 0, "atol": 1e-12}
    assert_allclose(one.mass_matrix(angles), ends.T @ free.mass_matrix(angles) @ ends, **near)
    assert_allclose(
        one.gravity_torques(angles, GRAVITY), free.gravity_torques(angles, GRAVITY) @ ends, **near
    )
    for finger in range(3):
        assert_allclose(one.jacobian(angles, finger), free.jacobian(angles, finger) @ ends, **near)


def test_mobility_is_the_largest_acceleration():
    """For joints under springs it is a bound."""
    kinematics = HandKinematics(turned())
    tips, joints = kinematics.mobility(kinematics.home)
    mass = kinematics.mass_matrix(kinematics.home)
    for finger, most in enumerate(tips):
        jacobian = kinematics.jacobian(kinematics.home, finger)
        assert most == pytest.approx(
            np.linalg.norm(jacobian @ np.linalg.solve(mass, jacobian.T), 2)
        )
    assert np.linalg.eigvalsh(np.diag(1.0 / joints) - mass).max() <= 1e-12


def test_mobility_is_that_of_the_motors_where_joints_are_coupled():
    kinematics = HandKinematics(gripper(3, 3, coupled=True))
    home = kinematics.home
    motors = [joint for joint in range(9) if joint % 3 < 2]
    tips, joints = kinematics.mobility(home)
    mass = kinematics.mass_matrix(home)[np.ix_(motors, motors)]
    for finger, most in enumerate(tips):
        jacobian = kinematics.jacobian(home, finger)[:, motors]
        assert most == pytest.approx(
            np.linalg.norm(jacobian @ np.linalg.solve(mass, jacobian.T), 2)
        )
    assert not joints[2::3].any()
    assert np.linalg.eigvalsh(np.diag(1.0 / joints[motors]) - mass).max() <= 1e-12


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_solve_comes_back_to_reachable_tips(make):
    kinematics = HandKinematics(make())
    rng = np.random.default_rng(0)
    lower = np.maximum(kinematics.lower, -math.pi)
    upper = np.minimum(kinematics.upper, math.pi)
    for _ in range(30):
        tips = kinematics.tips(rng.uniform(lower, upper))
        assert kinematics.reachable(tips)
        angles = kinematics.solve(tips)
        assert np.linalg.norm(kinematics.tips(angles) - tips, axis=1).max() < 1e-9
        assert (np.clip(angles, kinematics.lower, kinematics.upper) == angles).all()
        assert np.array_equal(angles, kinematics.solve(tips))


def test_solve_starts_where_it_is_told_and_stays_near():
    kinematics = HandKinematics(HandDescription.four_finger_4dof())
    start = kinematics.solve(NOMINAL)
    moved = kinematics.solve(NOMINAL + np.array([0.0, 0.001, 0.0]), start)
    assert np.abs(moved - start).max() < 0.03
    assert np.abs(start - kinematics.home).max() < 1.0
    assert np.array_equal(kinematics.solve(NOMINAL, start), start)
    # joints that move no fingertip stay
    kinematics = HandKinematics(
        HandDescription.from_urdf(CROOKED, ("finger_c_end",), joint_limits=ENDLESS)
    )
    own = kinematics.carries[0]
    angles = kinematics.solve(kinematics.tips(kinematics.home + 0.1 * own))
    assert own.sum() == 3
    assert_array_equal(angles[~own], kinematics.home[~own])


OUT_OF_REACH = [
    (2, (-0.03, -0.2, 0.06), r"'left' cannot reach.*it is 0\.3367 m.*up to 0\.1850 m; move the"),
    # on the second joint: the knee would have to fold beyond itself
    (1, (0.0, 0.1, 0.105), r"'middle' cannot reach.*nearest its tip comes is 0\.0413 m"),
    (
        0,
        (0.13, 0.13, -0.08),
        r"'thumb' reaches .* only beyond its joint limits: thumb_knuckle_joint = 1\.532 rad, allowed are -1\.000",
    ),
]


@pytest.mark.parametrize(("finger", "tip", "message"), OUT_OF_REACH)
def test_tips_out_of_reach_are_refused(finger, tip, message):
    kinematics = HandKinematics(HandDescription.four_finger())
    tips = NOMINAL.copy()
    tips[finger] = tip
    with pytest.raises(InvalidInputError, match=message):
        kinematics.solve(tips)
    assert not kinematics.reachable(tips)


def test_fingers_that_share_a_joint():
    kinematics = HandKinematics(crooked())
    first = kinematics.home.copy()
    second = kinematics.home.copy()
    fold = kinematics.hand.joint_names.index("palm_fold")
    first[fold], second[fold] = -0.5, 0.8
    tips = kinematics.tips(first)
    tips[1] = kinematics.tips(second)[1]
    with pytest.raises(
        InvalidInputError, match=r"'pad_a' reaches .* together with .* only beyond .*: b_curl ="
    ):
        kinematics.solve(tips)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda k: k.solve(NOMINAL), r"tips must have shape \(3, 3\)"),
        (lambda k: k.jacobian(k.home, 3), "finger"),
        (lambda k: k.export("/nowhere/a.hand"), "hand file /nowhere/a.hand: No such file"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(InvalidInputError, match=message):
        call(HandKinematics(HandDescription.three_finger()))
