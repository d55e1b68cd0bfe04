"""Soft fingertips under shear and torsion at once: a gripper, and a load for each seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.inputs.arguments import Array
from grasp_env.sim import HandKinematics
from grasp_env.sim.grasping.pads import PATCH_RADIUS, torsion_of
from grasp_env.sim.grasping.points import grasp_points
from grasp_env.sim.hand.description import Fingertip, Geometry, HandDescription, Link, Palm
from grasp_env.task.motion import blend

SQUEEZE = 30.0
"""Sum of the normal forces [N] at which a share of 1 is all that the margin allows."""
SIZES, BALANCE = (0.3, 1.0), (0.85, 1.0)
"""Ranges of the share of a load, and of its shear and its torsion relative to that.

If both are this close, forces within separate bounds on shear and torsion use up to sqrt(2) times
what the cone allows, which bounds both together.
"""
RAMP = 0.25
"""Time in which a load grows [s]."""
MOST_SLIDE = 1e-3
"""Largest distance that the middle and the rim of a pad may slide [m]."""
_WORD = 0x50F7  # first word of the seeds


@dataclass(frozen=True)
class Twist:
    """A disturbance: a force that turns once about an axis, and a constant moment about it.

    Attributes:
        axes: (3, 3) rows: the axis, and two directions across it, object frame.
        force, moment: sizes [N], [N m]; the moment may be negative.
        weight: (3,) force of gravity [N], which the force replaces.
    """

    axes: tuple[tuple[float, ...], ...]
    force: float
    moment: float
    weight: tuple[float, ...]

    def __call__(self, times: Array, rng: np.random.Generator, settings: Any) -> Array:
        """See `grasp_env.task.Disturbance`."""
        axis, first, second = np.array(self.axes)
        turn = 2.0 * np.pi * times / max(float(times[-1]), RAMP)
        push = self.force * (np.outer(np.cos(turn), first) + np.outer(np.sin(turn), second))
        moment = np.tile(self.moment * axis, (len(times), 1))
        return blend(times / RAMP)[0][:, None] * np.hstack([push - self.weight, moment])


def jaws() -> HandDescription:
    """Return a parallel gripper around the origin: two jaws that slide along x, a motor each.

    Example:
        >>> jaws().finger_count, jaws().joint_count
        (2, 2)
    """
    links, tips = list[Link](), list[Fingertip]()
    for name, side in (("left", -1.0), ("right", 1.0)):
        ball = Geometry("sphere", (0.008,), (0.008 * side, 0.0, 0.0))
        finger = Geometry("box", (0.02, 0.02, 0.1), (0.02 * side, 0.0, 0.04))
        links.append(
            Link(
                name,
                "palm",
                origin=(0.0, 0.0, 0.0),
                rotation=(0.0, 0.0, 0.0),
                axis=(side, 0.0, 0.0),
                lower=0.0,
                upper=0.06,
                torque_limit=80.0,
                mass=0.1,
                center=finger.origin,
                inertia=(1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-5),
                collision=(finger, ball),
                sliding=True,
            )
        )
        tips.append(Fingertip(name, name, ball.origin, 0.008))
    palm = Palm(collision=(Geometry("box", (0.2, 0.06, 0.04), (0.0, 0.0, 0.12)),))
    return HandDescription("jaws", palm, tuple(links), tuple(tips), (0.03, 0.03))


def with_load(config: EnvConfig, seed: int) -> EnvConfig:
    """Return settings with soft pads on the tips, the load of a seed, and limits of sliding.

    The axis runs from the first tip to the middle of the others. Shear and torsion are each 0.26 to
    1 of what the controller's margin allows at `SQUEEZE`.
    """
    hand = config.hand_description
    item = replace(config.object, torsional_friction=torsion_of(config.object.friction))
    points = np.asarray(config.contact_points)
    if not points.size:
        points = np.asarray(
            grasp_points(item, HandKinematics(hand), None, config.controller.friction_margin)[0]
        )
    rng = np.random.default_rng([seed, _WORD])
    axis = points[1:].mean(axis=0) - points[0]
    axis /= np.linalg.norm(axis)
    first = np.cross(axis, rng.standard_normal(3))
    first /= np.linalg.norm(first)
    size = rng.uniform(*SIZES)
    shear, torsion = size * rng.uniform(*BALANCE, 2)
    most = config.controller.friction_margin * hand.tip_friction * SQUEEZE
    load = Twist(
        tuple(map(tuple, np.array([axis, first, np.cross(axis, first)]).tolist())),
        float(shear * most * item.friction),
        float(rng.choice([-1.0, 1.0]) * torsion * most * item.torsional_friction),
        tuple((item.mass * np.array(config.gravity)).tolist()),
    )
    limits = {"limits.max_slide": MOST_SLIDE, "limits.max_tilt": MOST_SLIDE / PATCH_RADIUS}
    return config.override(
        object=item, contact_points=points, disturbance=load, randomize=(), **limits
    )


GRIPPERS: dict[str, Callable[[], HandDescription]] = {"jaws": jaws}
"""Hands of the scenarios that are not built in, by name."""
