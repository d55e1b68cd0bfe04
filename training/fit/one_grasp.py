"""Training of the initial-force network of one grasp on generated optima, with its model card."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env._extras import need
from grasp_env._files import digest

with need("train"):
    import torch
    from torch import Tensor

from grasp_env.force import Objective
from grasp_env.grasp import Grasp
from grasp_env.grasp.null_space import reference_basis
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS
from policies.checkpoint import Checkpoint
from policies.features import Features, surface_pairs
from policies.learned import LearnedInitialForce
from policies.network import Network
from training.data.one_grasp import BALL, LABEL_GAP, Dataset, Source, label, with_mean_friction
from training.fit.loop import PARTS, Plan, optimise
from training.fit.scores import scores
from training.fit.settings import FitConfig
from training.fit.state import Progress, StateFile
from training.results import provenance
from training.results.words import small

FRICTIONS, AT_ONCE = 256, 16
"""Numbers of frictions in the data and in a batch; the network has separate weights for each friction."""
HELD_OUT, HELD_OUT_SEED = 4096, 77_777
"""Number and seed of the held-out wrenches, the same for every training, so that trainings can be compared."""
FLOOR = 1e-6
"""Gap below which a smaller one gains nothing."""
PERCENTILES = (50, 95, 99)
MOST_NUMBERS = 60_000_000
"""Largest number of floats in the samples, 240 MB; it reduces the number of samples for many contacts."""
Samples = tuple[Tensor, Tensor, Tensor]
"""Features (F, B, inputs), R m (F, B, K, K) and R z* (F, B, K), friction by friction; with the network's output y the gap to second
order is |R m y - R z*|^2."""


@dataclass(frozen=True)
class FitResult:
    """Checkpoint, and learning curve with rows (step, seconds, median, p95, p99 of the gap on the ball and on the range)."""

    checkpoint: Checkpoint
    curve: np.ndarray


class NetworkTask:
    """Regression of the optimum: the loss is the mean of a small power of the gap of Phi, to second order.

    Args:
        config: settings of the batches and the loss.
        module: the network.
        train: training samples.
        held_out: samples of each held-out set.
    """

    def __init__(self, config: FitConfig, module: Network, train: Samples, held_out: tuple[Samples, ...]) -> None:
        self.module = module
        self._config, self._train, self._held_out = config, train, held_out

    def batch(self, rng: np.random.Generator) -> list[Samples]:
        """See `loop.Task`."""
        (frictions, each), size = self._train[0].shape[:2], self._config.batch_size // AT_ONCE
        # one friction from each part of the range: the gradient of the polynomials varies less between batches
        chosen = ((np.arange(AT_ONCE) + rng.random(AT_ONCE)) * (frictions / AT_ONCE)).astype(int)
        begin = rng.integers(0, each - size + 1, AT_ONCE)
        places = [
            [(k, slice(b, b + size)) for k, b in zip(chosen, begin, strict=True)][part::PARTS] for part in range(PARTS)
        ]
        return [tuple(torch.stack([all_[at] for at in part]) for all_ in self._train) for part in places]  # type: ignore[misc]

    def loss(self, part: Samples) -> Tensor:
        """See `loop.Task`."""
        # the small power keeps few hard wrenches from dominating the loss; the constant bounds its derivative
        return (gaps(self.module, part) + FLOOR).pow(self._config.tail).mean()

    @torch.no_grad()
    def score(self) -> list[float]:
        """Return percentiles of the gap to second order on each held-out set."""
        found = (gaps(self.module, each).numpy() for each in self._held_out)
        return [float(value) for gap in found for value in np.percentile(gap, PERCENTILES)]

    def note(self, row: list[float]) -> str:
        """See `loop.Task`."""
        ball, whole = (" ".join(f"{value:.0e}" for value in part) for part in (row[:3], row[3:]))
        return f"gaps, median p95 p99: ball {ball}, all {whole}"


def gaps(network: Network, samples: Samples) -> Tensor:
    """Return the relative gap of Phi (F * B,), to second order."""
    inputs, metric, goal = samples
    size = goal.shape[-1]
    outputs = network(inputs).reshape(-1, size, 1)
    return (
        torch.baddbmm(goal.reshape(-1, size, 1), metric.reshape(-1, size, size), outputs, beta=-1).square().sum((1, 2))
    )


def samples_of(data: Dataset, grasp: Grasp, features: Features, pairs: np.ndarray, frictions: int) -> Samples:
    """Return the network's samples of labelled data, which must be ordered friction by friction."""
    inputs, scale = features(data.wrenches @ grasp.unit_frame.T, data.friction, pairs)
    columns = inputs, data.metric * scale[:, None, None], np.einsum("bij,bj->bi", data.metric, data.coordinates)
    return tuple(  # type: ignore[return-value]
        torch.from_numpy(column.astype(np.float32).reshape(frictions, -1, *column.shape[1:])) for column in columns
    )


