"""Grasp forces of a simulated four-finger hand: solve, fit, evaluate, report, reproduce, bench, demo, warmup."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from grasp_env.errors import GraspError, InfeasibleWrenchError, InvalidInputError, UnknownNameError
from grasp_env.force import RULES, ForceLimits, InitialForceRule, optimize_force
from grasp_env.grasp import load_grasp, presets
from grasp_env.grasp.advice import advise
from policies import LearnedInitialForce
from training.settings import EvaluateConfig, FitConfig


@dataclass(frozen=True)
class Solve:
    """Optimise one grasp force and print it.

    Attributes:
        wrench: external wrench on the object: fx fy fz [N] mx my mz [N m].
        preset: the named grasp.
        grasp: a grasp's JSON file (positions, normals, friction, ...) instead of a preset.
        friction: replaces the preset's or the file's coefficient.
        initial: start rule, "learned" for the shipped network, or the path of a fitted one; of the methods on Phi.
        method: reduced_flow, full_flow, newton, conic or linear.
        criterion: what conic makes least, sum or max of the normal forces.
        barrier_weight: lambda [N^2].
        tolerance: relative gap; 0: the method's own (1e-4, conic 1e-6).
        min_normal, max_normal: limits of every normal force [N].
        json: print JSON for machines.
    """

    wrench: tuple[float, float, float, float, float, float] = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    preset: str = "paper_cuboid"
    grasp: Path | None = None
    friction: float | None = None
    initial: str | None = None
    method: str = "reduced_flow"
    criterion: str = "sum"
    barrier_weight: float = 0.01
    tolerance: float = 0.0
    min_normal: float = 0.0
    max_normal: float = math.inf
    json: bool = False


@dataclass(frozen=True)
class Report:
    """Rebuild a run's report from its saved trials; nothing is solved.

    Attributes:
        run: the run's folder.
    """

    run: tyro.conf.Positional[Path]


@dataclass(frozen=True)
class Reproduce:
    """Study what the paper leaves open (weights, step rules), its reduction and its claims: tables and figures.

    Attributes:
        out: the folder that gets a run.
        quick: few wrenches, for a first look.
    """

    out: Path = Path("runs")
    quick: bool = False


@dataclass(frozen=True)
class Demo:
    """Roll out the hand and save a picture or a video.

    Attributes:
        out: .png for a picture, .mp4 or .gif for a video.
        wrench: none, constant, paper_path or random.
        seconds: simulated time.
        initial: start rule, "learned" for the shipped network, or the path of a fitted one.
        seed: of the episode.
    """

    out: Path = Path("hand.mp4")
    wrench: str = "paper_path"
    seconds: float = 2.0
    initial: str = "linear_combination"
    seed: int = 0


@dataclass(frozen=True)
class Bench:
    """Time the solvers, side by side in one run.

    Attributes:
        what: solver (ours beside Clarabel, QOCO, QOCOGEN, ... from the extra [bench]), scaling (cost against contacts) or
            batch (solves per second on one core and all).
        contacts: numbers of contacts; empty: the benchmark's own.
        wrenches: problems per size; 0: the benchmark's own number.
        seed: of the problems.
        out: folder for the JSON, figures and generated C code.
        compare: an earlier JSON of the same kind to set beside.
        json: print JSON for machines.
    """

    what: tyro.conf.Positional[Literal["solver", "scaling", "batch"]]
    contacts: tuple[int, ...] = ()
    wrenches: int = 0
    seed: int = 0
    out: Path = Path("runs/bench")
    compare: Path | None = None
    json: bool = False


@dataclass(frozen=True)
class Warmup:
    """Compile every kernel and cache it on disk, so that later processes load instead of compiling (tens of ms)."""


@dataclass(frozen=True)
class Fit(FitConfig):
    """Train a network that predicts the initial force, and save it as two files.

    Attributes:
        out: their common stem.
    """

    out: Path = Path("runs/fit/four_finger")


@dataclass(frozen=True)
class Evaluate(EvaluateConfig):
    """Fit a network, compare all starts, roll out the hand, write the report."""


Command = (
    Annotated[Solve, tyro.conf.subcommand("solve")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Warmup, tyro.conf.subcommand("warmup")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one sub-command.

    Returns:
        0; 2 after an error of the project, told in one line on stderr; 130 after an interrupt.
    """
    command = tyro.cli(Command, prog="grasp", description=__doc__, args=arguments)  # type: ignore[arg-type]
    try:
        _HANDLERS[type(command)](command)
    except GraspError as error:
        sys.stderr.write(f"grasp: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("grasp: interrupted\n")
        return 130
    return 0


def _rule(name: str) -> str | InitialForceRule:
    """A rule's name, "learned", or the path of a model that `grasp fit` saved."""
    if name == "learned":
        return LearnedInitialForce.pretrained()
    if name in RULES or name == "previous":
        return name
    if name.endswith((".json", ".safetensors")) or Path(f"{name}.json").is_file():
        return LearnedInitialForce.load(name)
    raise UnknownNameError(
        "initial-force rule", name, (*RULES, "previous", "learned"), ", or give a saved model's path"
    )


def _at_least(value: int, name: str, least: int) -> int:
    """`value`, or an error where it is below `least`."""
    if value < least:
        raise InvalidInputError(f"{name} must be at least {least}, got {value}")
    return value


def _solve(command: Solve) -> None:
    if command.grasp is None:
        grasp = presets.preset(command.preset, command.friction)
    else:
        grasp = load_grasp(command.grasp)
        grasp = grasp if command.friction is None else grasp.with_friction(command.friction)
    limited = (command.min_normal, command.max_normal) != (0.0, math.inf)
    try:
        solution = optimize_force(
            grasp,
            np.array(command.wrench),
            initial=None if command.initial is None else _rule(command.initial),
            method=command.method,
            criterion=command.criterion,
            limits=ForceLimits(min_normal=command.min_normal, max_normal=command.max_normal) if limited else None,
            barrier_weight=command.barrier_weight,
            tolerance=command.tolerance or None,
        )
    except InfeasibleWrenchError:
        for advice in advise(grasp):
            sys.stderr.write(f"grasp: {advice}\n")
        raise
    if command.json:
        numbers = {
            "force": solution.force.tolist(),
            "torsion": solution.torsion.tolist(),
            "status": solution.status.value,
            "iterations": solution.iterations,
            "trials": solution.trials,
            "objective": solution.objective,
            "optimality_gap": solution.optimality_gap if np.isfinite(solution.optimality_gap) else None,
            "equilibrium_residual": solution.equilibrium_residual,
            "cone_margin": solution.cone_margin,
            "multipliers": solution.multipliers.tolist(),
            "total_normal_force": solution.total_normal_force,
        }
        sys.stdout.write(json.dumps(numbers, allow_nan=False) + "\n")
        solution.raise_for_status()
        return
    table = Table(
        "contact",
        "normal [N]",
        "o [N]",
        "t [N]",
        "mu n - |tangential| [N]",
        title=f"{command.preset if command.grasp is None else command.grasp.name}: {solution.status.value}",
    )
    x = grasp.to_cone(solution.force).reshape(-1, 3)
    for k, (normal, o, t) in enumerate(solution.force):
        margin = x[k, 0] - float(np.hypot(x[k, 1], x[k, 2]))
        table.add_row(str(k), f"{normal:.4f}", f"{o:.4f}", f"{t:.4f}", f"{margin:.4f}")
    console = Console()
    console.print(table)
    console.print(
        f"{solution.method} from {solution.initial}: {solution.iterations} iterations ({solution.trials} trials), "
        f"certified gap {solution.optimality_gap:.1e}, balance residual {solution.equilibrium_residual:.1e} N, "
        f"total normal force {solution.total_normal_force:.3f} N",
        highlight=False,
    )
    solution.raise_for_status()


def _fit(command: Fit) -> None:
    from training.fit import fit
    from training.runs import Run

    Run.create(command.out.parent, "")
    settings = FitConfig(**{name: getattr(command, name) for name in FitConfig.__dataclass_fields__})
    result = fit(settings, progress=sys.stderr.isatty(), command=" ".join(["grasp", *sys.argv[1:]]))
    path = result.checkpoint.save(command.out)
    gap = result.checkpoint.card["held_out_gap_second_order"]
    Console().print(f"{path}: held-out gap {gap['median']:.1e} median, {gap['p99']:.1e} p99", highlight=False)


def _evaluate(command: Evaluate) -> None:
    from training.evaluate import evaluate

    metrics = evaluate(EvaluateConfig(**{name: getattr(command, name) for name in EvaluateConfig.__dataclass_fields__}))
    _print_claims(metrics)


def _report(command: Report) -> None:
    from training.report import build_report, report_path
    from training.runs import Run

    run = Run.open(command.run, "run.json")
    _print_claims(build_report(run))
    Console().print(str(report_path(run)), highlight=False)


def _demo(command: Demo) -> None:
    from training.demo import record

    record(command.out, command.wrench, command.seconds, _rule(command.initial), command.seed)
    Console().print(str(command.out), highlight=False)


def _reproduce(command: Reproduce) -> None:
    from training.reproduce import reproduce

    metrics = reproduce(command.out, command.quick, sys.stderr.isatty())
    Console().print(str(Path(metrics["folder"]) / "report.md"), highlight=False)


def _bench(command: Bench) -> None:
    from training.bench import batch, scaling, show, solver
    from training.runs import Run

    options: dict[str, Any] = {"seed": command.seed}
    if command.wrenches:
        options["wrenches"] = _at_least(command.wrenches, "wrenches", 8)
    if command.contacts and command.what != "batch":
        options["sizes"] = tuple(_at_least(count, "contacts", 3) for count in command.contacts)
    if command.what == "solver":
        options["folder"] = command.out
    Run.create(command.out, "")
    console = Console(stderr=True)
    with console.status("starting") as status:
        if sys.stderr.isatty():
            options["tick"] = status.update
        run = {"solver": solver.solver, "scaling": scaling.scaling, "batch": batch.batch}[command.what]
        result = run(**options)
    path = show.save(result, command.out)
    if command.json:
        sys.stdout.write(json.dumps(result, allow_nan=False, default=str) + "\n")
        return
    show.show(result, Console())
    if command.compare is not None:
        show.compare(result, command.compare, Console())
    Console().print(str(path), highlight=False)


def _warmup(command: Warmup) -> None:
    from training.demo import warm_up

    Console().print(f"kernels compiled and cached in {warm_up():.1f} s", highlight=False)


def _print_claims(metrics: dict[str, Any]) -> None:
    if metrics["run"]["quick"]:
        sys.stdout.write("QUICK RUN: a network fitted for seconds and few wrenches; its claims may well be missed.\n")
    for row in sorted(metrics["claims"], key=lambda row: row["met"]):
        verdict = "met   " if row["met"] else "MISSED"
        sys.stdout.write(f"{verdict}  {row['claim']}\n        asked {row['asked']}; measured {row['measured']}\n")


_HANDLERS: dict[type, Callable[[Any], None]] = {
    Solve: _solve,
    Fit: _fit,
    Evaluate: _evaluate,
    Report: _report,
    Demo: _demo,
    Reproduce: _reproduce,
    Bench: _bench,
    Warmup: _warmup,
}


if __name__ == "__main__":
    sys.exit(main())
