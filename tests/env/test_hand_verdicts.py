"""The status of a hand's controller is true of its forces, and these stay moderate."""

from __future__ import annotations

import numpy as np
import pytest
from held import (
    FRICTION,
    GRASP,
    JOINTS,
    NO_POSTURE,
    NO_SPRINGS,
    PERIOD,
    made,
    net,
    sizes,
    torques_of,
    updated,
)
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env import core


@pytest.mark.parametrize("rate", [1e3, 1e9])
@pytest.mark.parametrize("limit", [3, 40])
def test_statuses_are_true_of_random_loads_contacts_and_motors(limit, rate):
    """`holding`: forces inside the margin balance the wrench. `marginal`: forces inside the cones do,
    or forces inside the margin balance nearly all of it. Both are within the motors' limits.
    `slipping`: the wrench is not balanced. Forces are no larger than the load calls for, unless
    their rate is bounded; then those that do not balance change by at most 1 N in an update."""
    seen = dict.fromkeys(("holding", "marginal", "overloaded", "slipping", "pivoting"), 0)
    for seed in range(120):
        rng = np.random.default_rng(seed)
        limits = rng.uniform(0.7, 1.4, JOINTS) * np.exp(rng.uniform(np.log(0.2), np.log(8.0)))
        share = rng.choice([0.5, 0.75, 1.0])
        given = rng.choice([0.0, 0.5])
        controller, state = made(
            limits,
            friction_margin=share,
            preload=given,
            max_iterations=limit,
            force_rate=rate,
            **NO_SPRINGS,
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
                if rate == 1e9 and status != "slipping":
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
                if rate == 1e3 and before is not None and not balanced and status != "pivoting":
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
    """The motors cannot give the forces within the margin, but they can give those inside the cones."""
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
    assert (controller.friction_used <= 1.0 + 1e-6).all()
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


def test_a_load_that_rises_takes_the_preload_of_the_springs():
    """Springs have raised the preload; then the load needs nearly all that weak motors have."""
    plain, state = made(**NO_SPRINGS)
    state.wrench[1] = -6.0
    updated(plain, state, 50)
    limits = 1.02 * np.abs(plain.torques).max() * np.ones(JOINTS)
    controller, state = made(limits, **NO_POSTURE)
    state.target[:3] = 0.0, 3e-4, 4e-4
    updated(controller, state, 300)
    assert (controller.arrays()["preload"] > 0.8).any()
    state.wrench[1] = -6.0
    for _ in range(30):
        updated(controller, state)
        assert controller.status == "holding"
        assert_allclose(net(controller, controller.arrays()["optimal"]), -state.wrench, atol=1e-5)


@pytest.mark.parametrize("fingers", [2, 3, 4])
def test_constant_inputs_lead_to_constant_forces(fingers):
    """Also where springs raise the preloads until forces within the margin are too large."""
    for seed in range(100):
        rng = np.random.default_rng(seed)
        soft = 0.005 * rng.integers(2)
        preload = rng.choice([0.0, 0.5, 1.0])
        controller, state = made(
            friction_margin=0.6, preload=preload, torsional_friction=soft, **NO_POSTURE
        )
        state.touching[rng.permutation(4)[fingers:]] = 0.0
        state.wrench[:] = rng.standard_normal(6) * np.repeat([0.8, 0.01], 3)
        state.target[:3] = rng.standard_normal(3) * 1e-3
        updated(controller, state, 400)
        before = controller.force.copy()
        for _ in range(40):
            updated(controller, state)
            # springs that gave way come back by a thousandth in an update
            assert np.abs(controller.force - before).max() < 0.6, seed
            before = controller.force.copy()


def test_springs_add_no_preload_where_nothing_balances():
    """Three fingers of one side: more of it would push the object away."""
    forces = []
    for springs in (NO_SPRINGS, NO_POSTURE):
        controller, state = made(preload=0.2, **springs)
        state.touching[0] = 0.0
        state.wrench[:] = 0.1, -0.5, -0.3, 0.0, 0.01, 0.02
        state.target[:3] = 0.0, 1e-3, 0.0
        controller.activate(state)
        updated(controller, state, 200)
        assert controller.status == "slipping"
        forces.append(controller.arrays()["optimal"][1:])
        assert_allclose(controller.arrays()["preload"][1:], 0.2)
    assert np.linalg.norm(controller.force[1:] - forces[1], axis=1).min() > 0.1  # springs pull
    assert_allclose(forces[1], forces[0], atol=1e-6)


@pytest.mark.parametrize("few", [False, True])
def test_a_spring_leaves_the_cone_only_so_far(few):
    """By four times what the force is inside it and 1 N, with four fingers and with two."""
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
            room = 4.0 * np.maximum(inside, 0.0) + 1.0
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
@pytest.mark.parametrize("preload", [0.0, 0.5, 2.0])
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
    controller.act(True, given=forces)
    assert controller.status == "given"
    assert_array_equal(controller.force, forces)
    # a command that is not finite leaves the last one
    controller.observe(state, PERIOD)
    controller.act(True, given=np.full((4, 3), np.nan))
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


@pytest.mark.parametrize(
    "margin", [(np.nan, 0.0), (0.0, 0.0), (1.1, 0.0), (0.5, -1.0), (0.5, np.inf), (0.5, np.nan)]
)
def test_a_margin_that_is_none_changes_nothing(margin):
    controller, state = made()
    updated(controller, state, 20)
    force = controller.force.copy()
    with pytest.raises(ValueError, match="margin must be a friction above 0 and at most 1"):
        controller.act(True, margin=np.array(margin))
    updated(controller, state, 20)
    assert_allclose(controller.force, force, atol=1e-9)
