"""Wrong input gets an error that names it; lost objects end the episode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from engines import bullet, needs_bullet

from grasp_env.config import EnvConfig, RewardSettings
from grasp_env.config.env import as_config
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import (
    GraspError,
    GraspWarning,
    InvalidInputError,
    ModelFileError,
    SimulationError,
    UnknownNameError,
    UnknownSettingError,
)
from grasp_env.sim import HandDescription
from grasp_env.sim.config import SceneConfig
from grasp_env.task.disturbance import Disturbed, disturb
from policies.learned import PRETRAINED

ZERO = np.zeros(6, dtype=np.float32)
FOUR = HandDescription.four_finger()
POINTS = SceneConfig().contact_points
TIMES = np.arange(501) * 0.004


CALLS: dict[str, Callable[..., Any]] = {
    "override": EnvConfig().override,
    "draw": lambda **rules: EnvConfig().override(randomize=rules).drawn(np.random.default_rng(0)),
    "disturb": lambda rule: disturb(rule, TIMES, np.random.default_rng(0), EnvConfig()),
    "return": lambda value: disturb(lambda *_: value, TIMES, np.random.default_rng(0), EnvConfig()),
    "to_json": lambda **settings: EnvConfig().override(**settings).to_json(),
    "as_config": as_config,
    "reward": RewardSettings,
}
OVERRIDE: list[tuple[dict[str, Any], str]] = [
    ({"disturbance": "wind"}, r"unknown disturbance 'wind'.*'none'.*or a function"),
    ({"disturbance": {"force": 1.0}}, "disturbance needs a name"),
    (
        {"disturbance": {"name": "random", "speed": 1.0}},
        r"disturbance.speed': .*'disturbance.force'",
    ),
    ({"disturbance.force": 1.0}, "give disturbance a name"),
    ({"task": {"size": 0.01}}, r"task.size'.*\(none\)"),
    ({"task": "six_directions", "disturbance": "random"}, "pushes by itself"),
    ({"initial_force": "best"}, r"'linear_combination'.* or a rule\(grasp, wrench\)"),
    ({"object": 3}, "object must be of class ObjectDescription, or a dict"),
    (
        {"engine": {"name": "bullet", "rate": 100}},
        "engine.rate must be a multiple of controller.rate",
    ),
    (
        {"controller": {"rate": 333}},
        "controller.rate must be a multiple of agent.rate, got 333 and 50",
    ),
    ({"sensors": {"delay": 1e6}}, "sensors.delay must be at most 4000 s"),
    ({"duration": 1e6}, "limits.duration must be at most 4000 s"),
    ({"sensors": {"delay": -1.0}, "reward": {"held": "a"}}, r"sensors.delay .*; reward.held must"),
    ({"approach": "down", "contact_points": POINTS}, "leave one of them out"),
    ({"randomize": ("colour",)}, "'shape', 'size', 'mass', 'friction'"),
    ({"randomize": None}, "randomize must be a list of some of shape, size, mass, friction"),
    ({"randomize": {"mass": (0.3, 0.1)}}, "low <= high"),
    ({"randomize": {"gravity": (1.0, 2.0)}}, "must be a function"),
    (
        {"randomize": "size", "contact_points": POINTS},
        "contact_points and grasp belong to one shape",
    ),
    ({"controller": "pd"}, r"class ControllerSettings, .*did you mean {'kind': 'pd'}"),
    ({"solver": "newtn"}, r"class SolverSettings, or a dict of its settings, got 'newtn'$"),
    ({"disturbance": [0.0] * 6}, r"give {'name': 'constant', 'value': \(fx, fy, fz"),
    ({"hand": {"name": "four_fingr"}}, r"unknown hand 'four_fingr': did you mean 'four_finger'"),
]
WRONG: list[tuple[str, dict[str, Any], str]] = [
    *(("override", given, message) for given, message in OVERRIDE),
    (
        "reward",
        {"force": 0.3},
        r"iterations 0\.5, force 0\.3, torque 0\.1, force_change 0\.1.* 1, .* at most 0\.9",
    ),
    ("draw", {"mass": lambda rng: -1.0}, r"object.mass \[kg\] must"),
    ("draw", {"mass": lambda: 1.0}, r"randomize\['object.mass'\] fails with TypeError"),
    ("return", {"value": np.zeros((501, 3))}, r"lambda.*\(501, 6\), got \(501, 3\)"),
    ("return", {"value": None}, "lambda.*None.*return"),
    (
        "return",
        {"value": Disturbed(gravity=np.zeros((500, 3)))},
        r"lambda.*\(501, 3\), got \(500, 3\)",
    ),
    (
        "disturb",
        {"rule": lambda times: times},
        r"lambda.*fails with TypeError: .*takes \(times, rng, settings\)",
    ),
    (
        "to_json",
        {"disturbance": lambda times, rng, settings: None},
        "disturbance is <function .*no JSON",
    ),
    (
        "to_json",
        {"randomize": {"gravity": lambda rng: (0, 0, 0)}},
        r"randomize\['gravity'\] is <function",
    ),
    ("as_config", {"config": {"schema": 0}}, "too old"),
    (
        "as_config",
        {"config": {"schema": 2}},
        "schema 2, this version reads 1: it is written by a newer version",
    ),
    ("as_config", {"config": "{"}, "config must be JSON"),
]


@pytest.mark.parametrize(("call", "given", "message"), WRONG, ids=range(len(WRONG)))
def test_wrong_input_is_named(call, given, message):
    with pytest.raises(GraspError, match=message):
        CALLS[call](**given)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("frameskip", "settings are 'hand', 'object'"),
        ("tolerance", "did you mean .*'solver.tolerance'"),
        ("motion", "did you mean 'task.motion'"),
        ("sensors.dely", "did you mean 'sensors.delay'"),
        ("object_mass", "did you mean 'object.mass'"),
        ("wrench", "did you mean 'disturbance' or 'sensors.wrench'"),
        ("render_size", "did you mean 'pictures.size'"),
        ("mas", "got an unexpected keyword argument 'mas': did you mean 'mass'"),
    ],
)
def test_unknown_keywords_name_the_likely_one(name, meant):
    for call in (
        EnvConfig().override,
        lambda **given: gym.make("grasp_env:FourFingerGrasp-v0", **given),
    ):
        with pytest.raises(UnknownSettingError, match=meant) as caught:
            call(**{name: 1})
        assert isinstance(caught.value, TypeError)


def connections() -> int:
    return sum(bullet.isConnected(number) for number in range(64)) if bullet else 0


NOT_HELD = [
    ({"render_mode": "ascii"}, "'ascii'"),
    ({"render_mode": "human"}, r"display.*rgb_array"),
    ({"shape": "mesh"}, "mesh"),
    ({"contact_points": (*POINTS[:3], (0.03, -0.02, 0.04))}, "surface"),
    ({"contact_points": (*POINTS[:3], (0.0, -0.05, 0.0))}, "reach|clear|unhindered"),
    (
        {"hand": FOUR.moved((0.0, 0.5, 0.0))},
        "cannot be grasped by the hand 'four_finger': finger .* out of reach",
    ),
    ({"hand": FOUR.moved((0.0, 0.0, 1e-6)), "size": (0.1, 0.4, 0.1)}, "palm"),
    ({"hand": replace(FOUR, fingertips=FOUR.fingertips[:1])}, "more fingers"),
    ({"initial_force": lambda grasp, wrench: np.ones((4, 3))}, "misses balance"),
    pytest.param(
        {
            "hand": replace(
                FOUR, links=tuple(replace(link, torque_limit=0.15) for link in FOUR.links)
            ),
            "contact_points": POINTS,
        },
        r"torque limits: .*_joint \(0\.15 N m\).*raise torque_limit",
        marks=needs_bullet,
    ),
]


@pytest.mark.parametrize(("settings", "message"), NOT_HELD, ids=range(len(NOT_HELD)))
def test_what_cannot_be_held_or_shown_opens_nothing(monkeypatch, settings, message):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    before = connections()
    with pytest.raises(GraspError, match=message):
        FourFingerGrasp(**settings)
    assert connections() == before


def test_wrong_calls_change_nothing():
    before = connections()
    env = FourFingerGrasp(disturbance="random", duration=0.1)
    rows = []
    with pytest.raises(SimulationError, match="step before reset"):
        env.step(ZERO)
    for wrong in (True, False):
        env.reset(seed=0)
        for options in (
            ({"wrnch": 1}, "x", {"wrench": [1, 2]}, {"wrench": [1, 2, np.inf, 0, 0, 0]})
            if wrong
            else ()
        ):
            with pytest.raises(GraspError, match=r"wrench|options must be a dict"):
                env.reset(options=options)
        seen = [env.reset(seed=0)[0]]
        for k in range(5):
            for action in (
                ([0, 0, np.nan, 0, 0, 0], np.zeros(5), np.zeros((1, 6)), "x", None) if wrong else ()
            ):
                with pytest.raises(
                    InvalidInputError, match=r"action must be of shape \(6,\), finite"
                ):
                    env.step(action)
            observed, _, _, truncated, _ = env.step(ZERO)
            assert truncated == (k == 4)
            seen.append(observed)
        with pytest.raises(SimulationError, match=r"time is up.*reset"):
            env.step(ZERO)
        rows.append(seen)
        env.close()
        env.close()
        assert connections() == before
        for call in (lambda: env.step(ZERO), lambda: env.scene):
            with pytest.raises(SimulationError, match=r"closed: call reset\(\)"):
                call()
    np.testing.assert_array_equal(*rows)


FAR = {"max_drift": 1e9, "max_tilt": 10.0, "max_contact_gap": 1e9}


@pytest.mark.parametrize(
    ("limits", "wrench", "failures"),
    [
        ({}, [0, 0, 0, 0, 0, 3.0], ("dropped", "closure_lost")),  # far beyond the joint torques
        # it turns
        ({"max_drift": 1e9, "max_contact_gap": 1e9}, [0, 0, 0, 0, 0, 3.0], ("dropped",)),
        *((FAR, [push, push, 0, 0, 0, push], ("simulation_diverged",)) for push in (1e5, 1e12)),
    ],
)
def test_a_lost_object_ends_the_episode(limits, wrench, failures):
    env = FourFingerGrasp(limits=limits)
    calm = env.reset(seed=0)[0]
    env.reset(seed=0, options={"wrench": wrench})
    terminated = False
    while not terminated:
        observed, reward, terminated, truncated, info = env.step(ZERO)
        assert not truncated
        assert env.observation_space.contains(observed)
        assert all(
            isinstance(value, str) or np.isfinite(value).all()
            for value in [*observed, reward, *info.values()]
        )
    assert info["failure"] in failures
    assert (reward, info["is_success"]) == (-env.config.reward.fault_cost, False)
    with pytest.raises(SimulationError, match=info["failure"]):
        env.step(ZERO)
    np.testing.assert_array_equal(env.reset(seed=0)[0], calm)  # intact again, to the last bit
    assert not env.step(ZERO)[2]
    env.close()


def test_a_reset_gives_up():
    env = FourFingerGrasp(randomize={"mass": (60.0, 90.0), "friction": (0.011, 0.012)})
    with pytest.raises(SimulationError, match="random objects could be held"):
        env.reset(seed=0)
    env.close()


def test_a_path_is_a_start_and_names_come_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "previous.json").write_text("{}")
    (tmp_path / "linear_combination.json").write_text("{}")
    for name in ("previous", "linear_combination"):
        FourFingerGrasp(initial_force=name).close()
    model = PRETRAINED / "four_finger"
    for path in (model, str(model), f"{model}.json"):
        env = FourFingerGrasp(initial_force=path)
        assert env.config.solver.initial_force == str(path)
        env.close()
    with pytest.raises(ModelFileError, match="No such file"):
        FourFingerGrasp(initial_force="runs/fit/mine")
    with pytest.raises(UnknownNameError, match="a model that `grasp fit` saved"):
        FourFingerGrasp(initial_force="mine")
    with pytest.warns(GraspWarning, match="knows 4 contacts, the hand has 3"):
        FourFingerGrasp(hand="three_finger", initial_force=str(model)).close()
