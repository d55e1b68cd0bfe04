"""The start of an episode: the fingers approach, touch the object, and take over its weight."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

import numpy as np

from grasp_env.control.loop import ForceLoop, critically_damped
from grasp_env.errors import SimulationError
from grasp_env.inputs.arguments import Array
from grasp_env.sim.scene import Scene
from grasp_env.task.motion import resting_target

CLOSING_TIME, SETTLING_TIME = 4.0, 0.6
"""Longest times [s] until every finger touches, and until the hand carries the weight at rest."""
# speed [m/s] and distance [m] below which the object is at rest in its place
_STILL, _PLACED = 2e-3, 3e-5
_WATCHED = 8  # control ticks between looks at what hinders the fingers
_QUIET, _SETTLED = 8, 4  # control ticks in a row at rest: of the fingers, of the object
# joint speed [rad/s] and kinetic energy [J] below which the fingers are at rest
_SLOW, _ENERGY = 0.1, 1e-5
_WEIGHT_ERROR = 0.01
# [s] over which contact forces are averaged: single steps of an engine chatter. In the second half
# of the settling the longer time counts, too: the speed of light objects chatters, but not their
# place
_MEAN_TIME, _LONG_TIME = 4e-3, 0.05
_NEAR, _LOST = 1e-3, 5e-3  # [m] from its place: accepted at the end of the settling; lost
_AT_LIMIT = 1.0 - 1e-6  # share of a torque limit that counts as the limit
_END, _STRAY = 5e-3, 0.05  # angle from a joint's limit [rad]; force of links on the object [N]
# [rad/s] bandwidth of the fixture that holds the object until the hand does
_FIXTURE_BANDWIDTH = 100.0
# [kg]: lighter objects get the second mass in the fixture, where they would be pushed around
_LIGHT, _LOADED = 0.1, 0.3


def close_hand(scene: Scene, loop: ForceLoop) -> None:
    """Bring all tips into contact while a fixture holds the object.

    Raises:
        SimulationError: a finger does not arrive in time.
    """
    loop.begin(scene)
    mass = scene.config.object.mass
    if mass < _LIGHT:
        scene.change_object(_LOADED)
    try:
        _close(scene, loop)
    finally:
        if mass < _LIGHT:
            scene.change_object(mass)


def _close(scene: Scene, loop: ForceLoop) -> None:
    target = resting_target(1)[0]
    steady = 0
    fixture = critically_damped(scene.config.object, _FIXTURE_BANDWIDTH, _FIXTURE_BANDWIDTH)
    for _ in range(round(CLOSING_TIME / loop.dt)):
        torques = loop.reach(scene.gravity, target)
        scene.look()
        scene.advance(torques, [-x for x in fixture.wrench(scene.core, target, scene.gravity)])
        arrived = scene.look().touching.all() and _slow(scene)
        steady = steady + 1 if arrived else 0
        if steady == _QUIET:
            return
    raise SimulationError(
        f"the fingers did not come to rest on the object in {CLOSING_TIME} s: "
        + _causes(
            scene,
            _weak(scene, loop),
            _obstacles(scene),
            "they push it about: make it heavier or less slender",
            False,
        )
    )


def _slow(scene: Scene) -> bool:
    """True if the fingers are nearly at rest, also in energy: heavy ones would carry the object."""
    snapshot = scene.look()
    rates = snapshot.rates
    if not np.abs(rates).max() < _SLOW:
        return False
    return float(rates @ scene.kinematics.mass_matrix(snapshot.angles) @ rates) < 2.0 * _ENERGY


def take_over(scene: Scene, loop: ForceLoop) -> None:
    """Remove the fixture and let the force loop carry the weight until everything is at rest.

    Raises:
        SimulationError: the hand or the object does not come to rest.
    """
    loop.reset()
    target = resting_target(1)[0]
    steady = 0
    every = round(loop.config.controller.rate / loop.config.agent.rate)
    weight = scene.config.object.mass * scene.gravity
    scale = float(np.linalg.norm(weight))
    error = np.inf
    ticks = round(SETTLING_TIME / loop.dt)
    few = max(1, round(_MEAN_TIME / loop.dt))
    totals: deque[Array] = deque(maxlen=max(few, round(_LONG_TIME / loop.dt)))
    in_place = 0  # ticks in a row
    latest = ticks - 2 * _SETTLED
    weak = set[int]()
    obstacles = list[str]()  # while the object was in its place: afterwards they are consequences

    def imbalance(forces: Collection[Array]) -> float:
        """Return what the mean of sums of contact forces misses of the weight, as a share of it."""
        missing = float(np.linalg.norm(np.mean([*forces], axis=0) + weight))
        return missing / (scale or max(float(np.abs(scene.look().forces).sum()), 1e-9))

    for tick in range(ticks):
        loop.begin_step()
        torques = loop.tick(np.zeros(6), scene.gravity, target, due=tick % every == 0)
        weak |= _weak(scene, loop)
        scene.advance(torques, None)
        snapshot = scene.look()
        totals.append(snapshot.rotation @ snapshot.forces.sum(axis=0))
        error = imbalance([*totals][-few:])
        still = (
            np.abs(snapshot.linear).max() < _STILL
            and snapshot.touching.all()
            and error < _WEIGHT_ERROR
            and not loop.controller.rising
        )
        away = np.abs(snapshot.position).max()
        if tick % _WATCHED == 0 and away < _NEAR:
            obstacles = _obstacles(scene)
        # fingers that cannot push in every direction leave the object slightly displaced
        steady = steady + 1 if still and away < (_PLACED if tick < latest else _NEAR) else 0
        in_place = in_place + 1 if snapshot.touching.all() and away < _PLACED else 0
        if steady == _SETTLED:
            return
        late = 2 * tick > ticks and in_place >= len(totals) and not loop.controller.rising
        if late and imbalance(totals) < _WEIGHT_ERROR:
            return
        if away > _LOST:
            break
    friction = (
        f"the contact forces miss the weight by {error:.1%} ({_WEIGHT_ERROR:.0%} allowed), with forces for {loop.margin.friction:.0%} of "
        f"the friction {loop.friction / loop.margin.friction:.3g}: lower friction_margin, raise barrier_weight, or make the object lighter"
    )
    raise SimulationError(
        f"the grasp did not settle within {SETTLING_TIME} s: {_causes(scene, weak, obstacles, friction, True)}"
    )


def _weak(scene: Scene, loop: ForceLoop) -> set[int]:
    """Return the joints whose motors give all they can and cannot hold the object."""
    limits = scene.kinematics.torque_limits
    at_limit = np.flatnonzero(np.abs(loop.torques) >= _AT_LIMIT * limits)
    return set(at_limit.tolist()) if loop.effort.saturated else set()


def _obstacles(scene: Scene) -> list[str]:
    """Return what hinders the fingers in their posture, with remedies."""
    snapshot = scene.look()
    hand = scene.config.hand
    joints = hand.joint_names
    kinematics = scene.kinematics
    angles = snapshot.angles
    names = [hand.palm.name, *(link.name for link in hand.links)]
    causes = []
    contacts = scene.simulator.self_contacts()
    pairs = [f"{names[first + 1]} and {names[second + 1]}" for first, second in contacts]
    if pairs:
        causes.append(
            f"links push each other: {', '.join(pairs)}. Give contact_points or a home posture that keep them apart"
        )
    span = kinematics.upper - kinematics.lower
    left = np.minimum(angles - kinematics.lower, kinematics.upper - angles)
    near = np.flatnonzero(left < np.minimum(_END, 0.01 * span))
    if len(near):
        listed = ", ".join(f"{joints[j]} ({angles[j]:.3f} {hand.links[j].units[0]})" for j in near)
        causes.append(
            f"joints at the ends of their ranges: {listed}. Give contact_points or a home posture away from these"
        )
    if snapshot.stray[0] > _STRAY:
        causes.append(
            f"links push the object with {snapshot.stray[0]:.2g} N besides the fingertips. Give contact_points that tips reach alone"
        )
    return causes


def _causes(
    scene: Scene, weak: set[int], obstacles: list[str], otherwise: str, settling: bool
) -> str:
    """Return the likely causes of a failed grasp, with remedies; `weak`: joints of weak motors."""
    snapshot = scene.look()
    hand = scene.config.hand
    limits = scene.kinematics.torque_limits
    causes = []
    if weak:
        listed = ", ".join(
            f"{hand.joint_names[j]} ({limits[j]:g} {hand.links[j].units[1]})" for j in sorted(weak)
        )
        causes.append(
            f"joints at their torque limits: {listed}. No force within them carries the object where it is: raise torque_limit, make "
            "the object lighter or rougher, or grasp it elsewhere"
        )
    causes += obstacles
    if not causes and settling:
        return otherwise
    if not snapshot.touching.all():
        listed = ", ".join(
            f"{hand.finger_names[i]} ({1e3 * snapshot.gaps[i]:.2f} mm)"
            for i in np.flatnonzero(snapshot.touching == 0)
        )
        causes.append(
            f"fingers that do not touch, with their gaps: {listed}. Give contact_points that they reach unhindered"
        )
    return "; ".join(causes or [otherwise])
