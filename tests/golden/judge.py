"""Whether an outcome of the running code is as good as the recorded one: plain numpy, none of the code it judges."""

from __future__ import annotations

import numpy as np
from golden.case import FLOWS, Case
from golden.record import Outcome, Problem
from scipy.optimize import linprog

OPTIMAL = "optimal"
SOLVED = (OPTIMAL, "iteration_limit", "stalled")
DIGITS = 1e-9
"""Relative difference of two objectives."""
CONIC_DIGITS = 5e-9
"""Of the exact problems, which are certified to 1e-9 at best."""
FORCES = {"newton": 1e-6, "reduced_flow": 1e-6, "full_flow": 1e-6}
"""Of the largest component: Phi is flat at its least, so 1e-12 of it are 1e-6 of the force."""
ROOT = 1.5
"""Largest component's part, in roots of the gap, to which forces within limits agree: 1.35 at most."""
STEPS = 2
"""Iterations by which a second-order method may exceed the recorded ones: a gap near the tolerance falls to either side."""
FLOW_STEPS = 1.35, 3.0
"""Factor and summand for the flows: the last digits of a wrench move their hundreds of iterations by a third (221 to 303)."""
SMALL = 1e-2
"""Arrays whose largest entry is below this count as of this size [m, N, N m]: a centre at the origin is rounding."""
SINGLE = 1e-6
"""Of the largest entry, for numbers that were rounded to 24 bits."""
DRIFT, TOTAL = 1.25, 0.01
"""By which the drift of all episodes together may grow, and their mean force change: in the simulation the last digit of a
force grows to 4 % and 0.01 %, and to 33 % of a single episode's drift."""
STALLED_GAP = 2e-8
"""Of a tight conic solution that ends stalled where the recorded one is optimal, or the other way round."""
BALANCE = 1e-11
"""Residual of balance as a part of forces and wrench; or ten times the recorded one, where contacts are far from the origin."""
NOTHING = 1e-280
"""[N] below which wrenches and forces count as none."""
FACETS = 64
ITERATES, ITERATE = 10, 1e-3
"""Entries of a flow's trace that are compared, and how closely: the first ones follow from the step rule, later ones from rounding; a
start that is known to `case.BASIS` moves a line search by up to a few 1e-4. Newton's way is its own affair."""


def differences(case: Case, now: list[Outcome], then: list[Outcome]) -> list[str]:
    """What is wrong with the outcomes of a case, in words; empty where nothing is."""
    if len(now) != len(then):
        return [f"{len(now)} outcomes, recorded {len(then)}"]
    return [f"{k}: {text}" for k, (a, b) in enumerate(zip(now, then, strict=True)) for text in _compare(case, a, b)]


def _compare(case: Case, now: Outcome, then: Outcome) -> list[str]:
    if now.end != then.end and not _as_good(case, now, then):
        return [f"ended {now.end} {now.text!r}, recorded {then.end} {then.text!r}"]
    out: list[str] = []
    if now.text != then.text:
        out.append(f"says {now.text!r}, recorded {then.text!r}")
    if now.end not in SOLVED:
        if now.end in ("InfeasibleWrenchError", "infeasible"):
            out += _proof(now)
        elif now.end == "episodes":
            out += _held(now.extra.reshape(-1, 4), then.extra.reshape(-1, 4))
        else:
            out += _close(
                "force", now.force, then.force, max(FORCES["newton"], case.start if case.start < np.inf else 0.0)
            )
            # observations are float32
            part = max(case.close, SINGLE) if now.text.startswith("observation") else case.close
            out += _close(now.text, now.extra, then.extra, part, SMALL)
        return out
    assert now.problem is not None
    if not np.array_equal(now.wrench, then.wrench):
        out.append(f"another problem: wrench {now.wrench.tolist()}, recorded {then.wrench.tolist()}")
    out += certified(now, now.problem, then, case.honest)
    out += _bounds(now, then)
    out += _steps(now, then, now.problem)
    if case.tight:
        out += _tight(now, then, now.problem)
    if case.start < np.inf:
        out += _close("start", now.start, then.start, case.start)
    if then.extra.size:
        out += _trace(now, then, case)
    return out


def _as_good(case: Case, now: Outcome, then: Outcome) -> bool:
    """Rounding decides between optimal and stalled where a method is asked for all the digits it has."""
    if then.end in ("stalled", "iteration_limit") and now.end == OPTIMAL:  # with the proof that `certified` asks for
        return True
    exact = case.tight and now.problem is not None and now.problem.method == "conic"
    return (
        exact
        and then.end == OPTIMAL
        and now.end == "stalled"
        and now.objective - now.lower_bound <= STALLED_GAP * now.lower_bound
    )


