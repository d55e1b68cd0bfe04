"""A model that reads the grasp: learned Newton layers on every contact, for any contacts."""

from __future__ import annotations

import numpy as np

from grasp_env import core
from grasp_env._check import ContactForces, Wrench
from grasp_env.force import Objective
from grasp_env.grasp import Grasp
from policies.checkpoint import FAULTS, Checkpoint, malformed, whole
from policies.learned import LearnedInitialForce


class AnyGraspForce(LearnedInitialForce, kind="any_grasp"):
    """Starts from the 12-basis' combination, or the previous solution, and takes learned Newton layers.

    Invariant to frame, units, order of contacts, omega and lambda by construction (`core/include/grasp/layers.hpp`).

    Args:
        checkpoint: weights, normalisation, training range and model card.
        objective: Phi; None: the defaults.
        remembers: whether it also starts from the previous solution.

    Attributes:
        layers: (K, numbers) float32.
        width: of their hidden layers.
    """

    def __init__(self, checkpoint: Checkpoint, objective: Objective | None = None, remembers: bool = False) -> None:
        try:
            count, self.width = layer_numbers(checkpoint.numbers, "layers", "width", 1)
            self._ranges = {name: checkpoint.ranges[name] for name in ("magnitude", "friction", "contacts")}
        except FAULTS as error:
            raise malformed("of kind any_grasp", error) from None
        checkpoint.expect(layer_shapes("layers", count, self.width))
        super().__init__(checkpoint, objective, remembers)
        self.layers = flat(checkpoint.tensors, count)
        self._layers = core.Layers.make(self.width, self.layers.astype(np.float64))

    def raw(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start for a `grasp` and a `wrench` itself: every layer stays balanced and inside the cones."""
        return self(grasp, wrench)

    def _model(self, grasp: Grasp) -> core.Model:
        low, high = self._ranges["friction"]
        least, most = self._ranges["contacts"]
        known = least <= grasp.n_contacts <= most and (low <= grasp.friction).all() and (grasp.friction <= high).all()
        weights = self.objective.weights(grasp.n_contacts)
        unit = float(np.sqrt((weights[:, 1] / weights[:, 0]).mean()))
        model = core.Model.make(None, self._layers)
        model.trained_on(grasp.length, grasp.centre.copy(), self._ranges["magnitude"][1] * unit if known else -1.0)
        return model


def layer_numbers(numbers: dict[str, object], count: str, width: str, least: int) -> tuple[int, int]:
    """How many layers a description says, `least` of them, and how wide; raises `ValueError` beyond what the core takes."""
    return whole(numbers[count], count, least, core.MOST_LAYERS), whole(numbers[width], width, 1, core.WIDEST)


def layer_shapes(prefix: str, count: int, width: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the tensors of learned Newton layers, by name."""
    sizes = {"first": (width, core.LAYER_FEATURES), "second": (width, 2 * width), "third": (3, width)}
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in range(count):
        for name, (outputs, inputs) in sizes.items():
            stem = f"{prefix}.{layer}.{name}"
            shapes |= {f"{stem}.weight": (outputs, inputs), f"{stem}.bias": (outputs,)}
    return shapes


def flat(weights: dict[str, np.ndarray], count: int, prefix: str = "layers") -> np.ndarray:
    """(count, numbers) float32 as the core reads them: matrices as (inputs x outputs), then their bias."""
    rows = []
    for layer in range(count):
        parts = []
        for name in ("first", "second", "third"):
            stem = f"{prefix}.{layer}.{name}"
            parts += [weights[f"{stem}.weight"].T.ravel(), weights[f"{stem}.bias"]]
        rows.append(np.concatenate(parts))
    return np.array(rows, dtype=np.float32)
