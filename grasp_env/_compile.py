"""`compiled`: numba with an on-disk cache that notices when a kernel of another file changed.

numba's cache compares the source file of the function it holds, not those of the functions compiled into it: after an
edit of `kernels.py` the cached loops in `control_kernels.py` would keep the old code, without a word. So the stamp of
every cached kernel here includes a hash of its own file and of all files of this package that it imports from, directly or not.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from grasp_env import core
from grasp_env._extras import need

with need("sim"):
    from numba import njit

_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(
    r"^[ \t]*(?:from|import)[ \t]+(grasp_env[\w.]*)(?:[ \t]+import[ \t]+(\([^)]*\)|.*))?", re.MULTILINE
)


_CORE = repr(
    (core.record_fields(), core.codes(), core.LARGEST, core.NOTHING, core.ROUNDING, core.TANGENT_SWITCH)
).encode()
"""What kernels take from the core and keep as constants."""
VECTOR_MATH = {"contract", "arcp", "nsz", "reassoc"}
"""What LLVM needs to vectorise sums over contacts. NaN and inf keep their meaning."""


def compiled(function: Callable[..., Any]) -> Any:
    """Compiles at the first call, caches on disk, releases the GIL; division by zero gives inf as in numpy."""
    # fastmath is said: numba lets a kernel inherit it from whichever caller compiled it first, and its last bits with it
    return _stamped(njit(cache=True, nogil=True, error_model="numpy", fastmath=False)(function))


def compiled_lanes(function: Callable[..., Any]) -> Any:
    """`compiled`, with sums that may be reordered."""
    return _stamped(njit(cache=True, nogil=True, error_model="numpy", fastmath=VECTOR_MATH)(function))


def _stamped(dispatcher: Any) -> Any:
    # numba has no public hook for the stamp; without a cache (NUMBA_DISABLE_JIT) there is nothing to mark
    file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if file is not None:
        file._source_stamp = (file._source_stamp, _stamp(Path(dispatcher.py_func.__code__.co_filename)))
    return dispatcher


@cache
def _stamp(path: Path) -> str:
    """A hash of a source file and of everything in this package that it imports from."""
    seen, waiting = set[Path](), [path]
    while waiting:
        file = waiting.pop()
        if file not in seen:
            seen.add(file)
            waiting += _imports(file)
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(seen)) + _CORE).hexdigest()


@cache
def _imports(path: Path) -> tuple[Path, ...]:
    found = set[Path]()
    for module, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
        place = _PACKAGE.joinpath(*module.split(".")[1:])
        inside = [place / f"{name}.py" for name in re.findall(r"\w+", names)]
        found.update(p for p in (place.with_suffix(".py"), place / "__init__.py", *inside) if p.is_file())
    return tuple(found)
