"""The observation, as one table: name, size, unit, frame, bound. The class docstring of the env is tested against it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array


@dataclass(frozen=True)
class Field:
    """One block of the observation vector."""

    name: str
    size: int
    unit: str
    frame: str
    bound: float


FIELDS = (
    Field("wrench to balance: force", 3, "N", "object", 200.0),
    Field("wrench to balance: moment", 3, "N m", "object", 20.0),
    Field("object position error", 3, "m", "world", 1.0),
    Field("object orientation error", 3, "rad", "world", 3.2),
    Field("object linear velocity", 3, "m/s", "world", 10.0),
    Field("object angular velocity", 3, "rad/s", "world", 50.0),
    Field("contact displacement from nominal", 12, "m", "object", 0.2),
    Field("commanded force (normal, o, t)", 12, "N", "contact", 500.0),
    Field("measured force (normal, o, t)", 12, "N", "contact", 500.0),
    Field("touching", 4, "1", "-", 1.0),
    Field("solver friction", 1, "1", "-", 10.0),
)
SIZE = sum(field.size for field in FIELDS)


def bounds() -> NDArray[np.float32]:
    """(SIZE,) the bound of each entry; observations are clipped to +-bound."""
    return np.repeat([field.bound for field in FIELDS], [field.size for field in FIELDS]).astype(np.float32)


def build(*blocks: Array | float) -> NDArray[np.float32]:
    """The clipped float32 observation from blocks in the order of `FIELDS`."""
    flat = np.concatenate([np.ravel(block) for block in blocks])
    limit = bounds()
    return np.clip(flat, -limit, limit).astype(np.float32)


def table() -> list[str]:
    """Lines "first-last | name | unit | frame | bound", as printed in the environment's docstring."""
    lines, start = [], 0
    for field in FIELDS:
        last = start + field.size - 1
        index = f"{start}" if field.size == 1 else f"{start}-{last}"
        lines.append(f"| {index} | {field.name} | {field.unit} | {field.frame} | {field.bound:g} |")
        start = last + 1
    return lines
