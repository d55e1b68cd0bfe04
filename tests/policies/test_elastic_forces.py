"""Forces and gradients of the layer where prices are high: beyond limits, without balance, and just within limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from layer_problems import almost_infeasible, human
from oracles.elastic import excess, least_excess, penalised
from scipy.linalg import null_space
from torch import Tensor

from policies import GraspForces, grasp_force, layer

LIMITS = {"normals": "max_normal", "torques": "torque_limit"}
STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
"""Steps of differences; the best counts: a long one is off where the force bends, a short one where it is rounded."""


def elastic(**given: Any) -> GraspForces:
    return grasp_force(**given, infeasible="elastic")


def slopes(given: dict[str, Tensor], name: str) -> tuple[GraspForces, Tensor, Tensor]:
    """Answers, their error of the slope of a random sum of forces along a random change of wrench and limits, and True without gradient."""
    draw = torch.Generator().manual_seed(0)
    by = torch.randn(given["positions"].shape, generator=draw, dtype=torch.float64)
    change = {key: torch.randn(given[key].shape, generator=draw, dtype=torch.float64) for key in ("wrench", name)}
    change["wrench"][:, 3:] *= 0.02
    change[name] *= given[name]
    leaves = {key: given[key].clone().requires_grad_() for key in change}
    found = elastic(**given | leaves)
    (by * found.force).sum().backward()
    parts = torch.cat([leaves[key].grad * a for key, a in change.items()], -1)  # type: ignore[operator]
    slope, size = parts.sum(-1), parts.abs().sum(-1)
    error = torch.full_like(slope, torch.inf)
    with torch.no_grad():
        for step in STEPS:
            moved = [elastic(**given | {key: given[key] + k * step * a for key, a in change.items()}) for k in (1, -1)]
            expected = (by * (moved[0].force - moved[1].force)).sum((1, 2)) / (2.0 * step)
            # a slope that is the small sum of large parts has their digits
            error = torch.minimum(
                error, (slope - expected).abs() / torch.maximum(slope.abs(), 0.01 * size).clamp(min=1e-9)
            )
    return GraspForces(*(a.detach() for a in found)), error, size == 0.0


def moved(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).abs().amax((1, 2)) / b.abs().amax((1, 2))


@pytest.mark.parametrize("batch", [20, pytest.param(250, marks=pytest.mark.slow)])
@pytest.mark.parametrize("limits", LIMITS)
def test_elastic_forces_have_their_last_digits_and_the_slopes_of_these(limits: str, batch: int) -> None:
    for contacts in (3, 4, 5, 6):
        given = human(limits, contacts, batch)
        found, error, declared = slopes(given, LIMITS[limits])
        assert (found.status == 5).sum() > 0.3 * batch
        assert declared.sum() <= 0.01 * batch  # a force that has not converged has no gradient
        assert error[~declared].max() < 0.01
        near = elastic(**given | {"wrench": given["wrench"] * (1.0 + 1e-9)})
        again = elastic(**given, start=found.force)
        assert torch.equal(again.status, found.status)
        for other in (near, again):
            assert moved(other.force, found.force)[~declared].max() < 1e-6


def test_a_force_that_has_not_converged_has_no_gradient() -> None:
    """With barriers a millionth of the usual, the penalties are too steep for the digits of most forces. The others have right slopes."""
    given = human("normals", 4, 40, seed=3)
    given["barrier_weight"] = torch.full((40, 4), 1e-8, dtype=torch.float64)
    found, error, declared = slopes(given, "max_normal")
    assert declared.any()
    assert not declared.all()
    assert (found.status[declared] != 0).all()
    assert found.force.isfinite().all()
    assert error[~declared].max() < 0.01


@pytest.mark.parametrize("limits", LIMITS)
def test_the_core_agrees_with_batched_newton_on_them(limits: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given, found = human(limits, 4, 6, seed=1), []
    for in_core in (True, False):
        monkeypatch.setattr(layer, "_CORE", in_core)
        wrench = given["wrench"].clone().requires_grad_()
        forces = elastic(**given | {"wrench": wrench}, max_iterations=1000)  # batched Newton takes more
        forces.force.square().sum().backward()
        found.append((forces, wrench.grad))
    (a, by_a), (b, by_b) = found
    alike = a.status == b.status  # 3 and 7 differ in whether a proof was found
    assert (alike | ((a.status % 4 == 3) & (b.status % 4 == 3))).all()
    assert moved(a.force, b.force).max() < 1e-7
    assert ((by_a - by_b).abs().amax(1) / by_b.abs().amax(1)).max() < 1e-4


def test_elastic_forces_are_least() -> None:
    """No balanced change lowers the plain formula, and another minimiser finds no smaller sum of squared excesses."""
    given, rng = human("normals", 4, 24, seed=2), np.random.default_rng(0)
    found = elastic(**given)
    exceeding = (found.status == 5).nonzero().flatten().tolist()
    assert len(exceeding) > 8
    compared = 0
    for k in exceeding:
        force, most, mu = found.force[k].numpy(), given["max_normal"][k].numpy(), float(given["friction"][k, 0, 0])
        normals = given["normals"][k].numpy()
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        points = given["positions"][k].numpy()
        moments = np.concatenate([np.cross(points, each) for each in np.eye(3)]).reshape(3, 4, 3)
        balance = np.concatenate([np.tile(np.eye(3), 4), moments.transpose(2, 1, 0).reshape(3, 12)])
        least = penalised(force, normals, mu, most)
        assert np.isfinite(least)
        free = null_space(balance)
        for size in 10.0 ** rng.uniform(-7.0, 0.0, 200):
            change = size * (free @ rng.normal(size=free.shape[1])).reshape(4, 3)
            assert penalised(force + change, normals, mu, most) > least * (1.0 - 1e-12)

        other = least_excess(force, normals, mu, most, balance)
        compared += other is not None
        # a newton of excess costs about a thousand newtons of Phi, so Phi itself moves the least excess by a few hundredths
        assert other is None or excess(force, normals, most) <= 1.01 * excess(other, normals, most) + 0.05
    assert compared > 0.5 * len(exceeding)


@pytest.mark.parametrize("limits", LIMITS)
def test_gradients_of_optima_just_within_their_limits(limits: str) -> None:
    for contacts in (3, 4, 5, 6):
        given = almost_infeasible(limits, contacts, 40)
        found, error, without = slopes(given, LIMITS[limits])
        optimal = found.status == 0
        assert optimal.sum() > 12
        assert not without[optimal].any()
        assert error[optimal].max() < 1e-3
