"""Iterations of the flow in an environment, from the starts that a fitted model competes with."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError, GraspWarning, SimulationError
from grasp_env.force.initial import LinearCombination
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import ContactForces, Wrench, warn
from policies import LearnedInitialForce
from training.data.episodes import episode
from training.data.one_grasp import moved
from training.data.played import solving
from training.evaluation.compare.starts import NetworkAlone
from training.fit.scores import quantiles

BASIS, ALONE, REPAIRED, PREVIOUS = "12-basis", "network alone", "network, repaired", "previous"
"""Starts that are compared: the paper's, the network with and without its repair, the last force."""
CASES = ("as fitted", "moved")
"""The contacts that the model was fitted to, and contacts that are moved on the object."""
EPISODES, FIRST_SEED = 5, 3_000_000
"""Number of episodes in each case that score a model, and their first seed."""
_TRIES = 50


def iterations(
    config: EnvConfig,
    model: LearnedInitialForce,
    episodes: int,
    seed: int,
    steps: int = 100,
    cases: Sequence[str] = CASES,
) -> Iterator[dict[str, Any]]:
    """Yield rows of the iterations of each agent step, from all starts in the same episodes.

    Args:
        config: the environment.
        model: the fitted model.
        episodes: number of episodes in each case; with moved contacts each has its own.
        seed: first seed of the episodes.
        steps: largest number of steps of an episode.
        cases: some of `CASES`.

    Raises:
        SimulationError: the hand can hold the object by no moved contacts.
    """
    starts = {
        BASIS: "linear_combination",
        ALONE: _Alone(model),
        REPAIRED: model,
        PREVIOUS: "previous",
    }
    planned = _planned(config)
    for case in cases:
        for number in range(seed, seed + episodes):
            here = config if case == "as fitted" else _moved(planned, number)
            for name, rule in starts.items():
                with warnings.catch_warnings():
                    # about the hand's structure, in every episode
                    warnings.simplefilter("ignore", GraspWarning)
                    with closing(FourFingerGrasp(config=solving(here, rule))) as env:
                        for k, step in enumerate(episode(env, number, most=steps)):
                            yield {
                                "case": case,
                                "start": name,
                                "seed": number,
                                "step": k,
                                "iterations": int(step.info["iterations"]),
                            }


class _Alone(NetworkAlone):
    """The network alone; without a contact that it knows, the 12-basis."""

    def __call__(self, grasp: Grasp, load: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        if grasp.n_contacts != self.model.n_contacts:
            return LinearCombination(self.model.objective)(grasp, load)
        return super().__call__(grasp, load)


def scores_in(config: EnvConfig, model: LearnedInitialForce) -> dict[str, dict[str, Any]]:
    """Return quantiles of the iterations in a few episodes, by case and start.

    A case that cannot be played is missing, with a warning.
    """
    scores: dict[str, dict[str, Any]] = {}
    for case in CASES:
        try:
            rows = list(iterations(config, model, EPISODES, FIRST_SEED, cases=(case,)))
        except SimulationError as error:
            warn(f"contacts {case}: not scored, {error}")
            continue
        counts: dict[str, list[int]] = {}
        for row in rows:
            counts.setdefault(row["start"], []).append(row["iterations"])
        scores[case] = {start: quantiles(np.array(found)) for start, found in counts.items()}
    return scores


def _planned(config: EnvConfig) -> EnvConfig:
    """Return settings with the pose of the hand and the contacts that the environment chooses."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GraspWarning)
        with closing(FourFingerGrasp(config=config)) as env:
            scene = env.scene.config
    return replace(config, hand=scene.hand, contact_points=scene.contact_points, approach=None)


def _moved(planned: EnvConfig, seed: int) -> EnvConfig:
    """Return settings whose contacts are moved on the object so that the hand still holds it.

    Raises:
        SimulationError: no such contacts were found.
    """
    rng = np.random.default_rng([seed, 0x30BED])
    points = np.array(planned.contact_points)
    surface = planned.object.surface
    normals = np.array([surface.nearest(point)[1] for point in points])
    grasp = Grasp.from_contacts(points, normals, planned.object.friction)
    for _ in range(_TRIES):
        there = moved(rng, grasp, surface).positions
        config = replace(planned, contact_points=tuple(map(tuple, there.tolist())))
        try:
            with closing(FourFingerGrasp(config=config)) as env:
                env.reset(seed=seed)
        except GraspError:
            continue
        return config
    raise SimulationError(
        f"the hand could hold the object by none of {_TRIES} sets of moved contacts: give more friction, or contact_points "
        "farther from edges"
    )
