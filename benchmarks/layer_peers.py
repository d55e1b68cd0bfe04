"""Differentiable layers of other packages for grasp forces, with their best settings.

A new one is an entry of `PEERS`. Inputs are in cone coordinates (u, o, t): A (n, 6, 3N), w (n, 6)
and the cost of each u (n, N). A package is imported when its layer is built.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, TypeAlias

from grasp_env.inputs.extras import need

with need("train"):
    import torch

Tensors: TypeAlias = dict[str, Any]
"""Tensors by name; the first dimension is that of the problems."""
Call: TypeAlias = Callable[..., Any]
"""Map tensors by name to the forces of a batch."""

CONTACTS = 4
"""Contacts of each problem."""
OMEGA, LAMBDA = 1.0, 0.01
"""Weights of Phi, the defaults of our layer."""
EDGES = 8
"""Edges of a friction pyramid."""


@dataclass(frozen=True)
class Contestant:
    """A layer.

    Attributes:
        setting: settings, in words.
        build: makes the layer for batches of one size; raises `ImportError` if not installed.
        packages: what pip installs; "": ours.
        phi: True if it minimises Phi, so its results should equal ours.
    """

    setting: str
    build: Callable[[int], Call]
    packages: str = ""
    phi: bool = True


def cone_form(positions: Any, normals: Any, friction: Any, wrench: Any) -> tuple[Tensors, Any]:
    """Return the problem A x + w = 0 in cone coordinates, differentiable in all arguments.

    Moments are about the contacts' centre in units of their distance from it.

    Returns:
        `matrix` A (..., 6, 3N), `load` w (..., 6) and `cost` 1 / friction (..., N); and (..., N, 3,
        3), the force of unit x along u, o and t.
    """
    inward = torch.nn.functional.normalize(normals, dim=-1)
    across = torch.nn.functional.one_hot(inward.detach().abs().argmin(dim=-1), 3).to(inward)
    first = torch.nn.functional.normalize(torch.linalg.cross(inward, across), dim=-1)
    axes = torch.stack(
        [inward / friction[..., None], first, torch.linalg.cross(inward, first)], dim=-2
    )
    # solutions do not depend on centre and unit: no gradient passes through them
    centre = positions.detach().mean(dim=-2, keepdim=True)
    arms = positions - centre
    unit = arms.detach().square().sum(dim=-1).mean(dim=-1).sqrt()[..., None]
    moments = torch.linalg.cross(arms[..., None, :].expand_as(axes), axes) / unit[..., None, None]
    matrix = torch.cat([axes, moments], dim=-1).flatten(-3, -2).transpose(-1, -2)
    force, moment = wrench.split(3, dim=-1)
    moment = (moment - torch.linalg.cross(centre[..., 0, :], force)) / unit
    load = torch.cat([force, moment], dim=-1)
    return {"matrix": matrix, "load": load, "cost": 1.0 / friction}, axes


def cvxpylayer(batch: int, **options: Any) -> Call:
    """Build Phi as a problem of cvxpy, with A and w as its parameters."""
    cp = import_module("cvxpy")
    layers = import_module("cvxpylayers.torch")
    matrix = cp.Parameter((6, 3 * CONTACTS))
    load = cp.Parameter(6)
    force = cp.Variable(3 * CONTACTS)
    phi = 0.0
    for k in range(0, 3 * CONTACTS, 3):
        height = force[k]
        inside = height - cp.quad_over_lin(force[k + 1 : k + 3], height)
        phi += 3.0 * OMEGA * height + LAMBDA * (cp.inv_pos(height) + 2.0 * cp.inv_pos(inside))
    problem = cp.Problem(cp.Minimize(phi), [matrix @ force + load == 0])
    layer = layers.CvxpyLayer(problem, parameters=[matrix, load], variables=[force], **options)
    return lambda matrix, load, cost: layer(matrix, load)[0]


def moreau(batch: int) -> Call:
    """Build the least sum of normal forces over exact cones.

    With the default derivatives, cones on the variables (`DirectConeSpec`) are the fastest of three
    forms: cones on slacks take 1.2 to 1.5 times as long, the dual problem 1.04 to 1.3 times. With
    `diff_method="exact"` the dual takes 0.9 to 0.97 times as long, a little less exact.
    """
    solver = import_module("moreau")
    layers = import_module("moreau.torch")
    size = 3 * CONTACTS
    cones = [
        solver.DirectConeSpec(kind="soc", indices=[k, k + 1, k + 2]) for k in range(0, size, 3)
    ]
    layer = layers.Solver(
        size,
        6,
        torch.zeros(size + 1, dtype=torch.int64),
        torch.zeros(0, dtype=torch.int64),
        torch.arange(0, 6 * size + 1, size),
        torch.arange(size).repeat(6),
        solver.Cones(num_zero_cones=6, dir_cones=cones),
        solver.Settings(device="cpu", solver="ipm", batch_size=batch, enable_grad=True),
    )
    quadratic = torch.zeros(batch, 0, dtype=torch.float64)
    return lambda matrix, load, cost: (
        layer.solve(quadratic, matrix.flatten(1), _along_normals(cost), -load).x
    )


def qplayer(batch: int) -> Call:
    """Build the least sum of normal forces and half of the squared forces over inner pyramids.

    Without the squares the solver fails on most problems.
    """
    solve = import_module("proxsuite.torch.qplayer").QPFunction()
    angles = 2.0 * math.pi / EDGES * torch.arange(EDGES, dtype=torch.float64)
    height = torch.full_like(angles, -math.cos(math.pi / EDGES))
    sides = torch.block_diag(*[torch.stack([height, angles.cos(), angles.sin()], dim=1)] * CONTACTS)
    squares = torch.eye(3 * CONTACTS, dtype=torch.float64)
    most = torch.zeros(len(sides), dtype=torch.float64)
    least = most - 1e20
    return lambda matrix, load, cost: solve(
        squares, _along_normals(cost), matrix, -load, sides, least, most
    )[0]


def _along_normals(cost: Any) -> Any:
    """Pad (..., N) to (..., 3N) with zeros along tangents."""
    return torch.nn.functional.pad(cost[..., None], (0, 2)).flatten(-2)


_CLARABEL: dict[str, Any] = {"solve_method": "Clarabel", "mode": "dense"}
_CLARABEL |= dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-10)
_SERIAL = {"n_jobs_forward": 1, "n_jobs_backward": 1}
PEERS = {
    "cvxpylayers": Contestant(
        "Phi by cvxpylayers with diffcp and their defaults: SCS, LSQR",
        partial(cvxpylayer, solver_args=_SERIAL),
        "cvxpylayers diffcp",
    ),
    "cvxpylayers_clarabel": Contestant(
        "the same with the fastest settings: Clarabel to 1e-10, dense",
        partial(cvxpylayer, solver_args=_SERIAL | _CLARABEL),
        "cvxpylayers diffcp clarabel",
    ),
    "cvxpylayers_moreau": Contestant(
        "Phi by cvxpylayers with Moreau, to 1e-8",
        partial(cvxpylayer, solver="MOREAU"),
        "cvxpylayers moreau",
    ),
    "moreau": Contestant(
        "conic problem by Moreau's torch layer, to 1e-8", moreau, "moreau", phi=False
    ),
    "qplayer": Contestant(
        f"pyramids of {EDGES} edges by ProxSuite's layer, to 1e-9", qplayer, "proxsuite", phi=False
    ),
}
"""All peers by name."""
