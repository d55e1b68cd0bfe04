"""Learned initial forces and controllers. torch is imported only where a network is trained."""

from policies.controllers import Policy, ZeroPolicy
from policies.learned import LearnedInitialForce

__all__ = ["LearnedInitialForce", "Policy", "ZeroPolicy"]
