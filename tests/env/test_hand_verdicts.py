"""The status of a hand's controller is true of its forces, and bad messages and settings do no harm."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hands import kinematics_alone
from numpy.testing import assert_allclose, assert_array_equal
from oracles import geometry

from grasp_env import core
from grasp_env.control import (
    Calibration,
    HandController,
    HandControllerSettings,
    HandState,
    Recording,
    differences,
    replay,
)
from grasp_env.errors import InvalidInputError
from grasp_env.grasp import presets
from grasp_env.sim import HandDescription

PERIOD = 1e-3
GRASP = presets.paper_cuboid()
FRICTION = float(np.ravel(GRASP.friction)[0])
KINEMATICS = kinematics_alone()
HOME = np.array(KINEMATICS.home)
JOINTS = len(HOME)
NO_SPRINGS = dict.fromkeys(
    ("grip_stiffness", "grip_damping", "posture_stiffness", "posture_damping"), 0.0
)
FAST = {"torque_rate": 1e6, "friction": FRICTION}


def scaled(limits: np.ndarray) -> Calibration:
    """Motors with these limits [N m], commanded in N m."""
    table = np.column_stack([-limits, limits])
    return Calibration(table, table, resolution=0.0)


def made(limits: np.ndarray | None = None, **settings: Any) -> tuple[HandController, HandState]:
    """A controller, and a state in which the hand holds the paper's cuboid of 2 N."""
    controller = HandController()
    options = HandControllerSettings(**{**FAST, **settings})
    controller.configure(
        KINEMATICS.hand, options, None if limits is None else scaled(np.asarray(limits))
    )
    state = controller.new_state()
    state.angles = HOME.copy()
    state.touching[:] = 1.0
    state.positions[:] = GRASP.positions
    state.normals[:] = GRASP.normals
    state.wrench[:] = 0.0, -2.0, 0.0, 0.0, 0.0, 0.0
    controller.activate(state)
    return controller, state


def updated(controller: HandController, state: HandState, count: int = 1) -> np.ndarray:
    """Commands of the last update."""
    return [controller.update(state, PERIOD) for _ in range(count)][-1]


def net(controller: HandController, force: np.ndarray) -> np.ndarray:
    """Wrench (6,) of forces (N, 3), contact frames, on the object."""
    pushes = np.einsum("nij,nj->ni", controller.arrays()["frames"], force)
    return np.concatenate([pushes.sum(axis=0), np.cross(GRASP.positions, pushes).sum(axis=0)])


def sizes(places: np.ndarray, *wrenches: np.ndarray) -> list[float]:
    """Sizes [N] of wrenches in the unit frame of contacts (N, 3)."""
    to_unit = geometry.unit_frame(places)[2]
    return [float(np.linalg.norm(to_unit @ wrench)) for wrench in wrenches]


def torques_of(controller: HandController, state: HandState, force: np.ndarray) -> np.ndarray:
    """Torques (M,) of forces (N, 3) and of the links' weight."""
    moves, weight = KINEMATICS.statics(state.angles, GRASP.positions, state.gravity)
    pushes = np.einsum("nij,nj->ni", controller.arrays()["frames"], force)
    return weight + pushes.ravel() @ moves.reshape(-1, JOINTS)


# --- statuses


