"""The public environment: observation, info, actions, start rules, resets and pictures."""

from __future__ import annotations

import pickle
import re
from typing import Any

import numpy as np
import pytest
from episodes import NO_SPRINGS, episode
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env.env import observation
from grasp_env.env.env import FourFingerGrasp
from grasp_env.force.rules import initial_rule
from grasp_env.sim.picture.annotation import LONGEST, LONGEST_TURN

ZERO = np.zeros(6, dtype=np.float32)
DOC = FourFingerGrasp.__doc__ or ""


def test_observations_match_the_docstring():
    rows = [line.strip() for line in DOC.splitlines()]
    env = FourFingerGrasp()
    table = []
    index = 0
    low = env.observation_space.low
    high = env.observation_space.high
    env.close()
    for block in observation.fields():
        after = index + block.size
        where = f"{index}" if block.size == 1 else f"{index}-{after - 1}"
        table.append(
            f"| {where} | `{block.key}` | {block.name} | {block.unit} | {block.frame} | {block.bound:g} |"
        )
        assert_array_equal(high[index:after], np.float32(block.bound))
        index = after
    start = rows.index(table[0])
    assert rows[start : start + len(table)] == table  # all of it, in order
    assert not rows[start + len(table)].startswith("|")
    assert (low == -high).all()
    assert high.shape == (index,)
    assert f"({index},)" in DOC


def test_observations_are_the_state_of_the_scene():
    """At reset and after some steps; a dict has the same numbers."""
    env = FourFingerGrasp(disturbance="random", observation="dict")
    other = FourFingerGrasp(disturbance="random")
    assert {field.key for field in observation.fields()} == set(env.observation_space.keys())
    (parts, info), vector = env.reset(seed=1), other.reset(seed=1)[0]
    for step in range(8):
        s = env.scene.look()
        assert env.observation_space.contains(parts)
        assert_array_equal(
            np.concatenate([parts[field.key] for field in observation.fields()]), vector
        )
        for name, known in {
            "force": info["wrench"][:3],
            "moment": info["wrench"][3:],
            "position": s.position,
            "linear_velocity": s.linear,
            "angular_velocity": s.angular,
            "contact_points": s.points,
            "normals": s.normals,
            "commanded_force": info["commanded_force"],
            "measured_force": info["measured_force"],
            "touching": s.touching,
            "joint_angles": s.angles,
            "friction": 0.85 * 0.4,
        }.items():
            assert_allclose(parts[name], np.ravel(known), rtol=1e-6, err_msg=name)
        # the normal component of the measured force, and its size, do not depend on the tangents
        normal = np.einsum("nk,nk->n", s.normals, s.forces)
        size = np.linalg.norm(s.forces, axis=1)
        assert_allclose(info["measured_force"][:, 0], normal, rtol=1e-9)
        assert_allclose(np.linalg.norm(info["measured_force"], axis=1), size, rtol=1e-9)
        assert info["time"] == pytest.approx(step / 50)
        if step == 0:  # the grasp that holds, within 1 % of the weight
            total = s.rotation @ s.forces.sum(axis=0)
            assert_allclose(total, [0.0, 0.2 * 9.81, 0.0], atol=0.01 * 0.2 * 9.81)
            assert (info["contacts"], info["contact_changes"]) == (4, 0)
            assert (info["status"], info["failure"], info["force_closure"]) == ("none", "", True)
        (parts, _, _, _, info), vector = env.step(ZERO), other.step(ZERO)[0]
    env.close()
    other.close()


