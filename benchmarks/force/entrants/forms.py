"""The conic forms of the problem for interior-point solvers.

    min c . x   s.t.  sides - rows x in {0}^equations x R+^nonneg x SOC(cones[0]) x SOC(cones[1])
    ...

The cone of a hard contact has three dimensions, that of a soft one four.

`Dual` serves the sum of the normal forces, `Primal` the same where limits outnumber the forces, and
`Barrier` phi.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from benchmarks.force.entrant import Answer, Task
from benchmarks.force.problems import BARRIER_WEIGHT, Array, Problem

SIZE = 30.0
"""Length to which the wrench is scaled for the sum: tolerances of solvers are partly absolute."""
Mask = NDArray[np.bool_]


class Form:
    """A problem in conic form. The multipliers z of the rows satisfy c + rows^T z = 0.

    Attributes:
        c: (n,) costs.
        rows, sides: (m, n) dense and (m,), in the order equations, nonnegative rows, cones.
        pattern: (m, n) True where a number may become nonzero in the session.
        equations, nonneg, cones: numbers of rows.
        in_cost: True if the wrench is in c, False if it is in `sides`.
    """

    c: Array
    rows: Array
    sides: Array
    pattern: Mask
    equations = 0
    nonneg = 0
    cones: list[int]
    in_cost = False

    def __init__(self, problem: Problem) -> None:
        self._limited = problem.limit_matrix != 0.0
        self._of = problem
        self._make(problem)

    def update(self, problem: Problem) -> str:
        """Load the next problem and return what changed.

        Returns:
            "wrench" alone, "numbers" of any kind, or "pattern", which needs a new set-up.
        """
        moved = problem.differs(self._of)
        self._of = problem
        if moved:
            limited = problem.limit_matrix != 0.0
            if (limited & ~self._limited).any():
                self._limited |= limited
                self._make(problem)
                return "pattern"
            self._numbers(problem)
        self._wrench(problem)
        return "numbers" if moved else "wrench"

    def answer(self, x: Array, z: Array, status: str) -> Answer:
        """Convert a solver's x and z, which may be a certificate of infeasibility, to an answer."""
        if status == "infeasible":
            return None, self._witness(x, z), status
        return *self._read(x, z), status

    def halves(self) -> tuple[Numbers | None, Numbers]:
        """Return the equations, if there are any, and the other rows as sparse matrices."""
        p = self.equations
        others = Numbers(self.rows[p:], self.pattern[p:])
        return Numbers(self.rows[:p], self.pattern[:p]) if p else None, others

    def joined(self, y: Array, z: Array) -> Array:
        """Join the multipliers of the equations and of the other rows."""
        return np.concatenate([y, z]) if self.equations else z

    def _make(self, problem: Problem) -> None:
        ones = np.ones_like(problem.matrix)
        self.pattern = self._rows(problem, ones, self._limited.astype(float)) != 0.0
        self._numbers(problem)
        self._wrench(problem)

    def _numbers(self, problem: Problem) -> None:
        on = problem.touching
        self._touching = None if on is None else np.repeat(on, problem.width)
        self.rows = self._rows(problem, problem.matrix, problem.limit_matrix)

    def _touched(self, force: Array) -> Array:
        return force if self._touching is None else force * self._touching

    def _size(self, problem: Problem) -> float:
        """Return the factor that scales a solver's forces."""
        return math.sqrt(problem.wrench @ problem.wrench) / SIZE or 1.0

    def _rows(self, problem: Problem, matrix: Array, limit_matrix: Array) -> Array:
        raise NotImplementedError

    def _wrench(self, problem: Problem) -> None:
        raise NotImplementedError

    def _read(self, x: Array, z: Array) -> tuple[Array, Array]:
        raise NotImplementedError

    def _witness(self, x: Array, z: Array) -> Array:
        raise NotImplementedError


