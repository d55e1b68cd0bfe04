"""What a pipeline still does between the core's start and its end: the flow, until it moves there."""

from __future__ import annotations

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.factor_kernels import flow_lanes
from grasp_env.force.flow_products import PROJECTOR, ROW_SPACE
from grasp_env.force.flow_record import run_flow
from grasp_env.force.lanes import CONSTANTS, LANES, pack_into
from grasp_env.force.record import CODE, REFUSED


@compiled
def flow_from(start, rest, rows, inverse, cone_matrix, divisor, weights, wrench, rule, options, record):
    """The flow from cone coordinates `start` (3N,) on the contacts of now into `record` (20 + 7N,).

    Args:
        start: balanced and strictly inside.
        rest: (3N,) an internal force strictly inside the cones.
        rows, inverse: G (6, 3N) in cone coordinates and the unit frame, and its G^+ (3N, 6).
        cone_matrix: (6, 3N) G in cone coordinates.
        divisor: (N, 3) of cone coordinates. weights: (N, 2) omega and lambda. wrench: (6,) [N, N m].
        rule: (5,) from `StepRule.parameters`. options: (8,) from `lanes.options`.
    """
    record[CODE] = REFUSED
    count = divisor.shape[0]
    blocks = (count + LANES - 1) // LANES
    constants = np.empty((blocks, LANES * CONSTANTS))
    pack_into(rows, inverse, rest, divisor, weights, constants)
    first, none, places = flow_lanes(rows), np.zeros((blocks, 0, 0)), np.zeros((0, 12), dtype=np.int64)
    if first.shape[0] == 0:
        return
    force = np.empty(start.size)
    for j in range(start.size):
        force[j] = start[j] / divisor[j // 3, j % 3]
    run_flow(
        constants, PROJECTOR if blocks == 1 else ROW_SPACE, first, none, places, force, cone_matrix, divisor, weights, wrench,
        rule, options, record, np.empty(0),
    )  # fmt: skip
