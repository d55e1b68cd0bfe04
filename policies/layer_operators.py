"""The compiled core as torch operators, for autograd, `torch.func` and `torch.compile`.

The core runs on `torch.get_num_threads()` threads, in float64. Tensors are on the CPU, their
leading dimensions broadcast, and gradients have the shapes of the inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn, TypeAlias

import numpy as np

from grasp_env import core
from grasp_env.errors import InfeasibleWrenchError, InvalidInputError, UnsupportedProblemError
from grasp_env.force import record
from grasp_env.force.many import over_parts
from grasp_env.inputs.extras import need
from grasp_env.inputs.ranges import CONTACTS, JOINTS
from policies.layer_inputs import (
    INPUTS,
    NAMES,
    NEEDED,
    RANKS,
    checked_tensors,
    common_lead,
    tails_of,
)

with need("layer"):
    import torch
    from torch import Tensor, nn
    from torch.autograd import forward_ad

STATUS = {
    record.INFEASIBLE: "no force inside the friction cones balances the wrench",
    record.REFUSED: "an input is not finite, out of range, or a zero vector where a direction is needed",
    record.LIMITS_EXCEEDED: "no force is within the limits",
    record.RANK_LOST: "all contacts are at one point",
    record.UNDECIDED: "no force inside the friction cones was found",
}
"""Reasons why an element has no optimum, by status."""
Solved: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Force, torsion, multipliers, facts (status, gap, residual, iterations), and the state from which
the core differentiates."""
_TENSORS = len(NAMES)
_PLAIN = (Tensor, nn.Parameter)  # no derived classes


# --- the core


def read_in_place(inputs: Sequence[Any]) -> core.ForceProblems | None:
    """Return the problems if the core can read the inputs in place, else None."""
    if (
        torch.compiler.is_compiling()
        or torch._C._are_functorch_transforms_active()
        or torch._C._len_torch_dispatch_stack()
        or forward_ad._current_level >= 0
    ):
        return None
    for a in inputs:
        if type(a) in _PLAIN:
            if a.is_neg():
                return None
        elif a is not None and type(a) not in (float, int):
            return None
    return core.ForceProblems.of(tuple(inputs), CONTACTS, JOINTS)


def _read(tensors: Sequence[Tensor | None]) -> core.ForceProblems:
    """Return the problems of an operator's checked tensors."""
    arrays = [a if a is None else _array(a, (torch.float64, torch.float32)) for a in tensors]
    problems = core.ForceProblems.of(tuple(arrays), CONTACTS, JOINTS)
    if problems is None:
        most = max(a.ndim for a in arrays if a is not None)
        raise InvalidInputError(
            f"tensors have {most} dimensions, too many leading ones: flatten them to at most 20"
        )
    return problems


def _array(a: Tensor, types: Sequence[torch.dtype] = (torch.float64,)) -> Any:
    """Return a tensor as an array, converted to float64 unless it has one of these types."""
    return (a if a.dtype in types else a.to(torch.float64)).detach().resolve_neg().numpy()


def optima(
    problems: core.ForceProblems, tolerance: float, max_iterations: int, chunk: int
) -> Solved:
    """Solve all problems."""
    tails = _result_tails(problems.contacts)
    arrays = tuple([np.empty((*problems.lead, *tail)) for tail in tails])

    def work(block: slice) -> None:
        problems.solve((block.start, block.stop), (tolerance, max_iterations), arrays)

    over_parts(work, problems.size, chunk, torch.get_num_threads())
    return tuple([torch.from_numpy(a) for a in arrays])  # type: ignore[return-value]


def _result_tails(count: int) -> tuple[tuple[int, ...], ...]:
    """Return the trailing dimensions of the tensors of `Solved`."""
    return (count, 3), (count,), (6,), (core.LAYER_FACTS,), (core.layer_state_size(count),)


def _differentiate(
    problems: core.ForceProblems,
    state: Tensor,
    losses: Sequence[Tensor | None],
    needed: Sequence[bool],
    elastic: bool,
    chunk: int,
) -> list[Tensor | None]:
    """Return the needed gradients, with the leading dimensions of the problems."""
    tails = tails_of(problems.contacts, problems.jacobian_rows, problems.joints)
    pairs = zip(needed, tails, strict=False)
    arrays = tuple([np.empty((*problems.lead, *tail)) if n else None for n, tail in pairs])
    state_array = _array(state.contiguous())
    loss_arrays = tuple([a if a is None else _array(a.contiguous()) for a in losses])

    def work(block: slice) -> None:
        problems.differentiate((block.start, block.stop), state_array, loss_arrays, elastic, arrays)

    over_parts(work, problems.size, chunk, torch.get_num_threads())
    return [a if a is None else torch.from_numpy(a) for a in arrays]


def _as_input(gradient: Tensor, like: Tensor) -> Tensor:
    """Return a gradient in the shape and type of its input, summed over broadcast dimensions."""
    if gradient.shape != like.shape:
        gradient = gradient.sum_to_size(like.shape)
    return gradient if gradient.dtype is like.dtype else gradient.to(like.dtype)


