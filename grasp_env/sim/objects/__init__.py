"""Objects: shapes and meshes, sizes, inertia and surfaces."""

from grasp_env.sim.objects.description import SHAPES, ObjectDescription

__all__ = ["SHAPES", "ObjectDescription"]