def fit(
    config: FitConfig,
    progress: bool = False,
    command: str = "training.fit.one_grasp.fit",
    out: Path | None = None,
    resume: bool = False,
) -> FitResult:
    """Train on the second-order relative gap of Phi and return the model with its model card.

    Args:
        config: all settings.
        progress: show the progress on stderr.
        command: command recorded in the model card.
        out: stem of the model's files, beside which an interrupted training is kept; None: it is not kept.
        resume: continue an interrupted training.

    Raises:
        InvalidInputError: before any work, if `out` cannot be written or holds another training.
        KeyboardInterrupt: interrupted; the training so far is kept.
    """
    config, grasp = config.resolved(), config.contacts()
    magnitudes, friction = (config.low, config.high), (config.friction_low, config.friction_high)
    source = Source(grasp, magnitudes, friction, paper=config.grasp is None)
    contacts = digest(*(array.tobytes() for array in (grasp.positions, grasp.normals, grasp.models.friction)))
    state = StateFile.begin(out, {**asdict(config), "grasp": contacts}, resume)
    torch.set_num_threads(1)
    reference = reference_basis(grasp)
    features = Features(friction_mean=sum(friction) / 2, friction_scale=(friction[1] - friction[0]) / 3)
    objective = Objective(config.force_weight, config.barrier_weight)
    pairs = surface_pairs(with_mean_friction(grasp, features.friction_mean), objective)
    rng, held_out_rng = np.random.default_rng([config.seed, 0]), np.random.default_rng([HELD_OUT_SEED, 1])

    def labelled(generator: np.random.Generator, count: int, groups: int, **keywords: float) -> Samples:
        drawn = source.draw(generator, count, groups, **keywords)
        return samples_of(label(grasp, reference, objective, *drawn, config.threads), grasp, features, pairs, groups)

    inputs, outputs = core.PLAIN_FEATURES + len(pairs) // 2, reference.shape[1]
    count = max(2 * config.batch_size, min(config.samples, MOST_NUMBERS // (inputs + outputs * (outputs + 1))))
    # every friction has at least the samples that a batch takes of it
    train = labelled(rng, count, min(FRICTIONS, AT_ONCE * count // config.batch_size))
    held_out = tuple(labelled(held_out_rng, HELD_OUT, min(FRICTIONS, HELD_OUT), ball=ball) for ball in (1.0, 0.0))
    torch.manual_seed(config.seed)
    network = Network(inputs, config.hidden, outputs, config.degree)
    name = config.preset if config.grasp is None else Path(config.grasp).name
    words = f"fit {name}{' (quick)' if config.quick else ''}" if progress else ""
    plan = Plan(config.seconds, config.steps, config.learning_rate, config.seed, config.threads, state, resume, words)
    now = optimise(NetworkTask(config, network, train, held_out), plan)
    checkpoint = Checkpoint(
        tensors={
            **{name: np.ascontiguousarray(value) for name, value in network.tensors().items()},
            "reference": reference,
            "pairs": pairs,
        },
        numbers={
            "sizes": [inputs, *config.hidden, outputs],
            "friction_degree": config.degree,
            "features": asdict(features),
            "n_contacts": grasp.n_contacts,
            "force_weight": config.force_weight,
            "barrier_weight": config.barrier_weight,
        },
        ranges={"magnitude": magnitudes, "friction": friction},
        card=_card(config, grasp, count, command, now),
    )
    model, ball = LearnedInitialForce(checkpoint), source.ball(held_out_rng, HELD_OUT)
    nominal = np.full(HELD_OUT, float(grasp.friction.mean()))
    checkpoint.card["held_out_gap"] = {
        "ball": scores(model, grasp, ball, held_out_rng.uniform(*friction, HELD_OUT), flow=True),
        "range": scores(model, grasp, *source.draw(held_out_rng, HELD_OUT, HELD_OUT, 0.0)),
        "ball, friction of the grasp": scores(model, grasp, ball, nominal, flow=True),
    }
    return FitResult(checkpoint, np.array(now.curve))


def _card(config: FitConfig, grasp: Grasp, count: int, command: str, now: Progress) -> dict[str, Any]:
    made, columns = provenance(), [f"{which} p{p}" for which in ("ball", "range") for p in PERCENTILES]
    named = {"preset": config.preset} if config.grasp is None else {"file": Path(config.grasp).name}
    contacts = {"positions": grasp.positions, "normals": grasp.normals, "friction": grasp.models.friction}
    moment = f"{MOMENT_RADIUS:g} N m about the origin"
    if config.grasp is not None:
        moment = f"1 N times {1e3 * grasp.length:.3g} mm about the contacts' centre"
    return {
        "quick": config.quick,
        "what": "initial grasp force of one grasp, from wrench and friction",
        "grasp": {**named, **{name: array.tolist() for name, array in contacts.items()}},
        "data": f"{count} generated wrenches, {100 * BALL:g} % of them from a ball (force {FORCE_RADIUS:g} N, moment {moment}), "
        f"labelled by Newton to a relative gap of {small(LABEL_GAP)}; others held out",
        "command": command,
        "config": asdict(config) | named,
        "optimisation_steps": now.step,
        "seconds": round(now.seconds, 1),
        "cpu_seconds": round(now.cpu_seconds, 1),
        "time": made["time"],
        "machine": made["machine"] | {"threads": config.threads, "gpu": False},
        "versions": {name: made["versions"][name] for name in ("torch", "numpy")},
        "curve": {
            "columns": ["step", "seconds", *columns],
            "rows": [" ".join(f"{value:.3g}" for value in row) for row in now.curve],
        },
        "limits": "one grasp (small displacements of its contacts only), the ranges above; everything else through the repair",
    }
