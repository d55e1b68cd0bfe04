"""A margin of optimal forces: a share of the friction, and a preload along the normals.

A margin m and preloads s give contact i the cone abs(t) / mu <= m (n - s_i), where n is its normal
force, and a soft contact the cone sqrt((abs(t) / mu)^2 + (torsion / gamma)^2) <= m (n - s_i). The
optimal force is f = g + s n_i, with n_i the unit normal and g the optimum of an ordinary problem:
its friction and torsional friction are m mu and m gamma, its wrench includes that of the preloads,
and its limits are those that the preloads leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from grasp_env.core import LARGEST
from grasp_env.errors import InvalidInputError, shown
from grasp_env.force.record import REFUSED, STALLED
from grasp_env.inputs.extras import need
from policies.layer_inputs import ALL_NAMES, NAMES, common_lead

with need("layer"):
    import torch
    from torch import Tensor

_COEFFICIENTS = ("friction", "torsional_friction")
_LEAST = 1e-150  # shorter normals are refused
_NO_GRADIENT = 0.0  # last number of the state of a force that has not converged


def with_margin(inputs: Sequence[Any], friction_margin: Any, preload: Any) -> Sequence[Any]:
    """Return the inputs, followed by their margin and preload unless friction alone has to change.

    Raises:
        InvalidInputError: a number is out of range.
    """
    preload = 0.0 if preload is None else preload
    numbers = _is_number(friction_margin), _is_number(preload)
    if numbers[0] and not 0.0 < friction_margin <= 1.0:
        raise InvalidInputError(
            f"friction_margin must be > 0 and at most 1, got {shown(friction_margin)}: "
            "0.8 leaves a fifth of the friction unused"
        )
    if numbers[1] and not 0.0 <= preload <= LARGEST:
        raise InvalidInputError(
            f"preload must be from 0 to {LARGEST:g} N, got {shown(preload)}: "
            "it is the size of a force along the inward normal, 0 is none"
        )
    if numbers[1] and preload > 0.0:
        most = inputs[NAMES.index("max_normal")]
        if _is_number(most) and preload >= most:
            raise InvalidInputError(
                f"preload must be below max_normal, got {shown(preload)} and {shown(most)}: "
                "lower preload or raise max_normal"
            )
    if not all(numbers) or preload > 0.0:
        return (*inputs, friction_margin, preload)
    if friction_margin == 1.0:
        return inputs
    return [
        _scaled(a, friction_margin) if name in _COEFFICIENTS else a
        for name, a in zip(NAMES, inputs, strict=True)
    ]


def _is_number(a: Any) -> bool:
    return type(a) in (float, int)


def _scaled(a: Any, by: float) -> Any:
    """Return a product in float32 at least; what is no coefficient is left to the checks."""
    if isinstance(a, Tensor) and a.is_floating_point():
        return a.to(torch.promote_types(a.dtype, torch.float32)) * by
    return a * by if _is_number(a) and abs(a) <= LARGEST else a


class Shift:
    """The ordinary problem of the force beyond the preload, and the way back.

    Args:
        tensors: inputs in the order of `ALL_NAMES`, with their full trailing dimensions.

    Attributes:
        problem: inputs of the ordinary problem, in the order of `NAMES`. An element whose margin or
            preload is out of range has a wrench of NaN, which the core refuses.
        force: (..., N, 3) force of the preload in the frame of the positions [N].
    """

    def __init__(self, tensors: Sequence[Tensor | None]) -> None:
        common_lead(tensors)
        # the order in which sums are added up depends on the strides, and so do the bits
        given: dict[str, Any] = {
            name: a if a is None else a.double().contiguous()
            for name, a in zip(ALL_NAMES, tensors, strict=True)
        }
        margin, preload = given["friction_margin"], given["preload"]
        low, high = given["min_normal"], given["max_normal"]
        sound_margin = (margin > 0.0) & (margin <= 1.0)
        sound = (preload >= 0.0) & (preload <= LARGEST)
        if high is not None:
            sound = sound & ((preload == 0.0) | (preload < high))
            given["max_normal"] = high - preload
        # NaN would spoil even the gradient zero of a refused element
        margin = torch.where(sound_margin, margin, 1.0)
        preload = torch.where(sound, preload, 0.0)
        normals = _finite(given["normals"])
        size = normals.square().sum(-1).clamp(min=_LEAST**2).sqrt()
        self.force = (preload / size).unsqueeze(-1) * normals
        arms, forces = torch.broadcast_tensors(_finite(given["positions"]), self.force)
        wrench = torch.cat([forces, torch.linalg.cross(arms, forces)], -1).sum(-2)
        refusal = torch.where(sound_margin & sound.all(-1), 0.0, torch.nan)
        given["wrench"] = given["wrench"] + wrench + refusal.unsqueeze(-1)
        given["friction"] = _share(given["friction"], margin[..., None, None])
        if given["torsional_friction"] is not None:
            given["torsional_friction"] = _share(given["torsional_friction"], margin[..., None])
        if given["jacobian"] is not None:
            moves = _finite(given["jacobian"][..., :3, :])
            torque = (moves * self.force.unsqueeze(-1)).sum((-3, -2))
            bias = given["torque_bias"]
            given["torque_bias"] = torque if bias is None else bias + torque
        if low is not None:  # one below zero stays, and is refused
            given["min_normal"] = torch.where(low < 0.0, low, (low - preload).clamp(min=0.0))
        if given["start"] is not None:
            given["start"] = given["start"] - self.force.detach()
        self.problem = [given[name] for name in NAMES]

    def back(self, force: Tensor, facts: Tensor, state: Tensor, infeasible: str) -> Tensor:
        """Return the force with the preload, which has a gradient where the given one has."""
        status = facts[..., 0]
        sloped = state[..., -1] != _NO_GRADIENT
        if infeasible != "elastic":
            sloped = sloped & (status <= float(STALLED))
        preloaded = torch.where(sloped[..., None, None], self.force, self.force.detach())
        return force + torch.where((status == float(REFUSED))[..., None, None], 0.0, preloaded)


def _finite(a: Tensor) -> Tensor:
    """Return a tensor with zeros where it is not finite, which the core refuses."""
    return a.nan_to_num(0.0, 0.0, 0.0)


def _share(a: Tensor, of: Tensor) -> Tensor:
    """Return a share of a tensor, whose entries stay where they are not finite."""
    return torch.where(a.isfinite(), of * _finite(a), a)
