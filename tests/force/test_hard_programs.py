"""The general program where it is hard: force closure nearly lost, contacts close to each other, flat grasps, limits near infeasible."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference, random_grasp, random_limits, random_wrench

from grasp_env.errors import GraspError, InfeasibleWrenchError, NotConvergedError
from grasp_env.force import ForceLimits, ForceOptimizer, Status
from grasp_env.grasp import Grasp
from grasp_env.quality import force_closure


def near_closure(rng: np.random.Generator) -> Grasp:
    """Friction above what force closure needs by 1e-5 to 0.1 of it."""
    base = random_grasp(rng, "hard", most=6)
    low, high = 1e-3, 3.0
    for _ in range(25):
        middle = float(np.sqrt(low * high))
        try:
            closed = bool(force_closure(base.with_friction(middle)))
        except GraspError:
            closed = False
        low, high = (low, middle) if closed else (middle, high)
    return base.with_friction(high * (1.0 + 10.0 ** rng.uniform(-5.0, -1.0)))


def clustered(rng: np.random.Generator) -> Grasp:
    """Contacts within 1e-6 to 1e-3 m of one to three places on a ball of 0.05 m."""
    count = int(rng.integers(4, 8))
    centres = rng.standard_normal((int(rng.integers(1, 4)), 3))
    centres *= 0.05 / np.linalg.norm(centres, axis=1)[:, None]
    which = rng.integers(0, len(centres), count)
    positions = centres[which] + 10.0 ** rng.uniform(-6.0, -3.0) * rng.standard_normal((count, 3))
    normals = -centres[which] / 0.05 + 0.4 * rng.standard_normal((count, 3))
    return Grasp.from_contacts(
        positions, normals / np.linalg.norm(normals, axis=1)[:, None], rng.uniform(0.2, 1.2, count)
    )


def problem(kind: str, rng: np.random.Generator) -> tuple[Grasp, np.ndarray, ForceLimits | None]:
    if kind in ("near closure", "clustered"):
        grasp = (near_closure if kind == "near closure" else clustered)(rng)
    else:
        model = str(rng.choice(["hard", "elliptic", "soft", "mixed"]))
        grasp = random_grasp(rng, model, flat=10.0 ** rng.uniform(-6.0, -2.0) if kind == "flat" else 1.0, most=8)
    wrench = random_wrench(rng, grasp, 0.1, 10.0)
    return grasp, wrench, random_limits(rng, grasp, float(np.abs(wrench[:3]).max())) if kind == "limits" else None


@pytest.mark.parametrize("criterion", ["sum", "max"])
@pytest.mark.parametrize("kind", ["near closure", "clustered", "flat", "limits"])
@pytest.mark.parametrize(
    "seeds", [range(40), pytest.param(range(40, 2000), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_optimal_inside_or_proven_infeasible(kind: str, criterion: str, seeds: range) -> None:
    """Every answer is inside and balanced, and none is off by more than the digits that such forces have: 1e-5, optimal at 1e-6."""
    pytest.importorskip("clarabel")
    solved, refuted = 0, []
    for seed in seeds:
        rng = np.random.default_rng([seed, 1707])
        try:
            grasp, wrench, limits = problem(kind, rng)
        except GraspError:
            continue  # rank lost
        try:
            # the general program also where hard contacts have a solver of their own
            given = limits or ForceLimits(max_normal=1e11)
            found = ForceOptimizer(grasp, method="conic", criterion=criterion, limits=given).solve(wrench)
        except InfeasibleWrenchError as error:
            solution = error.solution
            proof = None if solution is None else solution.certificate
            if proof is None or not Reference(grasp, limits).separates(proof, wrench) > -1e-7:
                refuted.append((seed, proof))
            continue
        except NotConvergedError:
            # slow is not infeasible; but only at the edge of it
            assert abs(Reference(grasp, limits).margin(wrench)) < 1e-7, seed
            continue
        reference = Reference(grasp, limits)
        force = float(np.abs(found.force).max())
        assert found.status in (Status.OPTIMAL, Status.STALLED), (seed, found)
        assert found.cone_margin >= 0.0, seed
        assert reference.violation(found.force, found.torsion) <= 1e-13 * force, seed
        assert found.equilibrium_residual <= 1e-9 * np.abs(reference.load(wrench)).max() + 1e-14 * force, seed
        assert found.optimality_gap <= (1e-6 if found.status is Status.OPTIMAL else 1e-5), (seed, found)
        solved += 1
    assert solved > len(seeds) // 5
    assert not refuted
