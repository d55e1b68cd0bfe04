"""The force layer: its answers, its gradients, its backends, and everything that torch does with it."""

from __future__ import annotations

import copy
import pickle
import random
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
from grasp_env.force import ForceLimits, optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball
from policies import GraspForceLayer, GraspForces, grasp_force, layer

BACKENDS = ("core", "operator", "torch")
DIFFERENTIABLE = ("force", "torsion", "multipliers")


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Who solves tensors on the CPU: the core what it can read as it lies, the core by torch's operators, or `batched_newton`."""
    monkeypatch.setattr(layer, "_CORE", request.param != "torch")
    if request.param == "operator":
        monkeypatch.setattr(layer, "_as_they_are", lambda given: None)
    return request.param


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Several threads wait for each other where others use the processor: the tests then take eight times as long."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def one(given: dict[str, Tensor], k: int) -> dict[str, Tensor]:
    return {name: a[k : k + 1] for name, a in given.items()}


def gradients(given: dict[str, Tensor], seed: int = 0, **options: Any) -> tuple[GraspForces, dict[str, Tensor]]:
    """The answers, and gradients of a random linear function of them."""
    leaves = {name: a.detach().clone().requires_grad_() for name, a in given.items()}
    result, draw = grasp_force(**leaves, **options), torch.Generator().manual_seed(seed)
    loss = sum((torch.randn(getattr(result, name)[:1].shape, generator=draw, dtype=torch.float64) * getattr(result, name)).sum() for name in DIFFERENTIABLE)  # fmt: skip
    assert isinstance(loss, Tensor)
    loss.backward()
    result = GraspForces(*(a.detach() for a in result))
    return result, {name: a.grad for name, a in leaves.items() if a.grad is not None}


def near(a: Tensor, b: Tensor) -> bool:
    """Equal but for what other sums of a batched product round, gaps and residuals to their own rounding."""
    return bool(((a.double() - b.double()).abs() <= 1e-8 * (1.0 + b.double().abs().max())).all())


def far(a: Tensor, b: Tensor) -> float:
    """Largest difference of elements, as a part of their size."""
    size = b.flatten(1).abs().amax(1).clamp(min=1e-9)
    return float(((a - b).flatten(1).abs().amax(1) / size).max())


@pytest.mark.parametrize("kind", KINDS)
def test_forces_are_those_of_the_optimizer(kind: str, backend: str) -> None:
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
        normals = a["normals"] / (a["normals"] ** 2).sum(-1, keepdims=True) ** 0.5
        grasp = Grasp.from_contacts(a["positions"], normals, a["friction"], tangents=a.get("tangents"), **soft)
        names = ("jacobian", "torque_limit", "torque_bias", "min_normal", "max_normal")
        limits = ForceLimits(**{name: a[name] for name in names if name in a}) if any(n in a for n in names) else None
        expected = optimize_force(grasp, a["wrench"], limits=limits, force_weight=a["force_weight"], barrier_weight=a["barrier_weight"], tolerance=1e-12)  # fmt: skip
        size = abs(expected.object_force).max()
        # a gap of 1e-12 leaves its root
        assert abs(result.force[k].numpy() - expected.object_force).max() < 5e-6 * size
        assert abs(result.multipliers[k].numpy() - expected.multipliers).max() < 5e-5 * abs(expected.multipliers).max()
        if soft:
            assert abs(result.torsion[k].numpy() - expected.torsion).max() < 1e-6


