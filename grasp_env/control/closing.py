"""How an episode starts: the fingers approach, touch, and take over the object's weight."""

from __future__ import annotations

import numpy as np

from grasp_env.control.loop import ForceLoop, critically_damped
from grasp_env.errors import SimulationError
from grasp_env.sim.scene import Scene
from grasp_env.task.motion import resting_target

CLEARANCE = 0.003
"""[m] between tips and object before the fingers close."""
CLOSING_TIME, SETTLING_TIME = 0.6, 0.6
"""[s] at most until every finger touches, and until the hand carries the weight at rest."""
_STILL, _PLACED = 2e-3, 3e-5  # [m/s], [m] of the object, below which it is at rest in its place
_QUIET, _SETTLED = 8, 4  # control ticks in a row
_WEIGHT_ERROR = 0.01
_JIG = 100.0  # [rad/s], critically damped: what holds the object until the hand does


def close_hand(scene: Scene, loop: ForceLoop) -> None:
    """Brings all tips into contact while a jig holds the object.

    Raises:
        SimulationError: a finger did not arrive in `CLOSING_TIME`.
    """
    loop.begin(scene)
    target, quiet = resting_target(1)[0], 0
    jig = critically_damped(scene.config.object, _JIG, _JIG)
    for _ in range(round(CLOSING_TIME / loop.dt)):
        torques = loop.reach(scene.gravity, target)
        scene.look()
        scene.advance(torques, [-part for part in jig.wrench(scene.core, target, scene.gravity)])
        arrived = scene.look().touching.all() and np.abs(scene.look().rates).max() < 0.1
        quiet = quiet + 1 if arrived else 0
        if quiet == _QUIET:
            return
    snapshot = scene.look()
    touching = snapshot.touching.astype(bool)
    hint = (
        "they push it about: make it heavier or less slender"
        if touching.all()
        else "give contact_points that they reach unhindered"
    )
    raise SimulationError(
        f"the fingers did not come to rest on the object in {CLOSING_TIME} s: touching={touching.tolist()}, gaps "
        f"{(1e3 * snapshot.gaps).round(2).tolist()} mm; {hint}"
    )


def take_over(scene: Scene, loop: ForceLoop) -> None:
    """The jig is gone: the force loop carries the weight, until all is at rest.

    Raises:
        SimulationError: the object was lost, or the contact forces do not carry its weight within 1 %.
    """
    loop.reset()
    target, quiet = resting_target(1)[0], 0
    every = round(loop.config.control_rate / loop.config.agent_rate)
    weight = scene.config.weight
    scale = float(np.linalg.norm(weight))
    error = np.inf
    for tick in range(round(SETTLING_TIME / loop.dt)):
        torques = loop.tick(np.zeros(6), scene.gravity, target, due=tick % every == 0)
        scene.advance(torques, None)
        snapshot = scene.look()
        total = snapshot.rotation @ snapshot.forces.sum(axis=0)
        error = float(np.linalg.norm(total + weight)) / (scale or max(float(np.abs(snapshot.forces).sum()), 1e-9))
        still = np.abs(snapshot.linear).max() < _STILL and np.abs(snapshot.position).max() < _PLACED
        still = still and snapshot.touching.all()
        quiet = quiet + 1 if still and error < _WEIGHT_ERROR else 0
        if quiet == _SETTLED:
            return
    snapshot = scene.look()
    raise SimulationError(
        f"the grasp did not settle in {SETTLING_TIME} s: touching={snapshot.touching.astype(bool).tolist()}, the contact forces "
        f"miss the weight by {error:.1%} (1 % allowed); the solver believes in friction {loop.friction:.3g}, the object has "
        f"{scene.config.object.friction:.3g}: lower friction_margin or friction_error, raise barrier_weight or squeeze, or make "
        "the object lighter"
    )
