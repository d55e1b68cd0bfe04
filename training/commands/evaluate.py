"""`grasp evaluate`: compare starts, or measure how well the hand holds."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from grasp_env._extras import need
from grasp_env.errors import InvalidInputError
from training.commands.claims import print_claims
from training.commands.options import one_of
from training.trials.hand_plan import ENGINES
from training.trials.settings import EnvEvaluateConfig, EvaluateConfig, HandsConfig, TransferConfig


@dataclass(frozen=True)
class Evaluate(EvaluateConfig):
    """Compare starts, hands or engines, and write a report.

    An interrupted run goes on by its name.

    Attributes:
        what: starts (every start on every set of cases by both methods, times, continuity, roll-outs: about five minutes on two
            cores, fits nothing unless told to), env (hold rates over random objects and wrenches, failures, the squeeze that
            robustness costs; with --hands these hands against objects and disturbances) or transfer (the same hands in Bullet and
            in MuJoCo).
        episodes: per start of each random scenario, or of each main scenario; 0: 10, of env 500, of env --hands 100, of transfer 300.
        hands: of env and transfer: names, or paths of URDFs; none: the four-finger hand, of transfer also allegro and leap.
        engines: of env --hands, in which they hold.
    """

    what: tyro.conf.Positional[Literal["starts", "env", "transfer"]] = "starts"
    episodes: int = 0
    hands: tuple[str, ...] = ()
    engines: tuple[Annotated[str, one_of(ENGINES)], ...] = ("bullet",)
    start: tyro.conf.UseAppendAction[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        pass  # checked where the evaluation's own settings are made of these

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        if self.engines != ("bullet",) and not (self.what == "env" and self.hands):
            raise InvalidInputError(
                f"--engines belongs to `grasp evaluate env --hands ...`, got {' '.join(self.engines)}"
            )
        need("sim", "report", *(["mujoco"] if self.what == "transfer" else []))
        from training.report.build import build_report, report_path
        from training.trials.comparison import evaluate
        from training.trials.hand_trials import evaluate_hands, evaluate_transfer
        from training.trials.hold_rates import evaluate_env

        kinds: dict[str, tuple[Any, Any]] = {
            "starts": (EvaluateConfig, evaluate),
            "env": (HandsConfig, evaluate_hands) if self.hands else (EnvEvaluateConfig, evaluate_env),
            "transfer": (TransferConfig, evaluate_transfer),
        }
        kind, measure = kinds[self.what]
        if self.start and self.what != "starts":
            raise InvalidInputError(
                f"--start belongs to `grasp evaluate starts`, which compares starts, got `grasp evaluate {self.what}`: leave it out"
            )
        settings = {name: getattr(self, name) for name in kind.__dataclass_fields__}
        if not self.episodes:
            del settings["episodes"]
        run = measure(kind(**settings))
        metrics = build_report(run)
        sys.stderr.write(f"report: {report_path(run)}\n")
        print_claims(metrics)
