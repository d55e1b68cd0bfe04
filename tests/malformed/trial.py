"""Malformed calls, many of them, in a process of their own: `python tests/malformed/trial.py --seed 1 --count 1000`.

Prints one line of JSON per call that did not end as it should: with an answer without nan, or with one of the project's errors;
without a warning, in `SECONDS`. A call that hangs ends the process with its traceback. `--only K` runs the K-th call alone.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import faulthandler
import io
import json
import os
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

from malformed.calls import Call, calls
from malformed.values import malformed

from grasp_env.errors import GraspError
from grasp_env.force import ForceSolution, ForceSolutions

SECONDS = 5.0
"""[s] of processor time that a call may take; the slowest right one takes a tenth of it."""
HANGS = 120.0
"""[s] after which a call hangs."""
MISSING = ("load_grasp", "TrainedAgent.load", "LearnedInitialForce.load", "make")
"""Calls whose arguments are wrong as they stand."""
MEMORY = 8 << 30
"""[bytes] of address space, so that whoever asks for all memory is told so."""


def numbers(value: Any, depth: int = 0) -> Iterator[float]:
    """The numbers of an answer; of solutions those that must never be nan."""
    if isinstance(value, ForceSolution):
        yield from (value.objective, value.lower_bound, value.equilibrium_residual, value.cone_margin)
        yield from value.force.flat
    elif isinstance(value, ForceSolutions):
        yield from value.force.flat
        yield from value.objective
    elif isinstance(value, float | np.floating):
        yield float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
        yield from value.flat
    elif isinstance(value, tuple | list) and depth < 4:
        for each in value:
            yield from numbers(each, depth + 1)
    elif (
        dataclasses.is_dataclass(value)
        and not isinstance(value, type)
        and depth < 4
        and type(value).__name__ != "ForceClosure"
    ):
        for item in dataclasses.fields(value):
            yield from numbers(getattr(value, item.name), depth + 1)


def drawn(table: dict[str, Call], seed: int, k: int) -> tuple[str, Call, dict[str, Any]]:
    """The k-th call of a seed: its name, and arguments of which one to three are not as they should be."""
    rng = np.random.default_rng([seed, k])
    names = list(table)
    weights = np.array([table[name].weight for name in names])
    name = names[rng.choice(len(names), p=weights / weights.sum())]
    call = table[name]
    given = dict(call.good)
    for argument in rng.permutation(list(given))[: rng.choice([1, 1, 1, 2, 3])]:
        given[str(argument)] = malformed(rng, given[str(argument)])
    return name, call, given


def fault(call: Call, given: dict[str, Any]) -> str:
    """What is wrong with how a call ended; empty: nothing."""
    begin = time.process_time()
    printed = contextlib.redirect_stdout(io.StringIO())  # `print` is a callable, too; the log is for faults
    with printed, warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            answer = call.run(**given)
        except GraspError as error:
            answer = None
            if not str(error):
                return "an error without words"
        except BaseException as error:  # whatever it is
            where = traceback.extract_tb(error.__traceback__)[-1]
            return f"{type(error).__name__}: {str(error)[:120]} ({Path(where.filename).name}:{where.lineno})"
    if told:
        return f"warns: {told[0].message} ({Path(told[0].filename).name}:{told[0].lineno})"
    if any(number != number for number in numbers(answer)):
        return "nan in the answer"
    took = time.process_time() - begin
    return f"takes {took:.1f} s" if took > SECONDS else ""


def short(value: Any) -> str:
    """For the log."""
    try:
        return f"{type(value).__name__} {value!r}"[:160]
    except Exception:
        return type(value).__name__


def main() -> int:
    """Runs the trial; 1 where a call ended in another way than it should."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--only", type=int, default=-1)
    asked = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        table = calls(Path(folder))
        os.chdir(folder)  # whatever is written lands there
        for name, call in table.items():
            if name not in MISSING:
                call.run(**call.good)  # what is good is answered
        for k in range(asked.count) if asked.only < 0 else (asked.only,):
            name, call, given = drawn(table, asked.seed, k)
            faulthandler.dump_traceback_later(HANGS, exit=True)
            found = fault(call, given)
            faulthandler.cancel_dump_traceback_later()
            if found:
                wrong += 1
                odd = {key: short(value) for key, value in given.items() if value is not call.good[key]}
                sys.stdout.write(json.dumps({"call": k, "name": name, "fault": found, "given": odd}) + "\n")
                sys.stdout.flush()
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
