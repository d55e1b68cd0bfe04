"""Optimal grasp forces as a layer of a torch model, with gradients with respect to all inputs.

The optimal force is a smooth function of contacts, friction, wrench, limits and weights. Its gradient costs one linear solve with the
matrix of the last Newton step (implicit differentiation). The compiled core solves tensors on the CPU, in vector registers and on
`torch.get_num_threads()` threads; `policies.batched_newton` solves tensors on other devices. All internal numbers are float64.

The file is long because the public function, its two torch operators and their rules for autograd and `vmap` depend on each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, NoReturn, TypeAlias

import numpy as np

from grasp_env import core
from grasp_env._check import choice, positive, whole
from grasp_env._extras import need
from grasp_env.core import LARGEST
from grasp_env.errors import InfeasibleWrenchError, InvalidInputError, UnsupportedProblemError, shown
from grasp_env.force.many import over_parts
from grasp_env.ranges import CONTACTS, ITERATIONS, JOINTS, TOLERANCE

with need("layer"):
    import torch
    from torch import Tensor, nn
    from torch.autograd import forward_ad

from policies import batched_newton
from policies.batched_newton import Inputs

MODES = ("mask", "elastic", "raise")
"""Values of `infeasible`."""
PART = 512
"""Number of elements that a thread solves at a time on the CPU."""
STATUS = {
    3: "no force inside the friction cones balances the wrench",
    4: "an input is not finite, out of range, or a zero vector where a direction is needed",
    5: "no force is within the limits",
    6: "the grasp matrix has a rank below 6, or all contacts are at one point",
    7: "no force inside the friction cones was found",
}
"""Reasons why an element has no optimum, by status."""

Given: TypeAlias = "Tensor | float"
_PROBLEM_RANKS = {
    "positions": 2, "normals": 2, "friction": 2, "tangents": 2, "torsional_friction": 1, "wrench": 1, "jacobian": 3, "torque_limit": 1,
    "torque_bias": 1, "min_normal": 1, "max_normal": 1, "force_weight": 1, "barrier_weight": 1, "start": 2,
}  # fmt: skip
"""Number of trailing dimensions of each input tensor that belong to one problem. The dimensions before them are the batch."""
_Solved: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
_NAMES, _RANKS = tuple(_PROBLEM_RANKS), tuple(_PROBLEM_RANKS.values())
_TENSORS = len(_NAMES)
_INPUTS = len(Inputs._fields)  # all but the start
_ANSWER_RANKS = (1, 2, 1, 1)  # ranks of the state and of the gradients by force, torsion and multipliers
_NEEDED = ("positions", "normals", "friction", "wrench", "force_weight", "barrier_weight")
_SCALARS = (
    "friction", "torsional_friction", "torque_limit", "torque_bias", "min_normal", "max_normal", "force_weight", "barrier_weight",
)  # fmt: skip
_PLAIN = (Tensor, nn.Parameter)  # no derived classes
_FLOATS = (torch.float64, torch.float32, torch.float16, torch.bfloat16)


class GraspForces(NamedTuple):
    """Optimal forces of a batch. `force`, `torsion` and `multipliers` carry gradients.

    An element without an optimum still has a finite force. Except for status 4, this elastic force is strictly inside the friction cones:

    - Status 5, no force within the limits: the force is balanced. It minimises Phi with a quadratic penalty on limits that are nearly
      reached or exceeded.
    - Status 3, 6 and 7, no balanced force was found: the force minimises the same function plus |G f + w|^2 / (2 * 0.01 N^2). Moments are
      divided by the contacts' spread, which is the root mean square of their distances from their centre.
    - Status 4, invalid inputs: the force is zero.

    Elastic forces are solved until their steps are rounding. One that does not get there, with steps above 1e-6 of the force, has the
    gradient zero.

    Attributes:
        force: (..., N, 3) in the frame of the positions [N].
        torsion: (..., N) moment about each normal [N m]; 0 where a contact is not soft.
        multipliers: (..., 6) Lagrange multipliers nu of the balance G f + w = 0: grad Phi = G^T nu, and d (min Phi) / d wrench = -nu.
        status: (...) int64: 0 optimal, 1 iteration limit, 2 stalled (balanced, but the gap is above the tolerance), 3 infeasible,
            4 invalid inputs, 5 limits exceeded, 6 all contacts at one point (on a GPU: rank of the grasp matrix below 6), 7 undecided.
        gap: (...) certified relative distance of Phi to its minimum; inf without an optimum.
        residual: (...) largest component of G f + w, with moments divided by the contacts' spread [N].
        iterations: (...) int64, accepted Newton steps.
        feasible: (...) bool, True if the force balances the wrench within cones and limits: status 0, 1 or 2.
    """

    force: Tensor
    torsion: Tensor
    multipliers: Tensor
    status: Tensor
    gap: Tensor
    residual: Tensor
    iterations: Tensor
    feasible: Tensor


def grasp_force(
    positions: Tensor, normals: Tensor, friction: Given, wrench: Tensor, *,
    tangents: Tensor | None = None, torsional_friction: Given | None = None, jacobian: Tensor | None = None,
    torque_limit: Given | None = None, torque_bias: Given | None = None, min_normal: Given | None = None, max_normal: Given | None = None,
    force_weight: Given = 1.0, barrier_weight: Given = 0.01, start: Tensor | None = None,
    infeasible: str = "mask", tolerance: float = 1e-10, max_iterations: int = 200, chunk: int | None = None,
) -> GraspForces:  # fmt: skip
    """Return the force of least Phi that balances each wrench, differentiable with respect to all tensors but `start`.

    Leading dimensions broadcast. All vectors are given in one frame of the caller's choice, and forces are returned in it. The result of an
    element does not depend on other elements: on the CPU it has the same bits as in a batch of one.

    Outputs have the promoted dtype of all inputs that are not 0-d, but at least float32. A number or a 0-d tensor holds for all contacts
    or joints.

    Tangential components are along o and t. o is the projection of `tangents` on the tangent plane, and t = normal x o.

    Args:
        positions: (..., N, 3) contact points [m].
        normals: (..., N, 3) inward normals of any length.
        friction: coefficients >= 0, (..., N), or (..., N, 2) along o and t; 0 is a frictionless contact. For N = 2, a shape that ends in
            (2, 2) is read as two coefficients per contact, not as a batch of two.
        wrench: (..., 6) external wrench ON the object [N, N m], moments about the origin: G f + w = 0.
        tangents: (..., N, 3) directions that define o; None: the default frames.
        torsional_friction: (..., N) gamma [m], abs(torsion) <= gamma * normal force; 0 is a hard contact.
        jacobian: (..., N, 3, J) from joint speeds to velocities of the contact points, or (..., N, 6, J) with angular velocities as well.
        torque_limit: (..., J) [N m]: abs(J^T f + torque_bias) <= torque_limit; inf: no limit.
        torque_bias: (..., J) joint torques that do not come from the grasp [N m].
        min_normal, max_normal: (..., N) limits of normal forces [N]; 0 and inf: none.
        force_weight, barrier_weight: (..., N) omega [-] and lambda [N^2] of Phi.
        start: (..., N, 3) force of an earlier result, used as a warm start if it is near; its gradient is zero.
        infeasible: what to do with elements without an optimum. "mask": return the elastic force (see `GraspForces`) with zero gradient.
            "elastic": return it with its gradient, which is zero if the force has not converged. "raise": raise an InfeasibleWrenchError
            that names the elements.
        tolerance: relative certified gap at which the solver stops.
        max_iterations: largest number of Newton steps.
        chunk: number of elements that are solved at a time; the results do not depend on it. None: all on a GPU, else 512 per thread.

    Raises:
        InvalidInputError: shapes, types or devices do not fit.
        UnknownNameError: `infeasible` has another value.
        InfeasibleWrenchError: elements have no optimum, with `infeasible="raise"`.

    Example:
        >>> import torch
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> positions, normals = torch.tensor(grasp.positions), torch.tensor(grasp.normals)
        >>> friction = torch.tensor(0.4, requires_grad=True)
        >>> wrench = torch.tensor([[1, 0.5, -0.6, -0.1, 0.2, 0], [0, 0, -2, 0, 0, 0]])    # two loads on one grasp
        >>> result = grasp_force(positions, normals, friction, wrench)
        >>> result.force.shape, result.feasible.tolist()
        (torch.Size([2, 4, 3]), [True, True])
        >>> result.force.norm(dim=-1).sum().backward()
        >>> friction.grad < 0                                                            # more friction, less force
        tensor(True)
    """
    settings = _settings(infeasible, tolerance, max_iterations, chunk)
    given = (
        positions, normals, friction, tangents, torsional_friction, wrench, jacobian, torque_limit, torque_bias,
        min_normal, max_normal, force_weight, barrier_weight, start,
    )  # fmt: skip
    problems = _read_in_place(given)
    if problems is None:
        tensors, dtype = _checked_tensors(given)
        force, torsion, multipliers, facts, _ = _call(_solve, _SolveFunction, *tensors, *settings)
    else:  # fast path: the core reads the inputs without a copy
        dtype = torch.float32 if problems.float32 else torch.float64
        if torch.is_grad_enabled() and any(a.requires_grad for a in given if isinstance(a, Tensor)):
            answers = _EagerFunction.apply(problems, settings, *given)
        else:
            answers = _optima(problems, *settings[1:])
        force, torsion, multipliers, facts = answers[:4]
        if infeasible == "raise":
            _raise_for(facts[..., 0], problems.lead)
    status, gap, residual, iterations = facts.unbind(-1)
    if dtype is not torch.float64:
        force, torsion, multipliers, gap, residual = (a.to(dtype) for a in (force, torsion, multipliers, gap, residual))
    feasible = status <= float(batched_newton.STALLED)
    return GraspForces(force, torsion, multipliers, status.long(), gap, residual, iterations.long(), feasible)


class GraspForceLayer(nn.Module):
    """`grasp_force` as a module that holds the settings. `forward` takes the tensors under the same names.

    It has no parameters. Copies, pickles and workers of a DataLoader carry only the settings.

    Args:
        infeasible, tolerance, max_iterations, chunk: see `grasp_force`.

    Example:
        >>> import torch
        >>> from grasp_env.grasp import presets
        >>> layer, grasp = GraspForceLayer(), presets.tripod()
        >>> positions = torch.tensor(grasp.positions, requires_grad=True)
        >>> result = layer(positions, torch.tensor(grasp.normals), 0.5, torch.tensor([0.0, 0, -2, 0, 0, 0]), max_normal=10.0)
        >>> result.force.square().sum().backward()
        >>> positions.grad.shape
        torch.Size([3, 3])
    """

    def __init__(
        self, infeasible: str = "mask", tolerance: float = 1e-10, max_iterations: int = 200, chunk: int | None = None
    ) -> None:
        super().__init__()
        settings = _settings(infeasible, tolerance, max_iterations, chunk)
        self.infeasible, self.tolerance, self.max_iterations, self.chunk = settings

    def extra_repr(self) -> str:
        """Return the settings for the module's repr."""
        return f"infeasible={self.infeasible!r}, tolerance={self.tolerance:g}, max_iterations={self.max_iterations}, chunk={self.chunk}"

    def forward(
        self, positions: Tensor, normals: Tensor, friction: Given, wrench: Tensor, **others: Any
    ) -> GraspForces:
        """Return the optimal forces.

        Args:
            positions, normals, friction, wrench: see `grasp_force`.
            others: keyword arguments of `grasp_force` for tensors: tangents, limits, weights, start.
        """
        return grasp_force(
            positions, normals, friction, wrench, **others, infeasible=self.infeasible, tolerance=self.tolerance,
            max_iterations=self.max_iterations, chunk=self.chunk,
        )  # fmt: skip


