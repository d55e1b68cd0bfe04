"""Planning of grasps: contacts that a hand reaches, its pose, and checks of contacts."""

from grasp_env.sim.grasping.placing import place_hand
from grasp_env.sim.grasping.points import GraspPlan, check_points, grasp_points, plan_grasp

__all__ = ["GraspPlan", "check_points", "grasp_points", "place_hand", "plan_grasp"]
