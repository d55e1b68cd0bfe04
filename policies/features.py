"""What the network reads: wrench and friction, normalised so that two decades of magnitude look alike.

A grasp force is nearly proportional to its wrench, but Phi is not homogeneous: below about `floor` newtons the rest
squeeze takes over. So the wrench is divided by m = sqrt(|(force, moment / length)|^2 + floor^2), its logarithm is one
feature, and the network's output is multiplied by m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env._check import Array

N_FEATURES = 8


@dataclass(frozen=True)
class Features:
    """Normalisation, saved with the model.

    Attributes:
        length: [m] divides moments.
        floor: [N] magnitude below which features stop growing in relative terms.
        log_mean, log_scale: of log m.
        friction_mean, friction_scale: of the friction coefficient.
    """

    length: float = 0.05
    floor: float = 0.2
    log_mean: float = 0.5
    log_scale: float = 1.3
    friction_mean: float = 0.4
    friction_scale: float = 0.12

    def __call__(self, wrenches: Array, friction: Array) -> tuple[Array, Array]:
        """(B, 6) wrenches and (B,) friction -> (B, 8) features and (B,) magnitudes m [N]."""
        scaled = np.concatenate([wrenches[:, :3], wrenches[:, 3:] / self.length], axis=1)
        m = np.sqrt((scaled**2).sum(axis=1) + self.floor**2)
        log = (np.log(m) - self.log_mean) / self.log_scale
        mu = (friction - self.friction_mean) / self.friction_scale
        return np.concatenate([scaled / m[:, None], log[:, None], mu[:, None]], axis=1), m

    def as_array(self) -> Array:
        """(6,) for the core."""
        return np.array(
            [self.length, self.floor, self.log_mean, self.log_scale, self.friction_mean, self.friction_scale]
        )