@pytest.mark.parametrize("limit", [3, 40])
def test_statuses_are_true_of_random_loads_contacts_and_motors(limit):
    """`holding`: forces inside the margin balance the wrench. `marginal`: forces inside the cones do,
    or forces inside the margin balance nearly all of it. Both are within the motors' limits, and
    no larger than the load calls for. `slipping`: the wrench is not balanced. Forces that do not
    balance change by at most 1 N in an update."""
    seen = dict.fromkeys(("holding", "marginal", "overloaded", "slipping", "pivoting"), 0)
    for seed in range(120):
        rng = np.random.default_rng(seed)
        limits = rng.uniform(0.7, 1.4, JOINTS) * np.exp(rng.uniform(np.log(0.2), np.log(8.0)))
        share = rng.choice([0.5, 0.75, 1.0])
        given = rng.choice([0.0, 0.5])
        controller, state = made(
            limits, friction_margin=share, preload=given, max_iterations=limit, **NO_SPRINGS
        )
        before = None
        for _ in range(12):
            state.touching[:] = rng.random(4) < 0.8
            state.wrench[:] = (
                rng.standard_normal(6) * np.repeat([1.0, 0.02], 3) * np.exp(rng.uniform(-3.0, 3.0))
            )
            for _ in range(rng.integers(1, 4)):
                updated(controller, state)
                status = controller.status
                assert (np.abs(controller.torques) <= limits * (1.0 + 1e-9)).all()
                if status not in seen:  # no finger counts as in contact
                    assert status == "released"
                    before = None
                    continue
                seen[status] += 1
                force = controller.arrays()["optimal"].copy()
                counts = np.array([controller.mask >> i & 1 == 1 for i in range(4)])
                missing, load = sizes(
                    GRASP.positions[counts], net(controller, force) + state.wrench, state.wrench
                )
                balanced = missing < 1e-5 * (1.0 + load)
                preload = controller.arrays()["preload"]
                used = np.hypot(force[:, 1], force[:, 2]) / FRICTION
                assert (used <= force[:, 0] * (1.0 + 1e-6) + 1e-6).all()
                if status in ("holding", "marginal"):
                    torques = torques_of(controller, state, force)
                    assert (np.abs(torques) <= limits * (1.0 + 1e-6)).all()
                if status in ("holding", "marginal", "pivoting"):
                    most = 2.0 * preload.sum() + 4.0 * (1.0 + load / (share * FRICTION))
                    assert force[:, 0].sum() <= most * (1.0 + 1e-6)
                if status == "holding":
                    assert balanced
                    room = force[:, 0] - preload
                    assert (used <= share * room * (1.0 + 1e-6) + 1e-6).all()
                elif status == "marginal":
                    assert missing <= min(0.3, 0.2 * load) * (1.0 + 1e-6)
                elif status == "slipping":
                    assert not balanced
                if before is not None and not balanced and status != "pivoting":
                    assert np.abs(force - before)[counts].max() <= 1.0 + 1e-9
                before = force
    assert min(seen.values()) > 5, seen


@pytest.mark.parametrize("push", [0.0, 0.2])
def test_three_fingers_below_a_ball_do_not_throw_it(push):
    """An Allegro hand that loses its thumb: to balance what three preloads of 1 N push upwards,
    two fingers would have to squeeze with all of the friction. The preloads stay, and a small part
    of the wrench is missing."""
    controller, state = made(friction=0.875, friction_margin=0.6, preload=1.0, **NO_SPRINGS)
    controller.deactivate()
    state.normals[:] = (
        [-0.879, 0.47, -0.073],
        [-0.062, 0.894, 0.444],
        [0.91, 0.382, 0.162],
        [0.298, -0.898, -0.323],
    )
    state.normals[:] /= np.linalg.norm(state.normals, axis=1)[:, None]
    state.positions[:] = -0.03 * state.normals
    state.wrench[:] = push, -1.47, 0.0, 0.0, 0.0, 0.0
    controller.activate(state)
    updated(controller, state, 30)
    assert controller.status == "holding"
    state.touching[3] = 0.0
    before = controller.force.copy()
    for tick in range(60):
        updated(controller, state)
        force = controller.force
        used = np.hypot(force[:3, 1], force[:3, 2])
        assert (used <= 0.6 * 0.875 * (force[:3, 0] - 1.0) + 1e-6).all()
        assert np.abs(force - before)[:3].max() <= 1.0 + 1e-9
        before = force.copy()
        if tick >= 5:
            assert controller.status == "marginal"
            pushes = np.einsum("nij,nj->i", controller.arrays()["frames"], force)
            assert 1e-3 < np.linalg.norm(pushes + state.wrench[:3]) < 0.3
            assert force[:, 0].sum() < 9.0


