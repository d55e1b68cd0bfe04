"""Pictures of a scene, drawn by the renderer of its physics engine, and what is drawn over them with Pillow."""

from grasp_env.sim.picture.annotation import Annotation
from grasp_env.sim.picture.camera import Camera, CameraConfig

__all__ = ["Annotation", "Camera", "CameraConfig"]
