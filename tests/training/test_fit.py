"""Labels are optima, the metric is the gap, short fits learn and repeat, interrupts lose nothing, wrong input is refused."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections import namedtuple
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from grasp_env import core
from grasp_env.errors import InvalidInputError, ModelFileError
from grasp_env.force import ForceOptimizer, Objective, optimize_force
from grasp_env.grasp import load_grasp, null_space_basis, presets, reference_basis
from grasp_env.grasp.wrench import sample_ball
from policies import LearnedInitialForce
from policies.network import Network, activation
from training.cli import main
from training.data.one_grasp import Source, label
from training.fit.one_grasp import NetworkTask, fit
from training.fit.settings import FitConfig
from training.fit.soap import Soap
from training.fit.state import Progress, StateFile

FIXED: dict[str, Any] = {"steps": 40, "samples": 4096, "hidden": (16,), "batch_size": 256}


@pytest.fixture
def small_scores(monkeypatch):
    """Scores on fewer wrenches."""
    monkeypatch.setattr("training.fit.one_grasp.HELD_OUT", 100)


def test_labels_are_optima_and_the_metric_is_the_gap():
    grasp, objective = presets.paper_cuboid(), Objective()
    samples = Source(grasp, (0.1, 20.0), (0.25, 0.6), True).draw(np.random.default_rng(0), 50, 10)
    data = label(grasp, reference_basis(grasp), objective, *samples)
    rng = np.random.default_rng(1)
    for k in range(50):
        here = grasp.with_friction(data.friction[k])
        best = optimize_force(here, data.wrenches[k], method="newton", tolerance=1e-10)
        basis = null_space_basis(here, reference_basis(grasp))
        particular = -here.pseudoinverse @ data.wrenches[k]
        force = particular + basis @ data.coordinates[k].astype(float)
        # coordinates are float32: 1e-7 of the force, a gap of its square times the conditioning
        assert objective.value(here.to_cone(force)) == pytest.approx(best.objective, rel=1e-6)
        assert data.least[k] == pytest.approx(best.objective, rel=1e-9)
        step = rng.normal(size=6)
        step *= 1e-3 / np.linalg.norm(data.metric[k] @ step)  # a predicted gap of 1e-6, deep in the quadratic region
        exact = basis.T @ (best.force.reshape(-1) - particular)
        value = objective.value(here.to_cone(particular + basis @ (exact + step)))
        assert value / best.objective - 1.0 == pytest.approx(1e-6, rel=0.1)


def test_samples_share_the_frictions_and_the_ball():
    source = Source(presets.paper_cuboid(), (10.0, 20.0), (0.25, 0.6), True)
    wrenches, friction = source.draw(np.random.default_rng(0), 6000, 20)
    for group, (low, high) in zip(friction.reshape(20, -1), pairwise(np.linspace(0.0, 1.0, 21)), strict=True):
        place = (group[0] - 0.25) / (0.6 - 0.25)
        assert low <= 0.7 * place + 0.3 * place**2 <= high  # the density grows from 0.7 to 1.3
        assert (group == group[0]).all()
    inside = (np.linalg.norm(wrenches[:, :3], axis=1) <= 2.0) & (np.linalg.norm(wrenches[:, 3:], axis=1) <= 0.05)
    # all others are of 10 N and more; three standard deviations
    assert abs(inside.mean() - 0.7) < 3 * np.sqrt(0.7 * 0.3 / 6000)
    sizes = np.linalg.norm(wrenches[~inside] @ source.grasp.unit_frame.T, axis=1)
    assert ((sizes >= 10.0) & (sizes <= 20.0)).all()


def test_a_short_fit_learns(small_scores):
    result = fit(FitConfig(**{**FIXED, "steps": 300, "samples": 20_000, "hidden": (32, 32)}))
    assert (result.curve[-1, [2, 5]] < 0.05 * result.curve[0, [2, 5]]).all()  # median gaps, held out: ball and range
    told = result.checkpoint.card["held_out_gap"]
    for row in told.values():
        assert sum(row["newton steps"].values()) == pytest.approx(1.0)
        assert 0.0 <= row["outside the cones"] < 0.5
    assert 0 < told["ball, friction of the grasp"]["flow iterations"]["median"] < 45  # the 12-basis's


def test_the_file_holds_the_network_of_every_friction(small_scores):
    """What inference folds for a grasp's friction is what torch trained."""
    checkpoint = fit(FitConfig(**FIXED)).checkpoint
    pairs = checkpoint.tensors["pairs"]
    network = Network(checkpoint.numbers["sizes"][0], (16,), 6, 2)
    for layer, parameter in enumerate(network.layers):
        weight, bias = (torch.from_numpy(checkpoint.tensors[f"layers.{layer}.{name}"]) for name in ("weight", "bias"))
        with torch.no_grad():
            parameter.copy_(torch.cat([weight.mT, bias[:, None]], 1).reshape(parameter.shape))
    model = LearnedInitialForce(checkpoint)
    wrenches = sample_ball(np.random.default_rng(3), 20)
    for friction in (0.25, 0.4, 0.57):
        grasp = presets.paper_cuboid().with_friction(friction)
        inputs, size = model.features(wrenches @ grasp.unit_frame.T, np.full(20, friction), pairs)
        with torch.no_grad():
            outputs = network(torch.from_numpy(inputs[None].astype(np.float32)))[0].double().numpy()
        internal = outputs * size[:, None] @ null_space_basis(grasp, reference_basis(grasp)).T
        for wrench, part in zip(wrenches, internal, strict=True):
            expected = (part - grasp.pseudoinverse @ wrench).reshape(-1, 3)
            # float32 weights and sums
            np.testing.assert_allclose(model.raw(grasp, wrench), expected, atol=1e-5 * np.abs(expected).max())


