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

from grasp_env.errors import GraspError, InfeasibleWrenchError, InvalidInputError, UnknownNameError
from grasp_env.force import RULES, ForceLimits, InitialForceRule, optimize_force
from grasp_env.grasp import load_grasp, presets
from grasp_env.grasp.advice import advise
from policies import LearnedInitialForce
from training.settings import EvaluateConfig, FitConfig
from training.solution import print_solution


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
    """Roll out the hand and save a picture or a video, with forces, friction cones and wrench drawn in.

    Attributes:
        video: .mp4 or .gif for a video, .png for its last picture.
        task: hold, move, payload or six_directions.
        disturbance: none, constant, paper_path, random, impulses or tilting_gravity; empty: the task's own, for hold the paper's path.
        motion: of move: lift, shake or rotate.
        shape: cuboid, cylinder, sphere, capsule.
        hand: four_finger, three_finger, five_finger or four_finger_4dof.
        seconds: simulated time; 0: the task's own.
        initial: start rule, "learned" for the shipped network, or the path of a fitted one.
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
    size: tuple[int, int] = (480, 480)
    seed: int = 0


@dataclass(frozen=True)
class Bench:
    """Time the solvers or the environment, side by side in one run.

    Attributes:
        what: solver (ours beside Clarabel, QOCO, QOCOGEN, ... from the extra [bench]), scaling (cost against contacts),
            batch (solves per second on one core and all) or env (steps per second beside bare PyBullet, resets, memory).
        contacts: numbers of contacts; empty: the benchmark's own.
        wrenches: problems per size; 0: the benchmark's own number.
        quick: of env: a small version, about 20 s; its numbers are rough.
        seed: of the problems.
        out: folder for the JSON, figures and generated C code.
        compare: an earlier JSON of the same kind to set beside.
        json: print JSON for machines.
    """

    what: tyro.conf.Positional[Literal["solver", "scaling", "batch", "env"]]
    contacts: tuple[int, ...] = ()
    wrenches: int = 0
    seed: int = 0
    quick: bool = False
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
    """Compare and write a report: all starts and a fitted network, or how well the hand holds.

    Attributes:
        what: starts (fit a network, compare all starts, roll out the hand) or env (hold rates over random objects and wrenches,
            failures, the squeeze that robustness costs; an interrupted run of the same name goes on).
        episodes: per start of each random scenario, or of each main scenario of env; 0: 10, of env 500.
        workers: of env: processes; 0: one per core.
    """

    what: tyro.conf.Positional[Literal["starts", "env"]] = "starts"
    episodes: int = 0
    workers: int = 0

    def __post_init__(self) -> None:
        pass  # checked where the evaluation's own settings are made of these


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
    title = command.preset if command.grasp is None else command.grasp.name
    print_solution(solution, grasp, title, command.json)
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
    kind: Any = EvaluateConfig
    if command.what == "env":
        from training.env_evaluation import EnvEvaluateConfig, evaluate_env

        kind, run = EnvEvaluateConfig, evaluate_env
    else:
        from training.evaluate import evaluate as run
    settings = {name: getattr(command, name) for name in kind.__dataclass_fields__}
    if not command.episodes:
        del settings["episodes"]
    _print_claims(run(kind(**settings)))


def _report(command: Report) -> None:
    from training.env_report import build_env_report
    from training.report import build_report, report_path
    from training.runs import Run

    run = Run.open(command.run, "run.json")
    build = build_env_report if run.read_json("run.json").get("kind") == "env" else build_report
    _print_claims(build(run))
    Console().print(str(report_path(run)), highlight=False)


def _demo(command: Demo) -> None:
    from training.demo import record

    disturbance = command.disturbance or ("paper_path" if command.task == "hold" else None)
    record(
        command.video,
        command.seconds or None,
        _rule(command.initial),
        command.seed,
        **{name: getattr(command, name) for name in ("task", "motion", "shape", "hand")},
        disturbance=disturbance,
        render_size=command.size,
    )
    Console().print(str(command.video), highlight=False)


def _reproduce(command: Reproduce) -> None:
    from training.reproduce import reproduce

    metrics = reproduce(command.out, command.quick, sys.stderr.isatty())
    Console().print(str(Path(metrics["folder"]) / "report.md"), highlight=False)


def _bench(command: Bench) -> None:
    from training.bench import batch, env, scaling, show, solver
    from training.runs import Run

    options: dict[str, Any] = {"seed": command.seed}
    if command.what == "env":
        options["quick"] = command.quick
    elif command.wrenches:
        options["wrenches"] = _at_least(command.wrenches, "wrenches", 8)
    if command.contacts and command.what in ("solver", "scaling"):
        options["sizes"] = tuple(_at_least(count, "contacts", 3) for count in command.contacts)
    if command.what == "solver":
        options["folder"] = command.out
    Run.create(command.out, "")
    console = Console(stderr=True)
    with console.status("starting") as status:
        if sys.stderr.isatty():
            options["tick"] = status.update
        benches = {"solver": solver.solver, "scaling": scaling.scaling, "batch": batch.batch, "env": env.env_bench}
        run = benches[command.what]
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
        sys.stdout.write("QUICK RUN: few trials, a network fitted for seconds; its claims may well be missed.\n")
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