# --- arguments


def _settings(infeasible: str, tolerance: float, max_iterations: int, chunk: int | None) -> tuple[Any, ...]:
    max_iterations = whole(max_iterations, "max_iterations", 0, ITERATIONS)
    chunk = chunk if chunk is None else whole(chunk, "chunk", 1)
    return choice(infeasible, "infeasible", MODES), positive(tolerance, "tolerance", TOLERANCE), max_iterations, chunk


def _refuse(name: str, given: Any, wanted: str) -> NoReturn:
    shape = f" of shape {tuple(given.shape)}" if isinstance(given, Tensor) and given.numel() <= 36 else ""
    raise InvalidInputError(f"{name} must be {wanted}, got {shown(given)}{shape}")


def _checked_tensors(given: tuple[Any, ...]) -> tuple[list[Tensor | None], torch.dtype]:
    """Return the input tensors, each with the trailing dimensions of one problem, and the dtype of the results."""
    positions, jacobian = given[0], given[6]
    if not isinstance(positions, Tensor) or positions.ndim < 2 or not 1 <= positions.shape[-2] <= CONTACTS:
        _refuse("positions", positions, f"a tensor (..., N, 3) of 1 to {CONTACTS} contacts")
    rows, joints = 3, 0
    if jacobian is not None:
        if not isinstance(jacobian, Tensor) or jacobian.ndim < 3 or not 1 <= jacobian.shape[-1] <= JOINTS:
            _refuse("jacobian", jacobian, f"a tensor (..., N, 3 or 6, J) of 1 to {JOINTS} joints")
        rows, joints = (6 if jacobian.shape[-2] == 6 else 3), jacobian.shape[-1]
    if (jacobian is None) != (given[7] is None) or (jacobian is None and given[8] is not None):
        raise InvalidInputError("torque limits need jacobian and torque_limit together; torque_bias belongs to them")
    n, device, dtype = positions.shape[-2:-1], positions.device, torch.float32
    out: list[Tensor | None] = []
    for a, tail, name in zip(given, _input_tails(n[0], rows, joints), _NAMES, strict=True):
        if a is None:
            if name in _NEEDED:
                _refuse(name, a, "given")
        elif not isinstance(a, Tensor):
            if name not in _SCALARS or type(a) not in (float, int):
                _refuse(name, a, "a tensor or a number" if name in _SCALARS else "a tensor")
            if type(a) is int and abs(a) > LARGEST:
                _refuse(name, a, f"at most {LARGEST:g}")
            a = torch.full(tail, float(a), dtype=torch.float64, device=device)
        else:
            if a.device != device:
                told = f"positions on {device} and {name} on {a.device}"
                raise InvalidInputError(f"all tensors must be on one device, got {told}")
            if a.dtype is not dtype:
                if a.dtype not in _FLOATS:
                    _refuse(name, a, "of a floating-point type")
                if a.ndim:
                    dtype = torch.promote_types(dtype, a.dtype)
            if a.shape[-len(tail) :] != tail:
                if a.ndim == 0 and name in _SCALARS:
                    a = a.expand(tail)
                elif name == "friction" and a.shape[-1:] == n:
                    a = a.unsqueeze(-1).expand(*a.shape, 2)
                else:
                    _refuse(name, a, f"of shape (..., {', '.join(map(str, tail))})")
        out.append(a)
    return out, dtype


