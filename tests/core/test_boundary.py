"""Python's side of the core: arrays that are not as the core reads them are refused, never misread; numbers too."""

from __future__ import annotations

import array
import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from calls import CALLS, INTERNAL, LIMIT, REFUSED, SAMPLE, TOLERANCE, begun, contacts, model

from grasp_env.core import _core

ROOT = Path(__file__).parents[2]
each_call = pytest.mark.parametrize("name", CALLS)


class Wrapped:
    """Numbers that are no buffer."""

    def __init__(self, a: np.ndarray) -> None:
        self.a = a

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        return self.a

    def __len__(self) -> int:
        return len(self.a)


def swapped(a: np.ndarray) -> np.ndarray:
    return a.astype(a.dtype.newbyteorder())


def spread(a: np.ndarray) -> np.ndarray:
    """The same numbers, every other place of a larger array."""
    wide = np.repeat(a, 2, axis=-1)
    wide[..., 1::2] = np.nan
    return wide[..., ::2]


SPOILED = {
    "float32": lambda a: a.astype(np.float32),
    "float16": lambda a: a.astype(np.float16),
    "long double": lambda a: a.astype(np.longdouble),
    "int": lambda a: a.astype(np.int64),
    "unsigned": lambda a: np.abs(a).astype(np.uint8),
    "bool": lambda a: a.astype(bool),
    "complex": lambda a: a.astype(np.complex128),
    "object": lambda a: a.astype(object),
    "text": lambda a: a.astype("U8"),
    "time": lambda a: a.astype(np.int64).astype("m8[s]"),
    "record": lambda a: np.ascontiguousarray(a).view(np.dtype([("value", np.float64)])),
    "byte-swapped": swapped,
    "Fortran order": np.asfortranarray,
    "transposed": lambda a: a.T,
    "strided": spread,
    "reversed": lambda a: a[..., ::-1],
    "broadcast": lambda a: np.broadcast_to(np.float64(1.0), a.shape),
    "off by a byte": lambda a: np.frombuffer(b"\0" + a.tobytes(), np.uint8)[1:].view(np.float32),
    "0-d": lambda a: np.array(1.0),
    "empty": lambda a: np.zeros((0,) * a.ndim) if a.size else np.zeros(7),
    "flat": lambda a: a.reshape(-1) if a.ndim > 1 else a[:, None],
    "one axis more": lambda a: a[None],
    "one more": lambda a: np.concatenate([a, a[..., :1]], axis=-1),
    "one less": lambda a: np.ascontiguousarray(a[..., :-1]),
    "a row more": lambda a: np.concatenate([a, a[:1]]),
    "a row less": lambda a: np.ascontiguousarray(a[:-1]),
    "huge": lambda a: np.broadcast_to(np.float64(0.0), (2**40,) * a.ndim if a.ndim == 1 else (2**31, *a.shape[1:])),
    "list": lambda a: a.tolist(),
    "tuple": lambda a: tuple(a),
    "none": lambda a: None,
    "number": lambda a: 1.0,
    "word": lambda a: "wrench",
    "bytes": lambda a: a.tobytes(),
    "bytearray": lambda a: bytearray(a.tobytes()),
    "memoryview of bytes": lambda a: memoryview(a).cast("B"),
    "memoryview of int": lambda a: memoryview(array.array("q", [1] * a.size)),
    "array of float32": lambda a: array.array("f", a.reshape(-1)),
    "ctypes": lambda a: (ctypes.c_float * a.size)(*a.reshape(-1)),
    "wrapped": Wrapped,
    "scalar": lambda a: np.float64(1.0),
    "dict": lambda a: {},
    "type": lambda a: np.float64,
}
"""Ways to spoil an argument; what comes out as it went in, such as a vector in Fortran order, is left out."""

ROWS_OF_ANY = {"a row more", "a row less", "one more", "one less", "empty"}
OPTIONAL = {
    *(("ForceOptimizer.make", name) for name in ("weights", "min_normal", "max_normal", "torque_bias", "rule")),
    *(
        (f"ForceOptimizer.{call}", name)
        for call in ("solve", "solve_from", "start", "update")
        for name in ("positions", "normals", "friction", "jacobian", "torque_bias", "trace")
    ),
    ("Flow.solve", "previous"),
    ("Newton.make_basis", "interior"),
    ("Learned.solve", "previous"),
    ("Learned.start", "previous"),
    ("Newton.solve", "previous"),
    ("LimitedNewton.solve", "previous"),
    ("Newton.solve_many", "previous"),
    ("LimitedNewton.solve_many", "previous"),
    ("Learned.solve_many", "previous"),
    ("newton_grasps", "tangents"),
    ("conic_grasps", "tangents"),
    ("Pipeline.make", "flows"),
    ("Pipeline.solve", "adjust"),
}
EMPTY_IS_NONE = {("Contacts.make", "tangents"), ("Contacts.put", "tangents")}