@pytest.mark.parametrize("kind", [*KINDS, "exceeded", "unbalanced"])
def test_gradcheck(kind: str) -> None:
    """All inputs at once, along random directions; the elastic answers, too."""
    given = problems(kind, 2)
    moves = {
        name: a.isfinite() & (a != 0.0) for name, a in given.items()
    }  # a limit of inf and a hard contact stay what they are

    def answers(*leaves: Tensor) -> tuple[Tensor, ...]:
        inputs = {name: torch.where(moves[name], a, given[name]) for name, a in zip(given, leaves, strict=True)}
        result = grasp_force(**inputs, infeasible="elastic", tolerance=1e-13)
        return result.force, result.torsion, result.multipliers

    leaves = [torch.where(moves[name], a, 1.0).requires_grad_() for name, a in given.items()]
    torch.manual_seed(0)
    assert torch.autograd.gradcheck(answers, leaves, eps=1e-6, atol=1e-6, rtol=1e-6, fast_mode=True)


@pytest.mark.parametrize("kind", [*KINDS, *HOPELESS])
def test_the_core_is_the_batched_newton(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given, found = problems(kind, 32, seed=1), []
    for in_core in (True, False):
        monkeypatch.setattr(layer, "_CORE", in_core)
        found.append(gradients(given, infeasible="elastic"))
    (a, by_a), (b, by_b) = found
    assert a.status.tolist() == b.status.tolist()
    assert {"exceeded": 5, "far exceeded": 5, "unbalanced": 6}.get(kind, 0) in a.status
    # forces that exceed limits by far lie on their cones, where both sides lose digits
    rounding = 10.0 if kind == "far exceeded" else 1.0
    assert far(a.force, b.force) < 1e-9 * rounding
    assert (a.torsion - b.torsion).abs().max() < 1e-10 * rounding
    assert far(a.multipliers, b.multipliers) < 1e-9 * rounding
    for name in by_a:
        assert far(by_a[name], by_b[name]) < 1e-7 * rounding**2, name


def test_both_tell_apart_what_balances_without_an_internal_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three contacts at random, few of which close the grasp: a force inside the cones is found, or shown not to exist."""
    draw, found = torch.Generator().manual_seed(1), []
    normals = torch.randn(40, 3, 3, generator=draw, dtype=torch.float64)
    wrench = torch.randn(40, 6, generator=draw, dtype=torch.float64) * torch.tensor([1, 1, 1, 0.02, 0.02, 0.02])
    for in_core in (True, False):
        monkeypatch.setattr(layer, "_CORE", in_core)
        found.append(grasp_force(-0.03 * normals, normals, 0.6, wrench, torsional_friction=0.003))
    assert found[0].status.tolist() == found[1].status.tolist()
    assert set(found[0].status.tolist()) == {0, 3}
    assert far(found[1].force, found[0].force) < 1e-9


def test_elements_do_not_disturb_their_neighbours(backend: str) -> None:
    """Infeasible, exceeding, and refused elements among good ones: the others bit for bit, and never a nan."""
    given = problems("soft", 1000 if backend != "torch" else 24)
    given["friction"][3] = given["torsional_friction"][3] = 1e-4  # nothing balances these wrenches
    good = torch.ones(len(given["wrench"]), dtype=torch.bool)
    spoiled = [
        ("wrench", torch.nan),
        ("wrench", torch.inf),
        ("normals", 0.0),
        ("positions", torch.nan),
        ("friction", -1.0),
    ]
    spoiled += [("friction", torch.nan), ("barrier_weight", 0.0), ("torsional_friction", torch.inf), ("wrench", 1e300)]
    spoiled += [("normals", 1e-320), ("positions", -torch.inf), ("force_weight", torch.nan)]
    good[3] = False
    for k, (name, value) in enumerate(spoiled, start=5):
        given[name][k], good[k] = value, False
    result, by = gradients(given)
    assert result.status[5 : 5 + len(spoiled)].tolist() == [4] * len(spoiled)
    assert result.status[3] in (3, 7)
    assert result.feasible.tolist() == good.tolist()
    assert not any(a.isnan().any() for a in (*result, *by.values()))
    assert not any(a[~good].any() for a in by.values())  # no gradient
    assert result.force[3].any()
    assert result.force.isfinite().all()
    whole, by_whole = gradients({name: a[good] for name, a in given.items()})
    for a, b in zip((*result, *by.values()), (*whole, *by_whole.values()), strict=True):
        assert torch.equal(a[good], b) if backend != "torch" else near(a[good], b)
    for k in (0, 4, 20):
        single, by_single = gradients(one(given, k))
        for a, b in zip((*result, *by.values()), (*single, *by_single.values()), strict=True):
            assert torch.equal(a[k], b[0]) if backend != "torch" else near(a[k], b[0])


def test_no_numbers_make_a_nan(backend: str) -> None:
    """Numbers that are not finite, tiny, huge or negative anywhere."""
    rng = random.Random(0)
    spoilers = [torch.nan, torch.inf, -torch.inf, 0.0, -1.0, 1e-320, 1e300, 1e12, -1e12, 1e-12, 1e6]
    for seed in range(90 if backend != "torch" else 5):
        given = problems((*KINDS, *HOPELESS)[-1 - seed % 9], 8, seed)
        for _ in range(rng.randint(1, 8)):
            values = rng.choice(list(given.values()))
            values[tuple(map(rng.randrange, values.shape))] = rng.choice(spoilers)
        result, by = gradients(given, infeasible="elastic")
        found = {**result._asdict(), **by}
        assert [name for name, a in found.items() if a.isnan().any()] == [], seed
        assert result.force.isfinite().all(), seed


@pytest.mark.parametrize("kind", ["exceeded", "unbalanced"])
def test_elements_without_an_optimum(kind: str, backend: str) -> None:
    """Their forces are strictly inside the cones, and their gradient is zero, or that of the elastic answer, or an error names them."""
    bad, count = problems(kind, 2), 2 if kind == "unbalanced" else 4
    masked, by = gradients(bad)
    assert masked.status.tolist() == [6 if kind == "unbalanced" else 5] * 2
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
    easy = problems("hard", 3)
    if kind == "unbalanced":
        with pytest.raises(
            InfeasibleWrenchError, match=r"2 of 2 elements have no optimal force \(0: its contacts .*, 1: .*'mask'"
        ):
            grasp_force(**bad, infeasible="raise")
        easy["wrench"][1] = torch.nan
        with pytest.raises(InfeasibleWrenchError, match=r"1 of 3 elements .*\(1: its numbers are not finite"):
            grasp_force(**easy, infeasible="raise")


def test_shapes_broadcast(backend: str) -> None:
    given = problems("hard", 6)
    flat = grasp_force(**given)
    shared = {name: a[0].clone().requires_grad_() for name, a in given.items() if name != "wrench"}
    wrench = given["wrench"].view(2, 3, 6)
    result = grasp_force(**shared, wrench=wrench)
    assert [tuple(a.shape) for a in result] == [
        (2, 3, 4, 3),
        (2, 3, 4),
        (2, 3, 6),
        (2, 3),
        (2, 3),
        (2, 3),
        (2, 3),
        (2, 3),
    ]
    assert torch.equal(result.force[0, 0], flat.force[0])
    result.force.square().sum().backward()
    alone = {name: a.detach().expand(6, *a.shape).clone().requires_grad_() for name, a in shared.items()}
    grasp_force(**alone, wrench=given["wrench"]).force.square().sum().backward()
    for name, a in shared.items():
        assert a.grad is not None
        torch.testing.assert_close(a.grad, alone[name].grad.sum(0), rtol=1e-8, atol=1e-8)  # type: ignore[union-attr]
    # numbers, tensors without dimensions, friction (N,) and (N, 2), no batch at all
    plain = {name: given[name][0] for name in ("positions", "normals", "wrench")}
    number = torch.tensor(0.6, requires_grad=True)
    forces = [grasp_force(friction=f, **plain).force for f in (0.6, torch.tensor(0.6, dtype=torch.float64), torch.full((4,), 0.6, dtype=torch.float64), torch.full((4, 2), 0.6, dtype=torch.float64))]  # fmt: skip
    assert all(f.shape == (4, 3) and torch.equal(f, forces[0]) for f in forces)
    grasp_force(friction=number, **plain).force.sum().backward()
    assert number.grad is not None
    assert number.grad.shape == ()
    empty, by = gradients({name: a[:0] for name, a in given.items()})
    assert empty.force.shape == (0, 4, 3)
    assert all(a.shape == given[name][:0].shape for name, a in by.items())


def between(a: Tensor) -> Tensor:
    """The numbers, at a place in memory where no float64 should lie."""
    return torch.frombuffer(bytearray(b"x" + a.numpy().tobytes()), dtype=a.dtype, offset=1).view(a.shape)


LAYOUTS: dict[str, Callable[[dict[str, Tensor]], dict[str, Tensor]]] = {
    "as they are": lambda given: given,
    "float32": lambda given: {name: a.float() for name, a in given.items()},
    "mixed": lambda given: {**given, "wrench": given["wrench"].float()},
    "one grasp": lambda given: {name: a if name == "wrench" else a[0] for name, a in given.items()},
    "one coefficient a contact": lambda given: {**given, "friction": given["friction"][..., 0]},
    "one for all": lambda given: {**given, "friction": given["friction"][0, :, 0]},
    "other strides": lambda given: {name: a.movedim(0, -1).contiguous().movedim(-1, 0) for name, a in given.items()},
    "expanded": lambda given: {name: a if name == "wrench" else a[:1].expand(a.shape) for name, a in given.items()},
    "two dimensions": lambda given: {name: a.unflatten(0, (2, 3)) for name, a in given.items()},
    "broadcast": lambda given: {name: a[:2, None] if name == "wrench" else a[:3] for name, a in given.items()},
    "no batch": lambda given: {name: a[0] for name, a in given.items()},
    "of no dimension": lambda given: {**given, "friction": given["friction"][0, 0, 0]},
    "between": lambda given: {**given, "wrench": between(given["wrench"])},
    "parameters": lambda given: {name: torch.nn.Parameter(a) for name, a in given.items()},
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_core_reads_what_operators_convert(layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same bits, with every layout, with numbers, and with arrays as torch before 2.10 gives them; sums over what is shared round."""
    given, found = LAYOUTS[layout](problems("own joints", 6)), []
    given |= {
        "max_normal": torch.tensor(50.0, dtype=torch.float64),
        "barrier_weight": torch.tensor(0.01, dtype=torch.float64),
    }
    for numbers in (False, True):
        options = {name: float(given.pop(name)) for name in ("max_normal", "barrier_weight")} if numbers else {}
        found = [gradients(given, **options)]
        with monkeypatch.context() as patch:
            patch.setattr(layer, "_as_they_are", lambda given: None)
            found.append(gradients(given, **options))
            patch.setattr(layer, "_read", lambda tensors: layer._of([a if a is None else a.numpy() for a in tensors]))
            found.append(gradients(given, **options))
        for result, by in found[1:]:
            assert all(torch.equal(a, b) for a, b in zip(found[0][0], result, strict=True))
            for name, a in by.items():
                torch.testing.assert_close(a, found[0][1][name], rtol=1e-12, atol=1e-12 * float(a.abs().max()))


def test_a_changed_sign_bit_is_read(backend: str) -> None:
    given = problems("hard", 2)
    expected = grasp_force(**given).force
    given["wrench"] = torch.complex(given["wrench"], -given["wrench"]).conj().imag
    assert given["wrench"].is_neg()
    assert torch.equal(grasp_force(**given).force, expected)


def test_what_is_saved_for_the_backward_pass(backend: str) -> None:
    """A changed input is noticed, tensors that are packed and unpacked on the way serve, and numbers need none."""
    given = {name: a.requires_grad_() for name, a in problems("hard", 2).items()}
    result = grasp_force(**given)
    assert [a.requires_grad for a in result] == [True] * 3 + [False] * 5
    with torch.no_grad():
        given["wrench"] += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        result.force.sum().backward()
    _, expected = gradients(given, max_normal=50.0)
    for unpack in (torch.from_numpy, lambda a: torch.from_numpy(a).float(), lambda a: torch.from_numpy(a).half()):
        with torch.autograd.graph.saved_tensors_hooks(lambda a: a.detach().numpy().copy(), unpack):
            _, by = gradients(given, max_normal=50.0)
        for name, a in by.items():
            exact = unpack is torch.from_numpy
            assert torch.equal(a, expected[name]) if exact else far(a, expected[name].to(a.dtype)) < 0.2
    leaf = given["wrench"].detach().requires_grad_()
    (slope,) = torch.autograd.grad(
        grasp_force(**{**given, "wrench": leaf}).force.square().sum(), leaf, create_graph=True
    )
    with pytest.raises(UnsupportedProblemError, match="first derivatives only"):
        slope.sum().backward()


def test_types(backend: str) -> None:
    """float32 in, float32 out, float64 inside; half types become float32, also under autocast."""
    given = problems("hard", 3)
    exact = grasp_force(**given)
    low = {name: a.float().requires_grad_() for name, a in given.items()}
    result = grasp_force(**low)
    assert {a.dtype for a in (result.force, result.torsion, result.multipliers, result.gap, result.residual)} == {
        torch.float32
    }
    assert (result.status.dtype, result.iterations.dtype, result.feasible.dtype) == (
        torch.int64,
        torch.int64,
        torch.bool,
    )
    assert far(result.force.detach().double(), exact.force) < 1e-4
    result.force.sum().backward()
    assert all(a.grad is not None and a.grad.dtype == torch.float32 and a.grad.isfinite().all() for a in low.values())
    mixed = grasp_force(**{**{name: a.detach() for name, a in low.items()}, "wrench": given["wrench"]})
    assert mixed.force.dtype == torch.float64
    with torch.autocast("cpu", torch.bfloat16):
        wrench = (given["wrench"].float() @ torch.eye(6)).requires_grad_()
        assert wrench.dtype == torch.bfloat16
        half = grasp_force(given["positions"].float(), given["normals"].half(), 0.6, wrench)
    assert half.force.dtype == torch.float32
    (found,) = torch.autograd.grad(half.force.sum(), wrench)
    assert found.dtype == torch.bfloat16


def test_transforms(backend: str) -> None:
    """`vmap`, `grad`, `jacrev`, one in the other, and `torch.compile` without a break."""
    given = problems("soft", 3)
    wrench, fixed = given.pop("wrench"), {name: a[0] for name, a in given.items()}
    positions, others = fixed.pop("positions"), fixed

    def force(w: Tensor, p: Tensor) -> Tensor:
        return grasp_force(positions=p, wrench=w, **others).force

    def cost(w: Tensor, p: Tensor) -> Tensor:
        return force(w, p).square().sum()

    every = force(wrench, positions)
    torch.testing.assert_close(torch.func.vmap(force, (0, None))(wrench, positions), every)
    jacobian = torch.func.jacrev(force)(wrench[0], positions)
    torch.testing.assert_close(jacobian, torch.autograd.functional.jacobian(lambda w: force(w, positions), wrench[0]))
    many = torch.func.vmap(torch.func.jacrev(force, (0, 1)), (0, None))(wrench, positions)
    torch.testing.assert_close(many[0][0], jacobian)
    whole = torch.func.jacrev(torch.func.vmap(force, (0, None)))(wrench, positions)
    torch.testing.assert_close(whole[0, ..., 0, :], jacobian)
    leaf = positions.clone().requires_grad_()
    moved = force(wrench[0], leaf)
    rows = torch.eye(12, dtype=torch.float64).view(12, 4, 3)
    (slopes,) = torch.vmap(lambda row: torch.autograd.grad(moved, leaf, row, retain_graph=True))(rows)
    torch.testing.assert_close(slopes.view(4, 3, 4, 3), torch.func.jacrev(force, 1)(wrench[0], positions))
    (slope,) = torch.autograd.grad(moved, leaf, torch._neg_view(rows[0]), retain_graph=True)
    torch.testing.assert_close(slope, -slopes[0])
    cost(wrench[0], leaf).backward()
    torch.testing.assert_close(torch.func.grad(cost, 1)(wrench[0], positions), leaf.grad)
    with pytest.raises(UnsupportedProblemError, match="first derivatives only"):
        torch.func.jacrev(torch.func.grad(cost))(wrench[0], positions)
    if backend != "torch":
        compiled = torch.compile(cost, fullgraph=True, backend="aot_eager")
        again = positions.clone().requires_grad_()
        compiled(wrench[0], again).backward()
        torch.testing.assert_close(again.grad, leaf.grad)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, on the way to forward mode
@pytest.mark.parametrize("graph", [True, False])
def test_forward_mode_is_refused(graph: bool, backend: str) -> None:
    given = problems("hard", 2)
    with torch.autograd.forward_ad.dual_level(), torch.set_grad_enabled(graph):
        given["wrench"] = torch.autograd.forward_ad.make_dual(given["wrench"], given["wrench"])
        with pytest.raises(NotImplementedError, match="forward mode"):
            grasp_force(**given)


@pytest.mark.parametrize("kind", ["soft", "exceeded"])
def test_operators_are_well_made(kind: str) -> None:
    """torch's own check of the schema, the fake and the autograd rules, of both operators."""
    given = problems(kind, 2)
    tensors = [given.get(name) for name in layer._NAMES]
    leaves = [a if a is None else a.clone().requires_grad_(k % 2 == 0) for k, a in enumerate(tensors)]
    torch.library.opcheck(layer._solve, (*leaves, "elastic", 1e-10, 200, None))
    *answers, _, state = layer._solve(*tensors, "elastic", 1e-10, 200, None)
    wanted = [a is not None for a in tensors[:-1]]
    torch.library.opcheck(layer._gradients, (*tensors[:-1], state, *map(torch.ones_like, answers), wanted, True, None))


def test_chunks_threads_and_copies_change_nothing(backend: str) -> None:
    given = problems("shared joints", 1200 if backend != "torch" else 7)
    whole, by = gradients(given)
    for count, chunk in ((1, None), (2, None), (2, 3), (2, 100)):
        torch.set_num_threads(count)
        again, by_again = gradients(given, chunk=chunk)
        if backend != "torch":
            assert all(
                torch.equal(a, b) for a, b in zip((*again, *by_again.values()), (*whole, *by.values()), strict=True)
            )
        else:
            torch.testing.assert_close(again.force, whole.force, rtol=1e-9, atol=1e-12)
    module = GraspForceLayer("elastic", tolerance=1e-8, chunk=100)
    for copied in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert (
            repr(copied)
            == repr(module)
            == "GraspForceLayer(infeasible='elastic', tolerance=1e-08, max_iterations=200, chunk=100)"
        )
        assert torch.equal(copied(**one(given, 0)).force, module(**one(given, 0)).force)
    assert not list(module.parameters())


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_of_a_loader(context: str) -> None:
    expected = grasp_force(**problems("hard", 2)).force
    loader = torch.utils.data.DataLoader(Forces(), batch_size=2, num_workers=1, multiprocessing_context=context)
    (found,) = list(loader)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


def test_a_start_saves_steps(backend: str) -> None:
    given = problems("shared joints", 8)
    cold = grasp_force(**given)
    given["wrench"] = given["wrench"] + 1e-4
    there = grasp_force(**given)
    warm = grasp_force(**given, start=cold.force)
    assert far(warm.force, there.force) < 1e-9
    assert warm.iterations.double().mean() < 0.5 * cold.iterations.double().mean()
    useless = torch.full_like(cold.force, torch.nan)
    useless[1] = -cold.force[1]  # outside the cones
    again = grasp_force(**given, start=useless)
    assert far(again.force, there.force) < 1e-9
    assert not again.force.isnan().any()


def test_iterations_are_limited(backend: str) -> None:
    few = grasp_force(**problems("hard", 3), max_iterations=2)
    assert few.status.tolist() == [1] * 3
    assert few.iterations.tolist() == [2] * 3
    assert few.feasible.all()
    assert (few.gap > 1e-10).all()
    assert few.residual.max() < 1e-9


WRONG: dict[str, tuple[dict[str, Any], type[GraspError], str]] = {
    "mode": ({"infeasible": "elastc"}, UnknownNameError, "did you mean 'elastic'"),
    "tolerance": ({"tolerance": 0.0}, InvalidInputError, "tolerance"),
    "iterations": ({"max_iterations": 1.5}, InvalidInputError, "max_iterations"),
    "chunk": ({"chunk": 0}, InvalidInputError, "chunk"),
    "no tensor": ({"positions": [[1.0, 0.0, 0.0]]}, InvalidInputError, r"positions must be a tensor \(..., N, 3\)"),
    "integers": ({"wrench": torch.ones(1, 6, dtype=torch.int64)}, InvalidInputError, "wrench must be of a floating-point type"),
    "contacts": ({"normals": torch.ones(1, 3, 3)}, InvalidInputError, r"normals must be of shape \(..., 4, 3\)"),
    "leading": ({"wrench": torch.ones(2, 6), "start": torch.ones(3, 4, 3)}, InvalidInputError, "leading dimensions must broadcast"),
    "friction": ({"friction": "0.4"}, InvalidInputError, "friction must be a tensor or a number"),
    "large": ({"friction": 10**400}, InvalidInputError, r"friction must be at most 1e\+12"),
    "half a limit": ({"torque_limit": 1.0}, InvalidInputError, "together"),
    "joints": ({"jacobian": torch.ones(1, 4, 3, 2), "torque_limit": torch.ones(3)}, InvalidInputError, r"torque_limit must be of shape \(..., 2\)"),
    "rows": ({"jacobian": torch.ones(1, 4, 5, 2), "torque_limit": 1.0}, InvalidInputError, r"jacobian must be of shape \(..., 4, 3, 2\)"),
    "device": ({"wrench": torch.ones(1, 6, device="meta")}, InvalidInputError, "one device, got positions on cpu and wrench on meta"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_errors_name_what_is_wrong(case: str) -> None:
    changed, kind, words = WRONG[case]
    with pytest.raises(kind, match=words):
        grasp_force(**{**problems("hard", 1), **changed})


def test_a_small_barrier_weight_approaches_the_exact_problem() -> None:
    """The page on gradients says how far sum and gradient of the normal forces are from the conic problem's."""
    grasp, loads = presets.paper_cuboid(), sample_ball(np.random.default_rng(0), 1000)
    exact = optimize_forces(grasp, loads, method="conic", tolerance=1e-10)
    least, slopes = exact.force[:, :, 0].sum(1), -exact.multipliers
    positions, normals = torch.from_numpy(np.array(grasp.positions)), torch.from_numpy(np.array(grasp.normals))
    excess: list[float] = []
    for weight, errors in ((1e-2, (0.048, 1.5)), (1e-4, (2.4e-3, 0.16)), (1e-6, (1.7e-4, 0.017))):
        wrench = torch.from_numpy(loads).requires_grad_()
        force = grasp_force(positions, normals, 0.4, wrench, barrier_weight=weight).force
        total = (force * normals).sum((1, 2))
        total.sum().backward()
        excess.append(float(np.median(total.detach().numpy() / least - 1.0)))
        off = np.abs(wrench.grad.numpy() - slopes).max(1) / np.abs(slopes).max(1)
        np.testing.assert_allclose((np.median(off), np.percentile(off, 99)), errors, rtol=0.03)
    np.testing.assert_allclose(excess, (0.15, 0.0145, 0.00145), rtol=0.02)
