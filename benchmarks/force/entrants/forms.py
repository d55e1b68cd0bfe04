"""The conic forms of the problem that a careful user hands to an interior-point solver, and what
their entrants share.

    min c . x   s.t.  sides - rows x in {0}^equations x R+^nonneg x SOC(cones[0]) x SOC(cones[1])
    ...

`Dual` serves the sum of the normal forces, `Primal` the same sum where limits outnumber the forces,
`Barrier` phi.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import block_diag

from benchmarks.force.entrant import Answer, Task
from benchmarks.force.problems import BARRIER_WEIGHT, Array, Problem

SIZE = 30.0
"""Length of the wrench that solvers are given for the sum, which scales with it: their tolerances
are partly absolute."""
Mask = NDArray[np.bool_]


class Form:
    """A problem in conic form. The multipliers z of the rows satisfy c + rows^T z = 0.

    Attributes:
        c: (n,) costs.
        rows, sides: (m, n) dense and (m,), in the order equations, nonnegative rows, cones.
        pattern: (m, n) which numbers may become nonzero in the session.
        equations, nonneg, cones: sizes of the parts.
        in_cost: whether the wrench is part of c; else it is part of `sides`.
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
        """Take the numbers of another problem of the session, and says what has changed.

        Returns:
            "wrench" alone; "numbers" of any kind; or "pattern", after which a solver must be set up
            again.
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
        """The answer to the problem in a solver's variables x and multipliers z; a certificate in
        their place is a witness.
        """
        if status == "infeasible":
            return None, self._witness(x, z), status
        return *self._read(x, z), status

    def halves(self) -> tuple[Numbers | None, Numbers]:
        """The equations, where there are any, and the other rows as sparse matrices."""
        p = self.equations
        return Numbers(self.rows[:p], self.pattern[:p]) if p else None, Numbers(
            self.rows[p:], self.pattern[p:]
        )

    def joined(self, y: Array, z: Array) -> Array:
        """The multipliers of all rows from those of the equations and of the others."""
        return np.concatenate([y, z]) if self.equations else z

    def _make(self, problem: Problem) -> None:
        self.pattern = (
            self._rows(problem, np.ones_like(problem.matrix), self._limited.astype(float)) != 0.0
        )
        self._numbers(problem)
        self._wrench(problem)

    def _numbers(self, problem: Problem) -> None:
        self._touching = (
            None if problem.touching is None else np.repeat(problem.touching, problem.width)
        )
        self.rows = self._rows(problem, problem.matrix, problem.limit_matrix)

    def _touched(self, force: Array) -> Array:
        return force if self._touching is None else force * self._touching

    def _size(self, problem: Problem) -> float:
        """Factor for the forces of a solver."""
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

        min w . nu + b . p   s.t.  p >= 0,  ((a_n - s) / mu, a_o, a_t) in SOC,  gamma abs(a_tau) <=
        s

    with a = c - G^T nu + B^T p of each contact; the variables are nu (6), p (L), and s of each
    contact with torsion.
    """

    in_cost = True

    def _make(self, problem: Problem) -> None:
        n = problem.n_contacts
        limits = len(problem.limit_bound)
        soft = problem.n_contacts * (problem.width == 4)
        self.nonneg = 2 * soft + limits
        self.cones = [3] * n
        self._prices = 6 + limits
        self.c, self.sides = np.zeros(6 + limits + soft), np.zeros(self.nonneg + 3 * n)
        super()._make(problem)

    def _rows(self, problem: Problem, matrix: Array, limit_matrix: Array) -> Array:
        made = np.zeros((len(self.sides), len(self.c)))
        n = problem.n_contacts
        end = self._prices
        mu = problem.friction
        # c - a of each contact
        work = np.concatenate([matrix, -limit_matrix]).T.reshape(n, -1, end)
        cones = made[self.nonneg :].reshape(n, 3, -1)
        cones[:, :, :end] = work[:, :3]
        cones[:, 0] /= mu[:, None]
        if problem.torsional_friction is not None:
            each = np.arange(n)
            turning = problem.torsional_friction[:, None] * work[:, 3]
            made[:n, :end], made[n : 2 * n, :end] = -turning, turning
            made[each, end + each] = made[n + each, end + each] = -1.0
            cones[each, 0, end + each] = 1.0 / mu
        made[self.nonneg - (end - 6) : self.nonneg, 6:end] = -np.eye(end - 6)
        return made

    def _numbers(self, problem: Problem) -> None:
        super()._numbers(problem)
        self.sides[self.nonneg :: 3] = self._per_normal = 1.0 / problem.friction
        if problem.torsional_friction is not None:
            self._per_turning = problem.torsional_friction

    def _wrench(self, problem: Problem) -> None:
        self._unit = self._size(problem)
        self.c[:6] = problem.wrench / self._unit
        if self._prices > 6:
            self.c[6 : self._prices] = problem.limit_bound / self._unit

    def _read(self, x: Array, z: Array) -> tuple[Array, Array]:
        n = len(self.cones)
        if len(x) == self._prices:
            force = z[self.nonneg :] * self._unit
            force[::3] *= self._per_normal
        else:
            force = np.column_stack(
                [z[self.nonneg :].reshape(n, 3), self._per_turning * (z[n : 2 * n] - z[:n])]
            )
            force[:, 0] *= self._per_normal
            force *= self._unit
        return self._touched(force.ravel()), np.array(x[: self._prices])

    def _witness(self, x: Array, z: Array) -> Array:
        return np.concatenate([-x[:6], x[6 : self._prices]])


