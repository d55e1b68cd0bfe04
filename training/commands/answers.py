"""The JSON that a sub-command prints for machines."""

from __future__ import annotations

import json
import math
import sys
from typing import Any


def write_json(answer: dict[str, Any]) -> None:
    """Prints one object on a line of stdout; arrays become lists, and NaN and infinity, which JSON lacks, null."""
    sys.stdout.write(json.dumps(_plain(answer), allow_nan=False, default=str) + "\n")


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
