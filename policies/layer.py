"""Optimal grasp forces as a layer of a torch model, with gradients for all inputs.

The optimal force is a smooth function of contacts, friction, wrench, limits and weights. Its
gradient costs one linear solve with the matrix of the last Newton step (implicit differentiation).
The compiled core computes both on the CPU: tensors on another device are copied there and back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

from grasp_env.force.record import STALLED
from grasp_env.inputs.extras import need
from policies.layer_inputs import NAMES, checked_settings, checked_tensors, common_device
from policies.layer_margin import Shift, with_margin
from policies.layer_operators import InPlace, optima, raise_for, read_in_place, solve

with need("layer"):
    import torch
    from torch import Tensor, nn

Given: TypeAlias = "Tensor | float"
_SOLVED_ON = ("cpu", "meta")
"""Devices whose tensors are not copied; tensors on `meta` have shapes only."""


class GraspForces(NamedTuple):
    """Optimal forces of a batch. `force`, `torsion` and `multipliers` carry gradients.

    An element without an optimum has an elastic force, strictly inside the friction cones:

    - Status 5, no force within the limits: the force is balanced. It minimises Phi with a quadratic
      penalty on limits that are nearly reached or exceeded.
    - Status 3, 6 and 7, no balanced force was found: the force minimises the same function plus |G
      f + w|^2 / (2 * 0.01 N^2). Moments are divided by the contacts' spread, the root mean square
      of their distances from their centre.
    - Status 4, invalid inputs: the force is zero.

    Elastic forces are solved until their steps are rounding. A force whose steps remain above 1e-6
    of it has a zero gradient.

    Attributes:
        force: (..., N, 3) in the frame of the positions [N].
        torsion: (..., N) moment about each normal [N m]; 0 where a contact is not soft.
        multipliers: (..., 6) Lagrange multipliers nu of the balance G f + w = 0: grad Phi = G^T nu,
            and d (min Phi) / d wrench = -nu.
        status: (...) int64: 0 optimal, 1 iteration limit, 2 stalled (balanced, but the gap is above
            the tolerance), 3 infeasible, 4 invalid inputs, 5 limits exceeded, 6 all contacts at one
            point, 7 undecided.
        gap: (...) certified relative distance of Phi to its minimum; inf without an optimum.
        residual: (...) largest component of G f + w, with moments divided by the contacts' spread
            [N].
        iterations: (...) int64, accepted Newton steps.
        feasible: (...) bool, True if the force is balanced within cones and limits: status 0 to 2.
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
    positions: Tensor,
    normals: Tensor,
    friction: Given,
    wrench: Tensor,
    *,
    tangents: Tensor | None = None,
    torsional_friction: Given | None = None,
    jacobian: Tensor | None = None,
    torque_limit: Given | None = None,
    torque_bias: Given | None = None,
    min_normal: Given | None = None,
    max_normal: Given | None = None,
    force_weight: Given = 1.0,
    barrier_weight: Given = 0.01,
    friction_margin: Given = 1.0,
    preload: Given | None = None,
    start: Tensor | None = None,
    infeasible: str = "mask",
    tolerance: float = 1e-10,
    max_iterations: int = 200,
    chunk: int = 512,
) -> GraspForces:
    """Return the force of least Phi that balances each wrench, with gradients.

    Leading dimensions broadcast. All vectors, results included, are in one frame of the caller's
    choice. The result of an element has the same bits as in a batch of one.

    Outputs have the promoted dtype of all inputs that are not 0-d, but at least float32. A number
    or a 0-d tensor holds for all contacts or joints. All tensors are on one device, as are outputs
    and gradients.

    Tangential components are along o and t. o is the projection of `tangents` on the tangent plane,
    and t = normal x o.

    A margin keeps each contact within abs(tangential force) / mu <= friction_margin * (normal force
    - preload), and a soft one within sqrt((abs(tangential force) / mu)^2 + (torsion / gamma)^2) <=
    friction_margin * (normal force - preload). Phi is that of the force beyond the preload. Phi of
    the whole force is larger by a constant, so its relative gap is at most `gap`. A `min_normal`
    that the preload reaches is no limit, so Phi has no barrier for it.

    Args:
        positions: (..., N, 3) contact points [m].
        normals: (..., N, 3) inward normals of any length.
        friction: coefficients >= 0, (..., N), or (..., N, 2) along o and t; 0 is a frictionless
            contact. For N = 2, a shape that ends in (2, 2) is read as two coefficients per contact,
            not as a batch of two.
        wrench: (..., 6) external wrench ON the object [N, N m], moments about the origin: G f + w =
            0.
        tangents: (..., N, 3) directions that define o; None: the default frames.
        torsional_friction: (..., N) gamma [m] of soft contacts, which keep sqrt((abs(tangential
            force) / mu)^2 + (torsion / gamma)^2) <= normal force; 0 is a hard contact.
        jacobian: (..., N, 3, J) from joint speeds to velocities of the contact points, or (..., N,
            6, J) with angular velocities as well.
        torque_limit: (..., J) [N m]: abs(J^T f + torque_bias) <= torque_limit; inf: no limit.
        torque_bias: (..., J) joint torques that do not come from the grasp [N m].
        min_normal, max_normal: (..., N) limits of normal forces [N]; 0 and inf: none.
        force_weight, barrier_weight: (..., N) omega [-] and lambda [N^2] of Phi.
        friction_margin: (...) share of the friction that may be used, > 0 and at most 1. A number
            or a 0-d tensor holds for all elements.
        preload: (..., N) normal force [N] that carries no tangential force, >= 0 and below
            max_normal; None: 0.
        start: (..., N, 3) force of an earlier result, used as a warm start if it is near; its
            gradient is zero.
        infeasible: treatment of elements without an optimum. "mask": return the elastic force (see
            `GraspForces`) with zero gradient. "elastic": return it with its gradient. "raise":
            raise an InfeasibleWrenchError that names the elements.
        tolerance: relative certified gap at which the solver stops.
        max_iterations: largest number of Newton steps.
        chunk: number of elements that a thread solves at a time; the results do not depend on it.

    Raises:
        InvalidInputError: shapes, types or devices do not fit, or a number given for
            friction_margin or preload is out of range. A tensor out of range gives status 4.
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
    inputs = (
        positions,
        normals,
        friction,
        tangents,
        torsional_friction,
        wrench,
        jacobian,
        torque_limit,
        torque_bias,
        min_normal,
        max_normal,
        force_weight,
        barrier_weight,
        start,
    )
    settings = checked_settings(infeasible, tolerance, max_iterations, chunk)
    return _forces(with_margin(inputs, friction_margin, preload), settings)


def _forces(inputs: Sequence[Any], settings: tuple[str, float, int, int]) -> GraspForces:
    """Return the forces; `inputs` are in the order of `layer_inputs.NAMES`, or `ALL_NAMES`."""
    has_margin = len(inputs) > len(NAMES)
    problems = None if has_margin else read_in_place(inputs)
    if problems is None:
        device = common_device(inputs)
        if device.type not in _SOLVED_ON:
            forces = _forces(
                [a.to("cpu") if isinstance(a, Tensor) else a for a in inputs], settings
            )
            return GraspForces(*[a.to(device) for a in forces])
        tensors, dtype = checked_tensors(inputs)
        shift = Shift(tensors) if has_margin else None
        tensors = shift.problem if shift else tensors
        force, torsion, multipliers, facts, state = solve(*tensors, *settings)
        if shift:
            force = shift.back(force, facts, state, settings[0])
    else:  # fast path: the core reads the inputs without a copy
        dtype = torch.float32 if problems.float32 else torch.float64
        if torch.is_grad_enabled() and any(
            a.requires_grad for a in inputs if isinstance(a, Tensor)
        ):
            answers = InPlace.apply(problems, settings, *inputs)
        else:
            answers = optima(problems, *settings[1:])
        force, torsion, multipliers, facts = answers[:4]
        if settings[0] == "raise":
            raise_for(facts[..., 0], problems.lead)
    status, gap, residual, iterations = facts.unbind(-1)
    if dtype is not torch.float64:
        force, torsion, multipliers, gap, residual = (
            a.to(dtype) for a in (force, torsion, multipliers, gap, residual)
        )
    feasible = status <= float(STALLED)
    return GraspForces(
        force, torsion, multipliers, status.long(), gap, residual, iterations.long(), feasible
    )


class GraspForceLayer(nn.Module):
    """`grasp_force` as a module that holds the settings; it has no parameters.

    `forward` takes the tensors under the same names.

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
        self,
        infeasible: str = "mask",
        tolerance: float = 1e-10,
        max_iterations: int = 200,
        chunk: int = 512,
    ) -> None:
        super().__init__()
        settings = checked_settings(infeasible, tolerance, max_iterations, chunk)
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
            others: keyword arguments of `grasp_force` for tensors: tangents, limits, weights,
                margin, start.
        """
        return grasp_force(
            positions,
            normals,
            friction,
            wrench,
            **others,
            infeasible=self.infeasible,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            chunk=self.chunk,
        )
