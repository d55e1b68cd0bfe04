"""The worst wrench of a set, on the exact cones, with a certified interval.

The cost c(w) of a wrench w is the smallest size of a contact force that balances w. The size of a
force is the sum or the maximum of its normal forces. c is convex. By duality, c(w) is the maximum
over twists n of -n . w / h(n). Here h(n) is the largest n . G f over the forces f in the cones of
size <= 1; `_largest_wrenches` computes it in closed form. The maximum of c over a ball is bounded
from both sides:

- Below, by ascent: solve the conic problem at w and take its multipliers n, for which h(n) <= 1.
  Replace w by the wrench of the ball with the largest -n . w, and repeat. c never decreases, since
  c(w') >= -n . w' for every w'.
- Above, without limits, by an inner hull: the convex hull of some wrenches G f of forces f of size
  <= 1. c is at most the factor by which the hull must be scaled to contain the ball. The facet that
  is nearest to the origin, relative to the ball, determines this factor. The next wrench of the
  hull is the one with the largest n . G f for the normal n of this facet. This is repeated until
  the gap is closed, as Zheng 2013 does for epsilon ("An efficient algorithm for a grasp quality
  measure", IEEE T-RO 29(2)).
- Above, with limits, by an outer polytope, which contains the ball: c is convex, so its maximum
  over the polytope is that of a vertex.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from grasp_env.errors import InfeasibleWrenchError, InvalidInputError, NotConvergedError
from grasp_env.force.limits import ForceLimits
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import (
    AllFaults,
    Array,
    Wrench,
    as_array,
    checked_size,
    choice,
    generator,
    positive,
    whole,
)
from grasp_env.quality.closure import force_closure

SHAPES = ("ellipsoid", "product")
CRITERIA = ("sum", "max")
"""Sizes of a contact force: the sum or the maximum of its normal forces."""
ENCLOSING = 42
"""Number of vertices of the polyhedron around a ball of forces or of moments; the outer polytope
combines the two."""
CORNERS = 4
"""Number of corners of the polygon around a quarter circle in (|force|, |moment|), for the outer
polytope of an ellipsoid."""
SHRINK = 1e-5
"""Largest relative random shift of the inner hull's points towards the origin; it keeps the points
in general position."""
JOGGLE = 1e-9
"""Largest random shift of a coordinate by Qhull (option QJ); the points have norms of about 1. The
bound subtracts 100 times this shift from every facet's distance to the origin."""
BATCH = 8
"""Number of facets refined at once."""


@dataclass(frozen=True)
class WrenchBall:
    """A set of wrenches around zero: moments about the object origin, object frame.

    Attributes:
        force: largest force [N], 1e-9 to 1e9.
        moment: largest moment [N m], 1e-9 to 1e9.
        shape: "ellipsoid": |F|^2 / force^2 + |M|^2 / moment^2 <= 1, or "product": |F| <= force and
            |M| <= moment, the set of `grasp_env.grasp.wrench.sample_ball`.

    Example:
        >>> WrenchBall(2.0, 0.05, "product").farthest(np.array([0, 0, 1, 0, 0, 1])).round(3)
        array([0.  , 0.  , 2.  , 0.  , 0.  , 0.05])
    """

    force: float
    moment: float
    shape: str = "ellipsoid"

    def __post_init__(self) -> None:
        with AllFaults() as check:
            check(positive, self.force, "force", ranges.BALL)
            check(positive, self.moment, "moment", ranges.BALL)
            check(choice, self.shape, "shape", SHAPES)

    @property
    def radii(self) -> Array:
        """(6,) the largest component along each axis [N, N m]."""
        return np.repeat([float(self.force), float(self.moment)], 3)

    def reach(self, directions: Array) -> Array:
        """Return (K,) the largest n . w over the ball for the rows n of `directions` (K, 6)."""
        parts = np.sqrt(((directions * self.radii).reshape(-1, 2, 3) ** 2).sum(axis=2))
        return parts.sum(axis=1) if self.shape == "product" else np.sqrt((parts**2).sum(axis=1))

    def farthest(self, direction: Array) -> Wrench:
        """Return the wrench w (6,) of the ball with the largest n . w, n being `direction` (6,)."""
        parts = (direction * self.radii).reshape(2, 3)
        sizes = np.sqrt((parts**2).sum(axis=1, keepdims=True))
        size = sizes if self.shape == "product" else np.sqrt((sizes**2).sum())
        return (parts / np.maximum(size, 1e-300)).reshape(6) * self.radii

    def enclosing(self) -> Array:
        """Return the vertices (V, 6) of an outer polytope, which contains the ball."""
        step = np.arange(ENCLOSING) + 0.5
        height = 1.0 - 2.0 * step / ENCLOSING
        turn = np.pi * (1.0 + np.sqrt(5.0)) * step
        flat = np.sqrt(1.0 - height**2)
        around = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
        around /= (-ConvexHull(around).equations[:, 3]).min()
        pairs = np.concatenate(
            [np.repeat(around, ENCLOSING, axis=0), np.tile(around, (ENCLOSING, 1))], axis=1
        )
        pairs *= self.radii
        if self.shape == "product":
            return pairs
        angles = np.pi / (2 * CORNERS) * (np.arange(CORNERS) + 0.5)
        parts = np.stack([np.cos(angles), np.sin(angles)], axis=1).repeat(3, axis=1) / np.cos(
            np.pi / (4 * CORNERS)
        )
        return (parts[:, None] * pairs).reshape(-1, 6)


