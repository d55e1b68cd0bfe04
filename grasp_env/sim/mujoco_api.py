"""MuJoCo's module, without types, as all that uses it imports it; it writes no log file."""

from __future__ import annotations

from typing import Any

import mujoco as compiled

mujoco: Any = compiled  # it has no types

# it would write what diverges, which callers report, into a file where it runs
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda text: None)
