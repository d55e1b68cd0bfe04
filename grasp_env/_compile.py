"""`compiled`: numba with an on-disk cache that notices when a kernel of another file changed.

numba's cache compares the source file of the function it holds, not those of the functions compiled into it: after an
edit of `kernels.py` the cached loops in `flow_kernels.py` would keep the old code, without a word. So the stamp of
every cached kernel here includes a hash of all the sources that kernels may come from.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

_ROOT = Path(__file__).parent
_SOURCES = hashlib.sha256(
    b"".join(
        path.read_bytes() for folder in ("force", "grasp", "sim") for path in sorted((_ROOT / folder).glob("*.py"))
    )
).hexdigest()


VECTOR_MATH = {"contract", "arcp", "nsz", "reassoc"}
"""What LLVM needs to vectorise sums over contacts. NaN and inf keep their meaning."""


def compiled(function: Callable[..., Any]) -> Any:
    """Compiles at the first call, caches on disk, releases the GIL; division by zero gives inf as in numpy."""
    return _stamped(njit(cache=True, nogil=True, error_model="numpy")(function))


def compiled_lanes(function: Callable[..., Any]) -> Any:
    """`compiled`, with sums that may be reordered: for kernels that work on four contacts at a time (`lanes.py`)."""
    return _stamped(njit(cache=True, nogil=True, error_model="numpy", fastmath=VECTOR_MATH)(function))


def _stamped(dispatcher: Any) -> Any:
    # numba has no public hook for the stamp; without a cache (NUMBA_DISABLE_JIT) there is nothing to mark
    file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if file is not None:
        file._source_stamp = (file._source_stamp, _SOURCES)
    return dispatcher
