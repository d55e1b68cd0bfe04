"""The start of an episode: forces that carry the weight, a place for the hand."""

from __future__ import annotations

from itertools import repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from engines import needs_bullet
from hands import gripper, numbers, scene_alone
from numpy.testing import assert_array_equal

from grasp_env.config import EnvConfig
from grasp_env.control import closing
from grasp_env.control.closing import close_hand, take_over
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspWarning, InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics, ObjectDescription, Scene, place_hand
from grasp_env.sim.grasping import plan_grasp
from grasp_env.sim.objects.description import SHAPES
from grasp_env.task import Move

ZERO = np.zeros(1, dtype=np.float32)
OBJECTS: list[dict[str, Any]] = [
    {"shape": "cuboid", "size": (0.06, 0.12, 0.08), "mass": 1.0, "friction": 0.7},
    {"shape": "cylinder", "size": (0.08, 0.09), "mass": 0.05},
    {"shape": "sphere", "size": (0.07,), "mass": 0.05},
    {"shape": "capsule", "size": (0.08, 0.12), "mass": 0.5, "friction": 0.7},
    {"shape": "mesh", "mass": 0.5, "friction": 0.8},
    *({"shape": shape, "gravity": (6.0, -2.0, -7.5)} for shape in SHAPES),
    *(
        {"shape": "sphere", "hand": hand}
        for hand in ("three_finger", "five_finger", "four_finger_4dof")
    ),
]


def make(folder: Path, **settings: Any) -> FourFingerGrasp:
    """Without actions, under a random wrench; the mesh is an egg of 320 faces."""
    if settings["shape"] == "mesh":
        egg = trimesh.creation.icosphere(2, 0.045)
        egg.apply_scale((1.0, 1.2, 1.0))
        egg.export(folder / "egg.obj")
        settings = {**settings, "object.mesh": folder / "egg.obj"}
    return FourFingerGrasp(disturbance="random", action_mode="none", **settings)


def start(env: FourFingerGrasp, mass: float) -> np.ndarray:
    """Everything that can be read at a reset, whose forces are checked, and in the steps after it."""
    env.reset(seed=5)
    scene = env.scene
    rows = []
    s = scene.look()
    assert s.touching.all()
    weight = mass * np.array(env.config.gravity)
    miss = np.linalg.norm(s.rotation @ s.forces.sum(axis=0) + weight) / np.linalg.norm(weight)
    assert miss < 0.01  # the promise of the environment
    for _ in range(10):
        rows.append(numbers(scene))
        env.step(ZERO)
    return np.array(rows)


def shake(scene: Scene, seed: int, steps: int) -> None:
    """Let the object fall (seed 0), or shake it and the hand so that links touch what they never
    touch otherwise."""
    rng = np.random.default_rng(seed)
    push = np.zeros(6) if seed == 0 else np.array([2.0, 2.0, 2.0, 0.05, 0.05, 0.05])
    torque = 0.0 if seed == 0 else 0.3
    for _ in range(steps):
        scene.step(
            torque * rng.normal(size=scene.kinematics.hand.joint_count), push * rng.normal(size=6)
        )


@pytest.mark.parametrize("settings", OBJECTS, ids=str)
def test_forces_carry_the_weight_at_every_reset(tmp_path, settings):
    env = make(tmp_path, **settings)
    mass = settings.get("mass", 0.2)
    first = start(env, mass)
    for seed, steps in ((0, 200), (2, 20), (3, 60)):
        shake(env.scene, seed, steps)
        np.testing.assert_array_equal(start(env, mass), first)
    env.close()


class Scripted:
    """A scene without physics and the loop that acts in it: after tick k everything is at rest, or
    what `disturbs` names is not."""

    def __init__(self, quiet: list[bool], disturbs: str) -> None:
        self.gravity, self.core, self.config = (
            np.zeros(3),
            scene_alone()[0],
            SimpleNamespace(object=ObjectDescription()),
        )
        self.kinematics = SimpleNamespace(
            mass_matrix=lambda angles: np.eye(1), hand=None, torque_limits=np.ones(1)
        )
        self.ticks, self._quiet, self._disturbs = 0, [*quiet, *repeat(False, 2000)], disturbs
        settings = EnvConfig()
        self.loop: Any = SimpleNamespace(
            dt=0.004,
            config=settings,
            begin=lambda scene: None,
            reset=lambda: None,
            begin_step=lambda: None,
            reach=lambda gravity, target: [0.0],
            tick=lambda *given, due: [0.0],
            friction=0.4,
            torques=np.zeros(1),
            controller=SimpleNamespace(rising=False),
            effort=SimpleNamespace(saturated=False),
        )

    def advance(self, torques: list[float], wrench: Any) -> None:
        self.ticks += 1

    def look(self) -> Any:
        state = {
            "touching": np.ones(4),
            "rates": np.zeros(1),
            "linear": np.zeros(3),
            "position": np.zeros(3),
            "forces": np.zeros((4, 3)),
            "rotation": np.eye(3),
            "angles": np.zeros(1),
        }
        if self.ticks and not self._quiet[self.ticks - 1]:
            # of the contacts, the first is lost
            state[self._disturbs] = 0.5 - state[self._disturbs]
            if self._disturbs == "touching":
                state["touching"] = np.array([0.0, 1.0, 1.0, 1.0])
        return SimpleNamespace(**state)


