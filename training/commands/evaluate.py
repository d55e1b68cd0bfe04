"""`grasp evaluate`: compare starts, or measure how well the hand holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import tyro

from grasp_env._extras import need
from training.commands.claims import print_claims
from training.settings import EvaluateConfig


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
        kind: Any = EvaluateConfig
        if self.what == "env":
            from training.env_evaluation import EnvEvaluateConfig, evaluate_env

            kind, run = EnvEvaluateConfig, evaluate_env
        else:
            from training.evaluate import evaluate as run
        settings = {name: getattr(self, name) for name in kind.__dataclass_fields__}
        if not self.episodes:
            del settings["episodes"]
        print_claims(run(kind(**settings)))
