"""Messages of a hand that are old, broken or late, and the life cycle of its controller."""

from __future__ import annotations

import numpy as np
import pytest
from held import FRICTION, GRASP, HOME, JOINTS, KINEMATICS, NO_SPRINGS, PERIOD, made, net, updated
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env.control import (
    HandController,
    HandControllerSettings,
    HandState,
    Recording,
    differences,
    replay,
)
from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription


def test_a_finger_reaches_for_its_first_place():
    """Each grasp has its own places, also in one life of a controller; a loss of contact does not
    move them, or they would wander over the object."""
    controller, state = made()
    updated(controller, state, 20)
    controller.deactivate()
    state.positions[:, 1] += 0.005
    controller.activate(state)
    updated(controller, state, 20)
    assert_array_equal(controller.arrays()["goals"], state.positions)
    first = state.positions.copy()
    state.touching[2] = 0.0
    updated(controller, state, 10)
    state.touching[2] = 1.0
    state.positions[2, 0] += 0.002
    updated(controller, state)
    assert_array_equal(controller.arrays()["goals"], first)


def test_a_recording_of_a_second_grasp_replays():
    controller, state = made()
    updated(controller, state, 20)
    controller.deactivate()
    state.positions[:, 1] += 0.005
    controller.record(1.0)
    controller.activate(state)
    updated(controller, state, 10)
    state.touching[0] = 0.0
    updated(controller, state, 50)
    recording = Recording.of(controller)
    assert len(recording) == 61
    assert differences(recording, replay(recording)).rows == 0


def test_a_recording_ends_at_an_agents_step():
    controller, state = made()
    controller.deactivate()
    controller.record(1.0)
    controller.activate(state)
    updated(controller, state, 3)
    controller.observe(state, PERIOD)
    controller.act(True)
    updated(controller, state, 3)
    assert len(Recording.of(controller)) == 4


def test_a_released_hand_carries_itself_and_no_more():
    """Old joints: neither free fingers nor dampers push on."""
    controller, state = made(damping=0.01)
    updated(controller, state, 20)
    state.touching[1] = 0.0
    state.angles[3:6] += 0.1
    state.rates[:] = 0.5
    updated(controller, state, 20)
    state.ages[0] = 1.0
    updated(controller, state, 1000)
    assert controller.status == "released"
    _, weight = KINEMATICS.statics(state.angles, GRASP.positions, state.gravity)
    assert_allclose(controller.torques, weight, atol=1e-12)


@pytest.mark.parametrize("late", [0.0, 0.02])
def test_the_spring_of_a_free_finger_is_softened_by_the_delay_of_joints(late):
    controller, state = made(
        joint_delay=late, posture_stiffness=0.0, posture_damping=0.0, reach_limit=1e3
    )
    updated(controller, state, 5)
    state.touching[0] = 0.0
    updated(controller, state, 5)
    own = KINEMATICS.carries[0]

    def pull() -> tuple[np.ndarray, np.ndarray]:
        """The force on the tip and its place; without gravity the links weigh nothing."""
        updated(controller, state)
        jacobian = KINEMATICS.jacobian(state.angles, 0)[:, own]
        return np.linalg.solve(jacobian.T, controller.torques[own]), KINEMATICS.tips(state.angles)[
            0
        ]

    before, there = pull()
    state.angles = HOME + 1e-3 * own
    after, here = pull()
    moved = here - there
    mobility, _ = KINEMATICS.mobility(HOME)
    stiffness = min(60.0, 0.5 / (mobility[0] * (PERIOD + 1.5 * late) ** 2))
    assert_allclose(-((after - before) @ moved) / (moved @ moved), stiffness, rtol=1e-6)
    assert (stiffness < 60.0) == (late > 0.0)


def test_quaternions_and_normals_count_as_exact_or_not_at_all():
    controller, state = made(**NO_SPRINGS)
    held = updated(controller, state, 20)
    for part in (state.object, state.target):
        part[3:7] = 0.0, 0.0, 1.0, 1.0
        assert_array_equal(updated(controller, state), held)
        with pytest.raises(InvalidInputError, match="quaternions of length 1"):
            HandController.activate(controller, state)
        part[3:7] = 0.0, 0.0, 0.0, 1.003
        controller.activate(state)
        assert_allclose(updated(controller, state, 20), held, atol=1e-3)
        part[3:7] = 0.0, 0.0, 0.0, 1.0
        controller.activate(state)
        held = updated(controller, state, 20)
    state.normals[:] = 0.995 * GRASP.normals
    updated(controller, state, 20)
    assert controller.status == "holding"
    assert_allclose(net(controller, controller.force), -state.wrench, atol=1e-6)


def test_ages_below_zero_are_new_and_an_infinite_one_of_the_wrench_is_allowed():
    controller, state = made()
    state.ages[:] = -30.0, -30.0, np.inf
    updated(controller, state)
    assert controller.status == "holding"
    broken = HandState(JOINTS + 1, 4)
    updated_with_nothing = [controller.update(broken, PERIOD) for _ in range(30)]
    assert controller.status == "coasting"
    assert len(updated_with_nothing) == 30


