"""References of the tracks, made from the problems: `refer`.

A reference is a force with multipliers that prove it optimal, or a witness that no force exists.
`Measure` computes the bounds from the problem alone, so the proof does not depend on the solver.
The numbers are the package's: conic for `sum`, newton for `phi`. In a track of many digits, and
where doubles leave too large a gap, `exact` continues from the package's force with mpmath.

`exact` solves hard contacts without limits and margin in cone coordinates x = (u, o, t), u =
friction * normal. It minimises

    phi     3 sum u + lambda sum (1 / u + 2 u / det x)
    sum     c . x - weight sum log det x,   weight -> 0

over balance A x = b, with det x = u^2 - o^2 - t^2, by damped Newton steps. For `sum` it follows the
minimisers as the weight falls, until the gap 2 N weight is `EXACT_GAP` of the optimum.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np
from mpmath import mp

from benchmarks.force.bounds import Measure, Numbers
from benchmarks.force.package import grasp_of, margin_of
from benchmarks.force.problems import Array, Problem, Reference, Session
from grasp_env.errors import GraspError, GraspWarning, InfeasibleWrenchError
from grasp_env.force import ForceOptimizer

GAP = 1e-9
"""Largest (upper - lower) / upper."""
TOLERANCES = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)
"""Tolerances that are tried until the gap is a tenth of `GAP`; the best answer counts."""
DIGITS = 100
"""Digits of `exact`. The Hessian of a barrier spans up to twice the digits of the gap."""
EXACT_GAP, CLOSE, CONVERGED = mp.mpf("1e-18"), mp.mpf("0.1"), mp.mpf("1e-20")
"""Relative gap of `sum`, and Newton decrements in units of the weight: for each weight, at last."""
STEPS, HALVINGS = 300, 200
"""Most Newton steps for a weight (it takes 1 to 20), and most halvings of a step."""

FLIP = np.array([1, -1, -1], dtype=object)
Barrier = Callable[[Numbers, Any], Any]
"""Map x and a weight to gradient (N, 3) and Hessian (N, 3, 3); None outside the cones."""


@dataclass(frozen=True, eq=False)
class Certified:
    """The answer to a problem.

    Attributes:
        force, multipliers: (N k,), (6 + L,); the force is nan if the multipliers are a witness.
        lower, upper: bounds by `Measure`; inf if the witness proves that no force exists.
        rest: (N k + 6 + L,) rounding errors of both for results of `exact`, else None.
    """

    force: Array
    multipliers: Array
    lower: float
    upper: float
    rest: Array | None = None

    @property
    def gap(self) -> float:
        """(upper - lower) / upper; 0 if no force exists, inf if nothing is known."""
        if self.lower == np.inf:
            return 0.0
        return abs(self.upper - self.lower) / self.upper if 0.0 < self.upper < np.inf else np.inf

    @property
    def value(self) -> float:
        """The optimum."""
        return 0.5 * (self.lower + self.upper)


def refer(session: Session, objectives: Sequence[str], digits: str) -> dict[str, Reference]:
    """Return new references of a session's problems, by objective.

    Args:
        session: its references are not read.
        objectives: of the track.
        digits: "double": by the package, and by `exact` where that is not enough; "exact": all by
            `exact`.

    Raises:
        ValueError: a problem has no answer within `GAP`.
    """
    references = {}
    with ProcessPoolExecutor(2) as pool:
        for name in objectives:
            answers: list[Certified] = []
            for m, answer in enumerate(
                pool.map(_settled, session.problems, repeat(name), repeat(digits), chunksize=4)
            ):
                if isinstance(answer, str):
                    raise ValueError(f"session {session.name!r}, problem {m}, {name}: {answer}")
                answers.append(answer)
            references[name] = _reference(answers)
    return references


def distance(stored: Reference, other: Reference) -> float:
    """Return the largest relative difference of optima; inf if only one says that none exists."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(other.value - stored.value) / stored.value
    apart = np.where(np.isnan(apart), np.inf, apart)
    return float(np.where(other.value == stored.value, 0.0, apart).max())


def _settled(problem: Problem, name: str, digits: str) -> Certified | str:
    """Return an answer, or a message."""
    try:
        answer = exact(problem, name) if digits == "exact" else package(problem, name)
        if answer.gap > GAP and _plain(problem):
            answer = exact(problem, name)
    except (GraspError, ArithmeticError) as error:
        return str(error)
    if answer.gap <= GAP:
        return answer
    return f"the bounds {answer.lower!r} and {answer.upper!r} are a gap of {answer.gap:.1e}"


def _reference(answers: list[Certified]) -> Reference:
    """Return the record of a session; it has a rest if any answer has one."""
    names = ("value", "lower", "upper", "force", "multipliers")
    arrays = {name: np.array([getattr(a, name) for a in answers]) for name in names}
    if any(a.rest is not None for a in answers):
        none = np.zeros(len(answers[0].force) + len(answers[0].multipliers))
        arrays["rest"] = np.stack([none if a.rest is None else a.rest for a in answers])
    return Reference(**arrays)


