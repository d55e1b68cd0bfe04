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
    """Run a sub-command, and return 0, or 2 after wrong input, with one line on stderr."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
        os.environ[name] = "1"  # before numpy is imported: every entrant runs on one thread
    from benchmarks.force.entrants import ENTRANTS
    from benchmarks.force.problems import SETS

    parser = argparse.ArgumentParser(prog="python -m benchmarks.force", description=__doc__)
    commands = parser.add_subparsers(required=True)

    def command(name: str, function: Any, text: str) -> Any:
        made = commands.add_parser(name, help=text, description=text)
        made.set_defaults(function=function)
        made.add_argument("--sets", type=Path, default=SETS, help="folder of the tracks")
        return made.add_argument

    entered: dict[str, Any] = {"action": "append", "default": [], "metavar": "FILE.py:CLASS"}
    own = "your own entrant; FILE.so:FUNCTION for a C function"
    add = command("run", _run, "time entrants on the tracks and score their answers")
    add("--solver", **entered, help=own)
    beside = f"entrants beside it: {', '.join(ENTRANTS)}; default: all"
    add("--against", nargs="*", default=list(ENTRANTS), metavar="NAME", help=beside)
    add("--tracks", nargs="+", default=[], metavar="TRACK")
    add(
        "--quick",
        action="store_true",
        help="a few problems of each session, once: rough numbers within a minute",
    )
    add("--out", type=Path, default=Path("runs"))
    add("--name", default="")
    checks = "check the files of the tracks and their references; with --solver what that solves of them instead, without timing"
    add = command("validate", _validate, checks)
    add("--solver", **entered, help=own)
    add("--tracks", nargs="+", default=[], metavar="TRACK")
    add = command("report", _report, "print the tables of a run, or what changed between two")
    add("runs", nargs="+", type=Path, metavar="RUN")
    anew = "compute the references of the tracks anew, and compare them with the stored ones"
    add = command("references", _references, anew)
    add("--tracks", nargs="+", default=[], metavar="TRACK")
    seeds = "make tracks and their references from a seed: 0 is the published one, others are for training or held out"
    add = command("generate", _generate, seeds)
    add("tracks", nargs="*", default=[], metavar="TRACK")
    add("--seed", type=int, default=0)
    add = command(
        "record", _record, "write hands.json anew, from hands by name or file; needs the simulator"
    )
    add("hands", nargs="+", metavar="HAND")
    given = parser.parse_args(arguments)
    try:
        return given.function(given)
    except ValueError as error:
        sys.stderr.write(f"benchmarks.force: {error}\n")
        return 2


def _tracks(given: Any) -> list[Any]:
    from benchmarks.force.problems import load, names

    return [load(name, given.sets) for name in given.tracks or names(given.sets)]


def _run(given: Any) -> int:
    from benchmarks.benchmark import tick
    from benchmarks.force.report import lines, profiles
    from benchmarks.force.run import QUICK, Effort, entrants, measured, unit
    from training.evaluation.report.page import svg
    from training.evaluation.results import Run, default_name
    from training.evaluation.results.table import table

    tracks = _tracks(given)
    chosen = entrants([*given.solver, *given.against])
    run = Run.create(given.out, given.name or default_name("force"))
    before = unit()
    effort = QUICK if given.quick else Effort()
    found, descriptions = measured(tracks, chosen, effort, tick)
    rows = table(found)
    tick("")
    about = {
        "kind": "force",
        "quick": given.quick,
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


def _validate(given: Any) -> int:
    from benchmarks.force.check import check
    from benchmarks.force.generate import TRACKS, generate
    from benchmarks.force.report import answers
    from benchmarks.force.run import Effort, entrants, measured
    from training.evaluation.results.table import table

    tracks = _tracks(given)
    if given.solver:
        made = table(measured(tracks, entrants(given.solver), Effort(rounds=1, seconds=0.0))[0])
        sys.stdout.write("\n".join([*answers(made), ""]))
        return int(not made.loc[made["method"] != "empty", "solved"].any())
    faults = []
    for track in tracks:
        faults += check(track)
        if (
            track.name in TRACKS
            and generate(track.name, track.about["seed"]).digest() != track.about["sha256"]
        ):
            faults.append(f"{track.name}: seed {track.about['seed']} gives other problems here")
        sys.stdout.write(
            f"{track.name}: {sum(len(session.problems) for session in track.sessions)} problems\n"
        )
    sys.stdout.write("".join(f"{fault}\n" for fault in faults) or "all references hold\n")
    return int(bool(faults))


def _report(given: Any) -> int:
    from benchmarks.force.report import beside, lines
    from training.evaluation.results import Run, understood

    loaded = []
    for folder in given.runs:
        with understood(folder, "run the benchmark again"):
            loaded.append(Run.open(folder).load())
    rows, about = loaded[-1]
    sys.stdout.write("\n".join([*lines(rows, about["unit"]), ""]))
    other = [
        name
        for name, digest in about["tracks"].items()
        if loaded[0][1]["tracks"].get(name, digest) != digest
    ]
    if other:
        raise ValueError(
            f"the runs are of different problems: {', '.join(other)}; compare runs of the same --sets"
        )
    if len(loaded) > 1:
        sys.stdout.write(
            f"{given.runs[-1]} beside {given.runs[0]}, us\n{beside(rows, loaded[0][0]).to_string(index=False)}\n"
        )
    return 0


def _references(given: Any) -> int:
    from benchmarks.force.check import AGREEMENT
    from benchmarks.force.references import distance, refer

    worst = 0.0
    for track in _tracks(given):
        apart = [0.0]
        digits = track.about.get("digits", "double")
        for session in track.sessions:
            if lacking := set(track.about["objectives"]) - set(session.references):
                raise ValueError(
                    f"{track.name}, session {session.name!r} stores no references of {', '.join(sorted(lacking))}"
                )
            made = refer(session, track.about["objectives"], digits)
            apart += [
                distance(session.references[name], reference) for name, reference in made.items()
            ]
        worst = max(worst, *apart)
        sys.stdout.write(
            f"{track.name}: the optima differ from the stored ones by at most {max(apart):.1e} of themselves\n"
        )
    return int(worst > AGREEMENT)


def _generate(given: Any) -> int:
    from dataclasses import replace

    from benchmarks.force.generate import TRACKS, generate
    from benchmarks.force.problems import save
    from benchmarks.force.references import refer

    if given.seed < 0:
        raise ValueError(f"the seed must be at least 0, got {given.seed}")
    for name in given.tracks or TRACKS:
        if name not in TRACKS:
            raise ValueError(f"no track {name!r}: there are {', '.join(TRACKS)}")
        track = generate(name, given.seed)
        sessions = [
            replace(
                session, references=refer(session, track.about["objectives"], track.about["digits"])
            )
            for session in track.sessions
        ]
        save(replace(track, sessions=sessions), given.sets)
        sys.stdout.write(
            f"{given.sets / name}.npz: {sum(len(session.problems) for session in sessions)} problems\n"
        )
    return 0


def _record(given: Any) -> int:
    from benchmarks.force.record import write

    write(given.hands)
    return 0


if __name__ == "__main__":
    sys.exit(main())
