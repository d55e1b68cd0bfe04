"""The public environment: contracts of Gymnasium and stable-baselines3, tasks, objects, hands, sensors, actions."""

from __future__ import annotations

import pickle
import re

import gymnasium as gym
import numpy as np
import pytest
from episodes import episode

from grasp_env.config.records import ACTION_MODES
from grasp_env.env import observation
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError
from grasp_env.force import initial_rule
from grasp_env.sim.picture.annotation import LONGEST, LONGEST_TURN

ZERO = np.zeros(6, dtype=np.float32)
DOC = FourFingerGrasp.__doc__ or ""


def block(obs: np.ndarray, name: str, tips: int = 4, joints: int = 12) -> np.ndarray:
    """The named part of an observation."""
    named = {field.name: field.key for field in observation.fields(tips, joints)}
    return observation.Observer(tips, joints).named(obs)[named[name]].reshape(-1)


def test_observation_table_matches_docstring_and_space():
    rows = [line.strip() for line in DOC.splitlines()]
    table, index = [], 0
    for block in observation.fields():
        last = index + block.size - 1
        where = f"{index}" if block.size == 1 else f"{index}-{last}"
        table.append(f"| {where} | `{block.key}` | {block.name} | {block.unit} | {block.frame} | {block.bound:g} |")
        index = last + 1
    start = rows.index(table[0])
    assert rows[start : start + len(table)] == table  # all of it, in order, and no row more
    assert not rows[start + len(table)].startswith("|")
    env = FourFingerGrasp()
    size = env.observation_space.shape[0]
    assert size == sum(field.size for field in observation.fields())
    assert f"({size},)" in DOC
    high = env.observation_space.high
    for line in table:  # the ranges of the table cover every index once, with the bound of the space
        index, _, _, _, _, bound = (part.strip() for part in line.strip("|").split("|"))
        first, last = (int(part) for part in (index.split("-") if "-" in index else (index, index)))
        np.testing.assert_array_equal(high[first : last + 1], np.float32(float(bound)))
    assert last == size - 1
    env.close()


@pytest.mark.parametrize("steps", [0, 7])
def test_observation_holds_what_the_table_says(steps):
    env = FourFingerGrasp(disturbance="random")
    obs, info = env.reset(seed=1)
    for _ in range(steps):
        obs, _, _, _, info = env.step(ZERO)
    s = env.scene.look()
    wrench = np.concatenate([block(obs, "wrench to balance: force"), block(obs, "wrench to balance: moment")])
    for seen, known in (
        (wrench, info["wrench"]),
        (block(obs, "object position minus the wanted one"), s.position),
        (block(obs, "object linear velocity minus the wanted one"), s.linear),
        (block(obs, "object angular velocity minus the wanted one"), s.angular),
        (block(obs, "contact point"), s.points),
        (block(obs, "inward normal"), s.normals),
        (block(obs, "commanded force (normal, o, t)"), info["commanded_force"]),
        (block(obs, "measured force (normal, o, t)"), info["measured_force"]),
        (block(obs, "touching"), s.touching),
        (block(obs, "joint angle"), s.angles),
        (block(obs, "solver friction"), 0.85 * 0.4),
    ):
        np.testing.assert_allclose(seen, np.ravel(known), rtol=1e-6)
    # the normal component of the measured force, and its size, do not depend on the tangents
    np.testing.assert_allclose(info["measured_force"][:, 0], np.einsum("nk,nk->n", s.normals, s.forces), rtol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(info["measured_force"], axis=1), np.linalg.norm(s.forces, axis=1), rtol=1e-9
    )
    if steps == 0:  # the grasp that holds, within 1 % of the weight
        total = s.rotation @ s.forces.sum(axis=0)
        np.testing.assert_allclose(total, [0.0, 0.2 * 9.81, 0.0], atol=0.01 * 0.2 * 9.81)
        assert info["touching"].all()
        assert (info["contacts"], info["force_closure"], info["contact_changes"]) == (4, True, 0)
        assert (info["status"], info["failure"], info["time"]) == ("none", "", 0.0)
    else:
        assert info["time"] == pytest.approx(steps / 50)
    env.close()


