"""A recording runs again bit for bit, comes back from its files, and wrong files are refused."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hands import gripper

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
from grasp_env.control.recording import OUTPUTS, STATUSES
from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.sim import HandDescription

pytest.importorskip("gymnasium", reason="the extra sim is not installed")

PERIOD = 1e-3
HOLDS = (core.Hold.optimized, core.Hold.place, core.Hold.reach, core.Hold.squeeze)


def holding(hand: HandDescription, weight: float = 1.5) -> HandState:
    """The fingertips on a ring, pressing inwards."""
    state = HandState(hand.joint_count, hand.finger_count)
    angles = 2.0 * np.pi * np.arange(hand.finger_count) / hand.finger_count
    outwards = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    state.angles[:] = hand.home
    state.touching[:] = 1.0
    state.positions[:], state.normals[:] = 0.03 * outwards, -outwards
    state.wrench[2] = -weight
    state.gravity[:] = 0.0, 0.0, -9.81
    state.ages[:] = PERIOD
    return state


def weak(hand: HandDescription) -> Calibration:
    """Motors with a hundredth of their torque, in raw numbers, with losses."""
    ends = np.outer(0.01 * np.array(hand.torque_limits), [-1.0, 0.0, 1.0])
    units = np.tile([-240.0, 10.0, 240.0], (hand.joint_count, 1))
    ones = np.ones(hand.joint_count)
    return Calibration(ends, units, 1e-3 * ones, 5.0 * ones, fade=2e-3, resolution=0.5)


def made(
    hand: HandDescription, calibration: Calibration | None = None, **settings: Any
) -> HandController:
    controller = HandController()
    controller.configure(hand, HandControllerSettings(**settings), calibration)
    controller.record(5.0)
    return controller


def run(controller: HandController, seed: int, events: int = 400) -> Recording:
    """Record random events: each lasts for some updates."""
    rng = np.random.default_rng(seed)
    hand = controller.hand
    state, good = holding(hand), holding(hand)
    foreign = HandState(hand.joint_count + 1, hand.finger_count)
    controller.activate(state)
    for _ in range(events):
        kind = rng.integers(14)
        state.numbers[:] = good.numbers
        state.angles[:] += rng.normal(0.0, 0.01, hand.joint_count)
        state.rates[:] = rng.normal(0.0, 0.1, hand.joint_count)
        state.wrench[:] += rng.normal(0.0, [0.3] * 3 + [0.01] * 3)
        state.object[:3] = rng.normal(0.0, 1e-4, 3)
        state.target[:3] = rng.normal(0.0, 1e-4, 3)
        period = rng.choice([PERIOD, 0.02, 0.0, -1.0, np.nan], p=[0.9, 0.04, 0.02, 0.02, 0.02])
        if kind == 0:
            controller.take_hold()
        elif kind == 1:
            controller.deactivate()
            if rng.random() < 0.5:
                controller.update(state, period)  # of no effect: nothing is recorded
            controller.activate(state)
        elif kind == 2:
            controller.activate(state)
        elif kind == 3:
            controller.hold = rng.choice(HOLDS, p=[0.7, 0.1, 0.1, 0.1])
        elif kind == 4:
            lost = rng.random(hand.finger_count) < 0.4
            state.touching[lost] = 0.0
            state.positions[lost] = np.nan
        elif kind == 5:
            state.numbers[rng.integers(len(state.numbers))] = rng.choice([np.nan, np.inf, -np.inf])
        elif kind == 6:
            state.normals[0] *= 2.0
        elif kind == 7:
            state.ages[rng.integers(3)] = 1.0
        elif kind == 8:
            state.wrench[:] *= 100.0
        elif kind == 9:
            state.wrench[:] = rng.choice([0.0, -0.0, 1e-300])
        for _ in range(rng.integers(1, 8) if kind != 7 else 300 * (rng.random() < 0.1)):
            controller.update(foreign if kind == 10 else state, period)
    return Recording.of(controller)


HANDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "allegro": (HandDescription.allegro, {}),
    "two fingers": (lambda: gripper(2, 2), {"release": 0}),
    "soft": (HandDescription.leap, {"torsional_friction": 0.005, "joint_delay": 0.004}),
    "coarse": (
        HandDescription.four_finger,
        {"rate": 333.0, "stale_wrench": 0.05, "max_iterations": 2, "tolerance": 0.3},
    ),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("motors", ["strong", "weak"])
@pytest.mark.parametrize("name", HANDS)
def test_random_events_come_back_bit_for_bit(name, motors, seed):
    make, settings = HANDS[name]
    hand = make()
    recording = run(made(hand, weak(hand) if motors == "weak" else None, **settings), seed)
    again = replay(recording)
    assert differences(recording, again) == (0, None, dict.fromkeys(OUTPUTS, 0.0))
    other = [k for k, column in enumerate(recording.columns) if not column.startswith("duration")]
    a, b = (each.rows[:, other].tobytes() for each in (recording, again))
    assert a == b or np.array_equal(recording.rows[:, other], again.rows[:, other], equal_nan=True)
    assert {0.0, 1.0, 2.0, 3.0, 4.0} == {*recording["event"]}
    assert len({*recording["status"]}) > 2


@pytest.mark.parametrize("times", [1, 2])
def test_the_controller_may_have_worked_before(times):
    controller = made(HandDescription.allegro())
    for seed in range(times):
        run(controller, seed, 50)
        controller.record(5.0)
    recording = run(controller, 9, 50)
    assert differences(recording, replay(recording)).rows == 0


def test_a_full_recording_ends_and_one_that_was_asked_for_waits_for_activate():
    controller = made(HandDescription.allegro())
    state = holding(controller.hand)
    with pytest.raises(InvalidInputError, match="call record"):
        Recording.of(controller)
    controller.activate(state)
    controller.record(0.01)
    commands = [controller.update(state, PERIOD) for _ in range(30)]
    recording = Recording.of(controller)
    assert len(recording) == 31
    np.testing.assert_array_equal(recording["commands"][1:], commands)
    controller.activate(state)
    for _ in range(30):
        controller.update(state, PERIOD)
    assert controller.recording.full
    short = Recording.of(controller)
    assert len(short) == 12
    assert differences(short, replay(short)).rows == 0


def test_parts_have_names_and_shapes():
    hand = HandDescription.allegro()
    controller = made(hand, weak(hand))
    state = holding(hand)
    controller.activate(state)
    told = []
    for k in range(20):
        state.touching[1] = k < 10
        controller.update(state, 2.0 * PERIOD if k == 5 else np.nan if k == 6 else PERIOD)
        told.append(controller.status)
    controller.take_hold()
    recording = Recording.of(controller)
    assert (recording.joints, recording.fingers, len(recording)) == (16, 4, 22)
    assert recording["torques"].shape == (22, 16)
    assert recording["force"].shape == recording["positions"].shape == (22, 4, 3)
    assert recording["duration"].shape == (22,)
    assert [STATUSES[int(number)] for number in recording["status"][1:-1]] == told
    np.testing.assert_array_equal(recording["touching"][1:-1, 1], np.arange(20) < 10)
    np.testing.assert_array_equal(recording["torques"][-1], controller.torques)
    np.testing.assert_allclose(recording.times[-3:], 1e-3 * np.array([19, 20, 20]))
    np.testing.assert_allclose(recording.limits, controller.limits, rtol=1e-15)
    assert recording.header["settings"]["rate"] == 1000.0
    with pytest.raises(UnknownNameError, match="did you mean 'torques'"):
        recording["torqes"]
    with pytest.raises(ValueError, match="read-only"):
        recording.rows[0] = 0.0


def test_limits_leave_out_joints_without_motor():
    hand = gripper(3, 3, coupled=True)
    controller = made(hand)
    controller.activate(holding(hand))
    limits = Recording.of(controller).limits
    assert np.isinf(limits[2::3]).all()
    np.testing.assert_array_equal(np.delete(limits, np.s_[2::3]), 2.0)


def test_differences_are_counted():
    recording = run(made(HandDescription.allegro()), 0, 30)
    rows = recording.rows.copy()
    torques = recording._parts["torques"].start
    rows[7, torques] += 0.25
    rows[9, recording._parts["force"].start] = np.nan
    rows[11, recording._parts["duration"].start] = 1.0
    other = Recording(recording.columns, rows, recording.text)
    found = differences(recording, other)
    assert (found.rows, found.first) == (2, 7)
    assert found.largest == {
        **dict.fromkeys(OUTPUTS, 0.0),
        "torques": pytest.approx(0.25),
        "force": np.inf,
    }
    assert differences(other, replay(other)) == found
    with pytest.raises(InvalidInputError, match="of one run are needed"):
        differences(recording, Recording(recording.columns, rows[:-1], recording.text))


# --- files


@pytest.fixture(scope="module")
def recording() -> Recording:
    return run(made(HandDescription.leap(), weak(HandDescription.leap())), 5, 60)


@pytest.mark.parametrize("suffix", ["csv", "CSV"])
def test_it_comes_back_from_its_file(recording, suffix, tmp_path):
    path = recording.save(tmp_path / f"run.{suffix}")
    again = Recording.load(str(path))
    np.testing.assert_array_equal(again.rows, recording.rows)
    assert (again.columns, again.text) == (recording.columns, recording.text)
    assert differences(recording, replay(again)).rows == 0
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    first = path.read_bytes()
    again.save(path)
    assert path.read_bytes() == first


def test_the_controller_writes_the_same_file(tmp_path):
    controller = made(HandDescription.allegro())
    state = holding(controller.hand)
    controller.activate(state)
    state.angles[0], state.angles[1] = np.nan, np.inf
    controller.update(state, -0.0)
    controller.recording.write(str(tmp_path / "core.csv"))
    path = Recording.of(controller).save(tmp_path / "python.csv")
    assert path.read_bytes() == (tmp_path / "core.csv").read_bytes()
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))  # as on Windows
    assert len(Recording.load(path)) == 2


def test_other_suffixes_and_places_are_refused(recording, tmp_path):
    for suffix in ("", ".txt", ".csv.gz", ".parquet", ".pkl"):
        for call in (recording.save, Recording.load):
            with pytest.raises(InvalidInputError, match=r"must end with \.csv, got"):
                call(tmp_path / f"run{suffix}")
    with pytest.raises(OSError, match="nowhere"):
        recording.save(tmp_path / "nowhere" / "run.csv")
    with pytest.raises(InvalidInputError, match="No such file"):
        Recording.load(tmp_path / "none.csv")
    assert list(tmp_path.iterdir()) == []


def header(recording: Recording, path: str, value: Any) -> str:
    """The header with one entry changed; None removes it."""
    made = json.loads(recording.text)
    *parents, last = path.split("/")
    inner = made
    for name in parents:
        inner = inner[name]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    return json.dumps(made)


HEADERS: dict[str, tuple[str, Any, str]] = {
    "kind": ("kind", "grasp hand recording 9", "of kind 'grasp hand recording 1'"),
    "no hand": ("hand", None, "entry 'hand' of type str"),
    "no digits": ("hand", "xyz", "bytes of a whole hand"),
    "short hand": ("hand", "47", "bytes of a whole hand"),
    "no settings": ("settings", None, "entry 'settings' of type dict"),
    "no rate": ("settings/rate", None, "without ['rate']"),
    "no tolerance": ("settings/tolerance", None, "tolerance .* must be a number"),
    "text": ("settings/friction", "rough", "friction .* must be a number, got 'rough'"),
    "flag": ("settings/friction", True, "friction .* must be a number, got True"),
    "half": ("settings/release", 1.5, "release .* must be a whole number"),
    "large": ("settings/release", 1e12, "release .* must be a whole number"),
    "negative": ("settings/rate", -1.0, "describes no controller: rate must be above 0 Hz"),
    "tiny rate": ("settings/rate", 5e-324, "describes no controller"),
    "huge number": ("settings/rate", 10**400, "describes no controller: rate"),
    "short spring": ("settings/grip", [1.0, 2.0], "grip .* list of 3 numbers"),
    "new setting": ("settings/humour", 1.0, "unknown setting 'humour'"),
    "method": ("settings/set_follow", 1.0, "unknown setting 'set_follow'"),
    "more": ("comment", "mine", "not that of its own controller"),
    "tables": ("calibration/torques", [[1.0]], "describes no controller: a calibration"),
    "no tables": ("calibration/units", 3.0, "entry 'units' of type list"),
    "rows": ("calibration/units", [3.0], "units .* list of numbers, got 3"),
    "home": ("home", [0.0], "describes no controller: home"),
    "empty home": ("home", [], "not that of its own controller"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_wrong_headers_are_refused(recording, name, tmp_path):
    path, value, message = HEADERS[name]
    text = header(recording, path, value)
    with pytest.raises(InvalidInputError, match=message.replace("[", r"\[").replace("]", r"\]")):
        Recording(recording.columns, recording.rows, text)


def spoiled_hand(recording: Recording) -> str:
    digits = json.loads(recording.text)["hand"]
    return header(recording, "hand", digits[:400] + "00" + digits[402:])


TEXTS = ["", "null", "[]", "{", '{"kind": NaN}', "[" * 100_000]


def test_headers_that_are_no_header_are_refused(recording):
    for text in (*TEXTS, spoiled_hand(recording), recording.text[:-5]):
        with pytest.raises(InvalidInputError, match="the header of a recording"):
            Recording(recording.columns, recording.rows, text)


def changed(recording: Recording, row: int, name: str, value: float) -> np.ndarray:
    rows = recording.rows.copy()
    rows[row, recording._parts[name].start] = value
    return rows


@pytest.mark.parametrize(
    ("row", "name", "value", "message"),
    [
        (3, "event", 5.0, "'event' .* whole numbers from 0 to 4, got 5 in row 3"),
        (3, "event", np.nan, "got nan in row 3"),
        (3, "hold", 0.5, "'hold' .* from 0 to 4"),
        (3, "status", -1.0, "'status' .* from 0 to 8"),
        (0, "event", 0.0, "begins with event 1 .* got event 0 in row 0"),
        (1, "event", 2.0, "got event .* in row 2"),
    ],
)
def test_rows_that_no_controller_records_are_refused(recording, row, name, value, message):
    with pytest.raises(InvalidInputError, match=message):
        Recording(recording.columns, changed(recording, row, name, value), recording.text)


def test_rows_of_another_shape_are_refused(recording):
    for rows in (recording.rows[:, :-1], recording.rows[0], "rows", recording.rows.astype(complex)):
        with pytest.raises(InvalidInputError, match="rows of a recording must"):
            Recording(recording.columns, rows, recording.text)
    with pytest.raises(InvalidInputError, match="needs rows"):
        Recording(recording.columns, recording.rows[:0], recording.text)
    with pytest.raises(InvalidInputError, match="columns of a recording"):
        Recording(recording.columns[::-1], recording.rows, recording.text)
    bad = changed(recording, 0, "angles", np.nan)
    with pytest.raises(InvalidInputError, match="row 0 of the recording activates"):
        replay(Recording(recording.columns, bad, recording.text))


def test_wrong_files_are_refused(recording, tmp_path):
    whole = recording.save(tmp_path / "whole.csv").read_bytes()
    lines = whole.split(b"\n")
    path = tmp_path / "wrong.csv"
    for content, message in (
        (b"", "its first line must be #"),
        (b"a,b\n1,2\n", "its first line must be #"),
        (whole[: len(whole) // 2], "it is cut"),
        (whole[: len(lines[0]) // 2], "the header .* is no JSON object|it is cut"),
        (
            b"\n".join(lines[:3]) + b"\n" + lines[3][: len(lines[3]) // 2] + b"\n",
            "is not a complete",
        ),
        (b"\n".join(lines[1:]), "its first line must be #"),
        (b"\n".join([lines[0], *lines[2:]]), "columns of a recording"),
        (b"\n".join([*lines[:4], b"", b""]).replace(b",0,", b",,"), "is not a complete"),
        (b"\n".join([*lines[:4], b""]).replace(b",0,", b",none,"), "is not a complete"),
        (b"\n".join([*lines[:4], b"\xff\xfe\n"]), "is not a complete"),
        (b"\n".join([*lines[:2], b""]), "is not a complete"),
        (b"# " + b"[" * 100_000 + b"\n\n0\n", "no JSON object"),
    ):
        path.write_bytes(content)
        with pytest.raises(InvalidInputError, match=message) as told:
            Recording.load(path)
        assert len(str(told.value)) < 1500


def test_spoiled_bytes_never_load_as_another_hand(recording, tmp_path):
    """The bytes of a hand have a hash; elsewhere a changed byte is refused or changes one number."""
    whole = bytearray(recording.save(tmp_path / "whole.csv").read_bytes())
    rng = np.random.default_rng(0)
    path = tmp_path / "spoiled.csv"
    end = whole.index(b'", "settings"')
    for place in rng.integers(40, end, 40).tolist():
        spoiled = whole.copy()
        spoiled[place] = ord("1") if spoiled[place] != ord("1") else ord("2")
        path.write_bytes(spoiled)
        with pytest.raises(InvalidInputError):
            Recording.load(path)
    for place in rng.integers(0, len(whole), 60).tolist():
        spoiled = whole.copy()
        spoiled[place] = rng.integers(256)
        path.write_bytes(spoiled)
        with suppress(InvalidInputError):
            assert Recording.load(path).rows.shape == recording.rows.shape
