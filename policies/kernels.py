"""Compiled inference: features, network, null-space force and repair in one call (torch costs more than the solve)."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.start_kernels import best_on_segment, combine


@compiled
def forward(features, sizes, weights, out):
    """The network on one feature vector; float32 weights, all layers flattened as (inputs x outputs, then bias)."""
    width = 0
    for size in sizes:
        width = max(width, size)
    a = np.empty(width, np.float32)
    b = np.empty(width, np.float32)
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
            value = a[i]
            row = weights[offset + i * outputs : offset + (i + 1) * outputs]
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
def predict(wrench, friction, normalisation, sizes, weights, pseudoinverse, null_space, out):
    """Raw prediction -G^+ w + B z in contact-frame coordinates, flat (3N,), into `out`."""
    features = np.empty(sizes[0])
    z = np.empty(sizes[sizes.size - 1])
    square = normalisation[1] * normalisation[1]
    for i in range(6):
        features[i] = wrench[i] if i < 3 else wrench[i] / normalisation[0]
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
            total += null_space[j, i] * (m * z[i])
        out[j] = total


@compiled
def predict_repaired(
    wrench, friction, frictions, normalisation, sizes, weights, pseudoinverse, null_space, basis, phi_weights, out
):
    """`predict`, then the force of least Phi between the 12-basis' combination and it; returns the share theta."""
    size = out.size
    x = np.empty(size)
    safe = np.empty(size)
    predict(wrench, friction, normalisation, sizes, weights, pseudoinverse, null_space, x)
    finite = True
    for i in range(size // 3):
        x[3 * i] *= frictions[i]
    for j in range(size):
        finite = finite and math.isfinite(x[j])
    combine(basis, wrench, False, safe)
    if not finite:
        x[:] = safe
    theta = best_on_segment(safe, x, phi_weights, out)
    for i in range(size // 3):
        out[3 * i] /= frictions[i]
    return theta