def test_a_dict_of_named_parts_has_the_same_numbers():
    env, second = (FourFingerGrasp(observation="dict", disturbance="random") for _ in range(2))
    other, flat, space = (
        FourFingerGrasp(disturbance="random"),
        gym.wrappers.FlattenObservation(second),
        env.observation_space,
    )
    for seed in (3, 4):
        parts, vector = env.reset(seed=seed)[0], other.reset(seed=seed)[0]
        flattened = flat.reset(seed=seed)[0]
        for _ in range(4):
            assert space.contains(parts)
            assert parts["commanded_force"].shape == (12,)
            np.testing.assert_array_equal(np.concatenate([parts[field.key] for field in observation.fields()]), vector)
            np.testing.assert_array_equal(np.sort(flattened), np.sort(vector))
            parts, vector, flattened = (each.step(ZERO)[0] for each in (env, other, flat))
    for each in (env, other, flat):
        each.close()
    assert {field.key for field in observation.fields()} == set(space.keys())


@pytest.mark.parametrize(
    "settings",
    [{}, *({"controller.kind": kind} for kind in ("pd", "constant_squeeze")), {"action_mode": "contact_force"}, {"agent.info": "numbers"}],
)  # fmt: skip
def test_info_keys_are_documented_and_constant(settings):
    """torchrl's reader, which makes tensors of infos, asks each value for its dtype, and knows no words."""
    env = FourFingerGrasp(**settings)
    _, first = env.reset(seed=0)
    terminated = False
    infos = [env.step(np.zeros(env.action_space.shape, dtype=np.float32))[4]]
    env.reset(seed=0, options={"wrench": [0, 0, 0, 0, 0, 4.0]})
    while not terminated:
        _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
        infos.append(info)
        assert not truncated
    for info in infos:
        assert first.keys() == info.keys()
        for key, value in info.items():
            assert type(value) is type(first[key]), key
            assert np.shape(value) == np.shape(first[key]), key
            if settings.get("agent.info") == "numbers":
                assert (value.dtype, value.dtype.kind in "fib") == (first[key].dtype, True), key
            if not isinstance(value, str):
                assert np.isfinite(value).all(), key
    documented = set(re.findall(r"`([a-z_]+)`", DOC.split("## Info")[1].split("## Reset")[0]))
    assert {key for key in first if not key.startswith("reward/")} <= documented
    env.close()


def iterations(steps: int = 4, action: float = 0.0, **settings) -> list[int]:
    return [info["iterations"] for info in episode(steps, action=np.full(6, action, dtype=np.float32), **settings)[1]]


def test_actions_move_the_start_of_every_optimization_and_not_the_optimum():
    """Also of the first; zero is the rule itself."""
    assert iterations() == iterations(initial_force="linear_combination")
    assert all(a != b for a, b in zip(iterations(), iterations(action=-1.0), strict=True))
    assert iterations(action=-1.0, agent={"action_scale": 1e-9}) == iterations()
    base, moved = (episode(5, action=np.full(6, a, dtype=np.float32))[1][-1]["objective"] for a in (0.0, -0.5))
    assert moved == pytest.approx(base, rel=3e-4)
    for method in ("newton", "full_flow"):
        assert episode(5, method=method)[1][-1]["objective"] == pytest.approx(base, rel=3e-4)


def test_action_modes():
    for mode, size in zip(ACTION_MODES, (6, 12, 1), strict=True):
        env = FourFingerGrasp(action_mode=mode)
        assert env.action_space == gym.spaces.Box(-1.0, 1.0, (size,))
        env.close()
    zero, one = (episode(10, action_mode="none", action=np.full(1, a, dtype=np.float32))[0] for a in (0.0, 1.0))
    np.testing.assert_array_equal(zero, one)  # ignored
    np.testing.assert_array_equal(zero, episode(10)[0])
    far, edge = (
        episode(4, action_mode="contact_force", action=np.tile(np.float32([a, 0.0, 0.0]), 4))[1][-1] for a in (3.0, 1.0)
    )
    np.testing.assert_array_equal(far["commanded_force"], edge["commanded_force"])  # clipped to the box


