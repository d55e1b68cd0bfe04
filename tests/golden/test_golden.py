"""An episode of the simulated hand against its record; run as a program, with `PYTHONPATH=.:tests`,
it writes the record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engines import needs_bullet

RECORD = Path(__file__).with_name("environment.npz")
SETTINGS: dict[str, Any] = {
    "agent.rate": 250,
    "task": {"name": "move", "motion": "shake", "period": 0.4},
    "disturbance": "impulses",
    "disturbance.interval": 0.05,
    "randomize": ("mass", "friction"),
    "gravity": (2.0, -9.0, 1.0),
    "sensors.wrench": "estimated",
    "sensors.delay": 0.008,
    "sensors.tactile_noise": 0.05,
    "sensors.pose_noise": 1e-5,
    "motors.noise": 0.01,
    "controller.friction_error": 0.1,
    "controller.friction_margin": 0.7,
    "solver.barrier_weight": 0.05,
    "method": "newton",
    "solver.tolerance": 1e-15,
}
"""Everything that acts on an episode, solved to the last digits; not the search for contacts, which
rounding may change."""
TICKS = 40
CLOSE = 1e-6
"""Largest difference as a share of a quantity's largest entry.

A last digit of gravity moves forces by 4e-9; observations are float32.
"""


def trajectory(**settings: Any) -> dict[str, np.ndarray]:
    """Arrays (TICKS, K) by name, in the order in which a tick computes them; one agent step is one
    control tick."""
    from grasp_env.env import FourFingerGrasp

    env = FourFingerGrasp(**SETTINGS | settings)
    env.reset(seed=1)
    _, info = env.reset(seed=5)  # the second reset, so that nothing depends on earlier episodes
    drawn = [info[name] for name in ("object_mass", "object_friction", "object_size")]
    advance = env.scene.advance
    received = []
    rows = []

    def listen(torques: list[float], wrench: list[float] | None) -> None:
        received[:] = [np.zeros(6) if wrench is None else wrench, torques]
        advance(torques, wrench)

    env.scene.advance = listen  # type: ignore[method-assign]
    for tick in range(TICKS):
        observed, _, _, _, info = env.step(np.full(6, 0.3 * (-1) ** tick, dtype=np.float32))
        costs = [
            value
            for name, value in info.items()
            if name.startswith("reward/") and name != "reward/iterations"
        ]
        rows.append(
            {
                "drawn object": drawn,
                "external wrench": received[0],
                "wrench to balance": info["wrench"],
                "commanded force": info["commanded_force"],
                "delivered torques": received[1],
                "measured force": info["measured_force"],
                "object motion": observed[6:18],
                "contacts": observed[18:42],
                "joint angles": observed[70:82],
                "observation": observed,
                "reward": costs,
            }
        )
    env.close()
    return {
        name: np.array([np.ravel(row[name]) for row in rows], dtype=np.float64) for name in rows[0]
    }


def first_difference(now: dict[str, np.ndarray], then: dict[str, np.ndarray]) -> str:
    """Return the first quantity that differs, with its tick; empty if all agree."""
    for tick in range(TICKS):
        for name, recorded in then.items():
            off = np.abs(now[name][tick] - recorded[tick]).max()
            largest = np.abs(recorded).max()
            if not off <= CLOSE * largest:
                return f"{name} moved first, at tick {tick}: by {off:.3g}, its largest is {largest:.3g}"
    return ""


@pytest.fixture(scope="module")
def recorded():
    with np.load(RECORD, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@needs_bullet
def test_an_episode_is_as_recorded(recorded):
    assert first_difference(trajectory(), recorded) == ""


if __name__ == "__main__":
    np.savez_compressed(RECORD, **trajectory())  # type: ignore[arg-type]
