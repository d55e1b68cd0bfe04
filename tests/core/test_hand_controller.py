"""The controller of a hand: its logic, the same from C++, and both on a simulated hand in another
process."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from building import SANITIZED, build, run, spoiled, succeed
from hands import gripper

from grasp_env import core
from grasp_env.control import Calibration, HandController, HandControllerSettings, HandState
from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics

pytest.importorskip("mujoco")

from benchmarks import hand_loop

PERIOD = 1e-3
STATUSES = hand_loop.STATUSES
TWO = [1.0, 0.0, 1.0, 0.0]
"""The fingertips that touch, if two opposite ones do."""
NO_SPRINGS = dict.fromkeys(
    ("grip_stiffness", "grip_damping", "posture_stiffness", "posture_damping"), 0.0
)
"""Settings with which torques are those of forces and of the hand's weight alone."""
OVERLOADED = 580
"""First tick of `scenario` with a wrench that is too large for the motors."""
RISE = 60
"""Updates after which torques have risen: they may change by 1/20 of their limits in each."""


@pytest.fixture(scope="module")
def hand():
    """An Allegro hand around a ball."""
    made = hand_loop.SimulatedHand("allegro", 1000)
    yield made
    made.env.close()


@pytest.fixture
def state(hand) -> HandState:
    """The hand at rest, with all fingers on the ball."""
    hand.env.reset(seed=0)
    return hand.state()


def controller(hand, table: Calibration | None = None, **settings: Any) -> HandController:
    made = HandController()
    chosen = HandControllerSettings(friction=hand.friction, **settings)
    made.configure(hand.hand, chosen, table or hand_loop.device_units(hand.limits))
    return made


def changed(state: HandState, **parts: Any) -> HandState:
    """A copy of a state of the Allegro hand with other parts."""
    made = HandState(len(state.angles), len(state.touching))
    made.numbers[:] = state.numbers
    for name, value in parts.items():
        setattr(made, name, np.array(value, dtype=float))
    return made


def repeated(made, state, ticks: int, period: float = PERIOD) -> np.ndarray:
    return [made.update(state, period) for _ in range(ticks)][-1]


def grasping(hand, state, **settings: Any) -> HandController:
    """A controller that has held the ball for some ticks."""
    made = controller(hand, **settings)
    made.activate(state)
    repeated(made, state, RISE)
    return made


def forces_of(made) -> np.ndarray:
    """Commanded forces (N, 3) along the axes of the base [N]."""
    return np.einsum("nij,nj->ni", made.arrays()["frames"], made.force)


def carried(hand, state) -> tuple[np.ndarray, np.ndarray]:
    """Matrix from forces at the fingertips (N, 3) to torques, and the torques that carry the hand."""
    moves, weight = hand.scene.kinematics.statics(state.angles, state.positions, state.gravity)
    return moves.reshape(-1, len(weight)), weight


# --- calibration


def test_a_calibration_is_linear_between_its_points_and_clipped_at_its_ends():
    table = Calibration(
        [[-1.0, 0.0, 0.5], [-2.0, -1.0, 4.0]], [[-200.0, 10.0, 240.0], [20.0, 0.0, -100.0]]
    )
    for torques, units in (
        ([0.25, 1.5], [125, -50]),
        ([-0.5, -1.5], [-95, 10]),
        ([9.0, 9.0], [240, -100]),
        ([-9.0, -9.0], [-200, 20]),
    ):
        assert table.to_units(torques).tolist() == units
    assert table.limits.tolist() == [0.5, 2.0]


@pytest.mark.parametrize(
    ("torques", "units", "losses"),
    [
        ([[1.0, 0.0]], [[0.0, 1.0]], {}),
        ([[0.0, 1.0]], [[-1.0, 1.0]], {}),
        ([[-1.0, 1.0]], [[0.0]], {}),
        ([0.0, 1.0], [0.0, 1.0], {}),
        ([[-1.0, np.nan]], [[-1.0, 1.0]], {}),
        ([[-1.0, 1.0]], [[-1.0, 1.0]], {"friction": [-0.1]}),
        ([[-1.0, 1.0]], [[-1.0, 1.0]], {"dead_band": [1.0, 1.0]}),
        ([[-1.0, 1.0]], [[-1.0, 1.0]], {"fade": 0.0}),
    ],
)
def test_a_calibration_that_fits_no_motor_is_refused(torques, units, losses):
    with pytest.raises(InvalidInputError, match="calibration"):
        Calibration(torques, units, **losses)


