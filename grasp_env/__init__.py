"""Grasp-force optimisation in a simulated hand: `grasp_env.grasp`, `grasp_env.force`, and a Gymnasium environment.

Importing registers `FourFingerGrasp-v0` with Gymnasium where that is installed and imports nothing heavy: pybullet
loads with the first environment.
"""

__version__ = "0.1.0"


def _register() -> None:
    try:
        from gymnasium.envs.registration import register, registry
    except ImportError:  # grasp_env.grasp and grasp_env.force need numpy and scipy only
        return
    if "FourFingerGrasp-v0" not in registry:
        register(id="FourFingerGrasp-v0", entry_point="grasp_env.env:FourFingerGrasp")


_register()
