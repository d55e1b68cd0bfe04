"""`grasp bench`: timings, side by side in one run."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from grasp_env import ranges
from grasp_env._extras import need
from grasp_env.errors import InvalidInputError, shown
from training.commands.answers import write_json
from training.commands.options import left_out


@dataclass(frozen=True)
class Bench:
    """Time the solvers or the environment, side by side in one run.

    Attributes:
        what: solver (ours beside Clarabel, QOCO, QOCOGEN, Moreau, ... from the extra [bench]), scaling (cost against contacts),
            batch (solves per second on one core and all), env (steps per second beside bare PyBullet, resets, memory)
            or core (this checkout beside an earlier one, taking turns on one core: solves, moving contacts, grasps).
        contacts: numbers of contacts; empty: the benchmark's own.
        wrenches: problems per size; 0: the benchmark's own number.
        quick: of env and core: a small version, about 20 s; its numbers are rough.
        baseline: of core: folder of another checkout with its own .venv (git worktree add PATH COMMIT; make -C PATH install);
            without it only this one is timed.
        start: of core: also the first solve of so many new processes per method and side.
        seed: of the problems.
        out: folder for the JSON, figures and generated C code.
        compare: an earlier JSON of the same kind to set beside.
        json: print one JSON object, errors too.
    """

    what: tyro.conf.Positional[Literal["solver", "scaling", "batch", "env", "core"]]
    contacts: tuple[int, ...] = ()
    wrenches: int = 0
    seed: int = 0
    quick: bool = False
    out: Path = Path("runs/bench")
    baseline: Annotated[Path | None, left_out("none", "FOLDER")] = None
    start: int = 0
    compare: Annotated[Path | None, left_out("none", "FILE")] = None
    json: bool = False

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need(*(("sim", "report") if self.what == "env" else ("report",)))
        from training.bench import batch, core, scaling, show, solver
        from training.runs import Run

        changes: dict[str, Any] = {"seed": _at_least(self.seed, "seed", 0, ranges.SEED)}
        if self.wrenches:
            changes["wrenches"] = _at_least(self.wrenches, "wrenches", 8)
        if self.contacts:
            changes["sizes"] = tuple(_at_least(count, "contacts", 3, ranges.CONTACTS) for count in self.contacts)
        if self.what != "core" and (self.baseline is not None or self.start):
            raise InvalidInputError(f"baseline and start belong to grasp bench core, not to {self.what}")
        quick = {"rounds": 2, "passes": 2, "wrenches": 80} if self.quick and self.what == "core" else {}
        benches: dict[str, tuple[Any, Callable[..., dict[str, Any]], dict[str, Any]]] = {
            "solver": (solver, solver.solver, {"folder": self.out}),
            "scaling": (scaling, scaling.scaling, {}),
            "batch": (batch, batch.batch, {}),
            "core": (core, core.core, {"baseline": self.baseline, "start": _at_least(self.start, "start", 0, 1000)}),
        }
        if self.what == "env":
            from training.bench.env import env_bench as run

            options: dict[str, Any] = {"seed": changes["seed"], "quick": self.quick}
        else:
            module, run, options = benches[self.what]
            options["effort"] = replace(module.EFFORT, **(quick | changes))
        Run.create(self.out, "")
        console = Console(stderr=True)
        with console.status("starting") as status:
            if sys.stderr.isatty():
                options["tick"] = lambda text: status.update(text[: console.width - 4])  # one line
            result = run(**options)
        path = show.save(result, self.out)
        if self.json:
            write_json(result)
            return
        show.show(result, Console())
        if self.compare is not None:
            show.compare(result, self.compare, Console())
        Console().print(str(path), highlight=False)


def _at_least(value: int, name: str, least: int, most: int = 10_000_000) -> int:
    """`value`, or an error where it is below `least` or absurdly large."""
    if not least <= value <= most:
        raise InvalidInputError(f"{name} must be at least {least}, at most {most}, got {shown(value)}")
    return value