def _input_tails(count: int, rows: int, joints: int) -> tuple[tuple[int, ...], ...]:
    """Return the trailing dimensions of the input tensors, those of one problem."""
    n, n3, j = (count,), (count, 3), (joints,)
    return n3, n3, (count, 2), n3, n, (6,), (count, rows, joints), j, j, n, n, n, n, n3


# --- the core


def _read_in_place(given: Sequence[Any]) -> core.ForceProblems | None:
    """Return the problems if the core can read the inputs in place; None if torch's operators must convert them."""
    if (
        not _CORE
        or torch.compiler.is_compiling()
        or torch._C._are_functorch_transforms_active()
        or torch._C._len_torch_dispatch_stack()
        or forward_ad._current_level >= 0
    ):
        return None
    for a in given:
        if type(a) in _PLAIN:
            if a.is_neg():
                return None
        elif a is not None and type(a) not in (float, int):
            return None
    return _of(given)


def _read(tensors: Sequence[Tensor | None]) -> core.ForceProblems:
    """Return the core's view of tensors on the CPU; before torch 2.10 they are read as arrays."""
    return _of(tensors) or _of([a if a is None else a.numpy() for a in tensors])


def _of(given: Sequence[Any]) -> Any:
    """Return `ForceProblems`, or None if the core cannot read them."""
    return core.ForceProblems.of(tuple(given), CONTACTS, JOINTS)


