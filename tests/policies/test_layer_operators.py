"""The force layer in torch: layouts, types and devices of tensors, transforms, operators, what is
saved for the backward pass."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch
from layer_problems import Forces, Passing, error, gradients, margin, problems, same_bits
from torch import Tensor
from torch._lazy import ts_backend

from grasp_env.errors import UnsupportedProblemError
from policies import GraspForceLayer, grasp_force, layer_inputs, layer_operators

pytestmark = pytest.mark.usefixtures("one_thread")
start_lazy_device = cache(ts_backend.init)


LAYOUTS: dict[str, Callable[[dict[str, Tensor]], dict[str, Tensor]]] = {
    "as they are": lambda given: given,
    "float32": lambda given: {name: a.float() for name, a in given.items()},
    "one grasp": lambda given: {name: a if name == "wrench" else a[0] for name, a in given.items()},
    "one coefficient a contact": lambda given: {**given, "friction": given["friction"][..., 0]},
    "one coefficient": lambda given: {**given, "friction": given["friction"][0, 0, 0]},
    "other strides": lambda given: {
        name: a.movedim(0, -1).contiguous().movedim(-1, 0) for name, a in given.items()
    },
    "broadcast": lambda given: {
        name: a[:2, None] if name == "wrench" else a[:3] for name, a in given.items()
    },
    "no batch": lambda given: {name: a[0] for name, a in given.items()},
    "no elements": lambda given: {name: a[:0] for name, a in given.items()},
    "sign bit": lambda given: {
        **given,
        "wrench": torch.complex(given["wrench"], -given["wrench"]).conj().imag,
    },
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read(layout):
    given = LAYOUTS[layout](problems("own joints", 6))
    result, by = gradients(given, max_normal=50.0)
    limit = torch.tensor(50.0, dtype=torch.float64)
    # as it is: `gradients` makes copies
    assert torch.equal(grasp_force(**given, max_normal=50.0).force, result.force)
    with Passing():
        assert torch.equal(grasp_force(**given, max_normal=50.0).force, result.force)
        converted = gradients(given, max_normal=50.0)
    for again, by_again in (converted, gradients({**given, "max_normal": limit})):
        assert same_bits(again, result)
        for name, a in by.items():
            assert (a.shape, a.dtype) == (given[name].shape, given[name].dtype)
            torch.testing.assert_close(a, by_again[name], rtol=1e-12, atol=1e-12)
    # which are other problems
    if layout not in ("one grasp", "one coefficient", "broadcast", "no elements"):
        flat = grasp_force(**problems("own joints", 6), max_normal=50.0).force
        flat = flat[0] if layout == "no batch" else flat
        wide = 1e-5 if layout == "float32" else 1e-12
        torch.testing.assert_close(result.force.double(), flat, rtol=0.0, atol=wide)


@pytest.mark.usefixtures("way")
def test_what_is_saved_for_the_backward_pass():
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


@pytest.mark.usefixtures("way")
def test_types():
    """float32 in, float32 out, float64 inside; half types become float32, also under autocast.

    A number, or a tensor without axes, takes the type of the others.
    """
    given = problems("hard", 3)
    low = {name: a.float() for name, a in given.items()}
    result, by = gradients(low)
    assert [a.dtype for a in result[:3]] == [torch.float32] * 3
    assert [a.dtype for a in result[3:]] == [
        torch.int64,
        torch.float32,
        torch.float32,
        torch.int64,
        torch.bool,
    ]
    assert error(result.force.double(), grasp_force(**given).force) < 1e-4
    assert all(a.dtype == torch.float32 and a.isfinite().all() for a in by.values())
    half_each = torch.full((4,), 0.5, dtype=torch.float64)
    for other, dtype in (
        ({"wrench": given["wrench"]}, torch.float64),
        ({"friction": 0.5}, torch.float32),
        ({"friction": half_each[0]}, torch.float32),
        ({"friction": half_each}, torch.float64),
    ):
        assert grasp_force(**low | other).force.dtype is dtype
    with torch.autocast("cpu", torch.bfloat16):
        wrench = (low["wrench"] @ torch.eye(6)).requires_grad_()
        half = grasp_force(low["positions"], given["normals"].half(), 0.6, wrench)
    assert half.force.dtype == torch.float32
    (found,) = torch.autograd.grad(half.force.sum(), wrench)
    assert found.dtype == wrench.dtype == torch.bfloat16


@pytest.mark.usefixtures("way")
def test_gradients_of_the_forces_are_read_in_any_layout():
    given = problems("hard", 3)
    wrench = given.pop("wrench").requires_grad_()
    loss = torch.randn(3, 4, 3, dtype=torch.float64)
    force = grasp_force(wrench=wrench, **given).force
    (plain,) = torch.autograd.grad(force, wrench, loss, retain_graph=True)
    strides = loss.movedim(0, -1).contiguous().movedim(-1, 0)
    for same in (strides, torch._neg_view(-loss)):
        assert torch.equal(torch.autograd.grad(force, wrench, same, retain_graph=True)[0], plain)


def test_transforms():
    given = problems("soft", 3)
    wrench = given.pop("wrench")
    others = {name: a[0] for name, a in given.items()}
    positions = others.pop("positions")

    def force(w: Tensor, p: Tensor) -> Tensor:
        return grasp_force(positions=p, wrench=w, **others).force

    def cost(w: Tensor, p: Tensor) -> Tensor:
        return force(w, p).square().sum()

    torch.testing.assert_close(
        torch.func.vmap(force, (0, None))(wrench, positions), force(wrench, positions)
    )
    jacobian = torch.func.jacrev(force)(wrench[0], positions)
    torch.testing.assert_close(
        jacobian, torch.autograd.functional.jacobian(lambda w: force(w, positions), wrench[0])
    )
    many = torch.func.vmap(torch.func.jacrev(force, (0, 1)), (0, None))(wrench, positions)
    torch.testing.assert_close(many[0][0], jacobian)
    leaf = positions.clone().requires_grad_()
    cost(wrench[0], leaf).backward()
    torch.testing.assert_close(torch.func.grad(cost, 1)(wrench[0], positions), leaf.grad)
    with pytest.raises(UnsupportedProblemError, match="first derivatives only"):
        torch.func.jacrev(torch.func.grad(cost))(wrench[0], positions)
    again = positions.clone().requires_grad_()
    torch.compile(cost, fullgraph=True, backend="aot_eager")(wrench[0], again).backward()
    torch.testing.assert_close(again.grad, leaf.grad)


@pytest.mark.parametrize("with_margin", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_tensors_on_another_device_are_solved_on_the_cpu(dtype, with_margin):
    """torch's builds for the CPU have a second device that computes, `lazy`: answers and gradients
    come back to it."""
    start_lazy_device()
    given = problems("soft", 3)
    if with_margin:
        given |= margin(given)
    given = {name: a.to(dtype) for name, a in given.items()}
    given["friction"] = given["friction"][0]  # shared
    far = {name: a.to("lazy") for name, a in given.items()}
    options: dict[str, Any] = {"max_normal": 50.0, "infeasible": "elastic"}
    found = []
    for each in (given, far):
        result, by = gradients(each, **options)
        warm = grasp_force(**each, start=result.force)
        slopes = torch.func.jacrev(
            lambda wrench, each=each: grasp_force(**each | {"wrench": wrench}).force
        )
        found.append((*result, *by.values(), *warm, slopes(each["wrench"])))
    for a, b in zip(*found, strict=True):
        assert (b.device.type, b.dtype) == ("lazy", a.dtype)
        assert torch.equal(b.cpu(), a)
    meta = grasp_force(**{name: a.to("meta") for name, a in given.items()})
    assert [(a.device.type, a.shape) for a in meta] == [("meta", a.shape) for a in result]


@pytest.mark.filterwarnings(
    "ignore:.*torch.jit.script:DeprecationWarning"
)  # torch's own, on the way to forward mode
def test_forward_mode_is_refused():
    given = problems("hard", 2)
    with torch.autograd.forward_ad.dual_level():
        given["wrench"] = torch.autograd.forward_ad.make_dual(given["wrench"], given["wrench"])
        with pytest.raises(NotImplementedError, match="forward mode"):
            grasp_force(**given)


def test_operators_pass_the_check_of_torch():
    given = problems("soft", 2)
    given["positions"] = given["positions"].float()  # as is its gradient
    tensors = [given.get(name) for name in layer_inputs.NAMES]
    leaves = [
        a if a is None else a.clone().requires_grad_(k % 2 == 0) for k, a in enumerate(tensors)
    ]
    torch.library.opcheck(layer_operators.SOLVE, (*leaves, "elastic", 1e-10, 200, 512))
    *answers, _, state = layer_operators.SOLVE(*tensors, "elastic", 1e-10, 200, 512)
    wanted = [a is not None for a in tensors[:-1]]
    torch.library.opcheck(
        layer_operators.GRADIENTS,
        (*tensors[:-1], state, *map(torch.ones_like, answers), wanted, True, 512),
    )


def test_modules_are_copied_and_used_by_workers():
    module = GraspForceLayer("elastic", tolerance=1e-8, chunk=100)
    given = problems("hard", 2)
    assert "infeasible='elastic', tolerance=1e-08, max_iterations=200, chunk=100" in repr(module)
    for copied in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert repr(copied) == repr(module)
        assert torch.equal(copied(**given).force, module(**given).force)
    loader = torch.utils.data.DataLoader(
        Forces(), batch_size=2, num_workers=1, multiprocessing_context="fork"
    )
    torch.testing.assert_close(
        next(iter(loader)), grasp_force(**given).force, rtol=1e-9, atol=1e-12
    )
