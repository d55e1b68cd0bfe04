"""`grasp rl`: train a reinforcement-learning agent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from grasp_env._extras import need
from training.rl.settings import RLConfig


@dataclass(frozen=True)
class RL(RLConfig):
    """Train PPO or SAC on FourFingerGrasp-v0.

    The agent is scored beside the paper's start, and a report is written.

    Attributes:
        out: folder of the run: seed-<seed>/ with checkpoints and TensorBoard events, rl.md, rl.json, learning_curve.png.
        resume: go on from the last whole checkpoint of each seed; the other options as before, but for --steps: more go on from a finished run.
        compare: folders of finished runs: nothing is trained, one report of them all goes to `out`.
    """

    out: Path = Path("runs/rl/agent")
    resume: bool = False
    compare: tuple[Path, ...] = ()

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        config = RLConfig(**{name: getattr(self, name) for name in RLConfig.__dataclass_fields__})
        from training.runs import Run

        if self.compare:
            need("sim", "train", "report")
            from training.rl.evaluate import evaluate_runs

            runs = [Run.open(folder, "run.json").folder for folder in self.compare]
            evaluate_runs(runs, Run.create(self.out.parent, self.out.name).folder, config.episodes, config.quick)
        else:
            from training.rl.train import train

            train(config, self.out, self.resume)
