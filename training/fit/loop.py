"""Training loop: batches, loss, learning rate, held-out scores, saved states, interrupts."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn

from policies.network import Network
from training.evaluation.results.bars import progress
from training.evaluation.results.interrupts import interruptible
from training.fit.fit_config import FitConfig
from training.fit.soap import Soap
from training.fit.state import FitProgress, StateFile

MARKS = 20
"""Number of held-out scores, and of saved states, per training."""
WARM = 0.03
"""Share of the training over which the learning rate rises."""
CLIP = 5.0
"""Largest norm of a gradient."""
SHARES = 2
"""Shares of a batch, each for one thread; the fixed order of their sum keeps its bits."""
AT_ONCE = 16
"""Number of frictions in a batch; the network has separate weights for each friction."""
FLOOR = 1e-6
"""Gap below which a smaller one gains nothing."""
PERCENTILES = (50, 95, 99)
Samples = tuple[Tensor, Tensor, Tensor, Tensor]
"""Displacements (F, moves), features (F, B, inputs), R m (F, B, K, K) and R z* (F, B, K), by
friction.

With the network's output y the gap to second order is |R m y - R z*|^2.
"""


class NetworkTask:
    """Regression of the optimum: the loss is the mean of a small power of the gap of Phi."""

    def __init__(
        self, config: FitConfig, module: Network, train: Samples, held_out: tuple[Samples, ...]
    ) -> None:
        self.config = config
        self.module = module
        self._train = train
        self._held_out = held_out

    def done(self, now: FitProgress) -> float:
        """Return the completed share of the training, 0 to 1 or above."""
        if self.config.seconds:
            return now.cpu_seconds / self.config.seconds
        return now.step / self.config.steps

    def batch(self, rng: np.random.Generator) -> list[Samples]:
        """Draw a batch, in `SHARES` shares."""
        moves, *samples = self._train
        frictions, count = samples[0].shape[:2]
        size = self.config.batch_size // AT_ONCE
        # one friction from each part of the range: the gradient of the polynomials varies less
        # between batches
        chosen = ((np.arange(AT_ONCE) + rng.random(AT_ONCE)) * (frictions / AT_ONCE)).astype(int)
        begin = rng.integers(0, count - size + 1, AT_ONCE)
        blocks = [(k, slice(b, b + size)) for k, b in zip(chosen, begin, strict=True)]
        return [
            (
                moves[chosen[share::SHARES]],
                *(torch.stack([data[at] for at in blocks[share::SHARES]]) for data in samples),
            )
            for share in range(SHARES)
        ]  # type: ignore[misc]

    def loss(self, share: Samples) -> Tensor:
        """Return the loss of a share. Several threads call it at once."""
        # the small power keeps few hard wrenches from dominating the loss; the constant bounds its
        # derivative
        return (gaps(self.module, share) + FLOOR).pow(self.config.tail).mean()

    @torch.no_grad()
    def score(self) -> list[float]:
        """Return percentiles of the gap on each held-out set, one row of the curve."""
        sets = (gaps(self.module, samples).numpy() for samples in self._held_out)
        return [float(value) for gap in sets for value in np.percentile(gap, PERCENTILES)]


def gaps(network: Network, samples: Samples) -> Tensor:
    """Return the relative gap of Phi (F * B,), to second order."""
    moves, inputs, metric, goal = samples
    size = goal.shape[-1]
    outputs = network(inputs, moves).reshape(-1, size, 1)
    goal = goal.reshape(-1, size, 1)
    errors = torch.baddbmm(goal, metric.reshape(-1, size, size), outputs, beta=-1)
    return errors.square().sum((1, 2))


def optimise(
    task: NetworkTask, state: StateFile | None = None, resume: bool = False, words: str = ""
) -> FitProgress:
    """Train `task.module`.

    Unless time decides, the result has the same bits with any number of threads, and after an
    interrupt and resume. The training is saved in the file `state`, from which `resume` continues.
    `words` label the progress on stderr (a bar on terminals, else lines); empty: no progress.

    Returns:
        Steps, seconds and the curve: rows (step, seconds, *score).

    Raises:
        KeyboardInterrupt: after an interrupt or SIGTERM; the state at that moment is saved.
    """
    config = task.config
    rng = np.random.default_rng([config.seed, 2])
    parameters = list(task.module.parameters())
    optimiser = Soap(parameters, lr=config.learning_rate)
    now = FitProgress()
    next_score = 0.0
    if state is not None and resume:
        now = state.restore(task.module, optimiser, rng)
        next_score = _next_mark(task.done(now))
    begun = now.seconds - time.perf_counter(), now.cpu_seconds - time.process_time()

    def gradients(share: Samples) -> tuple[Tensor, ...]:
        return torch.autograd.grad(task.loss(share), parameters)

    with (
        interruptible() as interrupted,
        _reporting(task, words) as report,
        ThreadPoolExecutor(config.threads) as pool,
    ):
        while True:
            done = task.done(now)
            if done >= min(next_score, 1.0):
                row = task.score()
                now.curve.append([float(now.step), round(now.seconds, 2), *row])
                next_score = _next_mark(done)
                report(now, row)
                if state is not None and done > 0.0:
                    state.save(task.module, optimiser, rng, now)
            if done >= 1.0:
                return now
            if interrupted():
                if state is not None:
                    state.save(task.module, optimiser, rng, now)
                    sys.stderr.write(
                        f"saved {state.path}: the same command with --resume continues from there\n"
                    )
                raise KeyboardInterrupt
            for group in optimiser.param_groups:
                group["lr"] = config.learning_rate * _schedule(done)
            shares = pool.map(gradients, task.batch(rng))
            for parameter, *gradient in zip(parameters, *shares, strict=True):
                parameter.grad = torch.stack(gradient).mean(dim=0)
            nn.utils.clip_grad_norm_(parameters, CLIP)
            optimiser.step()
            now.step += 1
            now.seconds = begun[0] + time.perf_counter()
            now.cpu_seconds = begun[1] + time.process_time()


def _schedule(done: float) -> float:
    """Return the factor of the learning rate: a linear warm-up, then a cosine to zero."""
    if done < WARM:
        return done / WARM + 1e-3
    return 0.5 * (1.0 + math.cos(math.pi * (done - WARM) / (1.0 - WARM))) + 1e-4


def _next_mark(done: float) -> float:
    return (math.floor(done * MARKS + 1e-9) + 1) / MARKS


@contextmanager
def _reporting(
    task: NetworkTask, words: str
) -> Iterator[Callable[[FitProgress, list[float]], None]]:
    console = Console(stderr=True, quiet=not words)
    seconds = task.config.seconds
    total = round(seconds) or task.config.steps
    with progress(console) as bar:
        bar_task = bar.add_task(f"{words}, {'seconds' if seconds else 'steps'}", total=total)

        def report(now: FitProgress, row: list[float]) -> None:
            ball, whole = (" ".join(f"{value:.0e}" for value in row[k : k + 3]) for k in (0, 3))
            note = f"gaps, median p95 p99: ball {ball}, all {whole}"
            done = round(total * min(1.0, task.done(now)))
            bar.update(bar_task, completed=done, note=note)
            if words and not console.is_terminal:
                sys.stderr.write(f"{words}: step {now.step}, {now.seconds:.0f} s: {note}\n")

        yield report
