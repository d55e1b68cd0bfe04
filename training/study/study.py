"""What the paper leaves open, computed: weights, step rules, forms, rates. Numbers only, no pictures.

The paper prints neither omega, lambda nor alpha_k and names their influence as future work.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import null_space

from grasp_env import core
from grasp_env._check import Array
from grasp_env.errors import UnknownNameError
from grasp_env.force import ForceOptimizer, Objective, OfflineBasis
from grasp_env.force.basis import core_contacts
from grasp_env.force.description import METRIC
from grasp_env.force.record import CODE, ITERATIONS, TRIALS, record_size
from grasp_env.force.step_size import AdaptiveStep, ArmijoStep, BarzilaiBorweinStep, ExactStep, FixedStep, StepRule
from grasp_env.grasp import Grasp, wrench
from training.cases.set_table import TOLERANCE
from training.runs.statistics import spread

LAMBDA = 0.01
"""[N^2] of Phi wherever it is not what is studied."""
OMEGAS = (0.5, 1.0, 2.0)
LAMBDAS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
FIXED_SIZES = tuple(float(size) for size in 10.0 ** np.arange(0.5, -4.6, -0.125))
"""Constant steps to try [N / omega], longest first."""
RULE_LABELS = {
    "fixed": "fixed, tuned",
    "armijo": "Armijo",
    "adaptive": "adaptive",
    "exact": "exact line search",
    "rough": "line search to a tenth",
    "bb_long": "Barzilai-Borwein, long",
    "bb_short": "Barzilai-Borwein, short",
    "bb_alternate": "Barzilai-Borwein, alternate",
}
ITERATION_LIMIT = 20_000
OTHER_LAMBDAS = (0.01, 0.1)
"""For omega other than 1."""
ROWS = len(LAMBDAS) + (len(OMEGAS) - 1) * len(OTHER_LAMBDAS)


def rules(fixed: float) -> dict[str, StepRule]:
    """Every step rule by its key in `RULE_LABELS`; `fixed` is the constant step."""
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


FORMS = ("full", "paper", "reduced")
"""Ways to make the same step: Q times vec(P^-1 W_i P^-1 - W_p) (Eqs. 9-12), Q_bar times VWP (Eqs. 18-26), and the fewest products."""


def operations(form: str, count: int) -> int:
    """Multiplications of one product step for N = `count` contacts; see the core's `projection.hpp`.

    Example:
        >>> [operations(form, 4) for form in FORMS]
        [20736, 432, 144]
    """
    n = 3 * count
    counts = {"full": n**4, "paper": 3 * n**2, "reduced": n**2 if count <= 4 else 13 * n}
    if form not in counts:
        raise UnknownNameError("form of the flow", form, FORMS)
    return counts[form]


class Cases:
    """One Phi on one grasp: the 12-basis starts of some wrenches, their optima, and the flow in one form.

    Attributes:
        starts: (n, N, 3) forces [N].
        optima: (n,) min Phi, by Newton to 1e-11.
        forces: (n, N, 3) the optimal forces [N].
    """

    def __init__(self, grasp: Grasp, objective: Objective, wrenches: Array, form: str = "reduced") -> None:
        self.wrenches, self.omega, self.form = wrenches, float(objective.weights(1)[0, 0]), form
        self.grasp, self._contacts = grasp, core_contacts(grasp, objective)
        self._basis = OfflineBasis.of(grasp, objective)
        self.starts = np.array([self._basis.combine(w) for w in wrenches])
        newton = ForceOptimizer(
            grasp,
            method="newton",
            force_weight=objective.force_weight,
            barrier_weight=objective.barrier_weight,
            tolerance=1e-11,
        )
        solutions = [newton.solve(w) for w in wrenches]
        self.optima = np.array([solution.objective for solution in solutions])
        self.forces = np.array([solution.force for solution in solutions])

    def flow(self, rule: StepRule, tolerance: float = TOLERANCE, limit: int = ITERATION_LIMIT) -> core.Flow:
        """The flow with that rule."""
        return core.Flow.on(self._contacts, tolerance, limit, self.form, rule.parameters())

    def run(self, flow: core.Flow, k: int, optimum: float, trace: Array) -> Array:
        """The record of wrench k from its start."""
        record = np.empty(record_size(self.grasp.n_contacts))
        flow.descend(self.wrenches[k], self.starts[k], optimum, trace, record)
        return record

    def iterations(self, rule: StepRule, count: int | None = None) -> tuple[Array, Array]:
        """(accepted steps, trials) of the first `count` wrenches to a gap of 1e-4; inf where it did not get there."""
        out, flow = np.full((2, len(self.wrenches[:count])), np.inf), self.flow(rule)
        for k in range(out.shape[1]):
            record = self.run(flow, k, float(self.optima[k]), np.empty(0))
            if record[CODE] == 0:
                out[:, k] = record[ITERATIONS], record[TRIALS]
        return out[0], out[1]

    def microseconds(self, rule: StepRule, repeats: int = 5) -> Array:
        """(n,) shortest of `repeats` certified compiled calls per wrench."""
        flow, best = self.flow(rule), np.empty(len(self.wrenches))
        flow.set_basis(self._basis.cone_forces)
        flow.times(self.wrenches, repeats, np.empty((len(best), record_size(self.grasp.n_contacts))), best)
        return 1e6 * best

    def tuned_step(self, count: int = 20) -> float:
        """The longest constant step that never has to be halved on the first wrenches: their fastest, up to rounding."""
        omega = self.omega
        for size in FIXED_SIZES:
            steps, trials = self.iterations(FixedStep(size / omega), count)
            if (steps == trials).all() and np.isfinite(steps).all():
                return size / omega
        return FIXED_SIZES[-1] / omega


def least_forces(grasp: Grasp, wrenches: Array) -> Array:
    """(n,) least total normal force of the exact cones [N], by the conic interior point."""
    conic = ForceOptimizer(grasp, method="conic")
    return np.array([conic.solve(w).raise_for_status().total_normal_force for w in wrenches])


def weights_study(grasp: Grasp, wrenches: Array, tick: Callable[[], None]) -> list[dict[str, Any]]:
    """Iterations and force excess over omega, lambda and step rule: one row per (omega, lambda).

    Scaling Phi by omega changes neither its optimum nor, with steps in units of 1 / omega, the iterates: what matters is
    lambda / omega. Rows with omega != 1 show what is left, the first trial step.
    """
    least = least_forces(grasp, wrenches)
    rows = []
    for omega in OMEGAS:
        for lam in LAMBDAS if omega == 1.0 else OTHER_LAMBDAS:
            cases = Cases(grasp, Objective(omega, lam), wrenches)
            fixed = cases.tuned_step()
            excess = cases.forces[:, :, 0].sum(axis=1) / least - 1.0
            row: dict[str, Any] = {"omega": omega, "lambda": lam, "fixed_step": fixed, "excess": spread(excess)}
            row["rules"] = {}
            for key, rule in rules(fixed).items():
                steps, trials = cases.iterations(rule)
                done = np.isfinite(steps)
                row["rules"][key] = {
                    "iterations": spread(steps[done]),
                    "trials": spread(trials[done]),
                    "not_converged": int((~done).sum()),
                }
            rows.append(row)
            tick()
    return rows


def rule_times(grasp: Grasp, wrenches: Array) -> dict[str, Any]:
    """Microseconds of a compiled call from the 12-basis to a certified gap of 1e-4, per rule, lambda 0.01."""
    cases = Cases(grasp, Objective(1.0, LAMBDA), wrenches)
    return {key: spread(cases.microseconds(rule)) for key, rule in rules(cases.tuned_step()).items()}


def spectrum(grasp: Grasp, objective: Objective, x: Array) -> tuple[float, float]:
    """(least, largest) eigenvalue of the Hessian of Phi on ker G, orthonormal in the metric of P: the flow's rates."""
    root = np.sqrt(np.tile(METRIC, grasp.n_contacts))
    basis = null_space(grasp.cone_matrix / root) / root[:, None]
    blocks = objective.hessian(x)
    whole = np.zeros((len(x), len(x)))
    for k, block in enumerate(blocks):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    values = np.linalg.eigvalsh(basis.T @ whole @ basis)
    return float(values[0]), float(values[-1])