def _optima(problems: core.ForceProblems, tolerance: float, max_iterations: int, chunk: int | None) -> _Solved:
    """Return the tensors of `batched_newton.Solved` for all problems."""
    arrays = [np.empty((*problems.lead, *tail)) for tail in batched_newton.tails(problems.contacts)]
    force, torsion, multipliers, facts, state = arrays

    def work(part: slice) -> None:
        problems.solve(part.start, part.stop, tolerance, max_iterations, force, torsion, multipliers, facts, state)

    over_parts(work, problems.size, chunk or PART, torch.get_num_threads())
    return tuple([torch.from_numpy(a) for a in arrays])  # type: ignore[return-value]


def _slopes(
    problems: core.ForceProblems, state: Tensor, losses: Sequence[Tensor | None], wanted: Sequence[bool], elastic: bool, chunk: int | None
) -> list[Tensor | None]:  # fmt: skip
    """Return gradients with respect to the inputs."""
    tails = _input_tails(problems.contacts, problems.jacobian_rows, problems.joints)
    arrays = tuple([np.empty((*problems.lead, *tail)) if w else None for w, tail in zip(wanted, tails, strict=False)])
    at, by_force, by_torsion, by_multipliers = [a if a is None else _array(a) for a in (state, *losses)]

    def work(part: slice) -> None:
        problems.differentiate(part.start, part.stop, at, by_force, by_torsion, by_multipliers, elastic, arrays)

    over_parts(work, problems.size, chunk or PART, torch.get_num_threads())
    return [a if a is None else torch.from_numpy(a) for a in arrays]


