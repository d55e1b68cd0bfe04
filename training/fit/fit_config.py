"""Settings of `grasp fit`, which are also its options; this module imports no torch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.grasp import Grasp, load_grasp, presets
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import number, positive
from grasp_env.quality import feasibility
from training.data.one_grasp import with_mean_friction
from training.evaluation.results.run import check_counts

LEAST, MOST = 5 / 8, 3 / 2
"""Default range of the friction, as factors of the grasp's own."""
CLOSURE = 0.01
"""Least closure margin times the number of contacts, as of random grasps in comparisons."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of a training.

    Attributes:
        preset: name of the grasp.
        grasp: JSON file of a grasp instead, with at least three hard contacts.
        steps: optimisation steps. A training of a given number of steps repeats bit by bit.
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
            wrenches [N].
        high: largest such norm [N].
        friction_low: least mean friction coefficient; 0: 5/8 of the grasp's own, or the least with
            which the grasp closes.
        friction_high: largest mean friction coefficient; 0: 3/2 of the grasp's own.
        force_weight: omega of Phi.
        barrier_weight: lambda of Phi [N^2].
        threads: 1 or 2 threads that share each batch; the result has the same bits.
        quick: a small training of about a minute; the model card marks it.
    """

    preset: str = "paper_cuboid"
    grasp: str | None = None
    steps: int = 300_000
    seconds: float = 0.0
    samples: int = 800_000
    hidden: tuple[int, ...] = (64, 64)
    degree: int = 2
    batch_size: int = 2048
    learning_rate: float = 2e-2
    tail: float = 0.35
    seed: int = 0
    low: float = 0.1
    high: float = 20.0
    friction_low: float = 0.0
    friction_high: float = 0.0
    force_weight: float = 1.0
    barrier_weight: float = 0.01
    threads: int = 2
    quick: bool = False

    def __post_init__(self) -> None:
        check_counts(self, {"batch_size": 1, "seed": 0, "steps": 1, "threads": 1, "degree": 0})
        check_counts(self, {"samples": 2 * self.batch_size})
        number(self.seconds, "seconds", ranges.Range(0.0, 1e9, "s"))
        if not self.hidden or min(self.hidden) < 1:
            raise InvalidInputError(f"hidden must be widths >= 1, got {self.hidden}")
        for name in ("learning_rate", "tail", "force_weight", "barrier_weight", "low", "high"):
            positive(getattr(self, name), name)
        for name in ("friction_low", "friction_high"):
            number(getattr(self, name), name, ranges.Range(0.0, ranges.FRICTION.high, ""))
        _ordered("low", self.low, "high", self.high)
        if self.friction_low and self.friction_high:
            _ordered("friction_low", self.friction_low, "friction_high", self.friction_high)

    def contacts(self) -> Grasp:
        """Return the grasp.

        Raises:
            GraspFileError: the file holds no grasp.
            InvalidInputError: contacts that models do not support, or no force closure.
        """
        grasp = presets.preset(self.preset) if self.grasp is None else load_grasp(self.grasp)
        if set(grasp.models.names) != {"hard"} or grasp.n_contacts < 3:
            raise InvalidInputError(
                f"a model needs three and more hard contacts, the grasp has {list(grasp.models.names)}: use a start without a model"
            )
        if not closes(grasp, float(grasp.friction.mean())):
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
        grasp = self.contacts()
        mean = float(grasp.friction.mean())
        low = self.friction_low or next(
            mu for mu in mean * np.linspace(LEAST, 1.0, 16) if closes(grasp, float(mu))
        )
        high = self.friction_high or MOST * mean
        _ordered("friction_low", low, "friction_high", high)
        if not closes(grasp, low):
            raise InvalidInputError(
                f"friction_low must close the grasp, {low:g} does not: give more, or leave it out"
            )
        full = replace(self, friction_low=float(low), friction_high=float(high))
        if not self.quick:
            return full
        return replace(full, steps=min(self.steps, 5000), samples=min(self.samples, 100_000))


def closes(grasp: Grasp, friction: float) -> bool:
    """Return True if the grasp closes at that mean friction with the margin `CLOSURE`."""
    margin = feasibility(with_mean_friction(grasp, friction), np.zeros(6)).margin
    return margin > CLOSURE / grasp.n_contacts


def _ordered(low_name: str, low: float, high_name: str, high: float) -> None:
    if not low < high:
        raise InvalidInputError(
            f"{low_name} must be less than {high_name}, got {low:g} and {high:g}"
        )
