"""The learned start: balance and the guarantee for every call, the compiled network, saved models."""

from __future__ import annotations

import json
import pickle
import shutil

import numpy as np
import pytest
import torch

from grasp_env.errors import InfeasibleStartError, ModelFileError
from grasp_env.force import ForceOptimizer, Objective, OfflineBasis, cone_margin, optimize_force
from grasp_env.grasp import Grasp, presets, wrench
from policies import LearnedInitialForce
from policies.kernels import forward
from policies.learned import PRETRAINED
from policies.network import Network


@pytest.fixture(scope="module")
def rule() -> LearnedInitialForce:
    return LearnedInitialForce.pretrained()


def moved(shift: float, friction: float) -> Grasp:
    grasp = presets.paper_cuboid()
    rng = np.random.default_rng(1)
    offset = rng.uniform(-shift, shift, grasp.positions.shape) * [1, 1, 0]
    return Grasp.from_contacts(grasp.positions + offset, grasp.normals, friction)


@pytest.mark.parametrize(("shift", "friction"), [(0.0, 0.4), (0.0, 0.34), (0.003, 0.4), (0.01, 0.2), (0.0, 1.1)])
def test_balanced_strictly_feasible_never_worse_than_the_basis(rule, shift, friction):
    """Also on moved contacts, unseen friction and wrenches far outside the training range."""
    grasp = moved(shift, friction)
    objective = rule.objective
    basis = OfflineBasis.of(grasp, objective)
    rng = np.random.default_rng(2)
    wrenches = np.concatenate(
        [
            wrench.sample_ball(rng, 500),
            wrench.sample_magnitudes(rng, 500, 1e-9, 1e4),
            np.zeros((1, 6)),
            100 * wrench.paper_path(np.linspace(0, 2, 50)),
        ]
    )
    for w in wrenches:
        force = rule(grasp, w)
        scale = np.abs(force).max() + np.abs(w).max()
        assert grasp.residual(force, w) < 1e-11 * scale  # rounding of a 12-term sum, moments over 5 cm
        assert cone_margin(force, grasp.friction) > 0
        paper = objective.value(grasp.to_cone(basis.combine(w)))
        assert objective.value(grasp.to_cone(force)) <= paper * (1 + 1e-12)


def test_a_quarter_of_the_basis_iterations_on_held_out_wrenches(rule):
    """The issue's target, on wrenches no training saw: medians over 300 draws, measured 2 against 45."""
    grasp = presets.paper_cuboid()
    newton, flow = ForceOptimizer(grasp, method="newton", tolerance=1e-10), ForceOptimizer(grasp)
    counts = {"learned": [], "basis": []}
    for w in wrench.sample_ball(np.random.default_rng(77), 300):
        optimum = newton.solve(w).objective
        counts["learned"].append(flow.solve(w, initial=rule, optimum=optimum).iterations)
        counts["basis"].append(flow.solve(w, optimum=optimum).iterations)
    assert np.median(counts["learned"]) <= 0.25 * np.median(counts["basis"])


def test_compiled_network_equals_torch(rule):
    checkpoint = rule.checkpoint
    network = Network(checkpoint.sizes[0], checkpoint.sizes[1:-1], checkpoint.sizes[-1])
    network.load_state_dict({name: torch.from_numpy(value) for name, value in checkpoint.weights.items()})
    rng = np.random.default_rng(3)
    wrenches, friction = wrench.sample_magnitudes(rng, 200), rng.uniform(0.25, 0.6, 200)
    inputs, scale = checkpoint.features(wrenches, friction)
    with torch.no_grad():
        expected = network(torch.from_numpy(inputs).float()).numpy()
    out = np.empty(checkpoint.sizes[-1])
    for k in range(200):
        forward(inputs[k], np.array(checkpoint.sizes), checkpoint.flat_weights(), out)
        np.testing.assert_allclose(out, expected[k], atol=2e-6 * np.abs(expected).max())  # float32 sums of 128 terms
        raw = rule.raw(presets.paper_cuboid(friction[k]), wrenches[k])
        assert np.isfinite(raw).all()
        assert scale[k] > 0


def test_learned_in_the_solver_is_optimal_and_keeps_its_name(rule):
    solution = optimize_force(presets.paper_cuboid(), wrench.PAPER_CONSTANT, initial=rule)
    assert solution.status.name == "OPTIMAL"
    assert solution.initial == "learned"


