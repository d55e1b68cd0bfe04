"""Labels, their metric, short fits, and their interrupts."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sys
from collections import namedtuple
from dataclasses import replace
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from torch import nn

from benchmarks.__main__ import main as benchmark
from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import (
    GraspError,
    GraspWarning,
    InvalidInputError,
    ModelFileError,
    SimulationError,
)
from grasp_env.force import ForceOptimizer, Objective, optimize_force
from grasp_env.grasp import Grasp, load_grasp, presets
from grasp_env.grasp.null_space import null_space_basis, reference_basis
from grasp_env.grasp.wrench import sample_ball
from policies import LearnedInitialForce
from policies.learned import PRETRAINED
from policies.network import Network
from training.data.one_grasp import Source, label
from training.data.played import played
from training.evaluation.results.table import pd
from training.fit import in_environment
from training.fit.fit_config import FitConfig
from training.fit.in_environment import ALONE, BASIS, CASES, PREVIOUS, REPAIRED, iterations
from training.fit.loop import WARM, optimise
from training.fit.one_grasp import NetworkTask, fit
from training.fit.soap import Soap
from training.fit.state import FitProgress, StateFile
from training.program.cli import main

FIXED: dict[str, Any] = {"steps": 40, "samples": 4096, "hidden": (16,), "batch_size": 256}
TRIPOD = {
    "positions": [[0.34, 0.1, 0], [0.28, 0.13, 0], [0.28, 0.07, 0.01]],
    "normals": [[-1, 0, 0], [0.6, -0.8, 0], [0.6, 0.8, 0]],
}
"""Contacts far from the origin of their frame."""


@pytest.fixture(autouse=True)
def _small_scores(monkeypatch):
    monkeypatch.setattr("training.fit.one_grasp.HELD_OUT", 64)


def test_labels_are_optima_and_the_metric_is_the_gap(monkeypatch):
    monkeypatch.setattr("training.data.one_grasp.CHUNK", 3)
    grasp = presets.paper_cuboid()
    objective = Objective()
    drawn = Source(grasp, (0.1, 20.0), (0.25, 0.6), True).draw(np.random.default_rng(0), 20, 5)
    data = label(drawn, reference_basis(grasp), objective)
    rng = np.random.default_rng(1)
    for group, here in enumerate(drawn.grasps):
        basis = null_space_basis(here, reference_basis(grasp))
        for wrench, coordinates, metric, least in zip(
            drawn.wrenches[group],
            data.coordinates[group],
            data.metric[group],
            data.least[group],
            strict=True,
        ):
            best = optimize_force(here, wrench, method="newton", tolerance=1e-10)
            particular = -here.pseudoinverse @ wrench
            force = particular + basis @ coordinates.astype(float)
            # coordinates are float32: 1e-7 of the force, a gap of its square times the conditioning
            assert objective.value(here.to_cone(force)) == pytest.approx(best.objective, rel=1e-6)
            assert least == pytest.approx(best.objective, rel=1e-9)
            step = rng.normal(size=6)
            # a predicted gap of 1e-6, deep in the quadratic region
            step *= 1e-3 / np.linalg.norm(metric @ step)
            exact = basis.T @ (best.force.reshape(-1) - particular)
            value = objective.value(here.to_cone(particular + basis @ (exact + step)))
            assert value / best.objective - 1.0 == pytest.approx(1e-6, rel=0.1)


def test_samples_share_the_frictions_and_the_ball():
    source = Source(presets.paper_cuboid(), (10.0, 20.0), (0.25, 0.6), True)
    drawn = source.draw(np.random.default_rng(0), 6000, 20)
    assert drawn.wrenches.shape == (20, 300, 6)
    assert drawn.moves.shape == (20, 0)
    for friction, (low, high) in zip(
        drawn.friction, pairwise(np.linspace(0.0, 1.0, 21)), strict=True
    ):
        place = (friction - 0.25) / (0.6 - 0.25)
        assert low <= 0.7 * place + 0.3 * place**2 <= high  # the density grows from 0.7 to 1.3
    wrenches = drawn.wrenches.reshape(-1, 6)
    inside = (np.linalg.norm(wrenches[:, :3], axis=1) <= 2.0) & (
        np.linalg.norm(wrenches[:, 3:], axis=1) <= 0.05
    )
    # all others are of 10 N and more; three standard deviations
    assert abs(inside.mean() - 0.7) < 3 * np.sqrt(0.7 * 0.3 / 6000)
    sizes = np.linalg.norm(wrenches[~inside] @ source.grasp.unit_frame.T, axis=1)
    assert ((sizes >= 10.0) & (sizes <= 20.0)).all()


def test_a_short_fit_learns():
    checkpoint = fit(FitConfig(**{**FIXED, "steps": 300, "samples": 20_000, "hidden": (32, 32)}))
    curve = np.array([row.split() for row in checkpoint.card["curve"]["rows"]], float)
    # median gaps, held out: ball and range
    assert (curve[-1, [2, 5]] < 0.05 * curve[0, [2, 5]]).all()
    for row in checkpoint.card["held_out_gap"].values():
        assert sum(row["newton steps"].values()) == pytest.approx(1.0)
        assert 0.0 <= row["outside the cones"] < 0.5
    flow = checkpoint.card["held_out_gap"]["ball, friction of the grasp"]["flow iterations"]
    assert 0 < flow["median"] < 45  # the 12-basis's
    network = Network(checkpoint.numbers["sizes"][0], (32, 32), 6, 2)
    for layer, parameter in enumerate(network.layers):
        weight, bias = (
            torch.from_numpy(checkpoint.tensors[f"layers.{layer}.{name}"])
            for name in ("weight", "bias")
        )
        with torch.no_grad():
            parameter.copy_(torch.cat([weight.mT, bias[:, None]], 1).reshape(parameter.shape))
    model = LearnedInitialForce(checkpoint)
    wrenches = sample_ball(np.random.default_rng(3), 20)
    for friction in (0.25, 0.57):
        grasp = presets.paper_cuboid().with_friction(friction)
        frictions = np.full(20, friction)
        pairs = checkpoint.tensors["pairs"]
        inputs, size = model.features(wrenches @ grasp.unit_frame.T, frictions, pairs)
        with torch.no_grad():
            outputs = network(torch.from_numpy(inputs[None].astype(np.float32)))[0].double().numpy()
        internal = outputs * size[:, None] @ null_space_basis(grasp, reference_basis(grasp)).T
        for wrench, part in zip(wrenches, internal, strict=True):
            expected = (part - grasp.pseudoinverse @ wrench).reshape(-1, 3)
            # float32 weights and sums
            np.testing.assert_allclose(
                model.raw(grasp, wrench), expected, atol=1e-5 * np.abs(expected).max()
            )


class Slope(NetworkTask):
    """One weight, and a loss that is this weight: its gradient is 1, so SOAP moves it by the
    learning rate."""

    def __init__(self, config: FitConfig) -> None:
        self.config, self.module, self.weights = config, nn.Module(), list[float]()
        self.module.weight = nn.Parameter(torch.ones(1, 1, dtype=torch.float64))

    def batch(self, rng: np.random.Generator) -> Any:
        self.weights.append(self.module.weight.item())
        return [None, None]

    def loss(self, part: Any) -> torch.Tensor:
        return self.module.weight.sum()

    def score(self) -> list[float]:
        self.last = self.module.weight.item()
        return [0.0] * 6


@pytest.mark.parametrize("rate", [2e-2, 3e-3])
def test_the_learning_rate_rises_and_falls(rate):
    """Straight up to `learning_rate` over the first 3 % of the steps, then down like a squared
    cosine."""
    task = Slope(FitConfig(**{**FIXED, "steps": 400}, learning_rate=rate))
    optimise(task)
    moves = -np.diff([*task.weights, task.last])
    done = np.arange(400) / 400
    falls = np.cos(0.5 * np.pi * (done - WARM) / (1.0 - WARM)) ** 2
    # the schedule adds 1e-3 and 1e-4 of the rate, so that no step is without effect
    np.testing.assert_allclose(moves / rate, np.where(done < 0.03, done / 0.03, falls), atol=1.1e-3)
    assert (moves > 0.0).all()


def test_bits_do_not_depend_on_threads_or_interrupts(tmp_path, monkeypatch, capsys):
    settings = FitConfig(**FIXED)
    out = tmp_path / "model"
    whole, single = (fit(made) for made in (settings, FitConfig(**FIXED, threads=1)))
    real = NetworkTask.batch
    calls = []

    def interrupted(self, rng):
        calls.append(self._held_out[0][0].numpy())
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return real(self, rng)

    monkeypatch.setattr(NetworkTask, "batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(settings, out=out)
    assert len(calls) == 4
    assert "--resume continues from there" in capsys.readouterr().err
    with pytest.raises(InvalidInputError, match="unfinished training: add --resume"):
        fit(settings, out=out)
    with pytest.raises(InvalidInputError, match=r"other settings \(seed was 0, is 1\)"):
        fit(FitConfig(**FIXED, seed=1), out=out, resume=True)
    again = fit(settings, out=out, resume=True).tensors
    for key, value in whole.tensors.items():
        np.testing.assert_array_equal(value, again[key])
        np.testing.assert_array_equal(value, single.tensors[key])
    fit(FitConfig(**{**FIXED, "steps": 1}, seed=1))
    np.testing.assert_array_equal(calls[-1], calls[0])  # held-out data are the same for every seed


@pytest.mark.parametrize(
    ("contacts", "low"),
    [
        # elliptic cones, some rougher than others; with less friction the tripod would not close
        ({**TRIPOD, "friction": [[0.5, 0.7], [0.6, 0.6], [0.8, 0.5]]}, 0.375),
        (
            {
                **{
                    name: getattr(presets.five_finger_cuboid(), name).tolist()
                    for name in ("positions", "normals")
                },
                "friction": 0.5,
            },
            0.3125,
        ),
    ],
)
def test_a_grasp_of_a_file_becomes_a_model(contacts, low, tmp_path, capsys):
    """Near its optima, and never worse at any wrench."""
    file = tmp_path / "mine.json"
    out = tmp_path / "model.v2"
    file.write_text(json.dumps(contacts))
    words = f"fit --grasp {file} --out {out} --steps 400 --samples 20000 --hidden 32 --quick"
    assert main(words.split()) == 0
    assert re.search(r"quick.*certified", capsys.readouterr().out)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "mine.json",
        "model.v2.json",
        "model.v2.safetensors",
    ]
    rule = LearnedInitialForce.load(out)
    grasp = load_grasp(file)
    card = rule.checkpoint.card
    assert card["grasp"]["file"] == "mine.json"
    assert card["grasp"]["positions"] == contacts["positions"]
    assert (card["quick"], card["command"]) == (True, " ".join(["grasp", *sys.argv[1:]]))
    assert card["config"]["friction_low"] == pytest.approx(low, rel=0.1)
    source = Source(grasp, (0.1, 20.0), (0.3, 0.6), False)
    optimizer, own = (
        ForceOptimizer(grasp, initial=initial) for initial in (rule, "internal_force")
    )
    gaps = []
    for w in source.ball(np.random.default_rng(5), 50):
        solution = optimizer.solve(w)
        assert (solution.status.value, solution.initial) == ("optimal", rule.name)
        gaps.append(
            rule.objective.value(grasp.to_cone(solution.initial_force)) / own.solve(w).objective
            - 1.0
        )
    assert np.median(gaps) < 0.1
    for w in source.loads(np.random.default_rng(6), 200, 1, 0.0)[0][0] * 100.0:
        there = [
            rule.objective.value(grasp.to_cone(solver.start(w))) for solver in (optimizer, own)
        ]
        assert there[0] <= there[1] * (1 + 1e-12)


BALL = '{"hand": "three_finger", "shape": "sphere", "size": [0.08], "friction": 0.8}'


def test_samples_of_an_environment_are_those_played():
    """Their contacts move on the object, and their wrenches lie near those of its episodes."""
    config = FitConfig(env=BALL).resolved()
    source, seen = config.source(), played(BALL)
    assert (config.steps, config.force_weight, config.barrier_weight) == (10_000, 1.0, 0.01)
    # 0.85 is the controller's margin, 5 % the room beside it
    assert source.frictions == pytest.approx((0.8 * 0.85 / 1.05, 0.8 * 0.85 * 1.05))
    drawn = source.draw(np.random.default_rng(0), 4000, 40, ball=1.0)
    wrenches = drawn.wrenches.reshape(-1, 6)
    spread = seen.wrenches.std(axis=0)
    np.testing.assert_allclose(
        wrenches.mean(axis=0), seen.wrenches.mean(axis=0), atol=0.1 * spread.max()
    )
    # the variance of a draw from the played ones and that of the noise add up
    np.testing.assert_allclose(wrenches.std(axis=0), np.sqrt(1.0 + 0.3**2) * spread, rtol=0.1)
    assert drawn.moves.shape == (40, 6)
    assert 0.5 < np.abs(drawn.moves).max() <= 1.0
    for grasp in drawn.grasps:
        np.testing.assert_allclose(np.linalg.norm(grasp.positions, axis=1), 0.04, rtol=1e-9)
        np.testing.assert_allclose(grasp.normals, -grasp.positions / 0.04, atol=1e-9)
        away = np.linalg.norm(grasp.positions - seen.grasp.positions, axis=1)
        # the nearest point of a sphere is at most this much farther
        assert away.max() < 3.1e-3


def test_a_model_of_an_environment_starts_its_flow(tmp_path, capsys):
    out = tmp_path / "ball"
    words = ["fit", "--env", BALL, "--out", str(out), "--steps", "150", "--samples", "20000"]
    assert main([*words, "--hidden", "32"]) == 0
    printed = capsys.readouterr().out
    assert "wrenches like the environment's" in printed
    assert "contacts moved: iterations of the flow in the environment" in printed
    model = LearnedInitialForce.load(out)
    assert model.checkpoint.card["grasp"]["env"] == BALL
    for case in CASES:
        scores = model.checkpoint.card["iterations"][case]
        assert list(scores) == [BASIS, ALONE, REPAIRED, PREVIOUS]
        assert scores[REPAIRED]["median"] < 0.5 * scores[BASIS]["median"]
    env: Any = gym.make(
        "grasp_env:FourFingerGrasp-v0",
        disturbance="random",
        initial_force=str(out),
        **json.loads(BALL),
    )
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))  # a path is JSON
    for each in (env, again):
        each.reset(seed=0)
        each.step(np.zeros(each.action_space.shape, np.float32))
        assert each.unwrapped.solution.initial == "learned_fixed_grasp"
        each.close()
    words = ["fitted", "--episodes", "1", "--out", str(tmp_path), "--name", "run", "--models"]
    assert benchmark([*words, str(PRETRAINED / "four_finger")]) == 2
    assert "the model of a grasp, not of an environment" in capsys.readouterr().err
    assert benchmark([*words, str(out)]) == 0
    told = capsys.readouterr().out
    assert "contacts moved: p99 iterations from a fitted start over the 12-basis's" in told
    # the weights depend on the contacts
    source = FitConfig(env=BALL).resolved().source()
    grasp, wrench = source.grasp, source.played[0]
    moved = Grasp.from_contacts(
        grasp.positions + 1e-3 * grasp.frames[:, :, 1], grasp.normals, grasp.friction
    )
    fixed = LearnedInitialForce(
        replace(
            model.checkpoint,
            tensors={**model.checkpoint.tensors, "positions": moved.positions},
        )
    )
    assert np.abs(model.raw(moved, wrench) - fixed.raw(moved, wrench)).max() > 1e-3


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ('{"randomize": ["size"]}', "a model knows one grasp"),
        ('{"object": {"torsional_friction": 0.01}}', "three and more hard contacts"),
        ('{"form": 1}', "unexpected keyword argument 'form'"),
        (
            '{"disturbance": {"name": "constant", "value": [0, -99, 0, 0, 0, 0]}}',
            "if the hand loses it",
        ),
        ("UncertanGrasp", "did you mean .UncertainGrasp"),
    ],
)
def test_environments_without_one_grasp_are_refused(env, message):
    with pytest.raises(GraspError, match=message):
        FitConfig(env=env).resolved()


def test_a_grip_evaluates_the_network_at_its_own_friction():
    """The margin of an agent's step is within the training range here, that of the settings not."""
    model = LearnedInitialForce.pretrained()  # frictions from 0.25 to 0.6
    counts = []
    for rule in (model, lambda grasp, wrench: model(grasp, wrench)):
        env = FourFingerGrasp(
            disturbance="random", action_mode="grip", initial_force=rule, friction=0.8
        )
        env.reset(seed=0)
        steps = [env.step(np.array([0.5, 0.0], np.float32))[4] for _ in range(40)]
        assert env.solution is not None
        assert env.solution.initial == ("learned_fixed_grasp" if rule is model else "<lambda>")
        counts.append([info["iterations"] for info in steps])
        env.close()
    assert counts[0] == counts[1]


