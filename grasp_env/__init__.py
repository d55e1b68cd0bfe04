"""Grasp-force optimisation in a simulated hand: `grasp_env.grasp`, `grasp_env.force`, and a Gymnasium environment.

Importing registers `FourFingerGrasp-v0` with Gymnasium as soon as that is imported, before or after, and imports nothing
heavy itself: pybullet loads with the first environment.
"""

import sys
from importlib.util import find_spec
from typing import Any

__version__ = "0.1.0"

_REGISTRY = "gymnasium.envs.registration"


def _register() -> None:
    registration = sys.modules[_REGISTRY]
    if "FourFingerGrasp-v0" not in registration.registry:
        registration.register(id="FourFingerGrasp-v0", entry_point="grasp_env.env:FourFingerGrasp")


class _Watch:
    """Registers after Gymnasium is imported: importing it here would cost whoever only solves a tenth of a second."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        if fullname != _REGISTRY:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_register(module: Any) -> None:
                run(module)
                _register()

            spec.loader.exec_module = run_and_register
        return spec


if _REGISTRY in sys.modules:
    _register()
else:
    sys.meta_path.insert(0, _Watch())
