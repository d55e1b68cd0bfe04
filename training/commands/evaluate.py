"""`grasp evaluate`: compare starts, or measure how well the hand holds."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Literal

import tyro

from grasp_env._extras import need
from training.commands.claims import print_claims
from training.trials.settings import EnvEvaluateConfig, EvaluateConfig


@dataclass(frozen=True)
class Evaluate(EvaluateConfig):
    """Compare and write a report: all starts of the optimisation, or how well the hand holds. An interrupted run goes on by its name.

    Attributes:
        what: starts (every start on every set of cases by both methods, times, continuity, roll-outs: about five minutes on two
            cores, fits nothing unless told to) or env (hold rates over random objects and wrenches, failures, the squeeze that
            robustness costs).
        episodes: per start of each random scenario, or of each main scenario of env; 0: 10, of env 500.
    """

    what: tyro.conf.Positional[Literal["starts", "env"]] = "starts"
    episodes: int = 0

    def __post_init__(self) -> None:
        pass  # checked where the evaluation's own settings are made of these

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need("sim", "report")
        from training.report.build import build_report, report_path
        from training.trials.comparison import evaluate
        from training.trials.hold_rates import evaluate_env

        kind: Any = EnvEvaluateConfig if self.what == "env" else EvaluateConfig
        measure: Any = evaluate_env if self.what == "env" else evaluate
        settings = {name: getattr(self, name) for name in kind.__dataclass_fields__}
        if not self.episodes:
            del settings["episodes"]
        run = measure(kind(**settings))
        metrics = build_report(run)
        sys.stderr.write(f"report: {report_path(run)}\n")
        print_claims(metrics)
