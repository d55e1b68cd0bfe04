"""The controller of a hand in real time with a simulated hand, from C++ and from Python.

The controller runs in a separate process. The hand runs in this one: MuJoCo steps at the rate,
sends the messages of a hand, and converts the answers to torques. The contacts of each finger in
turn are cut for a while, and messages stop now and then.

The C++ side is `grasp_env/core/examples/hand_controller.cpp`. The hand, the Python side and the
protocol of their messages are in this file.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from benchmarks.benchmark import Benchmark, tick
from grasp_env.control import Calibration, HandController, HandControllerSettings, HandState
from grasp_env.control.loop import critically_damped
from grasp_env.control.recording import STATUSES
from grasp_env.env.env import FourFingerGrasp
from grasp_env.env.motors import Motors
from grasp_env.errors import InvalidInputError, SimulationError
from grasp_env.inputs.arguments import Array
from grasp_env.sim import HandDescription, MujocoEngine
from grasp_env.sim.hand.description import HANDS
from grasp_env.task.motion import resting_target
from training.evaluation.report.page import axes
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import pd, table

ROOT = Path(__file__).parents[1]
UNITS = 240.0
"""Largest command, at the largest torque of each joint."""
BANDWIDTH = 40.0, 60.0
"""Bandwidths of the feedback on position and orientation [rad/s]."""
RISE = 0.05
"""Time before the hand carries the object [s]."""
FIRST_CUT, CUT_EVERY, CUT_FOR = 0.5, 0.4, 0.1
"""Time of cut contacts: first cut, interval between fingers, duration [s]. Fingers that are pulled off
need twice the interval to find the object again."""
PULL = 3.0
"""Force that pulls a fingertip off the object while its contact is cut, in a run with errors [N]."""
JOINT_DELAY, DELAY = 0.002, 0.010
"""Delays of joints, and of contacts and object, in a run with errors [s]."""
FRICTION_ERROR, NOISE, NOISE_TIME = 0.25, 0.05, 0.004
"""Relative errors of the controller's friction and of delivered torques, and the time for which
a draw of these stays [s], in a run with errors."""
CAREFUL = {"friction_margin": 0.6, "preload": 1.0}
"""Settings of the controller in a run with errors."""
FIRST_SILENCE, SILENCE_EVERY, SILENT_FOR = 0.7, 1.2, 0.04
"""Time when messages stop, long enough to coast, never while contacts are cut [s]."""
SENSOR_AGE = 0.001
"""Age of joints, contacts and wrench when they are sent [s]."""
NUMBER, HEARD, UPDATES, DURATION, LATE, OVER_BUDGET, STATUS, COMMANDS = range(8)
"""Indices of an answer."""
HELD = 5.0
"""Largest drift of a held object [mm]."""
LOST = 15.0
"""Drift of an object that is lost, at which a repeatable run ends [mm]."""
UPDATE, TRIP, WHOLE, REPEATABLE = "update", "round trip", "run", "repeatable run"
LANGUAGES = {"cpp": "C++", "python": "Python"}
PATIENCE = 60.0
"""Longest wait for the first answer of the controller [s]."""


@dataclass(frozen=True)
class HandLoopSettings:
    """Hand, rate, duration and languages of a run.

    Attributes:
        hand: hand that holds a ball of 60 mm and 150 g.
        rate: rate of the hand's messages and of the controller [Hz]; a divisor of 1000.
        seconds: simulated and real time.
        language: languages of the controller, one after another.
        errors: if True, joints, contacts and object are measured late, the controller assumes
            too much friction, torques are noisy, and cut fingers are pulled off the object.
        seeds: how many runs follow in one process and without real time. Each has a seed of the
            noise of its own, and repeats exactly. They show how often a hand loses the object.
    """

    hand: Literal["allegro", "leap"] = "allegro"
    rate: Literal[1000, 500, 250, 100] = 1000
    seconds: int = 60
    language: tuple[Literal["cpp", "python"], ...] = ("cpp", "python")
    errors: bool = False
    seeds: int = 0


def run(settings: HandLoopSettings) -> pd.DataFrame:
    """Run the loop; return one row per update, one per answered message, and a row of counts.

    A repeatable run is one row.
    """
    if not settings.language and not settings.seeds:
        raise InvalidInputError("nothing to run: name a language, or give seeds of at least 1")
    rows: list[dict[str, Any]] = []
    for language in settings.language:
        hand = SimulatedHand(settings.hand, settings.rate, settings.errors)
        measured = measure(hand, settings.seconds, language)
        keys = {"hand": settings.hand, "method": language}
        for case, times in ((UPDATE, measured.durations), (TRIP, measured.trips.values())):
            rows += [
                {**keys, "case": case, "problem": k, "latency": 1e6 * value}
                for k, value in enumerate(times)
            ]
        rows.append({**keys, "case": WHOLE, "problem": 0, **measured.counts})
    for seed in range(settings.seeds):
        tick(f"repeatable run {seed + 1} of {settings.seeds}")
        hand = SimulatedHand(settings.hand, settings.rate, settings.errors, seed)
        keys = {"hand": settings.hand, "method": "python", "case": REPEATABLE, "problem": seed}
        rows.append({**keys, **repeatable(hand, settings.seconds)})
    return table(rows)


def repeatable(hand: SimulatedHand, seconds: float) -> dict[str, Any]:
    """Run hand and controller by turns, and close the hand; return whether it held the object.

    Every message arrives at once, so that a run repeats exactly. It ends when the object is lost,
    with a `drift` of `LOST`; `seconds` of the result is the simulated time until then [s].
    """
    controller = configured(hand.hand, hand.settings)
    period = 1.0 / hand.rate
    commands = np.zeros(len(hand.limits))
    drift = 0.0
    now = 0.0
    try:
        state = hand.state()
        controller.activate(state)
        for _ in range(round(RISE * hand.rate)):
            state = hand.state()
            commands = np.asarray(controller.update(state, period))
        for k in range(round(seconds * hand.rate)):
            now = k * period
            hand.step(commands)
            drift = max(drift, hand.drift())
            if drift > LOST:
                break
            if hand.is_silent(now):
                state.ages += period
            else:
                state = hand.state(hand.cut_finger(now))
            commands = np.asarray(controller.update(state, period))
    except SimulationError:  # it flew away
        drift = np.inf
    finally:
        hand.env.close()
    return {"held": drift < HELD, "drift": min(drift, LOST), "seconds": now + period}


def measure(
    hand: SimulatedHand, seconds: float, language: str, program: Path | None = None
) -> Loop:
    """Run the loop once, and close the hand; without a compiled `program` the example is built.

    Raises:
        SimulationError: the controller failed.
    """
    mine, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process: Any = None
    try:
        with tempfile.TemporaryDirectory() as scratch, other:
            folder = Path(scratch)
            if language == "python":
                args = other, hand.hand, hand.settings
                spawn = multiprocessing.get_context("spawn")
                process = spawn.Process(target=serve, args=args, daemon=True)
                process.start()
            else:
                file = hand.scene.kinematics.export(folder / "hand")
                channel = other.fileno()
                told = hand.settings
                numbers = told.rate, told.friction, told.friction_margin, told.preload
                words = [program or build(folder), str(channel), str(file)]
                words += [f"{number:.17g}" for number in numbers]
                process = subprocess.Popen(words, pass_fds=[channel])
            other.close()
            loop = Loop(hand, mine)
            loop.run(seconds)
            return loop
    finally:
        mine.close()  # which ends the controller
        if process is not None:
            wait = process.join if language == "python" else process.wait
            with suppress(subprocess.TimeoutExpired):
                wait(10.0)
            process.kill()  # if it hangs
            wait()
        hand.env.close()


class SimulatedHand:
    """Simulated hand that holds an object, with the interface of a hardware driver.

    Args:
        name: its name in `HANDS`.
        rate: rate of its messages [Hz].
        errors: see `HandLoopSettings`.
        seed: seed of the noise.

    Attributes:
        settings: friction and margin of the controller: the default margin, or with
            errors one for a friction that is known to 25 %, and preloads for late wrenches.
    """

    def __init__(self, name: str, rate: int, errors: bool = False, seed: int = 0) -> None:
        self.rate, self.errors = rate, errors
        ball = {"shape": "sphere", "size": (0.06,), "friction": 0.7, "mass": 0.15}
        rates = {"controller.rate": rate, "agent.rate": rate // 10}
        self.env = FourFingerGrasp(hand=HANDS[name](), engine=MujocoEngine(), **rates, **ball)
        self.env.reset(seed=0)
        self.scene = scene = self.env.scene
        self.hand: HandDescription = scene.kinematics.hand
        self.limits = scene.kinematics.torque_limits
        self.friction = scene.config.object.friction * self.hand.tip_friction
        self.body = critically_damped(scene.config.object, *BANDWIDTH)
        self.target = resting_target(1)[0]
        usual = HandControllerSettings(rate=rate, friction=self.friction)
        wrong = {"friction": self.friction * (1.0 + FRICTION_ERROR), **CAREFUL}
        self.settings = usual.replaced(wrong if errors else {})
        noise = {"noise": NOISE, "noise_time": NOISE_TIME} if errors else {}
        self._motors = Motors(self.env.config.override(motors=noise), self.limits, seed)
        late = [round(delay * rate) * errors for delay in (JOINT_DELAY, DELAY)]
        self._joints, self._rest = (deque[HandState](maxlen=1 + ticks) for ticks in late)
        links = scene.kinematics.tip_links
        self._tips = [scene.simulator.model.body(f"link{int(link)}").id for link in links]

    def is_silent(self, now: float) -> bool:
        """Return True while messages stop; now: time since the start [s]."""
        return _within(now, FIRST_SILENCE, SILENCE_EVERY, SILENT_FOR) > 0

    def cut_finger(self, now: float) -> int:
        """Return the finger whose contact is cut, -1: none."""
        cut = _within(now, FIRST_CUT, CUT_EVERY * (1 + self.errors), CUT_FOR)
        return (cut - 1) % self.hand.finger_count if cut else -1

    def drift(self) -> float:
        """Return the object's distance from the pose at which it was grasped [mm]."""
        return 1e3 * float(np.linalg.norm(self.scene.look().position))

    def step(self, commands: Array) -> None:
        """Simulate a period with commands in device units."""
        self.scene.advance(self._motors((commands / UNITS * self.limits).tolist()), None)

    def state(self, cut: int = -1) -> HandState:
        """Return a message in the frame of the base.

        Finger `cut` loses its contact, -1: none does. Without errors it only reports so; with
        errors it is pulled away from the object.
        """
        now = self._measured()
        pulls = self.scene.simulator.data.xfrc_applied
        pulls[self._tips] = 0.0
        if cut >= 0 and self.errors:
            pulls[self._tips[cut], :3] = -PULL * now.normals[cut]
        elif cut >= 0:
            now.touching[cut] = 0.0
        self._joints.append(now)
        self._rest.append(now)
        joints = self._joints[0]
        sent = self.new_state()
        sent.numbers[:] = self._rest[0].numbers
        sent.angles, sent.rates = joints.angles, joints.rates
        late = np.array([len(self._joints) - 1, len(self._rest) - 1, len(self._rest) - 1])
        sent.ages[:] = SENSOR_AGE + late / self.rate
        return sent

    def new_state(self) -> HandState:
        """Return an empty message of this hand."""
        return HandState(self.hand.joint_count, self.hand.finger_count)

    def _measured(self) -> HandState:
        """Return the present state, except for the ages."""
        reading = self.scene.look()
        load = np.array(self.body.wrench(self.scene.core, self.target, self.scene.gravity))
        force = reading.rotation @ load[:3]
        moment = reading.rotation @ load[3:] + np.cross(reading.position, force)
        state = self.new_state()
        state.angles = reading.angles
        state.rates = reading.rates
        state.touching = reading.touching
        state.positions = reading.touch
        state.normals = reading.normals @ reading.rotation.T
        state.wrench = np.concatenate([force, moment])
        state.gravity = self.scene.gravity
        return state


