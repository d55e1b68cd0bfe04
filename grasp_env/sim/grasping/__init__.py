"""Planning of grasps: contacts that a hand reaches, its pose, and checks of contacts."""

from grasp_env.sim.grasping.motion import check_motion
from grasp_env.sim.grasping.placing import place_hand
from grasp_env.sim.grasping.points import FRICTION_MARGIN, plan_grasp

__all__ = ["FRICTION_MARGIN", "check_motion", "place_hand", "plan_grasp"]
