"""What is asked of the grasp in an episode: tasks, motions of the object, disturbances."""

from grasp_env.task.disturbance import DISTURBANCES, Disturbance, Disturbed
from grasp_env.task.motion import MOTIONS
from grasp_env.task.tasks import TASKS, Task

__all__ = ["DISTURBANCES", "MOTIONS", "TASKS", "Disturbance", "Disturbed", "Task"]
