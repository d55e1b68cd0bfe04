"""Ten ways to look like a success without holding the object, each told from one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engines import needs_bullet

from grasp_env.env.env import FourFingerGrasp
from grasp_env.force import Margin, optimize_force
from grasp_env.grasp import Grasp
from grasp_env.sim import HandDescription
from grasp_env.sim.config import SceneConfig
from grasp_env.task import RandomWrench

ENGINES = pytest.mark.parametrize("engine", [pytest.param("bullet", marks=needs_bullet), "mujoco"])
STEPS = 30
CALM: dict[str, Any] = {"disturbance": "none", "duration": STEPS / 50}
FORCES: dict[str, Any] = {
    **CALM,
    "action_mode": "contact_force",
    "agent": {"action_scale": 20.0},
    "limits": {"end_at_fault": False, "max_drift": 0.1, "max_slide": 0.1},
}


def actions_of(forces: np.ndarray, scale: float = 20.0) -> np.ndarray:
    """Return the action that commands contact forces (N, 3) [N]."""
    action = forces / scale
    action[:, 0] -= 1.0
    return action.reshape(-1).astype(np.float32)


def played(policy: Callable[[int, dict[str, Any]], np.ndarray], **settings: Any) -> list[Any]:
    """Return (info, reward) of all steps; a policy gets the step's number and the last info."""
    env = FourFingerGrasp(**settings)
    _, info = env.reset(seed=0)
    assert info["is_success"]
    out = []
    ended = False
    while not ended:
        _, reward, lost, over, info = env.step(policy(len(out), info))
        out.append((info, reward))
        ended = lost or over
    env.close()
    return out


def forces_of(preload: float, share: float = 1.0) -> np.ndarray:
    """Return forces (4, 3) [N] that hold the default object with this share of its weight."""
    env = FourFingerGrasp(**CALM)
    _, info = env.reset(seed=0)
    seen = env.scene.look()
    grasp = Grasp.from_contacts(seen.points.copy(), seen.normals.copy(), 0.5)
    solution = optimize_force(grasp, share * info["wrench"], margin=Margin(0.85, preload))
    env.close()
    return solution.force


@pytest.fixture(scope="module")
def held_forces() -> np.ndarray:
    return forces_of(preload=1.0)


@ENGINES
def test_the_forces_hold(held_forces, engine):
    """The other tests begin with these forces, which hold the object to the end."""
    rows = played(lambda k, info: actions_of(held_forces), engine=engine, **FORCES)
    assert all(info["is_success"] and reward > 0.0 for info, reward in rows)
    assert len(rows) == STEPS


@ENGINES
@pytest.mark.parametrize("last", [1, 2, 3])
def test_letting_go_at_the_end(held_forces, engine, last):
    """Ways 1 to 3."""
    nothing = np.zeros((4, 3))
    rows = played(
        lambda k, info: actions_of(held_forces if k < STEPS - last else nothing),
        engine=engine,
        **FORCES,
    )
    info, reward = rows[-1]
    assert len(rows) == STEPS
    assert (info["fault"], info["is_success"], reward) == ("not_carried", False, 0.0)


def test_throwing_it_at_the_end(held_forces):
    """Way 4: the object is in place, and on its way out of the hand."""

    def throw(k: int, info: dict[str, Any]) -> np.ndarray:
        forces = held_forces.copy()
        if k >= STEPS - 2:
            forces[0, 0] += 3.0
        return actions_of(forces)

    info, reward = played(throw, **FORCES)[-1]
    assert info["drift"] < 0.02
    assert info["speed"] > 0.2
    assert (info["is_success"], reward) == (False, 0.0)
    assert info["fault"] in ("moving", "not_carried")


def test_crushing_it(held_forces):
    """Way 5: the force of one fingertip, which another opposes, however short."""

    tight = forces_of(preload=8.0)
    most = 2.0 * float(np.linalg.norm(held_forces, axis=1).max())
    rows = played(
        lambda k, info: actions_of(tight if k == 10 else held_forces),
        **{**FORCES, "limits": {**FORCES["limits"], "max_force": most}},
    )
    assert rows[9][0]["is_success"]
    info, reward = rows[-1]
    assert info["peak_force"] > most
    assert (info["fault"], reward) == ("crushed", 0.0)
    assert [reward for _, reward in rows[10:12]] == [-10.0, 0.0]


@needs_bullet
def test_carrying_it_with_other_links():
    """Way 6: a link presses the object on the fingertips."""
    hand = HandDescription.four_finger()
    env = FourFingerGrasp(
        hand=replace(hand, fingertips=hand.fingertips[:3]),
        contact_points=SceneConfig().contact_points[:3],
        limits={"max_slide": 1.0},
        **CALM,
    )
    env.reset(seed=0)
    advance = env.scene.advance
    env.scene.advance = lambda torques, wrench: advance([*torques[:10], 0.5, torques[11]], wrench)
    infos = [env.step(np.zeros(3, np.float32))[4] for _ in range(STEPS)]
    env.close()
    assert (infos[-1]["fault"], infos[-1]["is_success"]) == ("stray_force", False)


def test_leaving_it_in_the_air():
    """Way 7: nothing pulls at an object without weight, so it stays without a hand."""
    forces = forces_of(preload=0.5, share=0.0)
    infos = played(
        lambda k, info: actions_of(forces if k < 5 else np.zeros((4, 3))),
        gravity=(0.0, 0.0, 0.0),
        **FORCES,
    )
    assert infos[4][0]["is_success"]
    info, reward = infos[-1]
    assert info["fault"] in ("not_carried", "moving")
    assert reward == 0.0


def test_spinning_it_at_the_end():
    """Way 8: the object is in place and its centre at rest, but it turns."""

    def twist(times: np.ndarray, rng: np.random.Generator, settings: Any) -> np.ndarray:
        wrenches = np.zeros((len(times), 6))
        wrenches[-5:, 4] = 0.5
        return wrenches

    sensors = {"wrench": "none"}
    info, reward = played(
        lambda k, info: np.zeros(6, np.float32), **{**CALM, "disturbance": twist}, sensors=sensors
    )[-1]
    assert info["tilt"] < 0.35
    assert (info["fault"], reward) == ("moving", 0.0)


@needs_bullet
def test_sliding_and_staying_in_place():
    """Way 9: the fingertips wander over the object, which stays where it is."""
    rows = played(
        lambda k, info: np.zeros(6, np.float32),
        disturbance=RandomWrench(force=2.0, moment=0.06),
        sensors={"delay": 0.012},
        duration=1.0,
        limits={"max_slide": 1e-4},
    )
    info, reward = rows[-1]
    assert info["drift"] < 1e-3
    assert (info["fault"], reward) == ("slid", 0.0)


def test_pressing_into_it(held_forces):
    """Way 10: a deep contact for a moment."""

    tight = forces_of(preload=8.0)

    def press(k: int, info: dict[str, Any]) -> np.ndarray:
        return actions_of(tight if k == 10 else held_forces)

    rows = played(press, engine="mujoco", **FORCES)
    deepest = max(info["overlap"] for info, _ in rows)
    limits = {**FORCES["limits"], "max_overlap": 0.5 * (rows[9][0]["overlap"] + deepest)}
    rows = played(press, engine="mujoco", **{**FORCES, "limits": limits})
    assert rows[9][0]["is_success"]
    assert (rows[-1][0]["fault"], rows[-1][1]) == ("overlap", 0.0)
