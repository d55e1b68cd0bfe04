"""Scores of a network on held-out wrenches: its gap, and the steps that remain."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np

from grasp_env.grasp import Grasp
from policies import LearnedInitialForce
from training.data.one_grasp import with_mean_friction
from training.evaluation.compare.methods import FLOW, optimizer
from training.evaluation.compare.starts import NetworkAlone
from training.evaluation.compare.trial import TOLERANCE

MOST = 4
"""Number of Newton steps from which on counts are added up."""
EXACT = 1e-10
"""Relative gap of the optima."""


def scores(
    model: LearnedInitialForce,
    grasp: Grasp,
    wrenches: np.ndarray,
    frictions: np.ndarray,
    flow: bool = False,
) -> dict[str, Any]:
    """Score a model's network, without Newton steps, on wrenches (B, 6) and frictions (B,).

    Returns:
        "gap" of the force before any step; "outside the cones": the share before the repair;
        "newton steps": the shares that need 0, 1, ... to a certified gap of 1e-4; with `flow`,
        "flow iterations" to 1e-4.
    """
    alone = NetworkAlone(model)
    rows: list[tuple[float, bool, int, int]] = []
    for friction, indices in groupby(range(len(wrenches)), key=lambda k: float(frictions[k])):
        varied = with_mean_friction(grasp, friction)
        exact, newton = (
            optimizer(varied, "newton", model.objective, gap) for gap in (EXACT, TOLERANCE)
        )
        reduced = optimizer(varied, FLOW, model.objective, TOLERANCE) if flow else newton
        for wrench in wrenches[list(indices)]:
            raw = model.raw(varied, wrench)
            start = alone(varied, wrench)
            gap = model.objective.of(varied, start) / exact.solve(wrench).objective - 1.0
            flow_steps = reduced.solve(wrench, initial=start).iterations if flow else 0
            newton_steps = newton.solve(wrench, initial=start).iterations
            outside = varied.cone_margin(raw) <= 0.0
            rows.append((max(0.0, gap), outside, newton_steps, flow_steps))
    gaps, outside, steps, iterations = np.array(rows).T
    names = [*map(str, range(MOST)), f"{MOST} or more"]
    shares = {name: float((np.minimum(steps, MOST) == k).mean()) for k, name in enumerate(names)}
    result: dict[str, Any] = {
        "wrenches": len(rows),
        "gap": quantiles(gaps),
        "outside the cones": float(outside.mean()),
        "newton steps": shares,
    }
    return result | ({"flow iterations": quantiles(iterations)} if flow else {})


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Return number, median and upper percentiles of finite values (n,).

    Example:
        >>> quantiles(np.arange(101.0))
        {'n': 101, 'median': 50.0, 'p90': 90.0, 'p99': 99.0, 'max': 100.0}
    """
    points = np.percentile(values, [50, 90, 99, 100]).tolist()
    names = ("median", "p90", "p99", "max")
    return {"n": len(values), **dict(zip(names, points, strict=True))}
