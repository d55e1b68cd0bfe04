"""Proofs that no force exists: checked by hand, and told in words."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from force.generators import problem

from grasp_env.errors import GraspError, InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceOptimizer
from grasp_env.grasp import Grasp, presets

CUBOID = presets.paper_cuboid()
WRENCH = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
PALM = Grasp.from_contacts(CUBOID.positions, [[0.0, 0.0, 1.0]] * 4, 0.4)
TWICE = 2e-7
"""What an interior point's proof may miss, of the size of its terms."""


def lacks(
    error: InfeasibleWrenchError, grasp: Grasp, limits: ForceLimits | None, wrench: np.ndarray
) -> tuple[float, float]:
    """How far q = G^T v + A^T y leaves the dual cones, and v . w - y . b falls short of 0, of the size of the terms."""
    solution, models = error.solution, grasp.models
    twist, prices = solution.certificate, solution.limit_multipliers
    q = np.concatenate([(twist @ grasp.matrix).reshape(-1, 3), (twist @ grasp.torsion_matrix)[:, None]], axis=1)
    size, right = np.abs(q).max(), 0.0
    if limits is not None:
        rows = limits.rows(grasp)
        assert (prices >= 0.0).all()
        assert len(prices) == len(rows.bound)
        q, right = q + (prices @ rows.matrix).reshape(-1, 4), float(prices @ rows.bound)
        size = max(size, float((prices[:, None] * np.abs(rows.matrix)).max(initial=0.0)))
    lost = np.hypot(*(models.friction * q[:, 1:3]).T) + models.torsional_friction * np.abs(q[:, 3])
    scale = float(np.abs(twist * wrench).sum()) + abs(right)
    return float((lost - q[:, 0]).max()) / size, (right - float(twist @ wrench)) / scale


@pytest.mark.parametrize("method", ["newton", "conic"])
@pytest.mark.parametrize("family", ["limited", "tight", "fingers"])
def test_a_proof_is_a_twist_and_prices_of_limits(family: str, method: str) -> None:
    proven = with_prices = 0
    for index in range(150):
        p = problem(family, 5, index)
        try:
            ForceOptimizer(p.grasp, method=method, limits=p.limits).solve(p.wrench)
        except InfeasibleWrenchError as error:
            outside, short = lacks(error, p.grasp, p.limits, p.wrench)
            assert outside <= TWICE, index
            assert short <= TWICE, index
            proven += 1
            with_prices += bool(error.solution.limit_multipliers.any())
        except GraspError:
            continue
    assert proven > 10
    assert with_prices > 3


def test_limits_in_a_proof_are_those_of_the_call() -> None:
    jacobian = 0.08 * np.random.default_rng(3).standard_normal((4, 3, 5))
    optimizer = ForceOptimizer(CUBOID, limits=ForceLimits(jacobian=jacobian, torque_limit=0.4))
    moved = {"positions": CUBOID.positions + 1e-3, "jacobian": 10.0 * jacobian}
    with pytest.raises(InfeasibleWrenchError, match=r"joint \d: torque") as caught:
        optimizer.solve(WRENCH, **moved)
    now = Grasp.from_contacts(moved["positions"], CUBOID.normals, CUBOID.friction)
    limits = ForceLimits(jacobian=moved["jacobian"], torque_limit=0.4)
    assert max(lacks(caught.value, now, limits, WRENCH)) <= TWICE


def test_words_name_what_the_proof_needs() -> None:
    with pytest.raises(InfeasibleWrenchError, match=r"needs the limits contact 0: normal <= 0.3 N.*elastic=True"):
        ForceOptimizer(CUBOID, method="conic", limits=ForceLimits(max_normal=[0.3, 90.0, 90.0, 90.0])).solve(WRENCH)
    with pytest.raises(InfeasibleWrenchError, match=r"inside the friction cones balances") as caught:
        ForceOptimizer(PALM).solve([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert "limits" not in str(caught.value)
    with pytest.raises(InfeasibleWrenchError) as caught:  # it slides
        ForceOptimizer(PALM).solve([2.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    q = (caught.value.solution.certificate @ PALM.matrix).reshape(-1, 3)
    lost = 0.4 * np.hypot(*q[:, 1:].T)
    slipping = [str(k) for k in range(4) if q[k, 0] - lost[k] <= 1e-3 * (q[k, 0] + lost[k])]
    assert len(slipping) > 1
    assert f"what the cones of contacts {', '.join(slipping)} can make" in str(caught.value)
    angle = 2.0 * np.pi * np.arange(12) / 12
    inward = -np.column_stack([np.cos(angle), np.sin(angle), np.zeros(12)])
    ring, many = Grasp.from_contacts(-0.05 * inward, inward, 0.5), ForceLimits(max_normal=0.1)
    with pytest.raises(InfeasibleWrenchError, match="and 6 more") as caught:
        ForceOptimizer(ring, limits=many).solve([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])
    with pytest.raises(InfeasibleWrenchError, match="exceeds"):
        ForceOptimizer(ring, limits=many, elastic=True).solve([0.0, 0.0, 5.0, 0.0, 0.0, 0.0]).raise_for_status()
    again = pickle.loads(pickle.dumps(caught.value))
    assert str(again) == str(caught.value)
    np.testing.assert_array_equal(again.solution.certificate, caught.value.solution.certificate)


def test_words_survive_overwritten_arrays():
    positions = CUBOID.positions.copy()
    with pytest.raises(InfeasibleWrenchError) as caught:
        ForceOptimizer(CUBOID, limits=ForceLimits(max_normal=0.01)).solve(WRENCH, positions=positions)
    positions[:] = np.nan
    assert "normal <= 0.01 N" in str(caught.value)
