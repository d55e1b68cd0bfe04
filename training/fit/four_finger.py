"""Fits the initial-force network of one grasp to generated optima, and writes its model card."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._extras import need

with need("train"):
    import torch
    from torch import Tensor

from grasp_env.force import Objective
from grasp_env.grasp import Grasp, presets, reference_basis
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS, sample_ball
from policies.checkpoint import Checkpoint
from policies.features import N_FEATURES, Features
from policies.learned import LearnedInitialForce
from policies.network import Network
from training.data.one_grasp import BALL, LABEL_GAP, Dataset, label, sample
from training.fit.loop import Plan, optimise
from training.fit.scores import scores
from training.fit.settings import FitConfig
from training.fit.state import Progress, StateFile
from training.results import provenance
from training.results.words import small

FRICTIONS, AT_ONCE = 256, 16
"""Different frictions in the data, and in a batch: each has weights of its own."""
HELD_OUT, HELD_OUT_SEED = 4096, 77_777
"""The same held-out wrenches for every training, so that seeds can be compared."""
FLOOR = 1e-6
"""Gaps below count as none."""
PERCENTILES = (50, 95, 99)


@dataclass(frozen=True)
class FitResult:
    """The checkpoint and the learning curve: rows (step, seconds, median, p95, p99 of the gap on the ball and on the range)."""

    checkpoint: Checkpoint
    curve: np.ndarray


class NetworkTask:
    """Mean of a small power of the gap of Phi, to second order.

    Args:
        config: of the batches and the loss.
        module: the network.
        train, held_out: samples by friction, see `tensor_of`.
    """

    def __init__(self, config: FitConfig, module: Network, train: Tensor, held_out: tuple[Tensor, ...]) -> None:
        self.module = module
        self._config, self._train, self._held_out = config, train, held_out

    def loss(self, rng: np.random.Generator) -> Tensor:
        """See `loop.Task`."""
        frictions, each = self._train.shape[:2]
        size = self._config.batch_size // AT_ONCE
        # a friction of every part of the range: what a batch says of the polynomials varies less
        chosen = ((np.arange(AT_ONCE) + rng.random(AT_ONCE)) * (frictions / AT_ONCE)).astype(int)
        begin = rng.integers(0, each - size + 1, AT_ONCE)
        batch = torch.stack([self._train[k, b : b + size] for k, b in zip(chosen, begin, strict=True)])
        # a root keeps the few hard wrenches from drowning the rest, and the constant its derivative bounded
        return (gaps(self.module, batch) + FLOOR).pow(self._config.tail).mean()

    @torch.no_grad()
    def score(self) -> list[float]:
        """Percentiles of the gap to second order on each held-out set."""
        found = (gaps(self.module, each).numpy().reshape(-1) for each in self._held_out)
        return [float(value) for gap in found for value in np.percentile(gap, PERCENTILES)]

    def note(self, row: list[float]) -> str:
        """See `loop.Task`."""
        ball, whole = (" ".join(f"{value:.0e}" for value in part) for part in (row[:3], row[3:]))
        return f"gaps, median p95 p99: ball {ball}, all {whole}"


def gaps(network: Network, samples: Tensor) -> Tensor:
    """(F, B) relative gap of Phi to second order: |R (m y - z*)|^2 with y the network's output."""
    inputs, scale, target, metric = samples.split_with_sizes(_columns(samples.shape[-1]), dim=-1)
    error = network(inputs) * scale - target
    return (metric.unflatten(-1, (target.shape[-1], -1)) * error[..., None, :]).sum(-1).square().sum(-1)


def tensor_of(data: Dataset, features: Features, frictions: int) -> Tensor:
    """(F, B, 8 + 1 + K + K K): features, magnitude, coordinates and metric of samples that lie friction by friction."""
    inputs, scale = features(data.wrenches, data.friction)
    columns = inputs, scale[:, None], data.coordinates, data.metric.reshape(len(data), -1)
    joined = np.concatenate([column.astype(np.float32) for column in columns], axis=1)
    return torch.from_numpy(joined.reshape(frictions, -1, joined.shape[1]))