class Dual(Form):
    """The dual of the least sum: forces are the multipliers of the cones.

        min w . nu + b . p   s.t.  p >= 0,  (a_n / mu, a_o, a_t, gamma / mu a_tau) in SOC

    with a = c - G^T nu + B^T p of each contact; the variables are nu (6) and p (L).
    """

    in_cost = True

    def _make(self, problem: Problem) -> None:
        n, k = problem.n_contacts, problem.width
        self.nonneg = len(problem.limit_bound)
        self.cones = [k] * n
        self.c, self.sides = np.zeros(6 + self.nonneg), np.zeros(self.nonneg + k * n)
        super()._make(problem)

    def _rows(self, problem: Problem, matrix: Array, limit_matrix: Array) -> Array:
        n, k = problem.n_contacts, problem.width
        rows = np.zeros((len(self.sides), len(self.c)))
        rows[: self.nonneg, 6:] = -np.eye(self.nonneg)
        # c - a of each contact
        rows[self.nonneg :] = np.concatenate([matrix, -limit_matrix]).T
        cones = rows[self.nonneg :].reshape(n, k, -1)
        cones[:, 0] /= problem.friction[:, None]
        if k == 4:
            cones[:, 3] *= problem.lever[:, None]
        return rows

    def _numbers(self, problem: Problem) -> None:
        super()._numbers(problem)
        self._per_normal = 1.0 / problem.friction
        self._lever = problem.lever
        self.sides[self.nonneg :: problem.width] = self._per_normal

    def _wrench(self, problem: Problem) -> None:
        self._unit = self._size(problem)
        self.c[:6] = problem.wrench / self._unit
        if self.nonneg:
            self.c[6:] = problem.limit_bound / self._unit

    def _read(self, x: Array, z: Array) -> tuple[Array, Array]:
        force = z[self.nonneg :] * self._unit
        force[:: self.cones[0]] *= self._per_normal
        if self.cones[0] == 4:
            force[3::4] *= self._lever
        return self._touched(force), np.array(x)

    def _witness(self, x: Array, z: Array) -> Array:
        return np.concatenate([-x[:6], x[6:]])


class Primal(Form):
    """The least sum of the normal forces.

    The variables are the forces, with v = mu / gamma torsion in place of torsion. The cones hold (mu
    n, o, t, v). A v without torsional friction moves nothing.
    """

    equations = 6

    def _make(self, problem: Problem) -> None:
        n, k = problem.n_contacts, problem.width
        self.nonneg = len(problem.limit_bound)
        self.cones = [k] * n
        self.c = np.tile(np.eye(k)[0], n)
        self.sides = np.zeros(6 + self.nonneg + k * n)
        self._limits = slice(6, 6 + self.nonneg)
        super()._make(problem)

    def _rows(self, problem: Problem, matrix: Array, limit_matrix: Array) -> Array:
        cones = -np.eye(len(self.c))
        cones[:: problem.width] *= problem.friction[:, None]
        rows = np.concatenate([matrix, limit_matrix, cones])
        if problem.width == 4:
            rows[: -len(cones), 3::4] *= problem.lever
        return rows

    def _numbers(self, problem: Problem) -> None:
        super()._numbers(problem)
        self._lever = problem.lever

    def _wrench(self, problem: Problem) -> None:
        self._unit = self._size(problem)
        self.sides[:6] = problem.wrench / -self._unit
        self.sides[self._limits] = problem.limit_bound / self._unit

    def _read(self, x: Array, z: Array) -> tuple[Array, Array]:
        force = x * self._unit
        if self.cones[0] == 4:
            force[3::4] *= self._lever
        return self._touched(force), np.concatenate([-z[:6], z[self._limits]])

    def _witness(self, x: Array, z: Array) -> Array:
        return np.concatenate([z[:6], z[self._limits]])


_CONES = -np.loadtxt(
    """
    1 0 0   1 0  0   # u + r
    1 0 0  -1 0  0   # u - r
    0 0 0   0 0  0
    2 0 0   0 0 -1   # 2 u - v
    0 0 0   0 0  1   # v
    0 2 0   0 0  0   # 2 o
    0 0 2   0 0  0   # 2 t
    0 0 0   0 1  1   # y + v
    0 0 0   0 1 -1   # y - v
    0 0 0   0 0  0
    """.splitlines()
)
"""Rows of the three cones of a contact, for (u, o, t) and (r, y, v)."""


