"""`python -m benchmarks NAME`, or `make bench ARGS="NAME"`: run a benchmark and save its rows."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib import import_module

from grasp_env.errors import GraspError, UnknownNameError
from grasp_env.inputs.extras import need

BENCHMARKS = {
    "algorithms": "each algorithm of the core on the problems it exists for",
    "scaling": "cost against contacts",
    "batch": "solves per second on one core and on all",
    "env": "steps per second of the environment beside bare PyBullet, resets, memory",
    "fitted": "iterations of the flow from models of `grasp fit --env`, in their environments",
    "hand_loop": "the controller of a hand in real time against a simulated hand: latencies, what is lost",
    "ticks": "every tick of a hand's control loop on its own: median, p99.9 and the largest of a million, beside other solvers",
    "layer": "the force layer beside cvxpylayers, Moreau's and ProxSuite's: forward and backward, how far answers differ",
    "core": "this checkout beside an earlier one, taking turns on one core: solves, moving contacts, grasps",
}
"""Benchmarks by name, which is that of the module."""
USAGE = f"""usage: python -m benchmarks NAME [OPTIONS]

{"".join(f"  {name:9} {text}{os.linesep}" for name, text in BENCHMARKS.items())}
force     all solvers of grasp forces on the tracks of benchmarks/force: `python -m benchmarks.force --help`
python -m benchmarks NAME --help lists the options.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one benchmark.

    Args:
        arguments: words of the command line; None: those of this process.

    Returns:
        0; 130 if it was interrupted; 2 after wrong input, with one line on stderr, and JSON on
        stdout with --json.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(USAGE)
        return 0
    try:
        execute(*words)
    except GraspError as error:
        sys.stderr.write(f"benchmarks: {error}\n")
        if "--json" in words:
            fields = {"kind": type(error).__name__, "message": str(error), "exit_code": 2}
            sys.stdout.write(json.dumps({"error": fields}) + "\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("benchmarks: interrupted\n")
        return 130
    return 0


def execute(name: str, *words: str) -> None:
    """Run the benchmark of that name with options, or raise a `GraspError`."""
    if name not in BENCHMARKS:
        raise UnknownNameError("benchmark", name, BENCHMARKS)
    need("report")
    import tyro

    from benchmarks import show
    from benchmarks.benchmark import RunOptions, checked, tick
    from training.evaluation.report.page import svg
    from training.evaluation.results import Run, default_name

    benchmark = import_module(f"benchmarks.{name}").BENCHMARK
    settings = benchmark.settings
    if "--quick" in words:
        settings = replace(settings, **benchmark.quick)
    program = f"python -m benchmarks {name}"
    kind_of_options = RunOptions[type(settings)]
    options = tyro.cli(kind_of_options, prog=program, default=RunOptions(settings), args=words)
    checked(options.settings)
    kind = "env_speed" if name == "env" else name  # the kind "env" are hold rates
    before = None if options.compare is None else show.earlier(options.compare, kind)
    run = Run.create(options.out, options.name or default_name(kind))
    rows = benchmark.run(options.settings)
    tick("")
    about = {
        "kind": kind,
        "quick": options.quick,
        "settings": asdict(options.settings),
        "load": os.getloadavg(),
        "missing": show.lacking(rows),
        "claims": [asdict(claim) for claim in benchmark.claims],
    }
    if benchmark.draw is not None:
        run.write_text("picture.svg", svg(benchmark.draw(rows, benchmark.words)))
    run.save(rows, about)
    about = run.read_json("run.json")
    if options.json:
        sys.stdout.write(show.as_json(benchmark, rows, about, before))
    else:
        sys.stdout.write(f"{show.as_text(benchmark, rows, about, before)}{run.folder}\n")


if __name__ == "__main__":
    sys.exit(main())
