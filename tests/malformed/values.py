"""Values that no caller means: odd objects, numbers out of every range, good values with one thing wrong."""

from __future__ import annotations

import datetime
import decimal
import fractions
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import numpy as np
from scipy import sparse

from grasp_env.grasp import Grasp


class Odd:
    """An object of somebody else's that answers nothing."""

    def _no(self, *_: object, **__: object) -> Any:
        raise RuntimeError("no")

    __repr__ = __array__ = __len__ = __iter__ = __eq__ = __float__ = __index__ = __getitem__ = __bool__ = _no  # type: ignore[assignment]
    __hash__ = None  # type: ignore[assignment]


class Frame:
    """What a table looks like to numpy: an array of any type, under a name."""

    shape, dtype = (6,), np.dtype(object)

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        return np.array([1.0, "a", None, 2.0, {}, 3.0], dtype=object)

    def tolist(self) -> list[Any]:
        raise AttributeError("tolist")


class Huge:
    """A sequence longer than any memory."""

    def __len__(self) -> int:
        return 10**12

    def __getitem__(self, index: int) -> float:
        return 0.0


def _fails(self: object, *_: object, **__: object) -> Any:
    raise RuntimeError("no")


def failing(base: type, *names: str) -> type:
    """A class of that kind in which these methods fail."""
    return type(f"Failing{base.__name__.title()}", (base,), dict.fromkeys(names, _fails) | {"__hash__": base.__hash__})


_COMPARED = ("__lt__", "__le__", "__gt__", "__ge__", "__eq__", "__repr__")
Text = failing(str, "__eq__", "__str__", "__repr__", "__len__", "__iter__")
Number = failing(float, *_COMPARED, "__float__", "__mul__")
Whole = failing(int, *_COMPARED, "__int__", "__index__", "__float__")
Listed = failing(list, "__len__", "__getitem__", "__iter__")
Row = failing(tuple, "__len__", "__getitem__", "__iter__")
Silent = failing(object, "__getattribute__", "__repr__")
Classless = type("Classless", (), {"__class__": property(_fails)})