@pytest.mark.parametrize(
    "settings",
    [{}, {"controller.kind": "pd"}, {"action_mode": "contact_force"}, {"agent.info": "numbers"}],
    ids=str,
)
def test_info_keys_are_documented_and_constant(settings):
    """Readers that make tensors of infos ask each value for its dtype."""
    env = FourFingerGrasp(**settings)
    zero = np.zeros(env.action_space.shape or (), dtype=np.float32)
    _, first = env.reset(seed=0)
    infos = [env.step(zero)[4]]
    terminated = False
    env.reset(seed=0, options={"wrench": [0, 0, 0, 0, 0, 4.0]})
    while not terminated:
        _, _, terminated, _, info = env.step(zero)
        infos.append(info)
    for info in infos:
        assert first.keys() == info.keys()
        for key, value in info.items():
            assert (type(value), np.shape(value)) == (type(first[key]), np.shape(first[key])), key
            assert isinstance(value, str) or np.isfinite(value).all(), key
            if settings.get("agent.info") == "numbers":
                assert (value.dtype, value.dtype.kind in "fib") == (first[key].dtype, True), key
    documented = set(re.findall(r"`([a-z_]+)`", DOC.split("## Info")[1].split("## Reset")[0]))
    assert {key for key in first if not key.startswith("reward/")} <= documented
    env.close()


def iterations(steps: int = 4, action: float = 0.0, **settings: Any) -> list[int]:
    return [
        info["iterations"]
        for info in episode(steps, action=np.full(6, action, dtype=np.float32), **settings)[1]
    ]


def test_actions_move_starts_and_not_the_optimum():
    plain = iterations()
    adjusted = iterations(action=-1.0)
    assert plain == iterations(action=-1.0, agent={"action_scale": 1e-9})
    assert all(a != b for a, b in zip(plain, adjusted, strict=True))  # also at the first step
    base, moved = (
        episode(5, action=np.full(6, a, dtype=np.float32))[1][-1]["objective"] for a in (0.0, -0.5)
    )
    assert moved == pytest.approx(base, rel=3e-4)
    for method in ("newton", "full_flow"):
        assert episode(5, method=method)[1][-1]["objective"] == pytest.approx(base, rel=3e-4)


def test_actions_may_be_ignored():
    ignored, zero = (
        episode(3, action_mode="none", action=np.full(1, a, np.float32))[0] for a in (1.0, 0.0)
    )
    assert_array_equal(ignored, zero)


def test_contact_forces_as_actions_hold_the_object():
    """The optimum of the solver, given as an action, is commanded without a solver, and the object
    stays."""
    force = episode(5, disturbance="none")[1][-1]["commanded_force"]
    scale = 8.0
    action = force / scale - [1.0, 0.0, 0.0]
    given = {"action_mode": "contact_force", "agent": {"action_scale": scale}}
    infos = episode(10, disturbance="none", action=action.reshape(-1).astype(np.float32), **given)[
        1
    ]
    for info in infos:
        assert_allclose(info["commanded_force"], force, atol=1e-5)
        assert (info["iterations"], info["status"], info["terminated"]) == (0, "none", False)
    assert_allclose(infos[-1]["measured_force"], force, atol=0.05)
    far, edge = (
        episode(2, action=np.tile(np.float32([a, 0, 0]), 4), **given)[0] for a in (3.0, 1.0)
    )
    assert_array_equal(far, edge)  # clipped to the box


def test_broken_rules_end_the_episode():
    broken = False
    calls = []

    def rule(grasp: Any, wrench: np.ndarray) -> np.ndarray:
        calls.append(wrench)
        return initial_rule("single_value")(grasp, wrench) * (np.nan if broken else 1.0)

    env = FourFingerGrasp(initial_force=rule)
    env.reset(seed=0)
    assert env.step(ZERO)[4]["status"] == "optimal"
    assert calls
    broken = True
    obs, reward, terminated, truncated, info = env.step(ZERO)
    assert (terminated, truncated, info["is_success"]) == (True, False, False)
    assert info["failure"] == "force_optimisation"
    assert (info["status"], info["iterations"]) == ("failed", 0)
    assert np.isfinite([*obs, reward]).all()
    broken = False
    env.reset(seed=0)
    assert env.step(ZERO)[4]["status"] == "optimal"
    env.close()
    assert iterations(5, initial_force="previous")[-1] <= 1


