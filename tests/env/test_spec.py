"""The specification of an environment in JSON makes the same environment again."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import trimesh
from engines import needs_bullet
from gymnasium.envs.registration import EnvSpec
from hands import gripper

from grasp_env.config import (
    AgentSettings,
    ControllerSettings,
    EnvConfig,
    EpisodeLimits,
    PictureSettings,
    RewardSettings,
    SensorSettings,
    SolverSettings,
)
from grasp_env.force.initial import LinearCombination
from grasp_env.sim import BulletEngine, HandDescription, MujocoEngine, ObjectDescription
from grasp_env.sim.config import SceneConfig
from grasp_env.task import Impulses, Move, Payload, RandomWrench

ID = "grasp_env:FourFingerGrasp-v0"
FOUR = HandDescription.four_finger()
POINTS = np.array(SceneConfig().contact_points)


def restored(spec: EnvSpec | None) -> EnvSpec:
    """Return a specification that went through strict JSON."""
    assert spec is not None
    text = spec.to_json()
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    return EnvSpec.from_json(text)


def rows(env: gym.Env[Any, Any]) -> bytes:
    """Return the bits of 20 steps with actions of a fixed seed, and close the environment."""
    env.action_space.seed(3)
    found = [env.reset(seed=7)[0]]
    for _ in range(20):
        observed, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        found += [observed, np.array([reward, terminated, truncated], dtype=np.float32)]
        if terminated or truncated:
            break
    env.close()
    return b"".join(np.asarray(row).tobytes() for row in found)


SETTINGS: dict[str, dict[str, Any]] = {
    "none": {},
    "hand by record": {
        "hand": HandDescription.allegro(),
        "disturbance": RandomWrench(force=0.3),
        "config": EnvConfig(),
    },
    "hand of your own": {"hand": FOUR.moved((0.0, 0.001, 0.0)), "task": Move("rotate", period=0.8)},
    "placed hand": {
        "hand": gripper(3, 3),
        "shape": "sphere",
        "size": 0.06,
        "approach": np.array([0.0, 0.0, -1.0]),
    },
    "object after one of its settings": {
        "mass": 0.3,
        "object": ObjectDescription("sphere", (0.08,), mass=0.15, friction=0.7),
    },
    "all small records": {
        "sensors": SensorSettings(delay=0.004, pose_noise=1e-5),
        "solver": SolverSettings(tolerance=1e-5),
        "controller": ControllerSettings(squeeze=30.0),
        "agent": AgentSettings(action_mode="contact_force"),
        "reward": RewardSettings(force=0.2),
        "limits": EpisodeLimits(duration=0.2),
        "pictures": PictureSettings(size=(64, 48)),
        "duration": 0.3,
        "sensors.tactile_noise": 0.01,
    },
    "records in a record": {
        "config": EnvConfig(
            hand=FOUR.moved((0.0, 0.001, 0.0)),
            sensors=SensorSettings(pose_noise=1e-5),
            task=Payload(factor=1.5),
        ),
        "sensors": {"delay": 0.004},
    },
    "records in a dict": {
        "config": {"schema": 1, "hand": FOUR, "disturbance": Impulses(force=2.0)}
    },
    "text": {"config": EnvConfig(disturbance=RandomWrench(force=0.3)).to_json()},
    "numpy": {
        "gravity": np.array([0.0, -9.0, 0.0]),
        "contact_points": POINTS,
        "friction": np.float32(0.5),
        "mass": np.array(0.25),
        "sensors": {"delay": np.float64(0.004)},
        "solver.max_iterations": np.int64(40),
    },
    "ranges": {
        "randomize": {"mass": np.array([0.1, 0.2]), "sensors.delay": (0.0, 0.004)},
        "disturbance": "random",
    },
    "names of what is drawn": {"randomize": ("mass", "friction")},
    "pairs of what is drawn": {"randomize": EnvConfig(randomize={"mass": (0.1, 0.3)}).randomize},
    "short episode": {"max_episode_steps": 7},
    "long episode": {"max_episode_steps": 300, "duration": 0.1},
    "dict": {"observation": "dict", "method": "newton", "action_mode": "none"},
    "engine": {"engine": MujocoEngine(cone="pyramidal")},
}


@pytest.mark.filterwarnings("error")
@pytest.mark.filterwarnings("ignore::grasp_env.errors.GraspWarning")
@pytest.mark.parametrize("name", SETTINGS)
def test_json_makes_the_same_environment(name):
    env = gym.make(ID, **SETTINGS[name])
    bare: Any = env.unwrapped
    assert env.spec is not None
    json.dumps(env.spec.kwargs, allow_nan=False)  # the keywords are JSON themselves
    expected = None
    for spec in (
        restored(env.spec),
        env.spec,
        pickle.loads(pickle.dumps(env.spec)),
        copy.deepcopy(env.spec),
    ):
        made = gym.make(spec)
        again: Any = made.unwrapped
        assert again.config == bare.config
        assert made.spec == env.spec
        assert restored(made.spec) == restored(env.spec)
        if expected is None:
            expected = rows(env) if name != "dict" else b""
            assert (rows(made) if name != "dict" else b"") == expected
        made.close()
    env.close()


@needs_bullet
def test_settings_of_the_engine_and_a_mesh_survive_json(tmp_path):
    path = tmp_path / "brick.stl"
    trimesh.creation.box((60, 80, 70)).export(path)
    item = ObjectDescription.from_mesh(path, scale=0.001, friction=0.6)
    for given in (item, {"shape": "mesh", "mesh": path, "size": np.array([0.001])}):
        env = gym.make(ID, object=given, engine=BulletEngine(solver_iterations=30))
        made = gym.make(restored(env.spec))
        assert made.unwrapped.config == env.unwrapped.config
        assert rows(made) == rows(env)


def test_many_environments_have_json():
    given: dict[str, Any] = {
        "disturbance": RandomWrench(force=0.3),
        "hand": FOUR.moved((0.0, 0.001, 0.0)),
    }
    many = gym.make_vec(ID, 2, "sync", **given)
    again = gym.make_vec(restored(many.spec))
    assert again.num_envs == 2
    for envs in (many, again):
        first: Any = envs.reset(seed=3)[0]
        assert first.shape == (2, 83)
        assert {env.unwrapped.config for env in envs.envs} == {
            gym.make(ID, **given).unwrapped.config
        }
        envs.close()
    single = gym.make(ID, **given)
    assert gym.make_vec(restored(single.spec), 2).num_envs == 2
    env = gym.make(
        ID, render_mode="rgb_array_list", pictures=PictureSettings(size=(64, 48)), **given
    )
    made = gym.make(restored(env.spec))
    assert made.render_mode == "rgb_array_list"
    assert made.spec == env.spec


def test_lengths_of_episodes_can_be_changed():
    """`gym.make` completes the environment of a specification, too."""
    env = gym.make(ID, disturbance="none")
    for spec in (env.spec, restored(env.spec)):
        assert spec is not None
        for steps in (3, 150):
            made = gym.make(spec, max_episode_steps=steps)
            assert made.unwrapped.config.limits.duration == steps / 50
            assert made.spec is not None
            assert made.spec.max_episode_steps == steps
            made.close()
    with pytest.warns(UserWarning, match="actions change nothing"):
        gym.make(env.spec, method="newton").close()
    env.close()


@dataclass(frozen=True)
class Gusts:
    """A user's disturbance that is a dataclass, which `EnvSpec.to_json` alone would write as a
    dict."""

    force: float = 1.0

    def __call__(self, times: np.ndarray, rng: np.random.Generator, settings: object) -> np.ndarray:
        return np.full((len(times), 6), self.force)


@dataclass(frozen=True)
class Breeze(RandomWrench):
    """A user's record, which is in no table."""