class Loop:
    """The hand's side of the loop: step, send, and receive answers until the next step is due.

    Attributes:
        durations: seconds of each update, as the controller measured it.
        statuses: indices in `STATUSES`, one per update.
        trips: seconds from sending a message to its answer, by its number.
        counts: columns of the table for the whole run.
    """

    def __init__(self, hand: SimulatedHand, channel: socket.socket) -> None:
        self.hand = hand
        self.channel = channel
        self.period = 1.0 / hand.rate
        self.durations: list[float] = []
        self.statuses: list[int] = []
        self.trips: dict[int, float] = {}
        self.counts: dict[str, Any] = {}
        self._sent: list[float] = []
        self._first = 0  # number of the first message that is timed
        self._came = 0  # answers
        self._answer = np.zeros(COMMANDS)

    def run(self, seconds: float) -> None:
        """Run for a time [s], or raise a `SimulationError` if the controller does not answer."""
        hand = self.hand
        drift = 0.0
        behind = 0
        self._rise()
        due = time.perf_counter()
        for k in range(round(seconds / self.period)):
            now = k * self.period
            due += self.period
            if not k % 1000:
                tick(f"{now:.0f} s of {seconds} s, {drift:.3f} mm")
            hand.step(self._answer[COMMANDS : COMMANDS + len(hand.limits)])
            drift = max(drift, hand.drift())
            if not hand.is_silent(now):
                self._send(hand.state(hand.cut_finger(now)))
            if time.perf_counter() > due:  # a busy machine delays the simulated hand
                due = time.perf_counter() + 0.5 * self.period
                behind += 1
            self._take(due)
        self._take(time.perf_counter() + 0.1)
        heard = self._answer[HEARD]
        updates = self._answer[UPDATES]
        self.counts = {
            "lost": int(len(self._sent) - heard + updates - self._came),
            "unanswered": len(self._sent) - self._first - len(self.trips),
            "late": int(self._answer[LATE]),
            "over_budget": int(self._answer[OVER_BUDGET]),
            "behind": behind,
            "solves": int(updates),
            "held": bool(drift < HELD),
            "drift": drift,
            "seconds": seconds,
        }

    def _rise(self) -> None:
        """Carry the object until torques have risen, untimed."""
        self._send(self.hand.state())
        self._take(time.perf_counter() + PATIENCE, first=True)
        if not self.durations:
            raise SimulationError(f"the controller did not answer in {PATIENCE} s")
        for _ in range(round(RISE / self.period)):
            self._send(self.hand.state())
            self._take(time.perf_counter() + self.period)
        self._take(time.perf_counter() + self.period)
        self.durations, self.statuses, self.trips, self._first = [], [], {}, len(self._sent)

    def _send(self, state: HandState) -> None:
        """Send a message with its number."""
        message = np.concatenate([[len(self._sent)], state.numbers]).tobytes()
        self._sent.append(time.perf_counter())
        self.channel.send(message)

    def _take(self, until: float, first: bool = False) -> None:
        """Take the answers that come until a time of `perf_counter`, or only the first one."""
        while (left := until - time.perf_counter()) > 0.0:
            if not select.select([self.channel], [], [], left)[0]:
                break
            message = self.channel.recv(1 << 16)
            came = time.perf_counter()
            if not message:
                raise SimulationError("the controller has ended")
            self._answer = np.frombuffer(message)
            number = int(self._answer[NUMBER])
            self._came += 1
            if number >= self._first:
                self.trips.setdefault(number, came - self._sent[number])
            self.durations.append(float(self._answer[DURATION]))
            self.statuses.append(int(self._answer[STATUS]))
            if first:
                break


