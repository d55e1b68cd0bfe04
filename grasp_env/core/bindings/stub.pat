grasp_env.core._core.Solution$:
    \from typing import Any
    \import numpy as np
    class Solution:
        """One record and what was said of it; see `grasp_env.force.ForceSolution`."""

        _record: np.ndarray
        method: str
        initial: str
        objective_trace: np.ndarray
        certificate: np.ndarray | None
        limit_multipliers: Any
        def __init__(
            self,
            record: np.ndarray,
            method: str,
            initial: str,
            objective_trace: np.ndarray = ...,
            certificate: np.ndarray | None = None,
            limit_multipliers: Any = ...,
        ) -> None: ...
        @property
        def n_contacts(self) -> int: ...
        @property
        def code(self) -> int: ...
        @property
        def force(self) -> np.ndarray: ...
        @property
        def initial_force(self) -> np.ndarray: ...
        @property
        def torsion(self) -> np.ndarray: ...
