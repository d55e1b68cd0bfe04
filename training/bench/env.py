"""The environment beside the bare PyBullet calls of the same episode: steps per second, where the rest goes, resets, memory."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import SimulationError
from grasp_env.sim.client import bullet
from policies import LearnedInitialForce
from training.bench.bare import STEPS, bare_loop, record
from training.bench.breakdown import breakdown
from training.runs import provenance
from training.runs.claims import bounded

ROWS: dict[str, dict[str, Any]] = {
    "the paper's": {},
    "newton, previous": {"method": "newton", "initial_force": "previous"},
    "reduced_flow, learned": {"initial_force": "learned"},
    "random wrench": {"disturbance": "random"},
    "estimated wrench": {"disturbance": "random", "wrench": "estimated"},
    "constant squeeze": {"controller": "constant_squeeze"},
    "PD only": {"controller": "pd"},
}
NEW_OBJECT = ("shape", "size", "mass", "friction")
ASKED = {"per_second": 1000.0, "ratio": 1.25, "same_ms": 5.0, "new_ms": 40.0, "mib": 60.0, "growth_mib": 1.0}


def env_bench(seed: int = 0, quick: bool = False, tick: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Times steps and resets, weighs environments; all on one thread, warm-up excluded.

    Args:
        seed: of the episodes.
        quick: fewer rounds and resets; rough.
        tick: told what runs.

    Returns:
        {"rows": [{method, per_second, us, bare_us, ratio}], "parts": [...], "resets": [...], "memory": [...], "vector": [...],
        "claims": [...]}.
    """
    rounds, resets = (4, 40) if quick else (30, 1000)
    rows = []
    for name, settings in ROWS.items():
        tick(f"steps: {name}")
        rows.append(
            {
                "method": name,
                **steps_beside_bare(settings, seed, rounds if name == "the paper's" else max(4, rounds // 3)),
            }
        )
    tick("steps through gym.make")
    rows.insert(1, {"method": "the paper's, gym.make", **steps_beside_bare({}, seed, rounds, wrapped=True)})
    tick("where a step's time goes")
    parts = breakdown(make({}), seed, max(2, rounds // 3))
    times = []
    for name, settings in (
        ("same object", {}),
        ("same shape, new mass and friction", {"randomise": ("mass", "friction")}),
        ("new shape", {"randomise": NEW_OBJECT}),
    ):
        tick(f"resets: {name}")
        times.append({"reset": name, **reset_times(settings, seed, max(20, resets // 4))})
    memory = []
    for name, settings in (("same object", {}), ("new shapes", {"randomise": NEW_OBJECT})):
        tick(f"memory over {resets} resets: {name}")
        memory.append({"resets": name, **memory_of(settings, resets, envs=2 if quick else 8)})
    vector = []
    for kind in ("sync", "async"):
        tick(f"two environments, {kind}")
        vector.append({"vector": kind, "envs": 2, "per_second": vector_rate(kind, 200 if quick else 2000, seed)})
    return {
        "kind": "env", "quick": quick, "rates": [EnvConfig().agent_rate, EnvConfig().control_rate], "rows": rows, "parts": parts, "resets": times, "memory": memory, "vector": vector,
        "claims": claims(rows, times, memory), "load": os.getloadavg(), "provenance": provenance(),
    }  # fmt: skip


def make(settings: dict[str, Any], wrapped: bool = False) -> Any:
    """An environment; `initial_force="learned"` is the shipped network."""
    if settings.get("initial_force") == "learned":
        settings = {**settings, "initial_force": LearnedInitialForce.pretrained()}
    return gym.make("grasp_env:FourFingerGrasp-v0", **settings) if wrapped else FourFingerGrasp(**settings)


def steps_beside_bare(settings: dict[str, Any], seed: int, rounds: int, wrapped: bool = False) -> dict[str, Any]:
    """Microseconds per agent step, and of the PyBullet calls alone that the same episode makes, taking turns.

    The bare loop repeats the recorded episode: the same torques and wrenches from the same state, the same readings, so that it
    passes through the same contacts; that it ends at the same pose, bit by bit, is checked.
    """
    env = make(settings, wrapped)
    try:
        inner: FourFingerGrasp = env.unwrapped
        action = np.zeros(env.action_space.shape, dtype=np.float32)
        recorded = record(inner, seed)
        ours, bare = [], []
        for turn in range(rounds + 1):
            env.reset(seed=seed)
            begin = time.perf_counter_ns()
            for _ in range(STEPS):
                env.step(action)
            taken = time.perf_counter_ns() - begin
            pose = _pose(inner)
            env.reset(seed=seed)
            alone = sum(bare_loop(inner, recorded))
            if _pose(inner) != pose:
                raise AssertionError(
                    "the bare loop went another way than the environment: the comparison would not be fair"
                )
            if turn:  # the first is warm-up
                ours.append(1e-3 * taken / STEPS)
                bare.append(1e-3 * alone / STEPS)
        best, best_bare = min(ours), min(bare)
        return {
            "per_second": 1e6 / best, "us": best, "us_median": float(np.median(ours)), "bare_us": best_bare,
            "bare_us_median": float(np.median(bare)), "ratio": best / best_bare,
            "ratio_median": float(np.median(np.array(ours) / np.array(bare))), "rounds": rounds,
        }  # fmt: skip
    finally:
        env.close()


def reset_times(settings: dict[str, Any], seed: int, count: int) -> dict[str, Any]:
    """Milliseconds of `reset`, closing the fingers included: median, p99, worst."""
    env = make(settings)
    try:
        times = []
        for k in range(count + 5):
            begin = time.perf_counter_ns()
            env.reset(seed=seed + k)
            times.append(1e-6 * (time.perf_counter_ns() - begin))
        kept = np.array(times[5:])
        return {
            "resets": count, "median_ms": float(np.median(kept)), "mean_ms": float(kept.mean()),
            "p99_ms": float(np.percentile(kept, 99)), "max_ms": float(kept.max()),
        }  # fmt: skip
    finally:
        env.close()


def memory_of(settings: dict[str, Any], resets: int, envs: int) -> dict[str, Any]:
    """Resident memory in a process of its own: per environment, and growth of one over `resets` resets, in MiB."""
    call = f"from training.bench.env import weigh; weigh({settings!r}, {resets}, {envs})"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True)
    if done.returncode:
        raise SimulationError(
            f"weighing {settings} ended with: {(done.stderr.strip().splitlines() or ['nothing said'])[-1]}"
        )
    return {"count": resets, **json.loads(done.stdout)}


def weigh(settings: dict[str, Any], resets: int, envs: int) -> None:
    """Prints {"per_env_mib", "growth_mib", "resident_mib"} of this process."""
    warm = make(settings)  # code and the first reset's caches belong to the process, not to an environment
    for k in range(max(20, resets // 10)):
        warm.reset(seed=k)
    before = _resident()
    for k in range(resets):
        warm.reset(seed=1000 + k)
    growth = _resident() - before
    before = _resident()
    made = [make(settings) for _ in range(envs)]
    for k, env in enumerate(made):
        env.reset(seed=k)
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    per_env = (_resident() - before) / envs
    print(json.dumps({"per_env_mib": per_env, "growth_mib": growth, "resident_mib": _resident()}))
    for env in (warm, *made):
        env.close()


def vector_rate(kind: str, steps: int, seed: int) -> float:
    """Agent steps per second of two environments in a vector, resets included."""
    envs = gym.make_vec("grasp_env:FourFingerGrasp-v0", num_envs=2, vectorization_mode=kind)
    try:
        actions = np.zeros(envs.action_space.shape or (), dtype=np.float32)
        envs.reset(seed=seed)
        for _ in range(20):
            envs.step(actions)
        begin = time.perf_counter()
        for _ in range(steps):
            envs.step(actions)
        return 2 * steps / (time.perf_counter() - begin)
    finally:
        envs.close()


def claims(
    rows: list[dict[str, Any]], resets: list[dict[str, Any]], memory: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """What was asked of speed and memory, what was measured, and whether that is enough."""
    first, times, weights = rows[0], {row["reset"]: row for row in resets}, {row["resets"]: row for row in memory}
    same = max(times["same object"]["median_ms"], times["same shape, new mass and friction"]["median_ms"])
    heaviest = max(row["per_env_mib"] for row in memory)
    growth = [bounded(f"growth over the resets, {name}", "below", ASKED["growth_mib"], weights[name]["growth_mib"], "MiB")
              for name in ("same object", "new shapes")]  # fmt: skip
    return [
        bounded("agent steps per second on one core, paper's pipeline, best episode", "at least", ASKED["per_second"], first["per_second"]),
        bounded("cost of a step over the bare PyBullet calls, median of pairs", "at most", ASKED["ratio"], first["ratio_median"]),
        bounded("reset, same object shape, median", "below", ASKED["same_ms"], same, "ms"),
        bounded("reset, new object shape, median", "below", ASKED["new_ms"], times["new shape"]["median_ms"], "ms"),
        bounded("memory per environment", "below", ASKED["mib"], heaviest, "MiB"),
        *growth,
    ]  # fmt: skip


def _pose(env: FourFingerGrasp) -> tuple[Any, ...]:
    return bullet.getBasePositionAndOrientation(env.scene.simulator.world.object, env.scene.simulator.client.number)


def _resident() -> float:
    """Resident memory of this process [MiB]."""
    gc.collect()
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
