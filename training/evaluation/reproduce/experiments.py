"""Study of what the paper leaves open: weights, step rules, rates, forms, W_ext(t), Table I.

The paper prints neither omega, lambda nor alpha_k and names their influence as future work.
`training.evaluation.report.reproduce_page` shows the rows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.linalg import block_diag, null_space

from grasp_env import core
from grasp_env.force import ForceOptimizer, Objective, OfflineBasis
from grasp_env.force.basis import core_contacts
from grasp_env.force.description import METRIC
from grasp_env.force.initial import InitialForceRule
from grasp_env.force.record import CODE, CONVERGED, ITERATIONS, LIMIT, TRIALS
from grasp_env.force.rules import initial_rule
from grasp_env.force.step_size import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    ExactStep,
    FixedStep,
    StepRule,
)
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.inputs.arguments import Array
from policies import LearnedInitialForce
from training.evaluation.reproduce.pyramids import pyramid_forces
from training.evaluation.results.bars import progress
from training.evaluation.results.table import pd, table

TOLERANCE = 1e-4
"""Relative gap of Phi at which a run ends."""
LAMBDA = 0.01
"""Barrier weight of Phi [N^2] where it is not varied."""
_BARRIERS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
WEIGHTS = (
    *((1.0, x) for x in _BARRIERS),
    *((omega, x) for omega in (0.5, 2.0) for x in (0.01, 0.1)),
)
"""Pairs (omega, lambda [N^2]) to compare.

Only lambda / omega matters to the optimum and, with steps in units of 1 / omega, to the iterates.
Rows with omega != 1 show the one remaining effect, the first trial step.
"""
FIXED_SIZES = tuple(float(size) for size in 10.0 ** np.arange(0.5, -4.6, -0.125))
"""Constant steps to try [N / omega], longest first."""
ITERATION_LIMIT = 20_000
FORMS = ("full", "paper", "reduced")
"""Ways to compute the same step.

