"""Other people's solvers of the conic force problem, each with the settings that serve it best. A new one is an entry of `PEERS`.

Packages are imported when a solver is made, so that this module imports without them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module

import numpy as np
from scipy import sparse
from scipy.optimize import minimize

from benchmarks.generated import FAST, Generated
from benchmarks.problem import Solver, dual_form
from grasp_env._check import Array, Wrench
from grasp_env.grasp import Grasp

_ROUND = 1e-16
"""[N^2] under the root: a gradient at the apex of a cone."""


class Clarabel(Solver):
    """Clarabel, updated in place; `tolerance` is that of gaps and feasibility."""

    def __init__(self, grasp: Grasp, tolerance: float = 1e-8) -> None:
        clarabel = import_module("clarabel")
        matrix, bound = dual_form(grasp)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        # either of these two would forbid the update
        settings.presolve_enable = False
        settings.chordal_decomposition_enable = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        cones = [clarabel.SecondOrderConeT(3)] * grasp.n_contacts
        self._solver = clarabel.DefaultSolver(sparse.csc_matrix((6, 6)), np.ones(6), matrix, bound, cones, settings)
        self._solved = clarabel.SolverStatus.Solved

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        self._solver.update(q=wrench)
        solution = self._solver.solve()
        force = np.array(solution.z)
        return force if solution.status == self._solved else np.full_like(force, np.nan)


class Qoco(Solver):
    """QOCO, updated in place.

    At 1e-8 it stalls on a few wrenches in a thousand, and a stall raises the regularisation of every later solve of
    the same object: hundreds fail. 1e-7 solves them all; the default is put back after a failure all the same.
    It does not detect infeasibility: for a wrench that nothing balances it reports success with forces near zero.
    """

    def __init__(self, grasp: Grasp, tolerance: float = 1e-7) -> None:
        matrix, bound = dual_form(grasp)
        count = grasp.n_contacts
        self._solver = import_module("qoco").QOCO()
        self._solver.setup(
            n=6, m=3 * count, p=0, P=None, c=np.ones(6), A=None, b=None, G=matrix, h=bound, l=0, nsoc=count,
            q=np.full(count, 3), abstol=tolerance, reltol=tolerance,
        )  # fmt: skip
        self._regularisation = self._solver.settings.kkt_dynamic_reg

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        self._solver.update_vector_data(c=wrench)
        solution = self._solver.solve()
        if solution.status != "QOCO_SOLVED":
            self._solver.update_settings(kkt_dynamic_reg=self._regularisation)
            return np.full(len(solution.z), np.nan)
        return np.asarray(solution.z)


class Moreau(Solver):
    """Moreau's compiled solver, its structure and values set up once.

    The dual form takes 0.85 of the time of the primal with `DirectConeSpec`, and every `direct_solve_method` the same. Warm starts
    save nothing on random wrenches.
    """

    def __init__(self, grasp: Grasp, tolerance: float = 1e-8) -> None:
        moreau = import_module("moreau")
        matrix, bound = dual_form(grasp)
        rows = matrix.tocsr()
        cones = moreau.Cones(so_cone_dims=[3] * grasp.n_contacts)
        ipm = moreau.IPMSettings(tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=tolerance)
        settings = moreau.Settings(device="cpu", solver="ipm", batch_size=1, ipm_settings=ipm)
        self._solver = moreau.CompiledSolver(
            6, len(bound), np.zeros(7, dtype=np.int64), [], rows.indptr, rows.indices, cones, settings
        )
        self._solver.setup(np.zeros(0), rows.data)
        self._bound, self._solved = bound[None], moreau.SolverStatus.Solved

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        force = np.asarray(self._solver.solve(wrench[None], self._bound).z[0])
        return force if self._solver.info.status[0] == self._solved else np.full_like(force, np.nan)


class Ecos(Solver):
    """ECOS, which has no update: every call sets up again. GPL-3: never a dependency, for comparison only."""

    def __init__(self, grasp: Grasp, tolerance: float = 1e-8) -> None:
        self._ecos = import_module("ecos")
        self._matrix, self._bound = dual_form(grasp)
        self._dims = {"l": 0, "q": [3] * grasp.n_contacts, "e": 0}
        self._options = {"abstol": tolerance, "reltol": tolerance, "feastol": tolerance, "verbose": False}

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        answer = self._ecos.solve(wrench, self._matrix, self._bound, self._dims, **self._options)
        return answer["z"] if answer["info"]["exitFlag"] == 0 else np.full_like(self._bound, np.nan)


class Slsqp(Solver):
    """SciPy's SLSQP on the primal, which people try first: exact Jacobians, from the least-norm force with u lifted into the cones.

    The cones are written u - sqrt(o^2 + t^2) >= 0: from the same start, u^2 - o^2 - t^2 >= 0 ends as a success far
    from the optimum on some wrenches.
    """

    def __init__(self, grasp: Grasp, tolerance: float = 1e-8) -> None:
        self._matrix, self._objective = grasp.cone_matrix, dual_form(grasp)[1]
        self._pseudoinverse = np.linalg.pinv(self._matrix)
        self._each = np.arange(grasp.n_contacts)
        self._options = {"ftol": tolerance, "maxiter": 300}
        self._cones = {"type": "ineq", "fun": self._slack, "jac": self._slack_jacobian}

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        start = -self._pseudoinverse @ wrench
        contacts = start.reshape(-1, 3)
        contacts[:, 0] = np.maximum(contacts[:, 0], 1.1 * np.hypot(contacts[:, 1], contacts[:, 2]))
        balance = {"type": "eq", "fun": lambda x: self._matrix @ x + wrench, "jac": lambda x: self._matrix}
        answer = minimize(
            lambda x: self._objective @ x,
            start,
            jac=lambda x: self._objective,
            method="SLSQP",
            constraints=[balance, self._cones],
            options=self._options,
        )
        return answer.x if answer.success else np.full_like(start, np.nan)

    def _slack(self, x: Array) -> Array:
        contacts = x.reshape(-1, 3)
        return contacts[:, 0] - np.sqrt(contacts[:, 1] ** 2 + contacts[:, 2] ** 2 + _ROUND)

    def _slack_jacobian(self, x: Array) -> Array:
        tangents, count = x.reshape(-1, 3)[:, 1:], len(self._each)
        jacobian = np.zeros((count, count, 3))
        jacobian[self._each, self._each, 0] = 1.0
        jacobian[self._each, self._each, 1:] = -tangents / np.sqrt((tangents**2).sum(axis=1) + _ROUND)[:, None]
        return jacobian.reshape(count, -1)


@dataclass(frozen=True)
class Peer:
    """A contestant of the benchmark of solvers.

    Attributes:
        setting: how it is used, for people.
        build: makes the solver of one grasp, not timed; raises `ImportError` or `RuntimeError` where it cannot run here.
        package: its distribution; "": ours.
        against: contestant over whose time its own is taken; "": none.
        slow: whether it gets few contacts and two calls of each problem.
    """

    setting: str
    build: Callable[[Grasp], Solver]
    package: str = ""
    against: str = "conic_python"
    slow: bool = False


_FAST = partial(Generated, flags=FAST, refinements=0)
PEERS = {
    "qocogen": Peer("C: generated, dual, 1e-7, -O3 -march=native", Generated, "qocogen", "conic"),
    "qocogen_fast": Peer("C: the same, -Ofast -flto, no refinement", _FAST, "qocogen", "conic"),
    "qoco": Peer("Python: dual, update, 1e-7", Qoco, "qoco"),
    "clarabel": Peer("Python: dual, update, 1e-8", Clarabel, "clarabel"),
    "moreau": Peer("Python: dual, compiled, 1e-8", Moreau, "moreau"),
    "ecos": Peer("Python: dual, 1e-8", Ecos, "ecos"),
    "slsqp": Peer("Python: primal, SLSQP, ftol 1e-8", Slsqp, "scipy", slow=True),
}
"""All peers by name."""
