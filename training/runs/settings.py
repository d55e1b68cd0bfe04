"""What the settings of every room have in common."""

from __future__ import annotations

from typing import Any

from grasp_env._check import together, whole

MOST = 1_000_000_000
"""Of anything that is counted here."""


def check_counts(config: Any, least: dict[str, int]) -> None:
    """Raises `InvalidInputError` unless these settings are integers from `least` on, and not absurdly many."""
    together(*(lambda n=n, low=low: whole(getattr(config, n), n, low, MOST) for n, low in least.items()))