@pytest.mark.parametrize("barrier_weight", [0.001, 0.1, 1.0])
def test_with_another_phi_it_is_repaired_in_that_one(rule, barrier_weight):
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, initial=rule, barrier_weight=barrier_weight)
    basis = OfflineBasis.of(grasp, optimizer.objective)
    for w in wrench.sample_ball(np.random.default_rng(5), 100):
        start = optimizer.objective.value(grasp.to_cone(optimizer.start(w)))
        assert start <= optimizer.objective.value(grasp.to_cone(basis.combine(w))) * (1 + 1e-12)


def test_names_with_dots_do_not_collide(rule, tmp_path):
    one, two = (rule.checkpoint.save(tmp_path / f"model.v{k}") for k in (1, 2))
    assert one != two
    assert LearnedInitialForce.load(tmp_path / "model.v2")


def test_covers(rule):
    assert rule.covers(np.array(wrench.PAPER_CONSTANT), 0.4)
    assert not rule.covers(np.array([100.0, 0, 0, 0, 0, 0]), 0.4)
    assert not rule.covers(np.array(wrench.PAPER_CONSTANT), 0.9)


def test_other_number_of_contacts(rule):
    with pytest.raises(InfeasibleStartError, match="4 contacts"):
        rule(presets.tripod(), np.zeros(6))


def test_save_load_and_pickle_keep_every_bit(rule, tmp_path):
    grasp, w = presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    stem = tmp_path / "model"
    assert rule.checkpoint.save(stem) == tmp_path / "model.safetensors"
    for again in (
        LearnedInitialForce.load(stem),
        LearnedInitialForce.load(tmp_path / "model.json"),
        pickle.loads(pickle.dumps(rule)),
    ):
        np.testing.assert_array_equal(again(grasp, w), rule(grasp, w))
    assert not list(tmp_path.glob(".*"))  # no temporary left behind


def test_model_card_of_the_shipped_model(rule):
    card = rule.checkpoint.card
    assert card["command"].startswith("grasp fit")
    assert {"data", "config", "seconds", "machine", "versions", "held_out_gap_second_order", "limits"} <= card.keys()
    assert rule.objective == Objective()
    size = sum(PRETRAINED.with_suffix(suffix).stat().st_size for suffix in (".safetensors", ".json"))
    assert size < 1_000_000


def _copy(tmp_path):
    for suffix in (".safetensors", ".json"):
        shutil.copy(PRETRAINED.with_suffix(suffix), tmp_path / f"m{suffix}")
    return tmp_path / "m"


def _edit(stem, **changes):
    path = stem.with_suffix(".json")
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_damaged_and_foreign_model_files(tmp_path):
    with pytest.raises(ModelFileError, match="No such file"):
        LearnedInitialForce.load(tmp_path / "absent")
    stem = _copy(tmp_path)
    weights = stem.with_suffix(".safetensors")
    whole = weights.read_bytes()
    weights.write_bytes(whole[:1000])
    with pytest.raises(ModelFileError, match="truncated"):
        LearnedInitialForce.load(stem)
    weights.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ModelFileError, match="sha256"):
        LearnedInitialForce.load(stem)
    weights.write_bytes(whole)
    _edit(stem, schema="other/7")
    with pytest.raises(ModelFileError, match="other/7"):
        LearnedInitialForce.load(stem)
    stem = _copy(tmp_path)
    _edit(stem, sizes=[8, 64, 6])
    with pytest.raises(ModelFileError, match="do not fit"):
        LearnedInitialForce.load(stem)
    stem = _copy(tmp_path)
    _edit(stem, features={"length": "x"})
    with pytest.raises(ModelFileError, match="malformed"):
        LearnedInitialForce.load(stem)
    stem.with_suffix(".json").write_text("not json")
    with pytest.raises(ModelFileError, match="not JSON") as caught:
        LearnedInitialForce.load(stem)
    assert isinstance(caught.value, ValueError | OSError)
    stem.with_suffix(".json").write_text("[]")
    with pytest.raises(ModelFileError, match="schema"):
        LearnedInitialForce.load(stem)


@pytest.mark.slow
def test_never_worse_on_a_million_wrenches(rule):
    grasp = presets.paper_cuboid()
    objective, basis = rule.objective, OfflineBasis.of(grasp, rule.objective)
    for w in wrench.sample_magnitudes(np.random.default_rng(9), 1_000_000, 1e-3, 100.0):
        learned = objective.value(grasp.to_cone(rule(grasp, w)))
        assert learned <= objective.value(grasp.to_cone(basis.combine(w))) * (1 + 1e-12)
