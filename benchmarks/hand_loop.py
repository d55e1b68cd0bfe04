"""The controllers of `examples/hand_controller` in a process of their own, in real time against a simulated hand that holds an object.

The hand runs here: MuJoCo steps at the rate, sends what a hand would, and turns what comes back into torques. Contacts of each finger in
turn are cut for a while, and messages stop now and then.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import util
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from benchmarks.settings import Benchmark, tick
from grasp_env._check import Array
from grasp_env.control.loop import critically_damped
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import SimulationError
from grasp_env.sim import HandDescription, MujocoEngine
from grasp_env.sim.hand.description import HANDS
from grasp_env.task.motion import resting_target
from training.results.claims import Claim
from training.results.table import pd, table

ROOT = Path(__file__).parents[1]
UNITS = 240.0
"""Largest command, for the largest torque of each joint."""
MARGIN = 0.9
"""Of the friction: what the controller believes in."""
BANDWIDTH = 40.0, 60.0
"""Of the feedback on position and orientation [rad/s]."""
RISE = 0.05
"""[s] before the hand carries the object."""
FIRST_CUT, CUT_EVERY, CUT_FOR = 0.5, 0.4, 0.1
"""[s] when contacts of a finger are cut, the next one's after that, and for how long."""
FIRST_SILENCE, SILENCE_EVERY, SILENT_FOR = 0.7, 1.2, 0.02
"""[s] when messages stop; never while contacts are cut."""
SENSOR_AGE = 0.001
"""[s] age of contacts when they are sent."""
SEQUENCE, HEARD, UPDATES, DURATION, LATE, OVER_BUDGET, STATUS, COMMANDS = range(8)
"""Places in what comes back."""
PATIENCE = 60.0
"""[s] until the controller must have answered its first message."""


@dataclass(frozen=True)
class Settings:
    """What runs.

    Attributes:
        hand: that holds a ball of 60 mm and 150 g.
        rate: of the hand's messages, and of the controller [Hz].
        seconds: of simulated and real time.
        language: of the controller.
    """

    hand: Literal["allegro", "leap"] = "allegro"
    rate: int = 1000
    seconds: int = 60
    language: Literal["cpp", "python"] = "cpp"


def run(settings: Settings) -> pd.DataFrame:
    """Runs the loop, and returns a row for each update, for each round trip, and one of counts."""
    with tempfile.TemporaryDirectory() as folder:
        hand = SimulatedHand(settings.hand, settings.rate)
        start = python_controller(hand) if settings.language == "python" else compiled_controller(hand, Path(folder))
        with start() as channel:
            told = Loop(hand, channel, settings.rate).run(settings.seconds)
        hand.env.close()
    rows: list[dict[str, Any]] = []
    for case, times in (("update", told["durations"]), ("round trip", told["trips"])):
        rows += [{"case": case, "problem": k, "latency": 1e6 * value} for k, value in enumerate(times)]
    counts = {name: told[name] for name in ("lost", "late", "over_budget", "unanswered", "held", "drift", "solves")}
    rows.append({"case": "run", "problem": 0, "latency": None, **counts})
    return table([{"hand": settings.hand, "method": settings.language, **row} for row in rows])


