"""Values that people pass by mistake: another type or unit, a wrong shape, a number that is
missing, infinite or far too large."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st

NUMBERS: list[Any] = [
    0,
    0.0,
    -1,
    -1.0,
    1,
    2,
    3,
    0.5,
    1e-300,
    1e-12,
    1e-6,
    1e3,
    1e6,
    1e9,
    1e13,
    1e155,
    1e300,
    float("nan"),
    float("inf"),
    -float("inf"),
    2**31,
    1 - 1e-12,
    True,
    False,
    1j,
    np.float32(0.3),
    np.int8(3),
    np.float64("nan"),
]
OBJECTS: list[Any] = [
    None,
    "",
    "a",
    "0.4",
    "nan",
    "newton",
    "sum",
    "previous",
    [],
    (),
    {},
    int,
    print,
    [None] * 6,
    [1.0, [2.0]],
    [[1.0, 2.0, 3.0], [1.0, 2.0]],
    ["1"] * 6,
    [True] * 6,
    [1j] * 6,
    [[0.0]] * 70,
    {"a": 1.0},
    np.zeros(()),
    np.zeros(0),
    np.zeros((0, 3)),
    np.ones(6),
    np.ones((4, 3)),
    np.full(6, np.nan),
    np.full((4, 3), np.inf),
    np.eye(6),
    np.ones(6, dtype=np.float32),
    np.ones(6).astype(">f8"),
    np.ma.masked_array(np.ones(6), [1, 0, 0, 0, 0, 0]),
]


@st.composite
def mistakes(draw: st.DrawFn, good: Any) -> Any:
    """Draw something to pass in place of `good`: another object, or the same with one mistake in
    it."""
    if (
        not isinstance(good, np.ndarray | list | tuple | float | int)
        or isinstance(good, bool)
        or draw(st.booleans())
    ):
        return (NUMBERS + OBJECTS)[draw(st.integers(0, len(NUMBERS + OBJECTS) - 1))]
    array = np.array(good, dtype=object if np.asarray(good).dtype.kind not in "if" else float)
    kind = draw(st.sampled_from(["scale", "shape", "type", "entry"]))
    if kind == "scale" and array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            scaled = array * 10.0 ** draw(st.integers(-300, 300))
        return scaled if scaled.ndim else float(scaled)
    if kind == "shape" and array.ndim:
        more = np.concatenate([array, array[:1]])
        flat = array.reshape(-1)
        return [array[:-1], more, array[None], flat, array.T, array[..., :0]][
            draw(st.integers(0, 5))
        ]
    if kind == "type" and array.dtype.kind == "f":
        with np.errstate(all="ignore"):
            return array.astype(draw(st.sampled_from(["f4", "i1", "i8", "c16", "U8", "O"])))
    if not array.size:
        return None
    spoiled = array.astype(object)
    spoiled.flat[draw(st.integers(0, array.size - 1))] = NUMBERS[
        draw(st.integers(0, len(NUMBERS) - 1))
    ]
    return spoiled.tolist()