def raise_for(status: Tensor, lead: Sequence[int]) -> None:
    """Raise an error that names the elements without an optimum, if there are any."""
    status = status.reshape(-1)
    failed = status > record.STALLED
    indices = failed.reshape(lead).nonzero().tolist()
    if not indices:
        return
    failures = [
        f"{k[0] if len(k) == 1 else tuple(k) or 'the only one'}: {STATUS[int(code)]}"
        for k, code in zip(indices[:5], status[failed][:5], strict=True)
    ]
    if len(indices) > 5:
        failures.append(f"and {len(indices) - 5} more")
    raise InfeasibleWrenchError(
        f"{len(indices)} of {len(status)} elements have no optimal force ({', '.join(failures)}): "
        "infeasible='mask' gives them the nearest force without a gradient, 'elastic' with one"
    )


# --- the operators


def _solve_impl(*args: Any) -> Solved:
    tensors = args[:_TENSORS]
    infeasible, *options = args[_TENSORS:]
    lead = common_lead(tensors)
    out = optima(_read(tensors), *options) if lead.numel() else _solve_fake(*args)
    if infeasible == "raise":
        raise_for(out[3][..., 0], lead)
    return out


def _solve_fake(*args: Any) -> Solved:
    lead = common_lead(args[:_TENSORS])
    like = args[0]
    tails = _result_tails(like.shape[-2])
    return tuple([like.new_empty((*lead, *tail), dtype=torch.float64) for tail in tails])  # type: ignore[return-value]


def _gradients_impl(*args: Any) -> list[Tensor]:
    tensors = args[:INPUTS]
    state, *losses = args[INPUTS:-3]
    needed, elastic, chunk = args[-3:]
    if not state.numel():
        return [a.new_zeros(a.shape) for a, w in zip(tensors, needed, strict=True) if w]
    # the start may have had more dimensions
    positions = tensors[0].expand(*state.shape[:-1], *tensors[0].shape[-2:])
    gradients = _differentiate(
        _read([positions, *tensors[1:]]), state, losses, needed, elastic, chunk
    )
    return [_as_input(g, a) for g, a in zip(gradients, tensors, strict=True) if g is not None]


def _gradients_fake(*args: Any) -> list[Tensor]:
    needed = [a for a, w in zip(args, args[INPUTS + 4], strict=False) if w]
    return [torch.empty_like(a, memory_format=torch.contiguous_format) for a in needed]


def _in_front(
    args: Sequence[Any], dims: Sequence[Any], ranks: Sequence[int], size: int
) -> list[Any]:
    """Move the dimension of `vmap` to the front and pad all tensors to equal leading dimensions."""
    triples = list(zip(args, dims, ranks, strict=True))
    rank = max(a.ndim - (d is not None) - r for a, d, r in triples if a is not None)
    out: list[Any] = []
    for a, d, r in triples:
        if a is not None:
            a = a.unsqueeze(0).expand(size, *a.shape) if d is None else a.movedim(d, 0)
            a = a.reshape(size, *(1,) * (rank - (a.ndim - 1 - r)), *a.shape[1:])
        out.append(a)
    return out


def _solve_vmap(info: Any, in_dims: Any, *args: Any) -> tuple[Any, Any]:
    tensors = _in_front(args[:_TENSORS], in_dims[:_TENSORS], [*RANKS.values()], info.batch_size)
    return solve(*tensors, *args[_TENSORS:]), (0,) * 5


def _gradients_vmap(info: Any, in_dims: Any, *args: Any) -> tuple[Any, Any]:
    last = INPUTS + 4
    ranks = [*RANKS.values()][:INPUTS]
    ranks += [1, 2, 1, 1]  # the state, and the gradients by force, torsion and multipliers
    tensors = _in_front(args[:last], in_dims[:last], ranks, info.batch_size)
    gradients = _gradients(*tensors, *args[last:])
    needed = [(a, d) for a, d, w in zip(args, in_dims, args[last], strict=False) if w]
    shapes = [a.shape if d is None else a.movedim(d, 0).shape[1:] for a, d in needed]
    shaped = [
        g.reshape(info.batch_size, *shape) for g, shape in zip(gradients, shapes, strict=True)
    ]
    return (
        (tuple(shaped), (0,) * len(shaped))
        if isinstance(gradients, tuple)
        else (shaped, [0] * len(shaped))
    )


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:INPUTS], output[4])
    ctx.elastic = inputs[_TENSORS] == "elastic"
    ctx.chunk = inputs[_TENSORS + 3]
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[3], output[4])


def _backward(ctx: Any, *losses: Any) -> tuple[Any, ...]:
    *tensors, state = ctx.saved_tensors
    needed = [a is not None and n for a, n in zip(tensors, ctx.needs_input_grad, strict=False)]
    return (*_needed_gradients(ctx, tensors, state, losses, needed), None, None, None, None, None)


