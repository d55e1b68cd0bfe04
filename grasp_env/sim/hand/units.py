"""A hand's numbers that are possible but look like another unit's, as `grasp_env.grasp.advise` has it for contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence

from grasp_env.sim.hand.tree import Fingertip, Link
from grasp_env.sim.hand.urdf_elements import names_of

LARGEST_TURN = 4.0 * math.pi
"""[rad] of a joint's range: two turns are more than any finger's hinge has."""
LARGEST_MASS = 5.0
"""[kg] of a link of a finger."""
LARGEST_TIP = 0.2
"""[m] radius of a fingertip."""


def look_again(links: Sequence[Link], tips: Sequence[Fingertip]) -> list[str]:
    """A sentence for each unit that looks wrong; nothing is changed."""
    found = {
        "the ranges of {} are wider than two turns: a URDF has radians, not degrees; look again": [
            link.joint for link in links if not link.sliding and LARGEST_TURN < link.upper - link.lower < math.inf
        ],
        f"{{}} weigh more than {LARGEST_MASS:g} kg each: a URDF has kilograms, not grams; look again": [
            link.name for link in links if link.mass > LARGEST_MASS
        ],
        f"the tips of {{}} have a radius above {LARGEST_TIP:g} m: a URDF has metres, not millimetres (scale of meshes, sizes); look again": [
            tip.name for tip in tips if tip.radius > LARGEST_TIP
        ],
    }
    return [text.format(names_of(names)) for text, names in found.items() if names]
