"""Contacts, grasps and wrenches, their files and frames. It needs numpy only."""

from grasp_env.grasp import presets, wrench
from grasp_env.grasp.advice import advise
from grasp_env.grasp.files import load_grasp, save_grasp
from grasp_env.grasp.grasp import Grasp
from grasp_env.grasp.transforms import gravity_wrench, transform_wrench, transformed, wrench_about

__all__ = [
    "Grasp",
    "advise",
    "gravity_wrench",
    "load_grasp",
    "presets",
    "save_grasp",
    "transform_wrench",
    "transformed",
    "wrench",
    "wrench_about",
]