def fits(name: str, argument: str, spoiled: object, right: np.ndarray, way: str) -> bool:
    """Whether an argument is right after all."""
    if argument in CALLS[name].any_length and way in ROWS_OF_ANY:
        return True
    if (way == "none" and (name, argument) in OPTIONAL) or (way == "empty" and (name, argument) in EMPTY_IS_NONE):
        return True
    if way == "number" and argument == "friction":  # one for all contacts
        return True
    same = isinstance(spoiled, np.ndarray) and spoiled.dtype.char == "d" and spoiled.dtype.isnative
    return same and spoiled.flags.c_contiguous and spoiled.shape == right.shape


def spoil(way: str, a: np.ndarray) -> object:
    with np.errstate(all="ignore"):
        return SPOILED[way](a)


def refused(outcome: object) -> bool:
    return outcome is False or (type(outcome) is int and outcome == REFUSED)


def run(name: str, arguments: dict[str, object]) -> object:
    """What a call returns; an error of argument types or values counts as REFUSED."""
    try:
        return CALLS[name].run(**arguments)
    except (TypeError, ValueError):
        return REFUSED


@each_call
def test_the_calls_are_right_as_they_stand(name: str) -> None:
    call, arguments = CALLS[name], CALLS[name].arguments()
    if name == "Newton.make_basis":
        arguments["basis"][:] = SAMPLE.basis
    if name == "Newton.segment":
        arguments["x"][:] = SAMPLE.basis[1]
    assert not refused(call.run(**arguments))
    for argument in call.given:  # nothing that is read is changed
        np.testing.assert_array_equal(arguments[argument], call.given[argument])


@each_call
def test_every_way_to_spoil_an_argument_is_refused(name: str) -> None:
    call, tried = CALLS[name], 0
    for argument in (*call.given, *call.written):
        for way in SPOILED:
            arguments: dict[str, object] = dict(call.arguments())
            right = arguments[argument]
            assert isinstance(right, np.ndarray)
            spoiled = spoil(way, right)
            if fits(name, argument, spoiled, right, way):
                continue
            arguments[argument] = spoiled
            assert refused(run(name, arguments)), (argument, way)
            for other, written in arguments.items():  # and nothing was written
                if other in call.written and other != argument and isinstance(written, np.ndarray):
                    assert (written == -7.0).all(), (argument, way, other)
            tried += 1
    assert tried > 20 * (len(call.given) + len(call.written))


@each_call
def test_what_is_written_must_be_writable(name: str) -> None:
    for argument in CALLS[name].written:
        arguments = CALLS[name].arguments()
        arguments[argument].setflags(write=False)
        assert refused(run(name, arguments))
        assert (arguments[argument] == -7.0).all()


def test_several_spoiled_arguments_at_once() -> None:
    rng, names, ways = np.random.default_rng(0), list(CALLS), list(SPOILED)
    for _ in range(3000):
        name = names[rng.integers(len(names))]
        arguments: dict[str, object] = dict(CALLS[name].arguments())
        wrong = 0
        for argument, right in CALLS[name].arguments().items():
            if rng.random() < 0.6:
                way = ways[rng.integers(len(ways))]
                arguments[argument] = spoil(way, right)
                wrong += not fits(name, argument, arguments[argument], right, way)
        if wrong:
            assert refused(run(name, arguments)), (name, arguments)


def read_only(a: np.ndarray) -> np.ndarray:
    a.setflags(write=False)
    return a


SAME = {
    "read-only": read_only,
    "memoryview": memoryview,
    "subclass": lambda a: a.view(np.recarray) if a.dtype.names else a.view(np.ma.MaskedArray).data,
    "a part of more": lambda a: np.concatenate([a, a])[: len(a)],
    "not aligned to a register": lambda a: np.frombuffer(b"\0" * 8 + a.tobytes(), np.float64, offset=8).reshape(
        a.shape
    ),
    "array.array": lambda a: (
        array.array("d", a) if a.ndim == 1 else memoryview(array.array("d", a.reshape(-1))).cast("B").cast("d", a.shape)
    ),
}