def test_friction_and_dead_band_are_added_in_their_directions():
    """Friction in that of the wanted motion, the dead band in that of the torque; both fade in."""
    plain = [[-1.0, 1.0]], [[-100.0, 100.0]]
    rubbing = Calibration(*plain, friction=[0.2])
    for torque, wanted, units in (
        (0.5, 1.0, 70),
        (0.5, -1.0, 30),
        (0.5, 0.005, 60),
        (0.5, 0.0, 50),
        (0.95, 1.0, 100),
    ):
        assert rubbing.to_units([torque], [wanted]).tolist() == [units]
    dead = Calibration(*plain, dead_band=[20.0])
    for torque, units in ((0.5, 70), (-0.5, -70), (0.005, 10), (0.0, 0), (0.9, 100)):
        assert dead.to_units([torque]).tolist() == [units]
    currents = Calibration.currents([0.5, 0.25], [0.6, 0.4], [1000.0, -1000.0])
    assert currents.to_units([0.15, 0.05]).tolist() == [300, -200]
    np.testing.assert_allclose(currents.limits, [0.3, 0.1], rtol=1e-15)  # products of two numbers


def test_a_calibration_or_a_posture_of_another_hand_is_refused(hand):
    made = HandController()
    for given in (
        {"calibration": Calibration.newton_metres(HandDescription.four_finger())},
        {"home": [0.0] * 15},
    ):
        with pytest.raises(InvalidInputError):
            made.configure(hand.hand, **given)


# --- life cycle and messages


def test_torques_rise_to_those_that_hold_and_end_with_deactivation(hand, state):
    made = controller(hand, damping=0.01, **NO_SPRINGS)
    assert not repeated(made, state, 3).any()  # not activated
    made.activate(state)
    most = made.settings.torque_rate * PERIOD * hand.limits
    risen = np.zeros((RISE, len(hand.limits)))
    for tick in range(RISE):
        made.update(state, PERIOD)
        risen[tick] = made.torques
    assert (abs(np.diff(risen, axis=0)) <= most * (1 + 1e-9)).all()  # rounding
    levers, weight = carried(hand, state)
    assert made.status == "holding"
    assert not made.rising
    forces = forces_of(made)
    # sums of 12 products of numbers below 1
    np.testing.assert_allclose(
        made.torques, weight - 0.01 * state.rates + forces.ravel() @ levers, atol=1e-12
    )
    # the solver's residual
    np.testing.assert_allclose(forces.sum(axis=0), -state.wrench[:3], atol=1e-9)
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


def test_torques_go_the_same_share_of_their_way(hand, state):
    """So that forces that balance before and after do so in between."""
    made = controller(hand, torque_rate=5.0, **NO_SPRINGS)
    made.activate(state)
    repeated(made, state, 5)
    assert made.rising
    part = made.torques.copy()
    repeated(made, state, 300)
    assert not made.rising
    whole = made.torques
    share = part @ whole / (whole @ whole)
    assert 0.01 < share < 0.9
    # the solver's first forces are within its tolerance of the last ones
    np.testing.assert_allclose(part, share * whole, atol=1e-3 * abs(whole).max())


