"""Descriptions of hands, their URDF files and their kinematics."""

from grasp_env.sim.hand.description import HANDS, FingerDescription, HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics

__all__ = ["HANDS", "FingerDescription", "HandDescription", "HandKinematics"]
