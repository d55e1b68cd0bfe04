"""Payload against Clarabel, bisection and closed forms, with its force and its proof."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import KINDS, some_grasp

from grasp_env.errors import (
    InfeasibleWrenchError,
    InvalidInputError,
    UnsupportedProblemError,
)
from grasp_env.force import ForceLimits, ForceOptimizer, Margin
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import payload
from grasp_env.quality.payload import Payload

GAMMA = 0.005
JAW = Grasp.from_contacts(
    [[-0.02, 0, 0], [0.02, 0, 0]],
    [[1, 0, 0], [-1, 0, 0]],
    0.5,
    contact_model="soft",
    torsional_friction=GAMMA,
)
TEN = ForceLimits(max_normal=10.0)


def drawn(seed: int) -> tuple[Grasp, ForceLimits, np.ndarray, np.ndarray]:
    """A grasp, limits of all normal forces and some joints, a direction, a small first wrench."""
    rng = np.random.default_rng(seed)
    grasp = some_grasp(rng, KINDS[seed % len(KINDS)], most=8)
    count = grasp.n_contacts
    joints = int(rng.integers(1, 7))
    jacobian = grasp.length * rng.standard_normal((count, 6, joints))
    jacobian[:, 3:] /= grasp.length
    limits = ForceLimits(
        max_normal=10.0 ** rng.uniform(0.0, 2.0, count),
        jacobian=jacobian if seed % 3 else None,
        torque_limit=grasp.length * 10.0 ** rng.uniform(0.5, 2.0, joints) if seed % 3 else None,
        torque_bias=grasp.length * rng.uniform(-1.0, 1.0, joints) if seed % 3 else None,
    )
    moments = [1.0] * 3 + [grasp.length] * 3
    direction = rng.standard_normal(6) * moments
    return grasp, limits, direction, (seed % 2) * 0.1 * rng.standard_normal(6) * moments


def assert_held(result: Payload, grasp: Grasp, limits: ForceLimits | None, within: float) -> None:
    """The force balances the load's wrench within cones and limits."""
    reference = Reference(grasp, limits)
    size = np.abs(reference.load(result.wrench)).max() + np.abs(result.force).max()
    assert reference.residual(result.force, result.torsion, result.wrench) <= 2e-9 * size
    assert reference.violation(result.force, result.torsion) <= within * size


def assert_proven(
    result: Payload,
    grasp: Grasp,
    limits: ForceLimits | None,
    direction: np.ndarray,
    wrench: np.ndarray,
) -> None:
    """The twist and the multipliers prove the upper bound for the loads above it."""
    above = wrench + (result.upper * (1.0 + 1e-12) + 1e-12) * direction
    proof = Reference(grasp, limits).proof(result.certificate, above, result.limit_multipliers)
    assert proof >= -1e-13
    assert result.certificate @ direction == pytest.approx(1.0, rel=1e-9)


# of the last six, the iterates stay outside a cone by rounding
@pytest.mark.parametrize("seed", [*range(40), 87, 124, 206, 237, 257, 285])
def test_the_load_is_that_of_clarabel(seed):
    grasp, limits, direction, wrench = drawn(seed)
    exact = Reference(grasp, limits).payload(direction, wrench)
    try:
        result = payload(grasp, direction, limits, wrench=wrench)
    except InfeasibleWrenchError:
        assert not exact > 1e-9
        return
    assert result.load == pytest.approx(exact, rel=2e-6, abs=1e-9)
    assert result.load <= result.upper <= result.load * (1.0 + 1e-6) + 1e-9
    np.testing.assert_allclose(result.wrench, wrench + result.load * direction, rtol=1e-12)
    assert_held(result, grasp, limits, 1e-12)
    assert_proven(result, grasp, limits, direction, wrench)


def test_limits_that_leave_some_forces_unbounded():
    bounded = 0
    for seed in range(1, 90, 3):
        grasp, limits, direction, wrench = drawn(seed)
        torques = ForceLimits(
            jacobian=limits.jacobian,
            torque_limit=limits.torque_limit,
            torque_bias=limits.torque_bias,
        )
        try:
            result = payload(grasp, direction, torques, wrench=wrench)
        except (InfeasibleWrenchError, UnsupportedProblemError):
            continue
        bounded += 1
        exact = Reference(grasp, torques).payload(direction, wrench)
        assert result.load == pytest.approx(exact, rel=1e-5, abs=1e-9)
        assert result.load <= result.upper <= result.load * (1.0 + 1e-6) + 1e-9
        assert_held(result, grasp, torques, 1e-12)
    assert bounded >= 10


