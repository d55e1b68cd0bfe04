"""Compiled inference: the fixed grasp's network against numpy, the learned Newton layers against torch, which trains them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from oracles import layers as oracle

from grasp_env.force import Objective, OfflineBasis
from grasp_env.grasp import null_space_basis, presets, wrench
from policies import LearnedInitialForce
from policies.any_grasp import AnyGraspForce
from policies.fixed_grasp import FixedGraspForce
from policies.newton_layers import NewtonLayers, Problems, newton_step, phi

SCALE = 0.1
"""sqrt(lambda / omega) of the default Phi [N]."""


@pytest.fixture(scope="module")
def anywhere():
    return LearnedInitialForce.pretrained("any_grasp")


def problem(grasp, w):
    """The batch of one and its start, in units of sqrt(lambda / omega)."""
    n, basis = grasp.n_contacts, OfflineBasis.of(grasp, Objective())
    rows = torch.from_numpy((grasp.unit_frame @ grasp.cone_matrix).reshape(6, n, 3))[None]
    rest = torch.from_numpy(basis.cone_forces[12].reshape(1, n, 3) / SCALE)
    start = torch.from_numpy(grasp.to_cone(basis.combine(w)).reshape(1, n, 3) / SCALE)
    return Problems(rows, torch.ones(1, n, dtype=torch.float64), rest), start


def some_layers(rule: AnyGraspForce, count: int, part: float = 1.0) -> tuple[AnyGraspForce, NewtonLayers]:
    """The first layers of a model, their last stage multiplied by `part`, compiled and in torch."""
    tensors = {
        name: value * part if ".third." in name else value
        for name, value in rule.checkpoint.tensors.items()
        if int(name.split(".")[1]) < count
    }
    tensors = {name: value.astype(np.float32) for name, value in tensors.items()}
    numbers = {"layers": count, "width": rule.width}
    twin = NewtonLayers(count, rule.width)
    twin.load_state_dict({name: torch.from_numpy(value) for name, value in tensors.items()})
    return AnyGraspForce(replace(rule.checkpoint, tensors=tensors, numbers=numbers)), twin


def network(rule: FixedGraspForce, features: np.ndarray) -> np.ndarray:
    """What the model's network says, plain; the last feature is the friction, of which its weights may be polynomials."""
    tensors, parts = rule.checkpoint.tensors, []
    powers = features[-1] ** np.arange(rule.checkpoint.numbers.get("friction_degree", 0) + 1)
    for k in range(len(rule.sizes) - 1):
        weight, bias = (tensors[f"layers.{k}.{name}"].astype(np.float64) for name in ("weight", "bias"))
        if weight.ndim == 3:
            weight, bias = np.einsum("k,kba->ba", powers, weight), powers @ bias
        parts += [weight.T.ravel(), bias]
    return oracle.network(list(rule.sizes), np.concatenate(parts), features)


def test_the_fixed_network_is_that_of_numpy():
    rule, grasp = LearnedInitialForce.pretrained("four_finger"), presets.paper_cuboid()
    assert isinstance(rule, FixedGraspForce)
    rng = np.random.default_rng(3)
    for friction in rng.uniform(0.25, 0.6, 10):
        there = grasp.with_friction(float(friction))
        internal = null_space_basis(there, rule.checkpoint.tensors["reference"].astype(np.float64))
        for w in wrench.sample_magnitudes(rng, 20):
            inputs, size = rule.features(w[None], np.array([friction]))
            said = network(rule, inputs[0])
            expected = -grasp.pseudoinverse @ w + internal @ (size[0] * said)
            found = rule.raw(there, w).ravel()
            # float32 sums of 64 terms that cancel
            np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("grasp", [presets.tripod(), presets.paper_cuboid(), presets.five_finger_cuboid()])
@pytest.mark.parametrize("count", [1, 2])
def test_layers_equal_torch(anywhere, grasp, count):
    """Where Phi falls with each, so that the core takes the steps as they are."""
    rule, twin = some_layers(anywhere, count)
    taken = 0
    for w in wrench.sample_ball(np.random.default_rng(8), 30):
        problems, x = problem(grasp, w)
        with torch.no_grad():
            made = [x, *twin(problems, x)]
            values = [float(phi(problems, each)) for each in made]
        if not all(after < before for before, after in pairwise(values)):
            continue
        taken += 1
        found = grasp.to_cone(rule(grasp, w)) / SCALE
        expected = made[-1].numpy().ravel()
        # the perceptron is float32: a millionth of a step that may be as long as the force
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert taken >= 15


def test_layers_that_say_nothing_are_shortened_newton_steps(anywhere):
    """With a last stage of zeros a layer is the Newton step, times 1 / sqrt(1 + its size)."""
    grasp = presets.paper_cuboid()
    rule, twin = some_layers(anywhere, 1, 0.0)
    for w in wrench.sample_ball(np.random.default_rng(1), 20):
        problems, x = problem(grasp, w)
        with torch.no_grad():
            expected, plain = twin(problems, x)[0], newton_step(problems, x)
        found = grasp.to_cone(rule(grasp, w)).reshape(1, -1, 3) / SCALE
        np.testing.assert_allclose(found, expected.numpy(), atol=1e-9 * float(expected.abs().max()))
        assert float((expected - x).abs().max()) < float((plain - x).abs().max()) * 1.001


def test_weights_may_be_polynomials_of_the_friction():
    """The network of a friction is that of the polynomials' values there; beyond the training range, of the nearest friction."""
    rule, rng = LearnedInitialForce.pretrained("four_finger"), np.random.default_rng(5)
    assert isinstance(rule, FixedGraspForce)
    numbers = {**rule.checkpoint.numbers, "sizes": [8, 5, 6], "polish": 0, "friction_degree": 2}
    shapes = {
        "layers.0.weight": (3, 5, 8),
        "layers.0.bias": (3, 5),
        "layers.1.weight": (3, 6, 5),
        "layers.1.bias": (3, 6),
    }
    tensors = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    tensors["reference"] = rule.checkpoint.tensors["reference"]
    made = FixedGraspForce(replace(rule.checkpoint, tensors=tensors, numbers=numbers))
    grasp, w = presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    for friction, nearest in ((0.3, 0.3), (0.55, 0.55), (1.5, 0.6), (0.1, 0.25)):
        there = grasp.with_friction(friction)
        internal = null_space_basis(there, tensors["reference"].astype(np.float64))
        inputs, size = made.features(w[None], np.array([nearest]))
        expected = -grasp.pseudoinverse @ w + internal @ (size[0] * network(made, inputs[0]))
        np.testing.assert_allclose(made.raw(there, w).ravel(), expected, atol=3e-6 * np.abs(expected).max())
