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
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    root = Path(__file__).parents[2]
    sys.path[:0] = [str(root), str(root / "tests"), str(root / "tests/core")]
    import conftest  # noqa: F401  the build of the core that is asked for

import calls
from calls import SPOILED, spoil

from grasp_env.core import _core
from grasp_env.force.record import FORCE

SECONDS, HANGS = 20.0, 120.0
"""[s] of processor time a call may take, under the sanitizers; after which it hangs."""
FRESH = 200
"""Calls after which all objects are made anew."""
RAISED = (TypeError, ValueError, OverflowError)
ODD = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    np.inf,
    -np.inf,
    np.nan,
    1e308,
    -1e308,
    5e-324,
    -1e-310,
    1e12,
    1.1e12,
    1e-200,
    1e20,
    2.0**53,
)
HUGE = (3, 1000, 2**31 - 1, -(2**31), 2**31, 2**63, 10**40, 1j)
SCALARS = (*ODD, True, False, None, "newton", b"", (), [], {}, 0, 1, -1, object(), *HUGE)
"""Integers that are right and huge would be waited for: 2**31 - 1 goes where it means a size, not a number of steps."""
NAMES = ("length", "floor", "log_mean", "log_scale", "friction_mean", "friction_scale")
NORMALISATION = dict(zip(NAMES, (1.0, 1.0, 0.0, 1.0, 0.0, 1.0), strict=True))
STEPS = ("limit", "passes", "times", "optimum")


def odd_numbers(rng: np.random.Generator, a: np.ndarray) -> np.ndarray:
    """The same array with one to all of its numbers odd ones."""
    out = a.copy()
    flat = out.reshape(-1)
    if flat.size:
        share = rng.choice([1.0 / flat.size, 0.1, 1.0])
        chosen = rng.random(flat.size) < share
        chosen[rng.integers(flat.size)] = True
        kind = rng.integers(4)
        if kind == 0:
            flat[chosen] = rng.choice(ODD, chosen.sum())
        elif kind == 1:
            flat[chosen] = rng.choice(ODD)
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
            if shared.size >= given.size:
                begin = int(rng.integers(shared.size - given.size + 1))
                return shared[begin : begin + given.size].reshape(given.shape)
            return shared
        read_only = given.copy()
        read_only.setflags(write=False)
        return read_only
    if name in STEPS and rng.random() < 0.5:
        return int(rng.integers(0, 50))
    if isinstance(given, int | float | str) or given is None:
        scalars = SCALARS[: -len(HUGE)] if name in STEPS else SCALARS
        return scalars[rng.integers(len(scalars))]
    never_made = type(given).__new__(type(given)) if rng.random() < 0.5 and isinstance(given, core_classes()) else None
    return never_made if rng.random() < 0.5 else SCALARS[rng.integers(len(SCALARS))]


def core_classes() -> tuple[type, ...]:
    return tuple(each for _, each in inspect.getmembers(_core, inspect.isclass))


def table() -> dict[str, tuple[Callable[..., Any], dict[str, Any], frozenset[str]]]:
    """By name: what is called, good arguments by name (also what `calls` binds), and those that are read."""
    out: dict[str, tuple[Callable[..., Any], dict[str, Any], frozenset[str]]] = {}
    for name, call in calls.calls().items():
        run, given = call.run, dict(call.arguments())
        if isinstance(run, partial):
            bound = {f"*{k}": value for k, value in enumerate(run.args)}
            given = bound | dict(run.keywords) | given
            run = run.func
        out[name] = run, given, frozenset(call.given)
    empty = np.full(calls.SIZE, -7.0)
    network = _core.Network.make([8, 6], np.zeros(54))
    fresh = _core.Model.make(network)
    wrench, blob = np.ones(6), calls.model().save()
    out |= {
        "Model.make": (_core.Model.make, {"network": network}, frozenset()),
        "Model.normalise": (fresh.normalise, NORMALISATION, frozenset()),
        "Model.place": (fresh.place, {"null_space": np.ones((12, 6)), "friction": 0.4, "scale": 1.0, "largest": 20.0}, frozenset()),
        "Model.load": (_core.Model.load, {"bytes": blob}, frozenset()),
        "Model.save": (fresh.save, {}, frozenset()),
        "ContactReader.read": (
            _core.ContactReader(
                least_friction=1e-4, most_friction=1e4, least_length=1e-9, most_length=1e6, distance=1e5, most=1000
            ).read,
            {name: calls.CALLS["Contacts.put"].given[name] for name in ("positions", "normals", "tangents")} | {"friction": 0.4},
            frozenset({"positions", "normals", "tangents"}),
        ),
        "Contacts.weighed alike": (calls.contacts().weighed, {"force_weight": 1.0, "barrier_weight": 0.01}, frozenset()),
        "all_finite": (_core.all_finite, {"array": wrench}, frozenset({"array"})),
        "normalise": (_core.normalise, {"normals": calls.SAMPLE.normals.copy()}, frozenset()),
        "record_size": (_core.record_size, {"contacts": 4}, frozenset()),
        "Solution": (_core.Solution, {"record": empty, "method": "", "initial": ""}, frozenset()),
        "Network.make sizes": (_core.Network.make, {"sizes": [8, 6], "weights": np.zeros(54)}, frozenset()),
    }  # fmt: skip
    return out


