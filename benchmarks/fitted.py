"""Iterations of the flow in environments, from models that `grasp fit --env` made for them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.benchmark import Benchmark, tick
from grasp_env.errors import InvalidInputError
from policies import LearnedInitialForce
from training.data.environment import environment
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import pd, table
from training.fit.in_environment import BASIS, CASES, REPAIRED, iterations


@dataclass(frozen=True)
class FittedSettings:
    """Settings of a benchmark.

    Attributes:
        models: paths of the models, as from `grasp fit --env ENV --out PATH`.
        episodes: episodes in each case, of 100 steps; with moved contacts each has its own.
        seed: seed of the first episode.
    """

    models: tuple[str, ...] = (
        "runs/fit/cuboid",
        "runs/fit/sphere",
        "runs/fit/allegro",
        "runs/fit/leap",
    )
    episodes: int = 20
    seed: int = 1_000_000


def run(settings: FittedSettings) -> pd.DataFrame:
    """Play the episodes of every model's environment."""
    return table(row for path in settings.models for row in _rows(path, settings))


def _rows(path: str, settings: FittedSettings) -> Iterator[dict[str, object]]:
    model = LearnedInitialForce.load(path)
    text = model.checkpoint.card["grasp"].get("env")
    if text is None:
        raise InvalidInputError(
            f"{path} is the model of a grasp, not of an environment: make one with `grasp fit --env`"
        )
    tick(f"{path}: {text}")
    for row in iterations(environment(text), model, settings.episodes, settings.seed):
        yield {"environment": text, **row}


CLAIMS = tuple(
    Claim.of(
        f"contacts {case}: {label} iterations from a fitted start over the 12-basis's",
        f"case == '{case}' and start == '{REPAIRED}'",
        f"iterations_{column} <= {most}",
        f"case == '{case}' and start == '{BASIS}'",
    )
    for case in CASES
    for label, column, most in (("median", "median", 0.25), ("p99", "p99", 0.5))
)
BENCHMARK = Benchmark(
    run,
    FittedSettings(),
    quick={"episodes": 2},
    shown=("iterations_median", "iterations_p95", "iterations_p99"),
    claims=CLAIMS,
)
