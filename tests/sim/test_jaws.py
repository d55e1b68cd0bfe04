"""Grippers of two jaws: one motor or two, placed with soft contacts, and held under a random wrench."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from engines import needs_bullet

from grasp_env.config import EnvConfig
from grasp_env.errors import GraspWarning, InvalidInputError, UnknownNameError
from grasp_env.sim import HandDescription, HandKinematics, ObjectDescription, place_hand
from grasp_env.sim.grasping import plan_grasp
from grasp_env.sim.grasping.pads import PATCH_RADIUS, padded, softened, torsion_of
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Mimic, Palm

NONE = (0.0, 0.0, 0.0)
CUBE = ObjectDescription("cuboid", (0.05, 0.05, 0.05), mass=0.15, friction=0.7)
BALL = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)


def jaws(motors: int = 1, force: float = 40.0) -> HandDescription:
    """Two jaws that slide apart along y, with flat faces beside the spheres of their tips; the second one may follow the first."""
    links, tips = list[Link](), list[Fingertip]()
    for number, side in enumerate((1.0, -1.0)):
        name, ball = f"jaw{number}", (0.0, 0.008 * side, 0.045)
        body = Geometry(
            "box", (0.02, 0.026, 0.036), (0.0, 0.013 * side, 0.018)
        )  # its inner face is as far as the sphere
        links.append(
            Link(
                name, "palm", origin=(0.0, 0.0, 0.06), rotation=NONE, axis=(0.0, side, 0.0), lower=0.0, upper=0.04, torque_limit=force, mass=0.05,
                center=(0.0, 0.013 * side, 0.02), inertia=(1e-5, 0.0, 0.0, 1e-5, 0.0, 1e-5), sliding=True,
                collision=(body, Geometry("sphere", (0.008,), ball)), mimic=Mimic("jaw0_joint") if number and motors == 1 else None,
            )
        )  # fmt: skip
        tips.append(Fingertip(name, name, ball, 0.008))
    palm = Palm(collision=(Geometry("box", (0.06, 0.2, 0.06), (0.0, 0.0, 0.02)),))
    return HandDescription("jaws", palm, tuple(links), tuple(tips), placed=False)


def knuckles() -> HandDescription:
    """Two jaws that swing on parallelograms, all moved by one knuckle whose own link carries no tip."""
    links = [
        Link("knuckle", "palm", origin=(0.03, 0.0, 0.05), rotation=NONE, axis=(0.0, 1.0, 0.0), lower=0.0, upper=0.8, torque_limit=8.0, mass=0.03,
             center=(0.0, 0.0, 0.02), inertia=(1e-5, 0.0, 0.0, 1e-5, 0.0, 1e-5), collision=())
    ]  # fmt: skip
    tips: list[Fingertip] = []
    for name, side in (("left", 1.0), ("right", -1.0)):
        common = {
            "rotation": NONE,
            "torque_limit": 1.0,
            "axis": (0.0, side, 0.0),
            "mass": 0.03,
            "inertia": (1e-5, 0.0, 0.0, 1e-5, 0.0, 1e-5),
            "upper": 1.6,
        }
        rod = Geometry("capsule", (0.005, 0.04), (0.0, 0.0, 0.025))
        pad = Geometry("box", (0.006, 0.02, 0.03), (0.0, 0.0, 0.015))
        links += [
            Link(f"{name}_rod", "palm", origin=(0.02 * side, 0.0, 0.05), lower=0.0, center=(0.0, 0.0, 0.02), collision=(rod,),
                 mimic=Mimic("knuckle_joint"), **common),
            Link(f"{name}_pad", f"{name}_rod", origin=(0.0, 0.0, 0.055), lower=-1.6, center=(0.0, 0.0, 0.01),
                 collision=(pad, Geometry("sphere", (0.006,), (0.0, 0.0, 0.035))), mimic=Mimic("knuckle_joint", -1.0), **common),
        ]  # fmt: skip
        tips.append(Fingertip(name, f"{name}_pad", (0.0, 0.0, 0.035), 0.006))
    palm = Palm(collision=(Geometry("box", (0.06, 0.06, 0.05), (0.0, 0.0, 0.02)),))
    return HandDescription("knuckles", palm, tuple(links), tuple(tips), placed=False)


HANDS = {"one motor": jaws(1), "two motors": jaws(2, 20.0), "knuckles": knuckles()}


@pytest.mark.parametrize("item", [CUBE, BALL], ids=["cube", "ball"])
@pytest.mark.parametrize("name", HANDS)
def test_both_jaws_touch_at_once(name: str, item: ObjectDescription) -> None:
    soft = softened(item, HANDS[name])
    placed = place_hand(HANDS[name], soft)
    kinematics = HandKinematics(placed)
    plan = plan_grasp(soft, kinematics)
    assert plan.normals[0] @ plan.normals[1] < -0.9
    np.testing.assert_allclose(plan.angles, kinematics.coupled(plan.angles), atol=1e-12)
    for angles, wanted in ((plan.angles, 0.0), (plan.start, 0.003)):
        gaps = [soft.surface.nearest(tip)[2] for tip in kinematics.tips(angles)] - kinematics.tip_radii
        assert (gaps > wanted - 2e-5).all()  # fingers of one motor open together: the other may be farther away
    np.testing.assert_allclose(
        [soft.surface.nearest(tip)[2] for tip in kinematics.tips(plan.angles)], kinematics.tip_radii, atol=2e-5
    )


def test_a_motor_that_moves_both_jaws_makes_both_forces() -> None:
    """A grasp takes twice as much of it as of the motors that move one jaw each."""
    soft = softened(CUBE, jaws())
    one, two = (plan_grasp(soft, HandKinematics(place_hand(jaws(motors, 10.0), soft))).force for motors in (1, 2))
    assert one == pytest.approx(2.0 * two, rel=0.1)


def test_pads_stand_before_flat_jaws() -> None:
    hand = padded(jaws())
    for tip, before, link, side in zip(hand.fingertips, jaws().fingertips, hand.links, (1.0, -1.0), strict=True):
        np.testing.assert_allclose(np.subtract(tip.center, before.center), (0.0, -0.0015 * side, 0.0), atol=1e-12)
        assert link.collision[1].origin == tip.center
    assert padded(hand) == hand  # they do so already
    three = replace(hand, fingertips=(*hand.fingertips, Fingertip("third", "jaw0", (0.0, 0.0, 0.02), 0.004)))
    assert padded(three) == three


def test_two_fingers_get_soft_contacts_and_it_is_said() -> None:
    with pytest.warns(
        GraspWarning,
        match=r"torsional_friction=0.0056 m, 2/3 of friction 0.7 times the 12 mm .* object={'torsional_friction'",
    ):
        config = EnvConfig(hand=jaws(), object=BALL).resolved()
    assert config.object.torsional_friction == torsion_of(0.7) == pytest.approx(2.0 / 3.0 * 0.7 * PATCH_RADIUS)
    given = EnvConfig(hand=jaws(), object=replace(BALL, torsional_friction=0.01)).resolved()
    assert given.object.torsional_friction == 0.01
    assert EnvConfig(object=BALL).resolved().object.torsional_friction == 0.0


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        pytest.param("one motor", "bullet", marks=needs_bullet),
        pytest.param("two motors", "bullet", marks=needs_bullet),
        *((name, "mujoco") for name in HANDS),  # in Bullet the gears of the knuckles give way
    ],
)
def test_jaws_hold_under_a_random_wrench(name: str, engine: str) -> None:
    for item in (CUBE, BALL):
        with pytest.warns(GraspWarning, match="two fingers hold with soft contacts"):
            env = gym.make(
                "grasp_env:FourFingerGrasp-v0", hand=HANDS[name], object=item, engine=engine, duration=1.0, action_mode="none",
                disturbance={"name": "random", "force": 2.0, "moment": 0.06},
            )  # fmt: skip
        env.reset(seed=0)
        ended, info = False, {}
        while not ended:
            _, _, lost, late, info = env.step(env.action_space.sample())
            ended = lost or late
        env.close()
        assert info["is_success"], info["fault"]
        assert info["torque_share"] > 0.01


@pytest.mark.parametrize(
    ("approach", "way"), [("down", (0.0, -1.0, 0.0)), ("up", (0.0, 1.0, 0.0)), ((3.0, 0.0, 4.0), (0.6, 0.0, 0.8))]
)
@pytest.mark.parametrize("item", [CUBE, BALL], ids=["cube", "ball"])
def test_the_palm_looks_where_it_is_wanted(
    approach: str | tuple[float, ...], way: tuple[float, ...], item: ObjectDescription
) -> None:
    placed = place_hand(jaws(), softened(item, jaws()), approach=approach)
    palm = np.array(placed.palm.collision[0].origin)
    assert -palm @ way / np.linalg.norm(palm) > np.cos(
        np.radians(35.0)
    )  # 30, and the middle of the box is not its nearest point


def test_a_palm_beside_the_object_and_approaches_that_cannot_be() -> None:
    placed = place_hand(jaws(), softened(BALL, jaws()), approach="side")
    palm = np.array(placed.palm.collision[0].origin)
    assert abs(palm[1]) / np.linalg.norm(palm) < np.sin(np.radians(35.0))
    # two sides of a cube lie in the jaws, and the palm is at least 35 degrees off its diagonal
    with pytest.raises(
        InvalidInputError, match=r"at \d+ of which no side of the object comes from approach=\(0.577, 0.577, 0.577\)"
    ):
        place_hand(jaws(), softened(CUBE, jaws()), approach=(1.0, 1.0, 1.0))
    with pytest.raises(UnknownNameError, match=r"choose one of .down., .up., .side."):
        place_hand(jaws(), CUBE, approach="sideways")
    with pytest.raises(InvalidInputError, match="must have a direction"):
        EnvConfig(hand=jaws(), approach=(0.0, 0.0, 0.0))
    with pytest.raises(
        InvalidInputError, match="approach='up' is for a hand that is put around the object, and the hand is placed"
    ):
        EnvConfig(approach="up")
    assert EnvConfig(hand=jaws(), approach=(0.0, -2.0, 0.0)).approach == (0.0, -1.0, 0.0)