def fault(run: Callable[..., Any], given: dict[str, Any], read: frozenset[str]) -> str:
    """What is wrong with how a call ended; empty: nothing."""
    written = [a for name, a in given.items() if name not in read and isinstance(a, np.ndarray)]
    # what shares its numbers with what is written may change with it
    kept = {
        name: a.copy()
        for name, a in given.items()
        if name in read
        and isinstance(a, np.ndarray)
        and a.size < 10**6
        and not any(np.may_share_memory(a, other) for other in written)
    }
    begin = time.process_time()
    positional = [value for name, value in given.items() if name.startswith("*")]
    try:
        answer = run(*positional, **{name: value for name, value in given.items() if not name.startswith("*")})
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
    solved = type(answer) is int and answer == 0 and isinstance(record, np.ndarray) and record.shape == (calls.SIZE,)
    if solved and not np.isfinite(record[FORCE : FORCE + 3 * calls.COUNT]).all():
        return "called a solution, and not finite"
    took = time.process_time() - begin
    return f"takes {took:.1f} s" if took > SECONDS else ""


def main() -> int:
    """Runs the trial; 1 where a call ended in another way than it should."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--only", type=int, default=-1)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")  # nanobind's, of objects that were never made, before its TypeError
    wrong, made = 0, {}
    for k in range(asked.count if asked.only < 0 else asked.only + 1):
        if asked.only >= 0 and k // FRESH < asked.only // FRESH:
            continue
        if not made or k % FRESH == 0:
            made = table()
        rng = np.random.default_rng([asked.seed, k])
        name = list(made)[rng.integers(len(made))]
        run, good, read = made[name]
        given = {key: value.copy() if isinstance(value, np.ndarray) else value for key, value in good.items()}
        keys = list(given)
        for argument in rng.permutation(keys)[: rng.choice([0, 1, 1, 1, 2, 3, 4])]:
            given[str(argument)] = any_argument(rng, given[str(argument)], given, str(argument))
        if rng.random() < 0.02:  # the method of an object that was never made, or of a copy
            owner = getattr(run, "__self__", None)
            if isinstance(owner, core_classes()):
                with_none = type(owner).__new__(type(owner)) if rng.random() < 0.5 else copied(owner)
                run = getattr(with_none, run.__name__)
        faulthandler.dump_traceback_later(HANGS, exit=True)
        found = fault(run, given, read)
        faulthandler.cancel_dump_traceback_later()
        if found:
            wrong += 1
            odd = {
                key: f"{type(value).__name__} {value!r}"[:160] for key, value in given.items() if value is not good[key]
            }
            sys.stdout.write(json.dumps({"call": k, "name": name, "fault": found, "given": odd}) + "\n")
            sys.stdout.flush()
    return int(wrong > 0)


def copied(owner: Any) -> Any:
    """A copy where there are any."""
    try:
        return copy.copy(owner)
    except TypeError:
        return owner


if __name__ == "__main__":
    sys.exit(main())
