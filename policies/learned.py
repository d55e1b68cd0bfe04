"""`LearnedInitialForce`: a network's start, repaired so that it is never worse in Phi than the paper's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleStartError
from grasp_env.force import Objective, OfflineBasis
from grasp_env.grasp import Grasp, null_space_basis
from grasp_env.grasp.wrench import magnitude
from policies.checkpoint import Checkpoint
from policies.kernels import predict, predict_repaired

PRETRAINED = Path(__file__).parent / "pretrained" / "four_finger"


class LearnedInitialForce:
    """An initial-force rule: rule(grasp, wrench) -> (N, 3) force [N], balanced and strictly feasible.

    The network maps wrench and friction to null-space coordinates of the grasp, so balance holds whatever it says.
    The force of least Phi on the segment from the 12-basis' combination of the grasp AS IT IS NOW to the prediction is
    returned: never worse in Phi than the paper's start, per call, by construction, in the Phi it was trained for (a
    `ForceOptimizer` with other weights repairs it again in its own). It was trained on one grasp;
    where contacts have moved a little, the null space moves along continuously.

    Attributes:
        checkpoint: weights, normalisation, training range and model card.
        objective: the Phi it was trained for.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> rule = LearnedInitialForce.pretrained()
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> learned = optimize_force(grasp, wrench, initial=rule)
        >>> paper = optimize_force(grasp, wrench)
        >>> learned.iterations < paper.iterations / 4
        True
    """

    name = "learned"

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.checkpoint = checkpoint
        self.objective = Objective(checkpoint.force_weight, checkpoint.barrier_weight)
        self._sizes = np.array(checkpoint.sizes)
        self._weights = checkpoint.flat_weights()
        self._normalisation = checkpoint.features.as_array()
        self._grasp: Grasp | None = None
        self._pseudoinverse = self._null_space = self._basis = self._frictions = np.empty(0)

    @classmethod
    def load(cls, path: str | Path) -> LearnedInitialForce:
        """The model saved at `path` (either file or their stem); raises `ModelFileError`."""
        return cls(Checkpoint.load(path))

    @classmethod
    def pretrained(cls) -> LearnedInitialForce:
        """The model that ships with the package: four fingers, contacts of `presets.paper_cuboid()`."""
        return cls.load(PRETRAINED)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The repaired start (N, 3) [N].

        Raises:
            InfeasibleStartError: a grasp with another number of contacts, or without force closure.
        """
        self._prepare(grasp)
        out = np.empty(3 * grasp.n_contacts)
        predict_repaired(
            np.asarray(wrench, dtype=np.float64),
            self._friction,
            self._frictions,
            self._normalisation,
            self._sizes,
            self._weights,
            self._pseudoinverse,
            self._null_space,
            self._basis,
            self._phi_weights,
            out,
        )
        return out.reshape(-1, 3)

    def raw(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The network's own force (N, 3) [N] before the repair: balanced, perhaps outside the cones."""
        self._prepare(grasp)
        out = np.empty(3 * grasp.n_contacts)
        predict(
            np.asarray(wrench, dtype=np.float64),
            self._friction,
            self._normalisation,
            self._sizes,
            self._weights,
            self._pseudoinverse,
            self._null_space,
            out,
        )
        return out.reshape(-1, 3)

    def covers(self, wrench: Wrench, friction: float) -> bool:
        """Whether wrench and friction lie in the training range; elsewhere the repair still guards the start."""
        low, high = self.checkpoint.friction_range
        size = float(magnitude(wrench, self.checkpoint.features.length))
        return size <= self.checkpoint.magnitude_range[1] and low <= friction <= high

    def _prepare(self, grasp: Grasp) -> None:
        if grasp is self._grasp:
            return
        if grasp.n_contacts != self.checkpoint.n_contacts:
            raise InfeasibleStartError(
                f"this model knows {self.checkpoint.n_contacts} contacts, the grasp has {grasp.n_contacts}; "
                "use initial='linear_combination'"
            )
        if set(grasp.models.names) != {"hard"} or (grasp.models.cone_scale[:, 1:] != 1.0).any():
            raise InfeasibleStartError(
                f"this model knows hard contacts with round friction cones, the grasp has {grasp.models.names}; "
                "use initial='linear_combination'"
            )
        basis = OfflineBasis.of(grasp, self.objective)
        self._basis: Array = basis.cone_forces
        self._pseudoinverse: Array = grasp.pseudoinverse.copy()  # kernels take writable arrays: one signature
        self._null_space: Array = null_space_basis(grasp, self.checkpoint.reference)
        self._frictions: Array = grasp.friction.copy()
        self._friction = float(grasp.friction.mean())
        self._phi_weights: Array = self.objective.weights(grasp.n_contacts)
        self._grasp = grasp

    def __reduce__(self) -> tuple[type[LearnedInitialForce], tuple[Checkpoint]]:
        # the prepared grasp is a cache; sub-process environments get the checkpoint
        return type(self), (self.checkpoint,)
