"""Tasks of an episode, motions of the object, and disturbances."""

from grasp_env.task.disturbance import (
    ConstantWrench,
    Disturbance,
    DisturbanceSettings,
    Disturbed,
    Impulses,
    NoDisturbance,
    PaperPath,
    RandomWrench,
    TiltingGravity,
)
from grasp_env.task.tasks import Hold, Move, Payload, SixDirections, Task

__all__ = [
    "ConstantWrench",
    "Disturbance",
    "DisturbanceSettings",
    "Disturbed",
    "Hold",
    "Impulses",
    "Move",
    "NoDisturbance",
    "PaperPath",
    "Payload",
    "RandomWrench",
    "SixDirections",
    "Task",
    "TiltingGravity",
]
