"""The forces of an annotation as lines in PyBullet's own window, for render_mode "human"."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grasp_env.sim.client import bullet
from grasp_env.sim.picture.annotation import PALETTE, WRENCH_COLOR, WRENCH_STRETCH, Annotation


def draw_debug(client: int, annotation: Annotation, lines: Sequence[int] = ()) -> list[int]:
    """Draw or move one line per finger, from outside to its contact, and one for the wrench's force.

    Args:
        client: Number of the PyBullet connection; without a window nothing happens.
        annotation: What to draw; a contact that is not active gets a line of no length.
        lines: What the last call returned, to move those lines instead of adding more.

    Returns:
        PyBullet's numbers of the lines.
    """
    scale = annotation.force_scale
    colors = PALETTE if annotation.colors is None else annotation.colors
    lengths = scale * np.asarray(annotation.active)[:, None]
    ends = list(zip(annotation.points - lengths * annotation.forces, annotation.points, strict=True))
    ends.append((annotation.center, annotation.center + WRENCH_STRETCH * scale * annotation.wrench[:3]))
    drawn = []
    for k, (start, end) in enumerate(ends):
        color = colors[k % len(colors)] if k < len(annotation.points) else np.divide(WRENCH_COLOR, 255.0)
        known = {"replaceItemUniqueId": lines[k]} if k < len(lines) and lines[k] >= 0 else {}
        drawn.append(
            bullet.addUserDebugLine(
                start.tolist(), end.tolist(), [float(part) for part in color], lineWidth=4.0, physicsClientId=client,
                **known,
            )
        )  # fmt: skip
    return drawn
