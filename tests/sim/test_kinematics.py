"""Kinematics against PyBullet's own and against finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from engines import HAND_FLAGS, Client, bullet, joint_indices, needs_bullet
from hands import load_hand, mass_matrix

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.description import HANDS, FingerDescription, HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics

CROOKED = Path(__file__).parent / "assets" / "crooked_hand.urdf"
CROOKED_TIPS = ("pad_a", "finger_b_end", "finger_c_end")
ENDLESS = {"b_root": (-np.inf, np.inf)}
NOMINAL = np.array([(0.0, 0.0, -0.06), (0.0, 0.03, 0.06), (-0.03, -0.02, 0.06), (0.03, -0.02, 0.06)])
GRAVITY = np.array([1.0, -9.0, 2.0])


def turned() -> HandDescription:
    """Fingers in all directions, one of them with four joints."""
    return HandDescription.of_fingers(
        [
            FingerDescription("skew", (0.2, 0.1, 0.0), (2 / 3, 2 / 3, 1 / 3), (-2 / 3, 1 / 3, 2 / 3)),
            FingerDescription(
                "up", (0.0, 0.1, 0.2), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0),
                link_lengths=(0.02, 0.09, 0.03, 0.05), link_masses=(0.05, 0.01, 0.04, 0.03),
                joint_lower=(-1, -1, -1, -1), joint_upper=(1, 2, 2, 2), home=(0, 0, 0.5, 0.5),
            ),
            FingerDescription("down", (0.0, 0.1, -0.2), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), tip_mass=0.03),
        ]
    )  # fmt: skip


def crooked() -> HandDescription:
    return HandDescription.from_urdf(CROOKED, CROOKED_TIPS, joint_limits=ENDLESS)


MAKERS: dict[str, Callable[[], HandDescription]] = {"turned": turned, "crooked": crooked, **HANDS}


class Loaded:
    """A hand in PyBullet beside its compiled twin, both at the same random angles."""

    def __init__(self, hand: HandDescription, original: Path | None = None) -> None:
        self.client, self.hand, self.kinematics = Client(), hand, HandKinematics(hand)
        self.number, self.count = self.client.number, hand.joint_count
        if original is None:
            self.body = load_hand(self.number, hand)
        else:
            self.body = bullet.loadURDF(str(original), useFixedBase=True, flags=HAND_FLAGS, physicsClientId=self.number)
        self.indices = joint_indices(self.number, self.body, hand)
        # PyBullet's dynamics number the moving joints only, in the order of their indices
        self.columns = [sorted(self.indices).index(index) for index in self.indices]
        self.angles = np.random.default_rng(3).uniform(-0.6, 1.1, self.count)
        for index, angle in zip(self.indices, self.angles.tolist(), strict=True):
            bullet.resetJointState(self.body, index, angle, physicsClientId=self.number)
        self.frames, self.origins = self.kinematics.links(self.angles)
        self.axes = np.array([frame @ link.axis for frame, link in zip(self.frames, hand.links, strict=True)])

    def theirs(self) -> list[float]:
        """The angles in PyBullet's order, as a list: arrays make it crash."""
        angles = np.empty(self.count)
        angles[self.columns] = self.angles
        return angles.tolist()

    def jacobian(self, link: int, point: np.ndarray) -> np.ndarray:
        return self.kinematics.link_jacobian(self.angles, link, point)


@pytest.fixture(params=[*MAKERS, "original"])
def loaded(request: pytest.FixtureRequest) -> Iterator[Loaded]:
    original = request.param == "original"
    made = Loaded(crooked(), CROOKED) if original else Loaded(MAKERS[request.param]())
    yield made
    made.client.close()