class WorstCase(NamedTuple):
    """Result of `worst_case`: the largest cost lies between `lower` and `upper`, by duality.

    Attributes:
        wrench: (6,) the worst wrench found [N, N m].
        lower: lower bound of the cost of `wrench` [N]; inf if no force balances this wrench.
        upper: upper bound of the cost of all wrenches of the set [N]; inf if no bound was found.
        solution: the optimal force for `wrench`, or the proof of infeasibility (`certificate`).
            None if the conic solver did not converge there; the bounds hold nevertheless.
    """

    wrench: Wrench
    lower: float
    upper: float
    solution: ForceSolution | None

    @property
    def least_force(self) -> float:
        """Cost of `wrench` [N] to the solver's tolerance; inf if infeasible."""
        return self.lower if self.solution is None else self.solution.objective

    @property
    def gap(self) -> float:
        """Relative gap (upper - lower) / lower."""
        if self.lower == np.inf:
            return 0.0
        return self.upper / self.lower - 1.0 if self.lower > 0.0 else np.inf


def worst_case(
    grasp: Grasp,
    wrenches: ArrayLike | WrenchBall,
    criterion: str = "sum",
    limits: ForceLimits | None = None,
    *,
    tolerance: float = 0.01,
    starts: int = 32,
    points: int = 400,
    seed: int = 0,
) -> WorstCase:
    """Find the worst wrench of a set: the one of the largest cost.

    The cost of a wrench is the smallest size of a contact force that balances it; in a ball it may
    be infinite, without force closure.

    Args:
        grasp: the contacts, of any models.
        wrenches: (M, 6) [N, N m], or a `WrenchBall`. The result also holds for the convex hull of
            the wrenches, since the cost is convex.
        criterion: size of a force: "sum" or "max" of its normal forces.
        limits: further limits. For a ball, `upper` is then the largest bound over the vertices of
            an outer polytope, which reaches at most 10 % (product) or 12 % (ellipsoid) beyond the
            ball. `upper` is inf if no force within the limits was found for some vertex.
        tolerance: relative gap at which the refinement of the upper bound ends, not below 1e-4;
            without limits only.
        starts: number of random directions in which an ascent starts, in addition to the axes; at
            most 10,000.
        points: number of points of the inner hull at which the refinement ends, 64 to 5000; without
            limits only.
        seed: seed of the random directions.

    Raises:
        UnknownNameError: unknown criterion.
        NotConvergedError: force closure is undecided; for a finite set, the solver did not converge
            for some wrench.

    Example:
        >>> from grasp_env.grasp import presets
        >>> worst = worst_case(presets.paper_cuboid(), WrenchBall(force=1.0, moment=0.05))
        >>> worst.least_force, worst.gap < 0.01
        (7.46, True)
        >>> worst_case(presets.paper_cuboid(), [[0, 0, -1, 0, 0, 0], [1, 0, 0, 0, 0, 0]]).wrench
        array([1., 0., 0., 0., 0., 0.])
    """
    with AllFaults() as check:
        starts = check(whole, starts, "starts", 0, ranges.STARTS)
        points = check(whole, points, "points", 64, ranges.POINTS)
        rng = check(generator, seed)
        tolerance = check(positive, tolerance, "tolerance", ranges.TOLERANCE)
        check(choice, criterion, "criterion", CRITERIA)
    optimizer = ForceOptimizer(grasp, method="conic", criterion=criterion, limits=limits)
    if not isinstance(wrenches, WrenchBall):
        listed = checked_size(as_array(wrenches, (None, 6), "wrenches"), "wrenches")
        if not len(listed):
            raise InvalidInputError("wrenches must hold at least one wrench")
        solved = [_solve(optimizer, wrench) for wrench in listed]
        for case in solved:
            if case.solution is None:
                raise NotConvergedError(
                    f"the conic solver found no optimal force for wrench {case.wrench.tolist()}"
                )
        worst = max(solved, key=lambda case: case.upper)
        return worst._replace(lower=max(case.lower for case in solved))
    ball = wrenches
    if limits is None and not (closure := force_closure(grasp)):
        assert closure.twist is not None
        # infeasible by the twist; the solver may add its own proof
        case = _solve(optimizer, ball.farthest(closure.twist))
        return case if case.lower == np.inf else WorstCase(case.wrench, np.inf, np.inf, None)
    axes = np.concatenate([np.eye(6), -np.eye(6)])
    directions = np.concatenate([axes, rng.standard_normal((starts, 6))]) / ball.radii
    best = max((_ascend(optimizer, ball, ball.farthest(n)) for n in directions), key=_lower)
    if best.lower == np.inf:
        return best
    if limits is None:
        return _refine_hull(optimizer, ball, best, tolerance, points, rng)
    return _within_limits(optimizer, ball, best)


