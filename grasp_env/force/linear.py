"""The classical linear program: least total normal force with a friction pyramid inside every cone, by HiGHS.

For comparison, and as an answer that needs no interior: it also holds where forces must touch their limits. Its
forces lie on edges of the pyramids. Along a path of the wrench they have kinks, and where several forces cost the same
they may jump: a millionth more friction at two of four fingers can hand them the whole load. Kerr, Roth 1986 and
Cheng, Orin 1990 used it for hands. A call takes milliseconds, most of them scipy's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog

from grasp_env import ranges
from grasp_env._check import Array, ContactForces, as_wrench, whole
from grasp_env.errors import InvalidInputError, NotConvergedError
from grasp_env.force.limits import ForceLimits, as_limits
from grasp_env.force.solution import Status
from grasp_env.grasp.grasp import Grasp, as_grasp

_SOLVER_TOLERANCE = 1e-10
"""HiGHS's least; relative to the wrench and the limits, which it is given scaled to 1."""
_TIGHT = 1e-7
"""[of the limit] within which a limit counts as touched."""
_KEPT = 1e-9
"""What an optimal answer may miss of balance and exceed of limits, relative."""


@dataclass(frozen=True, eq=False)
class LinearForces:
    """Answer of `linear_forces`.

    Attributes:
        force: (N, 3) normal, o, t [N]; zeros when infeasible.
        torsion: (N,) [N m], zero unless the contact is soft.
        objective: sum of the normal forces [N]; inf when infeasible.
        multipliers: (6,) nu of the balance G f + w = 0: objective changes by -nu . dw; None when infeasible. Without
            limits -nu . w is the objective. It bounds the PYRAMID's problem from below, not the cone's, whose
            optimum is smaller.
        status: OPTIMAL; STALLED: more than a part in 1e9 of balance or of a limit is missed; INFEASIBLE: no force inside the
            pyramids and limits balances the wrench (one inside the cones may).
    """

    force: ContactForces
    torsion: Array
    objective: float
    multipliers: Array | None
    status: Status


def linear_forces(grasp: Grasp, wrench: ArrayLike, facets: int = 8, limits: ForceLimits | None = None) -> LinearForces:
    """Forces of least total normal force that balance a wrench, each a sum of edges of an inscribed friction pyramid.

    min sum normal_i s.t. G f + w = 0, f_i = sum_k c_ik e_ik, c >= 0, A f <= b, where the `facets` edges e_ik lie on
    the cone of contact i, the first at normal + mu_o o. The pyramids lie inside their cones, so every answer satisfies the true
    friction to rounding; 8 facets cost 3 % more than the cones in the median (at most 8 % on the presets). Soft
    contacts have every edge twice, with torsion +-gamma normal; a frictionless contact has one.

    Args:
        grasp: the contacts, of any model.
        wrench: (6,) external wrench on the object [N, N m], object frame.
        facets: edges of each pyramid, 3 to 1000.
        limits: on normal forces and joint torques.

    Raises:
        InvalidInputError: a wrong wrench, fewer than three facets, or limits of another number of contacts.
        NotConvergedError: HiGHS ended without an optimum or a proof of infeasibility.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> answer = linear_forces(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> answer.status.name, round(answer.objective, 3), grasp.cone_margin(answer.force) > -1e-12
        ('OPTIMAL', 8.868, True)
    """
    wrench = as_wrench(wrench)
    count = as_grasp(grasp).n_contacts
    facets = whole(facets, "facets", 3, ranges.FACETS)
    if count * count * facets > ranges.EDGES:
        raise InvalidInputError(
            f"facets must be at most {ranges.EDGES // count**2} with {count} contacts, got {facets}"
        )
    edges = pyramid_edges(grasp, facets)
    frame = grasp.unit_frame
    balance = np.zeros((6, count, 4))
    balance[:, :, :3] = grasp.matrix.reshape(6, count, 3)
    balance[:, :, 3] = grasp.torsion_matrix
    balance = frame @ balance.reshape(6, -1) @ edges
    matrix, bound, _ = (as_limits(limits) or ForceLimits()).rows(grasp)
    load = frame @ wrench
    # rows in units of force, then everything in units of what forces there must be
    size = np.abs(matrix).max(axis=1)
    size[size == 0.0] = 1.0  # a joint that no force reaches
    unit = max(float(np.abs(load).max()), float((-bound / size).max(initial=0.0))) or 1.0
    limited, bound, load = (matrix / size[:, None]) @ edges, bound / size / unit, load / unit
    answer = linprog(
        edges[0::4].sum(axis=0),
        A_ub=limited,
        b_ub=bound,
        A_eq=balance,
        b_eq=-load,
        method="highs-ds",
        options={
            "presolve": False,
            "primal_feasibility_tolerance": _SOLVER_TOLERANCE,
            "dual_feasibility_tolerance": _SOLVER_TOLERANCE,
        },
    )
    if answer.status == 2:
        return LinearForces(np.zeros((count, 3)), np.zeros(count), float("inf"), None, Status.INFEASIBLE)
    if answer.status != 0:
        raise NotConvergedError(
            f"the linear program of wrench {wrench.tolist()} ended with neither an optimum nor a proof that there is none: "
            f"{answer.message}; use fewer facets, or optimize_force"
        )
    x = answer.x
    tight = np.abs(limited @ x - bound) <= _TIGHT * np.abs(bound)
    held, right = np.concatenate([balance, limited[tight]]), np.concatenate([-load, bound[tight]])
    for _ in range(2):  # onto what it holds, each edge by a part of itself: HiGHS's tolerance is absolute
        part = np.linalg.lstsq(held * x, right - held @ x, rcond=1e-12)[0]
        x = x * (1.0 + np.clip(part, -0.5, 0.5))
    missed = np.abs(balance @ x + load).max() > _KEPT * np.abs(load).max() + 1e-14 * np.abs(x).max(initial=0.0)
    missed = missed or (limited @ x > bound + _KEPT * np.abs(bound)).any()
    forces = (edges @ x * unit).reshape(count, 4)
    return LinearForces(
        forces[:, :3].copy(),
        forces[:, 3].copy(),
        float(forces[:, 0].sum()),
        np.asarray(answer.eqlin.marginals) @ frame,
        Status.STALLED if missed else Status.OPTIMAL,
    )


def pyramid_edges(grasp: Grasp, facets: int) -> Array:
    """(4N, E) forces (normal, o, t, torsion) per contact of each edge of all pyramids, normal 1.

    Example:
        >>> from grasp_env.grasp import presets
        >>> pyramid_edges(presets.tripod(), 4)[:3, :4].T.round(9) + 0.0   # mu = 0.5; rows: edges of the first contact
        array([[ 1. ,  0.5,  0. ],
               [ 1. ,  0. ,  0.5],
               [ 1. , -0.5,  0. ],
               [ 1. ,  0. , -0.5]])
    """
    angles = 2.0 * np.pi * np.arange(facets) / facets
    models = grasp.models
    blocks = []
    for k, (mu, gamma) in enumerate(zip(models.friction, models.torsional_friction, strict=True)):
        around = np.stack([np.ones(facets), mu[0] * np.cos(angles), mu[1] * np.sin(angles), np.zeros(facets)])
        if not mu.any():
            around = around[:, :1]
        if gamma > 0.0:
            twist = np.array([[0.0], [0.0], [0.0], [gamma]])
            around = np.concatenate([around + twist, around - twist], axis=1)
        block = np.zeros((4 * grasp.n_contacts, around.shape[1]))
        block[4 * k : 4 * k + 4] = around
        blocks.append(block)
    return np.concatenate(blocks, axis=1)