class SimulatedHand:
    """A hand that holds an object, as a driver of hardware shows it."""

    def __init__(self, name: str, rate: int) -> None:
        ball = {"shape": "sphere", "size": (0.06,), "friction": 0.7, "mass": 0.15}
        engine = MujocoEngine(rate=1000 if 1000 % rate == 0 else rate)
        self.env = FourFingerGrasp(
            hand=HANDS[name](), engine=engine, **{"controller.rate": rate, "agent.rate": rate // 10}, **ball
        )
        self.env.reset(seed=0)
        self.scene = scene = self.env.scene
        self.hand: HandDescription = scene.kinematics.hand
        self.limits = scene.kinematics.torque_limits
        self.friction = MARGIN * scene.config.object.friction * self.hand.tip_friction
        self.body = critically_damped(scene.config.object, *BANDWIDTH)
        self.target = resting_target(1)[0]

    def drift(self) -> float:
        """How far the object is from where it was grasped [m]."""
        return float(np.linalg.norm(self.scene.look().position))

    def step(self, commands: Array) -> None:
        """A period under commands in device units: motors turn them into torques."""
        self.scene.advance((commands / UNITS * self.limits).tolist(), None)

    def state(self, cut: int) -> Array:
        """The numbers of a `HandState`; cut: a finger whose contact is not seen, -1: none."""
        seen = self.scene.look()
        touching = seen.touching.copy()
        if cut >= 0:
            touching[cut] = 0.0
        load = np.array(self.body.wrench(self.scene.core, self.target, self.scene.gravity))
        force, moment = seen.rotation @ load[:3], seen.rotation @ load[3:]
        return np.concatenate([
            seen.angles, seen.rates, touching, seen.touch.ravel(), (seen.normals @ seen.rotation.T).ravel(), force,
            moment + np.cross(seen.position, force), self.scene.gravity, [SENSOR_AGE],
        ])  # fmt: skip


class Loop:
    """The hand's side of the loop: steps, sends, and takes what comes back until the next step is due."""

    def __init__(self, hand: SimulatedHand, channel: socket.socket, rate: int) -> None:
        self.hand, self.channel, self.period = hand, channel, 1.0 / rate
        self.sent: list[float] = []  # when
        self.durations: list[float] = []
        self.trips: dict[int, float] = {}
        self.statuses: list[int] = []
        self.answer = np.zeros(0)

    def run(self, seconds: float) -> dict[str, Any]:
        """What was measured and counted.

        Raises:
            SimulationError: the controller does not answer.
        """
        hand, fingers = self.hand, self.hand.hand.finger_count
        self.send(hand.state(-1))
        self.take(time.perf_counter() + PATIENCE, first=True)
        for _ in range(round(RISE / self.period)):  # the object is carried until torques have risen
            self.send(hand.state(-1))
            self.take(time.perf_counter() + self.period)
        due, drift, behind = time.perf_counter(), 0.0, 0
        for k in range(round(seconds / self.period)):
            now, due = k * self.period, due + self.period
            if not k % 1000:
                tick(f"{now:.0f} s of {seconds} s, {1e3 * drift:.3f} mm")
            hand.step(self.answer[COMMANDS : COMMANDS + len(hand.limits)])
            drift = max(drift, hand.drift())
            if not _within(now, FIRST_SILENCE, SILENCE_EVERY, SILENT_FOR):
                cut = _within(now, FIRST_CUT, CUT_EVERY, CUT_FOR)
                self.send(hand.state((cut - 1) % fingers if cut else -1))
            if time.perf_counter() > due + self.period:  # this side is late: a hand would not be
                due, behind = time.perf_counter(), behind + 1
            self.take(due)
        self.take(time.perf_counter() + 0.1)
        heard, updates = self.answer[HEARD], self.answer[UPDATES]
        return {
            "durations": self.durations, "trips": list(self.trips.values()), "statuses": np.array(self.statuses),
            "lost": int(len(self.sent) - heard + updates - len(self.durations)), "late": int(self.answer[LATE]),
            "over_budget": int(self.answer[OVER_BUDGET]), "unanswered": len(self.sent) - len(self.trips), "behind": behind,
            "held": hand.scene.look().touching.any() and drift < 0.005, "drift": 1e3 * drift, "solves": int(updates),
        }  # fmt: skip

    def send(self, numbers: Array) -> None:
        """One message, with its number."""
        self.sent.append(time.perf_counter())
        self.channel.send(np.concatenate([[len(self.sent) - 1], numbers]).tobytes())

    def take(self, until: float, first: bool = False) -> None:
        """What comes back until then, or the first of it."""
        while (left := until - time.perf_counter()) > 0.0:
            if not select.select([self.channel], [], [], left)[0]:
                break
            message = self.channel.recv(1 << 16)
            came = time.perf_counter()
            if not message:
                raise SimulationError("the controller has ended")
            self.answer = np.frombuffer(message)
            sequence = int(self.answer[SEQUENCE])
            self.trips.setdefault(sequence, came - self.sent[sequence])
            self.durations.append(float(self.answer[DURATION]))
            self.statuses.append(int(self.answer[STATUS]))
            if first:
                break
        if not len(self.answer):
            raise SimulationError(f"the controller did not answer in {PATIENCE} s")


def _within(now: float, first: float, every: float, lasts: float) -> int:
    """The number, from one on, of the repeated event that now is within; 0: of none."""
    number, since = divmod(now - first, every)
    return int(number) + 1 if now >= first and since < lasts else 0


def compiled_controller(hand: SimulatedHand, folder: Path, program: Path | None = None) -> Callable[[], Any]:
    """Starts the example in C++, which is built first unless it is given."""
    built = program or build(folder)
    file = hand.scene.kinematics.export(folder / "hand")

    @contextmanager
    def start() -> Iterator[socket.socket]:
        mine, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        words = [str(other.fileno()), str(file), f"{1.0 / hand.scene.timestep:g}", f"{hand.friction:.17g}"]
        with mine, subprocess.Popen([built, *words], pass_fds=[other.fileno()]) as process:
            other.close()
            yield mine
            mine.close()
            process.wait(10.0)

    return start


def build(folder: Path) -> Path:
    """The example in C++, compiled for this processor."""
    core = ROOT / "grasp_env" / "core"
    options = ["-DGRASP_EXAMPLES=ON", "-DCMAKE_BUILD_TYPE=Release", "-DCMAKE_CXX_FLAGS=-march=native"]
    made = folder / "build"
    tick("the example is compiled")
    for words in (["-S", core, "-B", made, *options], ["--build", made, "--target", "hand_controller"]):
        done = subprocess.run(["cmake", *words], capture_output=True, text=True, check=False)
        if done.returncode:
            raise SimulationError(f"cmake fails: {done.stderr or done.stdout}")
    return made / "hand_controller"


def python_controller(hand: SimulatedHand) -> Callable[[], Any]:
    """Starts the example in Python."""

    @contextmanager
    def start() -> Iterator[socket.socket]:
        mine, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        given = other, hand.hand, 1.0 / hand.scene.timestep, hand.friction
        process = multiprocessing.get_context("spawn").Process(target=serve, args=given, daemon=True)
        with mine:
            process.start()
            other.close()
            yield mine
        process.join(10.0)

    return start


def example() -> ModuleType:
    """`examples/hand_controller.py`."""
    spec = util.spec_from_file_location("hand_controller", ROOT / "examples" / "hand_controller.py")
    assert spec is not None and spec.loader is not None  # noqa: PT018
    module = util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def serve(channel: socket.socket, hand: HandDescription, rate: float, friction: float) -> None:
    """What `main` of the example in C++ does, with the one in Python."""
    shown = example()
    limits = hand.torque_limits
    controller = shown.HandController()
    settings = shown.Settings(friction=friction, rate=rate)
    controller.configure(
        hand, settings, shown.Calibration(np.outer(limits, [-1, 1]), np.outer(UNITS + 0 * limits, [-1, 1]))
    )
    joints, fingers = hand.joint_count, hand.finger_count
    ends = np.cumsum([1, joints, joints, fingers, 3 * fingers, 3 * fingers, 6, 3])
    names = ("inactive", "holding", "overloaded", "coasting", "released")
    channel.setblocking(False)
    heard, updates, measured, last = 0, 0, 0.0, 0.0
    state: Any = None
    sequence = 0.0
    while True:
        select.select([channel], [], [], 1.5 / rate if heard else None)
        newest = b""
        try:
            while message := channel.recv(1 << 16):  # the newest counts
                newest, heard = message, heard + 1
            return
        except BlockingIOError:
            if not heard:
                continue
        now = time.perf_counter()
        if newest:
            (sequence,), angles, rates, touching, positions, normals, wrench, gravity, (age,) = np.split(
                np.frombuffer(newest), ends
            )
            rows = positions.reshape(-1, 3), normals.reshape(-1, 3)
            state, measured = shown.HandState(angles, rates, touching > 0.0, *rows, wrench, gravity), now - age
        if not updates:
            controller.activate(state)
            last = now - 1.0 / rate
        state.age = now - measured
        commands = controller.update(state, now - last)
        last, updates = now, updates + 1
        told = [
            sequence,
            heard,
            updates,
            controller.duration,
            controller.late,
            controller.over_budget,
            names.index(controller.status),
        ]
        channel.send(np.concatenate([told, commands, controller.torques]).tobytes())


BENCHMARK = Benchmark(run, Settings(), {"seconds": 5}, ("latency_median", "latency_p99"))
