"""Which links of a hand touch each other whatever it does: those are not to collide."""

from __future__ import annotations

import math
import os
import tempfile
from functools import lru_cache

import numpy as np

from grasp_env._check import Array
from grasp_env.sim.client import Client, bullet
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.urdf import HULL_MARGIN, hand_files

_POSTURES = 24


@lru_cache(maxsize=64)
def touching_pairs(hand: HandDescription) -> frozenset[tuple[int, int]]:
    """Pairs of links, the smaller number first and -1 the palm, that no simulation and no search lets collide.

    Those one of which carries the other; those that overlap in half of `_POSTURES` postures spread over the joints' ranges: their
    shapes are coarser than they are; and, of a hand that is placed, those that overlap at `home`.

    Example:
        >>> (0, 1) in touching_pairs(HandDescription.four_finger())
        True
    """
    numbers = {hand.palm.name: -1} | {link.name: index for index, link in enumerate(hand.links)}
    pairs = {(numbers[link.parent], index) for index, link in enumerate(hand.links)}
    postures = _spread(hand)
    counts: dict[tuple[int, int], int] = {}
    for index, overlapping in enumerate(_overlaps(hand, postures)):
        for pair in overlapping:
            counts[pair] = counts.get(pair, 0) + 1
            if index == 0 and hand.placed:
                pairs.add(pair)
    pairs |= {pair for pair, count in counts.items() if 2 * count >= len(postures)}
    return frozenset(pairs)


def _spread(hand: HandDescription) -> Array:
    """Home, then postures all over the ranges of the joints (S, M), the same in every process."""
    kinematics = HandKinematics(hand)
    lower, upper = np.maximum(kinematics.lower, -math.pi), np.minimum(kinematics.upper, math.pi)
    parts = (np.outer(np.arange(1, _POSTURES), np.sqrt(_PRIMES[: len(lower)])) + 0.5) % 1.0
    angles = np.vstack([kinematics.home, lower + parts * (upper - lower)])
    for index, (link, driver) in enumerate(zip(hand.links, hand.drivers, strict=True)):
        if link.mimic is not None:
            angles[:, index] = link.mimic.ratio * angles[:, driver] + link.mimic.offset
    return angles


def _overlaps(hand: HandDescription, postures: Array) -> list[set[tuple[int, int]]]:
    """Pairs of links that overlap in each posture, neighbours left out."""
    client = Client(False)
    try:
        with tempfile.TemporaryDirectory() as folder:
            for name, text in hand_files(hand.unseen(), HULL_MARGIN).items():
                with open(os.path.join(folder, name), "w", encoding="utf-8") as file:
                    file.write(text)
            flags = bullet.URDF_USE_SELF_COLLISION | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
            body = bullet.loadURDF(
                os.path.join(folder, "hand.urdf"), useFixedBase=True, flags=flags, physicsClientId=client.number
            )
        names = [bullet.getJointInfo(body, index, client.number)[1].decode() for index in range(hand.joint_count)]
        links = [-1, *(hand.joint_names.index(name) for name in names)]
        found: list[set[tuple[int, int]]] = []
        for posture in postures.tolist():
            for index, name in enumerate(names):
                angle = posture[hand.joint_names.index(name)]
                bullet.resetJointState(body, index, angle, physicsClientId=client.number)
            bullet.performCollisionDetection(client.number)
            contacts = bullet.getContactPoints(body, body, physicsClientId=client.number)
            ends = ((links[contact[3] + 1], links[contact[4] + 1]) for contact in contacts if contact[8] < 0.0)
            found.append({(min(pair), max(pair)) for pair in ends})
        return found
    finally:
        client.close()


def _primes(count: int) -> Array:
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % prime for prime in found):
            found.append(number)
        number += 1
    return np.array(found, dtype=float)


_PRIMES = _primes(512)
