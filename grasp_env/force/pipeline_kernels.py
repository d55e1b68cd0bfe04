"""The force pipeline, compiled: contacts of now in, optimal force and certificates out; see `pipeline.ForcePipeline`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from grasp_env._check import LARGEST, Array
from grasp_env._compile import compiled
from grasp_env._views import cut, inlined
from grasp_env.force.basis_kernels import ACCEPTED_GAP, BASIS_ITERATIONS, BASIS_TOLERANCE, offline_basis
from grasp_env.force.descent_kernels import STALLED
from grasp_env.force.factor_kernels import flow_lanes, orthonormal_rows, smooth_null_space, write_inverse
from grasp_env.force.flow_products import PROJECTOR, ROW_SPACE
from grasp_env.force.flow_record import least_change, run_flow
from grasp_env.force.kernels import lower_bound, phi, relative_gap
from grasp_env.force.lanes import CENTRE, CONSTANTS, GAP, KNOWN, LANE_COUNT, LANES, LENGTH, STEPS, load, pack_into
from grasp_env.force.layer_kernels import EASE, refine
from grasp_env.force.newton_kernels import GIVEN, newton
from grasp_env.force.record import CODE, FORCE, REFUSED
from grasp_env.force.start_kernels import best_on_segment, combine, tangent
from grasp_env.grasp.kernels import (
    ROUNDING,
    UNIT_TOLERANCE,
    is_clearly_full_rank,
    to_unit_frame,
    write_contact_geometry,
    write_unit_frame,
)

FLOW, NEWTON = 0, 1
"""Methods."""
METHOD, PREVIOUS, TOLERANCE, MOST_STEPS, MAX_LANES, WIDTH = range(6)
"""Places in the settings: FLOW or NEWTON; whether to start from the last optimum; relative gap; most steps; lanes; width of
the learned layers."""
CARRIED, REPAIRED, CLIPPED = 0, 1, 2
"""How a force was carried."""
FAR = 2.0
"""Where carrying the combination to the contacts of now makes Phi grow by more than this factor the basis is old."""


class Held(NamedTuple):
    """What a pipeline holds between calls, for kernels: C-contiguous writable float64 arrays, overwritten in place.

    The optimum and the basis are written in the contact frames that they were found in; other contacts get them by `turn` and a
    tangent correction.

    Attributes:
        x: (3N,) the last optimum, cone coordinates [N]; nan: none.
        frames: (N, 3, 3) its contact frames, columns (n, o, t), object frame.
        cone_matrix: (6, 3N) its G in cone coordinates.
        basis: (13, 3N) offline basis, cone coordinates.
        basis_frames: (N, 3, 3) the contact frames it is written in.
        divisor: (N, 3) force = cone coordinates / divisor.
        weights: (N, 2) omega and lambda of Phi.
        tangents: (N, 3) directions of o, or (0, 3): the default rule.
    """

    x: Array
    frames: Array
    cone_matrix: Array
    basis: Array
    basis_frames: Array
    divisor: Array
    weights: Array
    tangents: Array


def held_size(count: int) -> int:
    """Numbers in what is held for N contacts, without the tangents."""
    return 83 * count


@inlined
def split_held(numbers, count, tangents):
    """The `Held` views of one flat array of `held_size` numbers, which costs a compiled call an eighth of what the tuple does."""
    n = count
    return Held(
        cut(numbers, 0, (3 * n,)),
        cut(numbers, 3 * n, (n, 3, 3)),
        cut(numbers, 12 * n, (6, 3 * n)),
        cut(numbers, 30 * n, (13, 3 * n)),
        cut(numbers, 69 * n, (n, 3, 3)),
        cut(numbers, 78 * n, (n, 3)),
        cut(numbers, 81 * n, (n, 2)),
        tangents,
    )


@compiled
def solve_held(points, normals, wrench, adjust, reference, numbers, tangents, rule, settings, layers, record):
    """`solve_contacts` with what is held as `split_held` takes it."""
    held = split_held(numbers, points.shape[0], tangents)
    solve_contacts(points, normals, wrench, adjust, reference, held, rule, settings, layers, record)


@compiled
def turn(x, divisor, old, new, out):
    """Out (3N,) = x with its tangential parts turned from the tangents of `old` into those of `new` frames (N, 3, 3).

    What the frames' tilt takes off a tangential force is left out, so that out is inside the cones where x is (round cones).
    """
    for k in range(divisor.shape[0]):
        fo, ft = x[3 * k + 1] / divisor[k, 1], x[3 * k + 2] / divisor[k, 2]
        o, t = 0.0, 0.0
        for a in range(3):
            along = old[k, a, 1] * fo + old[k, a, 2] * ft
            o += new[k, a, 1] * along
            t += new[k, a, 2] * along
        out[3 * k], out[3 * k + 1], out[3 * k + 2] = x[3 * k], o * divisor[k, 1], t * divisor[k, 2]


@compiled
def carry(x, basis, cone_matrix, wrench, weights, out):
    """A force that was optimal before, carried to the cone matrix and the wrench of now and strictly inside the cones.

    The tangent correction (one 6 x 6 system); where that leaves the cones, the least Phi on the segment to it from the
    basis' combination, itself carried; where even that is outside, the force clipped into the cones, without balance.
    Nothing but `out` is written. x and basis are in the frames of `cone_matrix`: `turn` takes them there, which matters where the
    default tangents jump (|n . e_x| > 0.9).

    Args:
        x: (3N,) the optimum before, cone coordinates [N].
        basis: (13, 3N) an offline basis of nearby contacts.
        cone_matrix: (6, 3N) G in cone coordinates.
        wrench: (6,) external wrench [N, N m], in the frame of cone_matrix.
        weights: (N, 2) omega and lambda of Phi.
        out: (3N,) overwritten; not x.

    Returns:
        CARRIED, REPAIRED or CLIPPED.
    """
    combined = np.empty_like(x)
    combine(basis, wrench, False, combined)
    return carry_or_repair(x, combined, cone_matrix, wrench, weights, out)


@compiled
def carry_or_repair(x, combined, cone_matrix, wrench, weights, out):
    """`carry` with the combination given (3N,)."""
    if not tangent(x, cone_matrix, wrench, weights, out):
        out[:] = x
    if phi(out, weights) < np.inf:  # false for nan
        return CARRIED
    safe, moved, finite = np.empty_like(x), out.copy(), True
    for j in range(moved.size):
        finite = finite and abs(moved[j]) < LARGEST
    if not finite:
        moved[:] = combined
    if tangent(combined, cone_matrix, wrench, weights, safe) and phi(safe, weights) < np.inf:
        out[:] = safe
        if finite:
            best_on_segment(safe, moved, weights, out)
        return REPAIRED
    out[:] = moved
    # give up a little balance (the pose feedback takes it back), never the friction cone
    for j in range(0, out.size, 3):
        out[j] = max(out[j], 1.05 * math.sqrt(out[j + 1] * out[j + 1] + out[j + 2] * out[j + 2]))
    return CLIPPED


@compiled
def carry_contacts(held, points, normals, wrench, frames, cone_matrix, force):
    """The last optimum carried to contacts and wrench of now, from `pipeline.held`, which is only read.

    Call it after a successful solve, with finite points and unit normals.

    Args:
        held: `ForcePipeline.held`.
        points, normals: (N, 3) contact points [m] and inward unit normals, object frame.
        wrench: (6,) external wrench [N, N m], object frame.
        frames: (N, 3, 3) overwritten: contact frames of now, columns (n, o, t).
        cone_matrix: (6, 3N) overwritten: G of now in cone coordinates.
        force: (N, 3) overwritten: (normal, o, t) [N] in `frames`; frames[k] @ force[k] is the force on the object.

    Returns:
        CARRIED, REPAIRED or CLIPPED, see `carry`.
    """
    size = held.x.size
    matrix, x, combined, out = np.empty((6, size)), np.empty(size), np.empty(size), np.empty(size)
    write_contact_geometry(points, normals, held.divisor, held.tangents, frames, matrix, cone_matrix)
    turn(held.x, held.divisor, held.frames, frames, x)
    combine(held.basis, wrench, False, out)
    turn(out, held.divisor, held.basis_frames, frames, combined)
    outcome = carry_or_repair(x, combined, cone_matrix, wrench, held.weights, out)
    for j in range(size):
        force[j // 3, j % 3] = out[j] / held.divisor[j // 3, j % 3]
    return outcome


@compiled
def solve_contacts(points, normals, wrench, adjust, reference, held, rule, settings, layers, record):
    """One solve; writes `record`, and what is held unless REFUSED. REFUSED: the general path has to say why.

    Args:
        points, normals: (N, 3) contact points [m] and inward unit normals, object frame.
        wrench: (6,) external wrench [N, N m], object frame.
        adjust: (3N - 6,) null-space coordinates [N], or (0,): none.
        reference: (3N, 3N - 6) their object-frame directions.
        held: `Held`.
        rule: (5,) from `StepRule.parameters`.
        settings: (6,) see above.
        layers: (K, numbers) float32 learned Newton layers that the start goes through (`layer_kernels.refine`), or (0, 0).
        record: (20 + 7N,) overwritten, see `record.py`.
    """
    count = points.shape[0]
    size = 3 * count
    record[CODE] = REFUSED
    inward = np.empty((count, 3))
    if not _trusted(points, normals, wrench, inward):
        return
    frames, matrix, cone_matrix = np.empty((count, 3, 3)), np.empty((6, size)), np.empty((6, size))
    write_contact_geometry(points, inward, held.divisor, held.tangents, frames, matrix, cone_matrix)
    options, unit_frame, unit = np.empty(8), np.empty((6, 6)), np.empty(6)
    options[LENGTH] = write_unit_frame(points, options[CENTRE : CENTRE + 3], unit_frame)
    options[GAP], options[STEPS], options[LANE_COUNT] = settings[TOLERANCE], settings[MOST_STEPS], settings[MAX_LANES]
    options[KNOWN] = np.nan
    force_rows, rows, inverse = np.empty((6, size)), np.empty((6, size)), np.empty((size, 6))
    orthonormal, lower = np.empty((6, size)), np.empty((6, 6))
    for j in range(size):
        to_unit_frame(unit_frame, matrix, j, force_rows, j)
        to_unit_frame(unit_frame, cone_matrix, j, rows, j)
    if not (is_clearly_full_rank(force_rows) and orthonormal_rows(force_rows, orthonormal, lower)):
        return
    write_inverse(orthonormal, lower, held.divisor, inverse)
    load(wrench, options, unit)
    blocks = (count + LANES - 1) // LANES
    constants = np.empty((blocks, LANES * CONSTANTS))
    pack_into(rows, inverse, held.basis[12], held.divisor, held.weights, constants)
    safe, x = np.empty(size), np.empty(size)
    if not _combination(wrench, unit, rows, frames, held, safe):
        if not _new_basis(cone_matrix, unit_frame, inverse, frames, constants, options, held):
            return
        combine(held.basis, wrench, False, safe)
    least_change(safe, rows, inverse, unit)
    x[:] = safe
    if settings[PREVIOUS] > 0.0 and phi(held.x, held.weights) < np.inf:
        turned = np.empty(size)
        turn(held.x, held.divisor, held.frames, frames, turned)
        if tangent(turned, rows, unit, held.weights, x):
            least_change(x, rows, inverse, unit)
            if not phi(x, held.weights) < phi(safe, held.weights):
                best_on_segment(safe, x.copy(), held.weights, x)
        else:
            x[:] = safe
    if layers.shape[0] > 0:
        rest, dual = np.empty(size), np.empty(6)
        turn(held.basis[12], held.divisor, held.basis_frames, frames, rest)
        settled, width = EASE * settings[TOLERANCE], int(settings[WIDTH])
        refine(x, rows, rest, held.weights, layers, width, layers.shape[0], settled, dual)
        least_change(x, rows, inverse, unit)
        value, bound = phi(x, held.weights), lower_bound(dual, rows, unit, held.weights)
        if settings[PREVIOUS] > 0.0 and not relative_gap(value, bound) <= settings[TOLERANCE]:
            # close to a cone the layers may get less far from the last optimum, though that has less Phi
            other = safe.copy()
            refine(other, rows, rest, held.weights, layers, width, layers.shape[0], settled, dual)
            least_change(other, rows, inverse, unit)
            if phi(other, held.weights) < value:
                x[:] = other
    if adjust.size > 0:
        basis, moved = np.empty((size, adjust.size)), np.empty(size)
        if not smooth_null_space(frames, orthonormal, reference, basis):
            return
        for j in range(size):
            total = 0.0
            for c in range(adjust.size):
                total += basis[j, c] * adjust[c]
            moved[j] = x[j] + total * held.divisor[j // 3, j % 3]
            if not abs(moved[j]) < LARGEST:
                return
        least_change(moved, rows, inverse, unit)
        best_on_segment(safe, moved, held.weights, x)
    for j in range(size):
        x[j] /= held.divisor[j // 3, j % 3]
    no_trace = np.empty(0)
    if settings[METHOD] == NEWTON:
        newton(constants, held.basis, GIVEN, x, wrench, held.weights, options, record, no_trace)
    else:
        first, none, places = flow_lanes(rows), np.zeros((blocks, 0, 0)), np.zeros((0, 12), dtype=np.int64)
        if first.shape[0] == 0:
            return
        run_flow(
            constants, PROJECTOR if blocks == 1 else ROW_SPACE, first, none, places, x, cone_matrix, held.divisor, held.weights,
            wrench, rule, options, record, no_trace,
        )  # fmt: skip
    if record[CODE] <= STALLED:  # also cut short: balanced and inside the cones
        for j in range(size):
            held.x[j] = record[FORCE + j] * held.divisor[j // 3, j % 3]
        held.frames[:] = frames
        held.cone_matrix[:] = cone_matrix


@compiled
def _trusted(points, normals, wrench, inward):
    """Whether all numbers are finite and the normals of unit length; `inward` (N, 3): the normals as `Grasp` takes them."""
    total = 0.0
    for r in range(6):
        if not abs(wrench[r]) <= LARGEST:
            return False
    for k in range(points.shape[0]):
        x, y, z = normals[k]
        length = math.sqrt(x * x + y * y + z * z)
        total += points[k, 0] + points[k, 1] + points[k, 2]
        if not abs(length - 1.0) <= UNIT_TOLERANCE:
            return False
        scale = length if abs(length - 1.0) > ROUNDING else 1.0
        inward[k, 0], inward[k, 1], inward[k, 2] = x / scale, y / scale, z / scale
    return abs(total) < np.inf


@compiled
def _combination(wrench, unit, rows, frames, held, out):
    """Out (3N,) = the basis' combination carried to the contacts of now; False where it is outside the cones or far."""
    there, turned = np.empty_like(out), np.empty_like(out)
    combine(held.basis, wrench, False, there)
    turn(there, held.divisor, held.basis_frames, frames, turned)
    if not tangent(turned, rows, unit, held.weights, out):
        return False
    value = phi(out, held.weights)
    return value < np.inf and value <= FAR * phi(there, held.weights)


@compiled
def _new_basis(cone_matrix, unit_frame, inverse, frames, constants, options, held):
    """The offline basis of the contacts of now in place of the one that is held; False: none found from there."""
    basis, numbers, raw = np.empty_like(held.basis), options.copy(), np.zeros_like(inverse)
    numbers[GAP], numbers[STEPS] = BASIS_TOLERANCE, BASIS_ITERATIONS
    for row in range(13):
        turn(held.basis[row], held.divisor, held.basis_frames, frames, basis[row])
    for j in range(raw.shape[0]):
        for r in range(6):
            for i in range(6):
                raw[j, r] += inverse[j, i] * unit_frame[i, r]
    nothing = np.zeros(raw.shape[0])
    if (
        not offline_basis(basis, True, nothing, constants, cone_matrix, raw, held.divisor, held.weights, numbers)
        < ACCEPTED_GAP
    ):
        return False
    held.basis[:] = basis
    held.basis_frames[:] = frames
    return True
