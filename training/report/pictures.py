"""Every figure of a report: which trials it needs, what it says, and its files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from training.cases.start_table import given_in
from training.demo.loops import ANIMATIONS, STILL, still_of
from training.report import figures, shares
from training.report.first import charts
from training.report.page import Picture, at, data_uri
from training.report.rl import learning_curves
from training.report.starts import label, set_label, short
from training.report.style import Drawing, close, standalone, svg
from training.runs import Run
from training.trials.arrays import Trials

_FANS = ("ball", "jump_50", "random_4", "rollout_changes")
_ECDFS = ("ball", "smooth", "jump_50", "friction", "random_4", "rollout_changes")
_BUDGETS = ("ball", "rollout_changes")
_FIXED = ("wrenches", "jumps", "paper")
_Entry = tuple[str, str, str, str, Callable[[], "Drawing | None"]]


def draw_all(run: Run, metrics: dict[str, Any], results: dict[str, Any] | None) -> list[Picture]:
    """Draws the figures whose trials the run has, and saves each as figures/<name>.svg.

    Args:
        run: receives them.
        metrics: of the run.
        results: of reinforcement learning, where there are some.
    """
    pictures = []
    for name, title, caption, alt, draw in (*_catalogue(run, metrics), *_models(metrics), *_learning(results)):
        drawing = draw()
        if drawing is None:
            continue
        page = svg(drawing, name, alt)
        close(drawing.figure)
        run.write_text(f"figures/{name}.svg", standalone(page, drawing.legend))
        pictures.append(Picture(name, title, caption, alt, drawing.legend, page, f"figures/{name}.svg"))
    return pictures


def loops(run: Run) -> list[Picture]:
    """The moving pictures of the hand, each with a still one; the still alone where a run has no other."""
    text = "A random wrench on the object. Arrows: forces of the fingers, wrench; cones: friction."
    out = []
    for name, what in ANIMATIONS.items():
        file = run.path(f"figures/{name}")
        if file.is_file():
            data = file.read_bytes()
            sources = {"moving": data_uri(data, "webp"), "still": data_uri(still_of(data), "jpeg")}
            alt = f"Animation of the hand holding a cuboid under a random wrench, forces optimised {what}."
            out.append(
                Picture(
                    name.split(".")[0], f"The hand, forces {what}", text, alt, file=f"figures/{name}", sources=sources
                )
            )
    still = run.path(f"figures/{STILL}")
    if not out and still.is_file():
        source = {"still": data_uri(still_of(still.read_bytes()), "jpeg")}
        alt = "The simulated four-finger hand holding a cuboid."
        out.append(Picture("hand", "The simulated hand", "", alt, file=f"figures/{STILL}", sources=source))
    return out


def _catalogue(run: Run, metrics: dict[str, Any]) -> Iterator[_Entry]:
    cache: dict[str, Trials] = {}

    def arrays(file: str) -> Trials:
        if file not in cache:
            cache[file] = run.read_arrays(file) if run.path(file).is_file() else {}
        return cache[file]

    def trials(name: str) -> Trials:
        return arrays(f"trials/{name}.npz")

    for *said, drawing in charts(metrics):
        name, title, caption, alt = said
        yield name, title, caption, alt, lambda drawing=drawing: drawing
    yield from _of_sets(metrics, trials)
    best = "Best of the repeats per wrench" if (at(metrics, "timing", "repeats") or 2) > 1 else "One call per wrench"
    yield (
        "violins",
        "Microseconds per call, held-out ball",
        f"{best}. Above each line the start and the reduced flow, below it, pale, the start and Newton; the "
        "bar is the median.",
        "Half violins of microseconds per call for every start, with the reduced flow and with Newton; the table has the numbers.",
        lambda: figures.violins(arrays("timing.npz")),
    )  # fmt: skip
    yield (
        "continuity",
        "Force change per wrench change, |df| / |dw|",
        "Along straight paths: median (dot), p99 (bar), largest (cross).",
        "Median, p99 and largest slope of every start; the table has the numbers.",
        lambda: figures.continuity(metrics),
    )
    constant, path = trials("constant"), trials("paper_path")
    if constant:
        yield (
            "constant",
            "Convergence on the paper's constant wrench (its Fig. 3)",
            "",
            "Convergence curves of the reduced flow on the paper's constant wrench, one per start.",
            lambda: figures.convergence(constant),
        )
    if "optimum/force" in path:
        yield (
            "forces",
            "Optimal forces along W_ext(t), full size",
            "",
            "Normal and tangential forces of the four fingers over two seconds.",
            lambda: figures.forces_over_time(path),
        )
        yield (
            "against",
            "Starts against the optimum along W_ext(t) (its Fig. 4)",
            "",
            "Normal force of each finger over time: optimum and starts.",
            lambda: figures.start_against_optimum(path),
        )
    for start in ("linear_combination", "learned_fixed", *given_in(at(metrics, "run", "given") or {})):
        yield (
            f"rollout-{start}",
            f"Roll-outs, start: {short(start)}",
            "Drift is drawn from 1e-6 mm on; dotted: 1 mm.",
            "Object drift, thumb force and iterations over time in every scenario.",
            lambda start=start: figures.rollout(arrays("rollouts.npz"), start),
        )


def _models(metrics: dict[str, Any]) -> Iterator[_Entry]:
    """The training curves of the models, where their cards hold them."""
    for key, card in (at(metrics, "run", "models") or {}).items():
        if isinstance(card, dict):
            title = f"Training: {label(key)}"
            yield (
                f"training-{key}",
                title,
                "",
                f"{title}, held-out gap against steps.",
                lambda card=card: figures.training_curve(card),
            )


def _learning(results: dict[str, Any] | None) -> Iterator[_Entry]:
    for name, title in (("iterations", "Iterations while learning"), ("return", "Return while learning")):
        note = "Thin: training seeds, thick: their mean."
        yield f"rl-{name}", title, note, f"{title}, per agent.", lambda name=name: learning_curves(results, name)


def _of_sets(metrics: dict[str, Any], trials: Callable[[str], Trials]) -> Iterator[_Entry]:
    """The figures that compare starts on sets of cases."""
    for kind, names, title, caption, draw in (
        (
            "fan",
            _FANS,
            "Convergence",
            "Median, and a band from p10 to p90 of the cases; dotted the 12-basis's median.",
            figures.fan,
        ),
        ("ecdf", _ECDFS, "Share solved within so many steps", "", shares.ecdf),
        (
            "budget",
            _BUDGETS,
            "Gap left after a budget of steps",
            "Median of the gap; the tables of the set have the p95.",
            shares.budget,
        ),
    ):
        for name in names:
            if trials(name):
                text = f"{title}: {set_label(metrics, name)}"
                alt = f"{text}. The tables of this set have the numbers."
                yield f"{kind}-{name}", text, caption, alt, lambda draw=draw, name=name: draw(trials(name))
    for title, wanted in (("fixed grasp", True), ("other contacts", False)):
        names = [
            name
            for name, entry in metrics.get("sets", {}).items()
            if (entry.get("group") in _FIXED) == wanted and "optimum/objective" in trials(name)
        ]
        if names:
            text = f"Performance profile, {title}: all cases of {len(names)} sets"
            note = "Share of cases solved within a factor of the fewest steps; starts that do not apply count as not solved."
            key = f"profile-{title.split()[0]}"
            yield key, text, note, text, lambda names=names: shares.profile([trials(name) for name in names])
