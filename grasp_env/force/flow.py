"""The gradient flow of one grasp, prepared: its form's matrices once, then one compiled call per wrench."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array, Wrench
from grasp_env.errors import UnknownNameError
from grasp_env.force import full_flow
from grasp_env.force.flow_kernels import flow
from grasp_env.force.lanes import GAP, KNOWN, LANES, STEPS, options, pack
from grasp_env.force.reduced_flow import METRIC, picked_columns, picked_rows, reduced_projector
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.grasp import Grasp

FORMS = ("full", "paper", "projector", "null_space", "row_space")
"""Ways to multiply; see `flow_products`. All give the same iterates to rounding."""
FlowResult = tuple[int, int, int, float, float]
"""Code, accepted steps, trials, Phi, lower bound."""
_PLACES = np.zeros((0, 12), dtype=np.int64)
_NO_TRACE = np.empty(0)


class Flow:
    """The flow on one grasp in one form. Contacts may be hard (round or elliptic) or frictionless, not soft.

    Example:
        >>> from grasp_env.force import AdaptiveStep, Objective, OfflineBasis
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), np.array([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> x = grasp.to_cone(OfflineBasis.of(grasp, Objective()).combine(wrench))
        >>> code, iterations, trials, value, bound = Flow(grasp).run(Objective().weights(4), x, wrench, AdaptiveStep())
        >>> code, bool(value / bound - 1 < 1e-4), grasp.cone_margin(grasp.to_force(x)) > 0
        (0, True, True)
    """

    def __init__(self, grasp: Grasp, form: str | None = None) -> None:
        """Makes the matrices.

        Args:
            grasp: the contacts.
            form: one of `FORMS`; None: `fastest_form`.

        Raises:
            UnknownNameError: another form.
            InvalidInputError: "full" with more than eight contacts.
        """
        self.form = fastest_form(grasp.n_contacts) if form is None else form
        if self.form not in FORMS:
            raise UnknownNameError("form of the flow", self.form, FORMS)
        count = grasp.n_contacts
        self.matrices = matrices(grasp, self.form)
        self.constants = pack(grasp, np.ones(3 * count), np.ones((count, 2)))
        self._options = options(grasp, 0.0, 0)

    def run(
        self,
        weights: Array,
        x: Array,
        wrench: Wrench,
        rule: StepRule,
        *,
        tolerance: float = 1e-4,
        optimum: float = float("nan"),
        max_iterations: int = 20_000,
        trace: Array = _NO_TRACE,
    ) -> FlowResult:
        """Runs Eqs. 12 and 26 from x until the gap of Phi is small enough.

        Args:
            weights: (N, 2) omega and lambda of each contact.
            x: (3N,) cone coordinates, strictly inside and balanced; overwritten with the last iterate.
            wrench: (6,) external wrench [N, N m].
            rule: the step rule.
            tolerance: relative gap of Phi at which to stop.
            optimum: a known min Phi to take the gap to; nan: a certified dual bound.
            max_iterations: most accepted steps.
            trace: (T,) receives Phi of iterates 0..T-1.
        """
        row = self._options.copy()
        row[GAP], row[STEPS], row[KNOWN] = tolerance, max_iterations, optimum
        return flow(
            self.constants,
            FORMS.index(self.form),
            *self.matrices,
            weights,
            x,
            wrench,
            rule.parameters(),
            row,
            trace,
            np.empty(6),
        )


def run_flow(
    grasp: Grasp,
    weights: Array,
    x: Array,
    wrench: Wrench,
    rule: StepRule,
    *,
    form: str | None = None,
    tolerance: float = 1e-4,
    optimum: float = float("nan"),
    max_iterations: int = 20_000,
    trace: Array = _NO_TRACE,
) -> FlowResult:
    """`Flow(grasp, form).run(...)` for one wrench."""
    return Flow(grasp, form).run(
        weights, x, wrench, rule, tolerance=tolerance, optimum=optimum, max_iterations=max_iterations, trace=trace
    )


def fastest_form(count: int) -> str:
    """Up to four contacts one 12 x 12 block; beyond, the form that is linear in N.

    Example:
        >>> fastest_form(4), fastest_form(5)
        ('projector', 'row_space')
    """
    return "projector" if count <= LANES else "row_space"


def operations(form: str, count: int) -> int:
    """Multiplications of one product step for N = `count` contacts.

    Example:
        >>> [operations(form, 4) for form in FORMS]
        [20736, 432, 144, 144, 156]
    """
    n = 3 * count
    counts = {
        "full": n**4,
        "paper": 3 * n**2,
        "projector": n**2,
        "null_space": 2 * n * (n - 6),
        "row_space": 12 * n + n,
    }
    if form not in counts:
        raise UnknownNameError("form of the flow", form, FORMS)
    return counts[form]


def matrices(grasp: Grasp, form: str) -> tuple[Array, Array, NDArray[np.int64]]:
    """(first, second, places) as `flow_products.direct` reads them, in blocks of four contacts.

    Inside a block coordinates lie as (u of four contacts, o of four, t of four); missing contacts are zeros.
    """
    count, blocks = grasp.n_contacts, -(-grasp.n_contacts // LANES)
    size, padded = 3 * count, 12 * blocks
    index = np.arange(size)
    lane = 12 * (index // 12) + 4 * (index % 3) + index // 3 % 4
    none = np.zeros((blocks, 0, 0))
    if form == "full":
        dense = full_flow.projector(grasp)
        whole = -(-len(dense) // 12) * 12
        first = np.zeros((1, whole, whole))
        first[0, : len(dense), : len(dense)] = dense
        rows, columns = picked_rows(count).reshape(-1, 3), picked_columns(count).reshape(-1, 9)
        return first, none, np.concatenate([columns, rows], axis=1)
    if form == "paper":
        whole = np.zeros((36 * blocks, padded))
        contact = np.arange(count)
        rows = (36 * (contact // 4) + contact % 4)[:, None] + 4 * np.arange(9)
        whole[np.ix_(rows.reshape(-1), lane)] = reduced_projector(grasp).T
        return whole.reshape(blocks, 36, blocks, 12).transpose(0, 2, 1, 3).reshape(-1, 36, 12).copy(), none, _PLACES
    g = grasp.unit_frame @ grasp.cone_matrix  # the projector does not depend on the frame, its rounding does
    root = np.sqrt(np.tile(METRIC, count))
    if form == "null_space":
        basis = _null_space(g / root) / root[:, None]
        internal = basis.shape[1]
        first = np.zeros((padded, -(-internal // 4) * 4))
        second = np.zeros((-(-internal // 6) * 6, padded))
        first[lane, :internal] = basis
        second[np.ix_(np.arange(internal), lane)] = -basis.T
        return first.reshape(blocks, 12, -1), second.reshape(-1, blocks, 12).transpose(1, 0, 2).copy(), _PLACES
    # rows of G D^-1/2, orthonormal, times D^-1/2: R, with Pi = D^-1 - R^T R
    rows = np.linalg.qr((g / root).T)[0].T / root
    if form == "row_space":
        table = np.zeros((blocks * LANES, 3, 6))
        table[:count] = rows.T.reshape(count, 3, 6)
        return table.reshape(blocks, LANES, 18).transpose(0, 2, 1).reshape(blocks, 1, 72).copy(), none, _PLACES
    pi = np.zeros((padded, padded))
    pi[np.ix_(lane, lane)] = rows.T @ rows - np.diag(1.0 / root**2)
    return pi.reshape(blocks, 12, blocks, 12).transpose(0, 2, 1, 3).reshape(-1, 1, 144).copy(), none, _PLACES


def _null_space(g: Array) -> Array:
    """Orthonormal basis of ker G; coordinates that no wrench comes from (frictionless o and t) stay out of it."""
    used = np.flatnonzero((g != 0.0).any(axis=0))
    _, _, vt = np.linalg.svd(g[:, used])
    basis = np.zeros((g.shape[1], len(used) - 6))
    basis[used] = vt[6:].T
    return basis
