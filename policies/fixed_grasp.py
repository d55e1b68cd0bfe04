"""A network for one grasp: wrench and friction to null-space coordinates, polished by learned Newton layers."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleStartError
from grasp_env.force import Objective
from grasp_env.grasp import Grasp, null_space_basis
from policies import kernels
from policies.any_grasp import flat, layer_shapes
from policies.checkpoint import Checkpoint, malformed
from policies.features import N_FEATURES, Features
from policies.learned import LearnedInitialForce

POLISH = 2
"""Newton steps after a network that was saved without layers of its own."""


class FixedGraspForce(LearnedInitialForce):
    """Trained on one grasp; where contacts have moved a little, the null space moves along continuously.

    The network's force, or the best on the segment from the 12-basis' combination where that has less Phi, goes through one
    learned Newton layer, and through further ones where the certificate asks. Balance holds whatever the network says, and no
    part raises Phi.

    Attributes:
        polish: layers at most; 0: the network alone.
    """

    _kernel = kernels.start_fixed

    def __init__(self, checkpoint: Checkpoint, objective: Objective | None = None, remembers: bool = False) -> None:
        try:
            numbers = checkpoint.numbers
            self.sizes = tuple(int(size) for size in numbers["sizes"])
            self.features = Features(**{name: float(value) for name, value in numbers["features"].items()})
            self.n_contacts = int(numbers["n_contacts"])
            trained = Objective(float(numbers["force_weight"]), float(numbers["barrier_weight"]))
            learned, width = int(numbers["polish"]), int(numbers["polish_width"])
            if learned < 0:
                raise ValueError(f"polish {learned}")
            self._ranges = checkpoint.ranges["magnitude"], checkpoint.ranges["friction"]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise malformed("of kind fixed_grasp", error) from None
        outputs = 3 * self.n_contacts - 6
        shapes: dict[str, tuple[int, ...]] = {"reference": (3 * self.n_contacts, outputs)}
        for layer, (a, b) in enumerate(zip(self.sizes[:-1], self.sizes[1:], strict=True)):
            shapes |= {f"layers.{layer}.weight": (b, a), f"layers.{layer}.bias": (b,)}
        checkpoint.expect(shapes | layer_shapes("polish", learned, width))
        if (self.sizes[0], self.sizes[-1]) != (N_FEATURES, outputs):
            raise malformed("of kind fixed_grasp", ValueError(f"sizes {self.sizes} for {self.n_contacts} contacts"))
        super().__init__(checkpoint, objective or trained, remembers)
        self._trained, self.polish, self._width = trained, learned or POLISH, width
        self._layers = flat(checkpoint.tensors, learned, "polish") if learned else np.empty((0, 0), np.float32)
        parts = []
        for layer in range(len(self.sizes) - 1):
            parts += [
                checkpoint.tensors[f"layers.{layer}.weight"].T.ravel(),
                checkpoint.tensors[f"layers.{layer}.bias"],
            ]
        self._flat = np.concatenate(parts).astype(np.float32)
        self._sizes = np.array(self.sizes)

    def raw(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """See `LearnedInitialForce.raw`: neither repaired nor polished."""
        out = np.empty(3 * grasp.n_contacts)
        kernels.raw_fixed(np.asarray(wrench, dtype=np.float64), self._numbers(grasp, 0.0), self._sizes, self._flat, out)
        return out.reshape(-1, 3)

    def _limit(self, grasp: Grasp) -> tuple[float, ...]:
        (_, most), (low, high) = self._ranges
        known = low <= float(grasp.friction.mean()) <= high  # of a grasp only the friction is looked at
        return self.features.length, 0.0, 0.0, 0.0, most * self._scale(grasp.n_contacts) if known else -1.0

    def _scale(self, count: int) -> float:
        """sqrt(lambda / omega), mean over the contacts, over that of training."""
        weights, trained = self.objective.weights(count), self._trained.weights(count)
        return float(np.sqrt((weights[:, 1] / weights[:, 0]).mean() * trained[0, 0] / trained[0, 1]))

    def _numbers(self, grasp: Grasp, tolerance: float) -> Array:
        if grasp.n_contacts != self.n_contacts:
            raise InfeasibleStartError(
                f"this model knows {self.n_contacts} contacts, the grasp has {grasp.n_contacts}; use "
                "LearnedInitialForce.pretrained(\"any_grasp\") or initial='linear_combination'"
            )
        parts = (
            super()._numbers(grasp, tolerance),
            grasp.pseudoinverse,
            null_space_basis(grasp, self.checkpoint.tensors["reference"].astype(np.float64)),
            self.features.as_array(),
            np.array([grasp.friction.mean(), self._scale(grasp.n_contacts)]),
        )
        return np.concatenate([part.ravel() for part in parts])

    def _network(self, grasp: Grasp) -> tuple[Any, ...]:
        return self._sizes, self._flat, self._layers, self._width, self.polish
