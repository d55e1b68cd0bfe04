"""Fits the initial-force network to generated optima and saves it with its model card."""

from __future__ import annotations

import platform
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from grasp_env.force import Objective
from grasp_env.grasp import Grasp, presets, reference_basis
from policies.checkpoint import Checkpoint
from policies.features import N_FEATURES, Features
from policies.network import Network
from training.dataset import Dataset, batches, generate
from training.settings import FitConfig


@dataclass(frozen=True)
class FitResult:
    """The checkpoint and the learning curve: rows (step, seconds, median gap, p95 gap, p99 gap) on held-out wrenches."""

    checkpoint: Checkpoint
    curve: np.ndarray


def fit(config: FitConfig, progress: bool = False, command: str = "training.fit.fit") -> FitResult:
    """Trains on the second-order relative gap of Phi and returns the model with the card of how it was made.

    Args:
        config: all settings.
        progress: show a progress bar.
        command: recorded in the model card.
    """
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    grasp = presets.preset(config.preset)
    reference = reference_basis(grasp)
    objective = Objective(config.force_weight, config.barrier_weight)
    ranges = (config.low, config.high), (config.friction_low, config.friction_high)
    started = time.perf_counter()
    data = generate(grasp, reference, objective, rng, config.samples, *ranges)
    held_out = generate(grasp, reference, objective, np.random.default_rng([config.seed, 1]), 4000, *ranges)
    prepared = time.perf_counter() - started
    features = Features()
    network = Network(N_FEATURES, config.hidden, reference.shape[1])
    curve, steps = _train(network, features, data, held_out, config, rng, progress)
    card = _card(config, grasp, command, steps, prepared, time.perf_counter() - started, curve)
    return FitResult(
        Checkpoint(
            weights={name: value.detach().numpy() for name, value in network.state_dict().items()},
            reference=reference,
            sizes=(N_FEATURES, *config.hidden, reference.shape[1]),
            features=features,
            n_contacts=grasp.n_contacts,
            force_weight=config.force_weight,
            barrier_weight=config.barrier_weight,
            magnitude_range=ranges[0],
            friction_range=ranges[1],
            card=card,
        ),
        np.array(curve),
    )


def gaps(network: Network, tensors: tuple[torch.Tensor, ...]) -> torch.Tensor:
    """(B,) relative gap of Phi to second order: |R m (y - y*)|^2 with y the network's output."""
    inputs, scale, target, metric = tensors
    error = network(inputs) * scale - target
    return torch.einsum("bij,bj->bi", metric, error).square().sum(dim=1)


def _tensors(data: Dataset, features: Features) -> tuple[torch.Tensor, ...]:
    inputs, scale = features(data.wrenches, data.friction)
    columns = (inputs, scale[:, None], data.coordinates, data.metric)
    return tuple(torch.from_numpy(np.asarray(column, dtype=np.float32)) for column in columns)


def _train(
    network: Network,
    features: Features,
    data: Dataset,
    held_out: Dataset,
    config: FitConfig,
    rng: np.random.Generator,
    progress: bool,
) -> tuple[list[tuple[float, ...]], int]:
    train, test = _tensors(data, features), _tensors(held_out, features)
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=1e-6)
    indices = batches(len(data), config.batch_size, rng)
    curve: list[tuple[float, ...]] = []
    started = time.perf_counter()
    step, done, mark = 0, 0.0, 0.0
    columns = TextColumn("fit"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn()
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("fit", total=1.0, note="")
        while True:
            if done >= mark or done >= 1.0:
                with torch.no_grad():
                    gap = gaps(network, test).numpy()
                median, p95, p99 = np.percentile(gap, [50, 95, 99])
                curve.append((step, time.perf_counter() - started, float(median), float(p95), float(p99)))
                bar.update(task, note=f"held-out gap {median:.1e} median, {p99:.1e} p99")
                mark += 0.05
            if done >= 1.0:
                return curve, step
            for group in optimiser.param_groups:
                group["lr"] = config.learning_rate * _schedule(done)
            index = torch.from_numpy(next(indices))
            gap = gaps(network, tuple(column[index] for column in train))
            # the root keeps the few hard wrenches from drowning the rest, and its derivative bounded
            loss = (gap + 1e-6).sqrt().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            step += 1
            done = step / config.steps if config.steps else (time.perf_counter() - started) / config.seconds
            bar.update(task, completed=min(1.0, done))


def _schedule(done: float) -> float:
    """Warm-up over 3 %, then a cosine to zero."""
    warm = 0.03
    return done / warm + 1e-3 if done < warm else 0.5 * (1.0 + np.cos(np.pi * (done - warm) / (1.0 - warm))) + 1e-4


def _card(
    config: FitConfig,
    grasp: Grasp,
    command: str,
    steps: int,
    prepared: float,
    total: float,
    curve: list[tuple[float, ...]],
) -> dict[str, Any]:
    _, _, median, p95, p99 = curve[-1]
    return {
        "what": "initial grasp force from wrench and friction, for the reduced gradient flow",
        "grasp": {"preset": config.preset, "positions": grasp.positions.tolist(), "normals": grasp.normals.tolist()},
        "data": f"{config.samples} generated wrenches, labelled by Newton to a relative gap of 1e-10; 4000 others held out",
        "command": command,
        "config": asdict(config),
        "optimisation_steps": steps,
        "seconds": {"data": round(prepared, 1), "total": round(total, 1)},
        "machine": f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} torch threads, no GPU",
        "versions": {name: version(name) for name in ("torch", "numpy", "numba")},
        "held_out_gap_second_order": {"median": median, "p95": p95, "p99": p99},
        "limits": "one grasp (small displacements of its contacts only), the ranges above; everything else through the repair",
    }