def test_weak_motors_get_forces_with_less_than_the_margin():
    """Where those within the margin are too large for them, and those inside the cones are not."""
    plain, state = made(friction_margin=0.4, preload=1.0, **NO_SPRINGS)
    state.wrench[1] = -6.0
    updated(plain, state, 50)
    assert plain.status == "holding"
    limits = 0.7 * np.abs(plain.torques).max() * np.ones(JOINTS)
    controller, state = made(limits, friction_margin=0.4, preload=1.0, **NO_SPRINGS)
    state.wrench[1] = -6.0
    updated(controller, state, 50)
    assert controller.status == "marginal"
    assert_allclose(net(controller, controller.force), -state.wrench, atol=1e-5)
    assert (np.abs(torques_of(controller, state, controller.force)) <= limits + 1e-9).all()
    assert 0.4 < controller.friction_used.max() <= 1.0 + 1e-6


def test_springs_leave_the_motors_and_the_cones_to_the_balanced_part():
    """With motors that can hardly give what balances, a target 5 mm off pulls as hard as limits and
    cones allow, and the object stays in balance."""
    plain, state = made(**NO_SPRINGS)
    updated(plain, state, 50)
    limits = 1.05 * np.abs(plain.torques).max() * np.ones(JOINTS)
    controller, state = made(limits, posture_stiffness=0.0, posture_damping=0.0)
    updated(controller, state, 50)
    assert controller.status == "holding"
    state.target[:3] = 0.0, 3e-3, 4e-3
    pulled = 0.0
    for _ in range(600):
        updated(controller, state)
        optimal = controller.arrays()["optimal"]
        assert controller.status == "holding"
        assert_allclose(net(controller, optimal), -state.wrench, atol=1e-6)
        torques = torques_of(controller, state, controller.force)
        assert (np.abs(torques) <= limits * (1.0 + 1e-9)).all()
        assert_allclose(controller.torques, torques, atol=1e-9)
        pulled = max(pulled, np.abs(controller.force - optimal).max())
    assert (controller.friction_used <= 0.75 + 1e-6).all()
    assert pulled > 0.01


@pytest.mark.parametrize("seed", range(8))
def test_weak_motors_and_springs_do_not_chatter(seed):
    """At constant input: springs that motors cannot give leave a part that hardly moves."""
    rng = np.random.default_rng(seed)
    plain, state = made(**NO_SPRINGS)
    updated(plain, state, 50)
    limits = rng.uniform(1.05, 1.6) * np.abs(plain.torques).max() * rng.uniform(0.9, 1.2, JOINTS)
    controller, state = made(limits, posture_stiffness=0.0, posture_damping=0.0)
    updated(controller, state, 50)
    state.target[:3] = rng.standard_normal(3) * 3e-3
    updated(controller, state, 1000)
    before = controller.force.copy()
    for _ in range(100):
        updated(controller, state)
        assert np.abs(controller.force - before).max() < 0.5  # a tenth of the springs at most
        before = controller.force.copy()


@pytest.mark.parametrize("few", [False, True])
def test_a_spring_leaves_the_cone_only_so_far(few):
    """By twice what the force is inside it and 1 N, with four fingers and with two."""
    rng = np.random.default_rng(1)
    share = 0.4 * FRICTION
    most = []
    for _ in range(40):
        controller, state = made(friction_margin=0.4, preload=0.0, grip_damping=0.0)
        state.touching[1:3] = float(not few)
        state.wrench[:] = rng.standard_normal(6) * np.repeat([0.3, 0.02], 3)
        controller.activate(state)
        updated(controller, state, 50)
        state.target[:3] = rng.standard_normal(3) * 2e-3
        for _ in range(20):
            optimal = controller.arrays()["optimal"].copy()
            updated(controller, state)
            spring = controller.force - controller.arrays()["optimal"]
            inside = share * optimal[:, 0] - np.hypot(optimal[:, 1], optimal[:, 2])
            outside = np.hypot(spring[:, 1], spring[:, 2]) - share * spring[:, 0]
            room = 2.0 * np.maximum(inside, 0.0) + 1.0
            touching = state.touching > 0.0
            assert (outside <= room * (1.0 + 1e-9))[touching].all()
            most.append((outside / room)[touching].max())
    assert np.max(most) == pytest.approx(1.0, abs=1e-9)