def package(problem: Problem, name: str) -> Certified:
    """Return the answer of `ForceOptimizer`, or raise its `GraspError`."""
    grasp, limits = grasp_of(problem)
    margin = margin_of(problem)
    method = "conic" if name == "sum" else "newton"

    def answers() -> Iterator[tuple[Array, Array, bool]]:
        for tolerance in TOLERANCES:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GraspWarning)  # sizes of a kilometre are intended
                optimizer = ForceOptimizer(
                    grasp, method=method, limits=limits, tolerance=tolerance, margin=margin
                )
            try:
                solution = optimizer.solve(problem.wrench, contacts=problem.touching)
            except InfeasibleWrenchError as error:
                solution = error.solution
            if solution is None:
                continue
            force = np.column_stack([solution.force, solution.torsion])[:, : problem.width]
            multipliers = np.concatenate([solution.multipliers, solution.limit_multipliers])
            yield force.reshape(-1), multipliers, solution.certificate is not None

    return _best(problem, name, answers())


def _best(problem: Problem, name: str, answers: Iterable[tuple[Array, Array, bool]]) -> Certified:
    """Return the answer of the least gap, or the first valid witness."""
    measure = Measure.of(problem)
    none = best = Certified(
        np.full(problem.matrix.shape[1], np.nan), np.zeros(6 + len(measure.bound)), -np.inf, np.inf
    )
    for force, multipliers, infeasible in answers:
        if infeasible and measure.witness(multipliers) > 0.0:
            return replace(none, multipliers=multipliers, lower=np.inf)
        if infeasible or not (np.isfinite(force).all() and np.isfinite(multipliers).all()):
            continue
        lower = measure.lower(name, multipliers)
        upper = measure.upper(name, force, multipliers)
        answer = Certified(force, multipliers, float(lower), float(upper))
        if answer.gap < best.gap:
            best = answer
        if best.gap <= 0.1 * GAP:
            break
    return best


# --- many digits


def exact(problem: Problem, name: str) -> Certified:
    """Return the answer in `DIGITS` digits, or raise an `ArithmeticError`."""
    if not _plain(problem):
        raise ArithmeticError("many digits are for hard contacts without limits and margin")
    if name == "sum" and not problem.wrench.any():
        raise ArithmeticError("no wrench: the optimum of `sum` is zero")
    start = package(problem, "phi").force
    with mp.workdps(DIGITS):
        m = exact_measure(problem)
        on = np.flatnonzero(m.touching)
        mu = m.friction[on]
        matrix = m.matrix[:, on]  # A: a copy
        matrix[:, :, 0] /= mu
        costs = numbers(np.zeros((len(on), 3)))
        costs[:, 0] = m.cost(name)[on] / mu
        x = numbers(start).reshape(-1, 3)[on]
        x[:, 0] *= mu
        x, nu = _optimum(name, matrix, -m.load, costs, x, m.weight)
        force = numbers(np.zeros((len(m.friction), 3)))
        multipliers = m.about_origin(nu)
        force[on] = x
        force[on, 0] /= mu
        force = force.reshape(-1)
        lower = m.lower(name, multipliers)
        upper = m.upper(name, force, multipliers)
        (high, low), (first, rest) = map(split, (force, multipliers))
    return Certified(high, first, float(lower), float(upper), np.concatenate([low, rest]))


def _plain(problem: Problem) -> bool:
    """Return True for hard contacts without limits and margin."""
    return problem.width == 3 and not (len(problem.limit_bound) or problem.has_margin)


def exact_measure(problem: Problem) -> Measure:
    """Return the measure in numbers of mpmath, with frames made orthonormal in all digits.

    n is the first column of a frame at unit length, o the second across n, and t = n x o.
    """
    normal, along = (numbers(problem.frames[:, :, k]) for k in (0, 1))
    normal = normal / _norm(normal)
    along = along - normal * (normal * along).sum(axis=1)[:, None]
    along = along / _norm(along)
    return Measure.of(problem, numbers, np.stack([normal, along, np.cross(normal, along)], axis=2))


def numbers(values: Any) -> Numbers:
    """Convert to an object array of mpmath's numbers, exactly."""
    array = np.asarray(values)
    exact = np.empty(array.size, dtype=object)
    exact[:] = [mp.mpf(value) for value in array.reshape(-1).tolist()]
    return exact.reshape(array.shape)


def split(values: Numbers) -> tuple[Array, Array]:
    """Split numbers into the nearest floats and the remainders as floats."""
    high = values.astype(float)
    return high, (values - numbers(high)).astype(float)


def _norm(vectors: Numbers) -> Numbers:
    """Return the lengths (N, 1)."""
    return np.sqrt((vectors**2).sum(axis=1))[:, None]


