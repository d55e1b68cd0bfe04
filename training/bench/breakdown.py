"""Where the time of an agent step goes: exclusive times of its pieces, and of the PyBullet calls inside them.

The calls cost more between other code than in a loop of their own: the processor's caches and its branch predictor hold less of
Bullet then. That part is shown apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from grasp_env.env.env import FourFingerGrasp
from grasp_env.sim import bullet as engine
from training.bench.bare import STEPS, bare_loop, record

_WRITES = ("setJointMotorControlArray", "applyExternalForce", "applyExternalTorque", "stepSimulation")
_READS = ("getJointStates", "getBasePositionAndOrientation", "getBaseVelocity", "getContactPoints")
PARTS = {
    "bare_writes": "PyBullet alone: torques, wrench, stepSimulation",
    "bare_reads": "PyBullet alone: joints, object, contacts",
    "writes": "the former called between other code: caches",
    "reads": "the latter called between other code: caches",
    "look": "reading: numbers of the calls into an array, snapshot",
    "advance": "writing: arguments of the calls",
    "optimise": "force optimisation: contacts, start, flow, certificate",
    "tick": "the rest of a control tick: what is seen, the wrench to balance, tangent correction, torques",
    "observe": "observation",
    "info": "info dictionary",
    "step": "the rest: checks, disturbance, reward, loop",
}


class Stopwatch:
    """Exclusive nanoseconds by name, of calls that may contain each other."""

    def __init__(self) -> None:
        self.spent: dict[str, int] = {}
        self.calls: dict[str, int] = {}
        self._inner = [0]
        self.cost = 0

    def around(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """`call`, timed under `name`."""
        self.spent.setdefault(name, 0)
        self.calls.setdefault(name, 0)

        def timed(*arguments: Any, **keywords: Any) -> Any:
            self._inner.append(0)
            begin = time.perf_counter_ns()
            try:
                return call(*arguments, **keywords)
            finally:
                taken = time.perf_counter_ns() - begin
                self.spent[name] += taken - self._inner.pop()
                self.calls[name] += 1
                self._inner[-1] += taken + self.cost

        return timed

    def calibrate(self) -> None:
        """Measures `cost` [ns], what the watch itself adds to a call's surroundings; it is left out of all parts."""
        nothing, number = self.around("nothing", lambda: None), 20_000
        begin = time.perf_counter_ns()
        for _ in range(number):
            nothing()
        self.cost = (time.perf_counter_ns() - begin - self.spent["nothing"]) // number
        del self.spent["nothing"], self.calls["nothing"]


class TimedModule:
    """A module whose functions `names` are timed together under `part`; the rest is as it was."""

    def __init__(self, module: Any, watch: Stopwatch, part: str, names: tuple[str, ...]) -> None:
        self._module = module
        for name in names:
            setattr(self, name, watch.around(part, getattr(module, name)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


def breakdown(env: FourFingerGrasp, seed: int, rounds: int) -> list[dict[str, Any]]:
    """Microseconds per agent step of each piece, best of `rounds` episodes, and of as many bare loops; closes `env`.

    Returns:
        [{part, what, us, calls, share}], the bare PyBullet calls first; `calls` is per agent step.
    """
    whole: Any = env
    action = np.zeros(env.action_space.shape or (), dtype=np.float32)
    patched: Any = engine
    bullet = patched.bullet
    try:
        recorded = record(env, seed)
        found: list[tuple[dict[str, int], dict[str, int]]] = []
        alone: list[tuple[int, int]] = []
        for _ in range(rounds + 1):
            env.reset(seed=seed)
            writes, reads = bare_loop(env, recorded)
            watch = Stopwatch()
            watch.calibrate()
            scene, loop = whole.scene, whole._loop
            places = (
                (scene, "look", "look"), (scene, "advance", "advance"), (loop, "optimise", "optimise"), (loop, "tick", "tick"),
                (whole, "_observe", "observe"), (whole, "_info", "info"),
            )  # fmt: skip
            env.reset(seed=seed)
            for owner, method, name in places:
                setattr(owner, method, watch.around(name, getattr(owner, method)))
            patched.bullet = TimedModule(TimedModule(bullet, watch, "reads", _READS), watch, "writes", _WRITES)
            try:
                step = watch.around("step", env.step)
                for _ in range(STEPS):
                    step(action)
            finally:
                patched.bullet = bullet
                for owner, method, _ in places:
                    delattr(owner, method)
            alone.append((writes, reads))
            found.append((watch.spent, watch.calls))
        spent, calls = min(found[1:], key=lambda pair: sum(pair[0].values()))  # the first is warm-up
        spent["bare_writes"], spent["bare_reads"] = min(alone[1:], key=sum)
        spent["writes"] -= spent["bare_writes"]
        spent["reads"] -= spent["bare_reads"]
        total = sum(spent.values())
        return [
            {
                "part": name, "what": what, "us": 1e-3 * spent[name] / STEPS, "calls": calls.get(name, 0) / STEPS,
                "share": spent[name] / total,
            }
            for name, what in PARTS.items()
        ]  # fmt: skip
    finally:
        env.close()
