"""Recordings of a hand's controller: what it was given and what it did, to run it again elsewhere."""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from grasp_env import core
from grasp_env.errors import InvalidInputError, UnknownNameError, shown
from grasp_env.inputs.arguments import Array, as_array, as_number
from grasp_env.inputs.files import WEIGHTS, as_path, parsed, replacing

KIND = "grasp hand recording 1"
STATUSES: tuple[str, ...] = core.HandController.STATUSES
"""Statuses of a controller, by their number in the column "status"."""
UPDATE, ACTIVATE, DEACTIVATE, TAKE_HOLD, FOREIGN = range(5)
"""Numbers in the column "event": `HandEvent` of recording.hpp."""
OUTPUTS = ("status", "torques", "commands", "force", "friction_used")
"""What a controller did, by the names of its columns; the duration of an update is no part of it."""
_HOLDS = (
    core.Hold.optimized,
    core.Hold.squeeze,
    core.Hold.place,
    core.Hold.direct,
    core.Hold.reach,
)
_SINGLE = ("event", "hold", "period", "status", "duration")
_VECTORS = ("positions", "normals", "force")
_FORM = "a complete recording of a hand's controller"
_HINT = "; copy the file again, and change nothing in it: HandController.record and Recording.save write such files"


class _Setup(NamedTuple):
    """All that makes a controller."""

    tree: core.Tree
    settings: core.HandControllerSettings
    calibration: core.Calibration
    home: list[float]

    def controller(self) -> core.HandController:
        made = core.HandController()
        made.configure(*self)
        return made

    def new_state(self, more: int = 0) -> core.HandState:
        """Return a state of this hand, or of one with `more` joints."""
        return core.HandState(self.tree.joints + more, self.tree.fingers)


