"""Settings of the commands: light to import, one frozen dataclass each, also the command line's options."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from grasp_env._check import positive
from grasp_env.errors import InvalidInputError
from training.runs import default_name


@dataclass(frozen=True)
class FitConfig:
    """How a network is fitted.

    Attributes:
        preset: the named grasp to learn.
        seconds: time for the optimisation steps; data generation and set-up come on top (about 15 s).
        steps: a fixed number of optimisation steps instead (then the result does not depend on the machine's speed).
        samples: labelled wrenches.
        hidden: widths of the hidden layers.
        batch_size: wrenches per optimisation step.
        learning_rate: peak of the one-cycle schedule.
        seed: of data, weights and batches.
        low: [N] least |(force, moment / 0.05 m)| of the training wrenches.
        high: [N] largest.
        friction_low: least friction coefficient.
        friction_high: largest.
        force_weight: omega of the Phi to learn.
        barrier_weight: lambda of the Phi to learn [N^2].
        threads: torch threads. One repeats bit by bit, and for networks this small more gain little; where another
            process takes one of two cores, two threads were measured 50 times slower than one.
    """

    preset: str = "paper_cuboid"
    seconds: float = 150.0
    steps: int = 0
    samples: int = 400_000
    hidden: tuple[int, ...] = (128, 128, 128)
    batch_size: int = 2048
    learning_rate: float = 4e-3
    seed: int = 0
    low: float = 0.1
    high: float = 20.0
    friction_low: float = 0.25
    friction_high: float = 0.6
    force_weight: float = 1.0
    barrier_weight: float = 0.01
    threads: int = 1

    def __post_init__(self) -> None:
        if self.seconds <= 0 and self.steps <= 0:
            raise InvalidInputError(f"give seconds > 0 or steps > 0, got seconds={self.seconds}, steps={self.steps}")
        for name, least in (("threads", 1), ("batch_size", 1), ("seed", 0), ("steps", 0)):
            if getattr(self, name) < least:
                raise InvalidInputError(f"{name} must be >= {least}, got {getattr(self, name)}")
        if not self.hidden or min(self.hidden) < 1:
            raise InvalidInputError(f"hidden must be widths >= 1, got {self.hidden}")
        for name in ("learning_rate", "force_weight", "barrier_weight"):
            positive(getattr(self, name), name)
        if self.samples < 2 * self.batch_size:
            raise InvalidInputError(f"samples must be at least two batches ({2 * self.batch_size}), got {self.samples}")
        if not 0 < self.low < self.high or not 0 < self.friction_low < self.friction_high:
            raise InvalidInputError("ranges must satisfy 0 < low < high")


@dataclass(frozen=True)
class EvaluateConfig:
    """What is compared.

    Attributes:
        out: folder of runs.
        name: of this run; empty: evaluate-<date>-<time>.
        wrenches: number of held-out wrenches (ball and smooth set each).
        timed: number of wrenches whose calls are timed.
        episodes: of each random scenario, per start.
        seed: of the held-out wrenches and the roll-outs; the network's is `fit.seed`.
        quick: a small version that ends in about a minute and says that it is quick.
        fit: how the network of this run is fitted.
    """

    out: str = "runs"
    name: str = ""
    wrenches: int = 1000
    timed: int = 500
    episodes: int = 10
    seed: int = 0
    quick: bool = False
    fit: FitConfig = field(default_factory=FitConfig)

    def __post_init__(self) -> None:
        for name, least in (("wrenches", 1), ("timed", 1), ("episodes", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise InvalidInputError(f"{name} must be >= {least}, got {getattr(self, name)}")
        if self.fit.preset != "paper_cuboid":
            raise InvalidInputError(
                f"the simulated hand holds the preset 'paper_cuboid', got fit.preset={self.fit.preset!r}: use `grasp fit` "
                "for other grasps"
            )

    def resolved(self) -> EvaluateConfig:
        """The settings in force: `quick` shrinks everything but the protocol."""
        name = self.name or default_name("evaluate")
        if not self.quick:
            return replace(self, name=name)
        small = replace(self.fit, seconds=15.0, samples=50_000)
        return replace(self, name=name, wrenches=100, timed=50, episodes=2, fit=small)
