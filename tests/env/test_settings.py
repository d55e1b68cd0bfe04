"""Settings: records that check themselves, names and paths in errors, keywords and dicts, JSON, what is drawn at a reset."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, fields, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from episodes import episode, random_object

from grasp_env.config import KEYWORDS, Controller, EnvConfig, Sensors, Solver, all_settings, as_config
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError, InvalidInputError, UnknownNameError, UnknownSettingError
from grasp_env.settings import Settings, described
from grasp_env.sim import HANDS, BulletEngine, HandDescription, MujocoEngine, ObjectDescription
from grasp_env.task import DISTURBANCES, TASKS, Impulses, Move, RandomWrench

ZERO = np.zeros(6, dtype=np.float32)
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"disturbance": "wind"}, r"unknown disturbance 'wind'.*'none'.*or give a function"),
    *(({"disturbance": given}, "unknown disturbance") for given in (5, ["none"], np.zeros((501, 6)))),
    ({"disturbance": {"force": 1.0}}, "disturbance needs a name"),
    ({"disturbance": {"name": "random", "force": -1.0}}, r"disturbance.force \[N\] must"),
    ({"disturbance": {"name": "random", "speed": 1.0}}, r"disturbance.speed': .*'disturbance.force'"),
    ({"disturbance": {"name": "constant", "value": (1, 2)}}, "disturbance.value"),
    ({"task": "juggle"}, "'hold', 'move', 'payload', 'six_directions'"),
    ({"task": {"name": "move", "motion": "throw"}}, "'throw'"),
    ({"task": "six_directions", "disturbance": "random"}, "pushes by itself"),
    ({"method": "magic"}, "unknown solver.method 'magic'"),
    ({"initial_force": "best"}, r"'linear_combination'.* or give a rule\(grasp, wrench\)"),
    ({"hand": "six_finger"}, "HandDescription.from_file"),
    ({"mass": float("nan")}, r"object.mass \[kg\]"),
    ({"mass": "heavy"}, r"object.mass \[kg\] must be a number"),
    ({"size": 30.0}, "object.size"),
    ({"object": 3}, "object must be a ObjectDescription, or a dict"),
    ({"contact_points": ((0.0, 0.0),)}, "contact_points"),
    ({"gravity": (0.0, float("inf"), 0.0)}, "gravity"),
    ({"engine": "bulet"}, r"unknown engine 'bulet': did you mean 'bullet'\? .* or give its settings"),
    ({"engine": {"name": "bullet", "rate": 100}}, "engine.rate must be a multiple of controller.rate, got 100 and 250"),
    ({"controller": {"rate": 333}}, "controller.rate must be a multiple of agent.rate, got 333 and 50"),
    ({"agent": {"rate": 0}}, r"agent.rate \[Hz\] must be an integer >= 1"),
    ({"action_mode": "torque"}, "agent.action_mode"),
    ({"controller": {"kind": "magic"}}, "'optimized', 'constant_squeeze', 'pd'"),
    ({"controller": {"motor_strength": 0.0}}, "controller.motor_strength must be a number > 0"),
    ({"sensors": {"wrench": "guessed"}}, "unknown sensors.wrench 'guessed'"),
    ({"sensors": {"delay": -0.1}}, r"sensors.delay \[s\] must be a number >= 0, got -0.1"),
    ({"sensors": {"delay": 1e6}}, "sensors.delay must be at most 4000 s"),
    ({"sensors": "exact"}, "sensors must be a Sensors, or a dict of its settings, got 'exact'"),
    ({"sensors": {"delay": -1.0}, "reward": {"held": "a"}}, r"sensors.delay .*; reward.held must"),
    ({"solver": {"max_iterations": 2.5}}, "solver.max_iterations"),
    ({"duration": 4001.0}, "a million|1000000 control ticks"),  # a plan of 0.7 GB
    ({"randomize": ("colour",)}, "'shape', 'size', 'mass', 'friction'"),
    ({"randomize": None}, "randomize must be a list of some of shape, size, mass, friction"),
    ({"randomize": {"mass": (0.3, 0.1)}}, "low <= high"),
    ({"randomize": {"mass": (0.0, 0.05)}}, "object.mass must be a number > 0"),
    ({"randomize": {"gravity": (1.0, 2.0)}}, "must be a function"),
    ({"randomize": {"sensors.delay": True}}, r"randomize\['sensors.delay'\]"),
    ({"randomize": {"solver.tolerance": (1e-6, 1e-3)}}, "unknown randomize 'solver.tolerance'"),
    ({"randomize": "size", "contact_points": ((0.0, 0.0, 0.05),)}, "contact_points belong to one shape"),
    ({"disturbance.force": 1.0}, "give disturbance a name"),
]


@pytest.mark.parametrize(("settings", "message"), WRONG, ids=str)
def test_wrong_settings_are_refused_with_their_path(settings: dict[str, Any], message: str) -> None:
    with pytest.raises((UnknownNameError, InvalidInputError), match=message):
        EnvConfig().override(**settings)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("frameskip", "settings are 'hand', 'object'"),
        ("disturbence", "did you mean 'disturbance'"),
        ("tolerance", "did you mean .*'solver.tolerance'"),
        ("motion", "did you mean 'task.motion'"),
        ("kind", "did you mean 'controller.kind'"),
        ("sensor_delay", "did you mean 'sensors.delay'"),
        ("object_mass", "did you mean 'object.mass'"),
        ("sensors.dely", "did you mean 'sensors.delay'"),
        ("sensors.delay.now", "sensors.delay.now"),
    ],
)
def test_an_unknown_keyword_is_told_where_the_setting_is(name: str, meant: str) -> None:
    for call in (EnvConfig().override, FourFingerGrasp, lambda **k: gym.make("grasp_env:FourFingerGrasp-v0", **k)):
        with pytest.raises(UnknownSettingError, match=meant):
            call(**{name: 1})
    assert issubclass(UnknownSettingError, TypeError)
    with pytest.raises(UnknownSettingError, match="got an unexpected keyword argument 'mas': did you mean 'mass'"):
        EnvConfig().override(mas=1)
    with pytest.raises(UnknownSettingError, match=r"task.size'.*\(none\)"):
        EnvConfig().override(task={"size": 0.01})  # holding has no settings


def every(record: type[Settings]) -> set[type[Settings]]:
    return {kind for _, kind, _ in described(record)} | {record}


def test_all_settings_have_one_description_and_no_record_is_large() -> None:
    records = every(EnvConfig) | set(TASKS.values()) | set(DISTURBANCES.values())
    assert records > {Sensors, Solver, Controller, ObjectDescription, BulletEngine, MujocoEngine, RandomWrench, Move}
    for record in records:
        assert len(fields(record)) <= 16, record
        for item in fields(record):
            assert f"    {item.name}: " in (record.__doc__ or ""), (record, item.name)
            about = item.metadata["about"]
            assert about.doc[0].isupper(), item.name
            assert about.doc.endswith("."), item.name
            assert about.kind.text, item.name
            if item.default is not None:  # what is the default may be given
                assert about.kind.take(item.default, item.name) == item.default or not item.default
    assert not set(KEYWORDS.values()) - set(all_settings())
    assert len(KEYWORDS) + len({"hand", "disturbance", "engine"}) == 12


def test_records_dicts_keywords_and_paths_say_the_same() -> None:
    wanted = EnvConfig(
        object=ObjectDescription("sphere", (0.08,), mass=0.15), disturbance=Impulses(force=2.0), sensors=Sensors(delay=0.004),
        solver=Solver(method="newton"),
    )  # fmt: skip
    given: dict[str, Any] = {"sensors": {"delay": 0.004}, "disturbance": {"name": "impulses", "force": 2.0}}
    paths: dict[str, Any] = {
        "object.shape": "sphere", "object.size": [0.08], "object.mass": 0.15, "disturbance": "impulses", "disturbance.force": 2.0,
        "sensors.delay": 0.004, "solver.method": "newton",
    }  # fmt: skip
    for made in (
        EnvConfig(object={"shape": "sphere", "size": (0.08,), "mass": 0.15}, solver={"method": "newton"}, **given),  # type: ignore[arg-type]
        EnvConfig().override(shape="sphere", size=0.08, mass=0.15, method="newton", **given),
        EnvConfig().override(**paths),
        as_config(wanted.to_json()),
        as_config(wanted.to_dict()),
        pickle.loads(pickle.dumps(wanted)),
    ):
        assert (made, hash(made)) == (wanted, hash(wanted))
    changed = wanted.override(sensors={"pose_noise": 1e-5}, disturbance={"moment": 0.0}, mass=0.2)
    assert (changed.sensors, changed.disturbance) == (Sensors(delay=0.004, pose_noise=1e-5), Impulses(2.0, 0.0))
    assert (changed.object.shape, changed.object.mass) == ("sphere", 0.2)
    assert wanted.override(shape="cylinder").object.size == (0.1, 0.1)  # another shape has its own size
    one, *others = (
        episode(4, **settings)[0]
        for settings in (
            {"config": wanted},
            {"config": wanted.to_json()},
            {"config": wanted.override(mass=0.2), "mass": 0.15},
        )
    )
    for other in others:
        np.testing.assert_array_equal(one, other)


def test_json_keeps_everything_and_refuses_what_it_cannot() -> None:
    config = EnvConfig().override(
        task=Move("rotate", size=0.2), engine={"name": "mujoco", "cone": "pyramidal"}, hand=HANDS["allegro"](), shape="capsule",
        randomize={"mass": (0.1, 0.2), "shape": True, "sensors.delay": (0.0, 0.01)}, contact_points=(), duration=1.0,
    )  # fmt: skip
    told = json.loads(config.to_json())
    assert told["schema"] == 1
    names = told["hand"], told["task"]["name"], told["engine"]["name"], told["disturbance"]
    assert names == ("allegro", "move", "mujoco", None)
    assert as_config(told) == config.override(hand="allegro")
    assert as_config({"schema": 1, "sensors": {"delay": 0.01}}) == EnvConfig(sensors=Sensors(delay=0.01))
    for settings, message in (
        ({"disturbance": lambda times, rng, settings: None}, "disturbance is <function .*no JSON"),
        ({"initial_force": lambda grasp, wrench: None}, "solver.initial_force is <function"),
        ({"randomize": {"gravity": lambda rng: (0, 0, 0)}}, r"randomize\['gravity'\] is <function"),
        ({"hand": HandDescription.allegro().moved((0.0, 0.1, 0.0))}, "hand is HandDescription.* no JSON"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            EnvConfig().override(**settings).to_json()
    for given, message in (
        ({"schema": 2}, "schema 2, this version reads 1: it is written by a newer version"),
        ({"schema": 0}, "too old"),
        ({}, '"schema": 1'),
        ([], '"schema": 1'),
    ):
        with pytest.raises(InvalidInputError, match=message):
            as_config(given)  # type: ignore[arg-type]
    for text in ("{", "3", "", 3):
        with pytest.raises(InvalidInputError, match="config must be"):
            as_config(text)  # type: ignore[arg-type]
    with pytest.raises(UnknownSettingError, match="colour"):
        as_config({"schema": 1, "colour": "red"})


def test_one_entry_adds_a_disturbance(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Wind(RandomWrench):
        """A wind."""

        name = "wind"

    monkeypatch.setitem(DISTURBANCES, "wind", Wind)
    made = EnvConfig().override(disturbance={"name": "wind", "force": 1.0})
    assert made.disturbance == Wind(force=1.0)
    assert as_config(made.to_json()) == made


def test_everything_that_may_be_drawn_is_drawn_of_the_seed_and_reaches_the_episode() -> None:
    ranges: dict[str, Any] = {
        "mass": lambda rng: 0.1 + 0.1 * rng.random(),
        "friction": (0.4, 0.6),
        "gravity": lambda rng: (0.0, -9.81 + rng.uniform(-2.0, 2.0), 0.0),
        "controller.motor_strength": (0.98, 1.0),
        "sensors.delay": lambda rng: 0.004 * rng.integers(3),
        "sensors.pose_noise": (0.0, 1e-5),
        "sensors.tactile_noise": (0.0, 0.02),
        "controller.friction_error": (-0.1, 0.1),
        "controller.force_noise": (0.0, 0.01),
    }
    told: list[EnvConfig] = []

    def still(times: np.ndarray, rng: np.random.Generator, settings: EnvConfig) -> np.ndarray:
        told.append(settings)
        return np.zeros((len(times), 6))

    env = FourFingerGrasp(randomize=ranges, disturbance=still)
    found = []
    for seed in (0, 1, 2, 1, 0):
        observation, info = env.reset(seed=seed)
        drawn, item = env.episode, env.scene.config.object
        assert told[-1] is drawn
        assert info["object_mass"] == item.mass == drawn.object.mass
        assert item.friction == drawn.object.friction
        np.testing.assert_array_equal(env.scene.gravity, drawn.gravity)
        believed = 0.85 * drawn.object.friction * (1.0 + drawn.controller.friction_error)
        assert observation[-1] == pytest.approx(believed, rel=1e-6)
        weight = item.mass * -drawn.gravity[1]
        s = env.scene.look()
        assert (s.rotation @ s.forces.sum(axis=0))[1] == pytest.approx(weight, rel=0.01)
        rows = [env.step(ZERO)[0] for _ in range(5)]
        values = (
            item.mass,
            drawn.gravity[1],
            drawn.controller.motor_strength,
            drawn.sensors.delay,
            drawn.sensors.pose_noise,
        )
        found.append((np.array(rows).tobytes(), *values))
    env.close()
    assert found[0] == found[4]
    assert found[1] == found[3]
    assert all(len({row[k] for row in found}) == 3 for k in (0, 1, 2, 3, 5))
    assert env.config.sensors == Sensors()  # the settings stay
    blind = FourFingerGrasp(
        randomize={"size": True, "gravity": ranges["gravity"]}, sensors={"wrench": "none"}, disturbance="none"
    )
    for seed in (0, 1):
        _, info = blind.reset(seed=seed)
        np.testing.assert_array_equal(blind.scene.gravity, blind.episode.gravity)
        np.testing.assert_allclose(info["wrench"][:3], 0.2 * np.array(blind.episode.gravity), atol=0.05)
    blind.close()
    usual = EnvConfig(randomize=("shape", "size", "mass", "friction")).drawn(np.random.default_rng(7)).object
    assert usual == random_object(np.random.default_rng(7))


def test_what_is_kept_of_the_object_does_not_change_what_is_drawn() -> None:
    base = ObjectDescription("cylinder", (0.08, 0.1), inertia=(2e-4, 2e-4, 2e-4))

    def drawn(*names: str) -> EnvConfig:
        rules = {**dict.fromkeys(names, True), "sensors.delay": (0.0, 0.004)}
        return EnvConfig(object=base).override(randomize=rules).drawn(np.random.default_rng(7))

    one, two, three = drawn("friction"), drawn("mass", "friction"), drawn("size", "mass", "friction")
    assert one.object == replace(base, friction=two.object.friction)
    assert three.object == replace(two.object, size=three.object.size, inertia=None)
    assert three.object.size != base.size
    assert one.sensors == two.sensors == three.sensors


def test_weak_motors_deliver_a_part_of_what_is_commanded() -> None:
    def rates(**settings: Any) -> np.ndarray:
        env = FourFingerGrasp(disturbance="none", **settings)
        env.reset(seed=0)
        for _ in range(3):
            info = env.step(ZERO)[4]
        env.close()
        return info["measured_force"][:, 0].sum() / info["commanded_force"][:, 0].sum()

    assert rates() == pytest.approx(1.0, abs=0.01)
    assert rates(controller={"motor_strength": 0.9}) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize(
    ("name", "rule", "message"),
    [
        ("mass", lambda rng: -1.0, r"object.mass \[kg\] must"),
        ("mass", lambda: 1.0, r"randomize\['object.mass'\] fails with TypeError"),
        ("shape", lambda rng: "torus", "unknown object.shape 'torus'"),
        ("shape", lambda rng: "mesh", "needs the path of a mesh file"),
    ],
)
def test_a_function_that_draws_nonsense_is_named(name: str, rule: Any, message: str) -> None:
    env = FourFingerGrasp(randomize={name: rule})
    with pytest.raises(GraspError, match=message):
        env.reset(seed=0)
    env.close()