def _array(a: Tensor) -> Any:
    """Return a contiguous array; an unnecessary conversion would take 0.7 us."""
    return (a if a.dtype is torch.float64 else a.to(torch.float64)).contiguous().resolve_neg().numpy()


# --- the operators: inputs have leading dimensions that broadcast, and gradients have the shapes of the inputs


def _lead(tensors: Sequence[Tensor | None]) -> torch.Size:
    """Return the common leading dimensions of the input tensors."""
    leads = [a.shape[: a.ndim - rank] for a, rank in zip(tensors, _RANKS, strict=False) if a is not None]
    first, *others = [lead for lead in leads if len(lead)] or [torch.Size()]
    try:
        return first if all(lead == first for lead in others) else torch.broadcast_shapes(*leads)
    except RuntimeError:
        told = ", ".join(f"{name} {tuple(a.shape)}" for name, a in zip(_NAMES, tensors, strict=False) if a is not None)
        raise InvalidInputError(f"leading dimensions must broadcast, got {told}") from None


def _flattened(tensors: Sequence[Any], ranks: Sequence[int], lead: torch.Size) -> list[Any]:
    """Return (batch, ...) float64 tensors; shared inputs are not copied if there is one leading dimension, and None stays None."""
    made = []
    for a, rank in zip(tensors, ranks, strict=True):
        if a is not None:
            tail = a.shape[a.ndim - rank :]
            a = a.detach().to(torch.float64).expand(*lead, *tail).reshape(lead.numel(), *tail)
        made.append(a)
    return made


