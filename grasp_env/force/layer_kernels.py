"""Learned Newton layers, compiled: every layer moves a balanced force inside the cones towards the optimum of Phi.

The torch twin, which trains them, is `policies.newton_layers`. A layer works in coordinates without units: per contact p = u - s and q = u + s, the
eigenvalues of P, changed by the factors 1 + a and 1 + b, and the tangential force across itself by c sqrt(p q). Inside
the cones is then (1 + a) (1 + b) > c^2, at any scale, in any frame.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled_lanes
from grasp_env._views import cut
from grasp_env.force.cholesky6 import factor6, solve6
from grasp_env.force.kernels import phi

FEATURES = 11
"""Numbers that a layer reads of each contact."""
REACH = 0.9
"""Part of the way to the nearest cone that a layer goes at most."""
EASE = 0.1
"""Part of the tolerance that the Newton decrement must promise for further layers to be left out."""
HALVINGS = 3
"""How often a learned step that does not lower Phi is halved before a plain Newton step is tried."""
SMALLEST = 1e-24
"""Added to s^2, so that a force along the normal has a direction too."""
P, Q, ROOT, COS, SIN, I11, I12, I22, I33, F1, F2, N1, N2, N3, D1, D2, D3, ROW = range(18)
"""Kept per contact: p, q, sqrt(p q), the force's direction, H^-1, its own step, the Newton step, the layer's step."""


@compiled_lanes
def refine(x, rows, rest, weights, network, width, steps, tolerance, multipliers):
    """Moves x towards the optimum of Phi by at most `steps` layers, each of which lowers Phi or is the last.

    Args:
        x: (3N,) cone coordinates, balanced and strictly inside; overwritten by what is both as well, with no larger Phi.
        rows: (6, 3N) G in cone coordinates, any frame.
        rest: (3N,) the optimum without a wrench.
        weights: (N, 2) omega and lambda.
        network: (layers, numbers) float32, see `policies.any_grasp.flat`; steps beyond its layers are plain Newton steps.
        width: of the hidden layers.
        steps: how many.
        tolerance: stop where the Newton decrement promises less than this relative gap.
        multipliers: (6,) receives those of the last Newton step looked at, in the frame of rows: second order in how far x was
            from the optimum before it, so that they certify what it made; nan: none.

    Returns:
        Layers that were taken. What rounding leaves of balance (1e-9 of the force where depths in the cones differ a
        thousandfold) is the caller's to take off.
    """
    count = x.size // 3
    padded = (count + 3) // 4 * 4
    # two allocations: one costs as much as a row of a layer's products. (Not `cut`: views must keep them alive.)
    scratch = np.empty(48 + count * (39 + ROW))
    lower, factor, right = scratch[:21], scratch[21:42], scratch[42:48]
    trial = scratch[48 : 48 + 3 * count]
    start = 48 + 3 * count
    work = scratch[start : start + count * ROW].reshape((count, ROW))
    start += count * ROW
    columns = scratch[start : start + 18 * count].reshape((count, 3, 6))
    half = scratch[start + 18 * count :].reshape((count, 3, 6))
    singles = np.zeros(padded * (FEATURES + 3) + (2 * padded + 2) * width, np.float32)
    features = singles[: padded * FEATURES].reshape((padded, FEATURES))
    output = singles[padded * FEATURES : padded * FEATURES + 3 * count].reshape((count, 3))
    hidden = singles[padded * (FEATURES + 3) :].reshape((2 * padded + 2, width))
    value = phi(x, weights)
    taken = 0
    multipliers[:] = np.nan
    for layer in range(steps):
        learned = layer < network.shape[0]
        if not _system(x, rows, weights, work, columns, half, lower, factor):
            break
        decrement, size = _newton_step(work, columns, half, factor, weights, right)
        for r in range(6):
            multipliers[r] = -right[r]
        if decrement <= 2.0 * tolerance * value:
            break
        share = 0.0
        if learned:
            _read(work, rest, weights, decrement / value, size, features)
            _forward(features, network[layer], width, hidden, output)
            share, trust = 1.0 / math.sqrt(1.0 + size), size / (1.0 + size)
            for k in range(count):
                for a in range(3):
                    work[k, D1 + a] = output[k, a] * trust
            _balance(work, columns, half, factor, right)
            for k in range(count):
                for a in range(3):
                    work[k, D1 + a] += share * work[k, N1 + a]
        else:
            work[:, D1 : D3 + 1] = work[:, N1 : N3 + 1]
        found = _move(x, work, weights, value, HALVINGS, trial)
        if not found < value and learned:
            work[:, D1 : D3 + 1] = work[:, N1 : N3 + 1]
            found = _move(x, work, weights, value, 4 * HALVINGS, trial)
        if not found < value:
            break
        x[:] = trial
        value = found
        taken += 1
    return taken


@compiled_lanes
def _system(x, rows, weights, work, columns, half, lower, factor):
    """Coordinates, scaled columns of G, H^-1, each contact's own step and the factor of G H^-1 G^T; False: singular."""
    lower[:] = 0.0
    for k in range(work.shape[0]):
        u, o, t = x[3 * k], x[3 * k + 1], x[3 * k + 2]
        omega, lam = weights[k, 0], weights[k, 1]
        s = math.sqrt(o * o + t * t + SMALLEST)
        q = u + s
        p = (u * u - s * s) / q
        root, total = math.sqrt(p * q), p + q
        row = work[k]
        row[P], row[Q], row[ROOT], row[COS], row[SIN] = p, q, root, o / s, t / s
        bend = 4.0 * lam / (total * total * total)
        h11, h22, h12 = 2.0 * lam / p + bend * p * p, 2.0 * lam / q + bend * q * q, bend * p * q
        det = h11 * h22 - h12 * h12
        row[I11], row[I22], row[I12] = h22 / det, h11 / det, -h12 / det
        row[I33] = p * q / (2.0 * lam * total)
        pull = 1.5 * omega - 2.0 * lam / (total * total)
        g1, g2 = p * pull - lam / p, q * pull - lam / q
        row[F1], row[F2] = -(row[I11] * g1 + row[I12] * g2), -(row[I12] * g1 + row[I22] * g2)
        for r in range(6):
            along = row[COS] * rows[r, 3 * k + 1] + row[SIN] * rows[r, 3 * k + 2]
            across = row[COS] * rows[r, 3 * k + 2] - row[SIN] * rows[r, 3 * k + 1]
            a, b, c = 0.5 * (rows[r, 3 * k] - along) * p, 0.5 * (rows[r, 3 * k] + along) * q, across * root
            columns[k, 0, r], columns[k, 1, r], columns[k, 2, r] = a, b, c
            half[k, 0, r] = a * row[I11] + b * row[I12]
            half[k, 1, r] = a * row[I12] + b * row[I22]
            half[k, 2, r] = c * row[I33]
        n = 0
        for i in range(6):
            for j in range(i + 1):
                lower[n] += (
                    columns[k, 0, i] * half[k, 0, j]
                    + columns[k, 1, i] * half[k, 1, j]
                    + columns[k, 2, i] * half[k, 2, j]
                )
                n += 1
    return factor6(lower, factor) > 0.0


