"""Compiled learned starts: the fixed grasp's network and the Newton layers, with the certificate of what they reach.

torch costs more per call than the whole solve, so inference is compiled over the saved weights.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._check import LARGEST
from grasp_env._compile import compiled
from grasp_env._views import cut, inlined
from grasp_env.force.flow_record import least_change, unit_size
from grasp_env.force.kernels import (
    best_on_segment,
    combine,
    cone_slack,
    lower_bound,
    phi,
    relative_gap,
    residual,
    tangent,
)
from grasp_env.force.lanes import load, pull_back
from grasp_env.force.layer_kernels import EASE, refine
from grasp_env.force.record import (
    BOUND,
    CODE,
    CONVERGED,
    FORCE,
    ITERATIONS,
    LIMIT,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    REFUSED,
    RESIDUAL,
    TRIALS,
    WRENCH,
)  # fmt: skip

OUTSIDE, OPEN = 1, 2
"""What a start answers; 0: inside the training range, and certified. REFUSED is 4."""
SETTLED = 1e-7
"""Relative gap that the Newton decrement must promise for further layers to be left out, where no tolerance is larger."""


@compiled
def forward(features, sizes, weights, out):
    """The network on one feature vector; float32 weights, all layers flattened as (inputs x outputs, then bias)."""
    width = 0
    for size in sizes:
        width = max(width, size)
    both = np.empty(2 * width, np.float32)
    a, b = both[:width], both[width:]  # not `cut`: views must keep it alive
    for i in range(sizes[0]):
        a[i] = features[i]
    offset = 0
    last = sizes.size - 2
    for layer in range(last + 1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        bias = offset + inputs * outputs
        for j in range(outputs):
            b[j] = weights[bias + j]
        for i in range(inputs):
            value, row = a[i], cut(weights, offset + i * outputs, (outputs,))
            for j in range(outputs):
                b[j] += value * row[j]
        if layer < last:
            one, half = np.float32(1.0), np.float32(0.5)
            for j in range(outputs):
                v = b[j]
                a[j] = half * v * (one + v / np.sqrt(one + v * v))
        offset = bias + outputs
    for j in range(sizes[last + 1]):
        out[j] = b[j]


@compiled
def predict(wrench, friction, scale, normalisation, sizes, weights, pseudoinverse, null_space, out):
    """Raw prediction -G^+ w + B z in contact-frame coordinates, flat (3N,), into `out`.

    scale: sqrt(lambda / omega) over that of training: Phi only knows forces in that unit.
    """
    features = np.empty(sizes[0])
    z = np.empty(sizes[sizes.size - 1])
    square = normalisation[1] * normalisation[1]
    for i in range(6):
        features[i] = (wrench[i] if i < 3 else wrench[i] / normalisation[0]) / scale
        square += features[i] * features[i]
    m = math.sqrt(square)
    for i in range(6):
        features[i] /= m
    features[6] = (math.log(m) - normalisation[2]) / normalisation[3]
    features[7] = (friction - normalisation[4]) / normalisation[5]
    forward(features, sizes, weights, z)
    for j in range(out.size):
        total = 0.0
        for i in range(6):
            total -= pseudoinverse[j, i] * wrench[i]
        for i in range(z.size):
            total += null_space[j, i] * (m * scale * z[i])
        out[j] = total


@compiled
def better(x, safe, weights):
    """X (3N,) = the force of least Phi on the way from `safe` to x, or x itself where that has less Phi than `safe`."""
    finite = True
    for j in range(x.size):
        finite = finite and abs(x[j]) < LARGEST
    if not finite:
        x[:] = safe
    elif not phi(x, weights) <= phi(safe, weights):
        best_on_segment(safe, x.copy(), weights, x)


NUMBERS = 14
"""Numbers before the contacts: see `split_numbers`."""
TOLERANCE, LIMIT_LENGTH, LIMIT_SIZE, OPTIONS = 0, 1, 5, 6


@inlined
def split_contacts(numbers, n):
    """Of one flat array, which costs a compiled call an eighth of what a tuple does.

    It begins with the relative gap to certify, the length and centre [m] of the frame in which training measured wrenches, their
    largest size there [N] (negative: nothing is inside), and `lanes.options`.

    Returns:
        G (6, 3N) in cone coordinates, the same in the unit frame, G^+ (3N, 6) in cone coordinates, divisor (N, 3),
        weights (N, 2) and the 12-basis with the rest (13, 3N).
    """
    return (
        cut(numbers, NUMBERS, (6, 3 * n)),
        cut(numbers, NUMBERS + 18 * n, (6, 3 * n)),
        cut(numbers, NUMBERS + 36 * n, (3 * n, 6)),
        cut(numbers, NUMBERS + 54 * n, (n, 3)),
        cut(numbers, NUMBERS + 57 * n, (n, 2)),
        cut(numbers, NUMBERS + 59 * n, (13, 3 * n)),
    )


@inlined
def split_network(numbers, n, outputs):
    """(pseudoinverse (3N, 6), null-space basis (3N, outputs), normalisation (6,), friction, scale): they follow the contacts."""
    start = NUMBERS + 98 * n
    size = start + 18 * n + 3 * n * outputs
    return (
        cut(numbers, start, (3 * n, 6)),
        cut(numbers, start + 18 * n, (3 * n, outputs)),
        cut(numbers, size, (6,)),
        numbers[size + 6],
        numbers[size + 7],
    )


@compiled
def raw_fixed(wrench, numbers, sizes, flat, out):
    """The fixed grasp's network alone, a force (normal, o, t) [N] into out (3N,)."""
    pseudoinverse, null_space, normalisation, friction, scale = split_network(numbers, out.size // 3, sizes[-1])
    predict(wrench, friction, scale, normalisation, sizes, flat, pseudoinverse, null_space, out)


@compiled
def start_fixed(wrench, previous, numbers, sizes, flat, layers, width, polish, record):
    """The fixed grasp's start, and where it is certified optimal the whole record (`record.py`).

    Args:
        wrench: (6,) [N, N m].
        previous: (>= 3N,) a force (normal, o, t) [N] that was optimal before, or (0,).
        numbers: see `split_contacts`, `split_network`.
        sizes, flat: see `forward`.
        layers, width: learned Newton layers that polish the network's force, see `layer_kernels.refine`; (0, 0): Newton steps.
        polish: how many at most; after the first only where the certificate asks.
        record: (20 + 7N,) overwritten. CODE: CONVERGED, or LIMIT where a descent has to go on from the initial force in it, or
            REFUSED for a wrench that is not finite.

    Returns:
        OUTSIDE where the wrench was larger than those of training, plus OPEN where a descent has to go on; or REFUSED.
    """
    record[CODE] = REFUSED
    if not _finite(wrench):
        return REFUSED
    x = np.empty((record.size - FORCE) // 7 * 3)
    divisor = split_contacts(numbers, x.size // 3)[3]
    raw_fixed(wrench, numbers, sizes, flat, x)
    for j in range(x.size):
        x[j] *= divisor[j // 3, j % 3]
    return _refined(wrench, previous, layers, width, polish, numbers, x, True, record)


@compiled
def start_layers(wrench, previous, numbers, layers, width, record):
    """The start that learned Newton layers make, as `start_fixed`; layers, width: see `layer_kernels.refine`."""
    record[CODE] = REFUSED
    if not _finite(wrench):
        return REFUSED
    x = np.empty((record.size - FORCE) // 7 * 3)
    return _refined(wrench, previous, layers, width, layers.shape[0], numbers, x, False, record)


@compiled
def _refined(wrench, previous, layers, width, steps, numbers, x, guessed, record):
    """The best of the 12-basis' combination, x itself (if `guessed`) and the previous optimum, then Newton layers; the record.

    Every part only ever lowers Phi: never worse than the 12-basis or the previous solution, by construction.
    """
    count = x.size // 3
    cone_matrix, _, inverse, divisor, weights, basis = split_contacts(numbers, count)
    scratch = np.empty(18 + 3 * x.size)
    safe, carried = scratch[18 : 18 + x.size], scratch[18 + x.size : 18 + 2 * x.size]
    before = scratch[18 + 2 * x.size :]
    combine(basis, wrench, False, safe)
    if guessed:
        better(x, safe, weights)
    else:
        x[:] = safe
    options, six, multipliers = cut(numbers, OPTIONS, (8,)), scratch[:6], scratch[6:12]
    load(wrench, options, six)
    value, bound, done = np.inf, -np.inf, False
    if previous.size > 0:
        for j in range(x.size):
            before[j] = previous[j] * divisor[j // 3, j % 3]
        known = phi(before, weights) < np.inf and tangent(before, cone_matrix, wrench, weights, carried)
        if known:
            least_change(carried, cone_matrix, inverse, wrench)
            better(carried, safe, weights)
            known = phi(carried, weights) < phi(x, weights)
        if known:
            value, bound = _polished(carried, six, wrench, layers, width, steps, guessed, numbers, multipliers)
            done = relative_gap(value, bound) <= numbers[TOLERANCE]
    if not done:
        # also where the carried force has less Phi: close to a cone the layers may get less far from it
        dual = scratch[12:18]
        other, other_bound = _polished(x, six, wrench, layers, width, steps, guessed, numbers, dual)
        if not value <= other:
            value, bound, multipliers = other, other_bound, dual
        else:
            x[:] = carried
            if other_bound > bound:
                bound, multipliers = other_bound, dual
        done = relative_gap(value, bound) <= numbers[TOLERANCE]
    else:
        x[:] = carried
    if not value <= phi(safe, weights):
        x[:] = safe  # rounding only
        value = phi(safe, weights)
    record[CODE] = CONVERGED if done else LIMIT
    record[ITERATIONS] = record[TRIALS] = 0.0
    record[OBJECTIVE], record[BOUND], record[MARGIN] = value, bound, cone_slack(x)
    given = pull_back(options, multipliers)
    residual(cone_matrix, x, wrench, six)
    record[RESIDUAL] = unit_size(six, options, safe)
    for r in range(6):
        record[WRENCH + r], record[MULTIPLIERS + r] = wrench[r], given[r]
    for j in range(x.size):
        record[FORCE + j] = record[FORCE + x.size + j] = x[j] / divisor[j // 3, j % 3]
    for k in range(count):
        record[FORCE + 2 * x.size + k] = 0.0
    outside = 0 if _size(wrench, numbers) <= numbers[LIMIT_SIZE] else OUTSIDE
    return outside if done else outside + OPEN


@compiled
def _polished(x, unit, wrench, layers, width, steps, each, numbers, multipliers):
    """X through the layers, with a certificate after each (`each`) or at their end; returns (Phi, lower bound)."""
    cone_matrix, rows, inverse, _, weights, basis = split_contacts(numbers, x.size // 3)
    settled = max(SETTLED, EASE * numbers[TOLERANCE])
    together = 1 if each else steps
    value, bound = np.inf, -np.inf
    for begin in range(0, max(steps, 1), max(together, 1)):
        refine(x, rows, basis[12], weights, layers[begin:], width, min(together, steps - begin), settled, multipliers)
        least_change(x, cone_matrix, inverse, wrench)
        value, bound = phi(x, weights), lower_bound(multipliers, rows, unit, weights)
        if relative_gap(value, bound) <= numbers[TOLERANCE]:
            break
    return value, bound


@compiled
def _finite(wrench):
    total = 0.0
    for r in range(6):
        total += abs(wrench[r])
    return total <= LARGEST


@compiled
def _size(wrench, numbers):
    length, x, y, z = (
        numbers[LIMIT_LENGTH],
        numbers[LIMIT_LENGTH + 1],
        numbers[LIMIT_LENGTH + 2],
        numbers[LIMIT_LENGTH + 3],
    )
    a = (wrench[3] - (y * wrench[2] - z * wrench[1])) / length
    b = (wrench[4] - (z * wrench[0] - x * wrench[2])) / length
    c = (wrench[5] - (x * wrench[1] - y * wrench[0])) / length
    return math.sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2 + a * a + b * b + c * c)
