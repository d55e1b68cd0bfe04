"""A run's report, of whatever kind the run is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from training.report import holds, pages
from training.runs import Run


def build_report(run: Run) -> dict[str, Any]:
    """Makes every output of a run from `run.json` and its saved trials; returns the metrics, as written to metrics.json.

    Raises:
        InvalidInputError: the run is of an older version.
    """
    env = run.read_json("run.json").get("kind") == "env"
    return holds.build_env_report(run) if env else pages.build_report(run)


def report_path(run: Run) -> Path:
    """The page to open."""
    return run.folder / "report.html"
