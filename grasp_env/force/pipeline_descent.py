"""A pipeline's descent where it is not the core's yet: the flow, between its start and its end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from grasp_env import core
from grasp_env._check import Array
from grasp_env.force.lanes import CENTRE, LENGTH, options
from grasp_env.force.method import readable
from grasp_env.force.pipeline_kernels import flow_from
from grasp_env.force.record import CODE, REFUSED

if TYPE_CHECKING:
    from grasp_env.force.optimizer import ForceOptimizer
    from grasp_env.force.pipeline import Held


class KernelDescent:
    """`core.Pipeline.solve` with numba's flow in it: the same arguments, the same answer."""

    def __init__(self, pipeline: core.Pipeline, checked: ForceOptimizer, held: Held) -> None:
        """Checked: the settings."""
        self._core, self._held = pipeline, held
        self._now = pipeline.arrays()
        self._divisor = np.array(held.divisor)  # kernels take writable arrays only: one compiled signature
        self._rule = checked.step_rule.parameters()
        self._options = options(checked.grasp, checked.tolerance, checked.max_iterations)

    def solve(self, points: Any, normals: Any, wrench: Any, adjust: Any, record: Array) -> int:
        """See `core.Pipeline.solve`."""
        record[CODE] = REFUSED
        # kernels have one signature: another wrench is converted first
        if not readable(wrench) or not self._core.begin(points, normals, wrench):
            return REFUSED
        held, now, numbers = self._held, self._now, self._options
        numbers[LENGTH], *numbers[CENTRE : CENTRE + 3] = self._core.unit_frame()
        geometry = now["rows_now"], now["inverse_now"]
        if adjust is not None and not self._core.adjust(wrench, adjust):
            return REFUSED
        flow_from(
            now["start"], now["rest_now"], *geometry, now["cone_matrix_now"], self._divisor, held.weights, wrench, self._rule,
            numbers, record,
        )  # fmt: skip
        code = int(record[CODE])
        if code != REFUSED:
            self._core.keep(record)
        return code