def _lower(case: WorstCase) -> float:
    return case.lower


def _solve(optimizer: ForceOptimizer, wrench: Wrench) -> WorstCase:
    """Return the bounds for one wrench."""
    try:
        solution = optimizer.solve(wrench)
    except InfeasibleWrenchError as error:
        return WorstCase(wrench, np.inf, np.inf, error.solution)
    except NotConvergedError:
        return WorstCase(wrench, 0.0, np.inf, None)
    if not np.isfinite([solution.objective, solution.lower_bound, *solution.multipliers]).all():
        return WorstCase(wrench, 0.0, np.inf, None)
    return WorstCase(wrench, solution.lower_bound, solution.objective, solution)


def _ascend(optimizer: ForceOptimizer, ball: WrenchBall, wrench: Wrench) -> WorstCase:
    """Replace w by the wrench with the largest -n . w, n its multipliers, until the bound stops."""
    best = _solve(optimizer, wrench)
    for _ in range(50):
        if best.lower == np.inf or best.solution is None or not best.solution.multipliers.any():
            break
        case = _solve(optimizer, ball.farthest(-best.solution.multipliers))
        if not case.lower > best.lower * (1.0 + 1e-6):
            break
        best = case
    return best


def _refine_hull(
    optimizer: ForceOptimizer,
    ball: WrenchBall,
    best: WorstCase,
    tolerance: float,
    points: int,
    rng: np.random.Generator,
) -> WorstCase:
    """Refine the upper bound by a growing inner hull, with wrenches scaled to a unit ball."""
    grasp = optimizer.grasp
    criterion = optimizer.options.criterion
    unit = WrenchBall(1.0, 1.0, ball.shape)
    # include the direction of the worst wrench so far
    directions = np.concatenate(
        [np.eye(6), rng.standard_normal((16, 6)), best.wrench[None] / ball.radii]
    )
    _, wrenches = _largest_wrenches(
        grasp, np.concatenate([directions, -directions]) / ball.radii, criterion
    )
    scale = float(np.sqrt(((wrenches / ball.radii) ** 2).sum(axis=1)).max())

    def hull_points(wrenches: Array) -> Array:
        scaled = np.unique(wrenches, axis=0) / ball.radii / scale
        return scaled * (1.0 - SHRINK * rng.random((len(scaled), 1)))

    try:
        hull = ConvexHull(
            hull_points(wrenches), incremental=True, qhull_options=f"QJ{JOGGLE} Q12 Pp"
        )
    except QhullError:  # the inner hull is too thin: no upper bound
        return best._replace(upper=np.inf)
    while True:
        normals = hull.equations[:, :6]
        distance = -hull.equations[:, 6] - 100.0 * JOGGLE
        reach = unit.reach(normals)
        # the nearest facets first; distance <= 0: the origin is outside
        top = np.argsort(distance / reach)[:BATCH]
        nearest = float(distance[top[0]] / reach[top[0]]) * scale
        heights, wrenches = _largest_wrenches(grasp, normals[top] / ball.radii, criterion)
        # -n . w / h(n) at the wrench w with the largest -n . w is a lower bound that needs no solve
        dual_bounds = reach[top] / np.maximum(heights, 1e-300)
        start = ball.farthest(-normals[top[dual_bounds.argmax()]] / ball.radii)
        unsolved = WorstCase(start, float(dual_bounds.max()), np.inf, None)
        best = max(best, _ascend(optimizer, ball, start), unsolved, key=_lower)
        upper = max(1.0 / nearest if nearest > 0.0 else np.inf, best.least_force)
        if upper <= best.lower * (1.0 + tolerance) or len(hull.points) >= points:
            return best._replace(upper=upper)
        try:
            hull.add_points(hull_points(wrenches))
        except QhullError:  # rounding: the bound so far is still valid
            return best._replace(upper=upper)