def _within(now: float, first: float, every: float, lasts: float) -> int:
    """Return the number, from one on, of the repeated event that is now; 0: none."""
    number, since = divmod(now - first, every)
    return int(number) + 1 if now >= first and since < lasts else 0


def build(folder: Path) -> Path:
    """Compile the example in C++ for this processor, or raise a `SimulationError`."""
    beside = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    if (cmake := shutil.which("cmake", path=beside)) is None:
        raise SimulationError(
            "the controller in C++ is built with cmake, which is missing: pip install cmake"
        )
    core = ROOT / "grasp_env" / "core"
    target = folder / "build"
    options = ["-DGRASP_EXAMPLES=ON", "-DCMAKE_BUILD_TYPE=Release"]
    options += ["-DCMAKE_CXX_FLAGS=-march=native"]
    configure = ["-S", core, "-B", target, *options]
    tick("the example is compiled")
    for words in (configure, ["--build", target, "--target", "hand_controller"]):
        ended = subprocess.run([cmake, *words], capture_output=True, text=True, check=False)
        if ended.returncode:
            raise SimulationError(f"cmake fails: {ended.stderr or ended.stdout}")
    return target / "hand_controller"


def configured(hand: HandDescription, settings: HandControllerSettings) -> HandController:
    """Return a controller that answers in device units."""
    controller = HandController()
    controller.configure(hand, settings, device_units(np.array(hand.torque_limits)))
    return controller


