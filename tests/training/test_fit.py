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

from grasp_env.errors import InvalidInputError, ModelFileError
from grasp_env.force import Objective, optimize_force
from grasp_env.grasp import null_space_basis, presets, reference_basis
from grasp_env.grasp.wrench import magnitude, sample_ball
from policies import LearnedInitialForce
from policies.features import N_FEATURES, Features
from policies.network import Network, activation
from training.cli import main
from training.data.one_grasp import label, sample
from training.fit.four_finger import NetworkTask, fit
from training.fit.settings import FitConfig
from training.fit.soap import Soap
from training.fit.state import Progress, StateFile

FIXED: dict[str, Any] = {"steps": 40, "samples": 4096, "hidden": (16,), "batch_size": 256}


@pytest.fixture
def small_scores(monkeypatch):
    """Scores on fewer wrenches."""
    monkeypatch.setattr("training.fit.four_finger.HELD_OUT", 100)


def test_labels_are_optima_and_the_metric_is_the_gap():
    grasp, objective = presets.paper_cuboid(), Objective()
    samples = sample(np.random.default_rng(0), 50, (0.1, 20.0), (0.25, 0.6), 10)
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
    wrenches, friction = sample(np.random.default_rng(0), 6000, (10.0, 20.0), (0.25, 0.6), 20)
    parts = np.linspace(0.25, 0.6, 21)
    for group, (low, high) in zip(friction.reshape(20, -1), pairwise(parts), strict=True):
        assert low <= group[0] <= high
        assert (group == group[0]).all()
    inside = (np.linalg.norm(wrenches[:, :3], axis=1) <= 2.0) & (np.linalg.norm(wrenches[:, 3:], axis=1) <= 0.05)
    # all others are of 10 N and more; three standard deviations of a fair coin
    assert abs(inside.mean() - 0.5) < 3 * 0.5 / np.sqrt(6000)
    assert (magnitude(wrenches[~inside]) >= 10.0).all()


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
    network = Network(N_FEATURES, (16,), 6, 2)
    for layer, parameter in enumerate(network.layers):
        weight, bias = (torch.from_numpy(checkpoint.tensors[f"layers.{layer}.{name}"]) for name in ("weight", "bias"))
        with torch.no_grad():
            parameter.copy_(torch.cat([weight.mT, bias[:, None]], 1).reshape(parameter.shape))
    model, features = LearnedInitialForce(checkpoint), Features()
    wrenches = sample_ball(np.random.default_rng(3), 20)
    for friction in (0.25, 0.4, 0.57):
        grasp = presets.paper_cuboid().with_friction(friction)
        inputs, size = features(wrenches, np.full(20, friction))
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


def test_the_same_bits_also_after_an_interrupt(tmp_path, monkeypatch, small_scores):
    settings, out = FitConfig(**FIXED), tmp_path / "model"
    whole = fit(settings).checkpoint
    real, calls = NetworkTask.loss, []

    def interrupted(self, rng):
        calls.append(1)
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return real(self, rng)

    monkeypatch.setattr(NetworkTask, "loss", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(settings, out=out)
    assert len(calls) == 4
    with pytest.raises(InvalidInputError, match="unfinished training: add --resume"):
        fit(settings, out=out)
    with pytest.raises(InvalidInputError, match=r"other settings \(seed was 0, is 1\)"):
        fit(FitConfig(**FIXED, seed=1), out=out, resume=True)
    again = fit(settings, out=out, resume=True).checkpoint
    assert whole.tensors.keys() == again.tensors.keys()
    for key, value in whole.tensors.items():
        np.testing.assert_array_equal(value, again.tensors[key])


def test_a_state_is_refused_if_truncated_or_changed(tmp_path):
    network, settings, out = Network(N_FEATURES, (4,), 6, 0), {"seed": 0}, tmp_path / "model"
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
    monkeypatch.setattr("training.fit.four_finger.label", _no_work)
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
        {"seconds": 0.0},
        {"seconds": float("nan")},
        {"seconds": float("inf")},
        {"samples": 10},
        {"batch_size": 0},
        {"seed": -1},
        {"steps": -1},
        {"learning_rate": float("nan")},
        {"tail": 0.0},
        {"low": 0.0},
        {"friction_low": 0.9},
        {"hidden": (0,)},
        {"hidden": ()},
        {"threads": 0},
        {"degree": -1},
    ],
)
def test_wrong_settings(wrong):
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        FitConfig(**wrong)


def test_an_unknown_preset_is_told(tmp_path, capsys):
    assert main(["fit", "--preset", "six_fingers", "--out", str(tmp_path / "m")]) == 2
    assert "paper_cuboid" in capsys.readouterr().err