def test_the_activation_has_its_derivative():
    x = torch.linspace(-5.0, 5.0, 41, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(activation, (x,))
    torch.testing.assert_close(activation(x), 0.5 * x * (1 + x / torch.sqrt(1 + x * x)))


def test_the_same_bits_with_one_thread_or_two_also_after_an_interrupt(tmp_path, monkeypatch, small_scores):
    settings, out = FitConfig(**FIXED), tmp_path / "model"
    whole, single = (fit(made).checkpoint.tensors for made in (settings, FitConfig(**FIXED, threads=1)))
    real, calls = NetworkTask.batch, []

    def interrupted(self, rng):
        calls.append(1)
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return real(self, rng)

    monkeypatch.setattr(NetworkTask, "batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(settings, out=out)
    assert len(calls) == 4
    with pytest.raises(InvalidInputError, match="unfinished training: add --resume"):
        fit(settings, out=out)
    with pytest.raises(InvalidInputError, match=r"other settings \(seed was 0, is 1\)"):
        fit(FitConfig(**FIXED, seed=1), out=out, resume=True)
    again = fit(settings, out=out, resume=True).checkpoint.tensors
    assert whole.keys() == again.keys() == single.keys()
    for key, value in whole.items():
        np.testing.assert_array_equal(value, again[key])
        np.testing.assert_array_equal(value, single[key])


TRIPOD = {
    "positions": [[0.34, 0.1, 0], [0.28, 0.13, 0], [0.28, 0.07, 0.01]],
    "normals": [[-1, 0, 0], [0.6, -0.8, 0], [0.6, 0.8, 0]],
}
"""Contacts far from the origin of their frame."""
FIVE = presets.five_finger_cuboid()


@pytest.mark.parametrize(
    ("contacts", "low"),
    [
        ({**TRIPOD, "friction": 0.6}, 0.375),
        # elliptic cones, some rougher than others; with less grip the tripod would not close
        ({**TRIPOD, "friction": [[0.5, 0.7], [0.6, 0.6], [0.8, 0.5]]}, 0.375),
        ({"positions": FIVE.positions.tolist(), "normals": FIVE.normals.tolist(), "friction": 0.5}, 0.3125),
    ],
)
def test_a_grasp_of_a_file_becomes_a_model_that_python_and_the_core_load(contacts, low, tmp_path, capsys, small_scores):
    """Near its optima after a second, never worse at any wrench, and the core has the bits of Python."""
    file, out = tmp_path / "mine.json", tmp_path / "model"
    file.write_text(json.dumps(contacts))
    assert (
        main(
            [
                "fit",
                "--grasp",
                str(file),
                "--out",
                str(out),
                "--steps",
                "400",
                "--samples",
                "20000",
                "--hidden",
                "32",
                "32",
            ]
        )
        == 0
    )
    assert "certified" in capsys.readouterr().out
    rule, grasp = LearnedInitialForce.load(out), load_grasp(file)
    card = rule.checkpoint.card
    assert (card["grasp"]["file"], card["grasp"]["positions"]) == ("mine.json", contacts["positions"])
    assert card["config"]["friction_low"] == pytest.approx(low, rel=0.1)
    source = Source(grasp, (0.1, 20.0), (0.3, 0.6), False)
    optimizer, own = (ForceOptimizer(grasp, initial=initial) for initial in (rule, "internal_force"))
    gaps = []
    for w in source.ball(np.random.default_rng(5), 100):
        solution = optimizer.solve(w)
        assert (solution.status.value, solution.initial) == ("optimal", rule.name)
        gaps.append(rule.objective.value(grasp.to_cone(solution.initial_force)) / own.solve(w).objective - 1.0)
    assert np.median(gaps) < 0.1
    for w in source.draw(np.random.default_rng(6), 200, 1, 0.0)[0] * 100.0:
        there = [rule.objective.value(grasp.to_cone(solver.start(w))) for solver in (optimizer, own)]
        assert there[0] <= there[1] * (1 + 1e-12)
    w = np.array([1.0, -0.5, 0.3, 0.01, 0.02, -0.01])
    exported = core.Model.load(rule.export(tmp_path / "mine.model", grasp).read_bytes())
    assert exported is not None
    found = np.empty(grasp.null_dimension)
    exported.predict(grasp.unit_frame @ w, found)
    internal = null_space_basis(grasp, rule.checkpoint.tensors["reference"].astype(float)) @ found
    np.testing.assert_array_equal((internal - grasp.pseudoinverse @ w).reshape(-1, 3), rule.raw(grasp, w))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contact_model": "soft", "torsional_friction": 0.01}, "three and more hard contacts"),
        ({"friction": 0.05}, "no force closure at its friction"),
        ({"friction": -1.0}, "friction must be > 0"),
        ({"normals": None}, "normals"),
    ],
)
def test_a_grasp_that_no_model_knows_is_told_before_work(changes, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("training.fit.one_grasp.label", _no_work)
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({**TRIPOD, "friction": 0.6, **changes}))
    assert main(["fit", "--grasp", str(file), "--out", str(tmp_path / "model")]) == 2
    assert message in capsys.readouterr().err


