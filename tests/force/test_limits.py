"""Limits as rows, slacks and words, and joint torques: what they are, and what is refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from problems import random_grasp

from grasp_env.errors import InvalidInputError
from grasp_env.force.limits import ForceLimits
from grasp_env.force.torques import joint_torques
from grasp_env.grasp import Grasp, presets


def _soft(rng: np.random.Generator) -> Grasp:
    """Along tangents of its own: torques do not hang on them."""
    plain, models = random_grasp(rng, 4), ["hard", "soft", "frictionless", "soft"]
    options = {"torsional_friction": 0.01, "contact_model": models, "tangents": rng.standard_normal((4, 3))}
    return Grasp.from_contacts(plain.positions, plain.normals, 0.5, **options)


def _transmitted(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Random force and torsion that `_soft` can carry."""
    force, torsion = rng.standard_normal((4, 3)), rng.standard_normal(4)
    force[2, 1:] = 0.0
    torsion[[0, 2]] = 0.0
    return force, torsion


def test_rows_say_what_slack_says() -> None:
    rng = np.random.default_rng(0)
    grasp = _soft(rng)
    jac = rng.standard_normal((4, 6, 3))
    limits = ForceLimits([0.1, 0, 0.2, 0.3], [1, np.inf, 2, 3], jac, [0.5, np.inf, 1.5], [0.1, 0.2, -0.3])
    matrix, bound, labels = limits.rows(grasp)
    assert matrix.shape == (3 + 3 + 4, 16)
    assert labels[0] == "contact 0: normal >= 0.1 N"
    assert labels[4] == "contact 2: normal <= 2 N"
    assert labels[6:] == tuple(
        f"joint {j}: torque {b} N m" for j, b in ((0, "<= 0.5"), (0, ">= -0.5"), (2, "<= 1.5"), (2, ">= -1.5"))
    )
    outcomes = set()
    for _ in range(200):
        force, torsion = _transmitted(rng)
        room = bound - matrix @ np.column_stack([force, torsion]).reshape(-1)
        slack = limits.slack(grasp, force, torsion)
        # contact 1 has the least normal force 0, which is the cone's own limit and no row
        assert slack.min_normal == pytest.approx(min(room[:3].min(), force[1, 0]), abs=1e-14)
        assert slack.max_normal == pytest.approx(room[3:6].min(), abs=1e-14)
        moment = torsion[:, None] * grasp.normals
        tau = joint_torques(jac, grasp.to_object_frame(force), [0.1, 0.2, -0.3], moment=moment)
        assert slack.torque == pytest.approx((np.array([0.5, np.inf, 1.5]) - np.abs(tau)).min(), abs=1e-13)
        assert slack.torque == pytest.approx(room[6:].min(), abs=1e-13)
        violated = limits.violations(grasp, force, torsion)
        assert [text.split(" is exceeded")[0] for text in violated] == [labels[k] for k in np.flatnonzero(room < -1e-9)]
        outcomes.add(len(violated))
    assert len(outcomes) > 3


def test_columns_of_what_is_not_transmitted_are_zero() -> None:
    rng = np.random.default_rng(1)
    matrix = ForceLimits(jacobian=rng.standard_normal((4, 6, 3)), torque_limit=1.0).rows(_soft(rng)).matrix
    used = np.abs(matrix).max(axis=0).reshape(4, 4) > 0.0
    np.testing.assert_array_equal(used, np.array([[1, 1, 1, 0], [1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 1]], dtype=bool))
    three = ForceLimits(jacobian=rng.standard_normal((4, 3, 3)), torque_limit=1.0).rows(_soft(rng)).matrix
    assert (three[:, 3::4] == 0.0).all()


def test_one_for_all_is_one_each() -> None:
    jac = np.random.default_rng(2).standard_normal((3, 3, 2))
    one = ForceLimits(0.5, 4.0, jac.reshape(9, 2), 2.0).rows(presets.tripod())
    each = ForceLimits([0.5] * 3, [4.0] * 3, jac, [2.0, 2.0], [0.0, 0.0]).rows(presets.tripod())
    np.testing.assert_array_equal(one.matrix, each.matrix)
    np.testing.assert_array_equal(one.bound, each.bound)
    assert one.labels == each.labels
    assert len(one.bound) == 3 + 3 + 4


def test_limits_are_immutable_copies() -> None:
    most = np.array([1.0, 2.0, 3.0])
    limits = ForceLimits(max_normal=most)
    most[0] = 9.0
    np.testing.assert_array_equal(limits.checked(3).max_normal, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="read-only"):
        limits.max_normal[0] = 5.0  # type: ignore[index]
    limits.checked(3).max_normal[0] = 7.0  # a copy to work with
    np.testing.assert_array_equal(limits.checked(3).max_normal, [1.0, 2.0, 3.0])


