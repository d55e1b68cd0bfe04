"""Compiled inference against torch: the fixed grasp's network and the learned Newton layers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from grasp_env.force import ForceOptimizer, Objective, OfflineBasis
from grasp_env.force.layer_kernels import FEATURES, _forward, refine
from grasp_env.grasp import presets, wrench
from policies import LearnedInitialForce
from policies.kernels import forward
from policies.network import Network
from policies.newton_layers import NewtonLayers, Problems, newton_step, phi

SCALE = 0.1
"""sqrt(lambda / omega) of the default Phi [N]."""


@pytest.fixture(scope="module")
def anywhere():
    return LearnedInitialForce.pretrained("any_grasp")


@pytest.fixture(scope="module")
def twin(anywhere) -> NewtonLayers:
    network = NewtonLayers(len(anywhere.layers), anywhere.width)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in anywhere.checkpoint.tensors.items()})
    return network


def problem(grasp, w):
    """The batch of one and its start, in units of sqrt(lambda / omega)."""
    n, basis = grasp.n_contacts, OfflineBasis.of(grasp, Objective())
    rows = torch.from_numpy((grasp.unit_frame @ grasp.cone_matrix).reshape(6, n, 3))[None]
    rest = torch.from_numpy(basis.cone_forces[12].reshape(1, n, 3) / SCALE)
    start = grasp.to_cone(basis.combine(w))
    return Problems(rows, torch.ones(1, n, dtype=torch.float64), rest), start


def test_the_fixed_network_equals_torch():
    rule = LearnedInitialForce.pretrained("four_finger")
    sizes = rule.sizes
    network = Network(sizes[0], sizes[1:-1], sizes[-1])
    names = network.state_dict()
    network.load_state_dict({name: torch.from_numpy(rule.checkpoint.tensors[name]) for name in names})
    rng = np.random.default_rng(3)
    inputs, _ = rule.features(wrench.sample_magnitudes(rng, 200), rng.uniform(0.25, 0.6, 200))
    with torch.no_grad():
        expected = network(torch.from_numpy(inputs).float()).numpy()
    out = np.empty(sizes[-1])
    for k in range(200):
        forward(inputs[k], np.array(sizes), rule._flat, out)
        np.testing.assert_allclose(out, expected[k], atol=1e-6 * np.abs(expected).max())


def test_a_layers_perceptron_equals_torch(anywhere, twin):
    rng = np.random.default_rng(3)
    width = anywhere.width
    for n in (3, 4, 5):
        padded = -(-n // 4) * 4
        features = np.zeros((padded, FEATURES), np.float32)
        features[:n] = rng.normal(size=(n, FEATURES))
        for k, layer in enumerate(twin.layers):
            with torch.no_grad():
                expected = layer(torch.from_numpy(features[:n])[None], torch.ones(1, n))[0].numpy()
            out = np.empty((n, 3), np.float32)
            _forward(features, anywhere.layers[k], width, np.empty((2 * padded + 2, width), np.float32), out)
            np.testing.assert_allclose(out, expected, atol=2e-6 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("grasp", [presets.tripod(), presets.paper_cuboid(), presets.five_finger_cuboid()])
@pytest.mark.parametrize("learned", [True, False])
def test_layers_equal_torch(anywhere, twin, grasp, learned):
    """One layer, learned or plain. Phi falls, so that the kernel accepts the step as it is."""
    rows = np.ascontiguousarray(grasp.unit_frame @ grasp.cone_matrix)
    weights, rest = Objective().weights(grasp.n_contacts), OfflineBasis.of(grasp, Objective()).cone_forces[12]
    network = anywhere.layers[:1] if learned else np.zeros((0, 0), np.float32)
    for w in wrench.sample_ball(np.random.default_rng(8), 30):
        problems, start = problem(grasp, w)
        with torch.no_grad():
            x = torch.from_numpy(start.reshape(1, -1, 3) / SCALE)
            expected = twin(problems, x)[0] if learned else newton_step(problems, x)
            if not phi(problems, expected) < phi(problems, x):
                continue
        found = start.copy()
        assert refine(found, rows, rest, weights, network, anywhere.width, 1, 0.0, np.empty(6)) == 1
        # the perceptron is float32: a millionth of a step that may be as long as the force
        np.testing.assert_allclose(found / SCALE, expected.numpy().ravel(), atol=1e-5 * float(expected.abs().max()))


def test_layers_only_lower_phi_and_keep_balance(anywhere):
    grasp, objective = presets.five_finger_cuboid(), Objective()
    rows, weights = np.ascontiguousarray(grasp.unit_frame @ grasp.cone_matrix), objective.weights(5)
    basis = OfflineBasis.of(grasp, objective)
    for w in wrench.sample_magnitudes(np.random.default_rng(2), 100, 1e-3, 1e3):
        x = grasp.to_cone(basis.combine(w))
        before = objective.value(x)
        for _ in range(6):
            refine(x, rows, basis.cone_forces[12], weights, anywhere.layers, anywhere.width, 1, 0.0, np.empty(6))
            assert objective.value(x) <= before
            before = objective.value(x)
        # where depths in the cones differ a thousandfold the 6 x 6 system loses digits, which callers take off
        assert grasp.residual(grasp.to_force(x), w) < 1e-7 * np.abs(x).max()


def test_plain_steps_are_newtons(anywhere):
    """Without weights the layers end where Newton does."""
    grasp = presets.paper_cuboid()
    rows, weights = np.ascontiguousarray(grasp.unit_frame @ grasp.cone_matrix), Objective().weights(4)
    basis = OfflineBasis.of(grasp, Objective())
    newton = ForceOptimizer(grasp, method="newton", tolerance=1e-12)
    for w in wrench.sample_ball(np.random.default_rng(1), 20):
        x, multipliers = grasp.to_cone(basis.combine(w)), np.empty(6)
        refine(x, rows, basis.cone_forces[12], weights, np.zeros((0, 0), np.float32), 0, 40, 0.0, multipliers)
        assert Objective().value(x) == pytest.approx(newton.solve(w).objective, rel=1e-12)
        unit = multipliers @ grasp.unit_frame
        np.testing.assert_allclose(unit, newton.solve(w).multipliers, atol=1e-6 * np.abs(unit).max())