"full" is Q times vec(P^-1 W_i P^-1 - W_p) (Eqs. 9-12), "paper" Q_bar times VWP (Eqs. 18-26),
"reduced" the fewest products.
"""
PAPER_TABLE: dict[str, tuple[tuple[float, ...], int | None]] = {
    "single_value": ((8.30, 2.73, 2.57, 2.40), 160),
    "lagrange": ((5.19, 1.59, 1.50, 1.51), 120),
    "linear_combination": ((4.15, 1.13, 1.15, 1.26), 80),
    "optimum": ((3.25, 0.66, 0.79, 1.21), None),
}
"""Table I by start: normal forces [N], and the steps quoted below it."""

Rows = Iterator[dict[str, Any]]


def run(quick: bool = False) -> pd.DataFrame:
    """Compute every part in turn, alone in this process; if `quick`, of few wrenches and samples.

    Returns:
        The rows. Cases: "weights", "times", "rates", "gaps", "forms", "costs_product",
        "costs_iteration", "path_<grasp>", "table_one" and "table_one_paper".
    """
    grasp = presets.paper_cuboid()
    five = presets.preset("five_finger_cuboid")
    wrenches = wrench.sample_ball(np.random.default_rng([0, 101]), 20 if quick else 200)
    load = np.array(wrench.PAPER_CONSTANT)
    fine = 0.005 if quick else 0.001
    studies = {
        **{
            f"omega {omega:g}, lambda {barrier:g}": weights(grasp, wrenches, omega, barrier)
            for omega, barrier in WEIGHTS
        },
        "times": times(grasp, wrenches),
        "rates": rates(grasp, load),
        "costs": costs((presets.tripod(), grasp, five), 9 if quick else 41),
        "path, paper_cuboid": path("paper_cuboid", grasp, fine),
        "path, five_finger_cuboid": path("five_finger_cuboid", five, fine),
        "Table I": table_one(grasp, load),
    }
    rows: list[dict[str, Any]] = []
    with progress() as bar:
        task = bar.add_task("reproduce", total=len(studies))
        for name, study in studies.items():
            bar.update(task, description=name)
            rows += study
            bar.advance(task)
    return table(rows)


def step_rules(fixed: float) -> dict[str, StepRule]:
    """Return every step rule by its key; `fixed` is the constant step."""
    return {
        "fixed": FixedStep(fixed),
        "armijo": ArmijoStep(),
        "adaptive": AdaptiveStep(),
        "exact": ExactStep(),
        "rough": ExactStep(0.1),
        "bb_long": BarzilaiBorweinStep(variant="long"),
        "bb_short": BarzilaiBorweinStep(variant="short"),
        "bb_alternate": BarzilaiBorweinStep(variant="alternate"),
    }


def operations(form: str, count: int) -> int:
    """Return the multiplications of a product step for N = `count`; see `projection.hpp`.

    Example:
        >>> [operations(form, 4) for form in FORMS]
        [20736, 432, 144]
    """
    n = 3 * count
    return {"full": n**4, "paper": 3 * n**2, "reduced": n**2 if count <= 4 else 13 * n}[form]


class Cases:
    """One Phi on one grasp: starts of the 12-basis, optima, and the flow in one form.

    Attributes:
        starts: (n, N, 3) forces [N].
        optima: (n,) min Phi, by Newton to 1e-11.
        forces: (n, N, 3) the optimal forces [N].
    """

    def __init__(
        self,
        grasp: Grasp,
        wrenches: Array,
        omega: float = 1.0,
        barrier: float = LAMBDA,
        form: str = "reduced",
    ) -> None:
        self.grasp = grasp
        self.wrenches = wrenches
        self.omega = omega
        self.form = form
        self.objective = Objective(omega, barrier)
        self.contacts = core_contacts(grasp, self.objective)
        basis = OfflineBasis.of(grasp, self.objective)
        self.starts = np.array([basis.combine(load) for load in wrenches])
        newton = ForceOptimizer(grasp, method="newton", tolerance=1e-11, **vars(self.objective))
        solutions = [newton.solve(load) for load in wrenches]
        self.optima = np.array([solution.objective for solution in solutions])
        self.forces = np.array([solution.force for solution in solutions])

    def run(
        self,
        rule: StepRule,
        k: int,
        optimum: float,
        tolerance: float = TOLERANCE,
        limit: int = ITERATION_LIMIT,
        trace: Array | None = None,
    ) -> Array:
        """Descend from the start of wrench k and return the core's record."""
        record = np.empty(core.record_size(self.grasp.n_contacts))
        options = core.Options(step_rule=rule.parameters(), tolerance=tolerance, limit=limit)
        request = core.Request(force=self.starts[k], optimum=optimum, trace=trace)
        core.descend_flow(self.contacts, self.form, options, self.wrenches[k], request, record)
        return record

    def descents(self, rule: StepRule, count: int | None = None) -> list[Array]:
        """Return the records of the first `count` wrenches, each run to a gap of 1e-4."""
        return [self.run(rule, k, float(self.optima[k])) for k in range(len(self.wrenches[:count]))]

    def gaps(self, rule: StepRule, limit: int = 5000) -> Array:
        """Return the relative gaps of Phi (steps + 1,) on the first wrench, down to 1e-12."""
        trace = np.full(limit + 1, np.nan)
        best = float(self.optima[0])
        record = self.run(rule, 0, best, 1e-12, limit, trace)
        return trace[: int(record[ITERATIONS]) + 1] / best - 1.0

    def certified(
        self, rule: StepRule, initial: str | InitialForceRule, repeats: int = 5
    ) -> tuple[Array, Array]:
        """Return the shortest times (n,) [us] of certified compiled calls, and iterations (n,)."""
        options = {"step_rule": rule, "initial": initial, **vars(self.objective)}
        flow = ForceOptimizer(self.grasp, method="reduced_flow", **options)
        best = np.empty(len(self.wrenches))
        rows = np.empty((len(self.wrenches), flow.core.size))
        flow.core.times(self.wrenches, repeats, rows, best)
        return 1e6 * best, rows[:, ITERATIONS]

    def tuned_step(self, count: int = 20) -> float:
        """Return the longest constant step that is never halved on the first `count` wrenches."""
        for size in FIXED_SIZES:
            records = np.array(self.descents(FixedStep(size / self.omega), count))
            never_halved = records[:, ITERATIONS] == records[:, TRIALS]
            if (never_halved & (records[:, CODE] == CONVERGED)).all():
                return size / self.omega
        return FIXED_SIZES[-1] / self.omega


