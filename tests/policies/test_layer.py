"""The force layer: answers against the optimizer, gradients against differences, its two backends, and its use in torch."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from layer_problems import HOPELESS, KINDS, Forces, problems
from torch import Tensor

from grasp_env.errors import (
    GraspError,
    InfeasibleWrenchError,
    InvalidInputError,
    UnknownNameError,
    UnsupportedProblemError,
)
from grasp_env.force import ForceLimits, ForceOptimizer, optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball
from policies import GraspForceLayer, GraspForces, grasp_force, layer

DIFFERENTIABLE = ("force", "torsion", "multipliers")


@pytest.fixture(params=["core", "torch"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The solver of tensors on the CPU: the compiled core or `batched_newton`."""
    monkeypatch.setattr(layer, "_CORE", request.param == "core")
    return request.param


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def gradients(given: dict[str, Tensor], **options: Any) -> tuple[GraspForces, dict[str, Tensor]]:
    """Answers, and gradients of a random linear function of them."""
    leaves = {name: a.detach().clone().requires_grad_() for name, a in given.items()}
    result, draw = grasp_force(**leaves, **options), torch.Generator().manual_seed(0)
    answers = [getattr(result, name) for name in DIFFERENTIABLE]
    loss = [(torch.randn(a[:1].shape, generator=draw, dtype=torch.float64) * a).sum() for a in answers]
    torch.stack(loss).sum().backward()
    return GraspForces(*(a.detach() for a in result)), {k: a.grad for k, a in leaves.items() if a.grad is not None}


def error(a: Tensor, b: Tensor) -> float:
    """Largest difference of an element, relative to its size."""
    size = b.flatten(1).abs().amax(1).clamp(min=1e-9)
    return float(((a - b).flatten(1).abs().amax(1) / size).max())


def agree(
    mine: tuple[GraspForces, dict[str, Tensor]], other: tuple[GraspForces, dict[str, Tensor]], exact: bool
) -> None:
    """Answers and gradients are the same bits; with `batched_newton` the same up to rounding of batched products."""
    for a, b in zip((*mine[0], *mine[1].values()), (*other[0], *other[1].values()), strict=True):
        near = torch.equal(a, b) or (not exact and (a.double() - b).abs().max() <= 1e-8 * (1.0 + b.abs().max()))
        assert near


@pytest.mark.parametrize("kind", KINDS)
def test_forces_are_those_of_the_optimizer(kind: str) -> None:
    given = problems(kind, 4)
    result = grasp_force(**given)
    assert result.status.tolist() == [0] * 4
    assert result.gap.max() <= 1e-10
    assert result.residual.max() < 1e-12
    for k in range(4):
        a = {name: value[k].numpy() for name, value in given.items()}
        soft = {}
        if "torsional_friction" in a:
            soft = {"torsional_friction": a["torsional_friction"], "contact_model": ["hard", "soft", "soft", "soft"]}
        normals = a["normals"] / np.linalg.norm(a["normals"], axis=-1, keepdims=True)
        grasp = Grasp.from_contacts(a["positions"], normals, a["friction"], tangents=a.get("tangents"), **soft)
        names = ("jacobian", "torque_limit", "torque_bias", "min_normal", "max_normal")
        limits = ForceLimits(**{name: a[name] for name in names if name in a}) if any(n in a for n in names) else None
        weights = {name: a[name] for name in ("force_weight", "barrier_weight")}
        expected = optimize_force(grasp, a["wrench"], limits=limits, tolerance=1e-12, **weights)
        # a gap of 1e-12 leaves an error of its square root
        assert abs(result.force[k].numpy() - expected.object_force).max() < 5e-6 * abs(expected.object_force).max()
        assert abs(result.multipliers[k].numpy() - expected.multipliers).max() < 5e-5 * abs(expected.multipliers).max()
        if soft:
            assert abs(result.torsion[k].numpy() - expected.torsion).max() < 1e-6


