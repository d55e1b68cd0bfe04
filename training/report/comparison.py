"""The report that compares starts, from a run's saved trials: metrics.json, figures, report.md, report.html."""

from __future__ import annotations

from typing import Any

from grasp_env.errors import InvalidInputError
from training.report.details import feasibility_section, newton_section, sets_section, timing_section
from training.report.facts import caveats_section, models_section
from training.report.first import comparison_section
from training.report.hand import hand_section, paper_section
from training.report.page import Picture, Section, claims_section, provenance_section, write_page
from training.report.pictures import draw_all, loops
from training.report.rl import rl_section
from training.report.starts import network_section, wins_section
from training.runs import Run
from training.trials.metrics import metrics_of


def build_report(run: Run) -> dict[str, Any]:
    """Makes every output of a run from its saved trials.

    Returns:
        The metrics, as written to metrics.json.

    Raises:
        InvalidInputError: the run is of an older version.
    """
    if (run.folder / "trials.npz").is_file() and not (run.folder / "trials").is_dir():
        raise InvalidInputError(
            f"{run.folder} was made by an older version, with other trials: run `grasp evaluate` again"
        )
    metrics = metrics_of(run)
    run.write_json("metrics.json", metrics)
    write_pages(run, metrics)
    return metrics


def write_pages(run: Run, metrics: dict[str, Any]) -> None:
    """Draws the figures and writes report.md and report.html; what a run lacks is a dash, or left out."""
    facts = metrics["run"]
    name = (facts.get("config") or {}).get("name") or run.folder.name
    write_page(run, f"Initial grasp forces: {name}", bool(facts.get("quick")), _sections(run, metrics))


def _sections(run: Run, metrics: dict[str, Any]) -> list[Section | None]:
    results = _rl_results(run)
    pictures = draw_all(run, metrics, results)

    def of(*names: str) -> list[Picture]:
        return [picture for picture in pictures if picture.name.split("-")[0] in names]

    notes = (
        "All figures: the flow's accepted steps, the same step rule for all starts, gaps to a Newton optimum. Shares "
        "count cases without a start as never solved.",
    )
    return [
        comparison_section(metrics, of("found")),
        claims_section(metrics),
        wins_section(metrics),
        network_section(metrics),
        Section("convergence", "How fast each start gets there", notes, of("fan", "ecdf", "budget", "profile")),
        hand_section(metrics, of("rollout"), loops(run)),
        timing_section(metrics, of("violins")),
        newton_section(metrics),
        feasibility_section(metrics, of("continuity")),
        paper_section(metrics, of("constant", "forces", "against")),
        rl_section(results, of("rl")),
        sets_section(metrics),
        models_section(metrics, of("training")),
        caveats_section(metrics),
        provenance_section(metrics["run"]),
    ]


def _rl_results(run: Run) -> dict[str, Any] | None:
    """What `grasp rl` has left in the run's folder, or in rl/ below it; None: nothing that can be read."""
    for name in ("rl.json", "rl/rl.json"):
        if (run.folder / name).is_file():
            found = run.read_json(name)
            return found if isinstance(found, dict) else {"content": found}
    return None
