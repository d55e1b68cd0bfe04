"""`grasp evaluate`: compare starts, controllers, hands or engines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.extras import need
from training.evaluation.compare.scenarios import BOTH, ENGINES
from training.program.commands.answers import write_report
from training.program.commands.options import misplaced, one_of

OPTIONS = {
    "starts": ("wrenches", "timed", "repeats", "episodes", "steps", "start"),
    "env": ("hands", "episodes"),
    "env --hands ...": ("hands", "objects", "engines", "episodes"),
    "transfer": ("hands", "episodes"),
    "soft": ("episodes",),
    "errors": ("hands", "engines", "episodes", "tuning"),
}
"""Options that apply to some comparisons only."""


@dataclass(frozen=True)
class Evaluate:
    """Compare starts, controllers, hands or engines: a table and a report.

    To continue an interrupted run, give its name.

    Attributes:
        what: starts (compare all starts with both methods, time them, and simulate the hand: about
            a minute on two cores), env (how often controllers hold random objects; with --hands,
            how often these hands hold objects: hours), transfer (the same hands in Bullet and in
            MuJoCo: hours), soft (soft fingertips under shear and torsion in both: ten minutes) or
            errors (controllers under errors of sensors, motors and friction, each with settings
            that were chosen on other episodes: hours).
        out: folder of runs.
        name: name of this run; empty: <what>-<date>-<time>. The name of an interrupted run
            continues it.
        seed: seed of all held-out problems, or of the first episode.
        quick: a small version that ends within a minute; its report is marked as quick.
        on: where the work runs: inline, processes (on this machine), ray (the cluster of
            RAY_ADDRESS or of this machine) or ray://HOST:PORT. It does not change the rows; times
            are always measured alone, in this process.
        workers: number of processes; 0: one per core.
        wrenches: starts: number of cases in a full set; the other sets have a share of it.
        timed: starts: number of wrenches whose calls are timed.
        repeats: starts: number of times each of those calls is timed.
        episodes: episodes per random scenario, or per main scenario; 0: 10 for starts, 500 for env,
            100 for env --hands, 10 with --objects, 300 for transfer, 200 for each engine and margin
            for soft, 100 for errors.
        tuning: errors: episodes on which settings are chosen, for each of them; 0: 100.
        steps: starts: steps of each roll-out, at 50 per second.
        start: starts: your own starts to compare with the others, each NAME=module:rule,
            NAME=file.py:rule or NAME=path of a saved model. A rule takes (grasp, wrench) and
            returns an (N, 3) force.
        hands: env, transfer and errors: names, or files (URDF, xacro, MJCF); none: the four-finger
            hand, for transfer and errors also allegro and leap.
        objects: env --hands: mesh files to hold instead of the built-in objects, each FILE or
            FILE=SCALE; 150 g, friction 0.7.
        engines: env --hands: physics engines; none: the default one. errors: bullet, mujoco; none:
            both.
    """

    what: tyro.conf.Positional[Literal["starts", "env", "transfer", "soft", "errors"]] = "starts"
    out: str = "runs"
    name: str = ""
    seed: int = 0
    quick: bool = False
    on: str = "processes"
    workers: int = 0
    wrenches: int = 1000
    timed: int = 500
    repeats: int = 7
    episodes: int = 0
    tuning: int = 0
    steps: int = 100
    start: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    hands: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    engines: tuple[Annotated[str, one_of(ENGINES)], ...] = ()

    def execute(self) -> None:
        """Run the command."""
        self._check()
        need("sim", "report")
        from grasp_env.sim.engine import class_of, engine_of
        from training.evaluation.results.run import Run, default_name

        for name in BOTH if self.what in ("transfer", "soft", "errors") else ():
            if name in (self.engines or BOTH):
                class_of(engine_of(name), "simulator")  # report a missing engine before the folder
        kind = self.what
        if kind == "env" and self.hands:
            kind = "objects" if self.objects else "hands"
        folder = Run.create(self.out, self.name or default_name(kind))
        rows, about = self._measure(kind, folder)
        folder.save(rows, about)
        write_report(folder, self.quick)

    def _check(self) -> None:
        """Refuse options that belong to another comparison."""
        what = "env --hands ..." if self.what == "env" and self.hands else self.what
        if option := misplaced(self, OPTIONS, what):
            where = next(what for what, names in OPTIONS.items() if option in names)
            raise InvalidInputError(
                f"--{option} belongs to `grasp evaluate {where}`, got `grasp evaluate {self.what}`: leave it out, or name that comparison"
            )

    def _measure(self, kind: str, folder: Any) -> tuple[Any, dict[str, Any]]:
        shared = {"on": self.on, "workers": self.workers}
        if kind == "starts":
            from training.evaluation.compare.comparison import StartsConfig, run
            from training.evaluation.compare.given import Given

            names = ("wrenches", "timed", "repeats", "steps", "seed", "quick")
            settings = {name: getattr(self, name) for name in names}
            config = StartsConfig(**settings, episodes=self.episodes or StartsConfig.episodes)
            given = Given.of(self.start)
            folder.begin({"kind": kind, **vars(config.resolved()), "given": dict(given.names)})
            return run(config, given, folder, **shared)
        from training.evaluation.compare.holds import HoldsConfig
        from training.evaluation.compare.holds import run as hold

        names = ("hands", "engines", "episodes", "seed", "quick", "objects", "tuning")
        config = HoldsConfig(kind, **{name: getattr(self, name) for name in names})
        folder.begin(vars(config))
        return hold(config, folder, **shared)