def test_a_load_just_below_is_held_and_one_above_is_not():
    held_at_all = 0
    for seed in range(16):
        grasp, limits, direction, wrench = drawn(seed)
        margin = Margin(0.8, 0.05)
        try:
            result = payload(grasp, direction, limits, margin, wrench=wrench)
        except InfeasibleWrenchError:  # the preloads exceed a torque limit
            continue
        held_at_all += 1
        exact = ForceOptimizer(grasp, method="conic", limits=limits, margin=margin)
        held = exact.solve(wrench + 0.9999 * result.load * direction)
        assert held.friction_used.max() <= 0.8 + 1e-9
        with pytest.raises(InfeasibleWrenchError):
            exact.solve(wrench + 1.0001 * result.upper * direction)
        shifted = result.force - 0.05 * np.array([1.0, 0.0, 0.0])
        narrowed = grasp.with_friction(
            0.8 * grasp.models.friction, 0.8 * grasp.models.torsional_friction
        )
        assert narrowed.cone_margin(shifted, result.torsion) >= -1e-9 * np.abs(result.force).max()
    assert held_at_all >= 10


def test_a_jaw_under_weight_and_torsion():
    # each tip carries W/2 of the weight and W d/2 of its moment about the normals
    for arm in (0.0, 0.005, 0.02):
        for share in (1.0, 0.8):
            one = np.hypot(0.5 / 0.5, 0.5 * arm / GAMMA) / share  # normal force per newton
            screw = [0, 0, -1, -arm, 0, 0]
            assert float(payload(JAW, screw, TEN, share)) == pytest.approx(10.0 / one, rel=1e-6)
    with_preload = payload(JAW, [0, 0, -1], TEN, Margin(1.0, 4.0))
    assert with_preload.load == pytest.approx(6.0, rel=1e-6)


def test_a_torque_bias_takes_its_share():
    jacobian = np.zeros((2, 3, 2))
    jacobian[0, 0, 0], jacobian[1, 0, 1] = 0.05, -0.05
    for bias in (0.0, 0.2):
        limits = ForceLimits(jacobian=jacobian, torque_limit=0.5, torque_bias=[bias, 0.0])
        # the normal force of 10 N less the part of the motor that holds the link
        assert payload(JAW, [0, 0, -1], limits).load == pytest.approx(10.0 - bias / 0.05, rel=1e-6)


def test_a_wrench_besides_the_load():
    alone = payload(JAW, [0, 0, -1], TEN).load
    besides = payload(JAW, [0, 0, -1], TEN, wrench=[0, 0, -3.0, 0, 0, 0]).load
    against = payload(JAW, [0, 0, -1], TEN, wrench=[0, 0, 3.0, 0, 0, 0]).load
    assert (besides, against) == (pytest.approx(alone - 3.0), pytest.approx(alone + 3.0))


def test_units_of_the_direction():
    for size in (1e-6, 1.0, 1e6):
        result = payload(JAW, [0, 0, -size], TEN)
        assert size * result.load == pytest.approx(10.0, rel=1e-6)


def test_an_unbounded_load_asks_for_limits():
    with pytest.raises(UnsupportedProblemError, match="max_normal"):
        payload(presets.tripod(), [0, 0, -1])
    with pytest.raises(UnsupportedProblemError, match="not bounded"):  # one finger has no limit
        payload(JAW, [1, 0, 0], ForceLimits(max_normal=[10.0, np.inf]))
    assert payload(JAW, [-1, 0, 0], ForceLimits(max_normal=[10.0, np.inf])).load == pytest.approx(
        10
    )


def test_no_force_without_load():
    limits = ForceLimits(min_normal=2.0, max_normal=10.0)
    with pytest.raises(InfeasibleWrenchError) as caught:
        payload(JAW, [0, 0, -1], limits, wrench=[0, 0, -50, 0, 0, 0])
    proof = caught.value.solution
    reference = Reference(JAW, limits)
    assert (
        reference.proof(proof.certificate, [0, 0, -50, 0, 0, 0], proof.limit_multipliers) >= -1e-9
    )


