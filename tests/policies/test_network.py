"""Compiled inference: the network against numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from oracles import network as oracle

from grasp_env.grasp import null_space_basis, presets, wrench
from policies import LearnedInitialForce


def network(rule: LearnedInitialForce, features: np.ndarray) -> np.ndarray:
    """What the model's network says, plain; the last feature is the friction, of which its weights may be polynomials."""
    tensors, parts = rule.checkpoint.tensors, []
    powers = features[-1] ** np.arange(rule.checkpoint.numbers["friction_degree"] + 1)
    for k in range(len(rule.sizes) - 1):
        weight, bias = (tensors[f"layers.{k}.{name}"].astype(np.float64) for name in ("weight", "bias"))
        parts += [np.einsum("k,kba->ba", powers, weight).T.ravel(), powers @ bias]
    return oracle.network(list(rule.sizes), np.concatenate(parts), features)


def test_the_fixed_network_is_that_of_numpy():
    rule, grasp = LearnedInitialForce.pretrained(), presets.paper_cuboid()
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


def test_weights_may_be_polynomials_of_the_friction():
    """The network of a friction is that of the polynomials' values there; beyond the training range, of the nearest friction."""
    rule, rng = LearnedInitialForce.pretrained(), np.random.default_rng(5)
    numbers = {**rule.checkpoint.numbers, "sizes": [8, 5, 6], "friction_degree": 2}
    shapes = {
        "layers.0.weight": (3, 5, 8),
        "layers.0.bias": (3, 5),
        "layers.1.weight": (3, 6, 5),
        "layers.1.bias": (3, 6),
    }
    tensors = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    tensors["reference"] = rule.checkpoint.tensors["reference"]
    made = LearnedInitialForce(replace(rule.checkpoint, tensors=tensors, numbers=numbers))
    grasp, w = presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    for friction, nearest in ((0.3, 0.3), (0.55, 0.55), (1.5, 0.6), (0.1, 0.25)):
        there = grasp.with_friction(friction)
        internal = null_space_basis(there, tensors["reference"].astype(np.float64))
        inputs, size = made.features(w[None], np.array([nearest]))
        expected = -grasp.pseudoinverse @ w + internal @ (size[0] * network(made, inputs[0]))
        np.testing.assert_allclose(made.raw(there, w).ravel(), expected, atol=3e-6 * np.abs(expected).max())