def weights(grasp: Grasp, wrenches: Array, omega: float, barrier: float) -> Rows:
    """Yield every rule's iterations on every wrench, and the excess over the least normal force."""
    conic = ForceOptimizer(grasp, method="conic")
    least = np.array([conic.solve(load).raise_for_status().total_normal_force for load in wrenches])
    cases = Cases(grasp, wrenches, omega, barrier)
    excess = cases.forces[:, :, 0].sum(axis=1) / least - 1.0
    fixed = cases.tuned_step()
    statuses = {CONVERGED: "optimal", LIMIT: "iteration_limit"}
    for name, rule in step_rules(fixed).items():
        for k, record in enumerate(cases.descents(rule)):
            row = {
                "case": "weights",
                "rule": name,
                "force_weight": omega,
                "barrier_weight": barrier,
                "problem": k,
                "status": statuses.get(int(record[CODE]), "stalled"),
                "force_excess": excess[k],
            }
            if record[CODE] == CONVERGED:
                row |= {"iterations": int(record[ITERATIONS]), "trials": int(record[TRIALS])}
            yield row | ({"step_size": fixed} if name == "fixed" else {})


def times(grasp: Grasp, wrenches: Array) -> Rows:
    """Yield time and iterations of compiled calls to a certified gap of 1e-4, lambda 0.01."""
    cases = Cases(grasp, wrenches)
    paper = "linear_combination"
    starts = {paper: paper, "learned_fixed": LearnedInitialForce.pretrained()}
    for name, rule in step_rules(cases.tuned_step()).items():
        for start, initial in starts.items():
            for k, (value, steps) in enumerate(zip(*cases.certified(rule, initial), strict=True)):
                yield {
                    "case": "times",
                    "rule": name,
                    "start": start,
                    "barrier_weight": LAMBDA,
                    "problem": k,
                    "microseconds": value,
                    "iterations": int(steps),
                }


def spectrum(cases: Cases) -> tuple[float, float]:
    """Return the extreme eigenvalues of the Hessian of Phi on ker G at the first optimum."""
    grasp = cases.grasp
    force = cases.forces[0]
    root = np.sqrt(np.tile(METRIC, grasp.n_contacts))
    basis = null_space(grasp.cone_matrix / root) / root[:, None]
    whole = block_diag(*cases.objective.hessian(grasp.to_cone(force)))
    values = np.linalg.eigvalsh(basis.T @ whole @ basis)
    return float(values[0]), float(values[-1])


def rates(grasp: Grasp, load: Array) -> Rows:
    """Yield gaps on one wrench, fitted and predicted rates, and differences between the forms.

    A rate is the factor per iteration of the gap, fitted between 1e-3 and 1e-9. With the projected
    Hessian's eigenvalues between m and L, kappa = L / m, the prediction is (1 - alpha m)^2 for a
    constant step alpha < 2 / (L + m), and at worst ((kappa - 1) / (kappa + 1))^2 for the exact line
    search; other rules have none.
    """
    cases = Cases(grasp, load[None])
    least, largest = spectrum(cases)
    kappa = largest / least
    fixed = 2.0 / (least + largest)
    predicted = {"fixed": (1.0 - fixed * least) ** 2, "exact": ((kappa - 1.0) / (kappa + 1.0)) ** 2}
    for name, rule in step_rules(fixed).items():
        gaps = cases.gaps(rule)
        yield {
            "case": "rates",
            "rule": name,
            "rate": _fitted(gaps),
            "rate_predicted": predicted.get(name),
            "eigenvalue_least": least,
            "eigenvalue_largest": largest,
            "step_size": fixed if name == "fixed" else None,
        }
        for step, gap in enumerate(np.maximum(gaps, 1e-14)):
            yield {"case": "gaps", "rule": name, "step": step, "gap": gap}
    reference = cases.gaps(AdaptiveStep(), 40)
    for form in FORMS:
        trace = Cases(grasp, load[None], form=form).gaps(AdaptiveStep(), 40)
        difference = np.abs((trace + 1.0) / (reference + 1.0) - 1.0).max()
        yield {"case": "forms", "form": form, "form_difference": difference}


def _fitted(gaps: Array) -> float | None:
    """Fit the factor per iteration to the logarithm; None with fewer than three points."""
    inside = np.flatnonzero((gaps < 1e-3) & (gaps > 1e-9))
    if len(inside) < 3:
        return None
    return float(np.exp(np.polyfit(inside, np.log(gaps[inside]), 1)[0]))


