"""PyBullet for tests that use it, which are skipped if it is not installed, as on CPython 3.12."""

from __future__ import annotations

from typing import Any

import pytest

from grasp_env.errors import MissingExtraError

missing = ""
try:
    from grasp_env.sim.bullet import HAND_FLAGS, Bullet, joint_indices
    from grasp_env.sim.bullet_body import create_body
    from grasp_env.sim.client import Client, bullet
except MissingExtraError as error:
    missing = str(error)
    HAND_FLAGS: Any = None
    Bullet = create_body = joint_indices = Client = bullet = HAND_FLAGS

__all__ = [
    "HAND_FLAGS",
    "Bullet",
    "Client",
    "bullet",
    "create_body",
    "joint_indices",
    "needs_bullet",
]

needs_bullet = pytest.mark.skipif(bool(missing), reason=missing)
"""Mark of a test, or of a module as `pytestmark`."""
