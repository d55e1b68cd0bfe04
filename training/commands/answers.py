"""JSON output of sub-commands."""

from __future__ import annotations

import json
import math
import sys
from typing import Any


def write_json(answer: dict[str, Any]) -> None:
    """Print one object on a line of stdout. Arrays become lists; NaN and infinity, which JSON lacks, become null."""
    sys.stdout.write(json.dumps(_plain(answer), allow_nan=False, default=str) + "\n")


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