def test_a_direction_that_contacts_do_not_hold():
    palm = Grasp.from_contacts(np.eye(3) * 0.05, [[0, 0, 1.0]] * 3, 0.5)
    for direction in ([0, 0, 1.0], [1.0, 0, 0]):  # lifted off; no weight presses it down
        result = payload(palm, direction)
        assert (result.load, result.upper) == (0.0, pytest.approx(0.0, abs=1e-9))
        assert np.abs(result.force).max() <= 1e-9
    hard = Grasp.from_contacts(JAW.positions, JAW.normals, 0.5)
    turned = payload(hard, [0, 0, 0, 1, 0, 0], TEN)  # about the line through the contacts
    assert (turned.load, turned.upper) == (0.0, 0.0)
    assert turned.certificate @ [0, 0, 0, 1, 0, 0] == pytest.approx(1.0)


@pytest.mark.parametrize("size", [1e-8, 1e-12, 0.1 + 0.2 - 0.3, 1e-30, 1e-300])
def test_a_wrench_that_is_hardly_one(size):
    for grasp in (presets.paper_cuboid(), presets.tripod()):
        without = payload(grasp, [0, 0, -1], TEN, 0.8)
        result = payload(grasp, [0, 0, -1], TEN, 0.8, wrench=[0, 0, size, 0, 0, 0])
        assert result.load == pytest.approx(without.load, rel=1e-6)


def test_limits_decades_apart():
    cuboid = presets.paper_cuboid()  # the thumb, below, carries the load
    for most in (1e-9, 1e-6, 1e-3, 1e4, 1e8, 1e12):
        by_thumb = payload(cuboid, [0, 0, -1], ForceLimits(max_normal=[most, 10, 10, 10]))
        assert by_thumb.load == pytest.approx(most, rel=1e-6)
        by_fingers = payload(cuboid, [0, 0, -1], ForceLimits(max_normal=[10, most, 10, 10]))
        assert by_fingers.load == pytest.approx(10.0, rel=1e-6)


def test_no_load_is_asked_for_first():
    finger = Grasp.from_contacts([[0, 0, -0.03]], [[0, 0, 1]], 0.5)
    lifted = [0, 0, 5.0, 0, 0, 0]  # the finger only pushes up, so it holds loads of 5 to 15 N
    with pytest.raises(InfeasibleWrenchError):
        payload(finger, [0, 0, -1], TEN, wrench=lifted)
    with pytest.raises(InfeasibleWrenchError):  # it presses with at least 1 N
        payload(finger, [0, 0, -1], ForceLimits(max_normal=10.0, min_normal=1.0))
    hard = Grasp.from_contacts(JAW.positions, JAW.normals, 0.5)
    with pytest.raises(InfeasibleWrenchError):  # held at a load of 1 N alone
        payload(hard, [0, 0, -1, -0.1, 0, 0], TEN, wrench=[0, 0, 0, 0.1, 0, 0])


def test_margins_are_checked_as_by_a_solver():
    with pytest.raises(InvalidInputError, match="preload must be below max_normal"):
        payload(JAW, [0, 0, -1], TEN, Margin(0.8, 20.0))
    with pytest.raises(InvalidInputError, match="preload has 3 entries"):
        payload(JAW, [0, 0, -1], TEN, Margin(0.8, [1, 1, 1]))


def test_a_plate_is_held_by_its_weight():
    palm = Grasp.from_contacts(
        [[0.05, 0, 0], [-0.05, 0.05, 0], [-0.05, -0.05, 0]], [[0, 0, 1.0]] * 3, 0.5
    )
    weight = np.array([0, 0, -10.0, 0, 0, 0])
    pulled = payload(palm, [1, 0, 0], wrench=weight)  # no limits: the weight bounds the friction
    assert pulled.load == pytest.approx(5.0, rel=1e-6)
    assert_proven(pulled, palm, None, np.array([1.0, 0, 0, 0, 0, 0]), weight)
    assert payload(palm, [0, 0, 1], wrench=weight).load == pytest.approx(10.0, rel=1e-6)


@pytest.mark.parametrize(
    ("direction", "message"),
    [
        ([0, 0, 0], "1e-100 to 1e\\+12, got"),
        ([0, 0, 1e-300], "1e-100 to 1e\\+12, got"),
        ([0, 0, -1, 0], r"\(3,\) or a screw \(6,\)"),
        ([0, 0, np.nan], "finite"),
        ([0, 0, 1e13], "1e\\+12"),
    ],
)
def test_wrong_directions(direction, message):
    with pytest.raises(InvalidInputError, match=message):
        payload(JAW, direction, TEN)