def _needed_gradients(
    ctx: Any, tensors: Any, state: Tensor, losses: Any, needed: list[bool]
) -> list[Tensor | None]:
    """Differentiate by the operator, which refuses a second differentiation."""
    gradients = iter(_gradients(*tensors, state, *losses[:3], needed, ctx.elastic, ctx.chunk))
    return [next(gradients) if w else None for w in needed]


def _no_second(ctx: Any, *_: Any) -> NoReturn:
    raise UnsupportedProblemError(
        "grasp_force has first derivatives only: take second ones by differences of its gradients"
    )


_ARGUMENTS = ", ".join(f"Tensor{'' if name in NEEDED else '?'} {name}" for name in NAMES[:INPUTS])
SOLVE = torch.library.custom_op(
    "policies::grasp_force",
    _solve_impl,
    mutates_args=(),
    schema=f"({_ARGUMENTS}, Tensor? start, str infeasible, float tolerance, int max_iterations, int chunk)"
    " -> (Tensor, Tensor, Tensor, Tensor, Tensor)",
)
GRADIENTS = torch.library.custom_op(
    "policies::grasp_force_gradients",
    _gradients_impl,
    mutates_args=(),
    schema=f"({_ARGUMENTS}, Tensor state, Tensor? d_force, Tensor? d_torsion, Tensor? d_multipliers,"
    " bool[] needed, bool elastic, int chunk) -> Tensor[]",
)
SOLVE.register_fake(_solve_fake)
SOLVE.register_vmap(_solve_vmap)
SOLVE.register_autograd(_backward, setup_context=_setup)
GRADIENTS.register_fake(_gradients_fake)
GRADIENTS.register_vmap(_gradients_vmap)
GRADIENTS.register_autograd(_no_second)


def solve(*args: Any) -> Solved:
    """Solve; `args` are the operator's arguments."""
    return _call(SOLVE, _SolveFunction, *args)


def _gradients(*args: Any) -> Any:
    return _call(GRADIENTS, _GradientsFunction, *args)


def _call(operator: Any, function: Any, *args: Any) -> Any:
    """Call an operator, or in eager code that differentiates its autograd function.

    The function costs a fifth of the operator's own autograd kernel, and `torch.func.grad` requires
    it.
    """
    # an autograd function refuses forward mode
    differentiated = torch.is_grad_enabled() or forward_ad._current_level >= 0
    if differentiated and not torch.compiler.is_compiling():
        return function.apply(*args)
    return operator(*args)


class _SolveFunction(torch.autograd.Function):
    forward = staticmethod(SOLVE)
    setup_context = staticmethod(_setup)  # type: ignore[assignment]
    backward = staticmethod(_backward)
    vmap = staticmethod(_solve_vmap)  # type: ignore[assignment]


class _GradientsFunction(torch.autograd.Function):
    forward = staticmethod(lambda *args: tuple(GRADIENTS(*args)))  # type: ignore[assignment]
    setup_context = staticmethod(lambda ctx, inputs, output: None)  # type: ignore[assignment]
    backward = staticmethod(_no_second)
    vmap = staticmethod(_gradients_vmap)  # type: ignore[assignment]


class InPlace(torch.autograd.Function):
    """The fast path for inputs that the core reads in place, without the cost of operators."""

    @staticmethod
    def forward(
        ctx: Any, problems: core.ForceProblems, settings: tuple[Any, ...], *inputs: Any
    ) -> Any:
        """Return force, torsion, multipliers and facts."""
        *answers, state = optima(problems, *settings[1:])
        tensors = [a if isinstance(a, Tensor) else None for a in inputs[:INPUTS]]
        ctx.save_for_backward(*tensors, state)
        ctx.numbers = [None if isinstance(a, Tensor) else a for a in inputs[:INPUTS]]
        ctx.elastic = settings[0] == "elastic"
        ctx.chunk = settings[3]
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(answers[3])
        return tuple(answers)

    @staticmethod
    def backward(ctx: Any, *losses: Any) -> Any:
        """Return the gradients with respect to the arguments of `forward`."""
        *tensors, state = ctx.saved_tensors
        inputs = tuple([b if a is None else a for a, b in zip(tensors, ctx.numbers, strict=True)])
        needed = ctx.needs_input_grad[2 : 2 + INPUTS]
        problems = None if torch.is_grad_enabled() else read_in_place(inputs)
        # the start may have had more dimensions
        if problems is None or problems.lead != state.shape[:-1]:
            checked, _ = checked_tensors((*inputs, None))
            gradients = _needed_gradients(ctx, checked[:-1], state, losses, list(needed))
        else:
            gradients = _differentiate(problems, state, losses[:3], needed, ctx.elastic, ctx.chunk)
        # one coefficient per contact
        if gradients[2] is not None and gradients[2].shape[-2:] != inputs[2].shape[-2:]:
            gradients[2] = gradients[2].sum(-1)
        return (
            None,
            None,
            *[g if g is None else _as_input(g, a) for g, a in zip(gradients, inputs, strict=True)],
            None,
        )