class Primal(Form):
    """The least sum of the normal forces itself; the variables are the forces."""

    equations = 6

    def _make(self, problem: Problem) -> None:
        n = problem.n_contacts
        k = problem.width
        limits = len(problem.limit_bound)
        self.nonneg = limits + 2 * n * (k == 4)
        self.cones = [3] * n
        self.c = np.tile(np.eye(k)[0], n)
        self.sides = np.zeros(6 + self.nonneg + 3 * n)
        self._prices = slice(6, 6 + limits)
        super()._make(problem)

    def _rows(self, problem: Problem, matrix: Array, limit_matrix: Array) -> Array:
        n, k = problem.n_contacts, problem.width
        parts = [matrix, limit_matrix]
        if problem.torsional_friction is not None:
            turning = block_diag(
                *(
                    [[-gamma, 0, 0, sign] for sign in (1, -1)]
                    for gamma in problem.torsional_friction
                )
            )
            parts.append(np.array(turning, dtype=float))
        cones = np.zeros((n, 3, n, k))
        each = np.arange(n)
        cones[each, 0, each, 0] = -problem.friction
        cones[each, 1, each, 1] = cones[each, 2, each, 2] = -1.0
        return np.concatenate([*parts, cones.reshape(3 * n, -1)])

    def _wrench(self, problem: Problem) -> None:
        self._unit = self._size(problem)
        self.sides[:6] = problem.wrench / -self._unit
        self.sides[self._prices] = problem.limit_bound / self._unit

    def _read(self, x: Array, z: Array) -> tuple[Array, Array]:
        return self._touched(x * self._unit), np.concatenate([-z[:6], z[self._prices]])

    def _witness(self, x: Array, z: Array) -> Array:
        return np.concatenate([z[:6], z[self._prices]])


# rows of (u + r, u - r, .), (2 u - v, v, 2 o, 2 t) and (y + v, y - v, .) for (u, o, t) and for (r,
# y, v)
_OF_FORCE = -np.array(
    [
        [1.0, 0, 0],
        [1, 0, 0],
        [0, 0, 0],
        [2, 0, 0],
        [0, 0, 0],
        [0, 2, 0],
        [0, 0, 2],
        *[[0, 0, 0]] * 3,
    ]
)
_OF_REST = -np.array(
    [
        [1.0, 0, 0],
        [-1, 0, 0],
        [0, 0, 0],
        [0, 0, -1],
        [0, 0, 1],
        *[[0, 0, 0]] * 2,
        [0, 1, 1],
        [0, 1, -1],
        [0, 0, 0],
    ]
)


class Barrier(Form):
    """Phi by second-order cones; the variables are (u, o, t) of all contacts, then r, y, v of each
    with the cost 3 u + r + y.

    r >= lambda / u where u r >= lambda, and y >= lambda 2 u / (u^2 - o^2 - t^2) where u (u - v) >=
    o^2 + t^2 and y v >= 2 lambda.
    """

    equations = 6

    def _make(self, problem: Problem) -> None:
        n = problem.n_contacts
        self.cones = [3, 4, 3] * n
        self.c = np.concatenate([np.tile([3.0, 0.0, 0.0], n), np.tile([1.0, 1.0, 0.0], n)])
        least = 2.0 * np.sqrt(BARRIER_WEIGHT)
        each = np.eye(n)
        self.sides = np.concatenate(
            [np.zeros(6), np.tile([0, 0, least, 0, 0, 0, 0, 0, 0, np.sqrt(2.0) * least], n)]
        )
        cones = np.concatenate([np.kron(each, _OF_FORCE), np.kron(each, _OF_REST)], axis=1)
        self._constant = np.concatenate([np.zeros((6, 6 * n)), cones])
        super()._make(problem)

    def _rows(self, problem: Problem, matrix: Array, limit_matrix: Array) -> Array:
        made = self._constant.copy()
        made[:6, : matrix.shape[1]] = matrix
        made[:6, : matrix.shape[1] : 3] /= problem.friction
        return made

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
    """The form in which interior-point solvers are fastest.

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
        """Take the numbers of a dense matrix, and returns those of the pattern."""
        numbers = dense[self._rows, self._columns]
        self.matrix.data[:] = numbers
        return numbers


class Conic:
    """The common part of entrants that are given a `Form`."""

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

    def build(self) -> None:
        """Set the solver up with the numbers of `form`."""
        raise NotImplementedError

    def run(self, moved: bool) -> tuple[Array, Array, str]:
        """x, z and status for the numbers of `form`, of which only the wrench has changed unless
        `moved`.
        """
        raise NotImplementedError