@dataclass(frozen=True)
class BetterSensors(SensorSettings):
    """A user's record of another class than the one that reads it."""


class OwnHand(HandDescription):
    """A user's hand of another class than the one that reads it."""


WITHOUT: list[tuple[dict[str, Any], str]] = [
    (
        {"disturbance": lambda times, rng, settings: np.zeros((len(times), 6))},
        "disturbance is <function",
    ),
    (
        {"disturbance": Gusts()},
        r"disturbance is Gusts\(force=1.0\), which has no JSON: .* give your own when the environment",
    ),
    ({"disturbance": Breeze()}, r"disturbance is Breeze\("),
    ({"hand": OwnHand(**vars(FOUR))}, r"hand is OwnHand\("),
    ({"sensors": BetterSensors()}, r"sensors is BetterSensors\("),
    ({"initial_force": LinearCombination()}, r"initial_force is LinearCombination\("),
    (
        {"solver": SolverSettings(initial_force=LinearCombination())},
        r"solver.initial_force is LinearCombination\(",
    ),
    (
        {"randomize": {"mass": (0.1, 0.2), "gravity": lambda rng: (0.0, -9.0, 0.0)}},
        r"randomize\['gravity'\] is <function",
    ),
    ({"config": EnvConfig(disturbance=Gusts())}, r"disturbance is Gusts\("),
    ({"config": {"schema": 1, "disturbance": Gusts()}}, r"disturbance is Gusts\("),
]


@pytest.mark.parametrize(("given", "message"), WITHOUT, ids=range(len(WITHOUT)))
def test_what_has_no_json_is_named(given, message):
    env = gym.make(ID, object=ObjectDescription("sphere"), **given)
    assert env.spec is not None
    with pytest.raises(TypeError, match=message):
        env.spec.to_json()
    assert env.spec.kwargs["object"]["shape"] == "sphere"
    made = gym.make(env.spec)
    assert made.unwrapped.config == env.unwrapped.config
    many = gym.make_vec(ID, 1, **given)
    with pytest.raises(TypeError, match=message):
        many.spec.to_json()
    for each in (env, made, many):
        each.close()


@pytest.mark.filterwarnings("ignore:`:UserWarning")  # for each description that a dataset lacks
@pytest.mark.filterwarnings(
    "ignore:Implicitly cleaning up:ResourceWarning"
)  # Minari leaves this to Python
def test_minari_recovers_an_environment(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = gym.make(
        ID, hand=FOUR.moved((0.0, 0.001, 0.0)), disturbance=RandomWrench(force=0.3), duration=0.1
    )
    collector = minari.DataCollector(env, record_infos=False)
    collector.reset(seed=0)
    while not any(collector.step(env.action_space.sample())[2:4]):
        pass
    data = collector.create_dataset("grasp/four-v0")
    recovered = minari.load_dataset("grasp/four-v0").recover_environment()
    assert (data.total_episodes, data.total_steps) == (1, 5)
    collector._tmp_dir.cleanup()
    assert rows(recovered) == rows(env)