def _columns(total: int) -> list[int]:
    outputs = next(k for k in range(1, total) if N_FEATURES + 1 + k + k * k == total)
    return [N_FEATURES, 1, outputs, outputs * outputs]


def fit(
    config: FitConfig,
    progress: bool = False,
    command: str = "training.fit.four_finger.fit",
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
    state = StateFile.begin(out, asdict(config), resume)
    torch.set_num_threads(config.threads)
    reference, features = reference_basis(grasp), Features()
    objective = Objective(config.force_weight, config.barrier_weight)
    magnitudes, friction = (config.low, config.high), (config.friction_low, config.friction_high)
    rng, held_out_rng = np.random.default_rng([config.seed, 0]), np.random.default_rng([HELD_OUT_SEED, 1])

    def labelled(source: np.random.Generator, count: int, groups: int, **keywords: float) -> Tensor:
        samples = sample(source, count, magnitudes, friction, groups, **keywords)
        return tensor_of(label(grasp, reference, objective, *samples), features, groups)

    # at least a batch's share of samples for every friction
    train = labelled(rng, config.samples, min(FRICTIONS, AT_ONCE * config.samples // config.batch_size))
    held_out = tuple(labelled(held_out_rng, HELD_OUT, min(FRICTIONS, HELD_OUT), ball=ball) for ball in (1.0, 0.0))
    torch.manual_seed(config.seed)
    network = Network(N_FEATURES, config.hidden, reference.shape[1], config.degree)
    words = f"fit {config.preset}{' (quick)' if config.quick else ''}" if progress else ""
    plan = Plan(config.seconds, config.steps, config.learning_rate, config.seed, state, resume, words)
    now = optimise(NetworkTask(config, network, train, held_out), plan)
    checkpoint = Checkpoint(
        tensors={
            **{name: np.ascontiguousarray(value) for name, value in network.tensors().items()},
            "reference": reference,
        },
        numbers={
            "sizes": [N_FEATURES, *config.hidden, reference.shape[1]],
            "friction_degree": config.degree,
            "features": asdict(features),
            "n_contacts": grasp.n_contacts,
            "force_weight": config.force_weight,
            "barrier_weight": config.barrier_weight,
        },
        ranges={"magnitude": magnitudes, "friction": friction},
        card=_card(config, grasp, command, now),
    )
    model, ball = LearnedInitialForce(checkpoint), sample_ball(held_out_rng, HELD_OUT)
    checkpoint.card["held_out_gap"] = {
        "ball": scores(model, grasp, ball, held_out_rng.uniform(*friction, HELD_OUT)),
        "range": scores(model, grasp, *sample(held_out_rng, HELD_OUT, magnitudes, friction, HELD_OUT, 0.0)),
        "ball, friction of the grasp": scores(model, grasp, ball, np.full(HELD_OUT, grasp.friction[0]), flow=True),
    }
    return FitResult(checkpoint, np.array(now.curve))


def _card(config: FitConfig, grasp: Grasp, command: str, now: Progress) -> dict[str, Any]:
    made, columns = provenance(), [f"{which} p{p}" for which in ("ball", "range") for p in PERCENTILES]
    return {
        "quick": config.quick,
        "what": "initial grasp force of one grasp, from wrench and friction",
        "grasp": {"preset": config.preset, "positions": grasp.positions.tolist(), "normals": grasp.normals.tolist()},
        "data": f"{config.samples} generated wrenches, {100 * BALL:g} % of them from the standard ball (force {FORCE_RADIUS:g} N, moment "
        f"{MOMENT_RADIUS:g} N m), labelled by Newton to a relative gap of {small(LABEL_GAP)}; others held out",
        "command": command,
        "config": asdict(config),
        "optimisation_steps": now.step,
        "seconds": round(now.seconds, 1),
        "cpu_seconds": round(now.cpu_seconds, 1),
        "time": made["time"],
        "machine": made["machine"] | {"torch threads": config.threads, "gpu": False},
        "versions": {name: made["versions"][name] for name in ("torch", "numpy")},
        "curve": {
            "columns": ["step", "seconds", *columns],
            "rows": [" ".join(f"{value:.3g}" for value in row) for row in now.curve],
        },
        "limits": "one grasp (small displacements of its contacts only), the ranges above; everything else through the repair",
    }
