"""Phase one: a force strictly inside all limits that balances a wrench, or the twist that proves there is none."""

from __future__ import annotations

from dataclasses import dataclass

from grasp_env._check import Array, ContactForces, Wrench, as_wrench
from grasp_env.errors import NotConvergedError
from grasp_env.force.limits import ForceLimits, as_limits
from grasp_env.force.program import ForceProgram
from grasp_env.force.record import CONVERGED, INFEASIBLE
from grasp_env.grasp.grasp import Grasp, as_grasp


@dataclass(frozen=True, eq=False)
class Feasibility:
    """Answer of `phase_one`.

    Attributes:
        force: (N, 3) balanced and strictly inside [N]; None when infeasible.
        torsion: (N,) of soft contacts [N m]; None when infeasible.
        certificate: (6,) a twist v with G_i^T v in every dual cone and v . w >= 0: then v . (G f + w) = 0 forces every
            contact onto the boundary (v . w = 0) or is impossible (v . w > 0). With further limits v . w > -v . G f for
            every force inside them. None when feasible.
        margin: depth inside the limits of forces that sum to one with the wrench's share; <= 0 when infeasible.
    """

    force: ContactForces | None
    torsion: Array | None
    certificate: Array | None
    margin: float

    @property
    def feasible(self) -> bool:
        """Whether a strictly feasible force exists."""
        return self.force is not None


def phase_one(grasp: Grasp, wrench: Wrench, limits: ForceLimits | None = None) -> Feasibility:
    """The force deepest inside all limits, or the proof that none is inside; see `ForceProgram.deepest`.

    Args:
        grasp: the grasp, any contact models.
        wrench: (6,) external wrench; zero asks for a strictly interior internal force (force closure).
        limits: further limits.

    Raises:
        NotConvergedError: neither a force nor a proof (slow is not infeasible).

    Example:
        >>> from grasp_env.grasp import presets
        >>> phase_one(presets.tripod(), [0.0] * 6).feasible
        True
    """
    load = as_wrench(wrench)
    return answer(ForceProgram(as_grasp(grasp), as_limits(limits)), load)


def answer(program: ForceProgram, wrench: Wrench) -> Feasibility:
    """`phase_one` of a program that exists already."""
    deepest = program.deepest(wrench)
    if deepest.code == CONVERGED:
        return Feasibility(program.force(deepest.z), program.torsion(deepest.z), None, deepest.margin)
    if deepest.code == INFEASIBLE:
        return Feasibility(None, None, deepest.twist, deepest.margin)
    raise NotConvergedError(
        f"phase one found neither a force nor a proof for wrench {wrench.tolist()} "
        f"(margin {deepest.margin:.3g} after {deepest.iterations} iterations)"
    )
