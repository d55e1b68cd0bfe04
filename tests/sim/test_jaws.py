"""Grippers of two jaws with one motor or two."""

from __future__ import annotations

import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from engines import needs_bullet
from hands import gripper, make_link

from grasp_env.config import EnvConfig
from grasp_env.errors import GraspWarning, InvalidInputError, UnknownNameError
from grasp_env.sim import HandDescription, HandKinematics, ObjectDescription, place_hand
from grasp_env.sim.grasping import plan_grasp
from grasp_env.sim.grasping.pads import (
    PATCH_RADIUS,
    torsion_of,
    with_protruding_tips,
    with_soft_contacts,
)
from grasp_env.sim.hand.limbs import touching_pairs
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Mimic, Palm

CUBE = ObjectDescription("cuboid", (0.05, 0.05, 0.05), mass=0.15, friction=0.7)
BALL = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)


def jaws(motors: int = 1, force: float = 40.0) -> HandDescription:
    """Return jaws that slide apart along y, with flat faces beside the spheres of their tips; with
    one motor the second is coupled."""
    links = list[Link]()
    tips = list[Fingertip]()
    for name, side in (("jaw0", 1.0), ("jaw1", -1.0)):
        ball = Geometry("sphere", (0.008,), (0.0, 0.008 * side, 0.045))
        # the inner face is as far out as the sphere
        body = Geometry("box", (0.02, 0.026, 0.036), (0.0, 0.013 * side, 0.018))
        links.append(
            make_link(
                name,
                origin=(0.0, 0.0, 0.06),
                center=body.origin,
                collision=(body, ball),
                sliding=True,
                lower=0.0,
                upper=0.04,
                torque_limit=force,
                axis=(0.0, side, 0.0),
                mimic=Mimic("jaw0_joint") if links and motors == 1 else None,
            )
        )
        tips.append(Fingertip(name, name, ball.origin, 0.008))
    palm = Palm(collision=(Geometry("box", (0.06, 0.2, 0.06), (0.0, 0.0, 0.02)),))
    return HandDescription("jaws", palm, tuple(links), tuple(tips), placed=False)


def racks(gap: float) -> HandDescription:
    """Return the jaws on two racks that pass each other at a gap [m]."""
    hand = jaws()
    bars = [Geometry("box", (0.005, 0.12, 0.005), (x, 0.0, 0.0)) for x in (0.02, 0.025 + gap)]
    links = (
        replace(link, collision=(*link.collision, bar))
        for link, bar in zip(hand.links, bars, strict=True)
    )
    return replace(hand, links=tuple(links))


def claw(ratio: float = 1.0) -> HandDescription:
    """Return two fingers that one motor swings against each other, the second `ratio` times as
    fast."""
    hand = gripper(2, 1, torque=8.0)
    return replace(
        hand, links=(hand.links[0], replace(hand.links[1], mimic=Mimic("f0_0_joint", ratio)))
    )


@pytest.mark.parametrize(
    ("hand", "item"),
    [(jaws(1), CUBE), (claw(), BALL), (claw(0.6), BALL)],
    ids=["jaws", "claw", "slow finger"],
)
def test_both_jaws_touch_at_once(hand, item):
    soft = with_soft_contacts(item, hand)
    kinematics = HandKinematics(place_hand(hand, soft).hand)
    plan = plan_grasp(soft, kinematics)
    assert plan.normals[0] @ plan.normals[1] < -0.9
    np.testing.assert_allclose(plan.angles, kinematics.coupled(plan.angles), atol=1e-12)
    for angles, wanted in ((plan.angles, 0.0), (plan.start, 0.003)):
        gaps = [
            soft.surface.nearest(tip)[2] for tip in kinematics.tips(angles)
        ] - kinematics.tip_radii
        # fingers of one motor open together: the other may be farther away
        assert (gaps > wanted - 2e-5).all()
        assert wanted > 0.0 or (gaps < 2e-5).all()


@pytest.mark.parametrize(("gap", "pairs"), [(0.0025, ((0, 1),)), (0.0035, ())])
def test_racks_that_are_always_near_may_be_so(gap, pairs):
    """They are nearer than fingers may be, in every posture; so a search must not ask for more."""
    hand = racks(gap)
    assert touching_pairs(hand) == pairs
    assert place_hand(hand, replace(CUBE, torsional_friction=0.005), keep=False).clearance > 0.0


def test_one_motor_makes_the_forces_of_both_jaws():
    """A grasp takes twice the force of one motor that it takes of two."""
    soft = with_soft_contacts(BALL, jaws())
    placed = place_hand(jaws(1, 10.0), soft).hand
    free = replace(placed, links=tuple(replace(link, mimic=None) for link in placed.links))
    one, two = (plan_grasp(soft, HandKinematics(hand)).force for hand in (placed, free))
    assert one == pytest.approx(2.0 * two, rel=0.1)


def test_pads_stand_before_flat_jaws():
    hand = with_protruding_tips(jaws())
    for tip, before, link, side in zip(
        hand.fingertips, jaws().fingertips, hand.links, (1.0, -1.0), strict=True
    ):
        np.testing.assert_allclose(
            np.subtract(tip.center, before.center), (0.0, -0.0015 * side, 0.0), atol=1e-12
        )
        assert link.collision[1].origin == tip.center
    assert with_protruding_tips(hand) == hand  # they do so already
    three = replace(
        hand, fingertips=(*hand.fingertips, Fingertip("third", "jaw0", (0.0, 0.0, 0.02), 0.004))
    )
    assert with_protruding_tips(three) == three