@dataclass(frozen=True, repr=False, eq=False)
class Recording:
    """Rows of a hand's controller, from `HandController.record` on: K rows of W numbers.

    `recording["torques"]` returns the columns of that name: (K,) for one number a row, (K, N, 3)
    for points, normals and forces, else (K, n). The names are "event", "hold", "period", those of
    a `HandState`, "status", "torques", "commands", "force", "friction_used" and "duration".

    Args:
        columns: (W,) names of the columns, with their units.
        rows: (K, W).
        text: JSON of the hand, the settings, the calibration and the home posture.

    Attributes:
        header: what `text` holds, its numbers as floats.

    Raises:
        InvalidInputError: they are not those of one recording.

    Example:
        >>> from grasp_env.control import HandController
        >>> from grasp_env.sim import HandDescription
        >>> controller = HandController()
        >>> controller.configure(HandDescription.allegro())
        >>> controller.record(60.0)
        >>> state = controller.new_state()
        >>> controller.activate(state)
        >>> commands = [controller.update(state, 1e-3) for _ in range(3)]
        >>> recording = Recording.of(controller)
        >>> recording
        Recording(4 rows, 0.003 s, 16 joints, 4 fingers)
        >>> recording["torques"].shape, recording.times.tolist()
        ((4, 16), [0.0, 0.001, 0.002, 0.003])
    """

    columns: tuple[str, ...]
    rows: Array
    text: str
    header: dict[str, Any] = field(init=False)
    _setup: _Setup = field(init=False)
    _parts: dict[str, slice] = field(init=False)

    def __post_init__(self) -> None:
        header = _header(self.text)
        setup = _setup(header)
        columns = _columns(setup, header)
        if columns != tuple(self.columns):
            raise InvalidInputError(
                f"the columns of a recording of this hand must be {shown(columns)}, got {shown(tuple(self.columns))}{_HINT}"
            )
        rows = as_array(self.rows, (None, len(columns)), "rows of a recording", finite=False)
        rows.flags.writeable = False
        values: tuple[tuple[str, Any], ...] = (
            ("columns", columns),
            ("rows", rows),
            ("header", header),
            ("_setup", setup),
            ("_parts", dict(_by_name(columns))),
        )
        for name, value in values:
            object.__setattr__(self, name, value)
        self._check_events()

    def _check_events(self) -> None:
        for name, most in (
            ("event", FOREIGN),
            ("hold", len(_HOLDS) - 1),
            ("status", len(STATUSES) - 1),
        ):
            numbers = self[name]
            if len(wrong := np.flatnonzero(~np.isin(numbers, np.arange(most + 1)))):
                raise InvalidInputError(
                    f"column {name!r} of a recording holds whole numbers from 0 to {most}, got {numbers[wrong[0]]:g} in row "
                    f"{wrong[0]}{_HINT}"
                )
        events = self["event"]
        begins = np.concatenate([[True], events[:-1] == DEACTIVATE])[: len(events)]
        if len(wrong := np.flatnonzero((events == ACTIVATE) != begins)):
            raise InvalidInputError(
                f"a recording begins with event {ACTIVATE} (activate), which comes again after event {DEACTIVATE} (deactivate) and "
                f"nowhere else, got event {events[wrong[0]]:g} in row {wrong[0]}{_HINT}"
            )
        if not len(events):
            raise InvalidInputError(
                "a recording needs rows, got none: call record(seconds), then activate and update"
            )

    @classmethod
    def of(cls, controller: core.HandController) -> Recording:
        """Return what a controller has recorded.

        Raises:
            InvalidInputError: the `controller` has recorded nothing.
        """
        made = controller.recording
        if not made.columns:
            raise InvalidInputError(
                "this controller has recorded nothing: call record(seconds) before activate"
            )
        return cls(tuple(made.columns), made.rows(), made.header)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recording:
        """Read a file of `save` or of the C++ controller. Nothing in it is executed.

        Args:
            path: a .csv file.

        Raises:
            InvalidInputError: it is no complete recording, or cannot be read.
        """
        file = as_path(path, InvalidInputError, "the file of a recording")
        name = f"recording {file}"
        parts = parsed(_csv(file), _from_csv, InvalidInputError, name, _FORM, _HINT, WEIGHTS)
        try:
            return cls(*parts)
        except InvalidInputError as error:
            raise InvalidInputError(f"{name}: {error}") from None

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a file, whole or not at all, as the C++ controller writes it; return its path.

        Args:
            path: a .csv file: a comment with the header, the columns, the rows, with 17 digits.

        Raises:
            InvalidInputError: another suffix.
            OSError: the file cannot be written.
        """
        file = as_path(path, InvalidInputError, "the file of a recording")
        line = ",".join(["%.17g"] * len(self.columns)) + "\n"
        with (
            replacing(_csv(file)) as hidden,
            hidden.open("w", encoding="utf-8", newline="\n") as text,
        ):
            text.write(f"# {self.text}\n{','.join(self.columns)}\n")
            text.writelines(line % tuple(row) for row in self.rows)
        return file

    def __getitem__(self, name: str) -> Array:
        if name not in self._parts:
            raise UnknownNameError("column of a recording", name, self._parts)
        part = self.rows[:, self._parts[name]]
        if name in _VECTORS:
            return part.reshape(len(part), -1, 3)
        return part[:, 0] if name in _SINGLE else part

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return f"Recording({len(self)} rows, {self.times[-1]:g} s, {self.joints} joints, {self.fingers} fingers)"

    @property
    def joints(self) -> int:
        """Number of joints M."""
        return self._setup.tree.joints

    @property
    def fingers(self) -> int:
        """Number of fingertips N."""
        return self._setup.tree.fingers

    @cached_property
    def times(self) -> Array:
        """(K,) sum of the periods of all updates so far [s]; negative ones and nan count as 0."""
        updates = np.isin(self["event"], (UPDATE, FOREIGN)) & (self["period"] > 0.0)
        return np.cumsum(np.where(updates, self["period"], 0.0))

    @cached_property
    def limits(self) -> Array:
        """(M,) torques that motors and calibration give [N m]; infinite for a joint without limit."""
        return np.array(self._setup.controller().torque_limits)


class Differences(NamedTuple):
    """How two recordings differ in what the controller did.

    Attributes:
        rows: number of rows that differ.
        first: the first of them; None: none.
        largest: largest difference of each output, by the names in `OUTPUTS`; infinite where one is
            infinite or nan and the other is not.
    """

    rows: int
    first: int | None
    largest: dict[str, float]


def replay(recording: Recording) -> Recording:
    """Run a recording through a new controller, and return what that one recorded.

    All but the durations comes back bit for bit with the same build on the same kind of processor.

    Args:
        recording: what the controller is given, with its hand, settings and calibration.

    Raises:
        InvalidInputError: rows that no controller records.

    Example:
        >>> from grasp_env.control import HandController
        >>> from grasp_env.sim import HandDescription
        >>> controller = HandController()
        >>> controller.configure(HandDescription.leap())
        >>> controller.record(1.0)
        >>> controller.activate(controller.new_state())
        >>> commands = controller.update(controller.new_state(), 1e-3)
        >>> recording = Recording.of(controller)
        >>> differences(recording, replay(recording)).rows
        0
    """
    setup = recording._setup
    controller = setup.controller()
    controller.record(len(recording) / setup.settings.rate)
    state, foreign = setup.new_state(), setup.new_state(1)
    numbers = state.numbers
    first = recording._parts["period"].stop
    given = recording.rows[:, first : first + len(numbers)]
    events = recording["event"].astype(int).tolist()
    holds = recording["hold"].astype(int).tolist()
    periods = recording["period"].tolist()
    for row, (event, hold, period) in enumerate(zip(events, holds, periods, strict=True)):
        controller.hold = _HOLDS[hold]
        if event == UPDATE:
            numbers[:] = given[row]
            controller.update(state, period)
        elif event == FOREIGN:
            controller.update(foreign, period)
        elif event == TAKE_HOLD:
            controller.take_hold()
        elif event == DEACTIVATE:
            controller.deactivate()
        else:
            numbers[:] = given[row]
            if not controller.activate(state):
                raise InvalidInputError(
                    f"row {row} of the recording activates a controller with numbers that are not finite{_HINT}"
                )
    return Recording.of(controller)


def differences(recording: Recording, again: Recording) -> Differences:
    """Compare what the controllers of two recordings did. nan equals nan.

    Args:
        recording, again: recordings with the same columns and number of rows.

    Raises:
        InvalidInputError: they have others.

    Example:
        >>> from grasp_env.control import HandController
        >>> from grasp_env.sim import HandDescription
        >>> controller = HandController()
        >>> controller.configure(HandDescription.leap())
        >>> controller.record(1.0)
        >>> controller.activate(controller.new_state())
        >>> same = differences(Recording.of(controller), Recording.of(controller))
        >>> same.rows, same.first, same.largest["torques"]
        (0, None, 0.0)
    """
    if recording.columns != again.columns or len(recording) != len(again):
        raise InvalidInputError(
            f"two recordings of one run are needed, got {recording} and {again}"
        )
    differ = np.zeros(len(recording), dtype=bool)
    largest: dict[str, float] = {}
    for name in OUTPUTS:
        a, b = (each.rows[:, each._parts[name]] for each in (recording, again))
        unequal = (a.view(np.int64) != b.view(np.int64)) & ~(np.isnan(a) & np.isnan(b))
        differ |= unequal.any(axis=1)
        with np.errstate(invalid="ignore"):
            gaps = np.abs(a[unequal] - b[unequal])
        largest[name] = float(np.where(np.isnan(gaps), np.inf, gaps).max(initial=0.0))
    rows = np.flatnonzero(differ)
    return Differences(len(rows), int(rows[0]) if len(rows) else None, largest)


# --- header


def _header(text: str) -> dict[str, Any]:
    """Return the header of a recording; its numbers are floats, so that -0 keeps its sign."""
    try:
        header = json.loads(text, parse_int=float, parse_constant=_refused)
    except (TypeError, ValueError, RecursionError) as error:
        raise InvalidInputError(
            f"the header of a recording is no JSON object: {str(error)[:200]}{_HINT}"
        ) from None
    if not isinstance(header, dict) or header.get("kind") != KIND:
        kind = header.get("kind") if isinstance(header, dict) else header
        raise InvalidInputError(
            f"the header of a recording must be of kind {KIND!r}, got {shown(kind)}; a recording of another version of this package "
            "needs that version"
        )
    return header


def _refused(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _setup(header: dict[str, Any]) -> _Setup:
    """Return what the header describes."""
    digits = _entry(header, "hand", str)
    try:
        tree = core.Tree.load(bytes.fromhex(digits))
    except ValueError:
        tree = None
    if tree is None or tree.fingers == 0:
        raise InvalidInputError(
            f"the header of a recording must hold the bytes of a whole hand as hexadecimal digits{_HINT}"
        )
    given = _entry(header, "settings", dict)
    settings = core.HandControllerSettings()
    rest = {"tolerance", "max_iterations"}
    for name, value in given.items():
        known = getattr(settings, name, None)
        if isinstance(known, core.Spring):
            setattr(settings, name, core.Spring(*_numbers(value, name, 3)))
        elif isinstance(known, float | int) and not isinstance(known, bool):
            setattr(settings, name, _like(known, value, name))
        elif name not in rest:
            raise InvalidInputError(
                f"the header of a recording has an unknown setting {shown(name)}: a later version of this package has made it, so "
                "update yours"
            )
    tolerance = _like(1.0, given.get("tolerance", ""), "tolerance")
    settings.set_follow(tolerance, _like(1, given.get("max_iterations", ""), "max_iterations"))
    table = _entry(header, "calibration", dict)
    calibration = core.Calibration()
    for name in ("torques", "units"):
        setattr(calibration, name, [_numbers(row, name) for row in _entry(table, name, list)])
    for name in ("friction", "dead_band"):
        setattr(calibration, name, _numbers(_entry(table, name, list), name))
    for name in ("fade", "resolution"):
        setattr(calibration, name, _like(1.0, table.get(name), name))
    return _Setup(tree, settings, calibration, _numbers(_entry(header, "home", list), "home"))


def _entry(of: dict[str, Any], name: str, kind: type) -> Any:
    if not isinstance(value := of.get(name), kind):
        raise InvalidInputError(
            f"the header of a recording needs an entry {name!r} of type {kind.__name__}, got {shown(value)}{_HINT}"
        )
    return value


def _like(known: float, value: Any, name: str) -> Any:
    """Return a number of the type of `known`; null is infinity."""
    number = np.inf if value is None else as_number(value)
    whole = isinstance(known, int)
    if number is None or (whole and not (number.is_integer() and abs(number) < 2**31)):
        raise InvalidInputError(
            f"{name} in the header of a recording must be a {'whole ' if whole else ''}number, got {shown(value)}{_HINT}"
        )
    return int(number) if whole else number


def _numbers(values: Any, name: str, count: int | None = None) -> list[float]:
    if not isinstance(values, list) or (count is not None and len(values) != count):
        wanted = "numbers" if count is None else f"{count} numbers"
        raise InvalidInputError(
            f"{name} in the header of a recording must be a list of {wanted}, got {shown(values)}{_HINT}"
        )
    return [_like(1.0, value, name) for value in values]


def _columns(setup: _Setup, header: dict[str, Any]) -> tuple[str, ...]:
    """Return the columns of a recording of this controller, whose own header must be the same."""
    try:
        controller = setup.controller()
        controller.record(1.0 / setup.settings.rate)
    except Exception as error:  # of the core: what no controller accepts
        raise InvalidInputError(
            f"the header of a recording describes no controller: {error}{_HINT}"
        ) from None
    controller.activate(setup.new_state())
    own = _header(controller.recording.header)
    if own != header:
        missing = [*(own["settings"].keys() - header["settings"].keys())]
        raise InvalidInputError(
            f"the header of a recording is not that of its own controller{f', without {missing}' if missing else ''}: another version "
            f"of this package has made it, so take that one{_HINT}"
        )
    return tuple(controller.recording.columns)


def _by_name(columns: tuple[str, ...]) -> Iterator[tuple[str, slice]]:
    """Yield the name and the place of each part of a row."""
    end = 0
    for name, group in groupby(columns, lambda column: re.split(r"[. ]", column)[0]):
        begin, end = end, end + len(list(group))
        yield name, slice(begin, end)


# --- files


def _csv(path: Path) -> Path:
    if path.suffix.lower() != ".csv":
        raise InvalidInputError(f"the file of a recording must end with .csv, got {str(path)!r}")
    return path


def _from_csv(blob: bytes) -> tuple[tuple[str, ...], Array, str]:
    text, _, rest = blob.partition(b"\n")
    names, _, body = rest.partition(b"\n")
    if not text.startswith(b"# "):
        raise ValueError(f"its first line must be # and a JSON object, got {shown(text)}")
    # units have commas
    columns = tuple(re.split(r",(?![^[]*\])", names.decode().rstrip("\r")))
    if not body.endswith(b"\n"):
        raise ValueError("it is cut: no end of a line follows its last number")
    rows = np.loadtxt(io.BytesIO(body), delimiter=",", comments=None, ndmin=2, encoding="utf-8")
    return columns, rows, text[2:].decode().rstrip("\r")