def test_an_overload_does_not_grow():
    """Two soft tips, and a load far beyond the motors: the forces of least excess stay as they
    are, update by update."""
    limits = np.full(JOINTS, 0.07)
    controller, state = made(limits, torsional_friction=0.005, **NO_SPRINGS)
    state.touching[1:3] = 0.0
    state.wrench[:] = -1.4, -8.0, -1.9, 0.03, -0.026, -0.037
    controller.activate(state)
    updated(controller, state, 60)
    first = controller.arrays()["optimal"].copy()
    updated(controller, state, 200)
    assert controller.status == "overloaded"
    assert_allclose(controller.arrays()["optimal"], first, atol=0.1)


def test_the_last_forces_stay_when_knowledge_ends():
    """Springs that gave way to weak motors do not come back with it."""
    plain, state = made(**NO_SPRINGS)
    updated(plain, state, 50)
    limits = 1.05 * np.abs(plain.torques).max() * np.ones(JOINTS)
    controller, state = made(limits, posture_stiffness=0.0, posture_damping=0.0)
    state.target[:3] = 0.0, 3e-3, 4e-3
    updated(controller, state, 300)
    force = controller.force.copy()
    torques = controller.torques.copy()
    state.ages[0] = 1.0
    updated(controller, state, 50)
    assert controller.status == "coasting"
    assert_allclose(controller.force, force, atol=1e-12)
    assert_allclose(controller.torques, torques, atol=1e-12)


@pytest.mark.parametrize("weight", [0.0, 0.03, 0.1, 0.3])
@pytest.mark.parametrize("preload", [0.5, 2.0])
def test_a_light_object_gets_its_preload(weight, preload):
    controller, state = made(preload=preload)
    state.wrench[1] = -weight
    updated(controller, state, 20)
    assert controller.status == "holding"
    assert (controller.force[:, 0] >= preload).all()
    assert controller.force[:, 0].sum() < 4.0 * preload + 8.0


def test_forces_and_places_that_are_given_are_not_judged():
    controller, state = made()
    forces = np.tile([5.0, 50.0, 0.0], (4, 1))
    controller.hold = core.Hold.direct
    controller.observe(state, PERIOD)
    controller.act(True, None, None, forces)
    assert controller.status == "given"
    assert_array_equal(controller.force, forces)
    # a command that is not finite leaves the last one
    controller.observe(state, PERIOD)
    controller.act(True, None, None, np.full((4, 3), np.nan))
    assert_array_equal(controller.force, forces)
    controller.deactivate()
    controller.activate(state)
    updated(controller, state)
    assert not controller.force.any()
    for hold in (core.Hold.squeeze, core.Hold.place, core.Hold.reach):
        controller.hold = hold
        updated(controller, state)
        assert controller.status == "given"


def test_a_squeeze_presses_at_the_contacts_at_hand():
    controller, state = made()
    controller.hold = core.Hold.squeeze
    updated(controller, state, 5)
    assert_allclose(net(controller, controller.force), -state.wrench, atol=1e-6)
    assert (controller.force[:, 0] > 0.0).all()
    used = np.hypot(controller.force[:, 1], controller.force[:, 2]) / controller.force[:, 0]
    assert (used < FRICTION).all()


# --- messages


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
    controller.act(True, None, None, None)
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
    stiffness = min(60.0, 0.5 / (mobility[0] * (PERIOD + late) ** 2))
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


# --- commands


