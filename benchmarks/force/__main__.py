"""`python -m benchmarks.force run | validate | report | references | generate | record`."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command; return 0, or 2 after wrong input, with one line on stderr."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
        os.environ[name] = "1"  # before numpy is imported: every entrant runs on one thread
    from benchmarks.force.entrants import ENTRANTS
    from benchmarks.force.problems import SETS

    parser = argparse.ArgumentParser(prog="python -m benchmarks.force", description=__doc__)
    commands = parser.add_subparsers(required=True)

    def command(name: str, function: Any, text: str) -> Any:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(function=function)
        sub.add_argument("--sets", type=Path, default=SETS, help="folder of the tracks")
        return sub.add_argument

    tracks: dict[str, Any] = {"nargs": "+", "default": [], "metavar": "TRACK"}
    solver: dict[str, Any] = {"action": "append", "default": [], "metavar": "FILE.py:CLASS"}
    solver["help"] = "your own entrant; FILE.so:FUNCTION for a C function"
    add = command("run", _run, "time entrants on the tracks and score their answers")
    add("--solver", **solver)
    beside = f"entrants beside it: {', '.join(ENTRANTS)}; default: all"
    add("--against", nargs="*", default=list(ENTRANTS), metavar="NAME", help=beside)
    add("--tracks", **tracks)
    quick = "a few problems of each session, once: rough numbers within a minute"
    add("--quick", action="store_true", help=quick)
    add("--out", type=Path, default=Path("runs"))
    add("--name", default="")
    checks = "check the files of the tracks and their references; with --solver what that solves of them instead, without timing"
    add = command("validate", _validate, checks)
    add("--solver", **solver)
    add("--tracks", **tracks)
    add = command("report", _report, "print the tables of a run, or what changed between two")
    add("runs", nargs="+", type=Path, metavar="RUN")
    anew = "compute the references of the tracks anew, and compare them with the stored ones"
    add = command("references", _references, anew)
    add("--tracks", **tracks)
    seeds = "make tracks and their references from a seed: 0 is the published one, others are for training or held out"
    add = command("generate", _generate, seeds)
    add("tracks", **tracks | {"nargs": "*"})
    add("--seed", type=int, default=0)
    hands = "write hands.json anew, from hands by name or file; needs the simulator"
    add = command("record", _record, hands)
    add("hands", nargs="+", metavar="HAND")
    args = parser.parse_args(arguments)
    try:
        return args.function(args)
    except ValueError as error:
        sys.stderr.write(f"benchmarks.force: {error}\n")
        return 2


def _tracks(args: Any) -> list[Any]:
    from benchmarks.force.problems import load, names

    return [load(name, args.sets) for name in args.tracks or names(args.sets)]


def _run(args: Any) -> int:
    from benchmarks.benchmark import tick
    from benchmarks.force.report import lines, profiles
    from benchmarks.force.run import QUICK, Effort, entrants, measured, unit
    from training.evaluation.report.page import svg
    from training.evaluation.results import Run, default_name
    from training.evaluation.results.table import table

    tracks = _tracks(args)
    chosen = entrants([*args.solver, *args.against])
    run = Run.create(args.out, args.name or default_name("force"))
    before = unit()
    effort = QUICK if args.quick else Effort()
    rows, descriptions = measured(tracks, chosen, effort, tick)
    rows = table(rows)
    tick("")
    about = {
        "kind": "force",
        "quick": args.quick,
        "settings": asdict(effort),
        "unit": min(before, unit()),
        "load": os.getloadavg(),
        "tracks": {track.name: track.about["sha256"] for track in tracks},
        "entrants": descriptions,
    }
    run.save(rows, about)
    run.write_text("profiles.svg", svg(profiles(rows)))
    sys.stdout.write("\n".join([*lines(rows, about["unit"]), f"{run.folder}\n"]))
    return 0


def _validate(args: Any) -> int:
    from benchmarks.force.check import check
    from benchmarks.force.generate import TRACKS, generate
    from benchmarks.force.report import answers
    from benchmarks.force.run import Effort, entrants, measured
    from training.evaluation.results.table import table

    tracks = _tracks(args)
    if args.solver:
        results = table(measured(tracks, entrants(args.solver), Effort(rounds=1, seconds=0.0))[0])
        sys.stdout.write("\n".join([*answers(results), ""]))
        return int(not results.loc[results["method"] != "empty", "solved"].any())
    faults = []
    for track in tracks:
        faults += check(track)
        if track.name in TRACKS:
            seed = track.about["seed"]
            if generate(track.name, seed).digest() != track.about["sha256"]:
                faults.append(f"{track.name}: seed {seed} gives other problems here")
        sys.stdout.write(f"{track.name}: {track.size} problems\n")
    sys.stdout.write("".join(f"{fault}\n" for fault in faults) or "all references hold\n")
    return int(bool(faults))


def _report(args: Any) -> int:
    from benchmarks.force.report import beside, lines
    from training.evaluation.results import Run, understood

    loaded = []
    for folder in args.runs:
        with understood(folder, "run the benchmark again"):
            loaded.append(Run.open(folder).load())
    earlier, before = loaded[0]
    rows, about = loaded[-1]
    sys.stdout.write("\n".join([*lines(rows, about["unit"]), ""]))
    tracks = before["tracks"]
    other = [name for name, sha in about["tracks"].items() if tracks.get(name, sha) != sha]
    if other:
        raise ValueError(
            f"the runs are of different problems: {', '.join(other)}; compare runs of the same --sets"
        )
    if len(loaded) > 1:
        table = beside(rows, earlier).to_string(index=False)
        sys.stdout.write(f"{args.runs[-1]} beside {args.runs[0]}, us\n{table}\n")
    return 0


def _references(args: Any) -> int:
    from benchmarks.force.check import AGREEMENT
    from benchmarks.force.references import distance, refer

    worst = 0.0
    for track in _tracks(args):
        distances = [0.0]
        digits = track.about.get("digits", "double")
        for session in track.sessions:
            if lacking := set(track.about["objectives"]) - set(session.references):
                raise ValueError(
                    f"{track.name}, session {session.name!r} stores no references of {', '.join(sorted(lacking))}"
                )
            computed = refer(session, track.about["objectives"], digits)
            distances += [
                distance(session.references[name], reference)
                for name, reference in computed.items()
            ]
        worst = max(worst, *distances)
        sys.stdout.write(
            f"{track.name}: the optima differ from the stored ones by at most {max(distances):.1e} of themselves\n"
        )
    return int(worst > AGREEMENT)


def _generate(args: Any) -> int:
    from dataclasses import replace

    from benchmarks.force.generate import TRACKS, generate
    from benchmarks.force.problems import save
    from benchmarks.force.references import refer

    if args.seed < 0:
        raise ValueError(f"the seed must be at least 0, got {args.seed}")
    for name in args.tracks or TRACKS:
        if name not in TRACKS:
            raise ValueError(f"no track {name!r}: there are {', '.join(TRACKS)}")
        track = generate(name, args.seed)
        objectives, digits = track.about["objectives"], track.about["digits"]
        sessions = [
            replace(session, references=refer(session, objectives, digits))
            for session in track.sessions
        ]
        save(replace(track, sessions=sessions), args.sets)
        sys.stdout.write(f"{args.sets / name}.npz: {track.size} problems\n")
    return 0


def _record(args: Any) -> int:
    from benchmarks.force.record import write

    write(args.hands)
    return 0


if __name__ == "__main__":
    sys.exit(main())
