"""The tests take the core of the source tree, or another build of it: `make test CXX=clang++`,
`make sanitize`.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path

import pytest


class OtherBuild:
    """Finds the core's modules in a build folder, before anybody else can find those of the source
    tree.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """As every finder: None for other modules; a build without the module is an error."""
        if name not in ("grasp_env.core._core", "_core_test"):
            return None
        spec = PathFinder.find_spec(name, [str(self.folder)])
        if spec is None:
            raise ImportError(
                f"{self.folder} holds no {name}: run `make core` with the options of that build"
            )
        return spec


# what is made of meshes is kept here, not in the cache of who runs the tests
os.environ["XDG_CACHE_HOME"] = str(Path(__file__).parent / "build" / "cache")

if "GRASP_CORE_BUILD" in os.environ:
    sys.meta_path.insert(0, OtherBuild(Path(__file__).parent / os.environ["GRASP_CORE_BUILD"]))

if find_spec("pybullet") is None:  # as from CPython 3.12 on: the doctests of what imports it
    collect_ignore = [
        "benchmarks/env.py",
        *(f"grasp_env/sim/{name}.py" for name in ("bullet", "client", "picture/bullet")),
    ]


def pytest_configure(config: pytest.Config) -> None:
    """Warnings are errors, but for what looks like a mistake in contacts: random ones are of any
    size, some inside out.
    """
    config.addinivalue_line("filterwarnings", "ignore::grasp_env.errors.GraspWarning")