def test_an_inactive_controller_commands_the_units_of_zero_torque():
    limits = np.array(KINEMATICS.torque_limits)
    table = Calibration(
        np.column_stack([-limits, 0.0 * limits, limits]),
        np.tile([-200.0, 10.0, 240.0], (JOINTS, 1)),
    )
    controller = HandController()
    controller.configure(KINEMATICS.hand, calibration=table)
    state = controller.new_state()
    assert_array_equal(updated(controller, state), 10.0)
    controller.activate(state)
    updated(controller, state, 5)
    controller.deactivate()
    assert_array_equal(updated(controller, state), 10.0)


def test_without_a_calibration_commands_are_torques():
    hand = HandDescription.allegro()
    controller = HandController()
    controller.configure(hand)
    state = controller.new_state()
    state.angles = np.array(hand.home)
    state.gravity[:] = 0.0, 0.0, -9.81
    controller.activate(state)
    commands = updated(controller, state, 100)
    assert_allclose(commands, controller.torques, atol=1e-14)
    assert np.abs(commands).max() > 0.01
    losses = Calibration.newton_metres(hand, friction=np.full(16, 0.05))
    assert_allclose(losses.to_units(np.full(16, 0.1), np.ones(16)), 0.15)


def test_commands_are_multiples_of_the_resolution():
    limits = np.ones(JOINTS)
    table = np.column_stack([-limits, limits])
    rough = Calibration(table, 100.0 * table, resolution=4.0)
    torques = np.linspace(-0.9, 0.9, JOINTS)
    # half a step may go either way
    assert_allclose(rough.to_units(torques), 100.0 * torques, atol=2.0 + 1e-9)
    assert not (rough.to_units(torques) % 4.0).any()


def test_a_dead_band_goes_the_way_of_descending_units():
    turned = Calibration([[-1.0, 1.0]], [[100.0, -100.0]], dead_band=[20.0])
    for torque, units in ((0.5, -70), (-0.5, 70), (0.9, -100)):
        assert turned.to_units([torque]).tolist() == [units]


def test_a_joint_without_limit_has_none():
    """Its table ends at 1e6 N m; it has no limit of its own."""
    hand = HandDescription.four_finger()
    links = tuple(replace(link, torque_limit=1e7) for link in hand.links)
    free = Calibration.newton_metres(replace(hand, links=links))
    assert np.isinf(free.limits).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("squeeze", np.nan),
        ("friction", 0.0),
        ("torsional_friction", -1.0),
        ("release", -5),
        ("budget", np.nan),
        ("grace", np.inf),
        ("fade", np.inf),
        ("force_rate", np.inf),
        ("torque_rate", np.inf),
        ("stale", np.inf),
    ],
)
def test_settings_that_make_no_finite_command_are_refused(name, value):
    """By the core, too: in C++ there is nothing before it."""
    settings = core.HandControllerSettings()
    setattr(settings, name, value)
    tree = KINEMATICS.tree
    motors = core.Calibration.newton_metres(tree)
    with pytest.raises(ValueError, match=name):
        core.HandController().configure(tree, settings, motors, KINEMATICS.home.tolist())


def test_places_without_stiffness_are_no_fault():
    settings = core.HandControllerSettings()
    settings.place = core.Spring(0.0, 1.0, np.inf)
    tree = KINEMATICS.tree
    controller = core.HandController()
    motors = core.Calibration.newton_metres(tree)
    controller.configure(tree, settings, motors, KINEMATICS.home.tolist())
    _, state = made()
    controller.activate(state)
    controller.hold = core.Hold.place
    assert np.isfinite(controller.update(state, PERIOD)).all()


def test_wrong_uses_are_named():
    with pytest.raises(InvalidInputError, match=r"call configure\(hand\) before activate"):
        HandController().activate(HandState(JOINTS, 4))
    for largest in ([0.6], [0.6, 0.7, 0.8]):
        with pytest.raises(InvalidInputError, match="one number for each joint"):
            Calibration.currents([0.5, 0.5], largest, [1000.0, 1000.0])
    with pytest.raises(InvalidInputError, match="resolution"):
        Calibration([[-1.0, 1.0]], [[-1.0, 1.0]], resolution=np.nan)
