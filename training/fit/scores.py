"""What a network of one grasp is worth on held-out wrenches: its gap, the Newton steps and the flow's iterations that are left."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np

from grasp_env.grasp import Grasp
from policies import LearnedInitialForce
from training.compare.methods import FLOW, optimizer
from training.compare.starts import NetworkAlone
from training.compare.trial import TOLERANCE
from training.data.one_grasp import with_mean_friction

MOST = 4
"""Newton steps that are counted one by one; more are counted together."""
EXACT = 1e-10
"""Relative gap of the optima."""


def scores(
    model: LearnedInitialForce, grasp: Grasp, wrenches: np.ndarray, frictions: np.ndarray, flow: bool = False
) -> dict[str, Any]:
    """Summaries over wrenches (B, 6) on a grasp with frictions (B,), each through the model as it is used.

    Args:
        model: whose network is looked at alone.
        grasp: its mean friction is replaced.
        wrenches: (B, 6) [N, N m].
        frictions: (B,).
        flow: run the flow, too.

    Returns:
        "gap" of the force before any step; "outside the cones": share, before the repair; "newton steps" to a certified 1e-4: shares
        that need 0, 1, ... and more; "flow iterations" to 1e-4.
    """
    alone = NetworkAlone(model)
    rows: list[tuple[float, bool, int, int]] = []
    for friction, chosen in groupby(range(len(wrenches)), key=lambda k: float(frictions[k])):
        here = with_mean_friction(grasp, friction)
        exact, newton = (optimizer(here, "newton", model.objective, gap) for gap in (EXACT, TOLERANCE))
        reduced = optimizer(here, FLOW, model.objective, TOLERANCE) if flow else newton
        for wrench in wrenches[list(chosen)]:
            raw, start = model.raw(here, wrench), alone(here, wrench)
            gap = model.objective.value(here.to_cone(start)) / exact.solve(wrench).objective - 1.0
            left = reduced.solve(wrench, initial=start).iterations if flow else 0
            taken = newton.solve(wrench, initial=start).iterations
            rows.append((max(0.0, gap), here.cone_margin(raw) <= 0.0, taken, left))
    gaps, outside, steps, iterations = np.array(rows).T
    told = {
        "wrenches": len(rows),
        "gap": spread(gaps),
        "outside the cones": float(outside.mean()),
        "newton steps": {
            f"{k}{' or more' if k == MOST else ''}": float((np.minimum(steps, MOST) == k).mean())
            for k in range(MOST + 1)
        },
    }
    return told | ({"flow iterations": spread(iterations)} if flow else {})


def spread(values: np.ndarray) -> dict[str, float]:
    """Number, median and upper percentiles of finite values (n,).

    Example:
        >>> spread(np.arange(101.0))
        {'n': 101, 'median': 50.0, 'p90': 90.0, 'p99': 99.0, 'max': 100.0}
    """
    points = zip(("median", "p90", "p99", "max"), np.percentile(values, [50, 90, 99, 100]), strict=True)
    return {"n": len(values), **{name: float(point) for name, point in points}}
