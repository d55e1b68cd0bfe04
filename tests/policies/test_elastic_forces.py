"""Forces and gradients of the layer where prices are high: beyond limits, without balance, and just
within limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from layer_problems import HOPELESS, almost_infeasible, human, problems
from oracles.elastic import excess, least_excess, penalised, spread_matrix
from scipy.linalg import null_space
from torch import Tensor

from policies import GraspForces, grasp_force

LIMITS = {"normals": "max_normal", "torques": "torque_limit"}
STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
"""Steps of differences; the best counts: a long one is off where the force bends, a short one where
it is rounded."""


def elastic(**given: Any) -> GraspForces:
    return grasp_force(**given, infeasible="elastic")


def slopes(given: dict[str, Tensor], name: str) -> tuple[GraspForces, Tensor, Tensor]:
    """Answers, their error of the slope of a random sum of forces along a random change of wrench
    and limits, and True without gradient."""
    draw = torch.Generator().manual_seed(0)
    by = torch.randn(given["positions"].shape, generator=draw, dtype=torch.float64)
    change = {
        key: torch.randn(given[key].shape, generator=draw, dtype=torch.float64)
        for key in ("wrench", name)
    }
    change["wrench"][:, 3:] *= 0.02
    change[name] *= given[name]
    leaves = {key: given[key].clone().requires_grad_() for key in change}
    found = elastic(**given | leaves)
    (by * found.force).sum().backward()
    parts = torch.cat([leaves[key].grad * a for key, a in change.items()], -1)  # type: ignore[operator]
    slope = parts.sum(-1)
    size = parts.abs().sum(-1)
    error = torch.full_like(slope, torch.inf)
    with torch.no_grad():
        for step in STEPS:
            moved = [
                elastic(**given | {key: given[key] + k * step * a for key, a in change.items()})
                for k in (1, -1)
            ]
            expected = (by * (moved[0].force - moved[1].force)).sum((1, 2)) / (2.0 * step)
            # a slope that is the small sum of large parts has their digits
            error = torch.minimum(
                error,
                (slope - expected).abs() / torch.maximum(slope.abs(), 0.01 * size).clamp(min=1e-9),
            )
    return GraspForces(*(a.detach() for a in found)), error, size == 0.0


def moved(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).abs().amax((1, 2)) / b.abs().amax((1, 2))


@pytest.mark.parametrize("batch", [20, pytest.param(250, marks=pytest.mark.slow)])
@pytest.mark.parametrize("limits", LIMITS)
def test_elastic_forces_have_their_last_digits_and_the_slopes_of_these(limits, batch):
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


def test_a_force_that_has_not_converged_has_no_gradient():
    """With barriers a millionth of the usual, the penalties are too steep for the digits of most
    forces. The others have right slopes."""
    given = human("normals", 4, 40, seed=3)
    given["barrier_weight"] = torch.full((40, 4), 1e-8, dtype=torch.float64)
    found, error, declared = slopes(given, "max_normal")
    assert declared.any()
    assert not declared.all()
    assert (found.status[declared] != 0).all()
    assert found.force.isfinite().all()
    assert error[~declared].max() < 0.01


KINDS = {
    **{kind: lambda kind=kind: problems(kind, 8) for kind in HOPELESS},
    **{f"human {limits}": lambda limits=limits: human(limits, 4, 12, seed=2) for limits in LIMITS},
    "pairs": lambda: human("normals", 2, 8),
}


@pytest.mark.parametrize("kind", KINDS)
def test_elastic_forces_are_least_and_their_multipliers_are_slopes(kind):
    given = KINDS[kind]()
    rng = np.random.default_rng(0)
    step = 1e-4
    given["normals"] = given["normals"] / given["normals"].norm(dim=-1, keepdim=True)
    direction = torch.from_numpy(
        rng.normal(size=given["wrench"].shape) * [1, 1, 1, 0.02, 0.02, 0.02]
    )
    loads = [given["wrench"] + k * step * direction for k in (0.0, 1.0, -1.0)]
    found = [elastic(**given | {"wrench": load}) for load in loads]
    same = (found[0].status == found[1].status) & (found[0].status == found[2].status)
    compared = (same & (found[0].status > 2)).nonzero().flatten().tolist()
    assert len(compared) > 0.4 * len(direction)
    for k in compared:
        softness = 0.0 if found[0].status[k] == 5 else 0.01  # status 5: the force is balanced
        one, *others = (
            {
                name: a[k].numpy().astype(np.longdouble)
                for name, a in (given | {"wrench": load}).items()
            }
            for load in loads
        )
        answers = [
            np.concatenate([each.force[k].flatten(), each.torsion[k]]).astype(np.longdouble)
            for each in found
        ]
        least = penalised(one, answers[0], softness)
        ahead, back = (penalised(*each, softness) for each in zip(others, answers[1:], strict=True))
        slope = -float(found[0].multipliers[k] @ direction[k])
        assert float(ahead - back) / (2.0 * step) == pytest.approx(slope, rel=1e-4)
        soft = one.get("torsional_friction", np.zeros(one["normals"].shape[0])) > 0.0
        changes = np.eye(answers[0].size)[
            :, np.concatenate([np.ones(3 * soft.size, dtype=bool), soft])
        ]
        if not softness:
            matrix = spread_matrix(one["positions"], one["normals"]).astype(float)
            changes = changes @ null_space(matrix @ changes)
        for size in 10.0 ** rng.uniform(-9.0, 0.0, 200):
            other = penalised(
                one, answers[0] + size * (changes @ rng.normal(size=changes.shape[1])), softness
            )
            assert other > least * (1.0 - 1e-15)


def test_other_forces_exceed_the_limits_no_less():
    given = human("normals", 4, 24, seed=2)
    found = elastic(**given)
    exceeding = (found.status == 5).nonzero().flatten().tolist()
    assert len(exceeding) > 8
    compared = 0
    for k in exceeding:
        force = found.force[k].numpy()
        most = given["max_normal"][k].numpy()
        mu = float(given["friction"][k, 0, 0])
        normals = given["normals"][k].numpy()
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        balance = spread_matrix(given["positions"][k].numpy(), normals)[:, : force.size]
        other = least_excess(force, normals, mu, most, balance)
        compared += other is not None
        # a newton of excess costs about a thousand newtons of Phi, so Phi itself moves the least
        # excess by a few hundredths
        assert (
            other is None
            or excess(force, normals, most) <= 1.01 * excess(other, normals, most) + 0.05
        )
    assert compared > 0.5 * len(exceeding)


@pytest.mark.parametrize("limits", LIMITS)
def test_gradients_of_optima_just_within_their_limits(limits):
    for contacts in (3, 4, 5, 6):
        given = almost_infeasible(limits, contacts, 40)
        found, error, without = slopes(given, LIMITS[limits])
        optimal = found.status == 0
        assert optimal.sum() > 12
        assert not without[optimal].any()
        assert error[optimal].max() < 1e-3
