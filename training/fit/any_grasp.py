"""Fits the layers that start any grasp, and writes their model card."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._extras import need

with need("train"):
    import torch
    from torch import Tensor, nn

from policies.checkpoint import Checkpoint
from policies.newton_layers import NewtonLayers, newton_step, phi
from training.data import any_grasp as any_dataset
from training.data.any_grasp import Pool, make_pool
from training.data.grasps import TRAINING
from training.fit.loop import Plan, card, optimise
from training.fit.settings import AnyFitConfig
from training.fit.soap import Soap
from training.fit.state import Progress, StateFile
from training.runs.words import small

HELD_OUT_SEED = 77_777
"""Of the held-out grasps: the same for every training, so that seeds can be compared."""
PERCENTILES = (50, 90, 99)
STARTS = ("basis", "carried")
EARLY = 0.2
"""Weight of every layer but the last in the loss."""
FROM_BASIS = 0.6
"""Share of a batch that starts from the 12-basis; the rest from carried previous solutions."""


class StartsTask:
    """Mean of a small power of the gap of Phi after each layer.

    Args:
        module: (problems, start) -> the forces after each layer.
        config: of the batches and the loss.
        train, held_out: samples.
    """

    def __init__(self, module: nn.Module, config: AnyFitConfig, train: Pool, held_out: Pool) -> None:
        self.module = module
        self._config, self._train, self._held_out = config, train, held_out

    def loss(self, rng: np.random.Generator) -> Tensor:
        """See `loop.Task`."""
        size = self._config.batch_size
        samples = torch.from_numpy(rng.integers(0, len(self._train), size))
        basis = torch.from_numpy(rng.random(size) < FROM_BASIS)[:, None, None]
        starts = self._train.starts
        x = torch.where(basis, starts["basis"][samples], starts["carried"][samples])
        problems, least = self._train.problems(samples), self._train.least[samples]
        total = torch.zeros((), dtype=torch.float64)
        outputs = self.module(problems, x)
        for layer, force in enumerate(outputs):
            gap = (phi(problems, force) / least - 1.0).clamp(min=0.0)
            # a small power: a tenth of the gap is worth nearly the same wherever it is, the tail somewhat more
            term = (gap + self._config.gap_floor).pow(self._config.tail).mean() / self._config.tail
            total = total + (1.0 if layer == len(outputs) - 1 else EARLY) * term
        return total

    def score(self) -> list[float]:
        """Per start and layer the percentiles of the gap."""
        return [value for start in STARTS for row in layer_gaps(self.module, self._held_out, start) for value in row]

    def note(self, row: list[float]) -> str:
        """See `loop.Task`."""
        half = len(row) // 2
        told = [" ".join(f"{gap:.0e}" for gap in part[-3:]) for part in (row[:half], row)]
        return f"gaps, median p90 p99: basis {told[0]}, carried {told[1]}"


@torch.no_grad()
def layer_gaps(module: nn.Module | None, pool: Pool, start: str, steps: int = 0) -> list[list[float]]:
    """Percentiles of the gap after each layer, or after each of `steps` plain Newton steps."""
    problems, x = pool.problems(torch.arange(len(pool))), pool.starts[start]
    if module is not None:
        outputs = module(problems, x)
    else:
        outputs = []
        for _ in range(steps):
            x = newton_step(problems, x)
            outputs.append(x)
    return [_percentiles(phi(problems, force) / pool.least - 1.0) for force in outputs]


def _percentiles(gap: Tensor) -> list[float]:
    return [float(value) for value in np.percentile(gap.numpy(), PERCENTILES).clip(0.0)]


def fit_any(
    config: AnyFitConfig,
    progress: bool = False,
    command: str = "training.fit.any_grasp.fit_any",
    out: Path | None = None,
    resume: bool = False,
) -> Checkpoint:
    """Trains on random grasps and returns the model with the card of how it was made.

    Args:
        config: all settings.
        progress: tell the progress on stderr.
        command: recorded in the model card.
        out: stem of the model's files, beside which an interrupted training is kept; None: it is not kept.
        resume: go on from there.
    """
    torch.set_num_threads(1)
    config = config.resolved()
    state = StateFile.begin(out, {"kind": "any_grasp", **asdict(config)}, resume)
    train = make_pool(np.random.default_rng([config.seed, 0]), config.grasps, config.samples)
    held_out = make_pool(np.random.default_rng([HELD_OUT_SEED, 1]), config.held_out // 4, config.held_out)
    torch.manual_seed(config.seed)
    module = NewtonLayers(config.layers, config.width)
    task = StartsTask(module, config, train, held_out)
    words = f"fit any_grasp{' (quick)' if config.quick else ''}" if progress else ""
    plan = Plan(
        config.seconds, config.steps, config.learning_rate, Soap, config.seed, state=state, resume=resume, words=words
    )
    now = optimise(task, plan)
    return Checkpoint(
        kind="any_grasp",
        tensors={name: value.detach().numpy() for name, value in module.state_dict().items()},
        numbers={"layers": config.layers, "width": config.width},
        ranges={
            "magnitude": (any_dataset.TINY[0] / any_dataset.UNIT, any_dataset.MAGNITUDES[1] / any_dataset.UNIT),
            "friction": TRAINING.friction,
            "contacts": (3, any_dataset.MOST_CONTACTS),
        },
        card=_card(config, command, now, module, train, held_out),
    )


def _card(
    config: AnyFitConfig, command: str, now: Progress, module: NewtonLayers, train: Pool, held_out: Pool
) -> dict[str, Any]:
    columns = [f"{s} layer {k + 1} p{p}" for s in STARTS for k in range(config.layers) for p in PERCENTILES]
    return {
        "what": "learned Newton layers: initial grasp force for any contacts, from the 12-basis or the previous solution",
        "data": f"{config.grasps} random grasps of 3 to {any_dataset.MOST_CONTACTS} contacts with force closure, {len(train)} wrenches, "
        f"labelled by Newton to a relative gap of {small(any_dataset.LABEL_GAP)} ({train.refused} dropped); {len(held_out)} wrenches on "
        f"{config.held_out // 4} other grasps held out",
        **card(config, command, now, columns),
        "held_out_gap": {
            start: {
                "percentiles": PERCENTILES,
                "start": _percentiles(
                    phi(held_out.problems(torch.arange(len(held_out))), held_out.starts[start]) / held_out.least - 1.0
                ),
                "after each layer": layer_gaps(module, held_out, start),
                "after as many plain Newton steps": layer_gaps(None, held_out, start, config.layers),
            }
            for start in STARTS
        },
        "limits": "hard contacts with round cones; magnitudes are in units of sqrt(lambda / omega), of the wrench as (force, "
        "moment about the contacts' centre / their rms distance); outside these ranges it is never worse than its start, "
        "but unproven",
    }
