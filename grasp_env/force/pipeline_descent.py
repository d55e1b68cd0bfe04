"""A pipeline's descent where it is not the core's yet: learned layers and the flow, between its start and its end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env._check import Array
from grasp_env.force.lanes import CENTRE, LENGTH, options
from grasp_env.force.method import readable
from grasp_env.force.pipeline_kernels import flow_from, refine_start
from grasp_env.force.record import CODE, REFUSED

if TYPE_CHECKING:
    from grasp_env.force.optimizer import ForceOptimizer
    from grasp_env.force.pipeline import Held


class KernelDescent:
    """`core.Pipeline.solve` with numba's layers and flow in it: the same arguments, the same answer."""

    def __init__(
        self,
        pipeline: core.Pipeline,
        checked: ForceOptimizer,
        held: Held,
        layers: tuple[NDArray[np.float32], int] | None,
        remembers: bool,
    ) -> None:
        """Layers: (K, numbers) and their width, or None. checked: the settings."""
        self._core, self._layers, self._remembers = pipeline, layers, remembers
        self._flows, self._held = checked.method == "reduced_flow", held
        self._now = pipeline.arrays()
        self._divisor = np.array(held.divisor)  # kernels take writable arrays only: one compiled signature
        self._rule = checked.step_rule.parameters()
        self._options = options(checked.grasp, checked.tolerance, checked.max_iterations)
        self._tolerance = checked.tolerance

    def solve(self, points: Any, normals: Any, wrench: Any, adjust: Any, record: Array) -> int:
        """See `core.Pipeline.solve`."""
        record[CODE] = REFUSED
        # kernels have one signature: another wrench is converted first
        if not readable(wrench) or not self._core.begin(points, normals, wrench):
            return REFUSED
        held, now, numbers = self._held, self._now, self._options
        numbers[LENGTH], *numbers[CENTRE : CENTRE + 3] = self._core.unit_frame()
        geometry = now["rows_now"], now["inverse_now"]
        if self._layers is not None:
            refine_start(
                now["start"], now["safe"], self._remembers, now["rest_now"], *geometry, held.weights, wrench, self._tolerance,
                *self._layers, numbers,
            )  # fmt: skip
            self._core.resume()
        if adjust is not None and not self._core.adjust(wrench, adjust):
            return REFUSED
        if self._flows:
            flow_from(
                now["start"], now["rest_now"], *geometry, now["cone_matrix_now"], self._divisor, held.weights, wrench, self._rule,
                numbers, record,
            )  # fmt: skip
            code = int(record[CODE])
        else:
            code = self._core.descend(wrench, record)
        if code != REFUSED:
            self._core.keep(record)
        return code