@pytest.mark.parametrize("kind", [*KINDS, "exceeded", "unbalanced"])
def test_gradients_are_those_of_differences(kind: str) -> None:
    """All inputs at once, along random directions; elastic answers included."""
    given = problems(kind, 2)
    moves = {name: a.isfinite() & (a != 0.0) for name, a in given.items()}  # infinite limits and hard contacts stay

    def answers(*leaves: Tensor) -> tuple[Tensor, ...]:
        inputs = {name: torch.where(moves[name], a, given[name]) for name, a in zip(given, leaves, strict=True)}
        result = grasp_force(**inputs, infeasible="elastic", tolerance=1e-13)
        return result.force, result.torsion, result.multipliers

    leaves = [torch.where(moves[name], a, 1.0).requires_grad_() for name, a in given.items()]
    torch.manual_seed(0)
    assert torch.autograd.gradcheck(answers, leaves, eps=1e-6, atol=1e-6, rtol=1e-6, fast_mode=True)


@pytest.mark.parametrize("kind", [*KINDS, *HOPELESS])
def test_the_core_agrees_with_batched_newton(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given, found = problems(kind, 32, seed=1), []
    for in_core in (True, False):
        monkeypatch.setattr(layer, "_CORE", in_core)
        found.append(gradients(given, infeasible="elastic"))
    (a, by_a), (b, by_b) = found
    # the copy on tensors does not tell what two contacts can balance
    assert b.status.tolist() == torch.where(a.status == 3, 6, a.status).tolist()
    assert {"exceeded": 5, "far exceeded": 5, "unbalanced": 3}.get(kind, 0) in a.status
    rounding = 10.0 if kind == "far exceeded" else 1.0  # such forces lie on their cones, where both lose digits
    assert error(a.force, b.force) < 1e-9 * rounding
    assert (a.torsion - b.torsion).abs().max() < 1e-10 * rounding
    assert error(a.multipliers, b.multipliers) < 1e-9 * rounding
    for name in by_a:
        assert error(by_a[name], by_b[name]) < 1e-7 * rounding**2, name


def test_both_find_or_exclude_a_force_without_force_closure(monkeypatch: pytest.MonkeyPatch) -> None:
    draw, found = torch.Generator().manual_seed(1), []
    normals = torch.randn(40, 3, 3, generator=draw, dtype=torch.float64)
    wrench = torch.randn(40, 6, generator=draw, dtype=torch.float64) * torch.tensor([1, 1, 1, 0.02, 0.02, 0.02])
    for in_core in (True, False):
        monkeypatch.setattr(layer, "_CORE", in_core)
        found.append(grasp_force(-0.03 * normals, normals, 0.6, wrench, torsional_friction=0.003))
    assert torch.equal(found[0].status, found[1].status)
    assert set(found[0].status.tolist()) == {0, 3}
    assert error(found[1].force, found[0].force) < 1e-9


SPOILED = [
    ("wrench", torch.nan), ("wrench", torch.inf), ("wrench", 1e300), ("normals", 0.0), ("normals", 1e-320), ("positions", torch.nan),
    ("positions", -torch.inf), ("friction", -1.0), ("friction", torch.nan), ("barrier_weight", 0.0), ("force_weight", torch.nan),
    ("torsional_friction", torch.inf),
]  # fmt: skip


def test_an_element_does_not_disturb_its_neighbours(backend: str) -> None:
    """Infeasible and refused elements among good ones: no nan, and the others are as without them, in any chunk."""
    given = problems("soft", 300 if backend == "core" else 24)
    given["friction"][3] = given["torsional_friction"][3] = 1e-4  # nothing balances this wrench
    good = torch.ones(len(given["wrench"]), dtype=torch.bool)
    good[3] = False
    for k, (name, value) in enumerate(SPOILED, start=5):
        given[name][k], good[k] = value, False
    result, by = found = gradients(given)
    assert result.status[5 : 5 + len(SPOILED)].tolist() == [4] * len(SPOILED)
    assert result.status[3] in (3, 7)
    assert result.feasible.tolist() == good.tolist()
    assert not any(a.isnan().any() for a in (*result, *by.values()))
    assert not any(a[~good].any() for a in by.values())  # no gradient
    assert result.force[3].any()
    assert result.force.isfinite().all()
    for part in (good, torch.arange(len(good)) == 20):
        mine = GraspForces(*(a[part] for a in result)), {name: a[part] for name, a in by.items()}
        agree(mine, gradients({name: a[part] for name, a in given.items()}), backend == "core")
    agree(gradients(given, chunk=7), found, backend == "core")
    if backend == "core":
        torch.set_num_threads(2)
        agree(gradients(given, chunk=100), found, exact=True)


@pytest.mark.parametrize("kind", ["exceeded", "unbalanced"])
def test_elements_without_an_optimum(kind: str, backend: str) -> None:
    """Forces are strictly inside the cones; the gradient is zero, that of the elastic force, or an error names the elements."""
    bad, count = problems(kind, 2), 2 if kind == "unbalanced" else 4
    masked, by = gradients(bad)
    assert masked.status.tolist() == [5 if kind == "exceeded" else 3 if backend == "core" else 6] * 2
    assert not masked.feasible.any()
    assert not any(a.any() for a in by.values())
    normals = bad["normals"] / bad["normals"].norm(dim=-1, keepdim=True)
    pressure = (masked.force * normals).sum(-1)
    rubbing = (masked.force - pressure.unsqueeze(-1) * normals).norm(dim=-1)
    assert (rubbing < bad["friction"][..., 0] * pressure).all()
    assert (masked.residual < 1e-8).all() == (kind == "exceeded")
    elastic, by = gradients(bad, infeasible="elastic")
    assert torch.equal(elastic.force, masked.force)
    assert all(a[:, :count].any() for name, a in by.items() if name in ("positions", "wrench", "torque_limit"))
    with pytest.raises(InfeasibleWrenchError, match=r"2 of 2 elements have no optimal force \(0: .*, 1: .*'mask'"):
        grasp_force(**bad, infeasible="raise")


LAYOUTS: dict[str, Callable[[dict[str, Tensor]], dict[str, Tensor]]] = {
    "as they are": lambda given: given,
    "float32": lambda given: {name: a.float() for name, a in given.items()},
    "one grasp": lambda given: {name: a if name == "wrench" else a[0] for name, a in given.items()},
    "one coefficient a contact": lambda given: {**given, "friction": given["friction"][..., 0]},
    "one coefficient": lambda given: {**given, "friction": given["friction"][0, 0, 0]},
    "other strides": lambda given: {name: a.movedim(0, -1).contiguous().movedim(-1, 0) for name, a in given.items()},
    "broadcast": lambda given: {name: a[:2, None] if name == "wrench" else a[:3] for name, a in given.items()},
    "no batch": lambda given: {name: a[0] for name, a in given.items()},
    "no elements": lambda given: {name: a[:0] for name, a in given.items()},
    "sign bit": lambda given: {**given, "wrench": torch.complex(given["wrench"], -given["wrench"]).conj().imag},
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read(layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read in place or converted by torch's operators: the same bits, and gradients in the layout of the inputs."""
    given = LAYOUTS[layout](problems("own joints", 6))
    result, by = gradients(given, max_normal=50.0)
    monkeypatch.setattr(layer, "_read_in_place", lambda given: None)
    limit = torch.tensor(50.0, dtype=torch.float64)
    for again, by_again in (gradients(given, max_normal=50.0), gradients({**given, "max_normal": limit})):
        assert all(torch.equal(a, b) for a, b in zip(again, result, strict=True))
        for name, a in by.items():
            assert (a.shape, a.dtype) == (given[name].shape, given[name].dtype)
            torch.testing.assert_close(a, by_again[name], rtol=1e-12, atol=1e-12)
    if layout not in ("one grasp", "one coefficient", "broadcast", "no elements"):  # which are other problems
        flat = grasp_force(**problems("own joints", 6), max_normal=50.0).force
        flat, wide = flat[0] if layout == "no batch" else flat, 1e-5 if layout == "float32" else 1e-12
        torch.testing.assert_close(result.force.double(), flat, rtol=0.0, atol=wide)


def test_shared_inputs_broadcast_and_sum_their_gradients(backend: str) -> None:
    given = problems("hard", 6)
    shared = {name: a[0].clone().requires_grad_() for name, a in given.items() if name != "wrench"}
    result = grasp_force(**shared, wrench=given["wrench"].view(2, 3, 6))
    assert [tuple(a.shape) for a in result] == [(2, 3, 4, 3), (2, 3, 4), (2, 3, 6)] + [(2, 3)] * 5
    result.force.square().sum().backward()
    alone = {name: a.detach().expand(6, *a.shape).clone().requires_grad_() for name, a in shared.items()}
    force = grasp_force(**alone, wrench=given["wrench"]).force
    torch.testing.assert_close(result.force.flatten(0, 1), force)
    force.square().sum().backward()
    for name, a in shared.items():
        torch.testing.assert_close(a.grad, alone[name].grad.sum(0), rtol=1e-8, atol=1e-8)  # type: ignore[union-attr]


def test_what_is_saved_for_the_backward_pass(backend: str) -> None:
    given = {name: a.requires_grad_() for name, a in problems("hard", 2).items()}
    result = grasp_force(**given)
    assert [a.requires_grad for a in result] == [True] * 3 + [False] * 5
    with torch.no_grad():
        given["wrench"] += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        result.force.sum().backward()
    leaf = given["wrench"].detach().requires_grad_()
    force = grasp_force(**{**given, "wrench": leaf}).force
    (slope,) = torch.autograd.grad(force.square().sum(), leaf, create_graph=True)
    with pytest.raises(UnsupportedProblemError, match="first derivatives only"):
        slope.sum().backward()


def test_types(backend: str) -> None:
    """float32 in, float32 out, float64 inside; half types become float32, also under autocast."""
    given = problems("hard", 3)
    low = {name: a.float() for name, a in given.items()}
    result, by = gradients(low)
    assert [a.dtype for a in result[:3]] == [torch.float32] * 3
    assert [a.dtype for a in result[3:]] == [torch.int64, torch.float32, torch.float32, torch.int64, torch.bool]
    assert error(result.force.double(), grasp_force(**given).force) < 1e-4
    assert all(a.dtype == torch.float32 and a.isfinite().all() for a in by.values())
    assert grasp_force(**low | {"wrench": given["wrench"]}).force.dtype == torch.float64
    with torch.autocast("cpu", torch.bfloat16):
        wrench = (low["wrench"] @ torch.eye(6)).requires_grad_()
        half = grasp_force(low["positions"], given["normals"].half(), 0.6, wrench)
    assert half.force.dtype == torch.float32
    (found,) = torch.autograd.grad(half.force.sum(), wrench)
    assert found.dtype == wrench.dtype == torch.bfloat16


def test_transforms(backend: str) -> None:
    """`vmap`, `grad` and `jacrev`, nested, and `torch.compile` without a break."""
    given = problems("soft", 3)
    wrench, others = given.pop("wrench"), {name: a[0] for name, a in given.items()}
    positions = others.pop("positions")

    def force(w: Tensor, p: Tensor) -> Tensor:
        return grasp_force(positions=p, wrench=w, **others).force

    def cost(w: Tensor, p: Tensor) -> Tensor:
        return force(w, p).square().sum()

    torch.testing.assert_close(torch.func.vmap(force, (0, None))(wrench, positions), force(wrench, positions))
    jacobian = torch.func.jacrev(force)(wrench[0], positions)
    torch.testing.assert_close(jacobian, torch.autograd.functional.jacobian(lambda w: force(w, positions), wrench[0]))
    many = torch.func.vmap(torch.func.jacrev(force, (0, 1)), (0, None))(wrench, positions)
    torch.testing.assert_close(many[0][0], jacobian)
    leaf = positions.clone().requires_grad_()
    cost(wrench[0], leaf).backward()
    torch.testing.assert_close(torch.func.grad(cost, 1)(wrench[0], positions), leaf.grad)
    with pytest.raises(UnsupportedProblemError, match="first derivatives only"):
        torch.func.jacrev(torch.func.grad(cost))(wrench[0], positions)
    if backend == "core":
        again = positions.clone().requires_grad_()
        torch.compile(cost, fullgraph=True, backend="aot_eager")(wrench[0], again).backward()
        torch.testing.assert_close(again.grad, leaf.grad)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, on the way to forward mode
def test_forward_mode_is_refused() -> None:
    given = problems("hard", 2)
    with torch.autograd.forward_ad.dual_level():
        given["wrench"] = torch.autograd.forward_ad.make_dual(given["wrench"], given["wrench"])
        with pytest.raises(NotImplementedError, match="forward mode"):
            grasp_force(**given)


def test_operators_pass_the_check_of_torch() -> None:
    given = problems("soft", 2)
    given["positions"] = given["positions"].float()  # as is its gradient
    tensors = [given.get(name) for name in layer._NAMES]
    leaves = [a if a is None else a.clone().requires_grad_(k % 2 == 0) for k, a in enumerate(tensors)]
    torch.library.opcheck(layer._solve, (*leaves, "elastic", 1e-10, 200, None))
    *answers, _, state = layer._solve(*tensors, "elastic", 1e-10, 200, None)
    wanted = [a is not None for a in tensors[:-1]]
    torch.library.opcheck(layer._gradients, (*tensors[:-1], state, *map(torch.ones_like, answers), wanted, True, None))


def test_modules_are_copied_and_used_by_workers() -> None:
    module, given = GraspForceLayer("elastic", tolerance=1e-8, chunk=100), problems("hard", 2)
    assert "infeasible='elastic', tolerance=1e-08, max_iterations=200, chunk=100" in repr(module)
    for copied in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert repr(copied) == repr(module)
        assert torch.equal(copied(**given).force, module(**given).force)
    loader = torch.utils.data.DataLoader(Forces(), batch_size=2, num_workers=1, multiprocessing_context="fork")
    torch.testing.assert_close(next(iter(loader)), grasp_force(**given).force, rtol=1e-9, atol=1e-12)


def test_a_start_saves_iterations_which_are_limited(backend: str) -> None:
    given = problems("shared joints", 8)
    cold = grasp_force(**given)
    given["wrench"] = given["wrench"] + 1e-4
    there, warm = grasp_force(**given), grasp_force(**given, start=cold.force)
    assert error(warm.force, there.force) < 1e-9
    assert warm.iterations.double().mean() < 0.5 * cold.iterations.double().mean()
    useless = torch.full_like(cold.force, torch.nan)
    useless[1] = -cold.force[1]  # outside the cones
    assert error(grasp_force(**given, start=useless).force, there.force) < 1e-9
    for kind in ("hard", "shared joints"):  # the second first solves without limits
        few = grasp_force(**problems(kind, 3), max_iterations=2)
        assert (few.status.tolist(), few.iterations.tolist()) == ([1] * 3, [2] * 3)
        assert few.feasible.all()
        assert few.residual.max() < 1e-9


WRONG: dict[str, tuple[dict[str, Any], type[GraspError], str]] = {
    "mode": ({"infeasible": "elastc"}, UnknownNameError, "did you mean 'elastic'"),
    "iterations": ({"max_iterations": 2.5}, InvalidInputError, "max_iterations"),
    "tolerance": ({"tolerance": 0.0}, InvalidInputError, "tolerance"),
    "chunk": ({"chunk": 0}, InvalidInputError, "chunk"),
    "no tensor": ({"positions": [[1.0, 0.0, 0.0]]}, InvalidInputError, r"positions must be a tensor \(..., N, 3\)"),
    "integers": ({"wrench": torch.ones(1, 6, dtype=torch.int64)}, InvalidInputError, "wrench must be of a floating-point type"),
    "contacts": ({"normals": torch.ones(1, 3, 3)}, InvalidInputError, r"normals must be of shape \(..., 4, 3\)"),
    "leading": ({"wrench": torch.ones(2, 6), "start": torch.ones(3, 4, 3)}, InvalidInputError, "leading dimensions must broadcast"),
    "friction": ({"friction": "0.4"}, InvalidInputError, "friction must be a tensor or a number"),
    "half a limit": ({"torque_limit": 1.0}, InvalidInputError, "together"),
    "joints": ({"jacobian": torch.ones(1, 4, 3, 2), "torque_limit": torch.ones(3)}, InvalidInputError, r"torque_limit must be of shape \(..., 2\)"),
    "device": ({"wrench": torch.ones(1, 6, device="meta")}, InvalidInputError, "one device, got positions on cpu and wrench on meta"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_errors_name_what_is_wrong(case: str) -> None:
    changed, kind, words = WRONG[case]
    with pytest.raises(kind, match=words):
        grasp_force(**{**problems("hard", 1), **changed})


def test_a_small_barrier_weight_approaches_the_exact_problem() -> None:
    """The page on gradients quotes these distances of sum and gradient of the normal forces from the conic optimum."""
    grasp, loads = presets.paper_cuboid(), sample_ball(np.random.default_rng(0), 1000)
    exact = optimize_forces(grasp, loads, method="conic", tolerance=1e-10)
    least, slopes = exact.force[:, :, 0].sum(1), -exact.multipliers
    positions, normals = torch.from_numpy(np.array(grasp.positions)), torch.from_numpy(np.array(grasp.normals))
    excess: list[float] = []
    for weight, errors in ((1e-2, (0.048, 1.5)), (1e-4, (2.4e-3, 0.16)), (1e-6, (1.7e-4, 0.017))):
        wrench = torch.from_numpy(loads).requires_grad_()
        total = (grasp_force(positions, normals, 0.4, wrench, barrier_weight=weight).force * normals).sum((1, 2))
        total.sum().backward()
        assert wrench.grad is not None
        excess.append(float(np.median(total.detach().numpy() / least - 1.0)))
        off = np.abs(wrench.grad.numpy() - slopes).max(1) / np.abs(slopes).max(1)
        np.testing.assert_allclose((np.median(off), np.percentile(off, 99)), errors, rtol=0.03)
    np.testing.assert_allclose(excess, (0.15, 0.0145, 0.00145), rtol=0.02)


def test_two_contacts_have_forces_and_gradients_within_their_reach() -> None:
    """The forces are those of `ForceOptimizer`; slopes along every change that keeps the wrench within reach."""
    pinch = Grasp.from_contacts(
        [[0, 0.03, 0.01], [0.002, -0.03, 0]], [[0, -1, 0.1], [0, 1, 0]] / np.array([[1.005], [1]]), 0.8
    )
    rng = np.random.default_rng(0)
    pushes = np.abs(rng.standard_normal((4, 2, 1))) + 0.5 + rng.uniform(-0.3, 0.3, (4, 2, 3)) * [0, 1, 1]
    loads = np.array([-pinch.wrench(np.column_stack([each[:, :1] * [[1.0]], each[:, 1:] * 0.3])) for each in pushes])
    given = {
        "positions": torch.tensor(pinch.positions), "normals": torch.tensor(pinch.normals), "friction": torch.tensor([0.8, 0.7]),
        "wrench": torch.tensor(loads), "force_weight": torch.tensor([1.0, 1.3]), "barrier_weight": torch.tensor([0.01, 0.02]),
    }  # fmt: skip
    given = {name: a.double().requires_grad_(name not in ("positions", "normals")) for name, a in given.items()}
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
            up, down = (grasp_force(**{**given, name: a + sign * step}).force for sign in (1.0, -1.0))
        slope = ((up - down) * along).sum().item() / 2e-6
        assert slope == pytest.approx((a.grad * torch.tensor(move)).sum().item(), rel=1e-5, abs=1e-6), name
    out = grasp_force(**{**given, "wrench": given["wrench"].detach() + torch.tensor([0, 0, 0, 0, 0.01, 0])})
    assert out.status.tolist() == [3] * 4
