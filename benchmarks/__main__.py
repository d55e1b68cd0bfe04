"""`python -m benchmarks NAME`, or `make bench ARGS="NAME"`: runs a benchmark, saves its rows and
prints their summary.
"""

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
    "hand_loop": "the controllers of examples/hand_controller in real time against a simulated hand: latencies, what is lost",
    "layer": "the force layer beside cvxpylayers, Moreau's and ProxSuite's: forward and backward, how far answers differ",
    "core": "this checkout beside an earlier one, taking turns on one core: solves, moving contacts, grasps",
}
"""Benchmarks by name; each is the `BENCHMARK` of the module of that name."""
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
        0; 130 if it was interrupted; 2 after wrong input, with one line on stderr, and with --json
        as JSON on stdout.
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
            described = {"kind": type(error).__name__, "message": str(error), "exit_code": 2}
            sys.stdout.write(json.dumps({"error": described}) + "\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("benchmarks: interrupted\n")
        return 130
    return 0


def execute(name: str, *words: str) -> None:
    """Run the benchmark of that name, with options; wrong ones are a `GraspError`."""
    if name not in BENCHMARKS:
        raise UnknownNameError("benchmark", name, BENCHMARKS)
    need("report")
    import tyro

    from benchmarks import show
    from benchmarks.benchmark import RunOptions, checked, tick
    from training.evaluation.report.page import svg
    from training.evaluation.results import Run, default_name

    benchmark = import_module(f"benchmarks.{name}").BENCHMARK
    usual = (
        replace(benchmark.settings, **benchmark.quick) if "--quick" in words else benchmark.settings
    )
    options = RunOptions[type(usual)]
    given = tyro.cli(
        options, prog=f"python -m benchmarks {name}", default=RunOptions(usual), args=words
    )
    checked(given.settings)
    kind = "env_speed" if name == "env" else name  # the kind "env" are hold rates
    before = None if given.compare is None else show.earlier(given.compare, kind)
    run = Run.create(given.out, given.name or default_name(kind))
    rows = benchmark.run(given.settings)
    tick("")
    about = {
        "kind": kind,
        "quick": given.quick,
        "settings": asdict(given.settings),
        "load": os.getloadavg(),
    }
    if benchmark.draw is not None:
        run.write_text("picture.svg", svg(benchmark.draw(rows, benchmark.words)))
    run.save(
        rows,
        about
        | {"missing": show.lacking(rows), "claims": [asdict(claim) for claim in benchmark.claims]},
    )
    written = (show.as_json if given.json else show.as_text)(
        benchmark, rows, run.read_json("run.json"), before
    )
    sys.stdout.write(written if given.json else f"{written}{run.folder}\n")


if __name__ == "__main__":
    sys.exit(main())
