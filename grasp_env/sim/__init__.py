"""The simulated hand and object; the only package that knows PyBullet."""

from grasp_env.sim.camera import Camera, CameraConfig
from grasp_env.sim.client import Client
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.contacts import FingerContacts
from grasp_env.sim.hand import FingerDescription, HandDescription
from grasp_env.sim.kinematics import HandKinematics
from grasp_env.sim.scene import ObjectState, Scene

__all__ = [
    "Camera",
    "CameraConfig",
    "Client",
    "FingerContacts",
    "FingerDescription",
    "HandDescription",
    "HandKinematics",
    "ObjectState",
    "Scene",
    "SceneConfig",
]
