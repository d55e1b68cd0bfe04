"""A network for one grasp: wrench and friction to null-space coordinates."""

from __future__ import annotations

from dataclasses import asdict
from itertools import pairwise

import numpy as np

from grasp_env import core
from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleStartError
from grasp_env.force import Objective
from grasp_env.grasp import Grasp, null_space_basis
from policies.any_grasp import flat, layer_numbers, layer_shapes
from policies.checkpoint import FAULTS, MOST_CONTACTS, Checkpoint, malformed, number, whole
from policies.features import Features
from policies.learned import LearnedInitialForce, read_load

MOST_DEGREE = 8
"""Of the polynomials of the friction that weights may be."""


class FixedGraspForce(LearnedInitialForce, kind="fixed_grasp"):
    """Trained on one grasp; where contacts have moved a little, the null space moves along continuously.

    The start is the network's force, or the best on the segment from the 12-basis' combination where that has less Phi; balance holds
    whatever the network says. `newton` goes on from it in the same compiled call. A model that was saved with learned layers
    (`polish` above 0) takes those first, as many as its certificate asks. A grasp keeps its friction from call to call, so weights may be
    polynomials of the friction (`friction_degree` above 0), made numbers when the grasp is known: one perceptron per friction.

    Args:
        checkpoint: weights, normalisation, training range and model card.
        objective: Phi; None: that of training.
        remembers: whether it also starts from the previous solution.

    Attributes:
        polish: learned layers at most; 0: the network alone.
    """

    def __init__(self, checkpoint: Checkpoint, objective: Objective | None = None, remembers: bool = False) -> None:
        try:
            numbers = checkpoint.numbers
            sizes = list(numbers["sizes"])
            stages = whole(len(sizes), "the number of sizes", 2, core.MOST_STAGES + 1)
            self.sizes = tuple(whole(sizes[k], f"sizes[{k}]", 1, core.WIDEST) for k in range(stages))
            self.features = _features(numbers["features"])
            self.n_contacts = whole(numbers["n_contacts"], "n_contacts", 3, MOST_CONTACTS)
            weights = (number(numbers[name], name, 0.0) for name in ("force_weight", "barrier_weight"))
            self._trained = Objective(*weights)
            self.polish, width = whole(numbers["polish"], "polish", 0, core.MOST_LAYERS), 1
            if self.polish:
                self.polish, width = layer_numbers(numbers, "polish", "polish_width", 1)
            self._degree = whole(numbers.get("friction_degree", 0), "friction_degree", 0, MOST_DEGREE)
            self._ranges = checkpoint.ranges["magnitude"], checkpoint.ranges["friction"]
            outputs = 3 * self.n_contacts - 6
            if (self.sizes[0], self.sizes[-1]) != (core.NETWORK_FEATURES, outputs):
                raise ValueError(f"sizes {self.sizes} for {self.n_contacts} contacts")
        except FAULTS as error:
            raise malformed("of kind fixed_grasp", error) from None
        shapes: dict[str, tuple[int, ...]] = {"reference": (3 * self.n_contacts, outputs)}
        powers = (self._degree + 1,) if "friction_degree" in numbers else ()
        for layer, (a, b) in enumerate(pairwise(self.sizes)):
            shapes |= {f"layers.{layer}.weight": (*powers, b, a), f"layers.{layer}.bias": (*powers, b)}
        checkpoint.expect(shapes | layer_shapes("polish", self.polish, width))
        super().__init__(checkpoint, self._trained if objective is None else objective, remembers)
        self._reference = checkpoint.tensors["reference"].astype(np.float64)
        self._made: tuple[float, core.Network] | None = None
        self._layers = None
        if self.polish:
            self._layers = core.Layers.make(width, flat(checkpoint.tensors, self.polish, "polish").astype(np.float64))

    def raw(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The network's force for a `grasp` and a `wrench`, neither repaired nor polished; see `LearnedInitialForce.raw`."""
        learned = self._learned(grasp)
        force = np.empty((grasp.n_contacts, 3))
        if not learned.predict(read_load(wrench), force):
            raise InfeasibleStartError(
                f"a wrench needs finite numbers up to {core.LARGEST:g}, got {np.asarray(wrench).tolist()}"
            )
        return force

    def _scale(self, count: int) -> float:
        """sqrt(lambda / omega), mean over the contacts, over that of training."""
        weights, trained = self.objective.weights(count), self._trained.weights(count)
        return float(np.sqrt((weights[:, 1] / weights[:, 0]).mean() * trained[0, 0] / trained[0, 1]))

    def _model(self, grasp: Grasp) -> core.Model:
        if grasp.n_contacts != self.n_contacts:
            raise InfeasibleStartError(
                f"this model knows {self.n_contacts} contacts, the grasp has {grasp.n_contacts}; use "
                "LearnedInitialForce.pretrained(\"any_grasp\") or initial='linear_combination'"
            )
        (_, most), (low, high) = self._ranges
        friction, scale = float(grasp.friction.mean()), self._scale(grasp.n_contacts)
        known = low <= friction <= high  # of a grasp only the friction is looked at
        nearest = min(max(friction, low), high) if self._degree else friction  # beyond, polynomials know nothing
        model = core.Model.make(self._network(nearest), self._layers)
        model.normalise(**asdict(self.features))
        model.place(np.ascontiguousarray(null_space_basis(grasp, self._reference)), nearest, scale)
        model.trained_on(self.features.length, np.zeros(3), most * scale if known else -1.0)
        return model

    def _network(self, friction: float) -> core.Network:
        """That of a friction, kept for the last one: contacts move more often than they change it."""
        made = self._made  # one tuple, read once: threads may share a rule
        if made is None or (made[0] != friction and self._degree):
            made = self._made = friction, core.Network.make(self.sizes, self._weights(friction))
        return made[1]

    def _weights(self, friction: float) -> Array:
        """Of that friction, as the core reads them: stage by stage (inputs x outputs), then the bias."""
        feature = (friction - self.features.friction_mean) / self.features.friction_scale
        feature = min(max(feature, -1e3), 1e3)  # far beyond training, where powers are no numbers any more
        powers, parts = feature ** np.arange(self._degree + 1), list[Array]()
        for layer, (a, b) in enumerate(pairwise(self.sizes)):
            for name, shape in (("weight", (-1, b, a)), ("bias", (-1, b))):
                coefficients = self.checkpoint.tensors[f"layers.{layer}.{name}"].astype(np.float64)
                parts.append(np.tensordot(powers, coefficients.reshape(shape), 1).T.ravel())
        most = float(np.finfo(np.float32).max)
        return np.concatenate(parts).clip(-most, most)


def _features(numbers: dict[str, object]) -> Features:
    """The saved normalisation; what divides is above 0."""
    mean = ("log_mean", "friction_mean")
    return Features(**{name: number(v, name, -np.inf if name in mean else 0.0) for name, v in numbers.items()})
