"""Fits the initial-force network of one grasp to generated optima, and writes its model card."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from grasp_env.force import Objective
from grasp_env.grasp import Grasp, presets, reference_basis
from policies.checkpoint import Checkpoint
from policies.features import N_FEATURES, Features
from policies.network import Network
from policies.newton_layers import NewtonLayers, phi
from training.dataset import Dataset, generate
from training.fit_loop import Plan, optimise
from training.fit_polish import FixedGrasp, FixedPool
from training.fit_state import Progress, StateFile
from training.runs import provenance
from training.settings import FitConfig
from training.soap import Soap

HELD_OUT, HELD_OUT_SEED = 4000, 77_777
"""The same held-out wrenches for every training, so that seeds can be compared."""
POLISHED, POLISH_BATCH = 100_000, 256
POLISH_RATE = 0.25
"""Learning rate of the layers, in parts of the network's."""
FLOOR, POWER = 1e-5, 0.15
"""Of the layers' loss, as in `AnyFitConfig`."""


@dataclass(frozen=True)
class FitResult:
    """The checkpoint and the learning curve: rows (step, seconds, median, p95, p99 of the network's gap, of the start's)."""

    checkpoint: Checkpoint
    curve: np.ndarray


class FixedModel(nn.Module):
    """The network, and the layers that go on from its force."""

    def __init__(self, config: FitConfig, outputs: int) -> None:
        super().__init__()
        self.network = Network(N_FEATURES, config.hidden, outputs)
        self.polish = NewtonLayers(config.polish, config.polish_width) if config.polish else None


class NetworkTask:
    """First the network: mean power of its second-order gap of Phi. Then the layers: the true gap from where it starts them."""

    def __init__(
        self,
        config: FitConfig,
        module: FixedModel,
        tensors: tuple[tuple[Tensor, ...], ...],
        pools: tuple[FixedPool, ...],
    ) -> None:
        self.module = module
        self.phases = (1.0, POLISH_RATE) if config.polish else (1.0,)
        self._config, self._train, self._held_out = config, *tensors
        self._pool, self._held_out_pool = pools
        self._starts: Tensor | None = None

    def loss(self, rng: np.random.Generator, phase: int) -> Tensor:
        """See `fit_loop.Task`."""
        if phase == 1 and self.module.polish is not None:
            return self._polish_loss(self.module.polish, rng)
        index = torch.from_numpy(rng.integers(0, len(self._train[0]), self._config.batch_size))
        gap = gaps(self.module.network, tuple(column[index] for column in self._train))
        # a root keeps the few hard wrenches from drowning the rest, and the constant its derivative bounded
        return (gap + 1e-6).pow(self._config.tail).mean()

    def _polish_loss(self, polish: NewtonLayers, rng: np.random.Generator) -> Tensor:
        if self._starts is None:  # the network does not change any more
            self._starts = self._pool.starts(self.module.network)[1]
        pool = self._pool.pool
        index = torch.from_numpy(rng.integers(0, len(pool), POLISH_BATCH))
        problems, total = pool.problems(index), torch.zeros((), dtype=torch.float64)
        for force in polish(problems, self._starts[index]):
            gap = (phi(problems, force) / pool.least[index] - 1.0).clamp(min=0.0)
            total = total + (gap + FLOOR).pow(POWER).mean() / POWER
        return total

    @torch.no_grad()
    def score(self) -> list[float]:
        """Median, p95 and p99 of the network's second-order gap and of the start's true gap."""
        pool, (_, start) = self._held_out_pool, self._held_out_pool.starts(self.module.network)
        if self.module.polish is not None:
            start = self.module.polish(pool.pool.problems(torch.arange(len(pool.pool))), start)[-1]
        both = gaps(self.module.network, self._held_out).numpy(), pool.gap(start).numpy().clip(0.0)
        return [float(value) for gap in both for value in np.percentile(gap, [50, 95, 99])]

    def note(self, row: list[float]) -> str:
        """See `fit_loop.Task`."""
        told = [" ".join(f"{value:.1e}" for value in part) for part in (row[:3], row[3:])]
        return f"held-out gap (median, p95, p99) of the network {told[0]}, of the start {told[1]}"