@pytest.mark.parametrize("old", [0, 1, 2])
def test_without_messages_the_last_forces_stay_then_fade(hand, state, old):
    made = grasping(hand, state, damping=0.01, stale_wrench=0.02, **NO_SPRINGS)
    forces, s = forces_of(made), made.settings
    turned = changed(state, angles=state.angles + 0.01, rates=state.rates + 0.5)
    turned.ages[old] = s.stale + 1e-6
    levers, weight = carried(hand, turned)
    for ticks, share, status in (
        (100, 1.0, "coasting"),
        (100, 0.5, "coasting"),
        (101, 0.0, "released"),
    ):
        repeated(made, turned, ticks)
        assert made.status == status
        # rounding of a hundred periods
        pushed = forces.ravel() @ levers - s.damping * turned.rates
        np.testing.assert_allclose(made.torques, weight + share * pushed, atol=1e-9)
    repeated(made, state, RISE)
    assert made.status == "holding"
    # optimal within the tolerance of the solver, from another start
    np.testing.assert_allclose(forces_of(made), forces, atol=0.05)


def test_a_wrench_of_any_age_is_used_by_default(hand, state):
    made = grasping(hand, state)
    state.ages[2] = 1e6
    made.update(state, PERIOD)
    assert made.status == "holding"


@pytest.mark.parametrize("spoil", ["nan", "other hand", "twisted"])
def test_broken_messages_are_ignored(hand, state, spoil):
    made = grasping(hand, state)
    held = made.torques.copy()
    broken = {
        "nan": changed(state, rates=np.full(16, np.nan)),
        "other hand": HandState(15, 4),
        "twisted": changed(state, normals=2.0 * state.normals),
    }[spoil]
    repeated(made, broken, 3)
    assert made.status == "holding"  # the last good one is fresh still
    # the springs settle a little
    np.testing.assert_allclose(made.torques, held, atol=1e-3)
    repeated(made, broken, 400)
    assert made.status == "released"
    made.update(broken, np.nan)
    made.update(broken, -1.0)
    assert np.isfinite(made.torques).all()
    with pytest.raises(InvalidInputError, match="a state of this hand, of 16 joints"):
        made.activate(broken)
    assert made.status == "inactive"


# --- contacts and motors


def test_a_finger_loses_its_contact_and_finds_it_again(hand, state):
    made = grasping(hand, state, **NO_SPRINGS)
    finger = 1
    whole = forces_of(made)
    kinematics = hand.scene.kinematics
    lost = changed(state)
    lost.touching[finger] = 0.0
    lost.positions[finger] = 0.0
    lost.normals[finger] = np.eye(3)[0]
    for ticks, away in ((RISE, 0.0), (RISE, 0.1)):
        lost.angles[4 * finger + 1] = state.angles[4 * finger + 1] + away
        repeated(made, lost, ticks)
        assert made.status == "holding"
        assert made.mask == 0b1101
        forces = forces_of(made)
        assert not forces[finger].any()
        # the residual of the solver
        np.testing.assert_allclose(forces.sum(axis=0), -state.wrench[:3], atol=1e-9)
        levers, weight = carried(hand, changed(lost, positions=state.positions))
        reaching = made.torques - weight - forces.ravel() @ levers
        moves = kinematics.jacobian(lost.angles, finger, kinematics.tips(lost.angles)[finger])
        force, rest, *_ = np.linalg.lstsq(moves.T, reaching, rcond=None)
        assert np.sqrt(rest.sum()) < 1e-9  # all other torques are zero
        place = kinematics.tips(state.angles)[finger] + 5e-3 * state.normals[finger]
        draw = place - kinematics.tips(lost.angles)[finger]
        s = made.settings
        # the tip stands 5 mm before its goal, and the contact gives by less than 0.3 mm
        expected = s.reach_stiffness * draw
        size = np.linalg.norm(expected)
        expected *= min(1.0, s.reach_limit / size)
        np.testing.assert_allclose(force, expected, atol=s.reach_stiffness * 3e-4)
    repeated(made, state, 2 * RISE)
    assert (made.mask, made.changes) == (0b1111, 2)
    # optimal within the tolerance of the solver, from another start
    np.testing.assert_allclose(forces_of(made), whole, atol=0.05)


def test_a_contact_that_flickers_counts_for_some_updates(hand, state):
    made = grasping(hand, state, release=2)
    lost = changed(state)
    lost.touching[1] = 0.0
    for ticks, mask in ((2, 0b1111), (1, 0b1101)):
        repeated(made, lost, ticks)
        assert made.mask == mask