def rate_study(grasp: Grasp, load: Array) -> dict[str, Any]:
    """The gap against iterations on one wrench per rule, fitted and predicted rates, and how far the forms differ.

    A fitted rate is the factor per iteration of the gap between 1e-3 and 1e-9. Predicted, kappa = L / m the condition
    number of the projected Hessian at the optimum: (1 - alpha m)^2 for a constant step alpha < 2 / (L + m), at worst
    ((kappa - 1) / (kappa + 1))^2 for the exact line search. The other rules have no such formula.
    """
    objective = Objective(1.0, LAMBDA)
    cases = Cases(grasp, objective, load[None])
    least, largest = spectrum(grasp, objective, grasp.to_cone(cases.forces[0]))
    kappa = largest / least
    fixed = 2.0 / (least + largest)
    worst = ((kappa - 1.0) / (kappa + 1.0)) ** 2
    predicted = {"fixed": (1.0 - fixed * least) ** 2, "exact": worst}
    gaps = {key: _gaps(cases, rule) for key, rule in rules(fixed).items()}
    forms = {}
    reference = _gaps(cases, AdaptiveStep(), limit=40) + 1.0
    for form in FORMS:
        trace = _gaps(Cases(grasp, objective, load[None], form), AdaptiveStep(), limit=40) + 1.0
        forms[form] = float(np.abs(trace / reference - 1.0).max())
    return {
        "least_eigenvalue": least,
        "largest_eigenvalue": largest,
        "condition": kappa,
        "fixed_step": fixed,
        "gaps": {key: np.maximum(values, 1e-14) for key, values in gaps.items()},
        "rates": {key: {"fitted": _fit(values), "predicted": predicted.get(key)} for key, values in gaps.items()},
        "forms": forms,
    }


