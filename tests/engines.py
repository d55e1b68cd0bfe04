"""PyBullet for tests that look at it, which are skipped where it is not installed, as from CPython 3.12 on."""

from __future__ import annotations

from typing import Any

import pytest

from grasp_env.errors import MissingExtraError

missing = ""
try:
    from grasp_env.sim.bullet import HAND_FLAGS, UNDAMPED, Bullet, create_body, joint_indices, set_dynamics
    from grasp_env.sim.client import Client, bullet
except MissingExtraError as error:
    missing = str(error)
    HAND_FLAGS: Any = None
    UNDAMPED = Bullet = create_body = joint_indices = set_dynamics = Client = bullet = HAND_FLAGS

__all__ = [
    "HAND_FLAGS",
    "UNDAMPED",
    "Bullet",
    "Client",
    "bullet",
    "create_body",
    "joint_indices",
    "needs_bullet",
    "set_dynamics",
]

needs_bullet = pytest.mark.skipif(bool(missing), reason=missing)
"""Of a test, or of a module as `pytestmark`."""