def test_contact_forces_as_actions_hold_the_object():
    """The optimum of the solver, given as an action, is commanded as it is: no solver, and the object stays."""
    env = FourFingerGrasp(disturbance="none", action_mode="none")
    env.reset(seed=0)
    for _ in range(5):
        info = env.step(np.zeros(1, dtype=np.float32))[4]
    force = info["commanded_force"]
    env.close()
    scale = 8.0
    action = force / scale
    action[:, 0] -= 1.0
    env = FourFingerGrasp(disturbance="none", action_mode="contact_force", agent={"action_scale": scale})
    env.reset(seed=0)
    for _ in range(10):
        _, _, terminated, _, info = env.step(action.reshape(-1).astype(np.float32))
        np.testing.assert_allclose(info["commanded_force"], force, atol=1e-5)
        assert (info["iterations"], info["status"]) == (0, "none")
        assert not terminated
    np.testing.assert_allclose(info["measured_force"], force, atol=0.05)
    env.close()


def test_initial_force_takes_any_rule():
    calls = []

    def rule(grasp, wrench):
        calls.append(wrench)
        return initial_rule("single_value")(grasp, wrench)

    infos = episode(3, initial_force=rule)[1]
    assert len(calls) >= 3
    assert all(info["status"] == "optimal" for info in infos)
    assert iterations(5, initial_force="previous")[-1] <= 1
    with pytest.raises(GraspError, match="misses balance"):  # already when the hand is made
        FourFingerGrasp(initial_force=lambda grasp, wrench: np.ones((4, 3)))


def test_a_rule_that_breaks_mid_episode_ends_it_without_stale_numbers():
    broken = False

    def rule(grasp, wrench):
        force = initial_rule("linear_combination")(grasp, wrench)
        return force * np.nan if broken else force

    env = FourFingerGrasp(initial_force=rule)
    env.reset(seed=0)
    assert env.step(ZERO)[4]["status"] == "optimal"
    broken = True
    obs, reward, terminated, truncated, info = env.step(ZERO)
    assert terminated
    assert not truncated
    assert (info["failure"], info["status"], info["iterations"]) == ("force_optimisation", "failed", 0)
    assert np.isfinite(obs).all()
    assert np.isfinite(reward)
    assert not info["is_success"]
    broken = False
    env.reset(seed=0)
    assert env.step(ZERO)[4]["status"] == "optimal"
    env.close()


def test_a_constant_wrench_of_the_reset():
    wrench = np.array([0.5, 0.2, -0.4, 0.02, 0.03, -0.04])
    env = FourFingerGrasp(disturbance="random")
    env.reset(seed=0, options={"wrench": wrench})
    for _ in range(40):
        info = env.step(ZERO)[4]
    np.testing.assert_allclose(info["wrench"], wrench + np.array([0.0, -0.2 * 9.81, 0.0, 0.0, 0.0, 0.0]), atol=1e-3)
    env.reset(seed=0)  # the next episode is as configured
    assert not np.allclose(env.step(ZERO)[4]["wrench"], info["wrench"], atol=1e-2)
    env.close()


def test_pictures_change_nothing_and_copies_are_equal():
    env = FourFingerGrasp(render_mode="rgb_array", disturbance="random", randomize=("mass",))
    copy, rows = pickle.loads(pickle.dumps(env)), []
    for each in (env, copy):
        seen = [each.reset(seed=3)[0]]
        for _ in range(5):
            if each is env:
                frame = env.render()
                assert isinstance(frame, np.ndarray)
                assert frame.dtype == np.uint8
                assert frame.std() > 10  # a picture, not a blank
            seen.append(each.step(ZERO)[0])
        each.close()
        rows.append(seen)
    rows.append(episode(5, disturbance="random", randomize=("mass",))[0])
    np.testing.assert_array_equal(rows[0], rows[1])
    np.testing.assert_array_equal(rows[0], rows[2])


