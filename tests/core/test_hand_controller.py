"""The example of a hardware controller: its logic, its twin in C++, and both on a simulated hand in
another process."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from building import run, spoiled
from hands import gripper

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics

pytest.importorskip("mujoco")

from benchmarks import hand_loop

shown = hand_loop.example()
PERIOD = 1e-3
HOLDING = shown.STATUSES.index("holding")
TWO = [1.0, 0.0, 1.0, 0.0]
"""The fingertips that touch, if two opposite ones do."""


@pytest.fixture(scope="module")
def hand():
    """An Allegro hand around a ball."""
    made = hand_loop.SimulatedHand("allegro", 1000)
    yield made
    made.env.close()


@pytest.fixture
def state(hand):
    """The hand at rest, with all fingers on the ball."""
    hand.env.reset(seed=0)
    return message(hand)


def message(hand, cut: int = -1) -> Any:
    return hand_loop.state_of(shown, hand.state(cut), hand.hand.joint_count, hand.hand.finger_count)


def controller(hand, table: Any = None, **settings: Any) -> Any:
    return hand_loop.controller_of(shown, hand.hand, table, friction=hand.friction, **settings)


def repeated(made, state, ticks: int, period: float = PERIOD) -> np.ndarray:
    return [made.update(state, period) for _ in range(ticks)][-1]


def grasping(hand, state) -> Any:
    """A controller that has held the ball for some ticks."""
    made = controller(hand)
    made.activate(state)
    repeated(made, state, 40)
    return made


def carried(hand, state) -> tuple[np.ndarray, np.ndarray]:
    """Matrix from forces at the fingertips (N, 3) to torques, and the torques that carry the hand."""
    moves, weight = hand.scene.kinematics.statics(state.angles, state.positions, state.gravity)
    return moves.reshape(-1, len(weight)), weight


def test_a_calibration_is_linear_between_its_points_and_clipped_at_its_ends():
    table = shown.Calibration(
        [[-1.0, 0.0, 0.5], [-2.0, -1.0, 4.0]], [[-200.0, 10.0, 240.0], [20.0, 0.0, -100.0]]
    )
    for torques, units in (
        ([0.25, 1.5], [125, -50]),
        ([-0.5, -1.5], [-95, 10]),
        ([9.0, 9.0], [240, -100]),
        ([-9.0, -9.0], [-200, 20]),
    ):
        assert table(np.array(torques)).tolist() == units
    assert table.limits.tolist() == [0.5, 2.0]
    for torques, units in (
        ([[1.0, 0.0]], [[0.0, 1.0]]),
        ([[0.0, 1.0]], [[0.0]]),
        ([0.0, 1.0], [0.0, 1.0]),
    ):
        with pytest.raises(ValueError, match="torques that ascend"):
            shown.Calibration(torques, units)


def test_torques_rise_to_those_that_hold_and_end_with_deactivation(hand, state):
    made = controller(hand)
    assert not repeated(made, state, 3).any()  # not activated
    made.activate(state)
    most = made.settings.slew * PERIOD * hand.limits
    before = np.zeros(len(hand.limits))
    for _ in range(40):
        made.update(state, PERIOD)
        assert (abs(made.torques - before) <= most * (1 + 1e-9)).all()
        before = made.torques
    levers, weight = carried(hand, state)
    assert made.status == "holding"
    np.testing.assert_allclose(
        made.torques, weight - 0.01 * state.rates + made.forces.ravel() @ levers, atol=1e-9
    )
    np.testing.assert_allclose(made.forces.sum(axis=0), -state.wrench[:3], atol=1e-6)
    assert (abs(made.torques) <= hand.limits).all()
    np.testing.assert_array_equal(
        made.update(state, PERIOD), np.rint(240.0 * made.torques / hand.limits)
    )
    assert (made.late, 0.0 < made.duration < 1.0) == (0, True)
    made.update(state, 0.5)
    assert made.late == 1
    made.deactivate()
    assert made.status == "inactive"
    assert not repeated(made, state, 2).any()


def test_without_messages_the_last_forces_stay_then_fade(hand, state):
    made = grasping(hand, state)
    forces, s = made.forces, made.settings
    turned = replace(state, angles=state.angles + 0.01, rates=state.rates + 0.5, age=s.stale + 1e-6)
    levers, weight = carried(hand, turned)
    own = weight - s.damping * turned.rates
    spring = -0.01 * s.stiffness
    for ticks, share, status in (
        (100, 1.0, "coasting"),
        (100, 0.5, "coasting"),
        (101, 0.0, "released"),
    ):
        repeated(made, turned, ticks)
        assert made.status == status
        np.testing.assert_allclose(
            made.torques, own + share * (spring + forces.ravel() @ levers), atol=1e-9
        )
    repeated(made, state, 40)
    assert made.status == "holding"
    np.testing.assert_allclose(made.forces, forces, atol=0.05)


@pytest.mark.parametrize("spoil", ["nan", "short", "twisted"])
def test_broken_messages_are_ignored(hand, state, spoil):
    made = grasping(hand, state)
    held = made.torques
    broken = {
        "nan": replace(state, rates=np.full(16, np.nan)),
        "short": replace(state, angles=state.angles[:-1]),
        "twisted": replace(state, normals=2.0 * state.normals),
    }[spoil]
    repeated(made, broken, 3)
    # the last good one is fresh still
    assert made.status == ("coasting" if spoil == "twisted" else "holding")
    np.testing.assert_allclose(made.torques, held, atol=1e-3)
    repeated(made, broken, 400)
    assert made.status == "released"
    made.update(broken, np.nan)
    made.update(broken, -1.0)
    assert np.isfinite(made.torques).all()
    if spoil != "twisted":
        with pytest.raises(ValueError, match="a state of 70 finite numbers"):
            made.activate(broken)


def test_a_finger_loses_its_contact_and_regains_it(hand, state):
    made = controller(hand)
    finger = 1
    made.activate(state)
    repeated(made, state, 40)
    whole, push = made.forces, made.settings.push
    touching = np.arange(4) != finger
    far = np.where(touching[:, None], state.positions, 0.0)
    lost = replace(
        state,
        touching=touching,
        positions=far,
        normals=np.where(touching[:, None], state.normals, np.eye(3)[0]),
    )
    repeated(made, lost, 40)
    levers, weight = carried(hand, state)  # the lost contact counts as where it was last
    assert made.status == "holding"
    np.testing.assert_allclose(made.forces[finger], push * state.normals[finger], atol=1e-12)
    np.testing.assert_allclose(made.forces[touching].sum(axis=0), -state.wrench[:3], atol=1e-6)
    np.testing.assert_allclose(
        made.torques, weight - 0.01 * state.rates + made.forces.ravel() @ levers, atol=1e-9
    )
    repeated(made, state, 40)
    np.testing.assert_allclose(made.forces, whole, atol=0.05)


def test_lost_closure_and_weak_motors_have_different_statuses(hand, state):
    made = grasping(hand, state)
    made.update(replace(state, touching=np.array([True, False, False, False])), PERIOD)
    assert made.status == "coasting"
    weak = shown.Calibration(
        np.outer(hand.limits, [-0.15, 0.15]), np.tile([-240.0, 240.0], (16, 1))
    )
    made = controller(hand, weak, budget=0.0)
    made.activate(state)
    commands = repeated(made, replace(state, wrench=4.0 * state.wrench), 40)
    assert made.status == "overloaded"
    assert abs(commands).max() == 240
    assert (abs(made.torques) <= made.limits).all()
    assert made.over_budget == 40


def test_two_contacts_balance_what_is_within_their_reach(hand, state):
    """The rest is a moment about the line through them; nothing else is missing."""
    made = controller(hand)
    lost = replace(state, touching=np.array(TWO, dtype=bool))
    for places in (lost.positions, lost.normals):
        places[~lost.touching] = np.nan
    made.activate(lost)
    repeated(made, lost, 40)
    assert made.status == "pivoting"
    where = lost.positions[lost.touching]
    forces = made.forces[lost.touching]
    missed = lost.wrench + np.concatenate([forces.sum(axis=0), np.cross(where, forces).sum(axis=0)])
    line = (where[1] - where[0]) / np.linalg.norm(where[1] - where[0])
    missed[3:] -= np.cross(where.mean(axis=0), missed[:3])
    np.testing.assert_allclose(missed[:3], 0.0, atol=1e-9)
    np.testing.assert_allclose(missed[3:], (missed[3:] @ line) * line, atol=1e-9)
    assert abs(missed[3:] @ line) > 1e-6
    exact = replace(lost, wrench=lost.wrench - missed)
    repeated(made, exact, 2)
    assert made.status == "holding"


def test_a_gripper_of_two_fingers_holds():
    two = gripper(2, 2)
    made = hand_loop.controller_of(shown, two, None, friction=0.8)
    where = np.array([[0.0, 0.03, 0.0], [0.0, -0.03, 0.0]])
    joints = np.zeros(two.joint_count)
    state = shown.HandState(
        joints,
        joints,
        np.ones(2, dtype=bool),
        where,
        -where / 0.03,
        np.array([0, 0, -1.0, 0, 0, 0]),
        np.zeros(3),
    )
    made.activate(state)
    repeated(made, state, 40)
    assert made.status in ("holding", "overloaded")
    np.testing.assert_allclose(made.forces.sum(axis=0), [0.0, 0.0, 1.0], atol=1e-9)


def sealed(blob: bytes, numbers: np.ndarray) -> bytes:
    """A file of these numbers whose hash is right."""
    body = numbers.tobytes()
    check = 14695981039346656037
    for byte in body:
        check = (check ^ byte) * 1099511628211 % 2**64
    return blob[:8] + check.to_bytes(8, "little") + body


def test_a_hand_comes_back_from_its_file(hand, tmp_path):
    kinematics = hand.scene.kinematics
    blob = kinematics.export(tmp_path / "hand").read_bytes()
    tree = core.Tree.load(blob)
    assert tree is not None
    assert tree.save() == blob
    moves = np.empty((4, 3, 16))
    weight = np.empty(16)
    angles = kinematics.home + 0.1
    tips = kinematics.tips(kinematics.home)
    tree.statics(angles, tips, np.array([1.0, 2.0, 3.0]), moves, weight)
    np.testing.assert_array_equal(weight, kinematics.gravity_torques(angles, (1.0, 2.0, 3.0)))
    for finger in range(4):
        np.testing.assert_array_equal(
            moves[finger], kinematics.jacobian(angles, finger, tips[finger])
        )
    assert {core.Tree.load(each) for each in spoiled(blob)} == {None}
    numbers = np.frombuffer(blob[16:])
    assert sealed(blob, numbers) == blob
    for place, value in (
        (0, 15),
        (0, 1e9),
        (1, 65),
        (2, 0),
        (2, 0.5),
        (3, np.nan),
        (33, 2),
        (34, 0),
        (-5, 16),
    ):
        changed = numbers.copy()
        changed[place] = value
        assert core.Tree.load(sealed(blob, changed)) is None, (place, value)
    with pytest.raises(InvalidInputError, match="No such file"):
        kinematics.export(tmp_path / "no folder/hand")


def test_a_hand_with_coupled_joints_and_joints_without_limits_comes_back(tmp_path):
    hand = HandDescription.four_finger()
    links = (*hand.links[:2], replace(hand.links[2], lower=-np.inf, upper=np.inf), *hand.links[3:])
    tree = HandKinematics(replace(hand, links=links)).tree
    again = core.Tree.load(tree.save())
    assert again is not None
    assert again.save() == tree.save()


# --- in C++


def scenario(hand) -> tuple[list[tuple[float, np.ndarray]], list[np.ndarray], Any]:
    """Periods and states of a run with every event, the answers of the controller in Python, and
    its table."""
    knees = np.outer(hand.limits, [-1.0, -0.05, 0.05, 1.0])
    table = shown.Calibration(knees, np.tile([-240.0, -20.0, 20.0, 240.0], (len(hand.limits), 1)))
    made = controller(hand, table)
    requests = []
    answered = []
    hand.env.reset(seed=0)
    age = 0.0
    for tick in range(1100):
        cut = (tick // 50) % 4 if tick % 100 > 50 else -1
        silent = 300 <= tick < 320
        dead = 600 <= tick < 950
        age = age + PERIOD if silent or dead else 1e-3
        period = 0.02 if tick == 450 else PERIOD
        numbers = hand.state(cut)
        numbers[-1] = age
        if tick == 500:
            numbers[20] = np.nan
        if tick == 520:
            numbers[32:36] = 0.0  # nothing touches
        if 550 <= tick < 556:
            numbers[32:36] = TWO
        if tick >= 100:  # sensors have no place of a finger that does not touch
            numbers[36:60].reshape(2, 4, 3)[:, numbers[32:36] == 0.0] = np.nan
        state = hand_loop.state_of(shown, numbers, 16, 4)
        if tick == 20:
            made.activate(state)
        if tick == 1050:
            made.deactivate()
        commands = made.update(state, period)
        requests.append((-period if tick == 20 else 0.0 if tick == 1050 else period, numbers))
        answered.append(
            np.concatenate([[shown.STATUSES.index(made.status), made.late], commands, made.torques])
        )
        if tick >= 60 and not dead:  # before, something else carries the ball
            hand.scene.advance(made.torques.tolist(), None)
    return requests, answered, (knees, np.tile([-240.0, -20.0, 20.0, 240.0], (16, 1)))


def test_the_twin_answers_the_same_and_allocates_nothing(hand, programs, tmp_path):
    requests, answered, tables = scenario(hand)
    file = hand.scene.kinematics.export(tmp_path / "hand")
    rows = [np.concatenate([[period], numbers]) for period, numbers in requests]
    given = np.concatenate([[4.0], *(table.ravel() for table in tables), *rows])
    command = [programs / "hand_controller", file, f"{hand.friction:.17g}"]
    done = run(*command, input=given.tobytes(), text=False)
    assert done.returncode == 0, done.stderr
    *_, status, allocated, finite = told = np.frombuffer(done.stdout)
    mine = np.array(answered)
    other = told[:-3].reshape(len(answered), -1)
    np.testing.assert_array_equal(other[:, :2], mine[:, :2])
    np.testing.assert_allclose(other[:, 18:], mine[:, 18:], atol=1e-6)
    assert abs(other[:, 2:18] - mine[:, 2:18]).max() <= 1.0  # half a unit may be rounded either way
    assert {*mine[:, 0].astype(int)} == {0, 1, 3, 4, 5}
    assert (status, allocated, finite) == (0.0, 0.0, 1.0)


def test_wrong_arguments_are_named(programs, tmp_path):
    for words, told in (
        ([], "usage"),
        (["9", tmp_path / "none", "1000", "0.5"], "HandKinematics.export writes one"),
    ):
        done = run(programs / "hand_controller", *words)
        assert (done.returncode, told in done.stderr, len(done.stderr.splitlines())) == (2, True, 1)


@pytest.mark.parametrize("seconds", [3, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("language", ["cpp", "python"])
def test_it_holds_in_real_time(language, seconds, programs):
    """With contacts that are cut and given back and messages that stop; its speed depends on the
    load of the machine."""
    loop = hand_loop.measure("allegro", 500, seconds, language, programs / "hand_controller")
    counts = loop.counts
    done = np.bincount(loop.statuses, minlength=5)
    assert counts["held"], counts
    assert counts["drift"] < 2.0
    assert counts["lost"] == 0
    assert len(loop.trips) > 2 * counts["unanswered"]
    assert done[HOLDING] > 0.7 * done.sum()
    assert done[0] == 0  # inactive
    assert done[3] > 2 * seconds  # silences
