"""What a sub-command prints for machines."""

from __future__ import annotations

import json
import math
import sys
from typing import Any


def write_json(answer: dict[str, Any]) -> None:
    """One object and a line's end on stdout; JSON has no NaN and no infinity, they become null."""
    sys.stdout.write(json.dumps(_finite(answer), allow_nan=False, default=str) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