@compiled_lanes
def _newton_step(work, columns, half, factor, weights, right):
    """The Newton step into N1..N3; returns (decrement^2, sum of its squares)."""
    for k in range(work.shape[0]):
        work[k, D1], work[k, D2], work[k, D3] = work[k, F1], work[k, F2], 0.0
    _balance(work, columns, half, factor, right)
    decrement, size = 0.0, 0.0
    for k in range(work.shape[0]):
        row = work[k]
        a, b, c = row[D1], row[D2], row[D3]
        row[N1], row[N2], row[N3] = a, b, c
        size += a * a + b * b + c * c
        p, q, lam = row[P], row[Q], weights[k, 1]
        total = p + q
        bend = 4.0 * lam / (total * total * total)
        mixed = p * a + q * b
        decrement += 2.0 * lam * (a * a / p + b * b / q) + bend * mixed * mixed + c * c * 2.0 * lam * total / (p * q)
    return decrement, size


@compiled_lanes
def _balance(work, columns, half, factor, right):
    """Takes from D1..D3 the least part, in the Hessian of Phi, that would change G f."""
    right[:] = 0.0
    for k in range(work.shape[0]):
        for a in range(3):
            d = work[k, D1 + a]
            for r in range(6):
                right[r] += columns[k, a, r] * d
    right[0], right[1], right[2], right[3], right[4], right[5] = solve6(
        factor, right[0], right[1], right[2], right[3], right[4], right[5]
    )
    for k in range(work.shape[0]):
        for a in range(3):
            total = 0.0
            for r in range(6):
                total += half[k, a, r] * right[r]
            work[k, D1 + a] -= total


@compiled_lanes
def _squash(v):
    return v / math.sqrt(1.0 + abs(v))


