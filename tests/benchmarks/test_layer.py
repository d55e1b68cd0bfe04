"""The problems and their cone coordinates by hand, other layers against our solvers, and the table
of a run with known layers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import layer
from benchmarks.layer import ANSWERS, FORWARD, LAYER, LayerSettings, answers, draw
from benchmarks.layer_peers import PEERS, Contestant, cone_form
from grasp_env.force import ForceLimits, optimize_forces
from training.evaluation.results.table import summary

COUNT = 40


@pytest.fixture(scope="module")
def problems():
    return draw(3, COUNT)


def test_a_part_of_the_limits_binds_and_the_layer_keeps_all(problems):
    grasps, data = problems
    joints = data["jacobian"].numpy()
    limits = data["torque_limit"].numpy()
    free = optimize_forces(grasps, data["wrench"].numpy(), method="newton", workers=1)
    needed = np.abs(
        np.einsum("knij,kni->kj", joints, [solution.object_force for solution in free])
    ).max(axis=1)
    assert 0.1 < (needed > limits[:, 0]).mean() < 0.5
    for k, grasp in enumerate(grasps):
        within = ForceLimits(jacobian=joints[k], torque_limit=limits[k])
        assert optimize_forces(
            grasp, data["wrench"].numpy()[k][None], limits=within, workers=1
        ).optimal.all()
    # a finger's joints move its own contact
    moved = np.abs(joints).max(axis=2).reshape(COUNT, 4, 4, 3).max(axis=3)
    assert (moved[:, ~np.eye(4, dtype=bool)] == 0.0).all()
    assert (moved[:, np.eye(4, dtype=bool)] > 0.01).all()
    assert all(torch.equal(draw(3, COUNT)[1][name], values) for name, values in data.items())
    # the layer itself
    built = {LAYER: layer.ours(COUNT)}
    (rows,) = layer.compared(grasps, {name: data[name] for name in layer.BASE}, built)
    assert rows["balance"].max() < 1e-6  # in cone coordinates
    assert rows["force_excess"].between(0.0, 1.0).all()
    assert 0.05 < rows["force_excess"].median() < 0.3
    for names in layer.CASES.values():
        given = layer.leaves({name: data[name] for name in names})
        slopes = torch.autograd.grad(built[LAYER](**given).square().sum(), list(given.values()))
        assert all(slope.isfinite().all() and slope.abs().max() > 0.0 for slope in slopes)


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.filterwarnings("ignore::Warning")  # theirs
def test_another_layer_agrees_with_our_solver(name, problems):
    peer = PEERS[name]
    try:
        call = peer.build(COUNT)
    except ImportError as error:
        pytest.skip(str(error))
    grasps = problems[0]
    data = {part: problems[1][part] for part in layer.BASE}
    method = "newton" if peer.phi else "conic"

    def forces(wrenches):
        options = {} if peer.phi else {"tolerance": 1e-9}
        solutions = optimize_forces(grasps, wrenches, method=method, workers=1, **options)
        return np.array([solution.object_force for solution in solutions])

    known = forces(data["wrench"].numpy())
    wrenches = data["wrench"].numpy()
    found, slopes = answers(call, data, True)
    assert all(torch.isfinite(slope).all() for slope in slopes)
    if name == "qplayer":  # another problem: of pyramids
        assert (
            np.linalg.norm(found.sum(dim=1).numpy() + wrenches[:, :3], axis=1) < 1e-6
        ).mean() > 0.9
        return
    np.testing.assert_allclose(found, known, atol=2e-3 * np.abs(known).max())
    if name == "cvxpylayers":  # its default gradients are rough
        return
    way = np.random.default_rng(1).standard_normal((COUNT, 6)) * [1, 1, 1, 0.03, 0.03, 0.03]
    step = 1e-4
    change = sum(
        sign * (forces(wrenches + sign * step * way) ** 2).sum(axis=(1, 2)) for sign in (1, -1)
    ) / (2 * step)
    apart = np.abs((slopes[3].numpy() * way).sum(axis=1) - change) / np.abs(change).max()
    assert np.quantile(apart, 0.9) < 1e-2


def least_norm(matrix, load, cost):
    """A known layer of cone coordinates: the least forces that balance, a percent too large."""
    return -1.01 * (torch.linalg.pinv(matrix) @ load[..., None])[..., 0]


def ours(positions, normals, friction, wrench, **limits):
    """The same without the percent, of contacts."""
    form, axes = cone_form(positions, normals, friction, wrench)
    unused = sum(0.0 * values.sum() for values in limits.values())
    return (least_norm(**form).unflatten(1, (-1, 3))[..., None] / 1.01 * axes).sum(dim=-2) + unused


def test_rows_of_known_layers(monkeypatch):
    def absent(batch):
        raise ImportError("No module named 'theseus'")

    mine = dict.fromkeys((LAYER, FORWARD), Contestant("", lambda batch: ours))
    peers = {
        "near": Contestant("", lambda batch: least_norm),
        "theseus": Contestant("", absent, "theseus-ai"),
    }
    took = {LAYER: [4e-5, 2e-5], FORWARD: [1e-5, 1e-5], "near": [4e-4, 6e-4]}
    turns = {}

    def seconds(call, given, backward, passes):
        name = {(1, True): LAYER, (1, False): FORWARD}.get(
            (int("positions" in given[0]), backward), "near"
        )
        turns[name] = turns.get(name, -1) + 1
        assert passes == 7
        assert all(values.requires_grad == backward for part in given for values in part.values())
        layer.step(call, given[0], backward)
        return np.full(len(given), took[name][turns[name] % 2])

    known = {"OURS": mine, "PEERS": peers, "CONTESTANTS": mine | peers, "seconds": seconds}
    for name, value in known.items():
        monkeypatch.setattr(layer, name, value)
    rows = layer.run(LayerSettings(batches=(1, 3, 4), calls=3, rounds=2, passes=7))
    lacking = rows.dropna(subset="reason")[["method", "reason"]].to_numpy().tolist()
    assert lacking == [["theseus", "No module named 'theseus': pip install theseus-ai"]]
    found = summary(rows[rows["reason"].isna()]).set_index(["case", "batch", "method"])
    timed = {key: row for key, row in found.iterrows() if key[0] != ANSWERS}
    assert {key[0] for key in timed} == {"hard", "limits", "soft"}
    assert {key[0] for key in timed if key[2] == "near"} == {"hard"}
    # three calls of one problem, or one call of three or of all four, in two rounds
    assert {key[1]: row["n"] for key, row in timed.items()} == {1: 6, 3: 2, 4: 2}
    assert timed["soft", 1, LAYER]["microseconds_median"] == pytest.approx(30.0)
    assert timed["hard", 4, "near"]["microseconds_median"] == pytest.approx(500.0 / 4)
    assert timed["hard", 4, "near"]["ratio_median"] == pytest.approx(20.0)
    near = found.loc[ANSWERS, 4, "near"]
    assert near["force_difference_max"] == pytest.approx(0.01)
    assert near["gradient_difference_max"] == pytest.approx(1.01**2 - 1.0)
    assert (near["failed_sum"], found.loc[ANSWERS, 4, LAYER]["failed_sum"]) == (4, 0)
    assert np.isnan(found.loc[ANSWERS, 4, LAYER]["force_difference_max"])
