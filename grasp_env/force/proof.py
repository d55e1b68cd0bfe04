"""Explanation of an infeasibility proof: the friction cones and limits that it needs."""

from __future__ import annotations

import numpy as np

from grasp_env.force.limits import ForceLimits
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp, transmitted_matrix
from grasp_env.inputs.arguments import Array

NEGLIGIBLE_MULTIPLIER = 1e-6
"""Fraction of the largest multiplier up to which a limit is not needed."""
SLIPPING = 1e-3
"""Relative distance of q_i to the surface of its dual cone up to which contact i slips."""
ROUNDING = 1e-6
"""Largest violation of a valid proof, relative to the size of its terms."""
UNMOVED = 1e-9
"""Largest motion of a contact along a twist, relative to its terms, that counts as none."""
MOST_NAMED = 6
"""Largest number of limits named in a message."""


def contact_motions(grasp: Grasp, twist: Array) -> Array:
    """Return q = G^T v, (N, 4): contact velocity along normal, o, t, and rate about the normal."""
    return np.concatenate(
        [(twist @ grasp.matrix).reshape(-1, 3), (twist @ grasp.torsion_matrix)[:, None]], axis=1
    )


def least_normal_motions(grasp: Grasp, q: Array) -> Array:
    """Return (N,) the least normal component at which q_i lies in the dual of friction cone i."""
    models = grasp.models
    largest = np.column_stack([models.friction, models.torsional_friction])
    return np.sqrt(((largest * q[:, 1:]) ** 2).sum(axis=1))


def explain(
    solution: ForceSolution, grasp: Grasp | None, limits: ForceLimits | None, preload: Array
) -> str:
    """Explain why no force balances the wrench of an infeasible solution.

    Args:
        solution: the solution, whose certificate is the proof.
        grasp: the contacts that touch, with the friction within the margin. The message names no
            contacts if it has not all of the solution's, or is None.
        limits: the limits of the problem.
        preload: (N,) [N] of the margin.
    """
    twist = solution.certificate
    assert twist is not None
    wrench = f"wrench {solution.wrench.tolist()}"
    shown = f"the twist {[round(v, 6) for v in twist.tolist()]}"
    if grasp is not None and grasp.rank < 6 and not _moves_contacts(grasp, twist):
        return (
            f"{wrench} is out of reach: rank(G) = {grasp.rank} < 6 with {grasp.n_contacts} contact{'s' * (grasp.n_contacts != 1)}, "
            f"and no force of theirs acts along {shown} (velocity, angular velocity; error.solution.certificate): leave that part out of "
            "the wrench (grasp.within_reach), or add a contact, friction or soft fingertips"
        )
    needed = _needed(solution, limits)
    slipping = [] if grasp is None else _slipping(solution, grasp, limits, preload)
    plural = "s" * (len(slipping) > 1)
    where = f" of contact{plural} {', '.join(map(str, slipping))}" if slipping else ""
    if needed:
        cones = f" and the friction cone{plural}{where}" if where else ""
        return (
            f"no force strictly inside the friction cones and limits balances {wrench}; the proof needs the limits {'; '.join(needed)}{cones} "
            f"({shown} and their multipliers: error.solution.certificate, .limit_multipliers): widen them (elastic=True returns the force "
            "that exceeds them least), raise the friction, add contacts, or change the wrench"
        )
    return (
        f"no force strictly inside the friction cones balances {wrench}; {shown} separates it from what the cones{where} can make "
        "(error.solution.certificate): add contacts that resist it, raise the friction, or change the wrench"
    )


def _moves_contacts(grasp: Grasp, twist: Array) -> bool:
    """Return False if no transmitted force or torsion does work along a twist (6,)."""
    sent = transmitted_matrix(grasp)
    return bool(np.abs(twist @ sent).max() > UNMOVED * (np.abs(twist) @ np.abs(sent)).max())


def _needed(solution: ForceSolution, limits: ForceLimits | None) -> list[str]:
    """Return the labels of the limits that a proof needs, the largest multiplier first."""
    multipliers = solution.limit_multipliers
    if limits is None or not len(multipliers) or not multipliers.max() > 0.0:
        return []
    labels = limits.labels(solution.n_contacts)
    least = NEGLIGIBLE_MULTIPLIER * multipliers.max()
    order = np.argsort(-multipliers, kind="stable").tolist()
    needed = [labels[k] for k in order if multipliers[k] > least]
    if len(needed) > MOST_NAMED:
        needed[MOST_NAMED:] = [f"and {len(needed) - MOST_NAMED} more"]
    return needed


def _slipping(
    solution: ForceSolution, grasp: Grasp, limits: ForceLimits | None, preload: Array
) -> list[int]:
    """Return the contacts that the proof needs to slip; none if it does not hold for the grasp."""
    twist = solution.certificate
    if twist is None or grasp.n_contacts != solution.n_contacts:
        return []
    q = contact_motions(grasp, twist)
    size = np.abs(q).max()
    right = 0.0
    if limits is not None:
        rows = limits.rows(grasp)
        multipliers = solution.limit_multipliers
        q += (multipliers @ rows.matrix).reshape(-1, 4)
        bound = rows.bound - rows.matrix[:, ::4] @ preload
        right = float(multipliers @ bound)
        size = max(size, float((multipliers[:, None] * np.abs(rows.matrix)).max(initial=0.0)))
    least = least_normal_motions(grasp, q)
    wrench = solution.wrench_with_preload
    scale = abs(right) + float(np.abs(twist * wrench).sum())
    if not (
        (q[:, 0] - least >= -ROUNDING * size).all() and twist @ wrench - right >= -ROUNDING * scale
    ):
        return []
    return [
        k
        for k in range(len(q))
        if q[k, 0] - least[k] <= SLIPPING * (abs(q[k, 0]) + least[k]) and least[k] > SLIPPING * size
    ]
