"""Reports from a run's saved trials: metrics.json, figures, report.md, self-contained report.html. Solves nothing."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from grasp_env.errors import InvalidInputError
from training.report.details import feasibility_section, newton_section, sets_section, timing_section
from training.report.facts import caveats_section, models_section, provenance_section
from training.report.hand import hand_section, paper_section
from training.report.model import Fold, Picture, Section, Table
from training.report.pictures import draw_all, loops
from training.report.rl import rl_section
from training.report.starts import claims_section, network_section, wins_section
from training.report.style import variables
from training.runs import Run
from training.runs.words import number, percent
from training.trials.metrics import metrics_of

__all__ = ["build_report", "number", "render", "write_pages"]


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
    sections = _sections(run, metrics)
    facts = metrics["run"]
    name = (facts.get("config") or {}).get("name") or run.folder.name
    context = {"title": f"Initial grasp forces: {name}", "quick": bool(facts.get("quick")), "sections": sections}
    run.write_text("report.md", render("report.md.j2", context))
    run.write_text(
        "report.html", render("report.html.j2", {**context, "light": variables(False), "dark": variables(True)})
    )


def _sections(run: Run, metrics: dict[str, Any]) -> list[Section]:
    results = _rl_results(run)
    pictures = draw_all(run, metrics, results)

    def of(*names: str) -> list[Picture]:
        return [picture for picture in pictures if picture.name.split("-")[0] in names]

    notes = (
        "All figures: the flow's accepted steps, the same step rule for all starts, gaps to a Newton optimum. Fans: median and "
        "p10 to p90 band over the cases. Shares count cases without a start as never solved.",
    )
    sections = [
        claims_section(metrics),
        wins_section(metrics),
        network_section(metrics),
        Section("convergence", "How fast each start gets there", notes, of("fan", "ecdf", "budget", "profile")),
        hand_section(metrics, of("rollout"), loops(run)),
        timing_section(metrics, of("violins")),
        newton_section(metrics, []),
        feasibility_section(metrics, of("continuity")),
        paper_section(metrics, of("constant", "forces", "against")),
        rl_section(results, of("rl")),
        sets_section(metrics),
        models_section(metrics, of("training")),
        caveats_section(metrics),
        provenance_section(metrics),
    ]
    return [section for section in sections if section is not None and (section.blocks or section.items)]


def _rl_results(run: Run) -> dict[str, Any] | None:
    """What `grasp rl` has left in the run's folder, or in rl/ below it; None: nothing that can be read."""
    for name in ("rl.json", "rl/rl.json"):
        if (run.folder / name).is_file():
            found = run.read_json(name)
            return found if isinstance(found, dict) else {"content": found}
    return None


def render(template: str, context: dict[str, Any]) -> str:
    """A template of this package, filled; one that names what `context` lacks raises."""
    environment = Environment(
        loader=PackageLoader("training.report", "templates"),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["percent"] = percent
    environment.tests["table"] = lambda block: isinstance(block, Table)
    environment.tests["picture"] = lambda block: isinstance(block, Picture)
    environment.tests["fold"] = lambda block: isinstance(block, Fold)
    return environment.get_template(template).render(context)