def test_lost_closure_and_weak_motors_have_different_statuses(hand, state):
    made = grasping(hand, state)
    repeated(made, changed(state, touching=[1.0, 0.0, 0.0, 0.0]), 4)
    assert made.status == "slipping"
    repeated(made, changed(state, touching=[0.0] * 4), 4)
    assert made.status == "released"
    made = controller(hand, hand_loop.device_units(0.15 * hand.limits), budget=0.0)
    made.activate(state)
    commands = repeated(made, changed(state, wrench=4.0 * state.wrench), 40)
    assert made.status == "overloaded"
    assert abs(commands).max() == 240
    assert (abs(made.torques) <= made.limits).all()
    assert made.over_budget == 40


def test_two_contacts_balance_what_is_within_their_reach(hand, state):
    """The rest is a moment about the line through them; nothing else is missing."""
    made = controller(hand, **NO_SPRINGS)
    lost = changed(state, touching=TWO)
    touching = lost.touching > 0.0
    for places in (lost.positions, lost.normals):
        places[~touching] = np.nan
    made.activate(lost)
    repeated(made, lost, RISE)
    assert made.status == "pivoting"
    where = lost.positions[touching]
    forces = forces_of(made)[touching]
    missed = lost.wrench + np.concatenate([forces.sum(axis=0), np.cross(where, forces).sum(axis=0)])
    line = (where[1] - where[0]) / np.linalg.norm(where[1] - where[0])
    missed[3:] -= np.cross(where.mean(axis=0), missed[:3])
    # the residual of the solver
    np.testing.assert_allclose(missed[:3], 0.0, atol=1e-9)
    np.testing.assert_allclose(missed[3:], (missed[3:] @ line) * line, atol=1e-9)
    assert abs(missed[3:] @ line) > 1e-6
    exact = changed(lost, wrench=lost.wrench - missed)
    repeated(made, exact, 2)
    assert made.status == "holding"


def test_a_gripper_of_two_fingers_holds():
    two = gripper(2, 2)
    made = HandController()
    made.configure(two, HandControllerSettings(friction=0.8))
    state = made.new_state()
    state.touching[:] = 1.0
    state.positions = np.array([[0.0, 0.03, 0.0], [0.0, -0.03, 0.0]])
    state.normals = -state.positions / 0.03
    state.wrench[2] = -1.0
    made.activate(state)
    repeated(made, state, RISE)
    assert made.status in ("holding", "overloaded")
    # the residual of the solver
    np.testing.assert_allclose(forces_of(made).sum(axis=0), [0.0, 0.0, 1.0], atol=1e-9)


# --- files of hands


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