def _in_core(a: Tensor) -> bool:
    return a.device.type == "cpu" and _CORE


def _parts(batch: int, chunk: int | None, *groups: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
    """Yield slices, each with that part of the tensors of every group; None stays None."""
    size = chunk or max(batch, 1)
    for part in (slice(k, k + size) for k in range(0, batch, size)):
        yield part, *(tuple([a if a is None else a[part] for a in group]) for group in groups)


def _solve_impl(*args: Any) -> _Solved:
    tensors, (infeasible, tolerance, max_iterations, chunk) = args[:_TENSORS], args[_TENSORS:]
    lead, count = _lead(tensors), tensors[0].shape[-2]
    batch = lead.numel()
    given = _flattened(tensors, _RANKS, lead)
    if batch and _in_core(tensors[0]):
        out: Any = _optima(_read(given), tolerance, max_iterations, chunk)
    else:
        out = _empty(tensors[0], (batch,), count)
        for part, (*mine, start) in _parts(batch, chunk, given):
            found = batched_newton.solve(Inputs(*mine), tolerance, max_iterations, start)
            for a, b in zip(out, found, strict=True):
                a[part] = b
    out = tuple([a if len(lead) == 1 else a.reshape(*lead, *a.shape[1:]) for a in out])
    if infeasible == "raise":
        _raise_for(out[3][..., 0], lead)
    return out


def _empty(like: Tensor, lead: Sequence[int], count: int) -> _Solved:
    return tuple(like.new_empty((*lead, *tail), dtype=torch.float64) for tail in batched_newton.tails(count))  # type: ignore[return-value]


def _raise_for(status: Tensor, lead: Sequence[int]) -> None:
    status = status.reshape(-1)
    lost = status > batched_newton.STALLED
    places = lost.reshape(lead).nonzero().tolist()
    if not places:
        return
    told = [
        f"{k[0] if len(k) == 1 else tuple(k) or 'the only one'}: {STATUS[int(code)]}"
        for k, code in zip(places[:5], status[lost][:5], strict=True)
    ]
    if len(places) > 5:
        told.append(f"and {len(places) - 5} more")
    raise InfeasibleWrenchError(
        f"{len(places)} of {len(status)} elements have no optimal force ({', '.join(told)}): infeasible='mask' gives them the nearest "
        "force without a gradient, 'elastic' with one"
    )


def _gradients_impl(*args: Any) -> list[Tensor]:
    tensors, answers, (wanted, elastic, chunk) = args[:_INPUTS], args[_INPUTS:-3], args[-3:]
    lead = answers[0].shape[:-1]  # the lead of all tensors
    batch = lead.numel()
    given = _flattened(tensors, _RANKS[:_INPUTS], lead)
    made: Any = _flattened(answers, _ANSWER_RANKS, lead)
    if batch and _in_core(made[0]):
        found: Any = _slopes(_read(given), made[0], made[1:], wanted, elastic, chunk)
    else:
        found = [a.new_empty(a.shape) if a is not None and w else None for a, w in zip(given, wanted, strict=True)]
        like = _empty(made[0], (batch,), tensors[0].shape[-2])
        made[1:] = [torch.zeros_like(a) if d is None else d for d, a in zip(made[1:], like, strict=False)]
        for part, mine, mine_made in _parts(batch, chunk, given, made):
            by = _differentiate(Inputs(*mine), *mine_made, elastic)
            for a, b in zip(found, by, strict=True):
                if a is not None:
                    a[part] = b
    return [_as_given(g.reshape(*lead, *g.shape[1:]), a) for g, a in zip(found, tensors, strict=True) if g is not None]


def _as_given(gradient: Tensor, like: Tensor) -> Tensor:
    """Return the gradient (lead, ...) in the shape and type of the input, summed over broadcast dimensions."""
    if gradient.shape != like.shape:
        gradient = gradient.sum_to_size(like.shape)
    return gradient if gradient.dtype is like.dtype else gradient.to(like.dtype)


def _differentiate(given: Inputs, *args: Any) -> Inputs:
    """Call `batched_newton.gradients` on another thread, because autograd records nothing on the thread that runs an operator."""
    module = torch.get_device_module(given.positions.device)
    stream = module.current_stream(given.positions.device)

    def work() -> Inputs:
        with module.stream(stream):
            return batched_newton.gradients(given, *args)

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


def _solve_fake(*args: Any) -> _Solved:
    return _empty(args[0], _lead(args[:_TENSORS]), args[0].shape[-2])


def _gradients_fake(*args: Any) -> list[Tensor]:
    wanted = [a for a, w in zip(args, args[_INPUTS + 4], strict=False) if w]
    return [torch.empty_like(a, memory_format=torch.contiguous_format) for a in wanted]


def _in_front(args: Sequence[Any], dims: Sequence[Any], ranks: Sequence[int], size: int) -> list[Any]:
    """Return tensors with the dimension of `vmap` in front, and equally many leading dimensions."""
    rank = max(a.ndim - (d is not None) - r for a, d, r in zip(args, dims, ranks, strict=True) if a is not None)
    out: list[Any] = []
    for a, d, r in zip(args, dims, ranks, strict=True):
        if a is not None:
            a = a.unsqueeze(0).expand(size, *a.shape) if d is None else a.movedim(d, 0)
            a = a.reshape(size, *(1,) * (rank - (a.ndim - 1 - r)), *a.shape[1:])
        out.append(a)
    return out


def _solve_vmap(info: Any, in_dims: Any, *args: Any) -> tuple[Any, Any]:
    tensors = _in_front(args[:_TENSORS], in_dims[:_TENSORS], _RANKS, info.batch_size)
    return _call(_solve, _SolveFunction, *tensors, *args[_TENSORS:]), (0,) * 5


def _gradients_vmap(info: Any, in_dims: Any, *args: Any) -> tuple[Any, Any]:
    last = _INPUTS + 4
    tensors = _in_front(args[:last], in_dims[:last], (*_RANKS[:_INPUTS], *_ANSWER_RANKS), info.batch_size)
    found = _call(_gradients, _GradientsFunction, *tensors, *args[last:])
    asked = [(a, d) for a, d, w in zip(args, in_dims, args[last], strict=False) if w]
    shapes = [a.shape if d is None else a.movedim(d, 0).shape[1:] for a, d in asked]
    made = [g.reshape(info.batch_size, *shape) for g, shape in zip(found, shapes, strict=True)]
    return (tuple(made), (0,) * len(made)) if isinstance(found, tuple) else (made, [0] * len(made))


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:_INPUTS], output[4])
    ctx.elastic, ctx.chunk = inputs[_TENSORS] == "elastic", inputs[_TENSORS + 3]
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[3], output[4])


