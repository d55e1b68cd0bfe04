"""`LearnedInitialForce`: a start predicted by a network, never worse than the method's own start."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env.errors import InfeasibleStartError, ModelFileError
from grasp_env.force import Objective
from grasp_env.force.basis import start_of, starter
from grasp_env.force.objective import as_objective
from grasp_env.force.solution import LEARNED
from grasp_env.grasp import Grasp
from grasp_env.grasp.grasp import as_grasp
from grasp_env.grasp.null_space import null_space_basis
from grasp_env.inputs.arguments import (
    Array,
    ContactForces,
    Wrench,
    as_array,
    flag,
    number,
    positive,
    whole,
)
from grasp_env.inputs.files import as_path, file_fault
from grasp_env.inputs.ranges import Range
from policies.checkpoint import Checkpoint, replace
from policies.features import Features
from policies.places import Places

PRETRAINED = Path(__file__).parent / "pretrained"
MOST_CONTACTS, MOST_DEGREE = 64, 8
"""Largest number of contacts of a model, and largest degree of its polynomials of the friction."""
_ANY = Range(-1e15, 1e15)
_POSITIVE = Range(1e-300, 1e15)


class LearnedInitialForce:
    """Initial-force rule: rule(grasp, wrench) -> (N, 3) force [N], balanced and strictly feasible.

    A network trained on one grasp predicts internal forces from the wrench and the friction. They
    change continuously with the contacts, so it also works after small movements.

    Let a be the network's force. Let b be the method's own start: Newton's internal force, or the
    combination of the 12-basis for the flows and for a direct call of the rule. The start is a if
    its Phi is not above that of b, else the point of least Phi on the segment from b to a. So it
    never has more Phi than b, at any wrench and for any weights. Optimizers continue from it in the
    same compiled call and certify the solution.

    The weights may be polynomials of the friction (`friction_degree` above 0), and of an
    environment's model they also depend linearly on the displacements of the contacts. They are
    evaluated once per grasp.

    Args:
        checkpoint: weights, normalisation, training range and model card.
        objective: Phi; None: that of training.
        remembers: True to start from the previous solution if that has less Phi.

    Attributes:
        checkpoint, objective, remembers: the arguments.
        sizes: widths of the network's layers, inputs and outputs included.
        features: normalisation of the network's inputs.
        n_contacts: number of contacts of the grasp on which it was trained.

    Raises:
        ModelFileError: the checkpoint does not describe such a model.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.01, 0.02, 0]
        >>> optimize_force(grasp, wrench, method="reduced_flow").iterations > 10
        True
        >>> optimize_force(grasp, wrench, method="reduced_flow", initial=LearnedInitialForce.pretrained()).iterations < 10
        True
    """

    def __init__(
        self, checkpoint: Checkpoint, objective: Objective | None = None, remembers: bool = False
    ) -> None:
        try:
            numbers = checkpoint.numbers
            sizes = list(numbers["sizes"])
            whole(len(sizes), "the number of sizes", 2, core.MOST_STAGES + 1)
            self.sizes = tuple(
                whole(size, f"sizes[{k}]", 1, core.WIDEST) for k, size in enumerate(sizes)
            )
            self.features = _features(numbers["features"])
            self.n_contacts = whole(numbers["n_contacts"], "n_contacts", 3, MOST_CONTACTS)
            names = ("force_weight", "barrier_weight")
            self._trained = Objective(*(positive(numbers[name], name, _POSITIVE) for name in names))
            self._degree = whole(numbers["friction_degree"], "friction_degree", 0, MOST_DEGREE)
            self._ranges = [_pair(checkpoint.ranges[name]) for name in ("magnitude", "friction")]
            outputs = 3 * self.n_contacts - 6
            # the other inputs are lengths of tangential vectors, see `surface_pairs`
            n_lengths = self.sizes[0] - core.PLAIN_FEATURES
            if n_lengths < 1 or self.sizes[-1] != outputs:
                raise ValueError(f"sizes {self.sizes} for {self.n_contacts} contacts")
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            fault = f"{type(error).__name__}: {error}"[:200]
            raise ModelFileError(
                f"the model is incomplete or malformed ({fault}); train anew with `grasp fit`"
            ) from None
        terms = self._degree + 1
        shapes: dict[str, tuple[int, ...]] = {
            "reference": (3 * self.n_contacts, outputs),
            "pairs": (2 * n_lengths, 6),
        }
        if "positions" in checkpoint.tensors:  # the weights depend on them
            shapes |= {"positions": (self.n_contacts, 3), "tangents": (self.n_contacts, 2, 3)}
            terms += 2 * self.n_contacts
        for layer, (a, b) in enumerate(pairwise(self.sizes)):
            shapes[f"layers.{layer}.weight"] = (terms, b, a)
            shapes[f"layers.{layer}.bias"] = (terms, b)
        checkpoint.expect(shapes)
        self.checkpoint = checkpoint
        self.objective = self._trained if objective is None else as_objective(objective)
        self.remembers = flag(remembers, "remembers")
        self._reference = checkpoint.tensors["reference"].astype(np.float64)
        self._places = (
            Places(
                *(checkpoint.tensors[name].astype(np.float64) for name in ("positions", "tangents"))
            )
            if "positions" in shapes
            else None
        )
        pairs = checkpoint.tensors["pairs"].astype(np.float64).T
        self._pairs = core.Network.make(pairs.shape, np.append(pairs, np.zeros(2 * n_lengths)))
        self._cached_network: tuple[bytes, core.Network] | None = None
        self._prepared: _Prepared | None = None

    @staticmethod
    def load(path: str | Path, *, remembers: bool = False) -> LearnedInitialForce:
        """Load a model saved by `grasp fit`.

        Args:
            path: either of its files, or their stem.
            remembers: True to start from the previous solution if that has less Phi.

        Raises:
            ModelFileError: the files are missing, damaged, of another schema, or not a model.
        """
        return LearnedInitialForce(Checkpoint.load(path), remembers=remembers)

    @staticmethod
    def pretrained(*, remembers: bool = False) -> LearnedInitialForce:
        """Load the shipped model, a network of 64 x 64 for the contacts of `presets.paper_cuboid()`.

        Args:
            remembers: see `load`.
        """
        return LearnedInitialForce.load(PRETRAINED / "four_finger", remembers=remembers)

    def export(self, path: str | Path, grasp: Grasp) -> Path:
        """Write the model for one grasp's contacts and this rule's Phi, for C++ programs.

        Args:
            path: file for `grasp::ModelFile::load`.
            grasp: hard contacts, as many as in training.

        Raises:
            InfeasibleStartError: the model does not support these contacts.
            ModelFileError: the file cannot be written.
        """
        file = as_path(path, ModelFileError, "a model's file")
        try:
            replace(file, self._model(as_grasp(grasp))[0].save())
        except OSError as error:
            raise ModelFileError(f"cannot write model file {file}: {file_fault(error)}") from None
        return file

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name})"

    @property
    def name(self) -> str:
        """Name of the start in solutions."""
        return f"learned_fixed_grasp{'_previous' if self.remembers else ''}"

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """Return the start (N, 3) [N].

        Raises:
            InfeasibleStartError: the model does not support these contacts, the grasp has no force
                closure, or the wrench is not finite.
        """
        load = _read(wrench)
        force = start_of(self._prepare(grasp).starter, LEARNED, load, None)
        if force is None:
            raise _not_finite(load)
        return force

    def with_objective(self, objective: Objective) -> LearnedInitialForce:
        """Return the same model for another `objective`.

        It is rescaled, since Phi depends on forces in units of sqrt(lambda / omega).
        """
        return type(self)(self.checkpoint, objective, self.remembers)

    def model(self, grasp: Grasp, objective: Objective) -> core.Model:
        """Return the compiled model for a `grasp` and an `objective`.

        Raises:
            InfeasibleStartError: the model does not support these contacts.
        """
        rule = self if objective == self.objective else self.with_objective(objective)
        return rule._model(as_grasp(grasp))[0]

    def covers(self, grasp: Grasp, wrench: Wrench) -> bool:
        """Return True if grasp and wrench are within the training range.

        Outside the range the start is still valid, and the solution says that it was out of range.
        """
        return self._prepare(grasp).model.covers(grasp.unit_frame @ _read(wrench))

    def raw(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """Return the network's force (N, 3) [N] for `grasp` and `wrench`, possibly outside the cones.

        Raises:
            InfeasibleStartError: see `__call__`.
        """
        prepared = self._prepare(grasp)
        load = _read(wrench)
        if not (np.abs(load) <= core.LARGEST).all():
            raise _not_finite(load)
        coordinates = np.empty(prepared.internal.shape[1])
        prepared.model.predict(grasp.unit_frame @ load, coordinates)
        return (prepared.internal @ coordinates - grasp.pseudoinverse @ load).reshape(-1, 3)

    def _prepare(self, grasp: Grasp) -> _Prepared:
        """Return the model on a grasp, cached for the last grasp."""
        prepared = self._prepared  # read once: threads may share a rule
        if prepared is None or prepared.grasp is not grasp:
            model, internal = self._model(as_grasp(grasp))
            prepared = self._prepared = _Prepared(
                grasp, model, starter(grasp, self.objective, model), internal
            )
        return prepared

    def _model(self, grasp: Grasp) -> tuple[core.Model, Array]:
        """Return the compiled model and its basis of internal forces (3N, 3N - 6)."""
        if set(grasp.models.names) != {"hard"}:
            raise InfeasibleStartError(
                f"this model knows hard contacts, the grasp has {grasp.models.names}: use initial='linear_combination'"
            )
        if grasp.n_contacts != self.n_contacts:
            raise InfeasibleStartError(
                f"this model knows {self.n_contacts} contacts, the grasp has {grasp.n_contacts}; "
                "use initial='linear_combination', or fit a model of your grasp"
            )
        (_, magnitude), (low, high) = self._ranges
        friction = float(grasp.friction.mean())
        scale = self._scale(grasp.n_contacts)
        # a negative magnitude: no wrench is in the training range
        magnitude = magnitude * scale if low <= friction <= high else -1.0
        if self._degree:  # polynomials do not extrapolate
            friction = min(max(friction, low), high)
        model = core.Model.make(self._network(self._terms(friction, grasp)), self._pairs)
        model.normalise(**asdict(self.features))
        internal = np.ascontiguousarray(null_space_basis(grasp, self._reference))
        model.place(internal, friction, scale, magnitude)
        return model, internal

    def _scale(self, count: int) -> float:
        """Return sqrt(lambda / omega), averaged over the contacts, relative to that of training."""
        omega, lambda_ = self.objective.weights(count).T
        trained = self._trained.weights(count)[0]
        return float(np.sqrt((lambda_ / omega).mean() * trained[0] / trained[1]))

    def _terms(self, friction: float, grasp: Grasp) -> Array:
        """Return the factors of the weights: powers of the friction, then displacements."""
        feature = (friction - self.features.friction_mean) / self.features.friction_scale
        # far outside the training range its powers would overflow
        powers = min(max(feature, -1e3), 1e3) ** np.arange(self._degree + 1.0)
        moves = np.empty(0) if self._places is None else self._places(grasp)
        return np.concatenate([powers, moves])

    def _network(self, terms: Array) -> core.Network:
        """Return the network of a grasp, cached for the last one."""
        key = terms.tobytes()
        cached = self._cached_network  # one tuple, read once: threads may share a rule
        if cached is None or cached[0] != key:
            network = core.Network.make(self.sizes, self._weights(terms))
            cached = self._cached_network = key, network
        return cached[1]

    def _weights(self, terms: Array) -> Array:
        """Return the weights: per layer the matrix (inputs, outputs), then the bias."""
        blocks = list[Array]()
        for layer in range(len(self.sizes) - 1):
            for name in ("weight", "bias"):
                coefficients = self.checkpoint.tensors[f"layers.{layer}.{name}"].astype(np.float64)
                blocks.append(np.tensordot(terms, coefficients, 1).T.ravel())
        largest = float(np.finfo(np.float32).max)
        return np.concatenate(blocks).clip(-largest, largest)

    def __reduce__(self) -> tuple[Any, ...]:
        # without the cached grasp: environments in other processes get the checkpoint
        return type(self), (self.checkpoint, self.objective, self.remembers)


@dataclass(frozen=True)
class _Prepared:
    """Model on one grasp; predictions are coordinates in the columns of `internal` (3N, 3N - 6)."""

    grasp: Grasp
    model: core.Model
    starter: core.ForceOptimizer
    internal: Array


def _features(numbers: dict[str, object]) -> Features:
    """Return the saved normalisation; divisors are above 0."""
    mean = ("log_mean", "friction_mean")
    return Features(
        **{
            name: number(v, name, _ANY) if name in mean else positive(v, name, _POSITIVE)
            for name, v in numbers.items()
        }
    )


def _pair(value: Any) -> tuple[float, float]:
    low, high = (number(v, "a range's end", _ANY) for v in value)
    if not low <= high:
        raise ValueError(
            f"range [{low:g}, {high:g}] is empty: the first number must not exceed the second"
        )
    return low, high


def _not_finite(wrench: Array) -> InfeasibleStartError:
    return InfeasibleStartError(
        f"the wrench must be finite and at most {core.LARGEST:g}, got {wrench.tolist()}"
    )


def _read(wrench: Any) -> Array:
    """Return a wrench (6,) for the core, which checks that it is finite."""
    return as_array(wrench, (6,), "wrench", finite=False)