def scales(env, seed):
    env.reset(seed=seed)
    found = set()
    for _ in range(12):
        env.step(ZERO)
        note = env._annotation(env.scene)
        found.add((note.scale, note.turn))
        drawn = [
            note.scale * np.linalg.norm(note.forces, axis=1),
            2.0 * note.scale * np.linalg.norm(note.wrench[:3]),
        ]
        assert max(map(np.max, drawn)) < 1.2 * LONGEST  # the plan knows no pose feedback
    assert len(found) == 1
    return found.pop()


def test_pictures_of_an_episode_have_one_scale_and_later_ones_never_a_larger_one():
    env = FourFingerGrasp(render_mode="rgb_array", disturbance="random", duration=0.3)
    found = np.array([scales(env, seed) for seed in range(6)])
    assert (np.diff(found, axis=0) <= 0.0).all()
    assert (found[-1] < found[0]).all()
    env.close()
    fixed = FourFingerGrasp(render_mode="rgb_array", duration=0.3, pictures={"force": 8.0, "moment": 2.0})
    np.testing.assert_allclose(scales(fixed, 0), [LONGEST / 8.0, LONGEST_TURN / 2.0])
    fixed.close()
    small = FourFingerGrasp(render_mode="rgb_array", duration=0.3, pictures={"force": 1e-3, "moment": 1e-3})
    small.reset(seed=0)  # what is near nothing is not blown up
    note = small._annotation(small.scene)
    np.testing.assert_allclose([note.scale, note.turn], [LONGEST / 0.1, LONGEST_TURN / 0.02])
    small.close()


def test_a_picture_is_in_the_world_frame():
    env = FourFingerGrasp(render_mode="rgb_array", task={"name": "move", "motion": "rotate"}, disturbance="none")
    env.reset(seed=0)
    for _ in range(25):
        env.step(ZERO)
    assert np.trace(env.scene.look().rotation) < 1.0 + 2.0 * np.cos(0.28)  # the object is turned by 16 degrees
    note = env._annotation(env.scene)
    np.testing.assert_allclose(note.forces.sum(axis=0), -note.wrench[:3], atol=1e-9)  # balance, N
    np.testing.assert_allclose(
        np.cross(note.points - note.center, note.forces).sum(axis=0), -note.wrench[3:], atol=1e-4
    )
    np.testing.assert_allclose(note.measured, note.forces, atol=0.05)
    along = (note.forces * note.normals).sum(axis=1) / np.linalg.norm(note.forces, axis=1)
    assert (along > np.cos(np.arctan(note.friction))).all()
    np.testing.assert_allclose(note.wrench[1], -9.81 * env.scene.config.object.mass, rtol=0.01)
    env.close()
    env = FourFingerGrasp(
        render_mode="rgb_array", controller={"kind": "pd"}, disturbance={"name": "paper_path", "scale": 1.0}
    )
    env.reset(seed=0)
    env.step(ZERO)
    across = env.scene.look().rotation[:, 2]  # of the two faces that are touched
    assert abs(across[2]) < 0.9998
    np.testing.assert_allclose(np.abs(env._annotation(env.scene).normals @ across), 1.0, atol=1e-5)
    env.close()


def test_a_picture_says_what_disturbs_and_how_it_ended():
    def push(times, rng, settings):
        return np.tile([300.0, 0.0, 0.0, 0.0, 0.0, 0.0], (len(times), 1))

    env = FourFingerGrasp(render_mode="rgb_array", disturbance=push)
    env.reset(seed=0)
    while not env.step(ZERO)[2]:
        pass
    note = env._annotation(env.scene)
    assert (note.title, note.hand) == ("hold: push", "four finger")
    assert note.alarm.startswith("lost: ")
    assert note.lines[0] == ("lost after", f"{env._tick * env._loop.dt:.2f} s")
    assert note.lines[1] == ("drift", f"{1e3 * env._outcome.drift:.2f} mm")
    env.close()
