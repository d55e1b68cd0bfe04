"""Whether an outcome of the running code is as good as the recorded one: plain numpy, none of the code it judges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from golden import environment
from golden.record import Case, Outcome, Problem

GROUPS: dict[str, Callable[[], dict[str, Case]]] = {"environment": environment.cases}
"""What a file of that name holds."""
OPTIMAL = "optimal"
SOLVED = (OPTIMAL, "iteration_limit", "stalled")
DIGITS = 1e-9
"""Relative difference of two objectives, and of what a solution says of its own."""
FORCES = 1e-6
"""Of the largest component: Phi is flat at its least, so 1e-12 of it are 1e-6 of the force."""
STEPS = 2
"""Iterations by which Newton may exceed the recorded ones: a gap near the tolerance falls to either side."""
FLOW_STEPS = 1.35, 3.0
"""Factor and summand for the flow: the last digits of a wrench move its hundreds of iterations by a third (221 to 303)."""
SMALL = 1e-2
"""Arrays whose largest entry is below this count as of this size [m, N, N m]: a centre at the origin is rounding."""
SINGLE = 1e-6
"""Of the largest entry, for numbers that were rounded to 24 bits."""
DRIFT, TOTAL = 1.25, 0.01
"""By which the drift of all episodes together may grow, and their mean force change: in the simulation the last digit of a
force grows to 4 % and 0.01 %, and to 33 % of a single episode's drift."""
BALANCE = 1e-11
"""Residual of balance as a part of forces and wrench."""


def differences(case: Case, now: list[Outcome], then: list[Outcome]) -> list[str]:
    """What is wrong with the outcomes of a case, in words; empty where nothing is."""
    if len(now) != len(then):
        return [f"{len(now)} outcomes, recorded {len(then)}"]
    return [f"{k}: {text}" for k, (a, b) in enumerate(zip(now, then, strict=True)) for text in _compare(case, a, b)]


def _compare(case: Case, now: Outcome, then: Outcome) -> list[str]:
    # an optimum with its proof is as good as what stopped short of it
    if now.end != then.end and not (now.end == OPTIMAL and then.end in SOLVED):
        return [f"ended {now.end} {now.text!r}, recorded {then.end} {then.text!r}"]
    out = [] if now.text == then.text else [f"says {now.text!r}, recorded {then.text!r}"]
    if now.end == "episodes":
        return out + _held(now.extra.reshape(-1, 4), then.extra.reshape(-1, 4))
    if now.end not in SOLVED:
        out += _close("force", now.force, then.force, FORCES)
        # observations are float32
        part = max(case.close, SINGLE) if now.text.startswith("observation") else case.close
        return out + _close(now.text, now.extra, then.extra, part, SMALL)
    problem = now.problem
    assert problem is not None
    if not np.array_equal(now.wrench, then.wrench):
        out.append(f"another problem: wrench {now.wrench.tolist()}, recorded {then.wrench.tolist()}")
    out += certified(now, problem)
    # either's bound lies below either's objective: two proofs about one minimum
    slack = DIGITS * abs(then.objective)
    if now.objective < then.lower_bound - slack or now.lower_bound > then.objective + slack:
        out.append(f"objective {now.objective:.12g} >= {now.lower_bound:.12g}, recorded {then.objective:.12g}")
    factor, more = FLOW_STEPS if problem.method == "reduced_flow" else (1.0, STEPS)
    # where rounding ends a solve, and after how many steps, is rounding too
    if "stalled" not in (now.end, then.end) and now.iterations > factor * then.iterations + more:
        out.append(f"{now.iterations:g} iterations, recorded {then.iterations:g}")
    if case.tight:
        if abs(now.objective - then.objective) > slack:
            out.append(f"objective {now.objective:.15g}, recorded {then.objective:.15g}")
        out += _close("force", now.force, then.force, FORCES)
        largest = float(np.abs(then.force).max())
        out += _close("multipliers", now.multipliers, then.multipliers, 10.0 * FORCES, then.objective / largest)
    return out if case.start == np.inf else out + _close("start", now.start, then.start, case.start)


def certified(row: Outcome, problem: Problem) -> list[str]:
    """What a solution promises: balance, cones, its objective, and the gap that its status says."""
    grasp, out, force = problem.grasp, [], row.force[:, :3]
    if not np.isfinite(row.force).all():
        return ["force is not finite"]
    load = grasp.unit_frame @ problem.wrench
    residual = float(np.abs(load + grasp.unit_frame @ (grasp.matrix @ force.reshape(-1))).max())
    scale = float(np.abs(force).max() + np.abs(load).max())
    if max(residual, abs(residual - row.residual)) > BALANCE * scale:
        out.append(f"misses balance by {residual:.3g} N, says {row.residual:.3g} N")
    u, o, t = (force * grasp.models.cone_scale).T
    tangential = np.hypot(o, t)
    margin = float((u - tangential).min())
    if not margin > 0.0 or abs(margin - row.margin) > DIGITS * scale:
        out.append(f"has margin {margin:.6g} N, says {row.margin:.6g} N")
    omega, lam = problem.objective.weights(len(u)).T
    value = float((3.0 * omega * u + lam * (1.0 / u + 2.0 * u / ((u - tangential) * (u + tangential)))).sum())
    if abs(value - row.objective) > DIGITS * value:
        out.append(f"has objective {value:.12g}, says {row.objective:.12g}")
    gap = (row.objective - row.lower_bound) / row.lower_bound if row.lower_bound > 0.0 else np.inf
    if row.end == OPTIMAL and gap > problem.tolerance:
        out.append(f"optimal with a gap of {gap:.3g}")
    return out


def _close(name: str, now: np.ndarray, then: np.ndarray, part: float, floor: float = 0.0) -> list[str]:
    """Within a part of the largest recorded entry, or of `floor` where all are smaller."""
    if now.shape != then.shape:
        return [f"{name} has shape {now.shape}, recorded {then.shape}"]
    off = float(np.abs(now - then).max(initial=0.0))
    size = max(float(np.abs(then).max(initial=0.0)), floor)
    return [] if off <= part * size else [f"{name} off by {off:.3g}, its largest is {size:.3g}"]


def _held(now: np.ndarray, then: np.ndarray) -> list[str]:
    """Episodes (M, 4): as often held and as long, with no more drift and no other force."""
    out: list[str] = []
    for name, column in (("held", 0), ("steps", 1)):
        if not np.array_equal(now[:, column], then[:, column]):
            out.append(f"{name} {now[:, column].sum():g}, recorded {then[:, column].sum():g}")
    drift, known = float(now[:, 2].mean()), float(then[:, 2].mean())
    # few episodes say less
    if not drift <= known * (DRIFT if len(then) >= 50 else 1.0 + 2.0 * (DRIFT - 1.0)):
        out.append(f"drift {1e3 * drift:.4g} mm, recorded {1e3 * known:.4g} mm")
    force, known = float(now[:, 3].mean()), float(then[:, 3].mean())
    if not abs(force - known) <= TOTAL * known:
        out.append(f"total force {force:.4g} N, recorded {known:.4g} N")
    return out