def test_scores_go_on_after_a_lost_contact():
    """All starts play the same steps; after a tip has left, the network alone is the 12-basis.

    The tolerance is small because a grasp that is lost amplifies differences of forces.
    """
    config = EnvConfig().override(
        disturbance={"name": "random", "force": 10.0, "moment": 0.5},
        motors={"noise": 0.3},
        **{"solver.tolerance": 1e-8},
    )
    rows = pd.DataFrame(iterations(config, LearnedInitialForce.pretrained(), 2, 0, steps=40))
    lengths = rows.groupby(["case", "start"])["step"].count().unstack()
    assert (lengths[ALONE] == lengths[BASIS]).all()


def test_a_case_that_cannot_be_played_is_told(monkeypatch):
    def none(*_: Any) -> Any:
        raise SimulationError("no moved contacts")

    monkeypatch.setattr(in_environment, "_moved", none)
    monkeypatch.setattr(in_environment, "EPISODES", 1)
    config = EnvConfig().override(duration=0.2)
    with pytest.warns(GraspWarning, match="contacts moved: not scored, no moved contacts"):
        scores = in_environment.scores_in(config, LearnedInitialForce.pretrained())
    assert list(scores) == ["as fitted"]
    assert scores["as fitted"][BASIS]["n"] == 10


