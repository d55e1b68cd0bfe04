"""Pictures of a scene, drawn by PyBullet, and what is drawn over them."""

from grasp_env.sim.picture.camera import Camera, CameraConfig
from grasp_env.sim.picture.overlay import Annotation

__all__ = ["Annotation", "Camera", "CameraConfig"]
