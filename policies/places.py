"""Displacements of contacts from those of training, which the weights of a network depend on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import Array

FARTHEST = 2.0
"""Displacement beyond which the weights stay the same, in those of training."""


@dataclass(frozen=True)
class Places:
    """Contacts of training.

    Attributes:
        positions: (N, 3) [m], object frame.
        tangents: (N, 2, 3) tangents o and t over the largest displacement in training [1/m].

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> Places.of(grasp, 0.003)(grasp)
        array([0., 0., 0., 0., 0., 0., 0., 0.])
    """

    positions: Array
    tangents: Array

    @classmethod
    def of(cls, grasp: Grasp, largest: float) -> Places:
        """Return the contacts of a grasp, which move by at most `largest` [m] in training."""
        return cls(grasp.positions, grasp.frames[:, :, 1:].transpose(0, 2, 1) / largest)

    def __call__(self, grasp: Grasp) -> Array:
        """Return how far the contacts of a grasp lie from these, (2N,), along both tangents."""
        away = np.einsum("nkx,nx->nk", self.tangents, grasp.positions - self.positions)
        return away.reshape(-1).clip(-FARTHEST, FARTHEST)