def scenario(hand) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Rows of a run with every event, the answers of the controller, and its posture and table."""
    knees = np.outer(hand.limits, [-1.0, -0.05, 0.05, 1.0])
    units = np.tile([-240.0, -20.0, 20.0, 240.0], (len(hand.limits), 1))
    made = controller(hand, Calibration(knees, units))
    requests = []
    answered = []
    hand.env.reset(seed=0)
    age = 0.0
    for tick in range(1100):
        cut = (tick // 50) % 4 if tick % 100 > 50 else -1
        silent = 300 <= tick < 330
        dead = 600 <= tick < 950
        age = age + PERIOD if silent or dead else 1e-3
        period = 0.02 if tick == 450 else PERIOD
        state = hand.state(cut)
        state.ages[:] = age
        if tick == 500:
            state.rates[4] = np.nan
        if 520 <= tick < 524:
            state.touching[:] = 0.0
        if 550 <= tick < 556:
            state.touching = np.array(TWO)
        if 570 <= tick < 576:
            state.touching[1:] = 0.0
        if OVERLOADED <= tick < OVERLOADED + 3:
            state.wrench *= 30.0
        if tick >= 100:  # sensors have no place of a finger that does not touch
            for places in (state.positions, state.normals):
                places[state.touching == 0.0] = np.nan
        if tick == 20:
            made.activate(state)
        if tick == 1050:
            made.deactivate()
        commands = made.update(state, period)
        order = -period if tick == 20 else 0.0 if tick == 1050 else period
        requests.append(np.concatenate([[order], state.numbers]))
        status = STATUSES.index(made.status)
        answered.append(np.concatenate([[status, made.late], commands, made.torques]))
        if tick >= 60 and not dead:  # before, something else carries the ball
            hand.scene.advance(made.torques.tolist(), None)
    return requests, answered, [np.array(hand.hand.home), np.array([4.0]), knees, units]


def test_it_answers_the_same_in_cpp_and_allocates_nothing(hand, programs, tmp_path):
    requests, answered, made_of = scenario(hand)
    file = hand.scene.kinematics.export(tmp_path / "hand")
    given = np.concatenate([part.ravel() for part in (*made_of, *requests)])
    command = [programs / "hand_controller", file, f"{hand.friction:.17g}"]
    done = run(*command, input=given.tobytes(), text=False)
    assert done.returncode == 0, done.stderr
    *_, status, allocated, finite = told = np.frombuffer(done.stdout)
    mine = np.array(answered)
    other = told[:-3].reshape(len(answered), -1)
    np.testing.assert_array_equal(other[:, :2], mine[:, :2])
    # other flags of the compiler round otherwise; forces that exceed the limits least are found to
    # the solver's tolerance, from which rounding takes other steps
    np.testing.assert_allclose(other[:OVERLOADED, 18:], mine[:OVERLOADED, 18:], atol=1e-9)
    np.testing.assert_allclose(other[:, 18:], mine[:, 18:], atol=1e-4)
    assert abs(other[:, 2:18] - mine[:, 2:18]).max() <= 1.0  # half a unit may be rounded either way
    seen = {STATUSES[int(number)] for number in mine[:, 0]}
    assert seen == set(STATUSES) - {"marginal", "given"}
    assert (status, allocated, finite) == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("sanitized", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_nothing_of_a_hand_is_left_when_another_is_configured(sanitized, request, tmp_path):
    hands = HandDescription.four_finger(), HandDescription.leap()
    files = [HandKinematics(each).export(tmp_path / each.name) for each in hands]
    made = (
        build(tmp_path, *SANITIZED, compiler="clang++")
        if sanitized
        else request.getfixturevalue("programs")
    )
    succeed(made / "lifecycle", *files)


def test_wrong_arguments_are_named(programs, tmp_path):
    for words, told in (
        ([], "usage"),
        (["9", tmp_path / "none", "1000", "0.5", "1", "0"], "HandKinematics.export writes one"),
    ):
        done = run(programs / "hand_controller", *words)
        assert (done.returncode, told in done.stderr, len(done.stderr.splitlines())) == (2, True, 1)


@pytest.mark.parametrize("seconds", [3, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("language", ["cpp", "python"])
def test_it_holds_in_real_time(language, seconds, programs):
    """With contacts that are cut and given back and messages that stop; its speed depends on the
    load of the machine."""
    loop = hand_loop.measure(
        hand_loop.SimulatedHand("allegro", 500), seconds, language, programs / "hand_controller"
    )
    counts = loop.counts
    done = dict(zip(STATUSES, np.bincount(loop.statuses, minlength=len(STATUSES)), strict=True))
    assert counts["held"], counts
    assert counts["drift"] < 2.0
    assert counts["lost"] == 0
    assert len(loop.trips) > 2 * counts["unanswered"]
    assert done["holding"] > 0.7 * len(loop.statuses)
    assert done["inactive"] == 0
    assert done["coasting"] > 2 * seconds  # silences


def test_runs_without_real_time_repeat_exactly():
    """With all errors; the seed draws the noise of the torques."""
    first, again, other = (
        hand_loop.repeatable(hand_loop.SimulatedHand("allegro", 1000, True, seed), 1.0)
        for seed in (2, 2, 4)
    )
    assert first == again
    assert first["drift"] != other["drift"]
    assert first["held"]
    assert first["seconds"] == pytest.approx(1.0)