def _optimum(
    name: str, matrix: Numbers, target: Numbers, costs: Numbers, x: Numbers, weight: Any
) -> tuple[Numbers, Numbers]:
    """Return the optimal x and nu over A x = target, from an x that balances in doubles."""
    if _phi(x, weight) is None:
        raise ArithmeticError("the package found no force strictly inside the cones")
    for _ in range(2):  # add what doubles miss of balance; twice, because a step rounds
        missed = target - np.einsum("rnk,nk->r", matrix, x)
        x = x + _step(matrix, _phi(x, weight)[1], 0 * x, missed)[0]
    value = (costs * x).sum()
    if name == "phi":
        return _minimised(_phi, matrix, costs, x, weight, CONVERGED * value)
    weight = value / (2 * len(x))
    while 2 * len(x) * weight > EXACT_GAP * (costs * x).sum():
        x, _ = _minimised(_log, matrix, costs, x, weight, CLOSE * weight)
        gradient, hessian = _log(x, weight)
        tangent, _ = _step(matrix, hessian, gradient * 9 / 10, 0 * target)
        x = x + _halved(tangent, lambda move, x=x: _log(x + move, 1) is not None)
        weight = weight / 10
    return _minimised(_log, matrix, costs, x, weight, CONVERGED * weight)


def _minimised(
    barrier: Barrier, matrix: Numbers, costs: Numbers, x: Numbers, weight: Any, close: Any
) -> tuple[Numbers, Numbers]:
    """Minimise costs . x + barrier(x, weight) from a balanced x inside the cones.

    The last step is the one whose squared Newton decrement is at most `close`.

    Returns:
        The minimiser, and nu with gradient = A^T nu.
    """
    for _ in range(STEPS):
        gradient, hessian = barrier(x, weight)
        slope = costs + gradient
        move, nu = _step(matrix, hessian, -slope, 0 * matrix[:, 0, 0])
        near = -(slope * move).sum() <= close

        def accepted(
            move: Numbers, x: Numbers = x, slope: Numbers = slope, near: bool = near
        ) -> bool:
            end = barrier(x + move, weight)
            return end is not None and (
                near or 4 * ((costs + end[0]) * move).sum() <= -(slope * move).sum()
            )

        x = x + _halved(move, accepted)
        if near:
            return x, nu
    raise ArithmeticError(f"{STEPS} Newton steps were not enough")


def _halved(move: Numbers, accepted: Callable[[Numbers], bool]) -> Numbers:
    """Halve the move until it is accepted."""
    for _ in range(HALVINGS):
        if accepted(move):
            return move
        move = move / 2
    raise ArithmeticError("no step leads down inside the cones")


def _step(
    matrix: Numbers, hessian: Numbers, right: Numbers, missed: Numbers
) -> tuple[Numbers, Numbers]:
    """Return dx (N, 3) and nu (6,) with hessian dx - A^T nu = right and A dx = missed."""
    inverse = np.stack([numbers(mp.inverse(mp.matrix(h.tolist())).tolist()) for h in hessian])
    back = np.einsum("rnk,nkl->rnl", matrix, inverse)
    square = np.einsum("rnk,snk->rs", back, matrix)
    lack = missed - np.einsum("rnk,nk->r", back, right)
    nu = numbers([*mp.lu_solve(mp.matrix(square.tolist()), mp.matrix(lack.tolist()))])
    return np.einsum("nkl,nl->nk", inverse, right + np.einsum("rnk,r->nk", matrix, nu)), nu


def _log(x: Numbers, weight: Any) -> Any:
    """Differentiate -weight sum log det x, a `Barrier`."""
    flipped = x * FLIP  # half the gradient of det
    det = (x * flipped).sum(axis=1)[:, None]
    if not ((x[:, 0] > 0) & (det[:, 0] > 0)).all():
        return None
    half = flipped / det
    return -2 * weight * half, weight * (
        4 * _outer(half, half) - 2 * np.diag(FLIP) / det[:, :, None]
    )


def _phi(x: Numbers, weight: Any) -> Any:
    """Differentiate weight sum (1 / u + 2 u / det x), a `Barrier`."""
    flipped = x * FLIP
    up = np.array([1, 0, 0], dtype=object) + 0 * x
    det = (x * flipped).sum(axis=1)[:, None]
    u = x[:, :1]
    if not ((u > 0) & (det > 0)).all():
        return None
    gradient = up * (2 / det - 1 / u**2) - 4 * u * flipped / det**2
    both = _outer(up, flipped) + _outer(flipped, up) + u[:, :, None] * np.diag(FLIP)
    hessian = (
        _outer(up, 2 * up / u**3)
        - 4 * both / det[:, :, None] ** 2
        + _outer(flipped, 16 * u * flipped / det**3)
    )
    return weight * gradient, weight * hessian


def _outer(a: Numbers, b: Numbers) -> Numbers:
    """Return the products (N, 3, 3) of (N, 3)."""
    return a[:, :, None] * b[:, None]
