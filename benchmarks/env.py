"""Comparison of the environment with the bare PyBullet calls of the same episode.

It measures steps per second, resets and memory.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import time
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.benchmark import Benchmark, tick
from grasp_env.env.env import FourFingerGrasp
from grasp_env.sim.client import bullet
from policies import LearnedInitialForce
from training.data.episodes import episode
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import pd, table

USUAL = "the paper's"
EPISODES: dict[str, dict[str, Any]] = {
    USUAL: {},
    "newton, previous": {"method": "newton", "initial_force": "previous"},
    "reduced_flow, learned": {"initial_force": "learned"},
    "random wrench": {"disturbance": "random"},
    "estimated wrench": {"disturbance": "random", "sensors.wrench": "estimated"},
    "constant squeeze": {"controller.kind": "constant_squeeze"},
    "PD only": {"controller.kind": "pd"},
}
"""Settings of the environments that are stepped."""
RESETS: dict[str, dict[str, Any]] = {
    "same object": {},
    "same shape, new mass and friction": {"randomize": ("mass", "friction")},
    "new shape": {"randomize": ("shape", "size", "mass", "friction")},
}
"""Settings of the environments that are reset."""
STEPS = 100
"""Number of agent steps in a timed episode."""
Recorded = list[tuple[list[float], list[float] | None]]
"""Torques and wrench of every physics step."""
Row = dict[str, Any]


@dataclass(frozen=True)
class EnvSettings:
    """Settings of a benchmark.

    Attributes:
        rounds: episodes of the usual environment; a third as many of others.
        resets: resets during which the growth of memory is measured; a quarter as many are timed.
        envs: environments whose memory is measured.
        seed: seed of the episodes.
    """

    rounds: int = 30
    resets: int = 1000
    envs: int = 8
    seed: int = 0


def run(settings: EnvSettings) -> pd.DataFrame:
    """Time steps and resets and measure memory, on one thread, without warm-up."""
    rows: list[Row] = []
    fewer = max(4, settings.rounds // 3)
    for name, options in EPISODES.items():
        tick(f"steps: {name}")
        rounds = settings.rounds if name == USUAL else fewer
        rows += steps_beside_bare(name, options, settings.seed, rounds)
    tick("steps through gym.make")
    name = f"{USUAL}, gym.make"
    rows += steps_beside_bare(name, {}, settings.seed, settings.rounds, wrapped=True)
    for name, options in RESETS.items():
        tick(f"resets: {name}")
        rows += reset_times(name, options, settings.seed, max(20, settings.resets // 4))
    for name in ("same object", "new shape"):
        tick(f"memory over {settings.resets} resets: {name}")
        rows += memory_of(name, RESETS[name], settings.resets, settings.envs)
    return table(rows)


def make(options: dict[str, Any], wrapped: bool = False) -> Any:
    """Make an environment; `initial_force="learned"` is the shipped network."""
    if options.get("initial_force") == "learned":
        options = {**options, "initial_force": LearnedInitialForce.pretrained()}
    if wrapped:
        return gym.make("grasp_env:FourFingerGrasp-v0", **options)
    return FourFingerGrasp(**options)


def steps_beside_bare(
    name: str, options: dict[str, Any], seed: int, rounds: int, wrapped: bool = False
) -> list[Row]:
    """Return microseconds of an agent step and of its PyBullet calls alone, measured in turns.

    The bare loop repeats the recorded torques and wrenches from the same state, with the same
    readings, so it has the same contacts. Its final pose must be the same, bit by bit.
    """
    env = make(options, wrapped)
    try:
        inner: FourFingerGrasp = env.unwrapped
        action = np.zeros(env.action_space.shape, dtype=np.float32)
        recorded = record(inner, seed)
        rows: list[Row] = []
        for turn in range(rounds + 1):
            env.reset(seed=seed)
            begin = time.perf_counter_ns()
            for _ in range(STEPS):
                env.step(action)
            ours = 1e-3 * (time.perf_counter_ns() - begin) / STEPS
            pose = _pose(inner)
            env.reset(seed=seed)
            bare = 1e-3 * bare_loop(inner, recorded) / STEPS
            if _pose(inner) != pose:
                raise AssertionError(
                    "the bare loop went another way than the environment: an unfair comparison"
                )
            row = {"method": name, "problem": turn - 1}
            step = {"microseconds": ours, "per_second": 1e6 / ours, "ratio": ours / bare}
            rows.append({**row, "case": "step", **step})
            rows.append({**row, "case": "bare PyBullet calls of the step", "microseconds": bare})
        return rows[2:]  # the first turn is warm-up
    finally:
        env.close()


def record(env: FourFingerGrasp, seed: int) -> Recorded:
    """Record the torques and wrenches of the first `STEPS` agent steps of an episode."""
    running = episode(env, seed, most=STEPS)
    scene: Any = env.scene
    out: Recorded = []
    advance = scene.advance

    def keep(torques: list[float], wrench: list[float] | None) -> None:
        out.append((list(torques), wrench))
        advance(torques, wrench)

    scene.advance = keep
    try:
        deque(running, maxlen=0)
    finally:
        del scene.advance
    return out


def bare_loop(env: FourFingerGrasp, recorded: Recorded) -> int:
    """Return nanoseconds of the calls that `Scene.advance` and `Scene.look` make, and no more.

    The environment's physics must run at its control rate.
    """
    simulator = env.scene.simulator
    world, client = simulator.world, simulator.client.number
    hand, body, joints = world.hand, world.object, world.joints
    mode = bullet.TORQUE_CONTROL
    frame = bullet.LINK_FRAME
    origin = (0.0, 0.0, 0.0)
    clock, total = time.perf_counter_ns, 0
    for torques, wrench in recorded:
        begin = clock()
        bullet.setJointMotorControlArray(hand, joints, mode, forces=torques, physicsClientId=client)
        if wrench is not None:
            bullet.applyExternalForce(body, -1, wrench[:3], origin, frame, client)
            bullet.applyExternalTorque(body, -1, wrench[3:], frame, client)
        bullet.stepSimulation(client)
        bullet.getJointStates(hand, joints, client)
        bullet.getBasePositionAndOrientation(body, client)
        bullet.getBaseVelocity(body, client)
        bullet.getContactPoints(hand, body, physicsClientId=client)
        total += clock() - begin
    return total


def reset_times(name: str, options: dict[str, Any], seed: int, count: int) -> list[Row]:
    """Return milliseconds of `reset`, closing the fingers included."""
    env = make(options)
    try:
        rows: list[Row] = []
        for k in range(count + 5):
            begin = time.perf_counter_ns()
            env.reset(seed=seed + k)
            milliseconds = 1e-6 * (time.perf_counter_ns() - begin)
            rows.append(
                {"case": "reset", "method": name, "problem": k - 5, "milliseconds": milliseconds}
            )
        return rows[5:]  # the first are warm-up
    finally:
        env.close()


def memory_of(name: str, options: dict[str, Any], resets: int, envs: int) -> list[Row]:
    """Run `weigh` in a separate process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        memory = pool.submit(weigh, options, resets, envs).result()
    return [{"case": case, "method": name, "mebibytes": value} for case, value in memory.items()]


