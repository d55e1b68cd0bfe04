"""Limits as rows, slacks and words, joint torques, and Newton within the limits of fingers with
their own joints."""

from __future__ import annotations

import numpy as np
import pytest
from force.generators import closed, finger_limits
from force.named import attempt
from problems import random_grasp

from grasp_env.force import ForceLimits, ForceOptimizer, Objective, Status, joint_torques
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility


def mixed(rng: np.random.Generator) -> Grasp:
    """Hard, soft and frictionless contacts with tangents of their own."""
    plain = random_grasp(rng, 4)
    models = ["hard", "soft", "frictionless", "soft"]
    options = {
        "torsional_friction": 0.01,
        "contact_model": models,
        "tangents": rng.standard_normal((4, 3)),
    }
    return Grasp.from_contacts(plain.positions, plain.normals, 0.5, **options)


def test_rows_slacks_and_violations_agree_with_the_torques():
    rng = np.random.default_rng(0)
    grasp = mixed(rng)
    jac = rng.standard_normal((4, 6, 3))
    limits = ForceLimits(
        [0.1, 0, 0.2, 0.3], [1, np.inf, 2, 3], jac, [0.5, np.inf, 1.5], [0.1, 0.2, -0.3]
    )
    matrix, bound, labels = limits.rows(grasp)
    assert matrix.shape == (3 + 3 + 4, 16)
    assert (labels[0], labels[4]) == ("contact 0: normal >= 0.1 N", "contact 2: normal <= 2 N")
    assert labels[6:] == tuple(
        f"joint {j}: torque {b} N m"
        for j, b in ((0, "<= 0.5"), (0, ">= -0.5"), (2, "<= 1.5"), (2, ">= -1.5"))
    )
    used = np.abs(matrix[6:]).max(axis=0).reshape(4, 4) > 0.0
    np.testing.assert_array_equal(
        used, np.array([[1, 1, 1, 0], [1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 1]], dtype=bool)
    )
    outcomes = set()
    for _ in range(100):
        force = rng.standard_normal((4, 3))
        torsion = rng.standard_normal(4)
        force[2, 1:], torsion[[0, 2]] = 0.0, 0.0  # what the contacts transmit
        room = bound - matrix @ np.column_stack([force, torsion]).reshape(-1)
        slack = limits.slack(grasp, force, torsion)
        # contact 1 has the least normal force 0, which the cone implies
        assert slack.min_normal == pytest.approx(min(room[:3].min(), force[1, 0]), abs=1e-14)
        assert slack.max_normal == pytest.approx(room[3:6].min(), abs=1e-14)
        moment = torsion[:, None] * grasp.normals
        tau = joint_torques(jac, grasp.to_object_frame(force), [0.1, 0.2, -0.3], moment=moment)
        assert slack.torque == pytest.approx(
            (np.array([0.5, np.inf, 1.5]) - np.abs(tau)).min(), abs=1e-13
        )
        assert slack.torque == pytest.approx(room[6:].min(), abs=1e-13)
        violated = limits.violations(grasp, force, torsion)
        assert [text.split(" is exceeded")[0] for text in violated] == [
            labels[k] for k in np.flatnonzero(room < -1e-9)
        ]
        outcomes.add(len(violated))
    assert len(outcomes) > 3


def test_one_limit_for_all_is_one_each_and_a_copy():
    jac = np.random.default_rng(2).standard_normal((3, 3, 2))
    most = np.full(3, 4.0)
    one = ForceLimits(0.5, 4.0, jac.reshape(9, 2), 2.0).rows(presets.tripod())
    limits = ForceLimits([0.5] * 3, most, jac, [2.0, 2.0], [0.0, 0.0])
    limits.checked(3).max_normal[0] = most[0] = 7.0
    each = limits.rows(presets.tripod())
    np.testing.assert_array_equal(one.matrix, each.matrix)
    np.testing.assert_array_equal(one.bound, each.bound)
    assert one.labels == each.labels
    with pytest.raises(ValueError, match="read-only"):
        limits.max_normal[0] = 5.0  # type: ignore[index]


# Newton within limits


@pytest.mark.parametrize("seed", range(3))
def test_the_general_program_agrees(seed):
    rng = np.random.default_rng(100 + seed)
    grasp = closed(rng, 4)
    limits = finger_limits(rng, 4, 2.5)
    optimizer = ForceOptimizer(grasp, limits=limits, tolerance=1e-10)
    optimal = 0
    for load in rng.standard_normal((8, 6)) * np.repeat([1.0, 0.03], 3):
        found = attempt(lambda load=load: optimizer.solve(load))
        if found.status is Status.INFEASIBLE:
            assert not feasibility(grasp, load, limits).feasible
            continue
        optimal += 1
        want = optimizer.solve(load, trace=True)  # a trace goes to the general program
        assert (np.diff(want.objective_trace) <= 0.0).all()
        assert found.status is want.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=2e-10)
        assert optimizer.solve(load, optimum=want.objective).optimality_gap <= 1e-9
        # prices are lambda / slack^2, known to the root of the gap
        for one, other in (
            (found.multipliers, want.multipliers),
            (found.limit_multipliers, want.limit_multipliers),
        ):
            np.testing.assert_allclose(one, other, atol=1e-3 * np.abs(other).max())
    assert optimal > 1


def test_a_limit_weighs_as_its_contact_with_friction_or_without():
    """A row of length l in cone coordinates has the multiplier lambda l / slack^2."""
    models = ["frictionless", "hard", "hard", "hard"]
    hard = presets.paper_cuboid()
    grasp = Grasp.from_contacts(hard.positions, hard.normals, hard.friction, contact_model=models)
    wrench = np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0])
    solution = ForceOptimizer(grasp, limits=ForceLimits(max_normal=1.5)).solve(wrench)
    slack = 1.5 - solution.force[:, 0]
    length = 1.0 / np.where(np.array(models) == "hard", hard.friction, 1.0)
    barrier = Objective().barrier_weight
    np.testing.assert_allclose(solution.limit_multipliers, barrier * length / slack**2, rtol=1e-9)
