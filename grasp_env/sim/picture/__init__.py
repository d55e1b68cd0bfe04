"""Pictures of a scene by the renderer of its physics engine, with annotations by Pillow."""

from grasp_env.sim.picture.annotation import Annotation
from grasp_env.sim.picture.camera import Camera, CameraConfig

__all__ = ["Annotation", "Camera", "CameraConfig"]