def _backward(ctx: Any, *losses: Any) -> tuple[Any, ...]:
    *tensors, state = ctx.saved_tensors
    wanted = [a is not None and needed for a, needed in zip(tensors, ctx.needs_input_grad, strict=False)]
    return (*_wanted(ctx, tensors, state, losses, wanted), None, None, None, None, None)


def _wanted(ctx: Any, tensors: Any, state: Tensor, losses: Any, wanted: list[bool]) -> list[Tensor | None]:
    """Return gradients with respect to the wanted inputs by the operator, which refuses a second differentiation."""
    found = iter(_call(_gradients, _GradientsFunction, *tensors, state, *losses[:3], wanted, ctx.elastic, ctx.chunk))
    return [next(found) if w else None for w in wanted]


def _no_second(ctx: Any, *_: Any) -> NoReturn:
    raise UnsupportedProblemError(
        "grasp_force has first derivatives only: take second ones by differences of its gradients"
    )


_CORE = True
"""True if the core solves tensors on the CPU; tests change it."""

_ARGUMENTS = ", ".join(f"Tensor{'' if name in _NEEDED else '?'} {name}" for name in _NAMES[:_INPUTS])
_solve = torch.library.custom_op(
    "policies::grasp_force", _solve_impl, mutates_args=(),
    schema=f"({_ARGUMENTS}, Tensor? start, str infeasible, float tolerance, int max_iterations, int? chunk) -> (Tensor, Tensor, Tensor, Tensor, Tensor)",
)  # fmt: skip
_gradients = torch.library.custom_op(
    "policies::grasp_force_gradients", _gradients_impl, mutates_args=(),
    schema=f"({_ARGUMENTS}, Tensor state, Tensor? d_force, Tensor? d_torsion, Tensor? d_multipliers, bool[] wanted, bool elastic, int? chunk) -> Tensor[]",
)  # fmt: skip
_solve.register_fake(_solve_fake)
_solve.register_vmap(_solve_vmap)
_solve.register_autograd(_backward, setup_context=_setup)
_gradients.register_fake(_gradients_fake)
_gradients.register_vmap(_gradients_vmap)
_gradients.register_autograd(_no_second)


