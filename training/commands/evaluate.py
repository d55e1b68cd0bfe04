"""`grasp evaluate`: compare starts, controllers, hands or engines."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

import tyro

from grasp_env._extras import need
from grasp_env.errors import InvalidInputError
from training.commands.options import one_of
from training.compare.scenarios import BOTH, ENGINES

OWN = {
    "starts": ("wrenches", "timed", "repeats", "episodes", "steps", "start", "solver"),
    "env": ("hands", "objects", "engines", "episodes"),
    "transfer": ("hands", "episodes"),
}
"""Options that belong to some of the comparisons only."""


@dataclass(frozen=True)
class Evaluate:
    """Compare starts, controllers, hands or engines: a table and a report.

    An interrupted run goes on by its name.

    Attributes:
        what: starts (every start on every set of cases by both methods, times, roll-outs: about a minute on two cores), env (how often
            controllers hold random objects; with --hands how often these hands hold objects: hours) or transfer (the same hands
            in Bullet and in MuJoCo: hours).
        out: folder of runs.
        name: of this run; empty: <what>-<date>-<time>. The name of an interrupted run continues it.
        seed: of everything held out, or of the first episode.
        quick: a small version that ends within a minute and says that it is quick.
        on: where the work is done: inline, processes (of this machine), ray (the cluster of RAY_ADDRESS or of this machine) or
            ray://HOST:PORT. The rows do not depend on it; times are always measured alone, in this process.
        workers: processes; 0: one for each core.
        wrenches: of starts: number of cases of a full set; the other sets have their share of it.
        timed: of starts: number of wrenches whose calls are timed.
        repeats: of starts: how often each of those calls is timed.
        episodes: of each random scenario, or of each main scenario; 0: 10 of starts, 500 of env, 100 of env --hands, 10 with --objects,
            300 of transfer.
        steps: of starts: of each roll-out, at 50 per second.
        start: of starts: starts of your own that are compared with the others, each NAME=module:rule, NAME=file.py:rule or NAME=saved
            model's path; a rule takes (grasp, wrench) and returns an (N, 3) force.
        solver: of starts: solvers of your own, each NAME=module:Class or NAME=file.py:Class; solve(problem) returns the (N, 3) forces.
        hands: of env and transfer: names, or files (URDF, xacro, MJCF); none: the four-finger hand, of transfer also allegro and leap.
        objects: of env --hands: mesh files to be held instead of our objects, each FILE or FILE=SCALE; 150 g, friction 0.7.
        engines: of env --hands, the engines in which they hold; none: the default one.
    """

    what: tyro.conf.Positional[Literal["starts", "env", "transfer"]] = "starts"
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
    steps: int = 100
    start: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    solver: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    hands: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    engines: tuple[Annotated[str, one_of(ENGINES)], ...] = ()

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        self._check()
        need("sim", "report")
        from grasp_env.sim.engine import class_of, engine_of
        from training.report.page import write
        from training.results.claims import lines
        from training.results.run import Run, default_name

        if self.what == "transfer":
            for name in BOTH:
                class_of(engine_of(name), "simulator")  # says what is not installed before there is a folder
        kind = self.what
        if kind == "env" and self.hands:
            kind = "objects" if self.objects else "hands"
        folder = Run.create(self.out, self.name or default_name(kind))
        rows, about = self._measure(kind, folder)
        folder.save(rows, about)
        report = write(folder)
        sys.stderr.write(f"report: {report.path}\n")
        if self.quick:
            sys.stdout.write("QUICK RUN: few trials; do not quote.\n")
        sys.stdout.writelines(f"{line}\n" for line in lines(report.claims))

    def _check(self) -> None:
        """Refuses options that belong to another comparison."""
        unused = {name for names in OWN.values() for name in names} - {*OWN[self.what]}
        if self.what == "env" and not self.hands:
            unused |= {"engines", "objects"}
        given = [item.name for item in fields(self) if item.name in unused and getattr(self, item.name) != item.default]
        if given:
            where = [what for what, names in OWN.items() if given[0] in names]
            hands = " --hands ..." if given[0] in ("engines", "objects") else ""
            raise InvalidInputError(
                f"--{given[0]} belongs to `grasp evaluate {where[0]}{hands}`, got `grasp evaluate {self.what}`: leave it out, or name "
                "that comparison"
            )

    def _measure(self, kind: str, folder: Any) -> tuple[Any, dict[str, Any]]:
        """The rows of the comparison and what run.json says of them."""
        shared = {"on": self.on, "workers": self.workers}
        if kind == "starts":
            from training.compare.comparison import StartsConfig, run
            from training.compare.given import Given

            own = {name: getattr(self, name) for name in ("wrenches", "timed", "repeats", "steps", "seed", "quick")}
            config = StartsConfig(**own, episodes=self.episodes or StartsConfig.episodes)
            given = Given.of(self.start, self.solver)
            folder.begin({"kind": kind, **vars(config.resolved()), "given": dict(given.names)})
            return run(config, given, folder, **shared)
        from training.compare.holds import HoldsConfig
        from training.compare.holds import run as hold

        config = HoldsConfig(kind, self.hands, self.engines, self.episodes, self.seed, self.quick, self.objects)
        folder.begin(vars(config))
        return hold(config, folder, **shared)
