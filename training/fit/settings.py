"""Settings of `grasp fit`: light to import, also the command line's options."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grasp_env import ranges
from grasp_env._check import number, positive
from grasp_env.errors import InvalidInputError
from grasp_env.grasp import Grasp, load_grasp, presets
from grasp_env.quality import feasibility
from training.data.one_grasp import with_mean_friction
from training.results.run import check_counts

LEAST, MOST = 5 / 8, 3 / 2
"""Range of the friction where none is given, over the grasp's own."""
CLOSURE = 0.01
"""Least closure margin times the contacts, as of the random grasps that starts are compared on."""


@dataclass(frozen=True)
class FitConfig:
    """How a network is fitted.

    Attributes:
        preset: the named grasp to learn.
        grasp: a grasp's JSON file instead, three and more hard contacts.
        steps: optimisation steps. Their number does not depend on the machine's speed, so that a training repeats bit by bit.
        seconds: processor time for them instead, all threads together: what others do on the machine does not count. 0: `steps`.
        samples: labelled wrenches; with many contacts fewer are made, which the model card says.
        hidden: widths of the hidden layers.
        degree: of the polynomials of the friction that the weights are; 0: friction is one more number that the network reads.
        batch_size: wrenches per optimisation step.
        learning_rate: peak of the one-cycle schedule.
        tail: exponent of the gap in the loss: larger cares more about the worst wrenches.
        seed: of data, weights and batches.
        low: [N] least |(force, moment about the contacts' centre / their length)| of the training wrenches.
        high: [N] largest.
        friction_low: least mean friction coefficient; 0: 5/8 of the grasp's own, or where contacts have less grip than closes
            the grasp, the least that does.
        friction_high: largest; 0: 3/2 of the grasp's own.
        force_weight: omega of the Phi to learn.
        barrier_weight: lambda of the Phi to learn [N^2].
        threads: 1 or 2 that share each batch; the result is the same bit by bit.
        quick: less of everything: ends within a minute, and says so.
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
        """The grasp to learn.

        Raises:
            GraspFileError: the file holds none.
            InvalidInputError: contacts that no model knows, or without force closure.
        """
        grasp = presets.preset(self.preset) if self.grasp is None else load_grasp(self.grasp)
        if set(grasp.models.names) != {"hard"} or grasp.n_contacts < 3:
            raise InvalidInputError(
                f"a model knows three and more hard contacts, the grasp has {list(grasp.models.names)}: its starts are those of "
                "methods without a model"
            )
        if not closes(grasp, float(grasp.friction.mean())):
            raise InvalidInputError(
                "the grasp has no force closure at its friction: give other contacts or more friction"
            )
        return grasp

    def resolved(self) -> FitConfig:
        """The settings in force: with the friction's range of the grasp.

        Raises:
            GraspFileError, InvalidInputError: see `contacts`; a range in which the grasp does not close.
        """
        grasp = self.contacts()
        own = float(grasp.friction.mean())
        low = self.friction_low or next(mu for mu in own * np.linspace(LEAST, 1.0, 16) if closes(grasp, float(mu)))
        high = self.friction_high or MOST * own
        _ordered("friction_low", low, "friction_high", high)
        if not closes(grasp, low):
            raise InvalidInputError(f"friction_low must close the grasp, {low:g} does not: give more, or leave it out")
        made = replace(self, friction_low=float(low), friction_high=float(high))
        if not self.quick:
            return made
        return replace(made, steps=min(self.steps, 5000), samples=min(self.samples, 100_000))


def closes(grasp: Grasp, friction: float) -> bool:
    """Whether the grasp closes with that mean friction, by more than a margin near which forces grow without bound."""
    return feasibility(with_mean_friction(grasp, friction), np.zeros(6)).margin > CLOSURE / grasp.n_contacts


def _ordered(low_name: str, low: float, high_name: str, high: float) -> None:
    if not low < high:
        raise InvalidInputError(f"{low_name} must be less than {high_name}, got {low:g} and {high:g}")
