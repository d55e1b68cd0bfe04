"""MuJoCo's module, untyped and without its log file; all other modules import it from here."""

from __future__ import annotations

from typing import Any

import mujoco as compiled

mujoco: Any = compiled  # it has no type stubs

# by default it logs divergence, which callers report, to a file
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda text: None)
