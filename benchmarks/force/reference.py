"""References: certified optima by two independent solvers, and what `validate` checks of them.

Source 1 is the package (conic for `sum`, newton for `phi`), source 2 Clarabel. `bounds` measures both. Where they leave an optimum of
hard contacts without limits open, or on request, both algorithms of `exact` take their place.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from benchmarks.force import bounds, exact
from benchmarks.force.bounds import Measure
from benchmarks.force.package import grasp_of
from benchmarks.force.problems import Array, Problem, Reference, Session, Track
from grasp_env.errors import GraspError, GraspWarning, InfeasibleWrenchError
from grasp_env.force import ForceOptimizer

GAP = 1e-9
"""Largest (upper - lower) / upper of a source."""
AGREEMENT = 1e-8
"""Largest relative distance between the sources."""
ROUNDING = 1e-11
"""Relative change of a bound that is computed anew: sums in another order round differently, and forces beyond the wrench amplify it."""
TOLERANCES = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)
"""Tolerances that the solvers are given one after the other, until the gap is a tenth of `GAP`; the best answer counts."""


@dataclass(frozen=True, eq=False)
class Found:
    """The answer of a source to a problem.

    Attributes:
        force, multipliers: (N k,), (6 + L,); the force is nan where the multipliers are a witness.
        lower, upper: bounds by `bounds`; inf where the witness proves that no force exists.
        rest: (N k + 6 + L,) what is left of both below the last digit, of answers by `exact`; else None.
    """

    force: Array
    multipliers: Array
    lower: float
    upper: float
    rest: Array | None = None

    @property
    def gap(self) -> float:
        """(upper - lower) / upper; 0 where no force exists, inf where nothing is known."""
        if self.lower == np.inf:
            return 0.0
        return (self.upper - self.lower) / self.upper if 0.0 < self.upper < np.inf else np.inf

    @property
    def value(self) -> float:
        """The optimum."""
        return 0.5 * (self.lower + self.upper)


def refer(
    session: Session, objectives: Sequence[str], digits: str = "double", processes: int = 2
) -> dict[str, Reference]:
    """The references of a session's problems, by objective.

    Args:
        session: its references are not read.
        objectives: of the track.
        digits: "double": by the package and Clarabel, and by `exact` where they are not enough; "exact": all by `exact`.
        processes: that work at once.

    Raises:
        ValueError: a problem is not settled; the message names it.
    """
    problems = session.problems
    tasks = [(problem, name, digits) for name in objectives for problem in problems]
    with ProcessPoolExecutor(processes) as pool:
        found = list(pool.map(_settled, tasks, chunksize=4))
    made = {}
    for start, name in zip(range(0, len(tasks), len(problems)), objectives, strict=True):
        answers = []
        for m, answer in enumerate(found[start : start + len(problems)]):
            if isinstance(answer, str):
                raise ValueError(f"session {session.name!r}, problem {m}, {name}: {answer}")
            answers.append(answer)
        made[name] = _reference(answers)
    return made


def check(track: Track) -> list[str]:
    """Complaints about the references of a track; objectives, bounds and witnesses are computed anew from force and multipliers."""
    return [
        f"{track.name}, session {session.name!r}, {where}"
        for session in track.sessions
        for where in _complaints(session, track.about["objectives"])
    ]


def package(problem: Problem, name: str) -> Found:
    """Source 1: `ForceOptimizer`.

    Raises:
        GraspError: it refuses the problem.
    """
    grasp, limits = grasp_of(problem)
    method = "conic" if name == "sum" else "newton"

    def answers() -> Iterator[tuple[Array, Array, bool]]:
        for tolerance in TOLERANCES:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GraspWarning)  # sizes of a kilometre are meant
                optimizer = ForceOptimizer(grasp, method=method, limits=limits, tolerance=tolerance)
            try:
                solution = optimizer.solve(problem.wrench, contacts=problem.touching)
            except InfeasibleWrenchError as error:
                solution = error.solution
            if solution is None:
                continue
            force = np.column_stack([solution.force, solution.torsion])[:, : problem.width]
            yield (
                force.reshape(-1),
                np.concatenate([solution.multipliers, solution.limit_multipliers]),
                solution.certificate is not None,
            )

    return _best(problem, name, answers())


def clarabel(problem: Problem, name: str) -> Found:
    """Source 2: Clarabel on the cone program, from `bounds.Measure` alone."""
    found = _best(problem, name, map(_Program(problem, name).solve, TOLERANCES))
    if (
        name == "phi" and not abs(found.gap) <= GAP
    ):  # where no force exists, the shorter program of `sum` proves it more clearly
        proof = _best(problem, "sum", map(_Program(problem, "sum").solve, TOLERANCES))
        return proof if proof.lower == np.inf else found
    return found


class _Program:
    """The cone program in u = friction * normal, o, t and torsion * friction / torsional_friction, in units of the wrench.

    For `phi` a contact has r, y and z besides: u r >= root, u (u - z) >= o^2 + t^2, y z >= 2 root, and the price of r and y is
    root = sqrt(lambda): at the optimum they are root / u and root 2 u / (u^2 - o^2 - t^2).
    """

    def __init__(self, problem: Problem, name: str) -> None:
        measure = self.measure = Measure.of(problem)
        self.kept = np.flatnonzero(measure.touching)
        count, k = len(self.kept), problem.width
        mu = measure.friction[self.kept]
        self.scale = np.ones((count, k))
        self.scale[:, 0] = 1.0 / mu
        self.scale[:, 3:] = (measure.spin[self.kept] / mu)[:, None]
        least_normal = 0.0 if problem.min_normal is None else problem.min_normal.max()
        self.unit = (
            float(max(np.abs(measure.load).max(), least_normal, np.sqrt(measure.weight) if name == "phi" else 0.0))
            or 1.0
        )
        self.width, self.size = count * k, count * (k + 3 if name == "phi" else k)
        each = np.eye(self.size)
        at = each[: self.width].reshape(count, k, self.size)
        self.rows, self.sides, self.cones = [], [], []
        self._add("ZeroConeT", self._wide(measure.matrix), -measure.load / self.unit)
        limits = self._wide(measure.rows)
        self.lengths = np.linalg.norm(limits, axis=1)
        self.lengths[self.lengths == 0.0] = 1.0
        self._add("NonnegativeConeT", limits / self.lengths[:, None], measure.bound / self.unit / self.lengths)
        if k == 4:
            self._add(
                "NonnegativeConeT",
                np.concatenate([sign * at[:, 3] - at[:, 0] for sign in (1.0, -1.0)]),
                np.zeros(2 * count),
            )
        self.cost = np.zeros(self.size)
        self.cost[: self.width : k] = measure.price(name)[self.kept] / mu
        root = float(np.sqrt(measure.weight)) / self.unit
        for i in range(count):
            u, o, t = at[i, :3]
            if name == "sum":
                self._add("SecondOrderConeT", -np.stack([u, o, t]), np.zeros(3))
                continue
            r, y, z = each[self.width + 3 * i : self.width + 3 * i + 3]
            self.cost[self.width + 3 * i : self.width + 3 * i + 2] = root
            self._product(u, r, [], np.sqrt(root))
            self._product(u, u - z, [o, t], 0.0)
            self._product(y, z, [], np.sqrt(2.0 * root))

    def solve(self, tolerance: float) -> tuple[Array, Array, bool]:
        """Force, multipliers, and whether these are a witness."""
        solver, sparse = import_module("clarabel"), import_module("scipy.sparse")
        settings = solver.DefaultSettings()
        settings.verbose, settings.presolve_enable, settings.max_iter = False, False, 200
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        settings.tol_infeas_abs = settings.tol_infeas_rel = tolerance
        nothing, matrix = sparse.csc_matrix((self.size, self.size)), sparse.csc_matrix(np.vstack(self.rows))
        cones = [getattr(solver, cone)(len(side)) for cone, side in zip(self.cones, self.sides, strict=True)]
        found = solver.DefaultSolver(nothing, self.cost, matrix, np.concatenate(self.sides), cones, settings).solve()
        x, z = np.array(found.x), np.array(found.z)
        infeasible = "PrimalInfeasible" in str(found.status)
        count, limits = len(self.measure.friction), len(self.lengths)
        force = np.zeros((count, self.scale.shape[1]))
        force[self.kept] = x[: self.width].reshape(self.scale.shape) * self.scale * self.unit
        sign = 1.0 if infeasible else -1.0
        return (
            force.reshape(-1),
            np.concatenate([self.measure.about_origin(sign * z[:6]), z[6 : 6 + limits] / self.lengths]),
            infeasible,
        )

    def _wide(self, rows: Array) -> Array:
        """Rows (R, N, k) on forces as rows on the variables."""
        kept = (rows[:, self.kept] * self.scale).reshape(len(rows), self.width)
        return np.concatenate([kept, np.zeros((len(rows), self.size - self.width))], axis=1)

    def _add(self, cone: str, rows: Array, side: Array) -> None:
        """Rows x + s = side, s in the cone."""
        if len(side):
            for kept, new in ((self.rows, rows), (self.sides, side), (self.cones, cone)):
                kept.append(new)

    def _product(self, a: Array, b: Array, others: list[Array], constant: float) -> None:
        """The constraint a b >= |others|^2 + constant^2."""
        rows = -np.stack([a + b, a - b, *(2.0 * other for other in others), 0.0 * a])
        side = np.zeros(len(rows))
        side[-1] = 2.0 * constant
        self._add("SecondOrderConeT", rows, side)


def _best(problem: Problem, name: str, answers: Iterable[tuple[Array, Array, bool]]) -> Found:
    """The answer of the least gap, or the first witness that holds."""
    none = best = Found(
        np.full(problem.matrix.shape[1], np.nan), np.zeros(6 + len(problem.limit_bound)), -np.inf, np.inf
    )
    for force, multipliers, infeasible in answers:
        if infeasible and bounds.witness(problem, multipliers) > 0.0:
            return replace(none, multipliers=multipliers, lower=np.inf)
        if infeasible or not (np.isfinite(force).all() and np.isfinite(multipliers).all()):
            continue
        lower, upper = (
            bounds.dual_bound(problem, name, multipliers),
            bounds.primal_bound(problem, name, force, multipliers),
        )
        found = Found(force, multipliers, lower, upper)
        if abs(found.gap) < abs(best.gap):
            best = found
        if abs(best.gap) <= 0.1 * GAP:
            break
    return best


def _settled(task: tuple[Problem, str, str]) -> tuple[Found, float] | str:
    """An answer and the optimum by the second source, or what is wrong."""
    problem, name, digits = task
    wrong = ""
    if digits != "exact":
        sources = []
        for source in (package, clarabel):
            try:
                sources.append(source(problem, name))
            except GraspError as error:
                wrong = f"{source.__name__}: {error}"
        if not wrong:
            wrong = _disagreement(*sources)
            if not wrong:
                return sources[0], sources[1].value
        if not _plain(problem):
            return wrong
    try:
        sources = [_exact(algorithm(problem, name)) for algorithm in (exact.primal, exact.dual)]
    except (ArithmeticError, ValueError) as error:
        return f"{wrong}; exact: {error}".removeprefix("; ")
    return _disagreement(*sources) or (sources[0], sources[1].value)


def _disagreement(first: Found, second: Found) -> str:
    """The reason why two sources do not settle a problem; empty if they do."""
    for which, source in (("first", first), ("second", second)):
        if abs(source.gap) > GAP:
            return f"the {which} source leaves a gap of {source.gap:.1e}: {source.lower!r} to {source.upper!r}"
    if first.value != second.value and not abs(first.value - second.value) <= AGREEMENT * abs(first.value):
        return f"the sources disagree: {first.value!r} and {second.value!r}"
    return ""


def _exact(optimum: exact.Optimum) -> Found:
    """An answer in floats, with what they leave."""
    parts = [exact.split(each) for each in (optimum.force, optimum.multipliers)]
    rest = np.concatenate([low for _, low in parts])
    return Found(parts[0][0], parts[1][0], float(optimum.lower), float(optimum.upper), rest)


def _reference(answers: list[tuple[Found, float]]) -> Reference:
    """The record of a session; rests are there if any problem has one."""
    found = [answer for answer, _ in answers]
    rests = None
    if any(each.rest is not None for each in found):
        none = np.zeros(len(found[0].force) + len(found[0].multipliers))
        rests = np.stack([none if each.rest is None else each.rest for each in found])
    return Reference(
        np.array([each.value for each in found]), np.array([each.lower for each in found]), np.array([each.upper for each in found]),
        np.array([other for _, other in answers]), np.stack([each.force for each in found]),
        np.stack([each.multipliers for each in found]), rests,
    )  # fmt: skip


def _complaints(session: Session, objectives: Sequence[str]) -> Iterator[str]:
    """Complaints about a session."""
    problems = session.problems
    for name in objectives:
        reference = session.references.get(name)
        if reference is None:
            yield f"{name}: no references"
            continue
        if len(reference.value) != len(problems):
            yield f"{name}: {len(reference.value)} references of {len(problems)} problems"
            continue
        for m, problem in enumerate(problems):
            yield from (f"problem {m}, {name}: {wrong}" for wrong in _wrong(problem, name, reference, m))


def _wrong(problem: Problem, name: str, reference: Reference, m: int) -> Iterator[str]:
    """Complaints about a reference."""
    value, other, force, multipliers = (
        getattr(reference, each)[m] for each in ("value", "other", "force", "multipliers")
    )
    stored = {"lower": reference.lower[m], "upper": reference.upper[m]}
    if value == np.inf:
        if not bounds.witness(problem, multipliers) > 0.0:
            yield f"the witness proves nothing: {bounds.witness(problem, multipliers):.1e}"
        if not (other == stored["lower"] == stored["upper"] == np.inf and np.isnan(force).all()):
            yield "no force exists, but not all bounds are inf and all forces nan"
        return
    rest = None if reference.rest is None or not reference.rest[m].any() else reference.rest[m]
    if rest is None:
        anew = bounds.dual_bound(problem, name, multipliers), bounds.primal_bound(problem, name, force, multipliers)
        reached = bounds.objective(problem, name, force)
    else:
        low, prices = np.split(rest, [len(force)])
        full = exact.joined(force, low)
        anew = exact.bounds_exact(problem, name, full, exact.joined(multipliers, prices))
        reached = exact.objective_exact(problem, name, full)
    for (which, bound), computed in zip(stored.items(), map(float, anew), strict=True):
        if not abs(bound - computed) <= ROUNDING * value:
            yield f"the {which} bound is {computed!r}, stored {bound!r}"
    for what, distance, most in (
        ("the gap between the bounds", stored["upper"] - stored["lower"], GAP),
        ("the distance of the value from the upper bound", value - stored["upper"], GAP),
        (
            "the distance of the value from the objective of the force",
            value - reached,
            AGREEMENT,
        ),
        ("the distance of the sources", value - other, AGREEMENT),
    ):
        if not abs(distance) <= most * value:
            yield f"{what} is {abs(distance) / value:.1e} of the optimum, more than {most:g}"


def _plain(problem: Problem) -> bool:
    """Hard contacts without limits."""
    return problem.width == 3 and not len(problem.limit_bound)
