"""Grasp-force optimisation in a simulated hand.

The solver is `grasp_env.grasp` and `grasp_env.force`; the hand is a Gymnasium environment,
`FourFingerGrasp-v0`, which is registered whichever of the two packages is imported first.
"""

import sys
from typing import Any

__version__ = "0.1.0"


def _register() -> bool:
    """Register the environment; return False if Gymnasium is not imported yet."""
    if not hasattr(sys.modules.get("gymnasium.envs.registration"), "register"):
        return False
    from grasp_env._spec import register

    register()
    return True


class _Watch:
    """Import hook that registers the environment once Gymnasium is imported.

    It then removes itself. Importing Gymnasium here would take 30 to 100 ms, also for users of the
    solver alone.
    """

    def __init__(self) -> None:
        self._registers = False

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if self._registers:  # for an import of `_register` itself
            return
        self._registers = True
        self._registers = _register()
        if self._registers:  # a new list: the current search still iterates over the old one
            sys.meta_path = [finder for finder in sys.meta_path if finder is not self]


if not _register():
    sys.meta_path.insert(0, _Watch())