def device_units(limits: Array) -> Calibration:
    """Return whole numbers from -UNITS to UNITS for torques up to limits (M,) [N m]."""
    units = np.tile([-UNITS, UNITS], (len(limits), 1))
    return Calibration(np.outer(limits, [-1.0, 1.0]), units)


def serve(channel: socket.socket, hand: HandDescription, settings: HandControllerSettings) -> None:
    """Serve the controller in Python as `main` of the example serves it in C++."""
    controller = configured(hand, settings)
    state = controller.new_state()
    heard = 0
    updates = 0
    number = 0.0
    last = 0.0
    channel.setblocking(False)
    gc.freeze()
    gc.disable()  # there are no reference cycles
    while True:
        select.select([channel], [], [], 1.5 / settings.rate if heard else None)
        newest = b""
        try:
            while message := channel.recv(1 << 16):  # the newest counts
                newest = message
                heard += 1
            return
        except BlockingIOError:
            pass
        except ConnectionError:  # closed with answers unread
            return
        now = time.perf_counter()
        if newest:
            row = np.frombuffer(newest)
            number = row[0]
            state.numbers[:] = row[1:]
        else:
            state.ages += now - last
        if controller.status == "inactive":
            with suppress(InvalidInputError):  # broken numbers: the next message
                controller.activate(state)
            last = now - 1.0 / settings.rate
        commands = np.asarray(controller.update(state, now - last))
        last = now
        updates += 1
        measures = controller.duration, controller.late, controller.over_budget
        header = [number, heard, updates, *measures, STATUSES.index(controller.status)]
        with suppress(BlockingIOError, ConnectionError):
            channel.send(np.concatenate([header, commands, controller.torques]).tobytes())