def costs(grasps: tuple[Grasp, ...], repeats: int) -> Rows:
    """Yield multiplications and nanoseconds per product step and per iteration of every form.

    The forms take turns, `repeats` times, with their matrices in the cache. The rest of an
    iteration is Phi, its gradient and the step rule.
    """
    load = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.008])
    for grasp in grasps:
        count = grasp.n_contacts
        cases = {form: Cases(grasp, load[None], form=form) for form in FORMS}
        for k in range(repeats):
            for form in FORMS:
                row = {"form": form, "contacts": count, "problem": k}
                row["operations"] = operations(form, count)
                yield {"case": "costs_product", **row, "nanoseconds": _product(cases[form])}
                yield {"case": "costs_iteration", **row, "nanoseconds": _iteration(cases[form])}


def _product(cases: Cases) -> float:
    x = cases.grasp.to_cone(cases.starts[0])

    def step(count: int) -> None:
        core.repeat_step(cases.contacts, cases.form, x, count)

    # a measurement takes a fifth of a millisecond, so it is rarely interrupted
    return _time_repetition(step, 100 if cases.form == "full" else 5000)


def _iteration(cases: Cases) -> float:
    """Return the nanoseconds per step; the step is so short that no trial fails."""

    def descend(count: int) -> None:
        record = cases.run(FixedStep(1e-6), 0, 1e-9, limit=count)
        assert (record[CODE], record[ITERATIONS], record[TRIALS]) == (LIMIT, count, count)

    return _time_repetition(descend, 100 if cases.form == "full" else 1000)


def _time_repetition(call: Callable[[int], object], count: int) -> float:
    """Return the nanoseconds per repetition, without the overhead of a call."""

    def clock(times: int) -> int:
        begin = time.perf_counter_ns()
        call(times)
        return time.perf_counter_ns() - begin

    clock(1)
    return (clock(count + 1) - clock(1)) / count


def path(name: str, grasp: Grasp, fine: float) -> Rows:
    """Yield forces along W_ext(t), 2 s, of the linear program, of Phi and of the exact cones.

    "jump" is the change of a finger's force since the sample before, and "kink" the change of its
    rate. With samples ten times closer, both become ten times smaller if the forces are smooth.
    `fine` is the time between samples [s]; the coarse samples are ten times as far apart.
    """
    times = np.arange(0.0, 2.0, fine)
    loads = wrench.paper_path(times)
    forces: dict[str, Array] = {}
    for key, method, tolerance in (("phi", "newton", 1e-13), ("conic", "conic", None)):
        optimizer = ForceOptimizer(grasp, method=method, tolerance=tolerance)
        forces[key] = np.array([optimizer.solve(load).force for load in loads])
    forces["linear"] = np.array([pyramid_forces(grasp, load) for load in loads])
    least = forces["conic"][:, :, 0].sum(axis=1)
    for key, values in forces.items():
        excess = values[:, :, 0].sum(axis=1) / least - 1.0
        for interval, samples in ((10.0 * fine, values[::10]), (fine, values)):
            jumps, kinks = (
                np.linalg.norm(np.diff(samples, order, axis=0), axis=2) for order in (1, 2)
            )
            for k, contact in np.ndindex(samples.shape[:2]):
                row = {
                    "case": f"path_{name}",
                    "method": key,
                    "interval": interval,
                    "time": interval * k,
                    "contact": contact,
                    "contact_force": samples[k, contact, 0],
                }
                if interval == fine and contact == 0:  # once for all fingers
                    row["force_excess"] = excess[k]
                if k > 0:
                    row["jump"] = jumps[k - 1, contact]
                if k > 1:
                    row["kink"] = kinks[k - 2, contact] / interval
                yield row


def table_one(grasp: Grasp, load: Array) -> Rows:
    """Yield normal forces and flow steps on the paper's constant wrench, and the printed."""
    phi = Objective(1.0, LAMBDA)
    newton = ForceOptimizer(grasp, method="newton", barrier_weight=LAMBDA, tolerance=1e-10)
    optimum = newton.solve(load)
    flow = ForceOptimizer(grasp, method="reduced_flow", barrier_weight=LAMBDA, tolerance=TOLERANCE)
    for start, (normals, steps) in PAPER_TABLE.items():
        force, iterations = optimum.force, None
        if start != "optimum":
            force = initial_rule(start, phi)(grasp, load)
            iterations = flow.solve(load, initial=force, optimum=optimum.objective).iterations
        for case, values, count in (
            ("table_one", force[:, 0], iterations),
            ("table_one_paper", normals, steps),
        ):
            for contact, value in enumerate(values):
                row = {"case": case, "start": start, "contact": contact, "contact_force": value}
                if contact == 0:
                    row |= {"iterations": count, "force_sum": sum(values)}
                yield row