@pytest.mark.parametrize("way", SAME)
@pytest.mark.parametrize(
    "name",
    ["Newton.solve", "Newton.descend", "Newton.solve_many", "LimitedNewton.solve", "Conic.solve", "Pipeline.solve"],
)
def test_the_same_numbers_elsewhere_give_the_same_bits(name: str, way: str) -> None:
    call = CALLS[name]
    plain, other = call.arguments(), call.arguments()
    begin = begun() if name.startswith("Pipeline") else None
    run_ = begin.solve if begin else call.run
    first = run_(**plain)
    if begin:
        begin.reset()
    again = {argument: SAME[way](a) if argument in call.given else a for argument, a in other.items()}
    assert run_(**again) == (first if not begin else 0)
    if begin:
        begin.reset()
        run_(**plain)
    for argument in call.written:
        np.testing.assert_array_equal(other[argument], plain[argument])


# in a process of its own, which a crash ends


def survives(script: str, **environment: str) -> None:
    # the conftest of the root chooses the build of the core, as for this process
    door = f"import sys; sys.path[:0] = [{str(ROOT)!r}]; import conftest; sys.path[:0] = {sys.path!r}; "
    door += "import numpy as np; from grasp_env.core import _core; from calls import *\n"
    done = subprocess.run(
        [sys.executable, "-c", door + script],
        cwd=ROOT,
        env=os.environ | environment,
        timeout=120,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_record_size_of_a_huge_number() -> None:
    survives("""
try:
    _core.record_size(2**31 - 1)
except ValueError:
    pass
else:
    sys.exit(1)
""")


def test_models_of_other_contacts_and_wrong_numbers_are_refused() -> None:
    for fails in (
        lambda: _core.Learned.make(contacts(), TOLERANCE, LIMIT, SAMPLE.basis, model(placed=False)),
        lambda: _core.Network.make([8, 10**6], np.zeros(1)),
        lambda: _core.Network.make([], np.zeros(1)),
        lambda: _core.Network.make([8, 6], np.full(54, 1e39)),
        lambda: _core.Network.make([8, 6], np.full(54, np.nan)),
        lambda: model().normalise(0.0, 0.2, 0.5, 1.3, 0.4, 0.12),
        lambda: model().normalise(0.05, 0.2, 0.5, np.nan, 0.4, 0.12),
    ):
        with pytest.raises(ValueError, match=r"other contacts|stages|finite"):
            fails()
    short = model()
    short.place(np.ascontiguousarray(INTERNAL[:, :5]), 0.5, 1.0, 20.0)
    with pytest.raises(ValueError, match="other contacts"):
        _core.Learned.make(contacts(), TOLERANCE, LIMIT, SAMPLE.basis, short)


@pytest.mark.parametrize("what", ["newton", "conic", "learned", "pipeline"])
def test_solvers_are_deleted_as_they_were_made(what: str) -> None:
    survives(f"made = {what}(); del made", ASAN_OPTIONS="detect_leaks=0")


def test_no_contacts_at_all() -> None:
    survives("""
nothing = np.zeros((0, 3))
try:
    _core.Contacts.make(nothing, nothing, nothing, np.zeros((0, 2)), nothing)
except ValueError:
    pass
else:
    sys.exit(1)
""")


TRIAL = Path(__file__).with_name("boundary_trial.py")
SEED = int(os.environ.get("GRASP_TRIAL_SEED", "0"))


def faults(seed: int, count: int) -> str:
    """What went wrong in that many random calls, in a process of its own: a crash or a hang is a fault of the last call."""
    command = [sys.executable, str(TRIAL), "--seed", str(seed), "--count", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout + (done.stderr[-3000:] if done.returncode else "")


def test_random_calls() -> None:
    assert faults(SEED, 1000) == ""


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_a_hundred_thousand_random_calls(part: int) -> None:
    """`GRASP_TRIAL_SEED=S make slow GRASP_SANITIZE=ON ARGS="tests/core -k hundred_thousand"` under the sanitizers."""
    assert faults(SEED + 1 + part, 10_000) == ""
