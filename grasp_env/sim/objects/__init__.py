"""Objects: shapes and meshes, sizes, inertia and surfaces."""