def test_contacts_come_from_one_place():
    with pytest.raises(InvalidInputError, match="leave one of them out"):
        FitConfig(env=BALL, grasp="mine.json")


def test_a_truncated_or_changed_state_is_refused(tmp_path):
    network = Network(9, (4,), 6, 0)
    settings = {"seed": 0}
    out = tmp_path / "model"
    file = StateFile(out, settings)
    rng = np.random.default_rng(0)
    now = FitProgress(3, 1.0, 1.0, [[0.0, 0.0]])
    file.save(network, Soap(network.parameters(), 0.1), rng, now)
    assert file.restore(network, Soap(network.parameters(), 0.1), rng) == now
    whole = file.path.read_bytes()
    for blob in (whole[:-100], whole[:-3] + bytes([whole[-3] ^ 1]) + whole[-2:]):
        file.path.write_bytes(blob)
        with pytest.raises(ModelFileError, match="truncated or was changed"):
            StateFile.begin(out, settings, resume=True)
    with pytest.raises(ModelFileError, match="nothing to resume"):
        StateFile.begin(tmp_path / "other", settings, resume=True)


WRONG = {
    "seconds": -1.0,
    "samples": 10,
    "steps": -1,
    "learning_rate": np.nan,
    "hidden": (),
    "preset": "six_fingers",
}
GRASPS = [
    ({"contact_model": "soft", "torsional_friction": 0.01}, {}, "three and more hard contacts"),
    ({"friction": 0.05}, {}, "no force closure at its friction"),
    ({}, {"friction_low": 0.1}, r"friction_low must close the grasp, 0\.1 does not"),
    (
        {},
        {"friction_low": 0.9, "friction_high": 0.8},
        "friction_low must be less than friction_high",
    ),
]


@pytest.mark.parametrize(
    ("contacts", "settings", "message"),
    [*(({}, {name: value}, name) for name, value in WRONG.items()), *GRASPS],
)
def test_wrong_settings_and_grasps_are_refused(contacts, settings, message, tmp_path):
    if "preset" not in settings:
        file = tmp_path / "mine.json"
        file.write_text(json.dumps({**TRIPOD, "friction": 0.6, **contacts}))
        settings = {"grasp": str(file), **settings}
    with pytest.raises(GraspError, match=message):
        FitConfig(**settings).resolved()


def test_a_full_disk_is_reported_before_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("training.fit.one_grasp.label", None)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10, 10, 1_000_000))
    assert main(["fit", "--out", str(tmp_path / "model")]) == 2
    assert "1 MB free" in capsys.readouterr().err
