"""`grasp demo`: a picture or a video of the hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from grasp_env._extras import need
from training.commands.rules import rule


@dataclass(frozen=True)
class Demo:
    """Roll out the hand and save a picture or a video, with forces, friction cones and wrench drawn in; say how it ended.

    Attributes:
        video: .mp4, .gif or .webp for a video, .png for its last picture.
        task: hold, move, payload or six_directions.
        disturbance: none, constant, paper_path, random, impulses or tilting_gravity; empty: the task's own, for hold the paper's path.
        motion: of move: lift, shake or rotate.
        shape: cuboid, cylinder, sphere, capsule.
        hand: four_finger, three_finger, five_finger or four_finger_4dof.
        seconds: simulated time; 0: the task's own.
        initial: start rule, "learned" for the shipped network, or the path of a fitted one.
        agent: a seed's folder of `grasp rl`, runs/rl/agent/seed-0: it acts, in the environment that it was trained in.
        size: width and height [pixels].
        seed: of the episode.
    """

    video: Path = Path("hand.mp4")
    task: str = "hold"
    disturbance: str = ""
    motion: str = "lift"
    shape: str = "cuboid"
    hand: str = "four_finger"
    seconds: float = 0.0
    initial: str = "linear_combination"
    agent: Path | None = None
    size: tuple[int, int] = (480, 480)
    seed: int = 0

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need("sim", "report")
        from policies import TrainedAgent
        from training.demo.record import record

        agent = None if self.agent is None else TrainedAgent.load(self.agent)
        settings = {} if agent is None else dict(agent.meta["env_settings"])
        start = settings.pop("initial_force", None)
        settings |= {name: getattr(self, name) for name in ("task", "motion", "shape", "hand")}
        if self.disturbance or agent is None:
            settings["disturbance"] = self.disturbance or ("paper_path" if self.task == "hold" else None)
        ending = record(
            self.video,
            self.seconds or None,
            rule(self.initial) if agent is None else start,
            self.seed,
            policy=agent,
            render_size=self.size,
            **settings,
        )
        Console().print(f"{ending}: {self.video}", highlight=False)