def weigh(options: dict[str, Any], resets: int, envs: int) -> dict[str, float]:
    """Return the resident memory of this process by purpose [MiB]."""
    # code and the first reset's caches belong to the process, not to an environment
    warm = make(options)
    for k in range(max(20, resets // 10)):
        warm.reset(seed=k)
    first = _resident()
    for k in range(resets):
        warm.reset(seed=1000 + k)
    before = _resident()
    more = [make(options) for _ in range(envs)]
    for k, env in enumerate(more):
        env.reset(seed=k)
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    total = _resident()
    for env in (warm, *more):
        env.close()
    return {
        "memory of an environment": (total - before) / envs,
        "growth over the resets": before - first,
        "memory in all": total,
    }


def _pose(env: FourFingerGrasp) -> tuple[Any, ...]:
    return bullet.getBasePositionAndOrientation(
        env.scene.simulator.world.object, env.scene.simulator.client.number
    )


def _resident() -> float:
    """Return the resident memory of this process [MiB]."""
    gc.collect()
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


_USUAL = f'case == "step" and method == "{USUAL}"'


def _reset(label: str, methods: str, most: float) -> Claim:
    query = f"case == 'reset' and method {methods}"
    return Claim(f"reset, {label}, median", query, "milliseconds_median", "<", most, unit="ms")


def _memory(label: str, query: str, most: float) -> Claim:
    return Claim(label, query, "mebibytes_max", "<", most, unit="MiB")


def _growth(label: str, method: str) -> Claim:
    query = f"case == 'growth over the resets' and method == '{method}'"
    return _memory(f"growth over the resets, {label}", query, 1.0)


BENCHMARK = Benchmark(
    run,
    EnvSettings(),
    quick={"rounds": 4, "resets": 40, "envs": 2},
    shown=(
        "per_second_max",
        "microseconds_median",
        "ratio_median",
        "ratio_low",
        "ratio_high",
        "milliseconds_median",
        "milliseconds_p99",
        "mebibytes_max",
    ),
    claims=(
        Claim(
            "agent steps per second on one core, paper's pipeline, best episode",
            _USUAL,
            "per_second_max",
            ">=",
            1000.0,
        ),
        Claim(
            "cost of a step over the bare PyBullet calls, median of pairs",
            _USUAL,
            "ratio_median",
            "<=",
            1.25,
        ),
        _reset("same object shape", "!= 'new shape'", 5.0),
        _reset("new object shape", "== 'new shape'", 40.0),
        _memory("memory per environment", "case == 'memory of an environment'", 60.0),
        _growth("same object", "same object"),
        _growth("new shapes", "new shape"),
    ),
)