@needs_bullet
def test_positions_and_jacobians_match_pybullet(loaded: Loaded) -> None:
    zero, kinematics, number = [0.0] * loaded.count, loaded.kinematics, loaded.number
    for link, index in enumerate(loaded.indices):
        state = bullet.getLinkState(loaded.body, index, computeForwardKinematics=1, physicsClientId=number)
        # getLinkState rounds to single precision; the Jacobians below do not
        np.testing.assert_allclose(loaded.origins[link], state[4], atol=3e-8)
        rotation = np.array(bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        np.testing.assert_allclose(loaded.frames[link], rotation, atol=1e-6)
    tips = kinematics.tips(loaded.angles)
    for finger, link in enumerate(kinematics.tip_links.tolist()):
        np.testing.assert_array_equal(kinematics.jacobian(loaded.angles, finger), loaded.jacobian(link, tips[finger]))
        index = loaded.indices[link]
        # PyBullet measures the point from the link's origin along the principal axes of its inertia
        turn = bullet.getDynamicsInfo(loaded.body, index, physicsClientId=number)[4]
        axes = np.array(bullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
        center = loaded.hand.fingertips[finger].center
        for local, point in (((0.0, 0.0, 0.0), loaded.origins[link]), (center, tips[finger])):
            place = (axes.T @ local).tolist()
            theirs, _ = bullet.calculateJacobian(loaded.body, index, place, loaded.theirs(), zero, zero, number)
            np.testing.assert_allclose(np.array(theirs)[:, loaded.columns], loaded.jacobian(link, point), atol=1e-12)


@pytest.mark.parametrize("maker", MAKERS.values(), ids=MAKERS)
def test_jacobians_and_gravity_torques_match_finite_differences(maker: Callable[[], HandDescription]) -> None:
    kinematics, step = HandKinematics(maker()), 1e-6
    hand, angles = kinematics.hand, np.random.default_rng(3).uniform(-0.6, 1.1, kinematics.hand.joint_count)
    masses, inside = (np.array([getattr(link, name) for link in hand.links]) for name in ("mass", "center"))

    def seen(angles: np.ndarray) -> np.ndarray:
        """The tips' places, then the height of all links."""
        frames, origins = kinematics.links(angles)
        height = -masses @ (origins + (frames @ inside[:, :, None])[:, :, 0]) @ GRAVITY
        return np.append(kinematics.tips(angles), height)

    slopes = np.array([seen(angles + shift) - seen(angles - shift) for shift in step * np.eye(len(angles))]) / (
        2 * step
    )
    ours = np.vstack([kinematics.jacobian(angles, finger) for finger in range(hand.finger_count)])
    np.testing.assert_allclose(slopes[:, :-1].T, ours, atol=1e-9)
    np.testing.assert_allclose(slopes[:, -1], kinematics.gravity_torques(angles, GRAVITY), atol=1e-9)


@needs_bullet
def test_gravity_torques_and_inertias_match_pybullet(loaded: Loaded) -> None:
    """The mass matrix: inertias, and what fixed joints merge, mean the same to PyBullet."""
    torques, zero = loaded.kinematics.gravity_torques(loaded.angles, GRAVITY), [0.0] * loaded.count
    bullet.setGravity(*GRAVITY, physicsClientId=loaded.number)
    theirs = bullet.calculateInverseDynamics(loaded.body, loaded.theirs(), zero, zero, physicsClientId=loaded.number)
    np.testing.assert_allclose(torques, np.array(theirs)[loaded.columns], atol=1e-12)
    total = mass_matrix(loaded.kinematics, loaded.angles)
    np.testing.assert_allclose(loaded.kinematics.mass_matrix(loaded.angles), total, atol=1e-15)
    theirs = np.array(bullet.calculateMassMatrix(loaded.body, loaded.theirs(), physicsClientId=loaded.number))
    # PyBullet finds principal axes to about 1e-8 of the inertia
    np.testing.assert_allclose(theirs[np.ix_(loaded.columns, loaded.columns)], total, atol=1e-11)


@pytest.mark.parametrize("maker", MAKERS.values(), ids=MAKERS)
def test_solve_comes_back_to_reachable_tips(maker: Callable[[], HandDescription]) -> None:
    kinematics, rng = HandKinematics(maker()), np.random.default_rng(0)
    lower, upper = np.maximum(kinematics.lower, -math.pi), np.minimum(kinematics.upper, math.pi)
    for _ in range(50):
        tips = kinematics.tips(rng.uniform(lower, upper))
        assert kinematics.reachable(tips)
        angles = kinematics.solve(tips)
        assert np.linalg.norm(kinematics.tips(angles) - tips, axis=1).max() < 1e-9
        assert (angles >= kinematics.lower).all()
        assert (angles <= kinematics.upper).all()
        assert np.array_equal(angles, kinematics.solve(tips))


def test_solve_matches_the_closed_form_of_three_joints() -> None:
    hand = HandDescription.four_finger()
    kinematics = HandKinematics(hand)
    angles = kinematics.solve(NOMINAL)
    for finger, (tip, thumb) in enumerate(zip(NOMINAL, (True, False, False, False), strict=True)):
        base = np.array(hand.links[3 * finger].origin)
        side = (tip - base) * ((1, -1, 1) if thumb else (-1, -1, -1))  # sideways, down, towards the object
        down = math.hypot(side[0], side[1]) - 0.035
        cosine = (down**2 + side[2] ** 2 - 0.08**2 - 0.07**2) / (2 * 0.08 * 0.07)
        knee = math.acos(cosine)
        bend = math.atan2(side[2], down) - math.atan2(0.07 * math.sin(knee), 0.08 + 0.07 * cosine)
        expected = [math.atan2(side[0], side[1]), bend, knee]
        np.testing.assert_allclose(angles[3 * finger : 3 * finger + 3], expected, atol=1e-12)


def test_solve_starts_where_it_is_told_and_stays_near() -> None:
    kinematics = HandKinematics(HandDescription.four_finger_4dof())
    start = kinematics.solve(NOMINAL)
    moved = kinematics.solve(NOMINAL + np.array([0.0, 0.001, 0.0]), start)
    assert np.abs(moved - start).max() < 0.03
    assert np.abs(start - kinematics.home).max() < 1.0
    assert np.array_equal(kinematics.solve(NOMINAL, start), start)


def test_joints_that_move_no_fingertip_stay() -> None:
    hand = HandDescription.from_urdf(CROOKED, ("finger_c_end",), joint_limits=ENDLESS)
    kinematics = HandKinematics(hand)
    aim = kinematics.home.copy()
    aim[kinematics.carries[0]] += 0.1
    angles = kinematics.solve(kinematics.tips(aim))
    idle = ~kinematics.carries[0]
    assert idle.sum() == 6
    np.testing.assert_array_equal(angles[idle], kinematics.home[idle])


@pytest.mark.parametrize(
    ("finger", "tip", "message"),
    [
        (2, (-0.03, -0.2, 0.06), r"'left' cannot reach.*it is 0\.3367 m.*up to 0\.1850 m; move the"),
        # on the second joint: the knee would have to fold beyond itself
        (1, (0.0, 0.1, 0.105), r"'middle' cannot reach.*nearest its tip comes is 0\.0413 m"),
        (
            0,
            (0.13, 0.13, -0.08),
            r"'thumb' reaches .* only beyond its joint limits: thumb_knuckle_joint = 1\.532 rad, allowed are -1\.000",
        ),
    ],
)
def test_what_cannot_be_reached_names_finger_and_reason(finger: int, tip: tuple[float, ...], message: str) -> None:
    kinematics, tips = HandKinematics(HandDescription.four_finger()), NOMINAL.copy()
    tips[finger] = tip
    with pytest.raises(InvalidInputError, match=message):
        kinematics.solve(tips)
    assert not kinematics.reachable(tips)


def test_fingers_that_share_a_joint_are_refused_together() -> None:
    kinematics = HandKinematics(crooked())
    first, second = kinematics.home.copy(), kinematics.home.copy()
    fold = kinematics.hand.joint_names.index("palm_fold")
    first[fold], second[fold] = -0.5, 0.8
    tips = kinematics.tips(first)
    tips[1] = kinematics.tips(second)[1]
    with pytest.raises(InvalidInputError, match=r"'pad_a' reaches .* together with .* only beyond .*: b_curl ="):
        kinematics.solve(tips)


def test_wrong_arrays_are_refused() -> None:
    kinematics = HandKinematics(HandDescription.three_finger())
    with pytest.raises(InvalidInputError, match=r"tips must have shape \(3, 3\)"):
        kinematics.solve(NOMINAL)
    with pytest.raises(InvalidInputError, match="angles must be finite"):
        kinematics.tips(np.full(9, np.nan))
    with pytest.raises(InvalidInputError, match="start must have shape"):
        kinematics.reachable(NOMINAL[:3], start=np.zeros(3))