def test_a_state_is_refused_if_truncated_or_changed(tmp_path):
    network, settings, out = Network(9, (4,), 6, 0), {"seed": 0}, tmp_path / "model"
    file, rng, now = StateFile(out, settings), np.random.default_rng(0), Progress(3, 1.0, 1.0, [[0.0, 0.0]])
    file.save(network, Soap(network.parameters(), 0.1), rng, now)
    assert file.restore(network, Soap(network.parameters(), 0.1), rng) == now
    whole = file.path.read_bytes()
    changed = bytearray(whole)
    changed[-3] ^= 1
    for blob in (whole[:-100], b"", bytes(changed), b"PK\x03\x04" + whole[:50]):
        file.path.write_bytes(blob)
        with pytest.raises(ModelFileError, match="truncated or was changed"):
            StateFile.begin(out, settings, resume=True)
    with pytest.raises(ModelFileError, match="nothing to resume"):
        StateFile.begin(tmp_path / "other", settings, resume=True)


def test_no_room_and_no_permission_are_said_before_work(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("training.fit.one_grasp.label", _no_work)
    assert main(["fit", "--out", str(tmp_path / "file" / "model")]) == 2
    assert "choose another --out" in capsys.readouterr().err
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10, 10, 1_000_000))
    assert main(["fit", "--out", str(tmp_path / "model")]) == 2
    assert "1 MB free" in capsys.readouterr().err


def _no_work(*args, **keywords):
    raise AssertionError("work was started")


def test_quick_says_so_and_the_command_saves_both_files(tmp_path, capsys, small_scores):
    arguments = ["--quick", "--steps", "5", "--samples", "1000", "--batch-size", "64", "--out", str(tmp_path / "m.v2")]
    assert main(["fit", *arguments, "--hidden", "8"]) == 0
    assert "quick" in capsys.readouterr().out
    meta = json.loads((tmp_path / "m.v2.json").read_text())
    assert meta["card"]["quick"] is True
    assert meta["card"]["command"] == " ".join(["grasp", *sys.argv[1:]])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.v2.json", "m.v2.safetensors"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"seconds": -1.0},
        {"seconds": float("nan")},
        {"seconds": float("inf")},
        {"samples": 10},
        {"batch_size": 0},
        {"seed": -1},
        {"steps": 0},
        {"learning_rate": float("nan")},
        {"tail": 0.0},
        {"low": 0.0},
        {"friction_low": 0.9, "friction_high": 0.8},
        {"friction_high": float("nan")},
        {"hidden": (0,)},
        {"hidden": ()},
        {"threads": 0},
        {"degree": -1},
    ],
)
def test_wrong_settings(wrong):
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        FitConfig(**wrong)


def test_a_range_in_which_the_grasp_does_not_close_is_told(tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({**TRIPOD, "friction": 0.6}))
    with pytest.raises(InvalidInputError, match=r"friction_low must close the grasp, 0\.1 does not"):
        FitConfig(grasp=str(file), friction_low=0.1).resolved()


def test_an_unknown_preset_is_told(tmp_path, capsys):
    assert main(["fit", "--preset", "six_fingers", "--out", str(tmp_path / "m")]) == 2
    assert "paper_cuboid" in capsys.readouterr().err
