"""The controller of a hand, the control loop of the simulation, and the closing of the fingers."""

from grasp_env.control.contacts import ContactEstimator, ContactEstimatorSettings
from grasp_env.control.hand import (
    Calibration,
    HandController,
    HandControllerSettings,
    HandState,
)
from grasp_env.control.recording import Recording, differences, replay

__all__ = [
    "Calibration",
    "ContactEstimator",
    "ContactEstimatorSettings",
    "HandController",
    "HandControllerSettings",
    "HandState",
    "Recording",
    "differences",
    "replay",
]
