"""Settings of `grasp evaluate`: light to import, also the command line's options."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import Any

from grasp_env import ranges
from grasp_env._check import choice, number, together
from grasp_env.errors import InvalidInputError
from training.fit.settings import FitConfig
from training.runs import default_name
from training.runs.settings import check_counts
from training.trials.hand_plan import ENGINES, short_name


@dataclass(frozen=True)
class EvaluateConfig:
    """What is compared.

    Attributes:
        out: folder of runs.
        name: of this run; empty: evaluate-<date>-<time>. The name of an interrupted run continues it.
        wrenches: number of cases of a full set of wrenches; the other sets have their share of it.
        timed: number of wrenches whose calls are timed.
        repeats: how often each of those calls is timed.
        guarded: wrenches over six decades on which each model's guarantee is counted.
        paths: straight paths along which continuity is measured.
        episodes: of each random scenario of the roll-outs, per start.
        steps: of each roll-out, at 50 per second.
        seed: of everything held out; the fitted network's is `fit.seed`.
        quick: a small version that ends within a minute and says that it is quick.
        workers: processes; 0: one per core. The results do not depend on it, the timings are taken by one alone.
        fit_seconds: fit a network of the fixed grasp for so long and compare it, too; 0: none.
        fit: how that network is fitted.
        start: starts of your own that are compared with the others, each NAME=module:rule, NAME=file.py:rule or NAME=saved
            model's path; a rule takes (grasp, wrench) and returns an (N, 3) force.
    """

    out: str = "runs"
    name: str = ""
    wrenches: int = 1000
    timed: int = 500
    repeats: int = 7
    guarded: int = 20_000
    paths: int = 20
    episodes: int = 10
    steps: int = 100
    seed: int = 0
    quick: bool = False
    workers: int = 0
    fit_seconds: float = 0.0
    fit: FitConfig = field(default_factory=FitConfig)
    start: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        counts = ("wrenches", "timed", "repeats", "guarded", "paths", "episodes", "steps")
        check_counts(self, {**dict.fromkeys(counts, 1), "seed": 0, "workers": 0})
        number(self.fit_seconds, "fit_seconds", ranges.Range(0.0, 1e9, "s"))
        if self.fit.preset != "paper_cuboid":
            raise InvalidInputError(
                f"the fixed grasp of the comparison is the preset 'paper_cuboid', got fit.preset={self.fit.preset!r}: use "
                "`grasp fit` for other grasps"
            )

    def resolved(self) -> EvaluateConfig:
        """The settings in force: `quick` shrinks everything but the protocol."""
        fit = replace(self.fit, seconds=self.fit_seconds) if self.fit_seconds and not self.fit.steps else self.fit
        full = replace(self, name=self.name or default_name("evaluate"), fit=fit)
        if not self.quick:
            return full
        return replace(full, **{name: min(getattr(self, name), value) for name, value in _QUICK.items()})


_QUICK: dict[str, Any] = {"wrenches": 50, "timed": 50, "repeats": 3, "guarded": 1000, "paths": 2, "episodes": 1}


@dataclass(frozen=True)
class EnvEvaluateConfig:
    """How the environment is evaluated.

    Attributes:
        out: folder of runs.
        name: of this run; empty: env-<date>-<time>. The name of an interrupted run continues it.
        episodes: of each main scenario; the others have as many or fewer, see `hold_plan.plan`.
        seed: of the first episode; the next ones follow. The same seeds serve all controllers.
        quick: a small version that ends within a minute and says that it is quick.
        workers: processes; 0: one per core. The results do not depend on it.
    """

    out: str = "runs"
    name: str = ""
    episodes: int = 500
    seed: int = 0
    quick: bool = False
    workers: int = 0

    def __post_init__(self) -> None:
        check_counts(self, {"episodes": 1, "seed": 0, "workers": 0})


@dataclass(frozen=True)
class HandsConfig:
    """How hands are compared: objects, and what disturbs them.

    Attributes:
        hands: names, or paths of URDFs.
        engines: in which they hold, of `hand_plan.ENGINES`.
        out: folder of runs.
        name: of this run; empty: hands-<date>-<time>. The name of an interrupted run continues it.
        episodes: of every object and disturbance in which something is random.
        seed: of the first episode; the next ones follow. The same seeds serve all hands and engines.
        quick: a small version that says that it is quick.
        workers: processes; 0: one per core. The results do not depend on it.
    """

    hands: tuple[str, ...]
    engines: tuple[str, ...] = ("bullet",)
    out: str = "runs"
    name: str = ""
    episodes: int = 100
    seed: int = 0
    quick: bool = False
    workers: int = 0

    def __post_init__(self) -> None:
        _check(self)
        if not self.hands or not self.engines:
            raise InvalidInputError(
                f"name at least one hand and one engine, got hands={self.hands}, engines={self.engines}"
            )


@dataclass(frozen=True)
class TransferConfig:
    """How the same hands are compared in both engines.

    Attributes:
        out: folder of runs.
        name: of this run; empty: transfer-<date>-<time>. The name of an interrupted run continues it.
        hands: names, or paths of URDFs; none: four_finger, allegro and leap.
        episodes: of each main scenario in each engine; the others have a third.
        seed: of the first episode; the next ones follow. The same seeds serve all engines.
        quick: a small version that says that it is quick.
        workers: processes; 0: one per core. The results do not depend on it.
    """

    out: str = "runs"
    name: str = ""
    hands: tuple[str, ...] = ()
    episodes: int = 300
    seed: int = 0
    quick: bool = False
    workers: int = 0

    def __post_init__(self) -> None:
        _check(self)


def _check(config: HandsConfig | TransferConfig) -> None:
    """Counts, hands that exist, each under a name of its own, and engines."""
    from grasp_env.sim.hand.description import HANDS  # the command line's options need no simulator

    def hand(name: str) -> None:
        if not (name.endswith(".urdf") and os.path.isfile(name)):
            choice(name, "hand", HANDS, ", or the path of a .urdf file that exists")

    names = [short_name(name) for name in config.hands]
    together(
        lambda: check_counts(config, {"episodes": 1, "seed": 0, "workers": 0}),
        *(lambda name=name: hand(name) for name in config.hands),
        *(lambda name=name: choice(name, "engine", ENGINES) for name in getattr(config, "engines", ())),
    )
    if len(set(names)) < len(names):
        raise InvalidInputError(f"hands need different names, got {', '.join(names)}: rename a file")
