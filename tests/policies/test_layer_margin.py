"""The margin of the force layer: the cones and limits that forces keep, the problem that is solved,
types, transforms, elements without an optimum, wrong numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from layer_problems import KINDS, error, gradients, human, margin, problems, same_bits
from torch import Tensor

from grasp_env.errors import InfeasibleWrenchError, InvalidInputError
from policies import GraspForceLayer, grasp_force

pytestmark = pytest.mark.usefixtures("one_thread")


def units(given: dict[str, Tensor]) -> Tensor:
    return given["normals"] / given["normals"].norm(dim=-1, keepdim=True)


def by_hand(given: dict[str, Tensor], share: Tensor, preload: Tensor) -> dict[str, Tensor]:
    """The problem of the force beyond the preload, contact by contact."""
    made = {name: a.clone() for name, a in given.items()}
    for k in range(len(made["positions"])):
        for name in ("friction", "torsional_friction"):
            if name in made:
                made[name][k] *= share[k]
        for i, (s, normal) in enumerate(zip(preload[k], units(given)[k], strict=True)):
            push = s * normal
            made["wrench"][k, :3] += push
            made["wrench"][k, 3:] += torch.linalg.cross(given["positions"][k, i], push)
            if "jacobian" in made:
                bias = made.setdefault("torque_bias", torch.zeros_like(given["torque_limit"]))
                bias[k] += given["jacobian"][k, i, :3].T @ push
            if "max_normal" in made:
                made["max_normal"][k, i] -= s
            if "min_normal" in made:
                made["min_normal"][k, i] = max(made["min_normal"][k, i] - s, torch.tensor(0.0))
    return made


@pytest.mark.parametrize("kind", [*KINDS, "exceeded", "unbalanced"])
def test_the_force_beyond_the_preload_is_that_of_another_problem(kind):
    given = problems(kind, 6)
    share, preload = margin(given).values()
    found = grasp_force(**given, friction_margin=share, preload=preload)
    other = grasp_force(**by_hand(given, share, preload))
    assert found.status.tolist() == other.status.tolist()
    # also without an optimum
    assert error(found.force, other.force + preload.unsqueeze(-1) * units(given)) < 1e-9
    torch.testing.assert_close(found.multipliers, other.multipliers, rtol=1e-7, atol=1e-7)
    warm = grasp_force(**given, friction_margin=share, preload=preload, start=found.force)
    assert error(warm.force, found.force) < 1e-9
    if kind in ("hard", "elliptic", "own joints", "shared joints"):
        assert not warm.iterations.any()


@pytest.mark.parametrize("kind", KINDS)
def test_forces_balance_the_wrench_within_narrower_cones_and_the_limits(kind):
    given = problems(kind, 40)
    share, preload = margin(given).values()
    found = grasp_force(**given, friction_margin=share, preload=preload)
    assert found.feasible.all()
    normals = units(given)
    pressure = (found.force * normals).sum(-1)
    rubbing = found.force - pressure.unsqueeze(-1) * normals
    allowed = share.unsqueeze(-1) * (pressure - preload)
    friction = given["friction"]
    if "tangents" in given:
        o = given["tangents"] - (given["tangents"] * normals).sum(-1, keepdim=True) * normals
        o = o / o.norm(dim=-1, keepdim=True)
        along = torch.stack([o, torch.linalg.cross(normals, o)], -2)
        parts = (along * rubbing.unsqueeze(-2)).sum(-1) / friction
    else:
        parts = rubbing / friction[..., :1].clamp(min=1e-12)
    gamma = given.get("torsional_friction", torch.zeros_like(pressure))
    turned = found.torsion / gamma.clamp(min=1e-12)
    use = torch.cat([parts, turned.unsqueeze(-1)], -1).norm(dim=-1) / allowed
    assert (use < 1.0).all()
    assert use.max() > 0.9  # a narrower cone would not do
    turning = (
        torch.linalg.cross(given["positions"], found.force) + found.torsion.unsqueeze(-1) * normals
    )
    missed = torch.cat([found.force.sum(1), turning.sum(1)], -1) + given["wrench"]
    assert missed.abs().max() < 1e-11
    if "min_normal" in given:
        assert (pressure > given["min_normal"]).all()
        assert (pressure < given["max_normal"]).all()
    if "jacobian" in given:
        moves = given["jacobian"]
        torque = torch.einsum("bnrj,bnr->bj", moves[:, :, :3], found.force)
        if moves.shape[2] == 6:
            torque += torch.einsum(
                "bnrj,bnr->bj", moves[:, :, 3:], found.torsion.unsqueeze(-1) * normals
            )
        torque += given.get("torque_bias", torch.zeros_like(torque))
        assert (torque.abs() < given["torque_limit"]).all()


def test_numbers_are_the_same_as_tensors():
    given = problems("all", 3)
    shapes = {"friction_margin": (3,), "preload": (3, 4)}
    for options in (
        {"friction_margin": 1, "preload": 0},
        {"friction_margin": 0.8},
        {"preload": 0.25},
        {"friction_margin": 0.8, "preload": 0.25},
    ):
        found, by = gradients(given, **options)
        full = {"friction_margin": 1.0, "preload": 0.0} | options
        for tensors in (
            {name: torch.tensor(float(a), dtype=torch.float64) for name, a in full.items()},
            {name: torch.full(shapes[name], a, dtype=torch.float64) for name, a in full.items()},
        ):
            again, by_again = gradients(given, **tensors)
            assert same_bits(again, found)
            for name, a in by.items():
                torch.testing.assert_close(by_again[name], a, rtol=1e-10, atol=1e-10)
        assert same_bits(GraspForceLayer()(**given, **options), found)
        if options.get("friction_margin") == 1:
            assert same_bits(grasp_force(**given), found)
    one = grasp_force(**given | {"friction": 0.7, "torsional_friction": 0.01}, friction_margin=0.8)
    lower = given | {"friction": 0.8 * 0.7, "torsional_friction": 0.8 * 0.01}
    assert same_bits(one, grasp_force(**lower))


def test_shared_margins_broadcast():
    """Margins of 3 problems, preloads of 2, one grasp, with friction of every shape."""
    given = {name: a[0] for name, a in problems("shared joints", 1).items()}
    share = torch.tensor([0.7, 0.8, 0.9], dtype=torch.float64, requires_grad=True)
    preload = torch.full((2, 1, 4), 0.1, dtype=torch.float64)
    preload[1] = 0.2
    preload.requires_grad_()
    for friction in (given["friction"], given["friction"][:, 0], given["friction"][0, 0]):
        given["friction"] = friction
        found = grasp_force(**given, friction_margin=share, preload=preload)
        assert [tuple(a.shape) for a in found[:4]] == [(2, 3, 4, 3), (2, 3, 4), (2, 3, 6), (2, 3)]
        found.force.square().sum().backward()
        expected = [torch.zeros(3).double(), torch.zeros(2, 1, 4).double()]
        for i in range(2):
            for k in range(3):
                one = share.detach()[k].requires_grad_(), preload.detach()[i, 0].requires_grad_()
                force = grasp_force(**given, friction_margin=one[0], preload=one[1]).force
                assert torch.equal(force, found.force[i, k])
                slopes = torch.autograd.grad(force.square().sum(), one)
                expected[0][k] += slopes[0]
                expected[1][i, 0] += slopes[1]
        for leaf, slope in zip((share, preload), expected, strict=True):
            torch.testing.assert_close(leaf.grad, slope, rtol=1e-8, atol=1e-8)
            leaf.grad = None


def test_friction_of_two_contacts_is_read_as_without_a_margin():
    """A shape that ends in (2, 2) has two coefficients per contact."""
    positions = torch.tensor([[0.0, 0.03, 0.0], [0.0, -0.03, 0.0]], dtype=torch.float64)
    friction = torch.tensor([[0.8, 0.5], [0.7, 0.6]], dtype=torch.float64)
    wrench = torch.tensor([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    share = torch.tensor([0.8, 0.9, 1.0], dtype=torch.float64)
    found = grasp_force(positions, -positions, friction, wrench, friction_margin=share)
    assert found.status.tolist() == [0, 0, 0]
    for k, m in enumerate(share.tolist()):
        alone = grasp_force(positions, -positions, m * friction, wrench)
        assert error(found.force[k : k + 1], alone.force[None]) < 1e-9


def test_types():
    """float32 in, float32 out, float64 inside; a margin without axes takes the type of the others."""
    given = problems("soft", 3)
    margins = margin(given)
    low, low_margins = ({name: a.float() for name, a in each.items()} for each in (given, margins))
    found, by = gradients(low | low_margins)
    assert [a.dtype for a in found[:3]] == [torch.float32] * 3
    assert all(a.dtype == torch.float32 and a.isfinite().all() for a in by.values())
    wide = {name: a.double() for name, a in (low | low_margins).items()}
    exact, by_exact = gradients(wide)
    assert same_bits(found, [b.to(a.dtype) for a, b in zip(found, exact, strict=True)])
    for name, a in by.items():  # that of the loss is rounded
        assert error(a.double()[..., None], by_exact[name][..., None]) < 1e-5
    share = torch.tensor(0.8, dtype=torch.float64)
    for options, dtype in (
        ({"friction_margin": share}, torch.float32),
        ({"friction_margin": share.expand(3)}, torch.float64),
        ({"friction_margin": 0.8}, torch.float32),
        ({"preload": share}, torch.float32),
        ({"preload": share.expand(4)}, torch.float64),
    ):
        assert grasp_force(**low, **options).force.dtype is dtype
    half = {**given, "friction": torch.full((4,), 0.5, dtype=torch.float16)}
    exact = grasp_force(**given | {"friction": 0.5}, friction_margin=0.9)
    assert error(grasp_force(**half, friction_margin=0.9).force, exact.force) < 1e-6


def test_transforms():
    given = problems("all", 3)
    margins = margin(given)
    names = ("wrench", "friction_margin", "preload")
    batched = [(given | margins)[name] for name in names]
    others = {name: a[0] for name, a in given.items() if name != "wrench"}

    def force(*leaves: Tensor) -> Tensor:
        return grasp_force(**others, **dict(zip(names, leaves, strict=True))).force

    def cost(*leaves: Tensor) -> Tensor:
        return force(*leaves).square().sum()

    torch.testing.assert_close(torch.func.vmap(force)(*batched), force(*batched))
    torch.testing.assert_close(
        torch.func.vmap(force, (0, None, 0))(batched[0], batched[1][0], batched[2]),
        force(batched[0], batched[1][0], batched[2]),
    )
    leaves = [a[0].clone().requires_grad_() for a in batched]
    slopes = torch.autograd.grad(cost(*leaves), leaves)
    first = [a[0] for a in batched]
    torch.testing.assert_close(torch.func.grad(cost, (0, 1, 2))(*first), slopes)
    jacobians = torch.func.jacrev(force, (0, 1, 2))(*first)
    torch.testing.assert_close(jacobians, torch.autograd.functional.jacobian(force, tuple(first)))
    many = torch.func.vmap(torch.func.jacrev(force, (0, 1, 2)))(*batched)
    torch.testing.assert_close(many[2][0], jacobians[2])
    compiled = torch.compile(cost, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(torch.autograd.grad(compiled(*leaves), leaves), slopes)

    def with_numbers(wrench: Tensor) -> Tensor:
        return grasp_force(**others, wrench=wrench, friction_margin=0.8, preload=0.1).force

    compiled = torch.compile(with_numbers, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(batched[0]), with_numbers(batched[0]))


@pytest.mark.parametrize("kind", ["own joints", "all"])
def test_an_element_has_the_bits_of_a_batch_of_one(kind):
    """Also with other strides, and beside NaN in a Jacobian."""
    given = problems(kind, 301)
    given |= margin(given)
    given["jacobian"][3, 0, 0, 0] = torch.nan
    result, by = gradients(given)
    assert result.status[:5].tolist() == [0, 0, 0, 4, 0]
    assert not any(a.isnan().any() for a in by.values())
    strides = {name: a.movedim(0, -1).contiguous().movedim(-1, 0) for name, a in given.items()}
    again, by_again = gradients(strides)
    assert same_bits([*again, *by_again.values()], [*result, *by.values()])
    for k in (0, 150, 300):
        alone, by_alone = gradients({name: a[k : k + 1] for name, a in strides.items()})
        whole = [a[k : k + 1] for a in (*result, *by.values())]
        assert same_bits([*alone, *by_alone.values()], whole)
        one = grasp_force(**{name: a[k] for name, a in given.items()})
        assert same_bits(one, [a[k] for a in result])


@pytest.mark.parametrize("kind", ["exceeded", "unbalanced"])
def test_elements_without_an_optimum(kind):
    given = problems(kind, 3)
    given |= margin(given)
    masked, by = gradients(given)
    assert not masked.feasible.any()
    assert not any(a.any() for a in by.values())
    elastic, by = gradients(given, infeasible="elastic")
    assert same_bits(elastic, masked)
    assert by["friction_margin"].any()
    assert by["preload"].any()
    with pytest.raises(InfeasibleWrenchError, match="3 of 3"):
        grasp_force(**given, infeasible="raise")


def test_a_force_that_has_not_converged_has_no_gradient():
    given = human("normals", 4, 40, seed=3)
    given["barrier_weight"] = torch.full((40, 4), 1e-8, dtype=torch.float64)
    _, by = gradients(given, preload=0.1, infeasible="elastic")
    _, by_preload = gradients(
        given | {"preload": torch.full((40, 4), 0.1, dtype=torch.float64)}, infeasible="elastic"
    )
    still = (by["wrench"] == 0.0).all(-1)
    assert still.any()
    assert not still.all()
    assert torch.equal((by_preload["preload"] == 0.0).all(-1), still)


def test_limits_that_a_preload_reaches():
    given = problems("normal", 4)
    low = given["min_normal"]
    held = grasp_force(**given, preload=low)  # the preload keeps them
    assert held.feasible.all()
    given["min_normal"] = torch.zeros_like(low)
    assert same_bits(grasp_force(**given, preload=low), held)
    given["max_normal"] = torch.tensor([10.0, 5.0, 5.0, 10.0], dtype=torch.float64)
    given["preload"] = torch.zeros(4, 4, dtype=torch.float64)
    given["preload"][1, 2] = 5.0
    given["preload"][2, 1] = 5.0 - 1e-9  # exceeded, but possible
    given["min_normal"][3, 0] = -0.1
    result, by = gradients(given)
    assert result.status.tolist() == [0, 4, 5, 4]
    assert not result.force[[1, 3]].any()
    assert all(a.isfinite().all() for a in by.values())
    given["max_normal"] = torch.zeros(4)  # none
    given["min_normal"][3, 0] = 0.0
    assert grasp_force(**given).status.tolist() == [0, 4, 4, 0]


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no share": ({"friction_margin": 0.0}, "friction_margin must be > 0 and at most 1, got 0.0"),
    "more": ({"friction_margin": 1.01}, "friction_margin must be > 0 and at most 1, got 1.01"),
    "no number": ({"friction_margin": float("nan")}, "friction_margin must be > 0"),
    "a long number": ({"friction_margin": 10**400}, "friction_margin must be > 0"),
    "a pull": ({"preload": -1}, "preload must be from 0 to 1e.12 N, got -1"),
    "infinite": ({"preload": float("inf")}, "preload must be from 0"),
    "above the limit": ({"preload": 3.0, "max_normal": 3.0}, "preload must be below max_normal"),
    "text": ({"friction_margin": "0.8"}, "friction_margin must be a tensor or a number"),
    "None": ({"friction_margin": None}, "friction_margin must be given"),
    "array": ({"preload": np.ones(4)}, "preload must be a tensor or a number"),
    "integers": ({"preload": torch.ones(4, dtype=torch.int64)}, "of a floating-point type"),
    "contacts": ({"preload": torch.ones(1, 3)}, r"preload must be of shape \(..., 4\)"),
    "leading": (
        {"wrench": torch.ones(2, 6), "friction_margin": torch.ones(3)},
        r"leading dimensions must broadcast, got .*friction_margin \(3,\)",
    ),
    "device": (
        {"preload": torch.ones(4, device="meta")},
        "one device, got positions on cpu and preload on meta",
    ),
    "friction": (
        {"friction": "0.4", "friction_margin": 0.8},
        "friction must be a tensor or a number, got '0.4'",
    ),
    "friction of integers": (
        {"friction": torch.ones(4, dtype=torch.int64), "friction_margin": 0.8},
        "friction must be of a floating-point type",
    ),
    "long friction": ({"friction": 10**400, "friction_margin": 0.8}, "friction must be at most"),
}


@pytest.mark.parametrize("case", WRONG)
def test_errors_name_what_is_wrong(case):
    changed, words = WRONG[case]
    with pytest.raises(InvalidInputError, match=words):
        grasp_force(**{**problems("hard", 1), **changed})
