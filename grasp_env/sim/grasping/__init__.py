"""Where a hand takes hold of an object: grasps that it reaches, and checks of points a user gives."""

from grasp_env.sim.grasping.points import check_points, grasp_points

__all__ = ["check_points", "grasp_points"]
