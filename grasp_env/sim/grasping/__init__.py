"""Planning of grasps: contacts that a hand reaches, its pose, and checks of contacts."""

from grasp_env.sim.grasping.placing import place_hand
from grasp_env.sim.grasping.points import plan_grasp

__all__ = ["place_hand", "plan_grasp"]
