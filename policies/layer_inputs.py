"""Inputs of the force layer: their names, shapes, checks and devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from grasp_env.core import LARGEST
from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import choice, positive, whole
from grasp_env.inputs.extras import need
from grasp_env.inputs.ranges import CONTACTS, ITERATIONS, JOINTS, TOLERANCE

with need("layer"):
    import torch
    from torch import Tensor

MODES = ("mask", "elastic", "raise")
"""Values of `infeasible`."""
RANKS = {
    "positions": 2,
    "normals": 2,
    "friction": 2,
    "tangents": 2,
    "torsional_friction": 1,
    "wrench": 1,
    "jacobian": 3,
    "torque_limit": 1,
    "torque_bias": 1,
    "min_normal": 1,
    "max_normal": 1,
    "force_weight": 1,
    "barrier_weight": 1,
    "start": 2,
}
"""Number of trailing dimensions of each tensor that belong to one problem, not to the batch."""
NAMES = tuple(RANKS)
ALL_RANKS = RANKS | {"friction_margin": 0, "preload": 1}
"""Those of a problem and of its margin, which may follow it."""
ALL_NAMES = tuple(ALL_RANKS)
NEEDED = (
    "positions",
    "normals",
    "friction",
    "wrench",
    "force_weight",
    "barrier_weight",
    "friction_margin",
)
INPUTS = len(NAMES) - 1
"""Number of differentiable inputs: all but the start."""
SCALARS = (
    "friction",
    "torsional_friction",
    "torque_limit",
    "torque_bias",
    "min_normal",
    "max_normal",
    "force_weight",
    "barrier_weight",
    "friction_margin",
    "preload",
)
"""Inputs that may be a number."""
FLOATS = (torch.float64, torch.float32, torch.float16, torch.bfloat16)


def checked_settings(
    infeasible: str, tolerance: float, max_iterations: int, chunk: int
) -> tuple[str, float, int, int]:
    """Return the settings of a call, in the order of the operators' arguments."""
    max_iterations = whole(max_iterations, "max_iterations", 0, ITERATIONS)
    chunk = whole(chunk, "chunk", 1)
    return (
        choice(infeasible, "infeasible", MODES),
        positive(tolerance, "tolerance", TOLERANCE),
        max_iterations,
        chunk,
    )


def tails_of(count: int, rows: int, joints: int) -> tuple[tuple[int, ...], ...]:
    """Return the trailing dimensions of each input."""
    n = (count,)
    n3 = (count, 3)
    j = (joints,)
    return n3, n3, (count, 2), n3, n, (6,), (count, rows, joints), j, j, n, n, n, n, n3, (), n


def checked_tensors(inputs: Sequence[Any]) -> tuple[list[Tensor | None], torch.dtype]:
    """Return the inputs as tensors with their full trailing dimensions, and the results' dtype."""
    positions = inputs[0]
    jacobian = inputs[6]
    if (
        not isinstance(positions, Tensor)
        or positions.ndim < 2
        or not 1 <= positions.shape[-2] <= CONTACTS
    ):
        _refuse("positions", positions, f"a tensor (..., N, 3) of 1 to {CONTACTS} contacts")
    rows, joints = 3, 0
    if jacobian is not None:
        if (
            not isinstance(jacobian, Tensor)
            or jacobian.ndim < 3
            or not 1 <= jacobian.shape[-1] <= JOINTS
        ):
            _refuse("jacobian", jacobian, f"a tensor (..., N, 3 or 6, J) of 1 to {JOINTS} joints")
        rows = 6 if jacobian.shape[-2] == 6 else 3
        joints = jacobian.shape[-1]
    if (jacobian is None) != (inputs[7] is None) or (jacobian is None and inputs[8] is not None):
        raise InvalidInputError(
            "torque limits need jacobian and torque_limit together; torque_bias belongs to them"
        )
    contacts = positions.shape[-2:-1]
    dtype = torch.float32
    out: list[Tensor | None] = []
    tails = tails_of(contacts[0], rows, joints)
    for a, tail, name in zip(inputs, tails, ALL_NAMES, strict=False):
        if a is None:
            if name in NEEDED:
                _refuse(name, a, "given")
        elif not isinstance(a, Tensor):
            if name not in SCALARS or type(a) not in (float, int):
                _refuse(name, a, "a tensor or a number" if name in SCALARS else "a tensor")
            if type(a) is int and abs(a) > LARGEST:
                _refuse(name, a, f"at most {LARGEST:g}")
            a = torch.full(tail, float(a), dtype=torch.float64, device=positions.device)
        else:
            if a.dtype is not dtype:
                if a.dtype not in FLOATS:
                    _refuse(name, a, "of a floating-point type")
                if a.ndim:
                    dtype = torch.promote_types(dtype, a.dtype)
            if a.shape[a.ndim - len(tail) :] != tail:
                if a.ndim == 0 and name in SCALARS:
                    a = a.expand(tail)
                elif name == "friction" and a.shape[-1:] == contacts:
                    a = a.unsqueeze(-1).expand(*a.shape, 2)
                else:
                    _refuse(name, a, f"of shape (..., {', '.join(map(str, tail))})")
        out.append(a)
    return out, dtype


def _refuse(name: str, value: Any, expected: str) -> NoReturn:
    small = isinstance(value, Tensor) and value.numel() <= 36
    shape = f" of shape {tuple(value.shape)}" if small else ""
    raise InvalidInputError(f"{name} must be {expected}, got {shown(value)}{shape}")


def common_device(inputs: Sequence[Any]) -> torch.device:
    """Return the device of all tensors."""
    device = getattr(inputs[0], "device", torch.device("cpu"))
    for a, name in zip(inputs, ALL_NAMES, strict=False):
        if isinstance(a, Tensor) and a.device != device:
            devices = f"positions on {device} and {name} on {a.device}"
            raise InvalidInputError(f"all tensors must be on one device, got {devices}")
    return device


def common_lead(tensors: Sequence[Tensor | None]) -> torch.Size:
    """Return the common leading dimensions of the tensors, in the order of `ALL_NAMES`."""
    pairs = zip(tensors, ALL_RANKS.values(), strict=False)
    leads = [a.shape[: a.ndim - rank] for a, rank in pairs if a is not None]
    try:
        return torch.broadcast_shapes(*leads)
    except RuntimeError:
        pairs = zip(ALL_NAMES, tensors, strict=False)
        shapes = ", ".join(f"{name} {tuple(a.shape)}" for name, a in pairs if a is not None)
        raise InvalidInputError(f"leading dimensions must broadcast, got {shapes}") from None
