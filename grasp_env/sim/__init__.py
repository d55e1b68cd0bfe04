"""Simulated hand and object. No other package depends on a physics engine."""

from grasp_env._extras import need

with need("sim"):
    from grasp_env.sim.config import SceneConfig
    from grasp_env.sim.engine import ENGINES, BulletEngine, MujocoEngine
    from grasp_env.sim.grasping.placing import place_hand
    from grasp_env.sim.hand.description import HANDS, FingerDescription, HandDescription
    from grasp_env.sim.hand.kinematics import HandKinematics
    from grasp_env.sim.objects.description import ObjectDescription
    from grasp_env.sim.picture.annotation import Annotation
    from grasp_env.sim.picture.camera import Camera, CameraConfig
    from grasp_env.sim.scene import Scene
    from grasp_env.sim.snapshot import Snapshot

__all__ = [
    "ENGINES",
    "HANDS",
    "Annotation",
    "BulletEngine",
    "Camera",
    "CameraConfig",
    "FingerDescription",
    "HandDescription",
    "HandKinematics",
    "MujocoEngine",
    "ObjectDescription",
    "Scene",
    "SceneConfig",
    "Snapshot",
    "place_hand",
]
