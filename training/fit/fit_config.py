"""Settings of `grasp fit`, which are also its options; this module imports no torch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.force import Objective
from grasp_env.grasp import Grasp, load_grasp, presets
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import number, positive
from training.data.grasps import closes
from training.data.one_grasp import Source, with_mean_friction
from training.evaluation.results.run import check_counts

if TYPE_CHECKING:
    from training.data.played import Played

LEAST, MOST = 5 / 8, 3 / 2
"""Default range of the friction, as factors of the grasp's own."""
STEPS = (300_000, 10_000)
"""Default number of optimisation steps, without and with an environment."""
MAGNITUDES = 0.1, 20.0
"""Default range of the wrenches' norm [N]."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of a training.

    Attributes:
        preset: name of the grasp.
        grasp: JSON file of a grasp instead, with at least three hard contacts.
        env: an environment instead, by name or JSON of settings, see `RLConfig.env`: its contacts,
            Phi, and the wrenches and frictions of episodes in it.
        steps: optimisation steps; 0: 300,000, or 10,000 for an environment. A training of a given
            number of steps repeats bit by bit.
        seconds: processor time of all threads for the optimisation steps, instead of their number;
            0: `steps` decides.
        samples: labelled wrenches; for many contacts fewer are made, as the model card records.
        hidden: widths of the hidden layers.
        degree: degree of the weights as polynomials of the friction; 0: friction is an input of the
            network instead.
        batch_size: wrenches per optimisation step.
        learning_rate: peak of the one-cycle schedule.
        tail: exponent of the gap in the loss; a larger one gives more weight to the worst wrenches.
        seed: seed of data, weights and batches.
        low: least |(force, moment about the contacts' centre / their length)| of the training
            wrenches [N]; 0: 0.1, or half of the environment's least.
        high: largest such norm [N]; 0: 20, or twice the environment's largest.
        friction_low: least mean friction coefficient; 0: 5/8 of the grasp's own or the
            environment's least, but at least that with which the grasp closes.
        friction_high: largest mean friction coefficient; 0: 3/2 of the grasp's own, or the
            environment's largest.
        force_weight: omega of Phi; 0: 1, or the environment's.
        barrier_weight: lambda of Phi [N^2]; 0: 0.01, or the environment's.
        threads: 1 or 2 threads that share each batch; the result has the same bits.
        quick: a small training of about a minute; the model card marks it.
    """

    preset: str = "paper_cuboid"
    grasp: str | None = None
    env: str | None = None
    steps: int = 0
    seconds: float = 0.0
    samples: int = 800_000
    hidden: tuple[int, ...] = (64, 64)
    degree: int = 2
    batch_size: int = 2048
    learning_rate: float = 2e-2
    tail: float = 0.35
    seed: int = 0
    low: float = 0.0
    high: float = 0.0
    friction_low: float = 0.0
    friction_high: float = 0.0
    force_weight: float = 0.0
    barrier_weight: float = 0.0
    threads: int = 2
    quick: bool = False

    def __post_init__(self) -> None:
        check_counts(self, {"batch_size": 1, "seed": 0, "steps": 0, "threads": 1, "degree": 0})
        check_counts(self, {"samples": 2 * self.batch_size})
        number(self.seconds, "seconds", ranges.Range(0.0, 1e9, "s"))
        if not self.hidden or min(self.hidden) < 1:
            raise InvalidInputError(f"hidden must be widths >= 1, got {self.hidden}")
        for name in ("learning_rate", "tail"):
            positive(getattr(self, name), name)
        for name in ("force_weight", "barrier_weight", "low", "high"):
            number(getattr(self, name), name, ranges.NOT_NEGATIVE)
        for name in ("friction_low", "friction_high"):
            number(getattr(self, name), name, ranges.Range(0.0, ranges.FRICTION.high, ""))
        for low, high in (("low", "high"), ("friction_low", "friction_high")):
            if getattr(self, low) and getattr(self, high):
                _ordered(low, getattr(self, low), high, getattr(self, high))
        if self.grasp is not None and self.env is not None:
            raise InvalidInputError("grasp and env both give contacts: leave one of them out")

    def contacts(self) -> Grasp:
        """Return the grasp.

        Raises:
            GraspFileError: the file holds no grasp.
            InvalidInputError: contacts that models do not support, no force closure, or an invalid
                environment.
        """
        if played := self._played():
            grasp = played.grasp
        else:
            grasp = presets.preset(self.preset) if self.grasp is None else load_grasp(self.grasp)
        if set(grasp.models.names) != {"hard"} or grasp.n_contacts < 3:
            raise InvalidInputError(
                f"a model needs three and more hard contacts, the grasp has {list(grasp.models.names)}: use a start without a model"
            )
        if not closes(grasp):
            raise InvalidInputError(
                "the grasp has no force closure at its friction: give other contacts or more friction"
            )
        return grasp

    def resolved(self) -> FitConfig:
        """Return the settings with every default filled in.

        Raises:
            GraspFileError, InvalidInputError: see `contacts`; or the grasp does not close in the
                whole range of friction.
        """
        grasp, played = self.contacts(), self._played()
        mean = float(grasp.friction.mean())
        frictions = played.frictions if played else (LEAST * mean, MOST * mean)
        low = self.friction_low or next(
            mu
            for mu in np.linspace(frictions[0], mean, 16)
            if closes(with_mean_friction(grasp, float(mu)))
        )
        high = self.friction_high or frictions[1]
        _ordered("friction_low", low, "friction_high", high)
        if not closes(with_mean_friction(grasp, low)):
            raise InvalidInputError(
                f"friction_low must close the grasp, {low:g} does not: give more, or leave it out"
            )
        magnitudes = played.magnitudes if played else MAGNITUDES
        objective = played.objective if played else Objective()
        full = replace(
            self,
            steps=self.steps or STEPS[played is not None],
            low=self.low or magnitudes[0],
            high=self.high or magnitudes[1],
            friction_low=float(low),
            friction_high=float(high),
            force_weight=self.force_weight or objective.force_weight,
            barrier_weight=self.barrier_weight or objective.barrier_weight,
        )
        _ordered("low", full.low, "high", full.high)
        if not self.quick:
            return full
        return replace(full, steps=min(full.steps, 5000), samples=min(self.samples, 100_000))

    def source(self) -> Source:
        """Return the contacts of resolved settings, and the distribution of their wrenches."""
        played = self._played()
        return Source(
            self.contacts(),
            (self.low, self.high),
            (self.friction_low, self.friction_high),
            paper=self.grasp is None,
            played=played.wrenches if played else None,
            surface=played.surface if played else None,
        )

    def _played(self) -> Played | None:
        if self.env is None:
            return None
        from training.data.played import played  # needs the extra sim

        return played(self.env)


def _ordered(low_name: str, low: float, high_name: str, high: float) -> None:
    if not low < high:
        raise InvalidInputError(
            f"{low_name} must be less than {high_name}, got {low:g} and {high:g}"
        )