@compiled_lanes
def _read(work, rest, weights, relative, size, features):
    count = work.shape[0]
    one, two = 0.2 * math.log(relative + 1e-12), 0.2 * math.log(size + 1e-12)
    for k in range(count):
        row = work[k]
        unit = math.sqrt(weights[k, 1] / weights[k, 0])
        out = features[k]
        out[0], out[1] = 0.5 * math.log(row[P] / unit), 0.5 * math.log(row[Q] / unit)
        out[2], out[3], out[4] = _squash(row[N1]), _squash(row[N2]), _squash(row[N3])
        along = row[COS] * rest[3 * k + 1] + row[SIN] * rest[3 * k + 2]
        across = row[COS] * rest[3 * k + 2] - row[SIN] * rest[3 * k + 1]
        out[5] = _squash((rest[3 * k] - along) / row[P])
        out[6] = _squash((rest[3 * k] + along) / row[Q])
        out[7] = _squash(across / row[ROOT])
        out[8], out[9], out[10] = one, two, count - 4.0


@compiled_lanes
def _products(values, first, inputs, numbers, start, width, hidden, into):
    """Rows into..into + 3 of hidden += values[first..first + 3, :inputs] @ numbers, four contacts per pass over the weights."""
    a, b = cut(hidden[into], 0, (width,)), cut(hidden[into + 1], 0, (width,))
    c, d = cut(hidden[into + 2], 0, (width,)), cut(hidden[into + 3], 0, (width,))
    for i in range(inputs):
        row = cut(numbers, start + i * width, (width,))
        p, q, r, s = values[first, i], values[first + 1, i], values[first + 2, i], values[first + 3, i]
        for j in range(width):
            v = row[j]
            a[j] += p * v
            b[j] += q * v
            c[j] += r * v
            d[j] += s * v


@compiled_lanes
def _forward(features, numbers, width, hidden, output):
    """A perceptron on every contact that also hears the mean of all contacts' first hidden layer.

    features (M, FEATURES), hidden (2 M + 2, width) work space, output (M, 3): M the contacts rounded up to four.
    """
    count, padded, one, part = output.shape[0], features.shape[0], np.float32(1.0), np.float32(0.5)
    second = FEATURES * width + width
    third = second + 2 * width * width + width
    mean, common = hidden[2 * padded], hidden[2 * padded + 1]
    for j in range(width):
        mean[j] = np.float32(0.0)
        common[j] = numbers[third - width + j]
    for k in range(padded):
        row = hidden[k]
        for j in range(width):
            row[j] = numbers[second - width + j]
    for k in range(0, padded, 4):
        _products(features, k, FEATURES, numbers, 0, width, hidden, k)
    for k in range(count):
        row = hidden[k]
        for j in range(width):
            v = row[j]
            row[j] = part * v * (one + v / np.sqrt(one + v * v))
            mean[j] += row[j]
    scale = np.float32(1.0 / count)
    for i in range(width):
        value, row = mean[i] * scale, cut(numbers, second + (width + i) * width, (width,))
        for j in range(width):
            common[j] += value * row[j]
    for k in range(padded):
        row = hidden[padded + k]
        for j in range(width):
            row[j] = common[j]
    for k in range(0, padded, 4):
        _products(hidden, k, width, numbers, second, width, hidden, padded + k)
    for k in range(count):
        row = hidden[padded + k]
        for j in range(width):
            v = row[j]
            row[j] = part * v * (one + v / np.sqrt(one + v * v))
        a, b, c = numbers[third + 3 * width], numbers[third + 3 * width + 1], numbers[third + 3 * width + 2]
        for j in range(width):
            v = row[j]
            a += v * numbers[third + 3 * j]
            b += v * numbers[third + 3 * j + 1]
            c += v * numbers[third + 3 * j + 2]
        output[k, 0], output[k, 1], output[k, 2] = a, b, c


@compiled_lanes
def _move(x, work, weights, value, halvings, trial):
    """Trial = x moved along D1..D3, REACH of the way to the nearest cone at most, halved until Phi < value; returns Phi."""
    theta = 1.0
    for k in range(work.shape[0]):
        a, b, c = work[k, D1], work[k, D2], work[k, D3]
        # inside: 1 + t (a + b) + t^2 (a b - c^2) > 0
        away = math.sqrt((a - b) * (a - b) + 4.0 * c * c) - (a + b)
        if away > 0.0:
            theta = min(theta, REACH * 2.0 / away)
    found = np.inf
    for _ in range(halvings + 1):
        for k in range(work.shape[0]):
            row = work[k]
            dp, dq, across = theta * row[P] * row[D1], theta * row[Q] * row[D2], theta * row[ROOT] * row[D3]
            along = 0.5 * (dq - dp)
            trial[3 * k] = x[3 * k] + 0.5 * (dp + dq)
            trial[3 * k + 1] = x[3 * k + 1] + along * row[COS] - across * row[SIN]
            trial[3 * k + 2] = x[3 * k + 2] + along * row[SIN] + across * row[COS]
        found = phi(trial, weights)
        if found < value:
            break
        theta *= 0.5
    return found
