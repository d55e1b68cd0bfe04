"""`LearnedInitialForce`: a start that a network predicts, never worse in Phi than the paper's."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env._check import Array, ContactForces, Wrench, as_array, choice, flag
from grasp_env._files import as_path
from grasp_env.errors import InfeasibleStartError, ModelFileError
from grasp_env.force import ForceSolution, Objective, OfflineBasis
from grasp_env.force.basis import core_contacts
from grasp_env.force.method import Loop, readable
from grasp_env.force.objective import as_objective
from grasp_env.force.record import CODE, FORCE, LIMIT, REFUSED, WRENCH, record_size
from grasp_env.grasp import Grasp
from grasp_env.grasp.grasp import as_grasp
from policies.checkpoint import Checkpoint, replace

PRETRAINED = Path(__file__).parent / "pretrained"
MODELS = ("any_grasp", "four_finger")
OUTSIDE = " (outside its training range)"


_KINDS: dict[str, type[LearnedInitialForce]] = {}
"""What a checkpoint of a kind is loaded as: subclasses enter themselves."""


class LearnedInitialForce(ABC):
    """An initial-force rule: rule(grasp, wrench) -> (N, 3) force [N], balanced and strictly feasible.

    Two kinds: `FixedGraspForce` knows one grasp, a network from the wrench to null-space coordinates; `AnyGraspForce` reads the grasp,
    a few learned Newton layers from the 12-basis' combination. Either's start is never worse in Phi than the 12-basis of the grasp
    AS IT IS NOW, per call, by construction, at any wrench and whatever the weights say: the two are compared in every call, also
    where `newton` goes on and certifies the solution anyhow.

    Attributes:
        checkpoint: weights, normalisation, training range and model card.
        objective: Phi, that of training unless `with_objective` set another.
        remembers: whether it also starts from the previous solution, where that has less Phi.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> optimize_force(grasp, wrench).iterations > 10
        True
        >>> optimize_force(grasp, wrench, initial=LearnedInitialForce.pretrained("four_finger")).iterations < 10
        True
        >>> anywhere = LearnedInitialForce.pretrained()
        >>> optimize_force(presets.five_finger_cuboid(), wrench, initial=anywhere).iterations < 3
        True
    """

    def __init_subclass__(cls, kind: str) -> None:
        _KINDS[kind] = cls

    def __init__(self, checkpoint: Checkpoint, objective: Objective | None = None, remembers: bool = False) -> None:
        self.checkpoint = checkpoint
        self.objective = as_objective(objective)
        self.remembers = flag(remembers, "remembers")
        self._prepared: tuple[Grasp, core.Learned] | None = None

    @staticmethod
    def load(path: str | Path, *, remembers: bool = False) -> LearnedInitialForce:
        """The model saved at `path` (either file or their stem), of either kind.

        Args:
            path: of a model that `grasp fit` saved.
            remembers: start from the previous solution where that is better: for control loops.

        Raises:
            ModelFileError: missing, truncated, changed, of another schema, or not what its kind asks for.
        """
        checkpoint = Checkpoint.load(path)
        return _KINDS[checkpoint.kind](checkpoint, remembers=remembers)

    @staticmethod
    def pretrained(name: str = "any_grasp", *, remembers: bool = False) -> LearnedInitialForce:
        """A model that ships with the package.

        Args:
            name: "any_grasp": three to five hard contacts anywhere; "four_finger": the contacts of `presets.paper_cuboid()`,
                a network of 64 x 64.
            remembers: see `load`.

        Raises:
            UnknownNameError: another name.
        """
        return LearnedInitialForce.load(PRETRAINED / choice(name, "pretrained model", MODELS), remembers=remembers)

    def export(self, path: str | Path, grasp: Grasp) -> Path:
        """Writes what C++ programs read: the model for the contacts of one grasp, and this rule's Phi.

        Args:
            path: of the file; `grasp::ModelFile::load` reads it.
            grasp: hard contacts that this model knows. `any_grasp` models also go on from every start of a
                `grasp::Pipeline`, whose contacts move.

        Raises:
            InfeasibleStartError: contacts that this model does not know.
            ModelFileError: the file cannot be written.
        """
        file = as_path(path, ModelFileError, "a model's file")
        try:
            replace(file, self._hard_model(as_grasp(grasp)).save())
        except OSError as error:
            raise ModelFileError(f"model file {file}: {error.strerror or error}") from None
        return file

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name})"

    @property
    def name(self) -> str:
        """What solutions say of their start."""
        return f"learned_{self.checkpoint.kind}{'_previous' if self.remembers else ''}"

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N].

        Raises:
            InfeasibleStartError: contacts that this model does not know, a grasp without force closure, or a wrench that
                is not finite.
        """
        return self.start(grasp, wrench, self.objective)[1]

    def with_objective(self, objective: Objective) -> LearnedInitialForce:
        """The same model for another `objective`, exact up to scale: Phi knows forces in units of sqrt(lambda / omega) only."""
        return type(self)(self.checkpoint, objective, self.remembers)

    def bind(
        self,
        grasp: Grasp,
        objective: Objective,
        tolerance: float,
        limit: int,
        descend: Callable[[Array, Array, Array], None] | None = None,
    ) -> Loop:
        """For optimizers: start and Newton in one compiled call, or the start, and `descend` where it is no solution yet.

        Args:
            grasp: the contacts.
            objective: Phi.
            tolerance: relative gap at which a start is a solution.
            limit: most accepted steps.
            descend: see `CompiledRule.bind`.
        """
        rule = self if objective == self.objective else self.with_objective(objective)
        return LearnedLoop(rule._make(grasp, tolerance, limit), rule.name, rule.remembers, descend)

    def start(
        self, grasp: Grasp, wrench: Wrench, objective: Objective, previous: ForceSolution | None = None
    ) -> tuple[str, ContactForces]:
        """The start's name, which says when wrench or grasp are outside the training range, and its force (N, 3) [N].

        Args:
            grasp: the contacts.
            wrench: (6,) [N, N m].
            objective: Phi.
            previous: a solution to start from where that has less Phi, if this rule remembers; one of another number of
                contacts is not used.

        Raises:
            InfeasibleStartError: see `__call__`.
        """
        rule = self if objective == self.objective else self.with_objective(objective)
        learned = rule._learned(grasp)
        record = np.empty(record_size(grasp.n_contacts))
        before = None
        if self.remembers and previous is not None and previous.n_contacts == grasp.n_contacts:
            before = np.array(previous._record)
        if learned.start(read_load(wrench), before, record) == REFUSED:
            raise InfeasibleStartError(
                f"a wrench needs finite numbers up to {core.LARGEST:g}, got {np.asarray(wrench).tolist()}"
            )
        force = record[FORCE : FORCE + 3 * grasp.n_contacts].reshape(-1, 3)
        return self.name + OUTSIDE * (not learned.covers(record[WRENCH : WRENCH + 6])), force

    def covers(self, grasp: Grasp, wrench: Wrench) -> bool:
        """Whether grasp and wrench lie in the training range; elsewhere the start is still safe, and solutions say so."""
        return not self.start(grasp, wrench, self.objective)[0].endswith(OUTSIDE)

    @abstractmethod
    def raw(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The network's own force (N, 3) [N] for a `grasp` and a `wrench` (6,), balanced, perhaps outside the cones."""

    @abstractmethod
    def _model(self, grasp: Grasp) -> core.Model:
        """What the core's start reads besides the contacts."""

    def _learned(self, grasp: Grasp) -> core.Learned:
        """The start alone on a grasp, kept for the last one."""
        prepared = self._prepared  # one tuple, read once: threads may share a rule
        if prepared is None or prepared[0] is not grasp:
            prepared = self._prepared = grasp, self._make(as_grasp(grasp), 0.0, 0)
        return prepared[1]

    def _hard_model(self, grasp: Grasp) -> core.Model:
        if set(grasp.models.names) != {"hard"}:
            raise InfeasibleStartError(
                f"this model knows hard contacts, the grasp has {grasp.models.names}: use initial='linear_combination'"
            )
        return self._model(grasp)

    def _make(self, grasp: Grasp, tolerance: float, limit: int) -> core.Learned:
        model = self._hard_model(grasp)
        basis = OfflineBasis.of(grasp, self.objective).cone_forces
        return core.Learned.make(core_contacts(grasp, self.objective), tolerance, limit, basis, model)

    def __reduce__(self) -> tuple[Any, ...]:
        # the prepared grasp is a cache; sub-process environments get the checkpoint
        return type(self), (self.checkpoint, self.objective, self.remembers)


def read_load(wrench: Any) -> Array:
    """A wrench as the core reads it, which looks for itself whether it is finite.

    Raises:
        InvalidInputError: not (6,) numbers.
    """
    return wrench.copy() if readable(wrench) else as_array(wrench, (6,), "wrench")


class LearnedLoop(Loop):
    """The control loop's call; what it says of its start hangs on the last wrench."""

    def __init__(
        self,
        learned: core.Learned,
        name: str,
        remembers: bool,
        descend: Callable[[Array, Array, Array], None] | None,
    ) -> None:
        self.call, self.remembers = learned.solve if descend is None else self._descended, remembers
        self.solution = self.stopped = ForceSolution
        self.many = learned.solve_many if descend is None else None
        self._learned, self._descend, self._names = learned, descend, (name, name + OUTSIDE)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Of the last start."""
        return self._names[self._learned.outside]

    carried = name  # type: ignore[assignment]

    def _descended(self, wrench: Any, previous: Array | None, record: Array) -> int:
        code = self._learned.start(wrench, previous, record)
        if code == LIMIT and self._descend is not None:
            count = 3 * ((len(record) - FORCE) // 7)
            self._descend(record[FORCE + count : FORCE + 2 * count].copy(), wrench, record)
            code = int(record[CODE])
        return code
