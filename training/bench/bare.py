"""The bare PyBullet calls of an episode: recorded, and made again without anything else."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from grasp_env.env.env import FourFingerGrasp
from grasp_env.sim.client import bullet
from training.data.episodes import episode

STEPS = 100
"""Of the agent, in an episode that is timed."""
Recorded = list[tuple[list[float], list[float] | None]]


def record(env: FourFingerGrasp, seed: int) -> Recorded:
    """Torques and wrench of every physics step of the first `STEPS` agent steps."""
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


def bare_loop(env: FourFingerGrasp, recorded: Recorded) -> tuple[int, int]:
    """The calls that `Scene.advance` and `Scene.look` make, and nothing else; nanoseconds of writes with steps, of reads.

    Of an environment whose physics runs at its control rate.
    """
    simulator = env.scene.simulator
    world, client = simulator.world, simulator.client.number
    hand, body, joints = world.hand, world.object, world.joints
    mode, frame, origin = bullet.TORQUE_CONTROL, bullet.LINK_FRAME, (0.0, 0.0, 0.0)
    clock, writes, reads = time.perf_counter_ns, 0, 0
    for torques, wrench in recorded:
        begin = clock()
        bullet.setJointMotorControlArray(hand, joints, mode, forces=torques, physicsClientId=client)
        if wrench is not None:
            bullet.applyExternalForce(body, -1, wrench[:3], origin, frame, client)
            bullet.applyExternalTorque(body, -1, wrench[3:], frame, client)
        bullet.stepSimulation(client)
        middle = clock()
        bullet.getJointStates(hand, joints, client)
        bullet.getBasePositionAndOrientation(body, client)
        bullet.getBaseVelocity(body, client)
        bullet.getContactPoints(hand, body, physicsClientId=client)
        end = clock()
        writes += middle - begin
        reads += end - middle
    return writes, reads
