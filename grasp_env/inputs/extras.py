"""The optional dependencies, as the extras of `pyproject.toml`."""

from __future__ import annotations

import platform
import sys
from contextlib import nullcontext
from importlib.util import find_spec

from grasp_env.errors import MissingExtraError

_ENGINE = "pybullet" if sys.version_info < (3, 12) or find_spec("pybullet") else "mujoco"
"""Engine that `sim` installs: PyBullet has wheels for CPython 3.10 and 3.11 only."""

_CUTTERS = (
    ("vhacdx",)
    if platform.machine() == "aarch64" and not find_spec("coacd")
    else ("coacd", "vhacdx")
)
"""Packages that cut meshes into convex pieces: CoACD has no wheel for Linux on ARM."""

EXTRAS = {
    "cli": ("rich", "tyro"),
    "sim": (
        "PIL",
        "collada",
        "fast_simplification",
        "gymnasium",
        "manifold3d",
        "networkx",
        "platformdirs",
        "trimesh",
        *_CUTTERS,
        _ENGINE,
    ),
    "mujoco": ("mujoco",),
    "mend": ("pymeshfix",),
    "xacro": ("xacrodoc",),
    "live": ("viser",),
    "layer": ("torch",),
    "train": ("stable_baselines3", "tensorboard", "torch"),
    "report": ("jinja2", "matplotlib", "pandas"),
    "ray": ("ray",),
    "video": ("imageio_ffmpeg", "moviepy"),
    "cvxpy": ("cvxpy",),
}
"""Modules that each extra installs."""


def need(*extras: str) -> nullcontext[None]:
    """Raise a `MissingExtraError` with the command that installs these extras, if one is missing.

    Example:
        >>> with need("sim"):
        ...     import gymnasium
    """
    absent = dict[str, None]()
    missing = list[str]()
    for extra in extras:
        names = [name for name in EXTRAS[extra] if find_spec(name) is None]
        if names:
            missing.append(extra)
            absent |= dict.fromkeys(names)
    if missing:
        raise MissingExtraError(
            f'this needs {", ".join(absent)}: pip install "grasp-force[{",".join(missing)}]"'
        )
    return nullcontext()
