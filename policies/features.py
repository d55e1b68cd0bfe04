"""Inputs of the network: wrench and friction, normalised over two decades of magnitude.

Wrenches are in the grasp's unit frame (`Grasp.unit_frame`), in which force and moment have similar
sizes. The optimal force is nearly proportional to the wrench, except below about `floor` newtons,
where the optimal squeeze at zero wrench dominates. So the wrench is divided by m = sqrt(|w|^2 +
floor^2), log m is a feature, and the network's output is multiplied by m.

Friction cones bound tangential magnitudes, which a perceptron approximates badly from components.
So the magnitudes of M vectors that are linear in the wrench are features, too; see `surface_pairs`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env.force import Objective, optimize_force
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import Array


@dataclass(frozen=True)
class Features:
    """Normalisation of the inputs, saved with the model.

    Attributes:
        floor: magnitude of wrenches below which m is nearly constant [N].
        smoothing: constant that makes the magnitudes smooth at zero, relative to m.
        log_mean, log_scale: mean and scale of log m.
        friction_mean, friction_scale: mean and scale of the friction coefficient.
    """

    floor: float = 0.2
    smoothing: float = 0.05
    log_mean: float = 0.5
    log_scale: float = 1.3
    friction_mean: float = 0.4
    friction_scale: float = 0.12

    def __call__(self, wrenches: Array, friction: Array, pairs: Array) -> tuple[Array, Array]:
        """Return (B, 8 + M) features, the friction last, and (B,) magnitudes m [N].

        Args:
            wrenches: (B, 6) in the unit frame [N].
            friction: (B,) mean coefficient of the contacts.
            pairs: (2 M, 6) maps from a wrench to M tangential vectors, all first components first.
        """
        m = np.sqrt((wrenches**2).sum(axis=1) + self.floor**2)
        direction = wrenches / m[:, None]
        log = (np.log(m) - self.log_mean) / self.log_scale
        along = (direction @ pairs.T).reshape(len(wrenches), 2, -1)
        lengths = np.sqrt((along**2).sum(axis=1) + self.smoothing**2)
        mu = (friction - self.friction_mean) / self.friction_scale
        return np.concatenate([direction, log[:, None], lengths, mu[:, None]], axis=1), m


def surface_pairs(grasp: Grasp, objective: Objective) -> Array:
    """Return (4 N, 6) maps from a wrench (unit frame) to tangential components of two forces.

    The rows along o come first, then those along t. Both forces balance the wrench and are linear
    in it: the least-norm force, and the first-order change of the optimum at zero wrench, in cone
    coordinates.

    Args:
        grasp: contacts, with the friction of that optimum.
        objective: Phi.
    """
    omega = objective.force_weight
    lambda_ = objective.barrier_weight
    optimum = optimize_force(grasp, np.zeros(6), force_weight=omega, barrier_weight=lambda_)
    inverse = np.zeros((3 * grasp.n_contacts, 3 * grasp.n_contacts))
    for i, block in enumerate(
        objective.hessian(grasp.to_cone(optimum.force), grasp.models.tangential)
    ):
        rows = slice(3 * i, 3 * i + 3)
        inverse[rows, rows] = np.linalg.inv(block)
    matrix = grasp.unit_frame @ grasp.cone_matrix
    least = (
        grasp.models.cone_scale.reshape(-1, 1)
        * grasp.pseudoinverse
        @ np.linalg.inv(grasp.unit_frame)
    )
    change = inverse @ matrix.T @ np.linalg.inv(matrix @ inverse @ matrix.T)
    both = np.concatenate([least, change]).reshape(-1, 3, 6)
    return np.concatenate([both[:, 1], both[:, 2]])
