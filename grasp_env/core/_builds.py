"""Choice of the core's build: a wheel for x86-64 holds one folder per processor level, any other
install a single build.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

VARIABLE = "GRASP_CORE_ARCH"
"""Environment variable that selects a level, such as `x86-64-v2`, for tests and measurements."""
_HERE = Path(__file__).parent


def processor_level(here: Path) -> int:
    """Return the level of x86-64, 1 to 4, that processor and system support
    (`bindings/wheel/processor.cpp`).
    """
    return ctypes.CDLL(str(here / "processor.so")).grasp_processor_level()


def folders(here: Path = _HERE) -> list[str]:
    """Return the folders to search for `_core` in addition to the package's own: that of the
    highest level that this processor runs.

    Raises:
        ImportError: the wheel holds no build for this processor, or not the one that the variable
            selects.
    """
    available = sorted(path.name for path in here.glob("x86-64-v*"))
    if not available:
        return []
    selected = os.environ.get(VARIABLE)
    if selected:
        if selected not in available:
            raise ImportError(f"{VARIABLE}={selected}: this wheel holds {', '.join(available)}")
        return [str(here / selected)]
    level = processor_level(here)
    fitting = [name for name in available if int(name.removeprefix("x86-64-v")) <= level]
    if not fitting:
        raise ImportError(
            f"this wheel needs a processor of level {available[0]}, and this one is older: build from source with `pip install .`"
        )
    return [str(here / fitting[-1])]
