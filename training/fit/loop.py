"""The optimisation loop: warm-up and cosine, a held-out curve, saved states, orderly interrupts."""

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
"""Scores on held-out data, and saved states, per training."""
WARM = 0.03
"""Share of the training over which the learning rate rises."""
CLIP = 5.0
"""Largest norm of a gradient."""
PARTS = 2
"""Of a batch: their gradients are made by a thread each and added in this order, so that the sum has the same bits on any machine's
number of cores."""
Part = Any
"""What a task makes of a part of a batch."""


class Task(Protocol):
    """What is trained."""

    @property
    def module(self) -> nn.Module:
        """Its weights are optimised."""
        ...

    def batch(self, rng: np.random.Generator) -> list[Part]:
        """A batch drawn with `rng`, in `PARTS` parts."""
        ...

    def loss(self, part: Part) -> Tensor:
        """Of a part; called by several threads at once."""
        ...

    def score(self) -> list[float]:
        """Held-out numbers, one row of the curve."""
        ...

    def note(self, row: list[float]) -> str:
        """A row in words."""
        ...


@dataclass(frozen=True)
class Plan:
    """How long and how.

    Attributes:
        seconds: processor time for the optimisation steps; 0: their number decides.
        steps: how many.
        learning_rate: peak.
        seed: of the batches.
        threads: that share the parts of a batch.
        state: where the training is saved; None: nowhere.
        resume: go on from there.
        words: what it is called where its scores are told on stderr (a bar on terminals, else lines); empty: nowhere.
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
        """0 to 1 (and beyond)."""
        return now.cpu_seconds / self.seconds if self.seconds else now.step / self.steps


def optimise(task: Task, plan: Plan) -> Progress:
    """Trains `task.module`; unless time decides the result is the same bit by bit, also with other threads, an interrupt and resume.

    Returns:
        Steps, seconds and the curve: rows (step, seconds, *score).

    Raises:
        KeyboardInterrupt: after an interrupt or SIGTERM; the training as it was then is saved.
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

    with interruptible() as interrupted, _telling(task, plan) as tell, ThreadPoolExecutor(plan.threads) as pool:
        while True:
            done = plan.done(now)
            if done >= min(mark, 1.0):
                row = task.score()
                now.curve.append([float(now.step), round(now.seconds, 2), *row])
                mark = _next_mark(done)
                tell(now, row)
                if plan.state is not None and done > 0.0:
                    plan.state.save(task.module, optimiser, rng, now)
            if done >= 1.0:
                return now
            if interrupted():
                if plan.state is not None:
                    plan.state.save(task.module, optimiser, rng, now)
                    sys.stderr.write(f"saved {plan.state.path}: the same command with --resume goes on from there\n")
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
    """Warm-up, then a cosine to zero."""
    return done / WARM + 1e-3 if done < WARM else 0.5 * (1.0 + math.cos(math.pi * (done - WARM) / (1.0 - WARM))) + 1e-4


def _next_mark(done: float) -> float:
    return (math.floor(done * MARKS + 1e-9) + 1) / MARKS


@contextmanager
def _telling(task: Task, plan: Plan) -> Iterator[Callable[[Progress, list[float]], None]]:
    console = Console(stderr=True, quiet=not plan.words)
    total = round(plan.seconds) or plan.steps
    with progress(console) as bar:
        shown = bar.add_task(f"{plan.words}, {'seconds' if plan.seconds else 'steps'}", total=total)

        def tell(now: Progress, row: list[float]) -> None:
            bar.update(shown, completed=round(total * min(1.0, plan.done(now))), note=task.note(row))
            if plan.words and not console.is_terminal:
                sys.stderr.write(f"{plan.words}: step {now.step}, {now.seconds:.0f} s: {task.note(row)}\n")

        yield tell
