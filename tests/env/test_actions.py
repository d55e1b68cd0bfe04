"""What an agent's action reaches: every optimisation of its step, the first step too; and contacts that chatter."""

from __future__ import annotations

import numpy as np

from grasp_env.env.env import FourFingerGrasp
from grasp_env.task.motion import resting_target


def iterations(action: float, steps: int = 4) -> list[int]:
    env = FourFingerGrasp(disturbance="random")
    env.reset(seed=0)
    taken = [env.step(np.full(6, action, dtype=np.float32))[4]["iterations"] for _ in range(steps)]
    env.close()
    return taken


def test_the_first_step_takes_its_action() -> None:
    still, moved = iterations(0.0), iterations(-1.0)
    assert all(a != b for a, b in zip(still, moved, strict=True))


def test_one_missed_tick_does_not_let_a_finger_go() -> None:
    """RELEASE counts ticks in a row: three single misses with contact between them keep the finger."""
    env = FourFingerGrasp()
    env.reset(seed=0)
    env.step(np.zeros(6, dtype=np.float32))
    core, touching = env._loop._core, env.scene.look().touching
    still = (np.zeros(6), env.scene.gravity, resting_target(1)[0], None)
    for mask, held in (
        (14, 15),
        (15, 15),
        (15, 15),
        (14, 15),
        (15, 15),
        (14, 15),
        (15, 15),
        (14, 15),
        (14, 15),
        (14, 14),
    ):
        touching[:] = [mask >> finger & 1 for finger in range(4)]
        core.see(None, *still)
        assert core.mask == held
    env.close()