def _gaps(cases: Cases, rule: StepRule, limit: int = 5000) -> Array:
    trace = np.full(limit + 1, np.nan)
    best = float(cases.optima[0])
    record = cases.run(cases.flow(rule, 1e-12, limit), 0, best, trace)
    return trace[: int(record[ITERATIONS]) + 1] / best - 1.0


def _fit(gaps: Array) -> float | None:
    """Factor per iteration by least squares on the logarithm; None with fewer than three points."""
    inside = np.flatnonzero((gaps < 1e-3) & (gaps > 1e-9))
    if len(inside) < 3:
        return None
    return float(np.exp(np.polyfit(inside, np.log(gaps[inside]), 1)[0]))


def cost_study(grasps: dict[str, Grasp], repeats: int) -> list[dict[str, Any]]:
    """Multiplications counted and nanoseconds measured, per product step and per whole iteration of every form.

    Forms take turns, `repeats` times; medians. The rest of an iteration is Phi, its gradient and the step rule; the
    matrices are in the cache, as in a control loop that does nothing else.
    """
    rows = []
    load = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.008])
    for name, grasp in grasps.items():
        times: dict[str, list[tuple[float, float]]] = {form: [] for form in FORMS}
        cases = {form: Cases(grasp, Objective(1.0, LAMBDA), load[None], form) for form in FORMS}
        for _ in range(repeats):
            for form in FORMS:
                times[form].append((_product_time(cases[form]), _iteration_time(cases[form])))
        for form in FORMS:
            product, iteration = np.median(times[form], axis=0)
            full = np.median(times["full"], axis=0)[0]
            rows.append(
                {
                    "grasp": name,
                    "contacts": grasp.n_contacts,
                    "form": form,
                    "operations": operations(form, grasp.n_contacts),
                    "product_ns": float(product),
                    "iteration_ns": float(iteration),
                    "speed_up": float(full / product),
                }
            )
    return rows


def _product_time(cases: Cases) -> float:
    flow, x = cases.flow(AdaptiveStep()), cases.grasp.to_cone(cases.starts[0])
    times = 100 if cases.form == "full" else 5000  # a fifth of a millisecond: seldom interrupted

    def call(count: int) -> float:
        begin = time.perf_counter_ns()
        flow.repeat(x, count)
        return float(time.perf_counter_ns() - begin)

    call(1)
    return (call(times) - call(1)) / (times - 1)


def _iteration_time(cases: Cases) -> float:
    """Nanoseconds per accepted step with a step short enough that neither trials fail nor an optimum comes near."""

    def call(limit: int) -> float:
        flow = cases.flow(FixedStep(1e-6), limit=limit)
        begin = time.perf_counter_ns()
        record = cases.run(flow, 0, 1e-9, np.empty(0))
        elapsed = float(time.perf_counter_ns() - begin)
        assert (record[CODE], record[ITERATIONS], record[TRIALS]) == (1, limit, limit)
        return elapsed

    times = 100 if cases.form == "full" else 1000
    call(1)
    return (call(times + 1) - call(1)) / times


def path_study(grasp: Grasp, fine: float, tick: Callable[[], None]) -> dict[str, Any]:
    """Forces along W_ext(t), 2 s: the pyramid linear program beside the continuous optima of Phi and of the exact cones.

    Args:
        grasp: the grasp.
        fine: time between samples [s]; the coarse ones are ten times as far apart.
        tick: called once per method.

    Returns:
        Per method "excess" over the exact conic minimum, "jump": the largest change of a finger's force between coarse
        and between fine samples [N] (ten times less where forces are continuous, the same at a jump), and "kink": the
        largest change of its rate [N/s] (ten times less where forces are smooth, the same at a kink).
    """
    times = np.arange(0.0, 2.0, fine)
    methods = {
        "phi": ForceOptimizer(grasp, method="newton", tolerance=1e-13),
        "conic": ForceOptimizer(grasp, method="conic"),
        "linear": ForceOptimizer(grasp, method="linear"),
    }
    forces: dict[str, Array] = {}
    for key, optimizer in methods.items():
        forces[key] = np.array([optimizer.solve(w).force for w in wrench.paper_path(times)])
        tick()
    least = forces["conic"][:, :, 0].sum(axis=1)
    out: dict[str, Any] = {"fine": fine, "coarse": 10.0 * fine, "time": times, "forces": forces, "methods": {}}
    for key, values in forces.items():
        out["methods"][key] = {
            "excess": spread(values[:, :, 0].sum(axis=1) / least - 1.0),
            "jump": [_largest(np.diff(part, axis=0)) for part in (values[::10], values)],
            "kink": [
                _largest(np.diff(part, n=2, axis=0)) / step
                for part, step in ((values[::10], 10.0 * fine), (values, fine))
            ],
        }
    return out


def _largest(changes: Array) -> float:
    return float(np.linalg.norm(changes, axis=2).max())
