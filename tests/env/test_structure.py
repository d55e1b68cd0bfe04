"""The share of forces that a finger's structure carries."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engines import needs_bullet
from episodes import episode
from hands import gripper

from grasp_env.control.structure import finger_structure
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspWarning, SimulationError
from grasp_env.force import optimize_force
from grasp_env.grasp.grasp import Grasp
from grasp_env.sim import HandKinematics, Scene
from grasp_env.sim.bullet_sweeps import contact_sweeps
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.grasping import placing, sites, trials
from grasp_env.sim.hand.description import HandDescription, Link, Mimic
from grasp_env.sim.hand.inertia import with_rotor

BALL: dict[str, Any] = {"shape": "sphere", "size": (0.06,), "mass": 0.15, "friction": 0.7}
LOADS = np.array([[0.0, -1.5, 0.0, 0.0, 0.0, 0.0], [1.0, -1.5, 0.5, 0.0, 0.03, 0.0]])


@pytest.fixture
def careless(monkeypatch, tmp_path):
    """Place hands without regard to the directions in which their motors push."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(trials, "_SHARE_POWER", 0.0)
    monkeypatch.setattr(sites, "_PUSHED", 0.0)
    monkeypatch.setattr("grasp_env.env.stage.MAX_CARRIED", 1.0)
    placing._placed.cache_clear()
    yield
    placing._placed.cache_clear()


def test_structure_carries_what_takes_no_torque():
    """The direction in which two motors cannot push, found from their Jacobian alone, and forces
    that are optimised one by one."""
    scene = Scene(SceneConfig())
    finger = 1
    snapshot = scene.look()
    hand = scene.config.hand
    grasp = Grasp.from_contacts(snapshot.points, snapshot.normals, 0.4)
    whole = finger_structure(snapshot, scene.kinematics, grasp, LOADS)
    np.testing.assert_array_equal(whole.components, 3)
    np.testing.assert_array_equal(whole.share, 0.0)
    assert whole.warning(hand.finger_names) == ""
    # the last joint is coupled to the one before, in the same posture
    last = int(scene.kinematics.tip_links[finger])
    angles = snapshot.angles
    mimic = Mimic(hand.links[last - 1].joint, 0.5, float(angles[last] - 0.5 * angles[last - 1]))
    links = [
        replace(link, mimic=mimic) if index == last else link
        for index, link in enumerate(hand.links)
    ]
    kinematics = HandKinematics(replace(hand, links=tuple(links)))
    found = finger_structure(snapshot, kinematics, grasp, LOADS)
    np.testing.assert_array_equal(found.components, [3, 2, 3, 3])
    jacobian = kinematics.jacobian(angles, finger, snapshot.touch[finger])[:, kinematics.motors]
    moves = jacobian[:, np.linalg.norm(jacobian, axis=0) > 1e-9].T
    stiff = np.cross(moves[0], moves[1])
    stiff /= np.linalg.norm(stiff)
    forces = np.array(
        [grasp.frames[finger] @ optimize_force(grasp, load).force[finger] for load in LOADS]
    )
    share = np.linalg.norm(forces @ snapshot.rotation.T @ stiff) / np.linalg.norm(forces)
    assert share > 0.05
    np.testing.assert_allclose(found.share, [0.0, share, 0.0, 0.0], atol=1e-6)
    scene.close()


@pytest.mark.usefixtures("careless")
def test_structure_is_reported_once():
    """Three fingers in planes press a ball through their structure; four do with less."""
    env = FourFingerGrasp(hand=gripper(3, 2), **BALL)
    with pytest.warns(
        GraspWarning, match=r"\d+% of the force of 'f\d' \(motors make \d of 3 components\)"
    ) as caught:
        _, info = env.reset(seed=0)
    assert len(caught) == 1
    assert info["structure_share"].shape == (3,)
    assert info["structure_share"].max() > 0.65
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=1)
        env.close()
        env = FourFingerGrasp(hand=gripper(4, 2), **BALL)
        _, info = env.reset(seed=0)
    assert 0.0 < info["structure_share"].max() < 0.65
    env.close()