class Barrier(Form):
    """Phi by second-order cones.

    The variables are (u, o, t) of all contacts, then (r, y, v), with the cost 3 u + r + y:
    r >= lambda / u where u r >= lambda, and y >= lambda 2 u / (u^2 - o^2 - t^2) where u (u - v) >=
    o^2 + t^2 and y v >= 2 lambda.
    """

    equations = 6

    def _make(self, problem: Problem) -> None:
        n = problem.n_contacts
        self.cones = [3, 4, 3] * n
        self.c = np.concatenate([np.tile([3.0, 0.0, 0.0], n), np.tile([1.0, 1.0, 0.0], n)])
        least = 2.0 * np.sqrt(BARRIER_WEIGHT)
        constants = [0, 0, least, 0, 0, 0, 0, 0, 0, np.sqrt(2.0) * least]
        self.sides = np.concatenate([np.zeros(6), np.tile(constants, n)])
        cones = np.hstack([np.kron(np.eye(n), half) for half in (_CONES[:, :3], _CONES[:, 3:])])
        self._constant = np.concatenate([np.zeros((6, 6 * n)), cones])
        super()._make(problem)

    def _rows(self, problem: Problem, matrix: Array, limit_matrix: Array) -> Array:
        rows = self._constant.copy()
        rows[:6, : matrix.shape[1]] = matrix
        rows[:6, : matrix.shape[1] : 3] /= problem.friction
        return rows

    def _numbers(self, problem: Problem) -> None:
        super()._numbers(problem)
        self._per_normal = 1.0 / problem.friction

    def _wrench(self, problem: Problem) -> None:
        np.negative(problem.wrench, out=self.sides[:6])

    def _read(self, x: Array, z: Array) -> tuple[Array, Array]:
        force = np.array(x[: len(x) // 2])
        force[::3] *= self._per_normal
        return self._touched(force), -z[:6]

    def _witness(self, x: Array, z: Array) -> Array:
        return np.array(z[:6])


def form(problem: Problem, objective: str) -> Form:
    """Return the form in which interior-point solvers are fastest.

    With 32 torque limits on four contacts `Primal` takes 0.86 to 0.93 of the time of `Dual`, with
    10 limits 1.04 to 1.2.

    Raises:
        NotImplementedError: phi with torsion or limits, which is not defined.
    """
    if objective == "sum":
        return (Primal if len(problem.limit_bound) > problem.matrix.shape[1] else Dual)(problem)
    if problem.width != 3 or len(problem.limit_bound):
        raise NotImplementedError("phi is defined without torsion and limits")
    return Barrier(problem)


class Numbers:
    """A sparse matrix whose numbers change while its pattern stays.

    Attributes:
        matrix: CSC, with explicit zeros where `pattern` is true and the number zero.
    """

    def __init__(self, dense: Array, pattern: Mask) -> None:
        self._columns, self._rows = np.nonzero(pattern.T)
        begins = np.searchsorted(self._columns, np.arange(dense.shape[1] + 1))
        self.matrix = sparse.csc_matrix(
            (dense[self._rows, self._columns], self._rows, begins), shape=dense.shape
        )

    def refresh(self, dense: Array) -> Array:
        """Return the values of a dense matrix at the pattern's entries, and store them."""
        numbers = dense[self._rows, self._columns]
        self.matrix.data[:] = numbers
        return numbers


class Conic:
    """Base of entrants that take a `Form`."""

    form: Form
    iterations = 0

    def setup(self, task: Task) -> None:
        """See `Entrant`."""
        self.form = form(task.first, task.objective)
        self.build()

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """See `Entrant`; `start` is not used."""
        changed = self.form.update(problem)
        if changed == "pattern":
            self.build()
        return self.form.answer(*self.run(changed == "numbers"))

    @property
    def tolerance(self) -> float:
        """Tolerance of a primal-dual solver; dual variables need more for the same accuracy."""
        return 1e-8 if self.form.in_cost else 1e-7

    def statuses(self, status: Any) -> dict[Any, str]:
        """Return our names of a solver's states, an enumeration."""
        infeasible = status.DualInfeasible if self.form.in_cost else status.PrimalInfeasible
        return {status.Solved: "solved", infeasible: "infeasible"}

    def build(self) -> None:
        """Set the solver up for `form`."""
        raise NotImplementedError

    def run(self, moved: bool) -> tuple[Array, Array, str]:
        """Return x, z and status; unless `moved`, only the wrench of `form` has changed."""
        raise NotImplementedError
