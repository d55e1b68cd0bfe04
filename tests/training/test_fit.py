"""Labels are optima, the metric is the gap, a short fit beats the basis, the same seed gives the same network."""

from __future__ import annotations

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError
from grasp_env.force import Objective, optimize_force
from grasp_env.grasp import null_space_basis, presets, reference_basis, wrench
from policies import LearnedInitialForce
from training.dataset import generate
from training.fit import fit
from training.settings import FitConfig


def test_labels_are_optima_and_the_metric_is_the_gap():
    grasp, objective = presets.paper_cuboid(), Objective()
    data = generate(grasp, reference_basis(grasp), objective, np.random.default_rng(0), 50, (0.1, 20.0), (0.25, 0.6))
    rng = np.random.default_rng(1)
    for k in range(50):
        here = grasp.with_friction(data.friction[k])
        best = optimize_force(here, data.wrenches[k], method="newton", tolerance=1e-10)
        basis = null_space_basis(here, reference_basis(grasp))
        particular = -here.pseudoinverse @ data.wrenches[k]
        force = particular + basis @ data.coordinates[k].astype(float)
        # coordinates are float32: 1e-7 of the force, a gap of its square times the conditioning
        assert objective.value(here.to_cone(force)) == pytest.approx(best.objective, rel=1e-6)
        step = rng.normal(size=6)
        step *= 1e-3 / np.linalg.norm(data.metric[k] @ step)  # a predicted gap of 1e-6, deep in the quadratic region
        exact = basis.T @ (best.force.reshape(-1) - particular)
        value = objective.value(here.to_cone(particular + basis @ (exact + step)))
        assert value / best.objective - 1.0 == pytest.approx(1e-6, rel=0.1)


def test_a_short_fit_learns_and_repeats():
    config = FitConfig(steps=400, samples=20_000, hidden=(64, 64), batch_size=512, threads=1)
    one, two = fit(config), fit(config)
    assert one.curve[-1, 2] < 0.05 * one.curve[0, 2]  # median gap, held out
    for name, value in one.checkpoint.weights.items():
        np.testing.assert_array_equal(value, two.checkpoint.weights[name])
    rule = LearnedInitialForce(one.checkpoint)
    grasp = presets.paper_cuboid()
    starts = {"learned": rule, "basis": "linear_combination"}
    steps = {
        name: np.median(
            [
                optimize_force(grasp, w, initial=start).iterations  # type: ignore[arg-type]
                for w in wrench.sample_ball(np.random.default_rng(2), 60)
            ]
        )
        for name, start in starts.items()
    }
    assert steps["learned"] < steps["basis"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"seconds": 0.0},
        {"samples": 10},
        {"low": 0.0},
        {"friction_low": 0.9},
        {"batch_size": 0},
        {"seed": -1},
        {"learning_rate": float("nan")},
        {"hidden": (0,)},
    ],
)
def test_wrong_settings(wrong):
    with pytest.raises(InvalidInputError):
        FitConfig(**wrong)
