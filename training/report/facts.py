"""The end of a comparison: the models, every caveat."""

from __future__ import annotations

from typing import Any

from training.cases.start_table import given_in, row_of
from training.report.page import Fold, Picture, Section, Table, at, flat, present
from training.report.starts import label, short, starts_of
from training.runs.words import number
from training.trials.claims import training_seconds


def models_section(metrics: dict[str, Any], pictures: list[Picture]) -> Section:
    """A line per model, its card folded below."""
    models = {key: card for key, card in (at(metrics, "run", "models") or {}).items() if isinstance(card, dict)}
    rows = [
        [label(key), str(card.get("limits") or "–"), number(card.get("bytes")), number(at(card, "optimisation_steps")),
         number(training_seconds(card)), *(number(at(card, "held_out_gap", "ball", "gap", part), 2) for part in ("median", "p99")),
         _range(card)]
        for key, card in models.items()
    ]  # fmt: skip
    columns = (
        "model",
        "limits",
        "bytes",
        "steps",
        "training [s of a core]",
        "held-out gap, median",
        "p99",
        "wrench [N]",
    )
    total = sum(card.get("bytes") or 0 for card in models.values())
    caption = f"Models of this run ({number(total / 1e6)} MB together; gaps of the network alone, standard ball, friction varied)"
    cards = [
        Fold(
            f"Model card: {label(key)}",
            [Table("As saved with the model", ("", "value"), [[*line] for line in flat(card)], words=2)],
        )
        for key, card in models.items()
    ]
    return Section("models", "The models", (), present([Table(caption, columns, rows, words=2), *pictures, *cards]))


def _steps_inside(metrics: dict[str, Any]) -> list[str]:
    """Which of this run's starts take Newton steps that no iteration counts."""
    keys = starts_of(metrics)
    given = given_in(keys)
    known = {
        key: at(metrics, "run", "given", key, "second_order") if key in given else row_of(key).second_order
        for key in keys
    }
    inside, without, unsaid = ([key for key in keys if known[key] is one] for one in (True, False, None))
    if not inside:
        return []
    unknown = f" Not known: {'; '.join(map(short, unsaid))}." if unsaid else ""
    return [
        f"Newton steps before the first iteration is counted: {'; '.join(map(short, inside))}. None: "
        f"{'; '.join(map(short, without)) or '–'}.{unknown} The 12-basis and the network after so many Newton steps are controls: what such "
        "steps do is not what was learned."
    ]


def _range(card: dict[str, Any]) -> str:
    """Magnitudes of the training wrenches."""
    low, high = at(card, "config", "low"), at(card, "config", "high")
    return "–" if low is None else f"{number(low)} to {number(high)}"


def caveats_section(metrics: dict[str, Any]) -> Section:
    """What the numbers do not say."""
    quick, several = at(metrics, "run", "quick"), (at(metrics, "timing", "repeats") or 0) > 1
    items = [
        "This is a quick run: few cases, wide intervals, p99 near the maximum. Do not quote its numbers." if quick else "",
        "Table I of the paper cannot be reproduced (its contacts, weights and step size are not printed); it is no acceptance test.",
        "The previous solution cannot help on a cold start (there is none), after a large jump of the wrench (it is far), or for "
        "other contacts (its forces belong to contacts that are gone).",
        "On independent draws the “previous” starts come from an unrelated wrench: a jump, not what a control loop meets at every tick.",
        *_steps_inside(metrics),
        "A start of lower Phi does not always need fewer steps: the flow follows the projected gradient, and a little gap along a "
        "badly conditioned direction takes longer than a larger one along a good direction.",
        "The 12-basis is recomputed for every grasp of the sets with other contacts; its offline work is not in its microseconds, "
        "but beside them.",
        "Iterations are counted to a gap against a Newton optimum; the microseconds are of calls that stop by their own certified "
        "gap, as a user's do.",
        "A start that does not exist or does not apply is counted, and in no percentile; compare starts on the same cases only.",
        "Microseconds are of this machine at that time, from Python"
        + ("; the best of the repeats leaves out what other processes took." if several else ", called once: they hold what other processes took."),
        "The fixed-grasp model and the stored solutions apply where all contacts are near those of their grasp; the rest is counted (‡).",
        "In the simulation contacts are rigid and the model is exact: the hand holds better than a real one would.",
        "One objective (one ω and λ) unless a table says otherwise; where the barrier is weaker the flow takes longer from every start.",
    ]  # fmt: skip
    return Section("caveats", "Caveats", (), (), [text for text in items if text])
