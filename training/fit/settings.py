"""Settings of `grasp fit`: light to import, also the command line's options."""

from __future__ import annotations

from dataclasses import dataclass, replace

from grasp_env import ranges
from grasp_env._check import number, positive
from grasp_env.errors import InvalidInputError
from training.results.run import check_counts


@dataclass(frozen=True)
class FitConfig:
    """How a network is fitted.

    Attributes:
        preset: the named grasp to learn.
        seconds: processor time for the optimisation steps, on one core: what others do on the machine does not count. Data and
            scores come on top (about 15 s).
        steps: a fixed number of optimisation steps instead (then the result does not depend on the machine's speed).
        samples: labelled wrenches.
        hidden: widths of the hidden layers.
        degree: of the polynomials of the friction that the weights are; 0: friction is one more number that the network reads.
        batch_size: wrenches per optimisation step.
        learning_rate: peak of the one-cycle schedule.
        tail: exponent of the gap in the loss: larger cares more about the worst wrenches.
        seed: of data, weights and batches.
        low: [N] least |(force, moment / 0.05 m)| of the training wrenches.
        high: [N] largest.
        friction_low: least friction coefficient.
        friction_high: largest.
        force_weight: omega of the Phi to learn.
        barrier_weight: lambda of the Phi to learn [N^2].
        threads: torch threads. One repeats bit by bit, and for networks this small more gain little; where another
            process takes one of two cores, two threads were measured 50 times slower than one.
        quick: less of everything: ends within a minute, and says so.
    """

    preset: str = "paper_cuboid"
    seconds: float = 480.0
    steps: int = 0
    samples: int = 800_000
    hidden: tuple[int, ...] = (64, 64)
    degree: int = 2
    batch_size: int = 2048
    learning_rate: float = 2e-2
    tail: float = 0.35
    seed: int = 0
    low: float = 0.1
    high: float = 20.0
    friction_low: float = 0.25
    friction_high: float = 0.6
    force_weight: float = 1.0
    barrier_weight: float = 0.01
    threads: int = 1
    quick: bool = False

    def __post_init__(self) -> None:
        check_counts(self, {"batch_size": 1, "seed": 0, "steps": 0, "threads": 1, "degree": 0})
        check_counts(self, {"samples": 2 * self.batch_size})
        seconds = number(self.seconds, "seconds", ranges.Range(-1e9, 1e9, "s"))
        if not seconds > 0.0 and self.steps <= 0:
            raise InvalidInputError(f"give seconds > 0 or steps > 0, got seconds={self.seconds}, steps={self.steps}")
        if not self.hidden or min(self.hidden) < 1:
            raise InvalidInputError(f"hidden must be widths >= 1, got {self.hidden}")
        for name in ("learning_rate", "tail", "force_weight", "barrier_weight"):
            positive(getattr(self, name), name)
        for name in ("low", "friction_low"):
            low, high = getattr(self, name), getattr(self, name.replace("low", "high"))
            if not 0 < low < high < float("inf"):
                raise InvalidInputError(
                    f"{name} and {name.replace('low', 'high')} must be 0 < low < high, got {low} and {high}"
                )

    def resolved(self) -> FitConfig:
        """The settings in force."""
        if not self.quick:
            return self
        return replace(self, seconds=min(self.seconds, 25.0), samples=min(self.samples, 100_000))
