"""The largest normal force and the norm of the joint torques, least within limits: Clarabel has the
same verdict and optimum on random wrenches of the benchmark's hands."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from limited_tracks import TRACKS, drawn, made_soft

from benchmarks.force.bounds import Measure
from benchmarks.force.package import grasp_of, margin_of
from benchmarks.force.problems import Problem, load
from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceOptimizer

clarabel = pytest.importorskip("clarabel")


def torque_matrix(p: Problem) -> np.ndarray:
    """(J, N k) joint torques of the forces."""
    parts = []
    for frame, jacobian in zip(p.frames, p.jacobian, strict=True):
        parts.append((frame.T @ jacobian[:3]).T)
        if p.width == 4:
            parts.append((frame[:, 0] @ jacobian[3:])[:, None])
    return np.hstack(parts)


def clarabel_optimum(problem: Problem, criterion: str) -> float | None:
    """None: no force keeps the limits."""
    p = problem.shifted()
    size = p.n_contacts * p.width
    unit = np.eye(size)
    idle = unit[~np.repeat(p.active, p.width)]
    blocks = [
        (p.matrix, 0.0, -p.wrench, clarabel.ZeroConeT),
        (idle, 0.0, np.zeros(len(idle)), clarabel.ZeroConeT),
        (p.limit_matrix, 0.0, p.limit_bound, clarabel.NonnegativeConeT),
    ]
    if criterion == "max":
        normals = unit[:: p.width]
        blocks.append((normals, -1.0, -problem.shift, clarabel.NonnegativeConeT))
    else:
        rows = np.vstack([np.zeros(size), -torque_matrix(p)])
        first = np.eye(len(rows), 1)[:, 0]
        blocks.append((rows, -first, np.append(0.0, p.torque_bias), clarabel.SecondOrderConeT))
    for i in range(p.n_contacts):
        rows = -unit[p.width * i : p.width * (i + 1)]
        rows[0] *= p.friction[i]
        if p.width == 4:
            rows[3] *= p.friction[i] / p.torsional_friction[i]
        blocks.append((rows, 0.0, np.zeros(p.width), clarabel.SecondOrderConeT))
    blocks = [block for block in blocks if len(block[0])]
    matrix = np.vstack([np.column_stack([a, np.broadcast_to(t, len(a))]) for a, t, _, _ in blocks])
    cones = [cone(len(a)) for a, _, _, cone in blocks]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cost = np.append(np.zeros(size), 1.0)
    bound = np.concatenate([b for _, _, b, _ in blocks])
    zero = sp.csc_matrix((size + 1, size + 1))
    answer = clarabel.DefaultSolver(
        zero, cost, sp.csc_matrix(matrix), bound, cones, settings
    ).solve()
    assert answer.status in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.PrimalInfeasible)
    return answer.x[-1] if answer.status == clarabel.SolverStatus.Solved else None


@pytest.mark.parametrize("soft", [False, True], ids=["hard", "soft"])
@pytest.mark.parametrize("criterion", ["max", "torque"])
def test_random_wrenches_have_clarabels_verdict_and_optimum(criterion, soft):
    rng = np.random.default_rng(1)  # Clarabel solves all of these
    verdicts = {"force": 0, "none": 0}
    sessions = [session for track in TRACKS for session in load(track).sessions]
    for session in sessions:
        for problem in drawn(session, rng, 3):
            if criterion == "torque" and problem.jacobian is None:
                continue
            problem = made_soft(problem) if soft else problem
            grasp, limits = grasp_of(problem)
            optimizer = ForceOptimizer(
                grasp,
                method="conic",
                criterion=criterion,
                limits=limits,
                margin=margin_of(problem),
                tolerance=1e-6,
            )
            best = clarabel_optimum(problem, criterion)
            try:
                solution = optimizer.solve(problem.wrench, contacts=problem.touching)
            except InfeasibleWrenchError:
                assert best is None
                verdicts["none"] += 1
                continue
            verdicts["force"] += 1
            flat = solution.force
            if problem.width == 4:
                flat = np.column_stack([flat, solution.torsion])
            measure, flat = Measure.of(problem), flat.reshape(-1)
            assert max(measure.balance(flat), measure.violation(flat), measure.excess(flat)) <= 1e-9
            value = (
                solution.force[:, 0].max()
                if criterion == "max"
                else np.linalg.norm(torque_matrix(problem) @ flat + problem.torque_bias)
            )
            # 1e-6 of its own gap, and that of Clarabel
            assert value == pytest.approx(best, rel=5e-6)
            assert solution.objective == pytest.approx(value, rel=1e-12)
            assert value * (1.0 - 1.01e-6) <= solution.lower_bound <= best * (1.0 + 2e-6)
    assert min(verdicts.values()) > 15
