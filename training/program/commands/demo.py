"""`grasp demo`: a picture or a video of the hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from grasp_env.errors import InvalidInputError, NoGraspError
from grasp_env.inputs.extras import need
from grasp_env.task.disturbance import DISTURBANCES
from grasp_env.task.motion import MOTIONS
from grasp_env.task.tasks import TASKS
from training.program.commands.options import left_out, listed, one_of, setting_help, settings_of
from training.program.commands.rules import rule


@dataclass(frozen=True)
class Demo:
    """Roll out the hand, save a picture or a video, and print the outcome.

    The picture shows forces, friction cones and the wrench.

    If no place of the hand is found, hand-miss.png shows the nearest miss.

    Attributes:
        video: .webp or .gif for a video, .mp4 with the extra "video", .png for its last picture.
        setting: further settings of the environment, each PATH=VALUE: sensors.delay=0.01,
            controller.kind=pd, disturbance='{"name": "random", "force": 2}'.
        seconds: simulated time.
        initial: start rule, "learned" for the shipped network, or the path of a fitted one.
        agent: the folder of one seed of `grasp rl`, such as runs/rl/agent/seed-0. The agent acts in
            the environment it was trained in.
        size: width and height [pixels].
        seed: seed of the episode.
    """

    video: Path = Path("hand.webp")
    task: Annotated[str, one_of(TASKS), setting_help("task")] = "hold"
    disturbance: Annotated[
        str, one_of(DISTURBANCES), setting_help("disturbance", "the task's own, of hold paper_path")
    ] = ""
    motion: Annotated[str, one_of(MOTIONS), setting_help("task.motion")] = "lift"
    shape: Annotated[
        str,
        listed("grasp_env.sim.objects.description", "SHAPES_WITHOUT_MESH"),
        setting_help("object.shape"),
    ] = "cuboid"
    hand: Annotated[str, listed("grasp_env.sim", "HANDS"), setting_help("hand")] = "four_finger"
    setting: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PATH=VALUE")
    ] = ()
    seconds: Annotated[float, left_out("the task's own")] = 0.0
    initial: str = "linear_combination"
    agent: Path | None = None
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="WIDTH HEIGHT")] = (480, 480)
    seed: int = 0

    def execute(self) -> None:
        """Run the command."""
        need("sim")
        from rich.console import Console

        from policies import TrainedAgent
        from training.program.film import record

        given = settings_of(self.setting)
        for path in ("initial_force", "solver.initial_force"):
            if path in given:
                raise InvalidInputError(
                    f"--setting {path}={given[path]} is an option of its own: give --initial {given[path]}"
                )
        agent = None if self.agent is None else TrainedAgent.load(self.agent)
        settings: dict[str, Any] = {"task": self.task, "shape": self.shape, "hand": self.hand}
        if self.task == "move":
            settings["task.motion"] = self.motion
        if self.disturbance or agent is None:
            settings["disturbance"] = self.disturbance or (
                "paper_path" if self.task == "hold" else None
            )
        try:
            ending = record(
                self.video,
                self.seconds or None,
                rule(self.initial) if agent is None else None,
                self.seed,
                policy=agent,
                config=None if agent is None else agent.meta["env_settings"],
                **{"pictures.size": self.size, **settings, **given},
            )
        except NoGraspError as error:
            if error.nearest is not None:
                picture = error.nearest.draw(self.video.with_name(f"{self.video.stem}-miss.png"))
                Console(stderr=True).print(
                    f"the nearest miss: {picture}", highlight=False, soft_wrap=True
                )
            raise
        Console().print(f"{ending}: {self.video}", highlight=False)
