"""Descriptions of hands: what they refuse, and what the built-in ones can do."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from engines import Client, bullet, joint_indices, needs_bullet
from hands import links_of_indices, load_hand

from grasp_env.errors import GraspError, SimulationError
from grasp_env.sim.hand.description import HANDS, FingerDescription, Fingertip, Geometry, HandDescription, Link, Palm
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.limbs import touching_pairs

# where the fingers press on the faces of a cuboid at z = -side / 2 (the thumb) and z = side / 2 [m]
FRONT = {
    "three_finger": [(-0.025, 0.0), (0.025, 0.0)],
    "four_finger": [(0.0, 0.03), (-0.03, -0.02), (0.03, -0.02)],
    "four_finger_4dof": [(0.0, 0.03), (-0.03, -0.02), (0.03, -0.02)],
    "five_finger": [(-0.0125, 0.025), (0.0125, 0.025), (-0.028, -0.01), (0.028, -0.01)],
}
OBJECT_SIDES = (0.07, 0.1, 0.12)


def tips_on_cuboid(name: str, side: float) -> np.ndarray:
    """Centres of tips that rest on a cuboid at the origin, (N, 3)."""
    away = 0.5 * side + 0.01
    return np.array([(0.0, 0.0, -away), *((x, y, away) for x, y in FRONT[name])])


OF_FINGERS = sorted(name for name, make in HANDS.items() if make().placed)
"""Hands that stand around an object at the origin; the others have no place of their own."""


class Posed:
    """A built-in hand in PyBullet."""

    def __init__(self, hand: HandDescription) -> None:
        self.hand, self.kinematics, self.client = hand, HandKinematics(hand), Client()
        self.number = self.client.number
        self.body = load_hand(self.number, hand)
        self.indices = joint_indices(self.number, self.body, hand)
        self.names = [link.name for link in hand.links] + ["palm"]

    def pose(self, angles: np.ndarray) -> None:
        for index, angle in zip(self.indices, angles.tolist(), strict=True):
            bullet.resetJointState(self.body, index, angle, physicsClientId=self.number)

    def collisions(self) -> set[tuple[str, str]]:
        """Names of the links that overlap, as the running simulation would find them."""
        bullet.performCollisionDetection(physicsClientId=self.number)
        links = links_of_indices(self.indices)
        rows = bullet.getContactPoints(self.body, self.body, physicsClientId=self.number)
        pairs = [(self.names[links[row[3]]], self.names[links[row[4]]]) for row in rows if row[8] < 0.0]
        return {(min(pair), max(pair)) for pair in pairs}

    def distance(self, other: int, link: int, other_link: int = -1) -> float:
        """Between one of our links and a link of a body [m], 0.05 where it is more."""
        rows = bullet.getClosestPoints(
            self.body, other, 0.05, linkIndexA=self.indices[link], linkIndexB=other_link, physicsClientId=self.number
        )
        return min((row[8] for row in rows), default=0.05)


@pytest.fixture(params=OF_FINGERS)
def posed(request: pytest.FixtureRequest) -> Iterator[Posed]:
    made = Posed(HANDS[request.param]())
    yield made
    made.client.close()


@pytest.mark.parametrize(
    ("name", "fingers", "joints", "torque"),
    [
        ("four_finger", 4, 12, 12.0), ("three_finger", 3, 9, 12.0), ("five_finger", 5, 15, 12.0), ("four_finger_4dof", 4, 16, 12.0),
        ("allegro", 4, 16, 0.7), ("leap", 4, 16, 0.95),
    ],
)  # fmt: skip
def test_built_in_hands(name: str, fingers: int, joints: int, torque: float) -> None:
    hand = HANDS[name]()
    assert (hand.name, hand.finger_count, hand.joint_count) == (name, fingers, joints)
    assert hand.torque_limits.tolist() == [torque] * joints
    assert len(set(hand.joint_names)) == joints
    assert hand == HANDS[name]() == pickle.loads(pickle.dumps(hand))
    assert hash(hand) == hash(HANDS[name]())


def test_real_hands_have_their_published_measures() -> None:
    """Straight middle fingers along z; the links of a finger overlap only their neighbours."""
    straight = {"allegro": (0.0, 0.0, 0.1362), "leap": (0.0019, -0.0149, 0.1284)}
    for name, tip in straight.items():
        hand = HANDS[name]()
        assert not hand.placed
        assert hand.finger_names == ("index", "middle", "ring", "thumb")
        np.testing.assert_allclose(HandKinematics(hand).tips(np.zeros(16))[1], tip, atol=1e-9)
        assert touching_pairs(hand, at_home=False) == ()
        heaviest = max(link.mass for link in hand.links)
        assert 0.04 < heaviest < 0.07
        assert 0.45 < sum(link.mass for link in hand.links) < 0.65


@needs_bullet
@pytest.mark.parametrize("side", OBJECT_SIDES)
def test_links_clear_one_another_and_the_object(posed: Posed, side: float) -> None:
    kinematics, tips = posed.kinematics, tips_on_cuboid(posed.hand.name, side)
    angles = kinematics.solve(tips)
    assert np.minimum(angles - kinematics.lower, kinematics.upper - angles).min() > 0.4
    for finger in range(len(tips)):  # far from singular
        jacobian = kinematics.jacobian(angles, finger)
        assert side != 0.1 or np.linalg.cond(jacobian[:, kinematics.carries[finger]]) < 4.5
    posed.pose(angles)
    assert posed.collisions() == set()
    halves = [0.5 * side] * 3
    shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=halves, physicsClientId=posed.number)
    box = bullet.createMultiBody(0.2, shape, physicsClientId=posed.number)
    tip_links = kinematics.tip_links.tolist()
    frames, origins = kinematics.links(angles)
    for link in tip_links:  # only the tip of a distal link is near the object
        capsule = next(shape for shape in posed.hand.links[link].collision if shape.kind == "capsule")
        along = np.linspace(-0.5, 0.5, 41) * capsule.size[1] + capsule.origin[0]
        outside = np.maximum(np.abs(origins[link] + np.outer(along, frames[link][:, 0])) - 0.5 * side, 0.0)
        assert np.linalg.norm(outside, axis=1).min() > capsule.size[0] + 0.007
    for link in range(posed.hand.joint_count):
        gap = posed.distance(box, link)
        assert abs(gap) < 1e-6 if link in tip_links else gap > 0.03, (link, gap)
        for other in range(link):
            finger, other_finger = kinematics.carries[:, link].argmax(), kinematics.carries[:, other].argmax()
            if finger != other_finger:
                assert posed.distance(posed.body, link, posed.indices[other]) > 0.004
    with pytest.raises(SimulationError, match="lacks the joints thumb_knuckle_joint"):
        joint_indices(posed.number, box, posed.hand)


@needs_bullet
def test_a_finger_meets_itself_nowhere_and_the_palm_only_with_its_folded_tip(posed: Posed) -> None:
    rng, hand, (lower, upper) = np.random.default_rng(5), posed.hand, (posed.kinematics.lower, posed.kinematics.upper)
    posed.pose(posed.kinematics.home)
    assert posed.collisions() == set()
    for trial in range(400):
        own = posed.kinematics.carries[trial % hand.finger_count]
        angles = np.where(own, rng.uniform(lower, upper), posed.kinematics.home)
        posed.pose(angles)
        for first, second in posed.collisions():
            fingers = {name.split("_")[0] for name in (first, second)}
            if len(fingers) == 1:
                pytest.fail(f"{first} meets {second} at {angles.tolist()}")
            if "palm" in fingers:
                assert "distal" in first + second


def test_a_moved_hand_moves_as_a_whole() -> None:
    hand = HandDescription.five_finger()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = hand.moved((0.1, 0.2, 0.3), (0.0, 0.0, np.pi / 2))
    expected = HandKinematics(hand).tips(hand.home) @ turn.T + (0.1, 0.2, 0.3)
    np.testing.assert_allclose(HandKinematics(moved).tips(hand.home), expected, atol=1e-15)
    np.testing.assert_allclose(moved.palm.collision[0].origin, (0.1 - 0.145, 0.2, 0.3), atol=1e-15)
    assert hand.moved((0.0, 0.0, 0.0)) == hand


def link(name: str = "a", parent: str = "palm", **changes: Any) -> Link:
    fields: dict[str, Any] = {
        "origin": (0, 0, 0), "rotation": (0, 0, 0), "axis": (0, 0, 1), "lower": -1, "upper": 1, "torque_limit": 2, "mass": 0.1,
        "center": (0, 0, 0), "inertia": (1e-5, 0, 0, 1e-5, 0, 1e-5),
    }  # fmt: skip
    return Link(name, parent, **(fields | changes))


TIP = Fingertip("a", "a", (0, 0, 0), 0.01)


def hand(links: Any, tips: Any = (TIP,), **fields: Any) -> HandDescription:
    return HandDescription("test", Palm(), links, tips, **fields)


GOOD, NEXT = link(), link("b", "a")
THUMB = FingerDescription("good", (0.0, 0.1, 0.0), press=(0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *(
            (partial(link, **changes), message)
            for changes, message in (
                ({"mass": 0.0}, r"link 'a': mass \[kg\]=0.0 must be above 0"),
                ({"mass": "heavy"}, "must be 1 numbers"),
                ({"axis": (0, 0, 2)}, "axis=.* must have length 1, not 2; normalise it"),
                ({"axis": (0, 1)}, "must be 3 numbers, not 2"),
                ({"lower": 1.0, "upper": -1.0}, "lower=1.0 must be below upper=-1.0"),
                ({"lower": -np.inf}, "must be finite"),
                ({"origin": (np.nan, 0, 0)}, "origin=.* must be finite"),
                ({"inertia": (1e-5, 0, 0, 1e-5, 0, -1e-5)}, "all must be above 0"),
                ({"inertia": (1e-5, 2e-5, 0, 1e-5, 0, 1e-5)}, "all must be above 0"),
                ({"inertia": (1e-5, 0, 0, 1e-5, 0, 3e-5)}, "the largest is below the sum of the other two"),
                ({"name": ""}, "must be a name"),
            )
        ),
        *(
            (partial(hand, links, tips, **fields), message)
            for links, tips, fields, message in (
                ([], (TIP,), {}, "links=.. is empty"),
                ([GOOD], (), {}, "fingertips=.. is empty"),
                ([NEXT, GOOD], (TIP,), {}, "parent 'a' of link 'b' stands after it"),
                ([GOOD, link("b", "c")], (TIP,), {}, "parent 'c' of link 'b' is not a link; known are palm, a"),
                ([GOOD, GOOD], (TIP,), {}, "two links are called 'a'"),
                ([link("palm")], (TIP,), {}, "two links are called 'palm'"),
                ([GOOD, link("b", joint="a_joint")], (TIP,), {}, "two joints are called 'a_joint'"),
                ([GOOD], (TIP, TIP), {}, "two fingertips are called 'a'"),
                ([GOOD], (Fingertip("a", "palm", (0, 0, 0), 0.01),), {}, "is on link 'palm', which does not move .*moving links are a"),
                ([GOOD], (TIP,), {"home": (2.0,)}, "home=2.0 rad of joint 'a_joint' must be within its limits"),
                ([GOOD], (TIP,), {"home": (0.0, 0.0)}, "must be 1 numbers, not 2"),
                ([GOOD], (TIP,), {"tip_friction": 0.0}, "tip_friction=0.0 must be above 0"),
            )
        ),
        (partial(Fingertip, "a", "a", (0, 0, 0), 0.0), r"radius .* must be above 0"),
        (partial(Geometry, "cone", (1.0,)), "unknown kind of geometry 'cone': choose one of 'sphere'"),
        (partial(Geometry, "capsule", (1.0,)), r"size \(radius, length\).* must be 2 numbers"),
        (partial(Geometry, "box", (1.0, 0.0, 1.0)), "m must be above 0"),
        (partial(replace, THUMB, press=(0.0, -1.0, 0.1)), r"press=.* must have length 1"),
        (partial(replace, THUMB, press=(0.0, -1.0, 0.0)), "must be orthogonal"),
        *(
            (lambda field=field, value=value: HandDescription.of_fingers([replace(THUMB, **{field: value})]), field)
            for field, value in (
                ("link_lengths", (0.1, 0.1)), ("link_masses", (0.02, 0.03, 0.0)), ("joint_lower", (2.0, 0.0, 0.0)),
                ("joint_upper", (1.0, 1.0, 1.0, 1.0)), ("tip_radius", -0.01), ("home", (0.0, 5.0, 0.1)),
            )
        ),
        (partial(HandDescription.of_fingers, []), "is empty"),
        (partial(HandDescription.of_fingers, [THUMB, THUMB]), "two links are called 'good_knuckle'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_impossible_parts_and_hands_are_refused(make: Callable[[], object], message: str) -> None:
    assert hand([GOOD, NEXT]).joint_count == 2
    with pytest.raises(GraspError, match=message):
        make()