def test_the_wrench_of_a_reset_lasts_one_episode():
    wrench = np.array([0.5, 0.2, -0.4, 0.02, 0.03, -0.04])
    env = FourFingerGrasp(disturbance="random")
    env.reset(seed=0, options={"wrench": wrench})
    for _ in range(40):
        info = env.step(ZERO)[4]
    assert_allclose(
        info["wrench"], wrench + np.array([0.0, -0.2 * 9.81, 0.0, 0.0, 0.0, 0.0]), atol=5e-3
    )
    env.reset(seed=0)
    assert not np.allclose(env.step(ZERO)[4]["wrench"], info["wrench"], atol=1e-2)
    env.close()


def test_pictures_change_nothing():
    settings: dict[str, Any] = {"disturbance": "random", "randomize": ("mass",)}
    env = FourFingerGrasp(render_mode="rgb_array", **settings)
    rows = [episode(5, **settings)[0]]
    for each in (env, pickle.loads(pickle.dumps(env))):
        seen = [each.reset(seed=3)[0]]
        for _ in range(5):
            if each is env:
                frame = env.render()
                assert isinstance(frame, np.ndarray)
                assert frame.dtype == np.uint8
                assert frame.std() > 10  # a picture, not a blank
            seen.append(each.step(ZERO)[0])
        each.close()
        rows.append(np.array(seen))
    assert_array_equal(rows[0], rows[1])
    assert_array_equal(rows[0], rows[2])


def test_pictures_are_in_the_world_frame():
    def push(times: np.ndarray, rng: np.random.Generator, settings: Any) -> np.ndarray:
        return np.where(times[:, None] > 0.5, [300.0, 0.0, 0.0, 0.0, 0.0, 0.0], 0.0)

    env = FourFingerGrasp(
        render_mode="rgb_array",
        task={"name": "move", "motion": "rotate"},
        disturbance=push,
        controller=NO_SPRINGS,
    )
    env.reset(seed=0)
    for _ in range(25):
        env.step(ZERO)
    # the object is turned by 16 degrees
    assert np.trace(env.scene.look().rotation) < 1.0 + 2.0 * np.cos(0.28)
    note = env._annotation(env.scene)
    assert_allclose(note.forces.sum(axis=0), -note.wrench[:3], atol=1e-9)  # balance, N
    moments = np.cross(note.points - note.center, note.forces).sum(axis=0)
    assert_allclose(moments, -note.wrench[3:], atol=1e-4)
    assert_allclose(note.measured, note.forces, atol=0.05)
    along = (note.forces * note.normals).sum(axis=1) / np.linalg.norm(note.forces, axis=1)
    assert (along > np.cos(np.arctan(note.friction))).all()
    assert_allclose(note.wrench[1], -9.81 * env.scene.config.object.mass, rtol=0.01)
    while not env.step(ZERO)[2]:
        pass
    note = env._annotation(env.scene)
    assert note.title == "move: rotate, push"
    assert (note.hand, note.alarm[:6]) == ("four finger", "lost: ")
    assert note.lines[0] == ("lost after", f"{env._tick * env._loop.dt:.2f} s")
    assert note.lines[1] == ("drift", f"{1e3 * env._outcome.drift:.2f} mm")
    env.reset(seed=0, options={"wrench": np.zeros(6)})
    later = env._annotation(env.scene)
    # lighter loads are drawn at the same scale
    assert (later.scale, later.turn) == (note.scale, note.turn)
    env.close()
    fixed = FourFingerGrasp(render_mode="rgb_array", pictures={"force": 8.0, "moment": 1e-3})
    fixed.reset(seed=0)
    assert (seen := fixed._annotation(fixed.scene)).scale == LONGEST / 8.0 != later.scale
    assert seen.turn == LONGEST_TURN / 0.02  # at least 0.02 N m
    fixed.close()
