"""`ForcePipeline`: contacts in, optimal force out, in one compiled call; for control loops whose contacts move at every step."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench, as_array, as_wrench
from grasp_env.errors import InfeasibleStartError, UnknownNameError, UnsupportedProblemError
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.descent_kernels import STALLED
from grasp_env.force.initial import LayeredRule, check_layers
from grasp_env.force.lanes import LANES
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.optimizer import MAX_ITERATIONS, ForceOptimizer
from grasp_env.force.pipeline_kernels import FLOW, NEWTON, Held, carry_contacts, held_size, solve_held, split_held
from grasp_env.force.record import CODE, REFUSED, record_size
from grasp_env.force.repair import Repair
from grasp_env.force.solution import ForceSolution
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.grasp.kernels import contact_geometry
from grasp_env.grasp.null_space import null_space_basis, reference_basis

PIPELINE_METHODS = {"reduced_flow": FLOW, "newton": NEWTON}
STARTS = ("linear_combination", "previous")
_FLOAT, _SIX = np.dtype(np.float64), (6,)
_NONE, _DEFAULT = np.empty(0), np.zeros((0, 3))
"""No adjustment; tangents by the default rule."""
_LOADED: set[tuple[str, int]] = set()
"""Methods and numbers of contacts whose kernels this process has called."""


class ForcePipeline:
    """Optimal forces for contacts that move a little from call to call; their number and friction stay.

    One compiled call does what `Grasp.from_contacts`, `ForceOptimizer.move_to` and `ForceOptimizer.solve` do: contact
    frames and G, the start, the flow or Newton, the certificates. The start is the paper's combination of the 12 offline optima
    of the NOMINAL grasp, taken to the contacts of now by the tangent correction; where that leaves the cones, or Phi grows
    by more than `pipeline_kernels.FAR`, the 12 optima are computed again for the contacts of now and kept from then on.
    A result depends on the nominal grasp and the calls since `reset`, on nothing else.

    Whatever is not solved that way (rank-deficient contacts, wrong numbers, no force closure) goes to a
    `ForceOptimizer` on the grasp of now, whose solutions, errors and proofs are returned. One pipeline belongs to one thread.

    Attributes:
        grasp: the nominal grasp: models, friction, tangents (the default rule unless it was made with others).
        held: the arrays that kernels read, see `Held`; overwritten in place by `solve` and `reset`. Owned by the pipeline.
        reference: (3N, 3N - 6) object-frame directions of `adjust`.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> pipeline = ForcePipeline(grasp)
        >>> solution = pipeline.solve(grasp.positions + 1e-3, grasp.normals, np.array([1, 0.5, -0.6, -0.1, 0.2, 0]))
        >>> solution.status.name, pipeline.frames.shape, pipeline.x.shape
        ('OPTIMAL', (4, 3, 3), (12,))
    """

    def __init__(
        self,
        grasp: Grasp,
        *,
        method: str = "reduced_flow",
        initial: str | LayeredRule = "linear_combination",
        force_weight: Weight = 1.0,
        barrier_weight: Weight = 0.01,
        tolerance: float | None = None,
        max_iterations: int = MAX_ITERATIONS,
        step_rule: StepRule | None = None,
        reference: Array | None = None,
    ) -> None:
        """Computes the offline basis and compiles, or loads, the kernels.

        Args:
            grasp: the nominal grasp, hard contacts (round or elliptic cones) with force closure.
            method: "reduced_flow" or "newton".
            initial: "linear_combination"; "previous": the last optimum carried over, never worse than the former; or a rule made of
                learned Newton layers (`policies.LearnedInitialForce.pretrained("any_grasp")`), which go on from either.
            force_weight, barrier_weight, tolerance, max_iterations, step_rule: see `optimize_force`.
            reference: (3N, 3N - 6) directions of `adjust`, object frame; None: `reference_basis` of the nominal grasp.

        Raises:
            UnsupportedProblemError: soft or frictionless contacts.
            InfeasibleStartError: the nominal grasp has no force closure.
            UnknownNameError, InvalidInputError: as `ForceOptimizer`.
        """
        as_grasp(grasp)
        if method not in PIPELINE_METHODS:
            raise UnknownNameError("method of a pipeline", method, PIPELINE_METHODS)
        layered = isinstance(initial, LayeredRule)
        if layered:
            check_layers(initial.layers, initial.width)
        if not layered and initial not in STARTS:
            raise UnknownNameError("start of a pipeline", str(initial), STARTS, ", or give a rule of learned layers")
        if set(grasp.models.names) != {"hard"}:
            raise UnsupportedProblemError(
                f"a ForcePipeline knows hard contacts, got {grasp.models.names}: use a ForceOptimizer and its move_to"
            )
        self.grasp, self.method = grasp, method
        self.initial = initial.name if layered else str(initial)
        self._layers = initial.layers if layered else np.zeros((0, 0), np.float32)
        remembers = initial.remembers if layered else initial == "previous"
        self.objective = Objective(force_weight, barrier_weight)
        self._options: dict[str, Any] = {
            "method": method,
            "force_weight": force_weight,
            "barrier_weight": barrier_weight,
            "tolerance": tolerance,
            "max_iterations": max_iterations,
            "step_rule": step_rule,
        }
        checked = ForceOptimizer(grasp, **self._options)
        self._nominal = OfflineBasis.of(grasp, self.objective).cone_forces
        count = grasp.n_contacts
        default = (
            grasp.frames
            == contact_geometry(grasp.positions.copy(), grasp.normals.copy(), np.ones((count, 3)), _DEFAULT)[0]
        ).all()
        self._numbers = np.empty(held_size(count))
        self.held: Held = split_held(self._numbers, count, _DEFAULT if default else grasp.frames[:, :, 1].copy())
        self.held.divisor[:] = grasp.models.cone_divisor
        self.held.weights[:] = self.objective.weights(count)
        self.reference: Array = (
            reference_basis(grasp)
            if reference is None
            else as_array(reference, (3 * count, grasp.null_dimension), "reference")
        )
        self._rule = checked.step_rule.parameters()
        width = initial.width if layered else 0
        settings = (PIPELINE_METHODS[method], remembers, checked.tolerance, checked.max_iterations, LANES, width)
        self._settings = np.array(settings, dtype=np.float64)
        self._shape, self._size = (count, 3), record_size(count)
        self._scratch = np.empty((count, 3, 3)), np.empty((6, 3 * count))
        if (method, count) not in _LOADED:  # compiles, or loads, the kernels, before the first call that counts
            for adjust in (_NONE, np.full(grasp.null_dimension, 1e-3)):
                self.reset()
                self.solve(grasp.positions, grasp.normals, np.zeros(6), adjust=adjust)
            self.carry(grasp.positions.copy(), grasp.normals.copy(), np.zeros(6), np.empty((count, 3)))
            _LOADED.add((method, count))
        self.reset()

    @property
    def x(self) -> Array:
        """(3N,) the last optimum in cone coordinates [N]; nan when there is none. The same array at each call."""
        return self.held.x

    @property
    def frames(self) -> Array:
        """(N, 3, 3) contact frames of the last optimum, columns (n, o, t), object frame. The same array at each call."""
        return self.held.frames

    @property
    def cone_matrix(self) -> Array:
        """(6, 3N) G of the last optimum in cone coordinates. The same array at each call."""
        return self.held.cone_matrix

    def reset(self) -> None:
        """Forgets all calls: the next solve gives the bits that the first ever gave."""
        self.held.basis[:] = self._nominal
        self.held.basis_frames[:] = self.grasp.frames
        self._hold(self.grasp, None)

    def solve(self, points: Array, normals: Array, wrench: Wrench, *, adjust: Array | None = None) -> ForceSolution:
        """The optimal force on the contacts of now.

        Args:
            points: (N, 3) contact points [m], object frame. C-contiguous float64 arrays are read as they are.
            normals: (N, 3) inward unit normals, object frame.
            wrench: (6,) external wrench on the object [N, N m], object frame.
            adjust: (3N - 6,) coordinates [N] in `null_space_basis(grasp of now, self.reference)` of an internal force added to
                the start, which is then repaired (`Repair`); None or zeros: none.

        Returns:
            The solution, in the frames `self.frames`; `self.x`, `self.frames` and `self.cone_matrix` are overwritten.

        Raises:
            InvalidInputError: wrong shapes, values that are not finite, normals not of unit length.
            RankDeficientGraspError, InfeasibleWrenchError, InfeasibleStartError: the contacts cannot balance the wrench.
                Nothing stale is left: `self.x` is nan then.
        """
        points = _ready(points, self._shape, "points")
        normals = _ready(normals, self._shape, "normals")
        wrench = _ready(wrench, _SIX, "wrench")
        if adjust is None:
            adjust = _NONE
        elif adjust is not _NONE:
            adjust = as_array(adjust, (self.grasp.null_dimension,), "adjust")
            adjust = adjust if adjust.any() else _NONE
        return self.solve_ready(points, normals, wrench, adjust)

    def solve_ready(self, points: Array, normals: Array, wrench: Wrench, adjust: Array = _NONE) -> ForceSolution:
        """`solve` of C-contiguous float64 arrays of the right shapes, which are not looked at; `adjust` (0,): none."""
        record = np.empty(self._size)
        self._compiled(points, normals, wrench, adjust, record)
        if record[CODE] > STALLED:
            return self._general(points, normals, wrench, adjust, record)
        return ForceSolution(record, self.method, self.initial)

    def carry(self, points: Array, normals: Array, wrench: Wrench, out_force: ContactForces) -> int:
        """Between two solves: the last optimum carried to the contacts and the wrench of now, back inside the cones if need be.

        The call from Python of the kernel `pipeline_kernels.carry_contacts(held, points, normals, wrench, frames, cone_matrix,
        force)`, which compiled control loops call with `pipeline.held`. Neither changes what is held. Arrays are trusted:
        finite, C-contiguous float64, writable.

        Args:
            points, normals, wrench: as in `solve`.
            out_force: (N, 3) overwritten: (normal, o, t) [N] in the contact frames of the contacts of NOW.

        Returns:
            CARRIED (0): the tangent correction, strictly inside. REPAIRED (1): the least Phi on the way to it from the carried
            combination. CLIPPED (2): inside the cones, but balance is given up as far as they ask.
        """
        return carry_contacts(self.held, points, normals, wrench, *self._scratch, out_force)

    def _hold(self, grasp: Grasp, solution: ForceSolution | None) -> None:
        self.held.frames[:] = grasp.frames
        self.held.cone_matrix[:] = grasp.cone_matrix
        self.held.x[:] = np.nan if solution is None else grasp.to_cone(solution.force)

    def _compiled(self, points: Array, normals: Array, wrench: Wrench, adjust: Array, record: Array) -> None:
        solve_held(
            points,
            normals,
            wrench,
            adjust,
            self.reference,
            self._numbers,
            self.held.tangents,
            self._rule,
            self._settings,
            self._layers,
            record,
        )

    def _general(self, points: Array, normals: Array, wrench: Wrench, adjust: Array, record: Array) -> ForceSolution:
        """What the compiled call left: first once more with a new basis, then a `ForceOptimizer` on the grasp of now."""
        self.held.x[:] = np.nan
        tangents = self.held.tangents
        grasp = Grasp.from_contacts(
            points,
            normals,
            self.grasp.models.friction,
            tangents=tangents if len(tangents) else None,
        )
        if record[CODE] == REFUSED:
            with suppress(InfeasibleStartError):  # no force closure: the general path says so
                self.held.basis[:] = OfflineBasis.of(grasp, self.objective).cone_forces
                self.held.basis_frames[:] = grasp.frames
                self._compiled(points, normals, wrench, adjust, record)
                if record[CODE] <= STALLED:
                    return ForceSolution(record, self.method, self.initial)
        wrench = as_wrench(wrench)
        optimizer = ForceOptimizer(grasp, **self._options)
        start = None
        if adjust.size:
            moved = optimizer.start(wrench) + (null_space_basis(grasp, self.reference) @ adjust).reshape(-1, 3)
            start = Repair(self.objective)(grasp, wrench, moved)
        solution = optimizer.solve(wrench, initial=start)
        self._hold(grasp, solution)
        return solution


def _ready(value: Array, shape: tuple[int, ...], name: str) -> Array:
    """`value` where kernels can read it as it is, else a copy."""
    if type(value) is np.ndarray and value.dtype is _FLOAT and value.shape == shape and value.flags.carray:
        return value
    return as_array(value, shape, name)