def certified(row: Outcome, problem: Problem, then: Outcome, honest: float = 1e-9) -> list[str]:
    """What a solution promises: balance, cones, limits, its objective, and the gap that its status says.

    `honest`: part by which what it says of its objective and margin may be off what they are.
    """
    grasp, out = problem.grasp, []
    force, torsion = row.force[:, :3], row.force[:, 3]
    if not np.isfinite(row.force).all():
        return ["force is not finite"]
    load = grasp.unit_frame @ problem.wrench
    made = grasp.unit_frame @ (grasp.matrix @ force.reshape(-1) + grasp.torsion_matrix @ torsion)
    residual, scale = float(np.abs(load + made).max()), float(np.abs(row.force).max() + np.abs(load).max()) + NOTHING
    if not residual <= max(BALANCE * scale, 10.0 * then.residual):
        out.append(f"misses balance by {residual:.3g} N")
    if not abs(residual - row.residual) <= BALANCE * scale:
        out.append(f"says it misses balance by {row.residual:.3g} N, misses it by {residual:.3g} N")
    exact = problem.method == "conic"  # which alone may touch its cones
    margin = _margin(problem, force)
    if not (margin >= -1e-12 * scale if exact else margin > 0.0):
        out.append(f"leaves a cone by {-margin:.3g} N")
    if not abs(margin - row.margin) <= honest * scale:
        out.append(f"says margin {row.margin:.6g} N, has {margin:.6g} N")
    if not (np.abs(torsion) <= grasp.models.torsional_friction * force[:, 0] + 1e-12 * scale).all():
        out.append("torsion beyond its friction")
    if problem.limits is not None:
        out += problem.limits.violations(grasp, force, torsion, 1e-9 * scale)
    if exact or (problem.limits is None and grasp.hard):
        value = _value(problem, force)
        if not abs(value - row.objective) <= honest * abs(value):
            out.append(f"says objective {row.objective:.12g}, has {value:.12g}")
    if row.end == OPTIMAL and row.objective > 0.0:
        gap = (row.objective - row.lower_bound) / row.lower_bound if row.lower_bound > 0.0 else np.inf
        if not gap <= problem.tolerance:
            out.append(f"optimal with a gap of {gap:.3g}")
    return out


def _margin(problem: Problem, force: np.ndarray) -> float:
    """Least distance to a cone's surface [N], cone coordinates."""
    x = force * problem.grasp.models.cone_scale
    return float((x[:, 0] - np.hypot(x[:, 1], x[:, 2])).min())


def _value(problem: Problem, force: np.ndarray) -> float:
    """The objective of a force, from the paper's formula; barriers of torsions and limits are not in it."""
    if problem.method == "conic":
        return float(force[:, 0].max() if problem.criterion == "max" else force[:, 0].sum())
    u, o, t = (force * problem.grasp.models.cone_scale).T
    omega, lam = problem.objective.weights(len(u)).T
    tangential = np.hypot(o, t)
    return float((3.0 * omega * u + lam * (1.0 / u + 2.0 * u / ((u - tangential) * (u + tangential)))).sum())


def _bounds(now: Outcome, then: Outcome) -> list[str]:
    """Either's bound lies below either's objective: two proofs about one minimum."""
    out: list[str] = []
    slack = DIGITS * abs(then.objective)
    if not now.objective >= then.lower_bound - slack:
        out.append(f"objective {now.objective:.12g} below the recorded bound {then.lower_bound:.12g}")
    if not now.lower_bound <= then.objective + slack:
        out.append(f"bound {now.lower_bound:.12g} above the recorded objective {then.objective:.12g}")
    return out


def _steps(now: Outcome, then: Outcome, problem: Problem) -> list[str]:
    if "stalled" in (now.end, then.end):  # where rounding ends a solve, and after how many steps, is rounding too
        return []
    factor, more = FLOW_STEPS if problem.method in FLOWS else (1.0, STEPS)
    most = factor * then.iterations + more
    return [] if now.iterations <= most else [f"{now.iterations:g} iterations, recorded {then.iterations:g}"]


def _tight(now: Outcome, then: Outcome, problem: Problem) -> list[str]:
    out: list[str] = []
    part = CONIC_DIGITS if problem.method == "conic" else DIGITS
    if problem.method == "conic" and "stalled" in (now.end, then.end):
        part = STALLED_GAP
    if not abs(now.objective - then.objective) <= part * abs(then.objective):
        out.append(f"objective {now.objective:.15g}, recorded {then.objective:.15g}")
    if problem.method in FORCES:
        digits = FORCES[problem.method]
        if problem.limits is not None:  # asked for 1e-10 of Phi only, whose root is what forces are known to
            digits = max(digits, ROOT * np.sqrt(problem.tolerance))
        out += _close("force", now.force[:, :3], then.force[:, :3], digits)
        largest = float(np.abs(then.force).max()) + NOTHING
        gamma = float(problem.grasp.models.torsional_friction.max())
        out += _close("torsion", now.force[:, 3], then.force[:, 3], digits, gamma * largest)
        out += _close("multipliers", now.multipliers, then.multipliers, 10.0 * digits, then.objective / largest)
    return out


