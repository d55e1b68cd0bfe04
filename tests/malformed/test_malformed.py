"""Calls that nobody means: only the project's errors, no nan, no warning, no hang, no crash. GRASP_TRIAL_SEED: another seed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TRIAL = Path(__file__).with_name("trial.py")
SEED = int(os.environ.get("GRASP_TRIAL_SEED", "0"))


def faults(seed: int, count: int) -> list[str]:
    """What went wrong in that many calls, in a process of its own: a crash or a hang is a fault of the last call."""
    command = [sys.executable, "-W", "error", str(TRIAL), "--seed", str(seed), "--count", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = [f"seed {seed}, call {row['call']}, {row['name']}: {row['fault']}, given {row['given']}" for row in map(json.loads, done.stdout.splitlines())]  # fmt: skip
    return (
        told if done.returncode == int(bool(told)) else [*told, f"ended with {done.returncode}:\n{done.stderr[-3000:]}"]
    )


def test_malformed_calls() -> None:
    assert faults(SEED, 1000) == []


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_thirty_thousand_malformed_calls(part: int) -> None:
    assert faults(SEED + 1 + part, 3000) == []