def _within_limits(optimizer: ForceOptimizer, ball: WrenchBall, best: WorstCase) -> WorstCase:
    """Take the upper bound from the vertices of an outer polytope."""
    upper = best.upper
    for vertex in ball.enclosing():
        case = _solve(optimizer, vertex)
        upper = max(upper, case.upper)
        if upper == np.inf:
            if case.solution is not None and case.solution.certificate is not None:
                # the twist that separates the vertex may also separate a wrench of the ball
                best = max(
                    best, _solve(optimizer, ball.farthest(case.solution.certificate)), key=_lower
                )
            break
    return best._replace(upper=upper)


def _largest_wrenches(grasp: Grasp, directions: Array, criterion: str) -> tuple[Array, Array]:
    """Return h(n) (K,) and the maximising wrenches G f (K, 6) for the rows n (K, 6)."""
    models, count = grasp.models, grasp.n_contacts
    pushes = (directions @ grasp.matrix).reshape(-1, count, 3)
    works = np.concatenate([pushes, (directions @ grasp.torsion_matrix)[:, :, None]], axis=2)
    largest = np.column_stack([models.friction, models.torsional_friction])  # per normal force
    tangential = works[:, :, 1:] * largest
    length = np.sqrt((tangential**2).sum(axis=2))
    # each contact separately, with a unit normal force
    best = works[:, :, 0] + length
    pushing = best > 0.0
    if criterion == "sum":
        pushing &= np.arange(count) == best.argmax(axis=1)[:, None]
    normals = pushing.astype(float)
    parts = (normals / np.where(length > 0.0, length, 1.0))[:, :, None] * largest * tangential
    forces = np.concatenate([normals[:, :, None], parts[:, :, :2]], axis=2)
    wrenches = forces.reshape(-1, 3 * count) @ grasp.matrix.T
    wrenches += parts[:, :, 2] @ grasp.torsion_matrix.T
    return (best * normals).sum(axis=1), wrenches
