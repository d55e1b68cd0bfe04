"""A run's report, of whatever kind the run is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from training.report.comparison import build_report as build_comparison
from training.report.hands import build_hands_report, build_transfer_report
from training.report.holds import build_env_report
from training.runs import Run

_BUILDERS = {"env": build_env_report, "hands": build_hands_report, "transfer": build_transfer_report}


def build_report(run: Run) -> dict[str, Any]:
    """Makes every output of a run from `run.json` and its saved trials; returns the metrics, as written to metrics.json.

    Raises:
        InvalidInputError: the run is of an older version.
    """
    return _BUILDERS.get(run.read_json("run.json").get("kind"), build_comparison)(run)


def report_path(run: Run) -> Path:
    """The page to open."""
    return run.folder / "report.html"