@pytest.mark.parametrize("period", [0.0, -1.0, np.nan])
def test_a_broken_clock_does_not_stop_ageing(period):
    controller, state = made()
    updated(controller, state, 5)
    broken = HandState(JOINTS + 1, 4)
    for _ in range(1000):
        controller.update(broken, period)
    assert controller.status == "released"


def test_a_second_configure_changes_nothing():
    controller, state = made()
    updated(controller, state, 5)
    with pytest.raises(InvalidInputError, match="make a new one"):
        controller.configure(HandDescription.allegro(), HandControllerSettings(rate=100.0))
    assert controller.hand is KINEMATICS.hand
    assert controller.settings.rate == 1000.0
    assert controller.status == "holding"


def test_a_state_of_another_hand_with_as_many_numbers_is_refused():
    """Two fingertips have as many as seven joints."""
    joints, fingers = JOINTS + 7, 2
    other = HandState(joints, fingers)
    controller, state = made()
    assert len(other.numbers) == len(state.numbers)
    held = updated(controller, state, 5)
    other.numbers[:] = state.numbers
    assert_allclose(updated(controller, other), held, atol=1e-3)
    assert controller.arrays()["positions"].shape == (4, 3)
    with pytest.raises(InvalidInputError, match="of 12 joints and 4 fingertips"):
        controller.activate(other)


def test_a_hand_that_begins_with_old_messages_carries_itself():
    """It has never known its contacts: there is nothing to keep for a while."""
    controller, state = made(damping=0.01)
    state.gravity[:] = 0.0, -9.81, 0.0
    state.rates[:] = 0.5
    state.ages[1] = 1.0
    controller.activate(state)
    updated(controller, state)
    assert controller.status == "released"
    _, weight = KINEMATICS.statics(state.angles, GRASP.positions, state.gravity)
    assert_allclose(controller.torques, weight, atol=1e-12)


def test_a_hand_without_contacts_and_messages_is_released():
    """It has no forces to keep; one with contacts keeps them for a while."""
    for touching, status in ((1.0, "coasting"), (0.0, "released")):
        controller, state = made()
        state.touching[:] = touching
        updated(controller, state, 5)
        state.ages[0] = 1.0
        updated(controller, state)
        assert controller.status == status


@pytest.mark.parametrize("soft", [0.0, 0.01])
def test_told_forces_fade_with_the_commanded_ones(soft):
    """Half of them after the grace and half of the fade; they use the same share of friction."""
    controller, state = made(torsional_friction=soft, **NO_SPRINGS)
    state.wrench[3:] = 0.02, 0.0, 0.03
    updated(controller, state, 50)
    held, used = controller.force.copy(), controller.friction_used.copy()
    alone = np.hypot(held[:, 1], held[:, 2]) / (FRICTION * held[:, 0])
    assert (used >= alone - 1e-12).all()
    assert (used > alone + 1e-3).any() == (soft > 0.0)
    state.ages[0] = 1.0
    updated(controller, state, 200)
    # rounding of 200 periods
    assert_allclose(controller.force, 0.5 * held, atol=1e-9)
    assert_allclose(controller.friction_used, used, atol=1e-9)


def test_each_loss_of_contact_counts_by_itself():
    """A finger that touches in between has its two updates again."""
    controller, state = made(release=2)
    updated(controller, state, 5)
    for touching in (0.0, 0.0, 1.0, 0.0, 0.0, 1.0):
        state.touching[1] = touching
        updated(controller, state)
        assert controller.mask == 0b1111
    assert controller.changes == 0


def test_an_age_that_is_no_number_makes_a_message_that_is_ignored():
    controller, state = made(**NO_SPRINGS)
    held = updated(controller, state, 20)
    for part in range(3):
        state.ages[:] = 0.0
        state.ages[part] = np.nan
        state.wrench[1] = -5.0
        assert_array_equal(updated(controller, state), held)
        assert controller.status == "holding"
        with pytest.raises(InvalidInputError):
            HandController.activate(controller, state)
        state.ages[part], state.wrench[1] = 0.0, -2.0
        controller.activate(state)
        held = updated(controller, state, 20)


def test_updates_after_a_missed_deadline_are_counted():
    """Those later than 1.9 periods; a new life begins from zero."""
    controller, state = made(budget=0.0)
    for periods, late in ((1.0, 0), (1.8, 0), (2.0, 1), (0.0, 1), (-1.0, 1), (3.0, 2)):
        controller.update(state, periods * PERIOD)
        assert controller.late == late
    state.touching[0] = 0.0
    updated(controller, state, 5)
    assert (controller.changes, controller.over_budget) == (1, 11)
    assert controller.peak > 0.0
    controller.activate(state)
    assert (controller.late, controller.changes, controller.over_budget) == (0, 0, 0)
    assert controller.peak == 0.0


def test_after_a_missed_deadline_torques_go_two_periods_of_their_way():
    controller, state = made(torque_rate=0.1, **NO_SPRINGS)
    limits = np.array(KINEMATICS.torque_limits)
    for periods, counted in ((1.0, 1.0), (2.0, 2.0), (100.0, 2.0), (0.5, 0.5)):
        before = controller.torques.copy()
        controller.update(state, periods * PERIOD)
        assert controller.rising
        moved = np.abs(controller.torques - before) / limits
        # differences of numbers below 1
        assert moved.max() == pytest.approx(0.1 * counted * PERIOD, rel=1e-9)
