"""What a proof that no force exists says, in words: which cones and limits it needs."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array
from grasp_env.force.limits import ForceLimits
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp

PART = 1e-6
"""A price up to this part of the largest is that of a limit which the proof does without."""
EDGE = 1e-3
"""A contact whose q_i is this near to the edge of its dual cone, of the size of q_i, would slip there."""
ROUNDING = 1e-6
"""What a proof may miss, of the size of its terms."""
MOST = 6
"""Limits that are named."""


def moved(grasp: Grasp, twist: Array) -> Array:
    """Motion q = G^T v of a twist, (n, 4): per contact along its normal and both tangents, and the turning about the normal."""
    return np.concatenate([(twist @ grasp.matrix).reshape(-1, 3), (twist @ grasp.torsion_matrix)[:, None]], axis=1)


def friction_part(grasp: Grasp, q: Array) -> Array:
    """(n,) the least normal part q may have: q_i lies in the dual of friction cone i where q_i0 is at least this."""
    models = grasp.models
    tangential: Array = np.hypot(models.friction[:, 0] * q[:, 1], models.friction[:, 1] * q[:, 2])
    return tangential + models.torsional_friction * np.abs(q[:, 3])


def tell(solution: ForceSolution, grasp: Grasp | None, limits: ForceLimits | None) -> str:
    """Why no force balances the wrench of an infeasible solution.

    Args:
        solution: the one without a force.
        grasp: the contacts of the call; None: only some of them touch, and none is named.
        limits: of the call.
    """
    twist = solution.certificate
    assert twist is not None
    said = f"wrench {solution.wrench.tolist()}"
    shown = f"the twist {[round(v, 6) for v in twist.tolist()]}"
    needed = _needed(solution, limits)
    slipping = [] if grasp is None else _slipping(solution, grasp, limits)
    where = f" of contact{'s' * (len(slipping) > 1)} {', '.join(map(str, slipping))}" if slipping else ""
    if needed:
        cones = f" and the friction cone{'s' * (len(slipping) > 1)}{where}" if where else ""
        return (
            f"no force strictly inside the friction cones and limits balances {said}; the proof needs the limits {'; '.join(needed)}{cones} "
            f"({shown} and their prices: error.solution.certificate, .limit_multipliers): widen them (elastic=True answers with the least "
            "excess of them), raise the friction, add contacts, or change the wrench"
        )
    return (
        f"no force strictly inside the friction cones balances {said}; {shown} separates it from what the cones{where} can make "
        "(error.solution.certificate): add contacts that resist it, raise the friction, or change the wrench"
    )


def _needed(solution: ForceSolution, limits: ForceLimits | None) -> list[str]:
    """The limits that a proof needs, the dearest first."""
    prices = solution.limit_multipliers
    if limits is None or not len(prices) or not prices.max() > 0.0:
        return []
    labels = limits.labels(solution.n_contacts)
    order = [k for k in np.argsort(-prices, kind="stable").tolist() if prices[k] > PART * prices.max()]
    return [labels[k] for k in order[:MOST]] + [f"and {len(order) - MOST} more"] * (len(order) > MOST)


def _slipping(solution: ForceSolution, grasp: Grasp, limits: ForceLimits | None) -> list[int]:
    """The contacts at the edge of their friction cones in the proof; none where it is not one for these contacts."""
    twist = solution.certificate
    if twist is None or grasp.n_contacts != solution.n_contacts:
        return []
    q = moved(grasp, twist)
    size, right = np.abs(q).max(), 0.0
    if limits is not None:
        rows, prices = limits.rows(grasp), solution.limit_multipliers
        q += (prices @ rows.matrix).reshape(-1, 4)
        right = float(prices @ rows.bound)
        size = max(size, float((prices[:, None] * np.abs(rows.matrix)).max(initial=0.0)))
    lost = friction_part(grasp, q)
    scale = abs(right) + float(np.abs(twist * solution.wrench).sum())
    if not ((q[:, 0] - lost >= -ROUNDING * size).all() and twist @ solution.wrench - right >= -ROUNDING * scale):
        return []
    return [k for k in range(len(q)) if q[k, 0] - lost[k] <= EDGE * (abs(q[k, 0]) + lost[k]) and lost[k] > EDGE * size]
