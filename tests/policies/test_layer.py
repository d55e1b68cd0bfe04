"""The force layer: answers against the optimizer, gradients against differences, elements without
an optimum, wrong inputs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from layer_problems import KINDS, error, gradients, margin, problems, same_bits
from torch import Tensor

from grasp_env.errors import InfeasibleWrenchError, InvalidInputError, UnknownNameError
from grasp_env.force import ForceLimits, ForceOptimizer, optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball
from grasp_env.quality import feasibility
from policies import grasp_force

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("kind", KINDS)
def test_forces_are_those_of_the_optimizer(kind):
    given = problems(kind, 4)
    result = grasp_force(**given)
    assert result.status.tolist() == [0] * 4
    assert result.gap.max() <= 1e-10
    assert (result.residual < 1e-13 * result.force.abs().amax((1, 2))).all()
    for k in range(4):
        a = {name: value[k].numpy() for name, value in given.items()}
        soft = {}
        if "torsional_friction" in a:
            soft = {
                "torsional_friction": a["torsional_friction"],
                "contact_model": [
                    "frictionless" if mu == 0.0 else "soft" if gamma > 0.0 else "hard"
                    for mu, gamma in zip(a["friction"][:, 0], a["torsional_friction"], strict=True)
                ],
            }
        normals = a["normals"] / np.linalg.norm(a["normals"], axis=-1, keepdims=True)
        grasp = Grasp.from_contacts(
            a["positions"], normals, a["friction"], tangents=a.get("tangents"), **soft
        )
        names = ("jacobian", "torque_limit", "torque_bias", "min_normal", "max_normal")
        limits = (
            ForceLimits(**{name: a[name] for name in names if name in a})
            if any(n in a for n in names)
            else None
        )
        weights = {name: a[name] for name in ("force_weight", "barrier_weight")}
        expected = optimize_force(grasp, a["wrench"], limits=limits, tolerance=1e-13, **weights)
        # a gap of 1e-13 leaves an error of its square root
        force, torsion, multipliers = (part[k].numpy() for part in result[:3])
        size = abs(expected.object_force).max()
        np.testing.assert_allclose(force, expected.object_force, rtol=0, atol=1e-6 * size)
        np.testing.assert_allclose(torsion, expected.torsion, rtol=0, atol=1e-8 * size)
        near = 1e-5 * abs(expected.multipliers).max()
        np.testing.assert_allclose(multipliers, expected.multipliers, rtol=1e-4, atol=near)


@pytest.mark.parametrize("with_margin", [False, True])
@pytest.mark.parametrize("kind", [*KINDS, "exceeded", "unbalanced"])
def test_gradients_are_those_of_differences(kind, with_margin):
    """All inputs at once, along random directions; elastic answers included.

    Answers above 100 are made smaller, because differences of 1e-6 magnify their rounding.
    """
    given = problems(kind, 2)
    if with_margin:
        given |= margin(given)
    # infinite limits and hard contacts stay
    moves = {name: a.isfinite() & (a != 0.0) for name, a in given.items()}
    first = grasp_force(**given, infeasible="elastic", tolerance=1e-13)
    shares = [(100.0 / a.abs().max()).clamp(max=1.0) for a in first[:3]]

    def answers(*leaves: Tensor) -> tuple[Tensor, ...]:
        inputs = {
            name: torch.where(moves[name], a, given[name])
            for name, a in zip(given, leaves, strict=True)
        }
        result = grasp_force(**inputs, infeasible="elastic", tolerance=1e-13)
        return tuple(share * a for share, a in zip(shares, result[:3], strict=True))

    leaves = [torch.where(moves[name], a, 1.0).requires_grad_() for name, a in given.items()]
    torch.manual_seed(0)
    assert torch.autograd.gradcheck(answers, leaves, eps=1e-6, atol=1e-6, rtol=1e-6, fast_mode=True)


@pytest.mark.parametrize("slippery", [False, True])
@pytest.mark.parametrize("kind", ["hard", "elliptic", "normal", "own exceeded", "unbalanced"])
def test_torsional_friction_of_zero_changes_nothing(kind, slippery):
    given = problems(kind, 40)
    if slippery:
        given["friction"][:, 1] = 0.0
    zero = torch.zeros(given["normals"].shape[:2], dtype=torch.float64)
    found, by = gradients(given, infeasible="elastic")
    again, by_again = gradients(given | {"torsional_friction": zero}, infeasible="elastic")
    assert not again.torsion.any()
    assert not by_again.pop("torsional_friction").any()
    assert torch.equal(again.status, found.status)
    assert error(again.force, found.force) < 1e-9
    assert error(again.multipliers, found.multipliers) < 1e-9
    for name, a in by.items():
        assert error(by_again[name], a) < 1e-6, name


def test_a_force_is_found_exactly_where_one_exists():
    """Three soft contacts without force closure, against another algorithm."""
    draw = torch.Generator().manual_seed(1)
    normals = torch.randn(40, 3, 3, generator=draw, dtype=torch.float64)
    wrench = torch.randn(40, 6, generator=draw, dtype=torch.float64) * torch.tensor(
        [1, 1, 1, 0.02, 0.02, 0.02]
    )
    status = grasp_force(-0.03 * normals, normals, 0.6, wrench, torsional_friction=0.003).status
    assert set(status.tolist()) == {0, 3}
    units = normals / normals.norm(dim=-1, keepdim=True)
    for k in range(40):
        grasp = Grasp.from_contacts(
            -0.03 * normals[k].numpy(),
            units[k].numpy(),
            0.6,
            contact_model="soft",
            torsional_friction=0.003,
        )
        assert (status[k] == 0) == (feasibility(grasp, wrench[k].numpy()).margin > 0.0)


SPOILED = [
    ("wrench", torch.nan),
    ("wrench", torch.inf),
    ("wrench", 1e300),
    ("normals", 0.0),
    ("normals", 1e-320),
    ("positions", torch.nan),
    ("positions", -torch.inf),
    ("friction", -1.0),
    ("friction", torch.nan),
    ("barrier_weight", 0.0),
    ("force_weight", torch.nan),
    ("torsional_friction", torch.inf),
]
SPOILED_MARGINS = [
    *(("friction_margin", value) for value in (0.0, -0.5, 1.001, torch.nan, torch.inf)),
    *(("preload", value) for value in (-0.1, 1e13, torch.nan, torch.inf)),
    ("normals", torch.nan),
]


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("margins", [[], SPOILED_MARGINS])
def test_an_element_does_not_disturb_its_neighbours(margins):
    given = problems("soft", 300)
    if margins:
        given |= margin(given)
    given["friction"][3] = given["torsional_friction"][3] = 1e-4  # nothing balances this wrench
    good = torch.ones(len(given["wrench"]), dtype=torch.bool)
    good[3] = False
    spoiled = SPOILED + margins
    for k, (name, value) in enumerate(spoiled, start=5):
        given[name][k], good[k] = value, False
    result, by = gradients(given)
    refused = slice(5, 5 + len(spoiled))
    assert result.status[refused].tolist() == [4] * len(spoiled)
    assert not result.force[refused].any()
    assert result.status[3] in (3, 7)
    assert result.feasible.tolist() == good.tolist()
    assert not any(a.isnan().any() for a in (*result, *by.values()))
    assert not any(a[~good].any() for a in by.values())  # no gradient
    assert result.force[3].any()
    assert result.force.isfinite().all()
    for part in (good, torch.arange(len(good)) == 20):
        alone, by_alone = gradients({name: a[part] for name, a in given.items()})
        assert same_bits([*alone, *by_alone.values()], [a[part] for a in (*result, *by.values())])
    for threads, chunk in ((1, 7), (2, 100)):
        torch.set_num_threads(threads)
        again, by_again = gradients(given, chunk=chunk)
        assert same_bits([*again, *by_again.values()], [*result, *by.values()])


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("kind", ["exceeded", "own exceeded", "unbalanced"])
def test_elements_without_an_optimum(kind):
    bad = problems(kind, 2)
    count = 2 if kind == "unbalanced" else 4
    masked, by = gradients(bad)
    balanced = kind != "unbalanced"
    assert masked.status.tolist() == [5 if balanced else 3] * 2
    assert not masked.feasible.any()
    assert masked.gap.isinf().all()
    assert not any(a.any() for a in by.values())
    normals = bad["normals"] / bad["normals"].norm(dim=-1, keepdim=True)
    pressure = (masked.force * normals).sum(-1)
    rubbing = (masked.force - pressure.unsqueeze(-1) * normals).norm(dim=-1)
    assert (rubbing < bad["friction"][..., 0] * pressure).all()
    assert (masked.residual < 1e-8).all() == balanced
    turning = (
        torch.linalg.cross(bad["positions"], masked.force) + masked.torsion[..., None] * normals
    )
    missed = torch.cat([masked.force.sum(1), turning.sum(1)], -1) + bad["wrench"]
    assert (missed.abs().max() < 1e-12 * masked.force.abs().max()) == balanced
    elastic, by = gradients(bad, infeasible="elastic")
    assert torch.equal(elastic.force, masked.force)
    assert all(
        a[:, :count].any()
        for name, a in by.items()
        if name in ("positions", "wrench", "torque_limit")
    )
    with pytest.raises(
        InfeasibleWrenchError, match=r"2 of 2 elements have no optimal force \(0: .*, 1: .*'mask'"
    ):
        grasp_force(**bad, infeasible="raise")


@pytest.mark.usefixtures("way")
def test_shared_inputs_broadcast_and_sum_their_gradients():
    given = problems("hard", 6)
    shared = {name: a[0].clone().requires_grad_() for name, a in given.items() if name != "wrench"}
    result = grasp_force(**shared, wrench=given["wrench"].view(2, 3, 6))
    assert [tuple(a.shape) for a in result] == [(2, 3, 4, 3), (2, 3, 4), (2, 3, 6)] + [(2, 3)] * 5
    result.force.square().sum().backward()
    alone = {
        name: a.detach().expand(6, *a.shape).clone().requires_grad_() for name, a in shared.items()
    }
    force = grasp_force(**alone, wrench=given["wrench"]).force
    torch.testing.assert_close(result.force.flatten(0, 1), force)
    force.square().sum().backward()
    for name, a in shared.items():
        torch.testing.assert_close(a.grad, alone[name].grad.sum(0), rtol=1e-8, atol=1e-8)  # type: ignore[union-attr]


@pytest.mark.usefixtures("way")
def test_a_start_saves_iterations_which_are_limited():
    given = problems("shared joints", 8)
    cold = grasp_force(**given)
    given["wrench"] = given["wrench"] + 1e-4
    there = grasp_force(**given)
    warm = grasp_force(**given, start=cold.force)
    assert error(warm.force, there.force) < 1e-9
    assert warm.iterations.double().mean() < 0.5 * cold.iterations.double().mean()
    useless = torch.full_like(cold.force, torch.nan)
    useless[1] = -cold.force[1]  # outside the cones
    assert error(grasp_force(**given, start=useless).force, there.force) < 1e-9
    given = {name: a[0] for name, a in given.items()}
    _, by = gradients({**given, "wrench": given["wrench"].expand(8, 6)})
    _, by_start = gradients(given, start=cold.force)  # of more dimensions than the others
    torch.testing.assert_close(by_start["wrench"], by["wrench"].sum(0), rtol=1e-8, atol=1e-8)
    for kind in ("hard", "shared joints"):  # the second first solves without limits
        few = grasp_force(**problems(kind, 3), max_iterations=2)
        assert (few.status.tolist(), few.iterations.tolist()) == ([1] * 3, [2] * 3)
        assert few.feasible.all()
        assert few.residual.max() < 1e-9


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "mode": ({"infeasible": "elastc"}, "did you mean 'elastic'"),
    "iterations": ({"max_iterations": 2.5}, "max_iterations"),
    "tolerance": ({"tolerance": 0.0}, "tolerance"),
    "chunk": ({"chunk": 0}, "chunk"),
    "no tensor": ({"positions": [[1.0, 0.0, 0.0]]}, r"positions must be a tensor \(..., N, 3\)"),
    "integers": (
        {"wrench": torch.ones(1, 6, dtype=torch.int64)},
        "wrench must be of a floating-point type",
    ),
    "contacts": ({"normals": torch.ones(1, 3, 3)}, r"normals must be of shape \(..., 4, 3\)"),
    "leading": (
        {"wrench": torch.ones(2, 6), "start": torch.ones(3, 4, 3)},
        "leading dimensions must broadcast",
    ),
    "friction": ({"friction": "0.4"}, "friction must be a tensor or a number"),
    "half a limit": ({"torque_limit": 1.0}, "together"),
    "joints": (
        {"jacobian": torch.ones(1, 4, 3, 2), "torque_limit": torch.ones(3)},
        r"torque_limit must be of shape \(..., 2\)",
    ),
    "dimensions": ({"wrench": torch.ones(*[1] * 24, 6)}, "too many leading ones"),
    "device": (
        {"wrench": torch.ones(1, 6, device="meta")},
        "one device, got positions on cpu and wrench on meta",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_errors_name_what_is_wrong(case):
    changed, words = WRONG[case]
    kind = UnknownNameError if case == "mode" else InvalidInputError
    with pytest.raises(kind, match=words):
        grasp_force(**{**problems("hard", 1), **changed})


def test_a_small_barrier_weight_approaches_the_exact_problem():
    """The page on gradients quotes these distances of sum and gradient of the normal forces from
    the conic optimum."""
    grasp = presets.paper_cuboid()
    loads = sample_ball(np.random.default_rng(0), 1000)
    exact = optimize_forces(grasp, loads, method="conic", tolerance=1e-10)
    least = exact.force[:, :, 0].sum(1)
    slopes = -exact.multipliers
    positions = torch.from_numpy(np.array(grasp.positions))
    normals = torch.from_numpy(np.array(grasp.normals))
    excess: list[float] = []
    for weight, errors in ((1e-2, (0.048, 1.5)), (1e-4, (2.4e-3, 0.16)), (1e-6, (1.7e-4, 0.017))):
        wrench = torch.from_numpy(loads).requires_grad_()
        total = (
            grasp_force(positions, normals, 0.4, wrench, barrier_weight=weight).force * normals
        ).sum((1, 2))
        total.sum().backward()
        assert wrench.grad is not None
        excess.append(float(np.median(total.detach().numpy() / least - 1.0)))
        off = np.abs(wrench.grad.numpy() - slopes).max(1) / np.abs(slopes).max(1)
        np.testing.assert_allclose((np.median(off), np.percentile(off, 99)), errors, rtol=0.03)
    np.testing.assert_allclose(excess, (0.15, 0.0145, 0.00145), rtol=0.02)


def test_two_contacts_have_forces_and_gradients_within_their_reach():
    pinch = Grasp.from_contacts(
        [[0, 0.03, 0.01], [0.002, -0.03, 0]],
        [[0, -1, 0.1], [0, 1, 0]] / np.array([[1.005], [1]]),
        0.8,
    )
    rng = np.random.default_rng(0)
    pushes = (
        np.abs(rng.standard_normal((4, 2, 1))) + 0.5 + rng.uniform(-0.3, 0.3, (4, 2, 3)) * [0, 1, 1]
    )
    loads = np.array(
        [
            -pinch.wrench(np.column_stack([each[:, :1] * [[1.0]], each[:, 1:] * 0.3]))
            for each in pushes
        ]
    )
    given = {
        "positions": torch.tensor(pinch.positions),
        "normals": torch.tensor(pinch.normals),
        "friction": torch.tensor([0.8, 0.7]),
        "wrench": torch.tensor(loads),
        "force_weight": torch.tensor([1.0, 1.3]),
        "barrier_weight": torch.tensor([0.01, 0.02]),
    }
    given = {
        name: a.double().requires_grad_(name not in ("positions", "normals"))
        for name, a in given.items()
    }
    found = grasp_force(**given)
    assert found.status.tolist() == [0] * 4
    assert found.feasible.all()
    other = Grasp.from_contacts(pinch.positions, pinch.normals, [0.8, 0.7])
    weights = {"force_weight": [1.0, 1.3], "barrier_weight": [0.01, 0.02]}
    for load, force in zip(loads, found.force.detach().numpy(), strict=True):
        expected = ForceOptimizer(other, tolerance=1e-9, **weights).solve(load)
        np.testing.assert_allclose(force, expected.object_force, rtol=1e-5, atol=1e-6)
    along = torch.tensor(rng.standard_normal((4, 2, 3)))
    (found.force * along).sum().backward()
    for name, a in given.items():
        if a.grad is None:
            continue
        move = rng.standard_normal(a.shape)
        if name == "wrench":
            move = np.array([pinch.within_reach(each) for each in move])
        step = 1e-6 * torch.tensor(move)
        with torch.no_grad():
            up, down = (
                grasp_force(**{**given, name: a + sign * step}).force for sign in (1.0, -1.0)
            )
        slope = ((up - down) * along).sum().item() / 2e-6
        assert slope == pytest.approx(
            (a.grad * torch.tensor(move)).sum().item(), rel=1e-5, abs=1e-6
        ), name
    out = grasp_force(
        **{**given, "wrench": given["wrench"].detach() + torch.tensor([0, 0, 0, 0, 0.01, 0])}
    )
    assert out.status.tolist() == [3] * 4
