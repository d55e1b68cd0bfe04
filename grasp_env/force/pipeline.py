"""`ForcePipeline`: contacts in, optimal force out, in one compiled call; for control loops whose contacts move at every step."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from grasp_env import core, ranges
from grasp_env._check import Array, ContactForces, Wrench, as_array, as_wrench, choice
from grasp_env.errors import InfeasibleStartError, UnsupportedProblemError
from grasp_env.force.basis import OfflineBasis, core_contacts
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.optimizer import MAX_ITERATIONS, ForceOptimizer
from grasp_env.force.record import CODE, REFUSED, STALLED, record_size
from grasp_env.force.repair import Repair
from grasp_env.force.solution import ForceSolution
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis

PIPELINE_METHODS = ("reduced_flow", "newton")
STARTS = ("linear_combination", "previous")


class Held(NamedTuple):
    """What a pipeline holds between calls: views of the core's struct of that name, overwritten in place.

    The optimum and the basis are written in the contact frames that they were found in; other contacts get them turned, with a
    tangent correction.

    Attributes:
        x: (3N,) the last optimum, cone coordinates [N]; nan: none.
        frames: (N, 3, 3) its contact frames, columns (n, o, t), object frame.
        cone_matrix: (6, 3N) its G in cone coordinates.
        basis: (13, 3N) offline basis, cone coordinates.
        basis_frames: (N, 3, 3) the contact frames it is written in.
        divisor: (N, 3) force = cone coordinates / divisor.
        weights: (N, 2) omega and lambda of Phi.
        tangents: (N, 3) directions of o, or (0, 3): the default rule.
    """

    x: Array
    frames: Array
    cone_matrix: Array
    basis: Array
    basis_frames: Array
    divisor: Array
    weights: Array
    tangents: Array


class ForcePipeline:
    """Optimal forces for contacts that move a little from call to call; their number and friction stay.

    One compiled call does what `Grasp.from_contacts`, `ForceOptimizer.move_to` and `ForceOptimizer.solve` do: contact
    frames and G, the start, the flow or Newton, the certificates. The start is the paper's combination of the 12 offline optima
    of the NOMINAL grasp, taken to the contacts of now by the tangent correction; where that leaves the cones, or Phi grows
    by more than a factor of two, the 12 optima are computed again for the contacts of now and kept from then on.
    A result depends on the nominal grasp and the calls since `reset`, on nothing else.

    Whatever is not solved that way (rank-deficient contacts, wrong numbers, no force closure) goes to a
    `ForceOptimizer` on the grasp of now, whose solutions, errors and proofs are returned. One pipeline belongs to one thread.

    Attributes:
        grasp: the nominal grasp: models, friction, tangents (the default rule unless it was made with others).
        held: what is held between calls, see `Held`; overwritten in place by `solve` and `reset`. Owned by the pipeline.
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
        initial: str = "linear_combination",
        force_weight: Weight = 1.0,
        barrier_weight: Weight = 0.01,
        tolerance: float | None = None,
        max_iterations: int = MAX_ITERATIONS,
        step_rule: StepRule | None = None,
        reference: Array | None = None,
    ) -> None:
        """Computes the offline basis.

        Args:
            grasp: the nominal grasp, hard contacts (round or elliptic cones) with force closure.
            method: "reduced_flow" or "newton".
            initial: "linear_combination"; "previous": the last optimum carried over, never worse than the former.
            force_weight, barrier_weight, tolerance, max_iterations, step_rule: see `optimize_force`.
            reference: (3N, 3N - 6) directions of `adjust`, object frame; None: `reference_basis` of the nominal grasp.

        Raises:
            UnsupportedProblemError: soft or frictionless contacts.
            InfeasibleStartError: the nominal grasp has no force closure.
            UnknownNameError, InvalidInputError: as `ForceOptimizer`.
        """
        as_grasp(grasp)
        method = choice(method, "method of a pipeline", PIPELINE_METHODS)
        self.initial = choice(initial, "start of a pipeline", STARTS, "; any other starts a ForceOptimizer")
        if set(grasp.models.names) != {"hard"}:
            raise UnsupportedProblemError(
                f"a ForcePipeline knows hard contacts, got {grasp.models.names}: use a ForceOptimizer and its move_to"
            )
        self.grasp, self.method = grasp, method
        self.objective = Objective(force_weight, barrier_weight)
        self._given: dict[str, Any] = {
            "method": method,
            "force_weight": force_weight,
            "barrier_weight": barrier_weight,
            "tolerance": tolerance,
            "max_iterations": max_iterations,
            "step_rule": step_rule,
        }
        count = grasp.n_contacts
        self.reference: Array = (
            reference_basis(grasp)
            if reference is None
            else as_array(reference, (3 * count, grasp.null_dimension), "reference")
        )
        self._shape, self._coordinates, self._size = (count, 3), (grasp.null_dimension,), record_size(count)
        self._remembers = self.initial == "previous"
        self._make()

    def _make(self) -> None:
        """What is compiled: after it a pipeline is as new."""
        grasp, checked = self.grasp, ForceOptimizer(self.grasp, **self._given)
        default = Grasp.unchecked(grasp.positions, grasp.normals, grasp.models)
        tangents = np.zeros((0, 3)) if (default.frames == grasp.frames).all() else grasp.frames[:, :, 1].copy()
        basis = OfflineBasis.of(grasp, self.objective).cone_forces
        self.core = core.Pipeline.make(
            core_contacts(grasp, self.objective, tangents), checked.tolerance, checked.max_iterations, basis,
            np.ascontiguousarray(grasp.frames), self._remembers, np.ascontiguousarray(self.reference),
            checked.step_rule.parameters() if self.method == "reduced_flow" else None,
        )  # fmt: skip
        arrays = self.core.arrays()
        weights = self.objective.weights(grasp.n_contacts)
        x, frames, cone_matrix, rows, basis_frames = (arrays[name] for name in Held._fields[:5])
        self.held = Held(x, frames, cone_matrix, rows, basis_frames, grasp.models.cone_divisor, weights, tangents)
        self._solve = self.core.solve

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("core", "_solve", "held")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make()

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

    def to_object_frame(self, force: ContactForces) -> Array:
        """Contact forces (N, 3) [N] of the last `solve` as vectors in object coordinates (N, 3) [N].

        Example:
            >>> from grasp_env.grasp import presets
            >>> grasp, wrench = presets.tripod(), np.array([0, 0, -2.0, 0, 0, 0])
            >>> pipeline = ForcePipeline(grasp)
            >>> solution = pipeline.solve(grasp.positions, grasp.normals, wrench)
            >>> pipeline.to_object_frame(solution.force).sum(axis=0).round(9) + 0.0   # they carry the weight
            array([0., 0., 2.])
        """
        return np.einsum("nij,nj->ni", self.frames, as_array(force, self._shape, "force", ranges.SIZE))

    def reset(self) -> None:
        """Forgets all calls: the next solve gives the bits that the first ever gave."""
        self.core.reset()
        self._hold(self.grasp, None)

    def __repr__(self) -> str:
        return f"ForcePipeline({self.grasp.n_contacts} contacts, {self.method} from {self.initial})"

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
        if (
            type(adjust) is np.ndarray
            and adjust.shape == self._coordinates
            and adjust.dtype.kind == "f"
            and not adjust.any()
        ):
            adjust = None
        record = np.empty(self._size)
        if self._solve(points, normals, wrench, adjust, record) <= STALLED:
            return ForceSolution(record, self.method, self.initial)
        # what cannot be read as it is, and what has to be said in words: nothing stale is left
        self.core.forget()
        points, normals = as_array(points, self._shape, "points"), as_array(normals, self._shape, "normals")
        wrench = as_wrench(wrench)
        if adjust is not None:
            adjust = as_array(adjust, (self.grasp.null_dimension,), "adjust", ranges.SIZE)
        return self.solve_ready(points, normals, wrench, adjust)

    def solve_ready(self, points: Array, normals: Array, wrench: Wrench, adjust: Array | None = None) -> ForceSolution:
        """`solve` of `points`, `normals`, `wrench` and `adjust` that are C-contiguous float64 arrays of the right shapes: not looked at."""
        record = np.empty(self._size)
        if self._solve(points, normals, wrench, adjust, record) > STALLED:
            return self._general(points, normals, wrench, adjust, record)
        return ForceSolution(record, self.method, self.initial)

    def carry(self, points: Array, normals: Array, wrench: Wrench, out_force: ContactForces) -> int:
        """Between two solves: the last optimum carried to the contacts and the wrench of now, back inside the cones if need be.

        Changes nothing that is held. Arrays are trusted: finite, C-contiguous float64, writable.

        Args:
            points, normals, wrench: as in `solve`.
            out_force: (N, 3) overwritten: (normal, o, t) [N] in the contact frames of the contacts of NOW.

        Returns:
            CARRIED (0): the tangent correction, strictly inside. REPAIRED (1): the least Phi on the way to it from the carried
            combination. CLIPPED (2): inside the cones, but balance is given up as far as they ask.
        """
        return self.core.carry(points, normals, wrench, out_force)

    def _hold(self, grasp: Grasp, solution: ForceSolution | None) -> None:
        self.held.frames[:] = grasp.frames
        self.held.cone_matrix[:] = grasp.cone_matrix
        self.held.x[:] = np.nan if solution is None else grasp.to_cone(solution.force)

    def _general(
        self, points: Array, normals: Array, wrench: Wrench, adjust: Array | None, record: Array
    ) -> ForceSolution:
        """What the core left: first once more with a new basis, then a `ForceOptimizer` on the grasp of now."""
        self.core.forget()
        tangents = self.held.tangents
        grasp = Grasp.from_contacts(
            points,
            normals,
            self.grasp.models.friction,
            tangents=tangents if len(tangents) else None,
        )
        if record[CODE] == REFUSED:
            with suppress(InfeasibleStartError):  # no force closure: the general path says so
                basis = OfflineBasis.of(grasp, self.objective).cone_forces
                self.core.set_basis(basis, np.ascontiguousarray(grasp.frames))
                if self._solve(points, normals, wrench, adjust, record) <= STALLED:
                    return ForceSolution(record, self.method, self.initial)
        wrench = as_wrench(wrench)
        optimizer = ForceOptimizer(grasp, **self._given)
        start = None
        if adjust is not None:
            moved = optimizer.start(wrench) + (null_space_basis(grasp, self.reference) @ adjust).reshape(-1, 3)
            start = Repair(self.objective)(grasp, wrench, moved)
        solution = optimizer.solve(wrench, initial=start)
        self._hold(grasp, solution)
        return solution
