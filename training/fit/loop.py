"""Training loop: warm-up and cosine schedule, held-out scores, saved states, orderly interrupts."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn

from training.fit.soap import Soap
from training.fit.state import Progress, StateFile
from training.results.bars import progress
from training.results.interrupts import interruptible

MARKS = 20
"""Number of held-out scores, and of saved states, per training."""
WARM = 0.03
"""Share of the training over which the learning rate rises."""
CLIP = 5.0
"""Largest norm of a gradient."""
PARTS = 2
"""Parts of a batch. Each part's gradient is computed by one thread, and they are added in a fixed order, so that the sum has the same
bits for any number of threads."""
Part = Any
"""Part of a batch, of a type that the task defines."""


class Task(Protocol):
    """Training problem."""

    @property
    def module(self) -> nn.Module:
        """Module whose weights are optimised."""
        ...

    def batch(self, rng: np.random.Generator) -> list[Part]:
        """Draw a batch, in `PARTS` parts."""
        ...

    def loss(self, part: Part) -> Tensor:
        """Return the loss of a part. Several threads call it at once."""
        ...

    def score(self) -> list[float]:
        """Return the held-out scores, one row of the curve."""
        ...

    def note(self, row: list[float]) -> str:
        """Describe a row in words."""
        ...


@dataclass(frozen=True)
class Plan:
    """Length and settings of a training.

    Attributes:
        seconds: processor time for the optimisation steps; 0: `steps` decides.
        steps: number of optimisation steps.
        learning_rate: peak learning rate.
        seed: seed of the batches.
        threads: threads that share the parts of a batch.
        state: file in which the training is saved; None: it is not saved.
        resume: continue from that file.
        words: label of the progress on stderr (a bar on terminals, else lines); empty: no progress.
    """

    seconds: float
    steps: int
    learning_rate: float
    seed: int
    threads: int = 1
    state: StateFile | None = None
    resume: bool = False
    words: str = ""

    def done(self, now: Progress) -> float:
        """Return the completed share, 0 to 1 or above."""
        return now.cpu_seconds / self.seconds if self.seconds else now.step / self.steps


def optimise(task: Task, plan: Plan) -> Progress:
    """Train `task.module`.

    Unless time decides, the result has the same bits with any number of threads, and after an interrupt and resume.

    Returns:
        Steps, seconds and the curve: rows (step, seconds, *score).

    Raises:
        KeyboardInterrupt: after an interrupt or SIGTERM; the state at that moment is saved.
    """
    rng = np.random.default_rng([plan.seed, 2])
    optimiser = Soap(task.module.parameters(), lr=plan.learning_rate)
    now, mark = Progress(), 0.0
    if plan.state is not None and plan.resume:
        now = plan.state.restore(task.module, optimiser, rng)
        mark = _next_mark(plan.done(now))
    since = now.seconds - time.perf_counter(), now.cpu_seconds - time.process_time()
    parameters = list(task.module.parameters())

    def gradients(part: Part) -> tuple[Tensor, ...]:
        return torch.autograd.grad(task.loss(part), parameters)

    with interruptible() as interrupted, _reporting(task, plan) as report, ThreadPoolExecutor(plan.threads) as pool:
        while True:
            done = plan.done(now)
            if done >= min(mark, 1.0):
                row = task.score()
                now.curve.append([float(now.step), round(now.seconds, 2), *row])
                mark = _next_mark(done)
                report(now, row)
                if plan.state is not None and done > 0.0:
                    plan.state.save(task.module, optimiser, rng, now)
            if done >= 1.0:
                return now
            if interrupted():
                if plan.state is not None:
                    plan.state.save(task.module, optimiser, rng, now)
                    sys.stderr.write(f"saved {plan.state.path}: the same command with --resume continues from there\n")
                raise KeyboardInterrupt
            for group in optimiser.param_groups:
                group["lr"] = plan.learning_rate * _schedule(done)
            for parameter, *found in zip(parameters, *pool.map(gradients, task.batch(rng)), strict=True):
                parameter.grad = torch.stack(found).mean(dim=0)
            nn.utils.clip_grad_norm_(parameters, CLIP)
            optimiser.step()
            now.step += 1
            now.seconds, now.cpu_seconds = since[0] + time.perf_counter(), since[1] + time.process_time()


def _schedule(done: float) -> float:
    """Return the factor of the learning rate: a linear warm-up, then a cosine to zero."""
    return done / WARM + 1e-3 if done < WARM else 0.5 * (1.0 + math.cos(math.pi * (done - WARM) / (1.0 - WARM))) + 1e-4


def _next_mark(done: float) -> float:
    return (math.floor(done * MARKS + 1e-9) + 1) / MARKS


@contextmanager
def _reporting(task: Task, plan: Plan) -> Iterator[Callable[[Progress, list[float]], None]]:
    console = Console(stderr=True, quiet=not plan.words)
    total = round(plan.seconds) or plan.steps
    with progress(console) as bar:
        shown = bar.add_task(f"{plan.words}, {'seconds' if plan.seconds else 'steps'}", total=total)

        def report(now: Progress, row: list[float]) -> None:
            bar.update(shown, completed=round(total * min(1.0, plan.done(now))), note=task.note(row))
            if plan.words and not console.is_terminal:
                sys.stderr.write(f"{plan.words}: step {now.step}, {now.seconds:.0f} s: {task.note(row)}\n")

        yield report