def draw(rows: pd.DataFrame, words: Mapping[str, str]) -> Figure:
    """Draw histograms of the times of updates and round trips; `words` name the methods.

    Without times, draw the drift of each repeatable run.
    """
    figure, panel = axes(3.4)
    if "latency" not in rows:
        panel.bar(rows["problem"], rows["drift"], width=0.7)
        panel.axhline(HELD, color="C1", linewidth=1.0, label=f"held: below {HELD:g} mm")
        panel.set(xlabel="seed", ylabel="drift [mm]", ylim=(0.0, LOST))
        panel.legend(frameon=False, fontsize=9)
        return figure
    timed = rows.dropna(subset="latency")
    edges = np.geomspace(max(timed["latency"].min(), 1.0), 1.01 * timed["latency"].max(), 70)
    for keys, group in timed.groupby(["method", "case"], sort=False):
        method, case = map(str, keys)  # type: ignore[call-overload]
        counts, _ = np.histogram(group["latency"], edges)
        label = f"{words[method]}, {case}"
        color = f"C{list(words).index(method)}"
        style = "-" if case == UPDATE else ":"
        panel.stairs(counts, edges, label=label, color=color, linestyle=style, linewidth=1.4)
    panel.set(xscale="log", yscale="log", xlabel="time [us]", ylabel="how many", ylim=(0.8, None))
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    figure.legend(frameon=False, fontsize=9, ncols=2, loc="outside upper left")
    return figure


_FAST = f"case == '{UPDATE}' and method == 'cpp'"
_WHOLE = f"case == '{WHOLE}'"
BENCHMARK = Benchmark(
    run,
    HandLoopSettings(),
    {"seconds": 5},
    (
        "latency_median",
        "latency_p99",
        "latency_p999",
        "latency_max",
        "lost_sum",
        "unanswered_sum",
        "late_sum",
        "over_budget_sum",
        "behind_sum",
        "drift_max",
        "held_mean",
    ),
    claims=(
        Claim("update in C++, median", _FAST, "latency_median", "<=", 15.0, unit="us"),
        Claim("update in C++, 99.9th percentile", _FAST, "latency_p999", "<=", 60.0, unit="us"),
        Claim("messages lost", _WHOLE, "lost_sum", "<=", 0.0),
        Claim("runs in which the object was held", _WHOLE, "held_mean", ">=", 1.0),
    ),
    words=LANGUAGES,
    draw=draw,
)
