"""Training of the initial-force network of one grasp on generated optima, with its model card."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env.inputs.extras import need
from grasp_env.inputs.files import digest

with need("train"):
    import torch

from grasp_env.force import Objective
from grasp_env.grasp import Grasp
from grasp_env.grasp.null_space import reference_basis
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS
from policies.checkpoint import Checkpoint
from policies.features import Features, surface_pairs
from policies.learned import LearnedInitialForce
from policies.network import Network
from policies.places import Places
from training.data.one_grasp import BALL, LABEL_GAP, MOVED, label, with_mean_friction
from training.evaluation.results import provenance
from training.evaluation.results.words import small
from training.fit.fit_config import FitConfig
from training.fit.loop import AT_ONCE, PERCENTILES, NetworkTask, Samples, optimise
from training.fit.scores import scores
from training.fit.state import FitProgress, StateFile

FRICTIONS, PLACES = 256, 2048
"""Number of frictions in the data, and of grasps if the contacts move."""
HELD_OUT, HELD_OUT_SEED = 4096, 77_777
"""Number and seed of the held-out wrenches, the same for every training."""
MOST_NUMBERS = 60_000_000
"""Largest number of floats in the samples, 240 MB; it limits the samples of many contacts."""


def fit(
    config: FitConfig,
    progress: bool = False,
    command: str = "training.fit.one_grasp.fit",
    out: Path | None = None,
    resume: bool = False,
) -> Checkpoint:
    """Train on the second-order relative gap of Phi and return the model with its model card.

    Args:
        config: all settings.
        progress: show the progress on stderr.
        command: command recorded in the model card.
        out: stem of the model's files, which keeps an interrupted training; None: none is kept.
        resume: continue an interrupted training.

    Raises:
        InvalidInputError: before any work, if `out` cannot be written or holds another training.
        KeyboardInterrupt: interrupted; the training so far is kept.
    """
    config = config.resolved()
    source = config.source()
    grasp, magnitudes, friction = source.grasp, source.magnitudes, source.frictions
    contacts = digest(
        *(array.tobytes() for array in (grasp.positions, grasp.normals, grasp.models.friction))
    )
    state = StateFile.begin(out, {**asdict(config), "grasp": contacts}, resume)
    torch.set_num_threads(1)
    reference = reference_basis(grasp)
    features = Features(
        friction_mean=sum(friction) / 2, friction_scale=(friction[1] - friction[0]) / 3
    )
    objective = Objective(config.force_weight, config.barrier_weight)
    pairs = surface_pairs(with_mean_friction(grasp, features.friction_mean), objective)
    rng = np.random.default_rng([config.seed, 0])
    held_out_rng = np.random.default_rng([HELD_OUT_SEED, 1])

    def labelled(
        generator: np.random.Generator, count: int, groups: int, **keywords: float
    ) -> Samples:
        drawn = source.draw(generator, count, groups, **keywords)
        data = label(drawn, reference, objective, config.threads)
        units = np.array([grasp.unit_frame for grasp in drawn.grasps])
        loads = (drawn.wrenches @ units.mT).reshape(-1, 6)
        shape = drawn.wrenches.shape[:2]
        inputs, scale = features(loads, drawn.friction.repeat(shape[1]), pairs)
        scale = scale.reshape(shape)
        columns = (
            drawn.moves,
            inputs.reshape(*shape, -1),
            data.metric * scale[..., None, None],
            np.einsum("fbij,fbj->fbi", data.metric, data.coordinates),
        )
        return tuple(torch.from_numpy(column.astype(np.float32)) for column in columns)  # type: ignore[return-value]

    inputs = core.PLAIN_FEATURES + len(pairs) // 2
    outputs = reference.shape[1]
    count = max(
        2 * config.batch_size,
        min(config.samples, MOST_NUMBERS // (inputs + outputs * (outputs + 1))),
    )
    # every group has at least the samples that a batch takes of it
    groups = FRICTIONS if source.surface is None else PLACES
    train = labelled(rng, count, min(groups, AT_ONCE * count // config.batch_size))
    held_out = tuple(
        labelled(held_out_rng, HELD_OUT, min(FRICTIONS, HELD_OUT), ball=ball) for ball in (1.0, 0.0)
    )
    torch.manual_seed(config.seed)
    network = Network(inputs, config.hidden, outputs, config.degree, train[0].shape[1])
    name = config.env or (config.preset if config.grasp is None else Path(config.grasp).name)
    words = f"fit {name}{' (quick)' if config.quick else ''}" if progress else ""
    now = optimise(NetworkTask(config, network, train, held_out), state, resume, words)
    checkpoint = Checkpoint(
        tensors={
            **{name: np.ascontiguousarray(value) for name, value in network.tensors().items()},
            "reference": reference,
            "pairs": pairs,
            **({} if source.surface is None else vars(Places.of(grasp, MOVED))),
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
    model = LearnedInitialForce(checkpoint)
    ball = source.ball(held_out_rng, HELD_OUT)
    nominal = np.full(HELD_OUT, float(grasp.friction.mean()))
    loads, frictions = source.loads(held_out_rng, HELD_OUT, HELD_OUT, 0.0)
    checkpoint.card["held_out_gap"] = {
        "ball": scores(model, grasp, ball, held_out_rng.uniform(*friction, HELD_OUT), flow=True),
        "range": scores(model, grasp, loads[:, 0], frictions),
        "ball, friction of the grasp": scores(model, grasp, ball, nominal, flow=True),
    }
    return checkpoint


def _card(
    config: FitConfig, grasp: Grasp, count: int, command: str, now: FitProgress
) -> dict[str, Any]:
    origin = provenance()
    columns = [f"{name} p{p}" for name in ("ball", "range") for p in PERCENTILES]
    contacts = {
        "positions": grasp.positions.tolist(),
        "normals": grasp.normals.tolist(),
        "friction": grasp.models.friction.tolist(),
    }
    source: dict[str, Any] = {"preset": config.preset}
    moment = f"{MOMENT_RADIUS:g} N m about the origin"
    if config.grasp is not None:
        source = {"file": Path(config.grasp).name}
        moment = f"1 N times {1e3 * grasp.length:.3g} mm about the contacts' centre"
    usual = f"a ball (force {FORCE_RADIUS:g} N, moment {moment})"
    if config.env is not None:
        source, usual = {"env": config.env}, "episodes of the environment"
    return {
        "quick": config.quick,
        "what": "initial grasp force of one grasp, from wrench and friction",
        "grasp": {**source, **contacts},
        "data": f"{count} generated wrenches, {100 * BALL:g} % of them from {usual}, "
        f"labelled by Newton to a relative gap of {small(LABEL_GAP)}; others held out",
        "command": command,
        "config": asdict(config) | source,
        "optimisation_steps": now.step,
        "seconds": round(now.seconds, 1),
        "cpu_seconds": round(now.cpu_seconds, 1),
        "time": origin["time"],
        "machine": origin["machine"] | {"threads": config.threads, "gpu": False},
        "versions": {name: origin["versions"][name] for name in ("torch", "numpy")},
        "curve": {
            "columns": ["step", "seconds", *columns],
            "rows": [" ".join(f"{value:.3g}" for value in row) for row in now.curve],
        },
        "limits": "one grasp (small displacements of its contacts only), the ranges above; everything else through the repair",
    }
