"""Grasp-force optimisation in a simulated hand: `grasp_env.grasp`, `grasp_env.force`, and a Gymnasium environment.

Importing registers `FourFingerGrasp-v0` with Gymnasium, whichever of the two is imported first. It imports nothing heavy
itself: Gymnasium is left to those who use it, and pybullet loads with the first environment.
"""

import sys
from typing import Any

__version__ = "0.1.0"


def _register() -> bool:
    """Registers the environment if Gymnasium's registry is there."""
    registration = sys.modules.get("gymnasium.envs.registration")
    if not hasattr(registration, "register"):
        return False
    if "FourFingerGrasp-v0" not in registration.registry:  # type: ignore[union-attr]
        last = registration.WrapperSpec("finish", "grasp_env.env.env:finish", {})  # type: ignore[union-attr]
        registration.register(  # type: ignore[union-attr]
            id="FourFingerGrasp-v0", entry_point="grasp_env.env:FourFingerGrasp", additional_wrappers=(last,)
        )
    return True


class _Watch:
    """Registers while Gymnasium is imported later. It finds no module itself, and leaves once it has registered.

    Gymnasium has no plugins since 1.0, and to import it here would cost everybody who only solves 30 to 100 ms.
    """

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if _register():  # a new list: the search under way still reads the old one
            sys.meta_path = [finder for finder in sys.meta_path if finder is not self]


if not _register():
    sys.meta_path.insert(0, _Watch())