def fit(
    config: FitConfig,
    progress: bool = False,
    command: str = "training.fit.fit",
    out: Path | None = None,
    resume: bool = False,
) -> FitResult:
    """Trains on the second-order relative gap of Phi and returns the model with the card of how it was made.

    Args:
        config: all settings.
        progress: tell the progress on stderr.
        command: recorded in the model card.
        out: stem of the model's files, beside which an interrupted training is kept; None: it is not kept.
        resume: go on from there.

    Raises:
        InvalidInputError: before any work, where `out` cannot be written or holds another training.
        KeyboardInterrupt: interrupted; the training so far is kept.
    """
    config = config.resolved()
    grasp = presets.preset(config.preset)
    state = StateFile.begin(out, {"kind": "fixed_grasp", **asdict(config)}, resume)
    torch.set_num_threads(config.threads)
    reference = reference_basis(grasp)
    objective = Objective(config.force_weight, config.barrier_weight)
    ranges = (config.low, config.high), (config.friction_low, config.friction_high)
    features = Features()
    rng, held_out_rng = np.random.default_rng([config.seed, 0]), np.random.default_rng([HELD_OUT_SEED, 1])
    data = generate(grasp, reference, objective, rng, config.samples, *ranges)
    held_out = generate(grasp, reference, objective, held_out_rng, HELD_OUT, *ranges)
    model = FixedGrasp(grasp, reference, features, objective)
    pools = tuple(
        FixedPool.ranges(model, each, count, *ranges)
        for each, count in ((rng, min(POLISHED, config.samples)), (held_out_rng, HELD_OUT))
    )
    torch.manual_seed(config.seed)
    module = FixedModel(config, reference.shape[1])
    task = NetworkTask(config, module, (_tensors(data, features), _tensors(held_out, features)), pools)
    words = f"fit {config.preset}{' (quick)' if config.quick else ''}" if progress else ""
    now = optimise(
        task, Plan(config.seconds, config.steps, config.learning_rate, Soap, config.seed, state, resume, words)
    )
    tensors = {name: value.detach().numpy() for name, value in module.network.state_dict().items()}
    if module.polish is not None:
        weights = {name: value.detach().numpy() for name, value in module.polish.state_dict().items()}
        tensors |= {name.replace("layers.", "polish.", 1): value for name, value in weights.items()}
    ball = FixedPool.ball(model, held_out_rng, HELD_OUT)
    scores = {
        "on": f"{HELD_OUT} wrenches of the standard ball (force 2 N, moment 0.05 N m), friction {grasp.friction[0]:g}",
        **ball.scores(module.network, module.polish),
        "training range": pools[1].scores(module.network, module.polish),
    }
    checkpoint = Checkpoint(
        kind="fixed_grasp",
        tensors={**tensors, "reference": reference},
        numbers={
            "sizes": [N_FEATURES, *config.hidden, reference.shape[1]],
            "features": asdict(features),
            "n_contacts": grasp.n_contacts,
            "force_weight": config.force_weight,
            "barrier_weight": config.barrier_weight,
            "polish": config.polish,
            "polish_width": config.polish_width,
        },
        ranges={"magnitude": ranges[0], "friction": ranges[1]},
        card=_card(config, grasp, command, now, scores),
    )
    return FitResult(checkpoint, np.array(now.curve))


def gaps(network: Network, tensors: tuple[Tensor, ...]) -> Tensor:
    """(B,) relative gap of Phi to second order: |R m (y - y*)|^2 with y the network's output."""
    inputs, scale, target, metric = tensors
    error = network(inputs) * scale - target
    return torch.einsum("bij,bj->bi", metric, error).square().sum(dim=1)


def _tensors(data: Dataset, features: Features) -> tuple[Tensor, ...]:
    inputs, scale = features(data.wrenches, data.friction)
    columns = (inputs, scale[:, None], data.coordinates, data.metric)
    return tuple(torch.from_numpy(np.asarray(column, dtype=np.float32)) for column in columns)


def _card(config: FitConfig, grasp: Grasp, command: str, now: Progress, scores: dict[str, Any]) -> dict[str, Any]:
    median, p95, p99 = now.curve[-1][2:5]
    made = provenance()
    return {
        "what": "initial grasp force of one grasp, from wrench and friction",
        "quick": config.quick,
        "grasp": {"preset": config.preset, "positions": grasp.positions.tolist(), "normals": grasp.normals.tolist()},
        "data": f"{config.samples} generated wrenches, labelled by Newton to a relative gap of 1e-10; others held out",
        "command": command,
        "config": asdict(config),
        "optimisation_steps": now.step,
        "seconds": round(now.seconds, 1),
        "cpu_seconds": round(now.cpu_seconds, 1),
        "time": made["time"],
        "machine": made["machine"] | {"torch threads": config.threads, "gpu": False},
        "versions": {name: made["versions"][name] for name in ("torch", "numpy", "numba")},
        "held_out_gap_second_order": {"median": median, "p95": p95, "p99": p99},
        "held_out_gap": scores,
        "curve": {
            "columns": ["step", "seconds", "median", "p95", "p99", "start median", "start p95", "start p99"],
            "rows": [" ".join(f"{value:.3g}" for value in row) for row in now.curve],
        },
        "limits": "one grasp (small displacements of its contacts only), the ranges above; everything else through the repair",
    }
