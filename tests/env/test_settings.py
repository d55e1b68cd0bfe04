"""Settings: descriptions, ways to give them, and what is drawn at a reset."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from episodes import random_object

from grasp_env.config import ControllerSettings, EnvConfig, SensorSettings, SolverSettings
from grasp_env.config.env import KEYWORDS, all_settings, as_config
from grasp_env.env.env import FourFingerGrasp
from grasp_env.settings import described
from grasp_env.sim import HANDS, BulletEngine, MujocoEngine, ObjectDescription
from grasp_env.task import Impulses, Move, RandomWrench
from grasp_env.task.disturbance import DISTURBANCES
from grasp_env.task.tasks import TASKS

ZERO = np.zeros(6, dtype=np.float32)


def test_settings_are_described_once():
    records = {
        EnvConfig,
        *(kind for _, kind, _ in described(EnvConfig)),
        *TASKS.values(),
        *DISTURBANCES.values(),
    }
    assert records > {
        SensorSettings,
        SolverSettings,
        ControllerSettings,
        ObjectDescription,
        BulletEngine,
        MujocoEngine,
        RandomWrench,
        Move,
    }
    for record in records:
        for item in fields(record):
            about = item.metadata["about"]
            assert f"    {item.name}: {about.doc} (" in (record.__doc__ or ""), (record, item.name)
            assert about.doc.endswith("."), item.name
            if item.default is not None:
                assert about.kind.take(item.default, item.name) == item.default or not item.default
    assert not set(KEYWORDS.values()) - set(all_settings())


def test_all_ways_give_the_same_settings():
    wanted = EnvConfig(
        object=ObjectDescription("sphere", (0.08,), mass=0.15),
        disturbance=Impulses(force=2.0),
        sensors=SensorSettings(delay=0.004),
        solver=SolverSettings(method="newton"),
    )
    given: dict[str, Any] = {
        "sensors": {"delay": 0.004},
        "disturbance": {"name": "impulses", "force": 2.0},
    }
    paths: dict[str, Any] = {
        "object.shape": "sphere",
        "object.size": [0.08],
        "object.mass": 0.15,
        "disturbance": "impulses",
        "disturbance.force": 2.0,
        "sensors.delay": 0.004,
        "solver.method": "newton",
    }
    for made in (
        EnvConfig().override(shape="sphere", size=0.08, mass=0.15, method="newton", **given),
        EnvConfig().override(
            **{"object.mass": 0.15, "shape": "sphere", "object": {"size": (0.08,)}},
            method="newton",
            **given,
        ),
        EnvConfig().override(**paths),
        as_config(wanted.to_json()),
        as_config(wanted.to_dict()),
        pickle.loads(pickle.dumps(wanted)),
    ):
        assert (made, hash(made)) == (wanted, hash(wanted))
    changed = wanted.override(sensors={"pose_noise": 1e-5}, disturbance={"moment": 0.0}, mass=0.2)
    assert changed.sensors == SensorSettings(delay=0.004, pose_noise=1e-5)
    assert changed.disturbance == Impulses(2.0, 0.0)
    assert (changed.object.shape, changed.object.mass) == ("sphere", 0.2)
    # another shape has its own size
    assert wanted.override(shape="cylinder").object.size == (0.1, 0.1)
    env = FourFingerGrasp(config=wanted.override(mass=0.2).to_json(), mass=0.15)
    assert env.config == wanted.resolved()
    env.close()


def test_json_keeps_everything(monkeypatch):
    @dataclass(frozen=True)
    class Wind(RandomWrench):
        """A disturbance of one more entry of the table."""

        name = "wind"

    monkeypatch.setitem(DISTURBANCES, "wind", Wind)
    config = EnvConfig().override(
        task=Move("rotate", size=0.2),
        engine={"name": "mujoco", "cone": "pyramidal"},
        hand=HANDS["allegro"](),
        shape="capsule",
        randomize={"mass": (0.1, 0.2), "shape": True, "sensors.delay": (0.0, 0.01)},
        contact_points=(),
        duration=1.0,
        disturbance={"name": "wind", "force": 1.0},
    )
    told = json.loads(config.to_json())
    assert (told["schema"], told["hand"]) == (1, {"name": "allegro"})
    assert told["disturbance"]["name"] == "wind"
    assert as_config(told) == config
    named = config.override(hand="allegro")
    assert as_config(named.to_json()) == named
    assert as_config(told).disturbance == Wind(force=1.0)


def test_what_is_drawn_reaches_the_episode():
    ranges: dict[str, Any] = {
        "mass": lambda rng: 0.1 + 0.1 * rng.random(),
        "friction": (0.4, 0.6),
        "gravity": lambda rng: (0.0, -9.81 + rng.uniform(-2.0, 2.0), 0.0),
        "motors.strength": (0.98, 1.0),
        "sensors.delay": lambda rng: 0.004 * rng.integers(3),
        "controller.friction_error": (-0.1, 0.1),
    }
    received: list[EnvConfig] = []

    def still(times: np.ndarray, rng: np.random.Generator, settings: EnvConfig) -> np.ndarray:
        received.append(settings)
        return np.zeros((len(times), 6))

    env = FourFingerGrasp(randomize=ranges, disturbance=still)
    found = []
    for seed in (0, 1, 1, 0):
        observation, info = env.reset(seed=seed)
        drawn, item = env.episode, env.scene.config.object
        assert received[-1] is drawn
        assert info["object_mass"] == item.mass == drawn.object.mass
        assert item.friction == drawn.object.friction
        np.testing.assert_array_equal(env.scene.gravity, drawn.gravity)
        assumed = 0.85 * drawn.object.friction * (1.0 + drawn.controller.friction_error)
        assert observation[-1] == pytest.approx(assumed, rel=1e-6)
        s = env.scene.look()
        assert (s.rotation @ s.forces.sum(axis=0))[1] == pytest.approx(
            item.mass * -drawn.gravity[1], rel=0.01
        )
        rows = np.array([env.step(ZERO)[0] for _ in range(5)]).tobytes()
        control = drawn.controller
        numbers = (item.mass, drawn.gravity[1], drawn.motors.strength, control.friction_error)
        found.append((rows, *numbers))
    env.close()
    assert found[0] == found[3]
    assert found[1] == found[2]
    assert all(len({row[k] for row in found}) == 2 for k in range(5))
    assert env.config.sensors == SensorSettings()  # the settings stay
    blind = FourFingerGrasp(
        randomize={"gravity": ranges["gravity"]}, sensors={"wrench": "none"}, disturbance="none"
    )
    _, info = blind.reset(seed=1)  # it still knows the drawn gravity
    np.testing.assert_allclose(info["wrench"][:3], 0.2 * np.array(blind.episode.gravity), atol=0.05)
    blind.close()
    usual = (
        EnvConfig(randomize=("shape", "size", "mass", "friction"))
        .drawn(np.random.default_rng(7))
        .object
    )
    assert usual == random_object(np.random.default_rng(7))


def test_what_is_kept_does_not_change_what_is_drawn():
    base = ObjectDescription("cylinder", (0.08, 0.1), inertia=(2e-4, 2e-4, 2e-4))

    def drawn(*names: str) -> EnvConfig:
        rules = {**dict.fromkeys(names, True), "sensors.delay": (0.0, 0.004)}
        return EnvConfig(object=base).override(randomize=rules).drawn(np.random.default_rng(7))

    one = drawn("friction")
    two = drawn("mass", "friction")
    three = drawn("size", "mass", "friction")
    assert one.object == replace(base, friction=two.object.friction)
    assert three.object == replace(two.object, size=three.object.size, inertia=None)
    assert three.object.size != base.size
    assert one.sensors == two.sensors == three.sensors
    assert drawn("shape").object.shape != drawn("size").object.shape == "cylinder"


def test_motors_deliver_a_part_of_the_command():
    """The hold takes 0.4 N m of 12, so motors that deliver 40 times the command are cut."""
    largest = []
    for strength in (0.9, 40.0):
        env = FourFingerGrasp(motors={"strength": strength})
        env.reset(seed=0)
        advance, loop = env.scene.advance, env._loop

        def check(
            torques: list[float],
            push: Any,
            advance: Any = advance,
            loop: Any = loop,
            share: float = strength,
        ) -> None:
            np.testing.assert_allclose(torques, np.clip(share * loop.torques, -12.0, 12.0))
            largest.append(float(np.abs(torques).max()))
            advance(torques, push)

        env.scene.advance = check
        env.step(ZERO)
        env.close()
    assert len(largest) == 10
    assert max(largest) == 12.0


def test_a_rule_of_length_zero_is_drawn():
    class Rule:
        def __len__(self) -> int:
            return 0

        def __call__(self, rng: np.random.Generator) -> float:
            return 0.123

    episode = EnvConfig(randomize={"mass": Rule()}).drawn(np.random.default_rng(0))
    assert episode.object.mass == 0.123
