"""A hand in a PyBullet server, and which of its joints is which."""

from __future__ import annotations

import os
import tempfile

from grasp_env.errors import SimulationError
from grasp_env.sim.client import bullet, silenced
from grasp_env.sim.hand import HandDescription
from grasp_env.sim.urdf import hand_urdf

HAND_FLAGS: int = (
    bullet.URDF_USE_INERTIA_FROM_FILE
    | bullet.URDF_USE_SELF_COLLISION
    | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT  # neighbours overlap around their joint
)


def load_hand(client: int, hand: HandDescription) -> int:
    """Load a hand, its palm fixed, and return its body number.

    Raises:
        SimulationError: PyBullet does not load the hand's URDF.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "hand.urdf")
        with open(path, "w", encoding="utf-8") as file:
            file.write(hand_urdf(hand))
        try:
            with silenced():
                return bullet.loadURDF(path, useFixedBase=True, flags=HAND_FLAGS, physicsClientId=client)
        except bullet.error as error:
            raise SimulationError(f"PyBullet did not load the hand {hand.name!r}: {error}") from None


def joint_indices(client: int, body: int, hand: HandDescription) -> list[int]:
    """PyBullet's index of every joint of the hand, (M,); a link has the index of its joint.

    Raises:
        SimulationError: The body is not this hand.
    """
    count = bullet.getNumJoints(body, physicsClientId=client)
    names = [bullet.getJointInfo(body, index, physicsClientId=client)[1].decode() for index in range(count)]
    missing = [name for name in hand.joint_names if name not in names]
    if missing:
        raise SimulationError(f"body {body} is not the hand {hand.name!r}: it lacks the joints {', '.join(missing)}")
    return [names.index(name) for name in hand.joint_names]


def links_of_indices(indices: list[int]) -> list[int]:
    """The other way: the number of our link for each of PyBullet's link indices, -1 for the palm and its parts.

    The last entry answers index -1, PyBullet's base.

    Example:
        >>> links_of_indices([2, 0, 1])
        [1, 2, 0, -1]
    """
    links = [-1] * (max(indices) + 2)
    for link, index in enumerate(indices):
        links[index] = link
    return links