def test_two_fingers_get_soft_contacts():
    words = r"torsional_friction=0.0056 m, 2/3 of friction 0.7 times the 12 mm .* object={'torsional_friction'"
    with pytest.warns(GraspWarning, match=words):
        config = EnvConfig(hand=jaws(), object=BALL).resolved()
    assert (
        config.object.torsional_friction
        == torsion_of(0.7)
        == pytest.approx(2.0 / 3.0 * 0.7 * PATCH_RADIUS)
    )
    given = EnvConfig(hand=jaws(), object=replace(BALL, torsional_friction=0.01)).resolved()
    assert given.object.torsional_friction == 0.01
    assert EnvConfig(object=BALL).resolved().object.torsional_friction == 0.0


@pytest.mark.parametrize(
    ("hand", "item", "engine"),
    [pytest.param(jaws(1), CUBE, "bullet", marks=needs_bullet), (claw(), CUBE, "mujoco")],
    ids=["jaws", "claw"],
)
def test_jaws_hold_under_a_random_wrench(hand, item, engine):
    with pytest.warns(GraspWarning, match="two fingers hold with soft contacts"):
        env = gym.make(
            "grasp_env:FourFingerGrasp-v0",
            hand=hand,
            object=item,
            engine=engine,
            duration=1.0,
            action_mode="none",
            disturbance={"name": "random", "force": 2.0, "moment": 0.06},
        )
    env.reset(seed=0)
    ended = False
    info = {}
    while not ended:
        _, _, lost, late, info = env.step(env.action_space.sample())
        ended = lost or late
    env.close()
    assert info["is_success"], info["fault"]
    assert info["torque_share"] > 0.01


@pytest.mark.parametrize(
    ("item", "approach", "way"),
    [(CUBE, "up", (0.0, 1.0, 0.0)), (BALL, (3.0, 0.0, 4.0), (0.6, 0.0, 0.8)), (BALL, "side", None)],
)
def test_the_palm_looks_where_it_is_wanted(item, approach, way):
    placed = place_hand(jaws(), with_soft_contacts(item, jaws()), approach=approach).hand
    palm = np.array(placed.palm.collision[0].origin)
    palm /= np.linalg.norm(palm)
    limit = np.radians(35.0)  # 30, and the middle of the box is not its nearest point
    assert abs(palm[1]) < np.sin(limit) if way is None else -palm @ way > np.cos(limit)


def test_hands_that_cannot_be_placed():
    with pytest.raises(
        InvalidInputError, match=r"surround it at 0 places.*none is left.* No two of its fingers"
    ):
        place_hand(jaws(), ObjectDescription("sphere", (0.4,), torsional_friction=0.01))
    with pytest.raises(InvalidInputError, match=r"surround it at 0 places.*none is left"):
        place_hand(gripper(3, 2), ObjectDescription("sphere", (0.4,)))
    with pytest.raises(
        InvalidInputError, match=r"soft contacts only.* torsional_friction \[m\], 0.0056 "
    ):
        place_hand(jaws(), BALL)
    # two sides of a cube lie in the jaws, and the palm is at least 35 degrees off its diagonal
    words = r"at \d+ of which no side of the object comes from approach=\(0.577, 0.577, 0.577\)"
    with pytest.raises(InvalidInputError, match=words):
        place_hand(jaws(), with_soft_contacts(CUBE, jaws()), approach=(1.0, 1.0, 1.0))
    with pytest.raises(UnknownNameError, match=r"choose one of .down., .up., .side."):
        place_hand(jaws(), CUBE, approach="sideways")
    with pytest.raises(InvalidInputError, match="must have a direction"):
        EnvConfig(hand=jaws(), approach=(0.0, 0.0, 0.0))
    with pytest.raises(
        InvalidInputError, match="approach='up' is for a hand that is put around the object"
    ):
        EnvConfig(hand=place_hand(claw(), with_soft_contacts(BALL, claw())).hand, approach="up")
    assert EnvConfig(approach="up").approach == "up"  # a hand with a name may be put elsewhere
    assert EnvConfig(hand=jaws(), approach=(0.0, -2.0, 0.0)).approach == (0.0, -1.0, 0.0)


def test_sliding_joints_have_their_own_units():
    jaw = jaws().links[0]
    with pytest.raises(InvalidInputError, match=r"torque_limit \[N\]"):
        replace(jaw, torque_limit=0.0)
    with pytest.raises(InvalidInputError, match=r"joint limits \[m\]"):
        replace(jaw, lower=0.1)
    with pytest.raises(
        InvalidInputError, match=r"home=0\.5 m of joint 'jaw0_joint' .* 0\.0 to 0\.04 m"
    ):
        replace(jaws(), home=(0.5, 0.5))


def test_an_agent_of_two_jaws_sets_the_grip():
    """A default that its user did not choose is no reason for a warning."""
    item = replace(CUBE, torsional_friction=0.004)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make("grasp_env:FourFingerGrasp-v0", hand=jaws(), object=item)
    assert env.action_space.shape == (2,)
    env.close()
    with pytest.warns(GraspWarning, match="an agent's actions change nothing: on soft contacts"):
        gym.make(
            "grasp_env:FourFingerGrasp-v0", hand=jaws(), object=item, action_mode="initial_force"
        ).close()
