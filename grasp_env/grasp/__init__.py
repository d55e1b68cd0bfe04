"""Contacts, grasps and wrenches. numpy only."""

from grasp_env.grasp import presets, wrench
from grasp_env.grasp.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis

__all__ = ["Grasp", "null_space_basis", "presets", "reference_basis", "wrench"]
