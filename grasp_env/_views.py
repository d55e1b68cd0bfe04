"""What keeps kernels of a control loop small: views into flat arrays, small arrays on the stack, functions that are always inlined.

Between two ticks the physics empties the caches, so that a kernel costs what its instructions and data take to load, several times what
they take to run. A numpy slice with `reshape` is 400 bytes of machine code with its checks and reference counts, a `cut` is 20.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload, register_jitable
from numba.np.arrayobj import make_array, populate_array

from grasp_env._check import Array


def inlined(function: Callable[..., Any]) -> Any:
    """Stays Python when Python calls it; kernels that call it take its code in, so that views nobody reads cost nothing."""
    return register_jitable(forceinline=True, error_model="numpy", fastmath=False)(function)


def cut(array: Any, start: int, shape: tuple[int, ...]) -> Any:
    """The view array[start:].reshape(shape) of a flat C-contiguous array, unchecked.

    In a kernel the view does not keep `array` alive: cut what the caller owns, never an array that the kernel made itself (it is
    freed after its last use by name), and do not return the view.
    """
    return array[start : start + math.prod(shape)].reshape(shape)


def small(size: int) -> Array:
    """`np.empty(size)`; in a kernel, where the size must be a constant, on the stack: it must not be returned."""
    return np.empty(size)


@overload(cut, jit_options={"forceinline": True})
def _compiled_cut(array, start, shape):  # pyright: ignore[reportUnusedFunction]
    return lambda array, start, shape: _view(array, start, shape)  # pyright: ignore[reportCallIssue]


@overload(small, prefer_literal=True, jit_options={"forceinline": True})
def _compiled_small(size):  # pyright: ignore[reportUnusedFunction]
    if isinstance(size, types.IntegerLiteral):
        count = size.literal_value
        return lambda size: _stack(count)  # pyright: ignore[reportCallIssue]
    return None


@intrinsic
def _view(typing, array, start, shape):
    found = types.Array(array.dtype, len(shape), "C")

    def generate(context, builder, signature, arguments):
        source = make_array(signature.args[0])(context, builder, arguments[0])
        data = builder.gep(source.data, [arguments[1]])
        return _array(context, builder, found, data, cgutils.unpack_tuple(builder, arguments[2]))

    return found(array, types.intp, types.UniTuple(types.intp, len(shape))), generate


@intrinsic(prefer_literal=True)
def _stack(typing, size):
    if not isinstance(size, types.IntegerLiteral):
        return None
    found, count = types.Array(types.float64, 1, "C"), size.literal_value

    def generate(context, builder, signature, arguments):
        length = context.get_constant(types.intp, count)
        data = cgutils.alloca_once(builder, context.get_data_type(types.float64), size=count)
        return _array(context, builder, found, data, [length])

    return found(size), generate


def _array(context: Any, builder: Any, found: Any, data: Any, shape: list[Any]) -> Any:
    width = context.get_constant(types.intp, found.dtype.bitwidth // 8)
    strides = [width]
    for length in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], length))
    out = make_array(found)(context, builder)
    populate_array(out, data=data, shape=shape, strides=strides, itemsize=width, meminfo=None)
    return out._getvalue()
