"""A wheel for x86-64 holds the core several times, each in the folder of its level; this chooses. Any other install holds one."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

VARIABLE = "GRASP_CORE_ARCH"
"""Forces a level, such as `x86-64-v2`; for tests and measurements."""
_HERE = Path(__file__).parent


def processor_level(here: Path) -> int:
    """1 to 4: of x86-64, what processor and system run (`bindings/wheel/processor.cpp`)."""
    return ctypes.CDLL(str(here / "processor.so")).grasp_processor_level()


def folders(here: Path = _HERE) -> list[str]:
    """Where to look for `_core` besides the package's own folder: the highest level that this processor runs.

    Raises:
        ImportError: the wheel holds none for this processor, or not the one that the variable asks for.
    """
    held = sorted(path.name for path in here.glob("x86-64-v*"))
    if not held:
        return []
    asked = os.environ.get(VARIABLE)
    if asked:
        if asked not in held:
            raise ImportError(f"{VARIABLE}={asked}: this wheel holds {', '.join(held)}")
        return [str(here / asked)]
    level = processor_level(here)
    fitting = [name for name in held if int(name.removeprefix("x86-64-v")) <= level]
    if not fitting:
        raise ImportError(
            f"this wheel needs a processor of {held[0]}, and this one is older: `pip install .` builds for any"
        )
    return [str(here / fitting[-1])]
