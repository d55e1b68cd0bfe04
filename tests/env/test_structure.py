"""Fingers with fewer motors than force components: what their structure carries is measured, reported at reset, and held in Bullet."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engines import needs_bullet
from hands import gripper

from grasp_env.control.structure import FingerStructure, finger_structure
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspWarning
from grasp_env.force import optimize_force
from grasp_env.grasp.grasp import Grasp
from grasp_env.sim import HandDescription, HandKinematics, Scene, SceneConfig
from grasp_env.sim.grasping import placing, sites
from grasp_env.sim.hand.description import Mimic

BALL: dict[str, Any] = {"shape": "sphere", "size": (0.06,), "mass": 0.15, "friction": 0.7}
LOADS = np.array([[0.0, -1.5, 0.0, 0.0, 0.0, 0.0], [1.0, -1.5, 0.5, 0.0, 0.03, 0.0]])


def held(hand: HandDescription, engine: str, seeds: int) -> int:
    """How often the hand holds a ball for 2 s under a random wrench."""
    env = FourFingerGrasp(
        hand=hand, engine=engine, action_mode="none", duration=2.0, disturbance={"name": "random", "force": 2.0, "moment": 0.06}, **BALL
    )  # fmt: skip
    successes = 0
    for seed in range(seeds):
        env.reset(seed=seed)
        while True:
            _, _, terminated, truncated, info = env.step(np.zeros(1, dtype=np.float32))
            if terminated or truncated:
                successes += info["is_success"]
                break
    env.close()
    return successes


def grasp_of(scene: Scene) -> Grasp:
    """The contacts of a scene."""
    return Grasp.from_contacts(scene.look().points, scene.look().normals, 0.4)


def coupled_last_joint(scene: Scene, finger: int) -> HandKinematics:
    """The hand of a scene with the last joint of a finger coupled to the one before, in the posture of the scene."""
    hand, angles = scene.config.hand, scene.look().angles
    last = int(scene.kinematics.tip_links[finger])
    mimic = Mimic(hand.links[last - 1].joint, 0.5, float(angles[last] - 0.5 * angles[last - 1]))
    links = [replace(link, mimic=mimic) if index == last else link for index, link in enumerate(hand.links)]
    return HandKinematics(replace(hand, links=tuple(links)))


@pytest.fixture
def careless(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Hands are placed as if it did not matter what their motors push."""
    monkeypatch.setattr(placing, "_MADE", 0.0)
    monkeypatch.setattr(sites, "_PUSHED", 0.0)
    placing._placed.cache_clear()
    yield
    placing._placed.cache_clear()


@pytest.fixture
def scene() -> Any:
    made = Scene(SceneConfig())
    yield made
    made.close()


def test_three_motors_of_a_finger_make_all_of_its_force(scene: Scene) -> None:
    found = finger_structure(scene.look(), scene.kinematics, grasp_of(scene), LOADS)
    np.testing.assert_array_equal(found.components, 3)
    np.testing.assert_array_equal(found.share, 0.0)
    assert found.warning(scene.config.hand.finger_names) == ""


def test_the_structure_of_a_finger_carries_what_takes_no_torque(scene: Scene) -> None:
    """The direction in which two motors cannot push, found from their Jacobian alone, and forces that are optimized one by one."""
    kinematics, snapshot = coupled_last_joint(scene, 1), scene.look()
    found = finger_structure(snapshot, kinematics, grasp_of(scene), LOADS)
    np.testing.assert_array_equal(found.components, [3, 2, 3, 3])
    jacobian = kinematics.jacobian(snapshot.angles, 1, snapshot.touch[1])[:, kinematics.motors]
    moves = jacobian[:, np.linalg.norm(jacobian, axis=0) > 1e-9].T
    stiff = np.cross(moves[0], moves[1])
    stiff /= np.linalg.norm(stiff)
    grasp = grasp_of(scene)
    forces = np.array([grasp.frames[1] @ optimize_force(grasp, load).force[1] for load in LOADS]) @ snapshot.rotation.T
    share = np.linalg.norm(forces @ stiff) / np.linalg.norm(forces)
    assert share > 0.05
    np.testing.assert_allclose(found.share, [0.0, share, 0.0, 0.0], atol=1e-6)


def test_the_warning_names_fingers_and_numbers() -> None:
    found = FingerStructure(np.array([3, 1, 3, 2]), np.array([0.0, 0.83, 0.71, 0.4]))
    said = found.warning(("thumb", "index", "ring", "little"))
    assert (
        "83% of the force of 'index' (motors make 1 of 3 components), 71% of the force of 'ring' (other fingers share"
        in said
    )
    assert "thumb" not in said
    assert "little" not in said


@pytest.mark.usefixtures("careless")
@pytest.mark.parametrize("engine", [pytest.param("bullet", marks=needs_bullet), "mujoco"])
def test_a_reset_reports_what_structure_carries_once(engine: str) -> None:
    """Three fingers in planes press a ball through their structure; four do with less."""
    env = FourFingerGrasp(hand=gripper(3, 2), engine=engine, **BALL)
    with pytest.warns(GraspWarning, match=r"\d+% of the force of 'f\d' \(motors make \d of 3 components\)") as caught:
        _, info = env.reset(seed=0)
    assert len(caught) == 1
    assert info["structure_share"].shape == (3,)
    assert info["structure_share"].max() > 0.65
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=1)
    env.close()
    env = FourFingerGrasp(hand=gripper(4, 2), engine=engine, **BALL)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, info = env.reset(seed=0)
    assert 0.0 < info["structure_share"].max() < 0.65
    env.close()


@pytest.mark.filterwarnings("ignore::grasp_env.errors.GraspWarning")
def test_two_soft_contacts_are_measured() -> None:
    """Such as those of jaws: hard contacts at their places are no grasp."""
    env = FourFingerGrasp(hand=gripper(2, 2), engine="mujoco", object={"torsional_friction": 0.004}, **BALL)
    _, info = env.reset(seed=0)
    assert info["structure_share"].shape == (2,)
    assert ((info["structure_share"] > 0.0) & (info["structure_share"] < 1.0)).all()
    env.close()


@needs_bullet
@pytest.mark.usefixtures("careless")
@pytest.mark.filterwarnings("ignore::grasp_env.errors.GraspWarning")
def test_bullet_holds_with_fingers_of_one_motor(monkeypatch: pytest.MonkeyPatch) -> None:
    """It does not with the sweeps that suffice for other hands."""
    hand = gripper(5, 1)
    assert held(hand, "bullet", 4) == 4
    monkeypatch.setattr("grasp_env.sim.bullet.STRUCTURE_SWEEPS", 20)
    assert held(hand, "bullet", 2) == 0
