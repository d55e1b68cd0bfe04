"""Motors with limits: forces within them where there are any, an honest mark where there are none; coupled and missing joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engines import needs_bullet
from episodes import episode
from scipy.linalg import null_space

from grasp_env.env import FourFingerGrasp
from grasp_env.errors import GraspWarning
from grasp_env.grasp import Grasp
from grasp_env.sim import HandDescription
from grasp_env.sim.engine import BulletEngine
from grasp_env.sim.hand.description import _front, _thumb
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Mimic, Palm
from grasp_env.task import SixDirections

POINTS = ((0.0, 0.0, -0.05), (0.0, 0.03, 0.05), (-0.03, -0.02, 0.05), (0.03, -0.02, 0.05))
"""The reference grasp; a search would take other places for weak motors."""
PUSHES = SixDirections(push_time=0.5)


def weak(limit: float) -> HandDescription:
    """The four-finger hand with other motors."""
    hand = HandDescription.four_finger()
    return replace(hand, links=tuple(replace(link, torque_limit=limit) for link in hand.links))


def test_limits_that_leave_enough_cost_nothing_of_the_hold() -> None:
    """0.68 N m: the strongest pushes take 0.695 without limits; the object stays as it does with strong motors."""
    _, infos = episode(None, seed=0, hand=weak(0.68), contact_points=POINTS, task=PUSHES)
    assert infos[-1]["is_success"]
    assert sum(info["limited"] for info in infos) > 100
    assert not any(info["saturated"] for info in infos)
    assert max(info["drift"] for info in infos) < 1e-4
    assert min(info["torque_margin"] for info in infos) > 0.0
    strong = episode(20)[1]  # limits that are far away
    assert all(info["limited"] == 0 and not info["saturated"] for info in strong)
    assert 11.0 < min(info["torque_margin"] for info in strong) < 12.0


def planar() -> HandDescription:
    """Four fingers of two joints each that flex in planes x = constant."""
    links: list[Link] = []
    tips: list[Fingertip] = []
    inertia, still, center = (2e-5, 0.0, 0.0, 2e-5, 0.0, 2e-5), (0.0, 0.0, 0.0), (0.0, -0.03, 0.0)
    bone, ball = (
        Geometry("capsule", (0.006, 0.04), center, (np.pi / 2, 0.0, 0.0)),
        Geometry("sphere", (0.01,), (0.0, -0.06, 0.0)),
    )
    for name, x, side in (("a", -0.03, 1.0), ("b", 0.03, 1.0), ("c", -0.03, -1.0), ("d", 0.03, -1.0)):
        base, knee, axis = (x, 0.11, -0.09 * side), (0.0, -0.07, 0.0), (-side, 0.0, 0.0)
        links.append(Link(f"{name}1", "palm", base, still, axis, -1.5, 1.5, 2.0, 0.03, center, inertia, (bone,)))
        links.append(Link(f"{name}2", f"{name}1", knee, still, axis, -1.5, 2.5, 2.0, 0.02, center, inertia, (ball,)))
        tips.append(Fingertip(name, f"{name}2", (0.0, -0.06, 0.0), 0.01))
    return HandDescription("planar", Palm(), tuple(links), tuple(tips), home=(0.2, 0.2) * 4)


@pytest.mark.parametrize("engine", [pytest.param(BulletEngine(solver_iterations=500), marks=needs_bullet), "mujoco"])
def test_fingers_of_two_joints_push_as_they_are_told(engine: Any) -> None:
    """Structure carries what no motor produces: measured forces are the commanded ones apart from one undetermined squeeze.

    It acts across the fingers' planes: 0 in MuJoCo, 0.3 N in Bullet, which needs more than 20 sweeps for closed chains.
    """
    points = ((-0.03, 0.0, -0.05), (0.03, 0.01, -0.05), (-0.03, 0.01, 0.05), (0.03, 0.0, 0.05))
    env = FourFingerGrasp(hand=planar(), contact_points=points, friction=0.7, engine=engine, disturbance="random")
    env.reset(seed=3)
    loop, hand, truncated, errors = env._loop, env.scene.kinematics, False, []
    while not truncated:
        *_, truncated, info = env.step(np.zeros(6, dtype=np.float32))
        grasp = Grasp.from_contacts(loop.seen.points, loop.seen.normals, 1.0)
        turned = np.array([
            hand.link_jacobian(loop.seen.angles, int(link), touch)[:, hand.motors].T @ loop.seen.rotation @ frame
            for link, touch, frame in zip(hand.tip_links, loop.seen.touch, grasp.frames, strict=True)
        ])  # fmt: skip
        torques = np.concatenate(turned, axis=1)
        free = null_space(np.vstack([grasp.matrix, torques]), rcond=1e-6)  # neither balance nor motors determine it
        assert free.shape == (12, 1)
        missed = (info["measured_force"] - info["commanded_force"]).reshape(-1)
        errors.append(np.abs(missed - free @ (free.T @ missed)).max())
    env.close()
    assert info["is_success"]
    assert np.median(errors) < 0.01  # of 2 N; the pushes change by as much in a tick


@pytest.mark.parametrize("engine", [pytest.param("bullet", marks=needs_bullet), "mujoco"])
def test_two_fingers_hold_by_torsion(engine: str) -> None:
    """Two hard contacts cannot keep the object from turning about the line between them."""
    pinch = HandDescription.of_fingers([_thumb(), _front("front", 0.0, 1)], "pinch")
    given = {"hand": pinch, "contact_points": ((0.0, 0.0, -0.05), (0.0, 0.0, 0.05)), "engine": engine}
    soft = {"object": {"torsional_friction": 0.005}, "disturbance": "random", "action_mode": "none", "duration": 2.0}
    _, infos = episode(None, seed=1, **soft, **given)
    last = infos[-1]
    assert (last["is_success"], last["contacts"], last["status"]) == (True, 2, "optimal")
    assert max(info["tilt"] for info in infos) < 0.01
    with pytest.warns(GraspWarning, match=r"assumed is torsional_friction=0.0032 m"):
        env = FourFingerGrasp(**given)
    assert env.config.object.torsional_friction == pytest.approx(2.0 / 3.0 * 0.4 * 0.012)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[4]["status"] == "optimal"
    env.close()


def test_a_joint_that_two_fingers_share_keeps_its_limit() -> None:
    """The outer knuckles are coupled to one motor of 0.02 N m, of which pushes would take 0.029: rows of two contacts at once."""
    hand = HandDescription.four_finger()
    driver, mimic = "left_knuckle_joint", Mimic("left_knuckle_joint", -1.0)
    links = [
        replace(link, mimic=mimic)
        if link.joint == "right_knuckle_joint"
        else replace(link, torque_limit=0.02 if link.joint == driver else link.torque_limit)
        for link in hand.links
    ]
    env = FourFingerGrasp(
        hand=replace(hand, links=tuple(links)), contact_points=POINTS, task=PUSHES, agent={"rate": 250}
    )
    env.reset(seed=0)
    joint, over, torques, limited = hand.joint_names.index(driver), False, [], 0
    while not over:
        *_, terminated, truncated, info = env.step(np.zeros(6, dtype=np.float32))
        over = terminated or truncated
        torques.append(abs(env._loop.torques[joint]))
        limited += info["limited"] > 0
        assert not info["saturated"]
    env.close()
    assert limited > 20  # a push that stays takes no more iterations
    assert info["is_success"]
    assert 0.019 < max(torques) <= 0.02
