"""Simulated hand and object. No other package depends on a physics engine."""

from grasp_env.inputs.extras import need

with need("sim"):
    from grasp_env.sim.engine import BulletEngine, MujocoEngine
    from grasp_env.sim.grasping.miss import NearestMiss
    from grasp_env.sim.grasping.placing import place_hand
    from grasp_env.sim.grasping.record import HandGrasp
    from grasp_env.sim.hand.description import HANDS, FingerDescription, HandDescription
    from grasp_env.sim.hand.kinematics import HandKinematics
    from grasp_env.sim.objects.description import ObjectDescription
    from grasp_env.sim.scene import Scene

__all__ = [
    "HANDS",
    "BulletEngine",
    "FingerDescription",
    "HandDescription",
    "HandGrasp",
    "HandKinematics",
    "MujocoEngine",
    "NearestMiss",
    "ObjectDescription",
    "Scene",
    "place_hand",
]
