"""Read hands from files: URDF, xacro and MuJoCo models."""