@pytest.mark.parametrize(
    ("settle", "ticks", "disturbs"),
    [
        (close_hand, 8, "touching"),
        (close_hand, 8, "rates"),
        (take_over, 4, "touching"),
        (take_over, 4, "linear"),
    ],
)
def test_closing_ends_after_quiet_ticks_in_a_row(monkeypatch, settle, ticks, disturbs):
    monkeypatch.setattr(closing, "_obstacles", lambda scene: [])
    few = [True] * (ticks - 1)
    scene: Any = Scripted([*few, False, *few, False, True, False, *few, True, True, True], disturbs)
    settle(scene, scene.loop)
    assert scene.ticks == (ticks - 1) + 1 + (ticks - 1) + 1 + 1 + 1 + ticks


def test_other_objects_may_need_another_place():
    env = FourFingerGrasp(
        hand=gripper(4, 2),
        shape="cuboid",
        size=(0.06, 0.06, 0.06),
        friction=0.7,
        mass=0.15,
        disturbance="none",
        randomize={"size": (0.04, 0.042)},
    )
    first = env.scene.config.hand
    with pytest.raises(InvalidInputError):  # from the first place it cannot be grasped
        plan_grasp(
            ObjectDescription("cuboid", (0.041, 0.041, 0.041), mass=0.15, friction=0.7),
            env.scene.kinematics,
        )
    env.reset(seed=1)
    assert env.scene.config.hand != first
    assert env.scene.config.hand.finger_names == first.finger_names
    env.close()


def test_contacts_are_planned_within_the_margin():
    ball = {"shape": "sphere", "size": (0.08,), "friction": 0.4}
    wide, narrow = (
        FourFingerGrasp(
            config=EnvConfig().override(object=ball, **{"controller.friction_margin": margin})
        ).scene.config.contact_points
        for margin in (1.0, 0.4)
    )
    item = ObjectDescription(**ball)
    hand = HandKinematics(HandDescription.four_finger())
    # the planner keeps a reserve also where the controller does not
    assert_array_equal(wide, plan_grasp(item, hand).points)
    assert_array_equal(narrow, plan_grasp(item, hand, friction_margin=0.4).points)
    assert np.abs(np.subtract(wide, narrow)).max() > 0.001


def test_what_has_slid_before_an_episode_does_not_count():
    env = FourFingerGrasp()
    for _ in range(2):
        assert env.reset(seed=0)[1]["slip_distance"] == 0.0
        for _ in range(5):
            assert env.step(np.zeros(6, np.float32))[4]["slip_distance"] > 0.0
    env.close()


def test_a_hand_is_placed_where_it_follows_a_motion():
    """From the first places a link would touch the cube, or the thumb does not reach it."""
    cube = {"shape": "cuboid", "size": (0.05, 0.05, 0.05)}
    env = FourFingerGrasp(hand="leap", object=cube, task=Move("shake"), action_mode="none")
    assert (
        env.scene.config.hand != place_hand(HandDescription.leap(), ObjectDescription(**cube)).hand
    )
    env.reset(seed=0)
    ended = False
    while not ended:
        *_, ended, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert (info["fault"], info["stray_share"]) == ("", 0.0)
    env.close()


def test_a_motion_that_no_pose_follows_is_told():
    cube = {"shape": "cuboid", "size": (0.05, 0.05, 0.05)}
    with pytest.warns(GraspWarning, match="follows the motion 'shake': finger .* cannot reach"):
        FourFingerGrasp(hand="leap", object=cube, task=Move("shake", size=0.06)).close()


@needs_bullet
@pytest.mark.parametrize(("mass", "friction"), [(0.05, 0.7), (0.08, 0.75)])
def test_a_light_object_whose_contacts_chatter_settles(mass, friction):
    """On the round side of a cylinder Bullet's contact forces change from step to step by a tenth of
    so small a weight. The object stays in place, and its mean force over 50 ms is the weight."""
    env = FourFingerGrasp(
        shape="cylinder",
        size=(0.0832, 0.0713),
        mass=mass,
        friction=friction,
        engine={"name": "bullet", "rate": 1000},
        controller={"rate": 1000, "friction_margin": 0.5, "preload": 1.0},
    )
    env.reset(seed=0)
    assert np.abs(env.scene.look().position).max() < 1e-4
    env.close()