class Everything(str):
    """Equal to every name."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = str.__hash__


class Least(int):
    """Less than nothing, it says."""

    def __lt__(self, other: object) -> bool:
        return False

    __gt__ = __lt__


class Nameless(type):
    """Of classes that do not tell their name."""

    __name__ = property(_fails)  # type: ignore[assignment]


class Array(np.ndarray):
    """An array whose numbers are asked for in vain."""

    shape = dtype = property(_fails)  # type: ignore[assignment]
    __getitem__ = __array_function__ = __array_ufunc__ = _fails  # type: ignore[assignment]


def nested(depth: int) -> list[Any]:
    """[[[...]]]."""
    out: list[Any] = []
    for _ in range(depth):
        out = [out]
    return out


def itself() -> list[Any]:
    """A list that holds itself."""
    out: list[Any] = [1.0]
    out.append(out)
    return out


NUMBERS: list[Any] = [
    0, 0.0, -0.0, -1, -1.0, 1, 2, 3, 0.5, 1.5, 1e-300, 5e-324, 1e-120, 1e-32, 1e-12, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e7, 1e9, 1e12,
    1e13, 1e30, 1e120, 1e150, 1e155, 1e200, 1e300, 1.7e308, float("nan"), float("inf"), -float("inf"), -1e300, 2**31, 2**53, 2**63,
    2**64, -(2**63), 10**30, 10**400, -(10**400), 10**5000, 1 - 1e-12, 1 + 1e-12, True, False, 1j, 0j, complex("nan"),
]  # fmt: skip
"""As Python has them."""
TYPES: list[Callable[[Any], Any]] = [
    np.float16, np.float32, np.float64, np.longdouble, np.int8, np.int64, np.uint64, np.bool_, np.complex128, str, repr,
    fractions.Fraction, decimal.Decimal, np.array, lambda x: np.array([x]), lambda x: np.array(x, dtype=object), lambda x: [x],
    lambda x: [[x]], lambda x: (x,), lambda x: {x}, lambda x: {x: x}, lambda x: iter([x]), lambda x: lambda: x,
    lambda x: np.ma.masked_array([x], [True]), lambda x: [x] * 6, lambda x: [[x] * 3] * 4, lambda x: [[x] * 6] * 2,
    lambda x: np.full((4, 3), x), lambda x: np.full(6, x), lambda x: np.broadcast_to(x, (2**40, 6)), lambda x: np.full((0, 6), x),
]  # fmt: skip
OBJECTS: list[Callable[[], Any]] = [
    lambda: None, lambda: ..., lambda: NotImplemented, object, Odd, Frame, Huge, lambda: Odd, lambda: [Odd()] * 6, itself,
    lambda: nested(30), lambda: nested(70), lambda: nested(1000), lambda: nested(20_000), lambda: "", lambda: "a", lambda: "0.4",
    lambda: "nan", lambda: "\0", lambda: "a" * 100_000, lambda: b"\xff", lambda: bytearray(6), lambda: memoryview(b"123456"),
    lambda: "previous", lambda: "sum", lambda: "newton", lambda: "\ud800", lambda: "hard", list, lambda: (), dict, set,
    lambda: [1.0, [2.0]], lambda: [[1.0], [1.0, 2.0]], lambda: [[1.0, 2.0, 3.0], [1.0, 2.0]], lambda: range(6),
    lambda: range(10**12), lambda: [range(10**10)], lambda: np.zeros(()), lambda: np.zeros(0), lambda: np.zeros((0, 0)),
    lambda: np.zeros((1,) * 30), lambda: np.zeros(6, dtype=[("a", float)]), lambda: np.array(["2020"] * 6, dtype="M8[Y]"),
    lambda: np.array([1] * 6, dtype="m8[s]"), lambda: np.datetime64("nat"), lambda: datetime.datetime(2020, 1, 1),
    lambda: np.ma.masked_array(np.ones(6), [1, 0, 0, 0, 0, 0]), lambda: sparse.csr_matrix(np.eye(6)), lambda: np.matrix(np.eye(6)),
    lambda: sparse.coo_array(np.eye(3)), lambda: int, lambda: np.float64, lambda: print, lambda: (x for x in range(6)),
    lambda: np.random.default_rng(0), lambda: ValueError("a"), lambda: np.array([None] * 6), lambda: np.array(10**400),
    lambda: Text("newton"), lambda: Number(0.4), lambda: Whole(3), lambda: Listed(np.ones(6)), lambda: Row(np.ones(6)), Silent, Classless,
    lambda: Everything("a"), lambda: Least(-5), Nameless("Kind", (), {"__repr__": _fails}), lambda: np.ones(6).view(Array),
    lambda: np.timedelta64(3), lambda: [np.timedelta64(1)] * 6, lambda: [True] * 6, lambda: [np.True_, 1.0], lambda: range(10**8),
    lambda: [[0.0], range(10**9)], lambda: [np.broadcast_to(0.0, 10**10)], lambda: [[range(10**6)] * 100] * 100,
    lambda: Mock(spec=Grasp), lambda: Mock(spec=float), lambda: np.ones(6).astype(">f8"), lambda: np.array([np.longdouble("1e4000")] * 6),
    lambda: memoryview(np.ones(6)), lambda: np.frombuffer(b"\0" + bytes(48), "u1")[1:].view("f8"), lambda: decimal.Decimal("0.4"),
    lambda: np.full((4, 3), "a"), lambda: np.broadcast_to(np.float64(0.0), (2**40,)), lambda: np.array([1.0, 10**400], dtype=object),
]  # fmt: skip


def malformed(rng: np.random.Generator, good: Any) -> Any:
    """Something that may stand where `good` should: mostly wrong, sometimes only strange, now and then right."""
    kind = rng.integers(6)
    if kind == 0:
        return OBJECTS[rng.integers(len(OBJECTS))]()
    if kind == 1 or not isinstance(good, np.ndarray | list | tuple | float | int):
        return NUMBERS[rng.integers(len(NUMBERS))]
    if kind == 2:
        number, change = NUMBERS[rng.integers(len(NUMBERS))], TYPES[rng.integers(len(TYPES))]
        try:
            with np.errstate(all="ignore"):
                return change(number)
        except Exception:  # no such value
            return number
    return _spoiled(rng, good)


def _spoiled(rng: np.random.Generator, good: Any) -> Any:
    """A good value with one thing wrong: its size, its shape, its type, or one of its entries."""
    with np.errstate(all="ignore"):
        a = np.array(good, dtype=object if isinstance(good, str) else None)
    kind = rng.integers(7)
    if kind == 0 and a.dtype.kind in "if":
        with np.errstate(all="ignore"):
            scaled = a.astype(float) * 10.0 ** rng.integers(-320, 320)
        return scaled.item() if scaled.ndim == 0 else scaled
    if kind == 1 and a.ndim:
        return (a[:-1], np.concatenate([a, a[:1]]), a[None], a.reshape(-1), a.T, a[..., :0])[rng.integers(6)]
    if kind == 2 and a.dtype.kind in "if":
        with np.errstate(all="ignore"):
            return a.astype(
                [np.float16, np.float32, np.int8, np.int64, complex, bool, "U8", object, "M8[s]"][rng.integers(9)]
            )
    if kind == 3 and a.size:
        out = a.astype(object)
        odd = NUMBERS[rng.integers(len(NUMBERS))] if rng.random() < 0.7 else OBJECTS[rng.integers(len(OBJECTS))]()
        places = list(np.ndindex(out.shape))
        out[places[rng.integers(len(places))]] = odd
        return out if rng.random() < 0.3 or not out.ndim else out.tolist()
    if kind == 4 and a.dtype.kind in "if" and a.size:
        out = np.array(a, dtype=float)
        places = list(np.ndindex(out.shape))
        value = NUMBERS[rng.integers(len(NUMBERS))]
        if isinstance(value, float):
            out[places[rng.integers(len(places))]] = value
        return out
    if kind == 5 and a.dtype.kind in "if" and a.ndim:
        return np.asfortranarray(np.repeat(a, 2, axis=-1)[..., ::2].astype(float)) + 0.0
    return good