def _call(operator: Any, function: Any, *args: Any) -> Any:
    """Call an operator. Eager code that differentiates calls the autograd function with the same rules instead.

    The function costs a fifth of the operator's own autograd kernel, and also supports `torch.func.grad`.
    """
    # an autograd function refuses forward mode
    differentiated = torch.is_grad_enabled() or forward_ad._current_level >= 0
    if differentiated and not torch.compiler.is_compiling():
        return function.apply(*args)
    return operator(*args)


class _SolveFunction(torch.autograd.Function):
    forward, setup_context = staticmethod(_solve), staticmethod(_setup)  # type: ignore[assignment]
    backward, vmap = staticmethod(_backward), staticmethod(_solve_vmap)  # type: ignore[assignment]


class _GradientsFunction(torch.autograd.Function):
    forward = staticmethod(lambda *args: tuple(_gradients(*args)))  # type: ignore[assignment]
    setup_context = staticmethod(lambda ctx, inputs, output: None)  # type: ignore[assignment]
    backward, vmap = staticmethod(_no_second), staticmethod(_gradients_vmap)  # type: ignore[assignment]


class _EagerFunction(torch.autograd.Function):
    """The fast path: forces of inputs that the core reads in place, without the overhead of operators and `torch.func`."""

    @staticmethod
    def forward(ctx: Any, problems: core.ForceProblems, settings: tuple[Any, ...], *given: Any) -> Any:
        *answers, state = _optima(problems, *settings[1:])
        tensors = [a if isinstance(a, Tensor) else None for a in given[:_INPUTS]]
        ctx.save_for_backward(*tensors, state)
        ctx.numbers = [None if isinstance(a, Tensor) else a for a in given[:_INPUTS]]
        ctx.elastic, ctx.chunk = settings[0] == "elastic", settings[3]
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(answers[3])
        return tuple(answers)

    @staticmethod
    def backward(ctx: Any, *losses: Any) -> Any:
        *tensors, state = ctx.saved_tensors
        given = tuple([b if a is None else a for a, b in zip(tensors, ctx.numbers, strict=True)])
        wanted = ctx.needs_input_grad[2 : 2 + _INPUTS]
        problems = None if torch.is_grad_enabled() else _read_in_place(given)
        if problems is None:
            known, _ = _checked_tensors((*given, None))
            found = _wanted(ctx, known[:-1], state, losses, list(wanted))
        else:
            found = _slopes(problems, state, losses[:3], wanted, ctx.elastic, ctx.chunk)
        if found[2] is not None and found[2].shape[-2:] != given[2].shape[-2:]:  # one coefficient per contact
            found[2] = found[2].sum(-1)
        return (None, None, *[g if g is None else _as_given(g, a) for g, a in zip(found, given, strict=True)], None)
