"""Random calls into the compiled module, in a process of their own: `python tests/core/boundary_trial.py --seed 1 --count 1000`.

Every class and function, with up to four arguments of any type, shape, layout or number, arrays that overlap, objects that were never
made, in any order: what one call leaves is what the next one meets. Under the sanitizers a wrong access ends the process. Prints a line
of JSON per call that did not end as it should: with an answer, `TypeError`, `ValueError` or `OverflowError`; what is read unchanged; a
solution that is called one made of finite numbers; in `SECONDS`. `--only K` runs the calls before the K-th in silence, then that one.
"""

from __future__ import annotations

import argparse
import copy
import faulthandler
import inspect
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    root = Path(__file__).parents[2]
    sys.path[:0] = [str(root), str(root / "tests"), str(root / "tests/core")]
    import conftest  # noqa: F401  the build of the core that is asked for

from calls import COUNT, SIZE, SPOILED, Call, calls, others, spoil

from grasp_env.core import _core
from grasp_env.force.record import FORCE

SECONDS, HANGS = 20.0, 120.0
"""[s] of processor time a call may take, under the sanitizers; after which it hangs."""
FRESH = 200
"""Calls after which all objects are made anew."""
RAISED = (TypeError, ValueError, OverflowError)
ODD = (
    0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e308, -1e308, 5e-324, -1e-310, 1e12, 1.1e12, 1e-200, 1e20, 2.0**53,
)  # fmt: skip
HUGE = (3, 1000, 2**31 - 1, -(2**31), 2**31, 2**63, 10**40, 1j)
SCALARS = (*ODD, True, False, None, "newton", b"", (), [], {}, 0, 1, -1, object(), *HUGE)
"""Integers that are right and huge would be waited for: 2**31 - 1 goes where it means a size, not a number of steps."""
STEPS = ("limit", "passes", "times", "optimum")
CLASSES = tuple(each for _, each in inspect.getmembers(_core, inspect.isclass))


def odd_numbers(rng: np.random.Generator, a: np.ndarray) -> np.ndarray:
    """The same array with one to all of its numbers odd ones."""
    out = a.copy()
    flat = out.reshape(-1)
    if flat.size:
        chosen = rng.random(flat.size) < rng.choice([1.0 / flat.size, 0.1, 1.0])
        chosen[rng.integers(flat.size)] = True
        kind = rng.integers(4)
        if kind <= 1:
            flat[chosen] = rng.choice(ODD, chosen.sum() if kind else None)
        elif kind == 2:
            with np.errstate(all="ignore"):
                flat[chosen] *= np.power(10.0, rng.uniform(-330, 330))
        else:
            flat[chosen] = rng.integers(0, 2**63, chosen.sum(), dtype=np.int64).view(np.float64)
    return out


def any_argument(rng: np.random.Generator, given: Any, others: dict[str, Any], name: str) -> Any:
    """Something in place of an argument."""
    if isinstance(given, np.ndarray):
        kind = rng.integers(5)
        if kind <= 1:
            return odd_numbers(rng, given)
        if kind == 2:
            return spoil(str(rng.choice(list(SPOILED))), given)
        arrays = [a for a in others.values() if isinstance(a, np.ndarray)]
        if kind == 3:  # another argument, or a part of it that begins elsewhere
            shared = arrays[rng.integers(len(arrays))].reshape(-1)
            begin = int(rng.integers(max(1, shared.size - given.size + 1)))
            return shared[begin : begin + given.size].reshape(given.shape) if shared.size >= given.size else shared
        read_only = given.copy()
        read_only.setflags(write=False)
        return read_only
    if name in STEPS and rng.random() < 0.5:
        return int(rng.integers(0, 50))
    if isinstance(given, CLASSES) and rng.random() < 0.25:
        return type(given).__new__(type(given))  # never made
    scalars = SCALARS[: -len(HUGE)] if name in STEPS else SCALARS
    return scalars[rng.integers(len(scalars))]


def fault(call: Call, given: dict[str, Any]) -> str:
    """What is wrong with how a call ended; empty: nothing."""
    written = [a for name in call.written if isinstance(a := given[name], np.ndarray)]
    arrays = {name: a for name in call.read if isinstance(a := given[name], np.ndarray) and a.size < 10**6}
    # what shares its numbers with what is written may change with it
    kept = {name: a.copy() for name, a in arrays.items() if not any(np.may_share_memory(a, w) for w in written)}
    begin = time.process_time()
    try:
        answer = call.run(**given)
    except RAISED as error:
        answer = None
        if not str(error):
            return "an error without words"
    except BaseException as error:  # whatever it is
        return f"{type(error).__name__}: {str(error)[:200]}"
    for name, before in kept.items():
        if before.tobytes() != np.asarray(given[name]).tobytes():
            return f"{name} was changed"
    record = given.get("record")
    solved = type(answer) is int and answer == 0 and isinstance(record, np.ndarray) and record.shape == (SIZE,)
    if solved and not np.isfinite(record[FORCE : FORCE + 3 * COUNT]).all():
        return "called a solution, and not finite"
    took = time.process_time() - begin
    return f"takes {took:.1f} s" if took > SECONDS else ""


def elsewhere(rng: np.random.Generator, call: Call) -> Call:
    """The method of an object that was never made, or of a copy where there are any."""
    owner = getattr(call.run, "__self__", None)
    if not isinstance(owner, CLASSES):
        return call
    try:
        other = type(owner).__new__(type(owner)) if rng.random() < 0.5 else copy.copy(owner)
    except TypeError:
        return call
    return Call(getattr(other, call.run.__name__), call.given, call.written)


def main() -> int:
    """Runs the trial; 1 where a call ended in another way than it should."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("seed", 0), ("count", 1000), ("only", -1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")  # nanobind's, of objects that were never made, before its TypeError
    wrong, made = 0, {}
    for k in range(asked.count if asked.only < 0 else asked.only + 1):
        if asked.only >= 0 and k // FRESH < asked.only // FRESH:
            continue
        if not made or k % FRESH == 0:
            made = calls() | others()
        rng = np.random.default_rng([asked.seed, k])
        name = list(made)[rng.integers(len(made))]
        call = made[name]
        good = call.arguments()
        given = dict(good)
        for argument in rng.permutation(list(given))[: rng.choice([0, 1, 1, 1, 2, 3, 4])]:
            given[str(argument)] = any_argument(rng, given[str(argument)], given, str(argument))
        if rng.random() < 0.02:
            call = elsewhere(rng, call)
        faulthandler.dump_traceback_later(HANGS, exit=True)
        found = fault(call, given)
        faulthandler.cancel_dump_traceback_later()
        if found:
            wrong += 1
            odd = {
                key: f"{type(value).__name__} {value!r}"[:160] for key, value in given.items() if value is not good[key]
            }
            print(json.dumps({"call": k, "name": name, "fault": found, "given": odd}), flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
