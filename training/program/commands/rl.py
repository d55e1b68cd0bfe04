"""`grasp rl`: train a reinforcement-learning agent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from grasp_env.inputs.extras import need
from training.rl.rl_config import RLConfig


@dataclass(frozen=True)
class RL(RLConfig):
    """Train PPO or SAC on FourFingerGrasp-v0.

    The agent is compared with the paper's start, and a report is written.

    Attributes:
        out: folder of the run: seed-<seed>/ with checkpoints and TensorBoard events, rows.csv.xz,
            run.json, report.html.
        resume: continue from the last complete checkpoint of each seed, with the same options. A
            larger --steps continues a finished run.
        compare: folders of finished runs. Nothing is trained; one report of all of them goes to
            `out`.
        on: where seeds run: inline, processes, ray or ray://HOST:PORT; empty: inline for one seed,
            else one process each. Ray needs an --out that all its machines share.
    """

    out: Path = Path("runs/rl/agent")
    resume: bool = False
    compare: tuple[Path, ...] = ()
    on: str = ""

    def execute(self) -> None:
        """Run the command."""
        config = RLConfig(**{name: getattr(self, name) for name in RLConfig.__dataclass_fields__})
        need("sim", "train", "report")
        from training.evaluation.report.page import write
        from training.evaluation.report.rl_page import scores_text
        from training.rl.train import compare, train

        if self.compare:
            run = compare(self.compare, self.out, config, self.on)
        else:
            run = train(config, self.out, self.resume, self.on)
        page = write(run)[0]
        print(scores_text(run.load()[0]))
        print(page)