def _trace(now: Outcome, then: Outcome, case: Case) -> list[str]:
    out: list[str] = []
    if len(now.extra) != now.iterations + 1:
        out.append(f"{len(now.extra)} values for {now.iterations:g} iterations")
    if not (np.diff(now.extra) <= 0.0).all():
        out.append("the objective rises along the trace")
    if now.extra[-1] != now.objective:
        out.append(f"the trace ends with {now.extra[-1]:.12g} at an objective of {now.objective:.12g}")
    if case.start < np.inf and now.problem is not None and now.problem.method in FLOWS:
        most = min(len(now.extra), len(then.extra), ITERATES)
        out += _close("trace", now.extra[:most], then.extra[:most], ITERATE)
    return out


def _close(name: str, now: np.ndarray, then: np.ndarray, part: float, floor: float = 0.0) -> list[str]:
    """Within a part of the largest recorded entry, or of `floor` where all are smaller."""
    if now.shape != then.shape:
        return [f"{name} has shape {now.shape}, recorded {then.shape}"]
    off = float(np.abs(now - then).max(initial=0.0))
    size = max(float(np.abs(then).max(initial=0.0)), floor)
    return (
        [] if off <= part * size else [f"{name} off by {off:.3g}, {off / size if size else np.inf:.3g} of its largest"]
    )


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


def _proof(row: Outcome) -> list[str]:
    """The twist v has to prove infeasibility: v . w at least what forces within cones and limits can make of -v . G f.

    Cones are replaced by pyramids of `FACETS` facets AROUND them, which only makes the proof harder.
    """
    problem, twist = row.problem, row.extra
    assert problem is not None
    if twist.shape != (6,) or not np.isfinite(twist).all() or not twist.any():
        return [f"no certificate: {twist.tolist()}"]
    grasp, models = problem.grasp, problem.grasp.models
    pull = (grasp.matrix.T @ twist).reshape(-1, 3)
    turn = grasp.torsion_matrix.T @ twist
    gain = float(twist @ problem.wrench)
    scale = float(np.abs(np.linalg.inv(grasp.unit_frame).T @ twist).max())
    slack = 1e-9 * scale
    if problem.limits is None:
        worth = pull[:, 0] - np.hypot(*(models.friction * pull[:, 1:]).T) - models.torsional_friction * np.abs(turn)
        out = [] if worth.min() >= -slack else [f"certificate leaves a dual cone by {-worth.min():.3g}"]
        least = -slack * float(np.abs(grasp.unit_frame @ problem.wrench).max())
        return out if gain >= least else [*out, f"certificate gains {gain:.3g} < 0"]
    return [] if _most(problem, pull, turn) < gain else ["certificate proves nothing within the limits"]


def _most(problem: Problem, pull: np.ndarray, turn: np.ndarray) -> float:
    """Max of -v . G f over forces in pyramids around the cones and within the limits."""
    grasp, models, count = problem.grasp, problem.grasp.models, problem.grasp.n_contacts
    assert problem.limits is not None
    angles = 2.0 * np.pi * np.arange(FACETS) / FACETS
    rows: list[np.ndarray] = []
    for k in range(count):
        mu, gamma = models.friction[k], models.torsional_friction[k]
        for a in angles if mu.any() else ():
            row = np.zeros((count, 4))
            row[k, :3] = -1.0, np.cos(a) / mu[0], np.sin(a) / mu[1]
            rows.append(row)
        for sign in (1.0, -1.0) if gamma > 0.0 else ():
            row = np.zeros((count, 4))
            row[k, 0], row[k, 3] = -gamma, sign
            rows.append(row)
    free = np.column_stack([models.cone_scale > 0.0, models.torsional_friction > 0.0]).reshape(-1)
    limit = problem.limits.rows(grasp)
    bounds = [((0.0 if j % 4 == 0 else None), None) if free[j] else (0.0, 0.0) for j in range(4 * count)]
    found = linprog(
        np.column_stack([pull, turn]).reshape(-1),
        A_ub=np.vstack([np.array(rows).reshape(-1, 4 * count), limit.matrix]),
        b_ub=np.append(np.zeros(len(rows)), limit.bound),
        bounds=bounds,
        method="highs",
    )
    return -np.inf if found.status == 2 else float(-found.fun) if found.status == 0 else np.inf
