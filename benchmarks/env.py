"""Comparison of the environment with the bare PyBullet calls of the same episode: steps per second,
resets, memory.
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
        rows += steps_beside_bare(
            name, options, settings.seed, settings.rounds if name == USUAL else fewer
        )
    tick("steps through gym.make")
    rows += steps_beside_bare(
        f"{USUAL}, gym.make", {}, settings.seed, settings.rounds, wrapped=True
    )
    for name, options in RESETS.items():
        tick(f"resets: {name}")
        rows += reset_times(name, options, settings.seed, max(20, settings.resets // 4))
    for name in ("same object", "new shape"):
        tick(f"memory over {settings.resets} resets: {name}")
        rows += memory_of(name, RESETS[name], settings.resets, settings.envs)
    return table(rows)


def make(options: dict[str, Any], wrapped: bool = False) -> Any:
    """An environment; `initial_force="learned"` is the shipped network."""
    if options.get("initial_force") == "learned":
        options = {**options, "initial_force": LearnedInitialForce.pretrained()}
    return (
        gym.make("grasp_env:FourFingerGrasp-v0", **options)
        if wrapped
        else FourFingerGrasp(**options)
    )


def steps_beside_bare(
    name: str, options: dict[str, Any], seed: int, rounds: int, wrapped: bool = False
) -> list[Row]:
    """Return microseconds of an agent step and of its PyBullet calls alone, measured in turns.

    The bare loop repeats the recorded episode: the same torques and wrenches from the same state,
    and the same readings, so it has the same contacts. A check requires the same final pose, bit by
    bit.
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
            ratio = ours / bare
            rate = 1e6 / ours
            rows.append(
                {**row, "case": "step", "microseconds": ours, "per_second": rate, "ratio": ratio}
            )
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
    """Nanoseconds of the calls that `Scene.advance` and `Scene.look` make, and nothing else.

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
    """Milliseconds of `reset`, closing the fingers included."""
    env = make(options)
    try:
        rows: list[Row] = []
        for k in range(count + 5):
            begin = time.perf_counter_ns()
            env.reset(seed=seed + k)
            taken = 1e-6 * (time.perf_counter_ns() - begin)
            rows.append({"case": "reset", "method": name, "problem": k - 5, "milliseconds": taken})
        return rows[5:]  # the first are warm-up
    finally:
        env.close()


def memory_of(name: str, options: dict[str, Any], resets: int, envs: int) -> list[Row]:
    """Measure resident memory in a separate process: of an environment, and its growth over
    `resets` resets.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        found = pool.submit(weigh, options, resets, envs).result()
    return [{"case": case, "method": name, "mebibytes": value} for case, value in found.items()]


def weigh(options: dict[str, Any], resets: int, envs: int) -> dict[str, float]:
    """Return the memory of this process by purpose [MiB]."""
    # code and the first reset's caches belong to the process, not to an environment
    warm = make(options)
    for k in range(max(20, resets // 10)):
        warm.reset(seed=k)
    first = _resident()
    for k in range(resets):
        warm.reset(seed=1000 + k)
    before = _resident()
    made = [make(options) for _ in range(envs)]
    for k, env in enumerate(made):
        env.reset(seed=k)
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    all_of_it = _resident()
    per_env = (all_of_it - before) / envs
    growth = before - first
    found = {
        "memory of an environment": per_env,
        "growth over the resets": growth,
        "memory in all": all_of_it,
    }
    for env in (warm, *made):
        env.close()
    return found


def _pose(env: FourFingerGrasp) -> tuple[Any, ...]:
    return bullet.getBasePositionAndOrientation(
        env.scene.simulator.world.object, env.scene.simulator.client.number
    )


def _resident() -> float:
    """Resident memory of this process [MiB]."""
    gc.collect()
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


_USUAL = f'case == "step" and method == "{USUAL}"'
_GROWTH = "case == 'growth over the resets' and method == '{}'"
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
        Claim(
            "reset, same object shape, median",
            "case == 'reset' and method != 'new shape'",
            "milliseconds_median",
            "<",
            5.0,
            unit="ms",
        ),
        Claim(
            "reset, new object shape, median",
            "case == 'reset' and method == 'new shape'",
            "milliseconds_median",
            "<",
            40.0,
            unit="ms",
        ),
        Claim(
            "memory per environment",
            "case == 'memory of an environment'",
            "mebibytes_max",
            "<",
            60.0,
            unit="MiB",
        ),
        Claim(
            "growth over the resets, same object",
            _GROWTH.format("same object"),
            "mebibytes_max",
            "<",
            1.0,
            unit="MiB",
        ),
        Claim(
            "growth over the resets, new shapes",
            _GROWTH.format("new shape"),
            "mebibytes_max",
            "<",
            1.0,
            unit="MiB",
        ),
    ),
)
