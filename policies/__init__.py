"""Learned initial forces and controllers. torch is imported only where a network is trained."""

from policies.any_grasp import AnyGraspForce
from policies.controllers import Policy, ZeroPolicy
from policies.fixed_grasp import FixedGraspForce
from policies.learned import LearnedInitialForce

__all__ = ["AnyGraspForce", "FixedGraspForce", "LearnedInitialForce", "Policy", "ZeroPolicy"]
