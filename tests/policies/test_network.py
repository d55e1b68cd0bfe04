"""Compiled inference: the network against numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from oracles import network as oracle

from grasp_env.force import ForceOptimizer, Objective
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.grasp.null_space import null_space_basis
from policies import LearnedInitialForce
from policies.features import surface_pairs


def network(rule: LearnedInitialForce, features: np.ndarray) -> np.ndarray:
    """Return the output of the model's network by numpy; the last feature is the friction, of which
    its weights may be polynomials."""
    tensors = rule.checkpoint.tensors
    parts = []
    powers = features[-1] ** np.arange(rule.checkpoint.numbers["friction_degree"] + 1)
    for k in range(len(rule.sizes) - 1):
        weight, bias = (
            tensors[f"layers.{k}.{name}"].astype(np.float64) for name in ("weight", "bias")
        )
        parts += [np.einsum("k,kba->ba", powers, weight).T.ravel(), powers @ bias]
    return oracle.network(list(rule.sizes), np.concatenate(parts), features)


def expected(rule: LearnedInitialForce, grasp: Grasp, w: np.ndarray, friction: float) -> np.ndarray:
    """Return the force (3N,) of the network by numpy."""
    pairs, reference = (
        rule.checkpoint.tensors[name].astype(np.float64) for name in ("pairs", "reference")
    )
    inputs, size = rule.features((grasp.unit_frame @ w)[None], np.array([friction]), pairs)
    return -grasp.pseudoinverse @ w + null_space_basis(grasp, reference) @ (
        size[0] * network(rule, inputs[0])
    )


def test_the_fixed_network_is_that_of_numpy():
    rule = LearnedInitialForce.pretrained()
    grasp = presets.paper_cuboid()
    rng = np.random.default_rng(3)
    for friction in rng.uniform(0.25, 0.6, 10):
        there = grasp.with_friction(float(friction))
        for w in wrench.sample_magnitudes(rng, 20):
            force = expected(rule, there, w, float(friction))
            # Sums of 64 float32 terms that cancel, in an order that depends on the register width:
            # up to 1.3e-5 of the largest force in 1,000 wrenches with AVX2. One weight left out:
            # 7e-4 (median).
            np.testing.assert_allclose(
                rule.raw(there, w).ravel(), force, atol=5e-5 * np.abs(force).max()
            )


def test_weights_may_be_polynomials_of_the_friction():
    """The network of a friction is that of the polynomials' values there; beyond the training
    range, of the nearest friction."""
    rule = LearnedInitialForce.pretrained()
    rng = np.random.default_rng(5)
    reads = rule.sizes[0]
    numbers = {**rule.checkpoint.numbers, "sizes": [reads, 5, 6], "friction_degree": 2}
    shapes = {"0.weight": (3, 5, reads), "0.bias": (3, 5), "1.weight": (3, 6, 5), "1.bias": (3, 6)}
    tensors = {
        f"layers.{name}": rng.normal(size=shape).astype(np.float32)
        for name, shape in shapes.items()
    }
    tensors |= {name: rule.checkpoint.tensors[name] for name in ("reference", "pairs")}
    made = LearnedInitialForce(replace(rule.checkpoint, tensors=tensors, numbers=numbers))
    grasp = presets.paper_cuboid()
    w = np.array(wrench.PAPER_CONSTANT)
    for friction, nearest in ((0.3, 0.3), (0.55, 0.55), (1.5, 0.6), (0.1, 0.25)):
        there = grasp.with_friction(friction)
        force = expected(made, there, w, nearest)
        np.testing.assert_allclose(
            made.raw(there, w).ravel(), force, atol=3e-6 * np.abs(force).max()
        )


def test_lengths_along_the_surfaces_are_those_of_the_least_force_and_of_the_optimum_near_no_wrench():
    """Also where cones are elliptic and the origin is elsewhere."""
    base = presets.paper_cuboid()
    grasp = Grasp.from_contacts(
        base.positions + np.array([0.3, -0.2, 0.1]), base.normals, [[0.4, 0.6]] * 4
    )
    pairs = surface_pairs(grasp, Objective())
    w = np.array([0.02, 0.01, -0.015, 1e-3, -2e-3, 5e-4])
    o, t = (pairs @ (grasp.unit_frame @ w)).reshape(2, 2, 4)
    least = grasp.to_cone((-grasp.pseudoinverse @ w).reshape(-1, 3)).reshape(-1, 3)
    np.testing.assert_allclose(np.hypot(o[0], t[0]), np.hypot(least[:, 1], least[:, 2]), rtol=1e-9)
    solver = ForceOptimizer(grasp, tolerance=1e-12)
    rest, little = (
        grasp.to_cone(solver.solve(size * w).force).reshape(-1, 3) for size in (0.0, 1e-3)
    )
    change = (little - rest) / 1e-3
    np.testing.assert_allclose(
        np.hypot(o[1], t[1]), np.hypot(change[:, 1], change[:, 2]), rtol=1e-2
    )