JAC, SPUN = np.ones((3, 3, 2)), np.zeros((4, 3, 2))
ONES = np.ones((4, 3))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"min_normal": -1}, "min_normal must be >= 0 and finite, one for all or one per contact, got -1"),
        ({"min_normal": np.inf}, "min_normal must be >= 0 and finite"),
        ({"min_normal": [0, np.nan]}, r"min_normal must be .* got \[0\.0, nan\]"),
        ({"min_normal": "a"}, "min_normal must be a number or one per contact"), ({"min_normal": [[1.0]]}, "min_normal must be"),
        ({"min_normal": []}, "min_normal must be"), ({"max_normal": 0}, "max_normal must be > 0, inf for no limit, one for all"),
        ({"max_normal": None}, "max_normal must be"), ({"min_normal": 2, "max_normal": [3, 2, 4]}, "at contact 1 they are 2 and 2"),
        ({"min_normal": [0, 0], "max_normal": [1, 1, 1]}, "min_normal has 2 entries and max_normal 3"),
        *((given, f"need jacobian and torque_limit together, got only {next(iter(given))}") for given in ({"jacobian": JAC}, {"torque_limit": 1})),
        ({"torque_bias": [1.0]}, "torque_bias without torque limits has no effect"),
        ({"jacobian": JAC, "torque_limit": 0}, "torque_limit must be > 0, inf for no limit, one for all or one per joint"),
        ({"jacobian": JAC, "torque_limit": [1, 1, 1]}, "torque_limit has 3 entries, the jacobian 2 joints"),
        ({"jacobian": JAC, "torque_limit": 1, "torque_bias": [1]}, r"torque_bias must have shape \(2,\)"),
        ({"jacobian": np.ones((3, 5, 2)), "torque_limit": 1}, r"jacobian must have shape \(N, 3, J\)"),
    ],
)  # fmt: skip
def test_wrong_limits(given: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ForceLimits(**given)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (ForceLimits(min_normal=[0, 0, 0]), "min_normal has 3 entries, the grasp 4 contacts: give one or 4"),
        (ForceLimits(max_normal=[1, 1, 1]), "max_normal has 3 entries"),
        (ForceLimits(jacobian=JAC, torque_limit=1), r"jacobian must have shape \(4, 3, J\)"),
    ],
)
def test_limits_of_another_number_of_contacts(limits: ForceLimits, message: str) -> None:
    cuboid = presets.paper_cuboid()
    for call in (lambda: limits.checked(4), lambda: limits.rows(cuboid), lambda: limits.slack(cuboid, ONES)):
        with pytest.raises(InvalidInputError, match=message):
            call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ForceLimits().slack(presets.tripod(), np.ones(3)), r"force must have shape \(3, 3\)"),
        (lambda: ForceLimits().violations(presets.tripod(), ONES), r"force must have shape \(3, 3\)"),
        (lambda: ForceLimits().slack(presets.tripod(), ONES[:3], np.ones(2)), r"torsion must have shape \(3,\)"),
        (lambda: joint_torques(SPUN, np.zeros(12)), r"force must have shape \(N, 3\)"),
        (lambda: joint_torques(SPUN, ONES, np.zeros(3)), r"bias must have shape \(2,\), got \(3,\)"),
        (lambda: joint_torques(SPUN, ONES, moment=ONES), r"moment needs a jacobian of shape \(N, 6, J\)"),
        (lambda: joint_torques(np.zeros((4, 6, 2)), ONES, moment=np.zeros(4)), r"moment must have shape \(4, 3\)"),
        (lambda: joint_torques(np.zeros((3, 3, 2)), ONES),
         r"jacobian must have shape \(4, 3, J\), \(12, J\) or \(4, 6, J\) .*got \(3, 3, 2\)"),
        *((partial(joint_torques, np.zeros(shape), ONES), re.escape(f"got {shape}")) for shape in ((4, 4, 2), (4, 3, 0), (11, 2), (12,))),
        (lambda: joint_torques(np.full((4, 3, 2), np.inf), ONES), "jacobian must be finite"),
        (lambda: joint_torques([[1.0], [1.0, 2.0]], ONES), "jacobian must be numbers"),
    ],
)  # fmt: skip
def test_wrong_forces_and_jacobians(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        call()


# torques


def test_torques_do_the_power_of_the_forces() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        grasp = random_grasp(rng, 4)
        jac = rng.standard_normal((4, 6, 5))
        force, torsion, speed = rng.standard_normal((4, 3)), rng.standard_normal(4), rng.standard_normal(5)
        in_object = np.einsum("nij,nj->ni", grasp.frames, force)
        power = sum(float(in_object[k] @ (jac[k, :3] @ speed)) for k in range(4))
        assert joint_torques(jac[:, :3], in_object) @ speed == pytest.approx(power, rel=1e-12)
        twisting = sum(float(torsion[k] * grasp.normals[k] @ (jac[k, 3:] @ speed)) for k in range(4))
        tau = joint_torques(jac, in_object, moment=torsion[:, None] * grasp.normals)
        assert tau @ speed == pytest.approx(power + twisting, rel=1e-11, abs=1e-12)


def test_shapes_and_bias() -> None:
    rng = np.random.default_rng(2)
    jac, force, bias = rng.standard_normal((4, 3, 2)), rng.standard_normal((4, 3)), np.array([1.0, -2.0])
    plain = joint_torques(jac, force)
    np.testing.assert_array_equal(joint_torques(jac.reshape(12, 2), force), plain)
    np.testing.assert_allclose(plain, jac.reshape(12, 2).T @ force.reshape(-1), atol=1e-14)
    np.testing.assert_array_equal(joint_torques(jac, force, bias), plain + bias)
    six = np.concatenate([jac, rng.standard_normal((4, 3, 2))], axis=1)
    np.testing.assert_array_equal(joint_torques(six, force), plain)  # no moment, no torque of it