@needs_bullet
@pytest.mark.usefixtures("careless")
def test_bullet_holds_with_fingers_of_one_motor(monkeypatch):
    """It does not with the sweeps that suffice for other hands."""
    wind = {"name": "random", "force": 2.0, "moment": 0.06}
    for held in (True, False):
        if not held:
            monkeypatch.setattr("grasp_env.sim.bullet_sweeps.STRUCTURE_SWEEPS", 20)
            monkeypatch.setattr("grasp_env.sim.bullet_sweeps.contact_sweeps", lambda *_: 20)
        _, infos = episode(
            None,
            0,
            hand=gripper(5, 1),
            engine="bullet",
            action_mode="none",
            disturbance=wind,
            **BALL,
        )
        assert infos[-1]["is_success"] == held


def light(hand: HandDescription, mass: float) -> HandDescription:
    """The hand with links of this mass [kg], and a rotor at each last one."""
    carriers = {link.parent for link in hand.links}
    links = list[Link]()
    for link in hand.links:
        x, y, z, u, v, w = (mass / link.mass * value for value in link.inertia)
        lighter = replace(link, mass=mass, inertia=(x, y, z, u, v, w))
        last = link.name not in carriers
        links.append(
            replace(lighter, inertia=with_rotor(lighter.inertia, 1e-4)) if last else lighter
        )
    return replace(hand, links=tuple(links))


@needs_bullet
def test_bullet_sweeps_as_often_as_light_links_need(monkeypatch):
    """With the sweeps that suffice for other hands the grasp does not even settle."""
    settings: dict[str, Any] = {"hand": light(gripper(3, 3), 1e-3), "engine": "bullet", **BALL}
    wind = {"name": "random", "force": 2.0, "moment": 0.06}
    _, infos = episode(None, 0, disturbance=wind, **settings)
    assert infos[-1]["is_success"], infos[-1]["fault"]
    assert infos[-1]["slip_distance"] < 1e-3
    monkeypatch.setattr("grasp_env.sim.bullet_sweeps.contact_sweeps", lambda *_: 20)
    with pytest.raises(SimulationError, match=r"did not (settle|come to rest)"):
        FourFingerGrasp(**settings)


def test_the_sweeps_leave_a_thousandth_of_the_error():
    """Against the method of Gauss and Seidel itself, at the contacts of the reference grasp."""
    config = SceneConfig()
    scene = Scene(config)
    angles = scene.look().angles.copy()
    kinematics = scene.kinematics
    inverse = np.linalg.inv(kinematics.mass_matrix(angles))
    points, normals = np.array(config.contact_points), config.contact_normals
    rows = []
    for finger, (point, normal) in enumerate(zip(points, normals, strict=True)):
        moves = kinematics.jacobian(angles, finger, point)
        for axis in np.linalg.svd(normal[None])[2]:  # the normal and two tangents
            rows.append((axis @ moves, np.concatenate([axis, np.cross(point, axis)])))
    hand_rows, object_rows = (np.array(part) for part in zip(*rows, strict=True))
    moments = [config.object.mass] * 3 + [*config.object.moments]
    matrix = hand_rows @ inverse @ hand_rows.T + object_rows / moments @ object_rows.T
    sweeps = contact_sweeps(config, angles)
    error = np.random.default_rng(0).standard_normal(len(matrix))
    sizes = [np.linalg.norm(error)]
    for _ in range(2 * sweeps):
        for row in range(len(matrix)):
            error[row] -= matrix[row] @ error / matrix[row, row]
        sizes.append(np.linalg.norm(error))
    # the share that a sweep leaves, after the first ones
    share = (sizes[2 * sweeps] / sizes[sweeps // 2]) ** (1.0 / (2 * sweeps - sweeps // 2))
    assert sweeps * np.log(share) == pytest.approx(np.log(1e-3), rel=0.15)
