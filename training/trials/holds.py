"""Episodes for the hold rates: what one episode leaves behind. A trial depends on its cell and seed alone."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from itertools import chain
from typing import Any

import numpy as np
from rich.console import Console

from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError, InvalidInputError, SimulationError
from grasp_env.sim import HandKinematics, ObjectDescription
from grasp_env.sim.engine import engine_of
from grasp_env.sim.grasping.points import grasp_points
from grasp_env.sim.hand.description import HANDS, HandDescription
from grasp_env.sim.objects.description import random_object
from training.data.episodes import episode
from training.runs import Run
from training.runs.workers import Job, progress, run_jobs
from training.trials.hold_plan import NO_START, NOT_PLACED, Cell

_REDRAWS = 100
_BEFORE, _IN_PLACE = 25, 1e-3
"""Agent steps before an object is lost, and how far it has drifted [m], in which torques that were cut are the cause."""


def draw_object(seed: int, config: EnvConfig) -> tuple[ObjectDescription, np.ndarray, int]:
    """The random object of a seed: any shape, size, mass and friction of the config's ranges, that the hand can reach.

    Returns:
        The object, its contact points (N, 3) [m], object frame, and how many objects drawn before it no grasp was found for.
        None of it depends on the controller or the engine. No points for a hand without a place of its own, which goes to every
        object anew.
    """
    rng, kinematics = np.random.default_rng([seed, 0x0B1EC7]), _kinematics(config.hand)
    for redrawn in range(_REDRAWS):
        item = random_object(rng, size=config.size_range, mass=config.mass_range, friction=config.friction_range)
        if not kinematics.hand.placed:
            return item, np.zeros((0, 3)), 0
        try:
            return item, np.asarray(grasp_points(item, kinematics)[0]), redrawn
        except GraspError:
            continue
    raise SimulationError(f"no grasp was found for any of {_REDRAWS} random objects of seed {seed}")


def run_trial(settings: dict[str, Any], random_objects: bool, seed: int) -> dict[str, Any]:
    """One episode in an environment of its own; the seed gives the object and everything random of the episode.

    Returns:
        The columns of `columns`: plain numbers and strings, taken at the agent's rate; nan for what never came about.
    """
    config, redrawn = settings_of(settings), 0
    if random_objects:
        item, points, redrawn = draw_object(seed, config)
        config = config.override(
            shape=item.shape, size=item.size, object_mass=item.mass, friction=item.friction,
            contact_points=tuple(map(tuple, points.tolist())),
        )  # fmt: skip
    row: dict[str, Any] = {"seed": seed, "redrawn": redrawn, **_object_columns(config)}
    try:
        env = FourFingerGrasp(config=config)
    except GraspError as error:
        return {**row, **_summary([], NOT_PLACED if isinstance(error, InvalidInputError) else NO_START, str(error))}
    try:
        infos = [step.info for step in episode(env, seed)]
        return {**row, **_object_columns(config, infos[0]), **_summary(infos, str(infos[-1]["failure"]), "")}
    finally:
        env.close()


def settings_of(settings: dict[str, Any]) -> EnvConfig:
    """The environment's settings of a plan: "hand" may be the path of a URDF, "engine_settings" are the engine's own."""
    made = dict(settings)
    if "hand" in made:
        made["hand"] = _hand(made["hand"])
    own = made.pop("engine_settings", None)
    if own is not None:
        made["engine"] = replace(engine_of(made["engine"]), **own)
    return EnvConfig().override(**made)


def torque_limit() -> float:
    """The least that a joint of the hand of these episodes can give [N m]."""
    return float(HANDS["four_finger"]().torque_limits.min())


def run_chunk(cell: dict[str, Any], seeds: list[int]) -> list[dict[str, Any]]:
    """The trials of some seeds, for a worker process."""
    return [run_trial(cell["settings"], cell["random_objects"], seed) for seed in seeds]


def roll_out(
    run: Run, parts: Sequence[Any], chunk: int, work: Callable[..., Any], config: Any, console: Console
) -> None:
    """What is not there yet of a plan, over spawned workers: a file trials/<name> for each part, kept as it is done.

    Args:
        run: receives the files.
        parts: dataclasses with a name and a number of episodes, whose seeds are config.seed, config.seed + 1, ...
        chunk: seeds that a worker is given at a time.
        work: (part as a dictionary, seeds) to rows of `run_trial`.
        config: seed and workers.
        console: for the progress.
    """
    jobs = []
    for part in parts:
        seeds = range(config.seed, config.seed + part.episodes)
        calls = [(work, (asdict(part), list(seeds[k : k + chunk]))) for k in range(0, len(seeds), chunk)]
        jobs.append(Job(f"trials/{part.name}", calls, lambda rows: columns(list(chain.from_iterable(rows)))))
    left = [job for job in jobs if not job.done(run)]
    with progress(console) as bar:
        task = bar.add_task("episodes", total=sum(len(job.calls) for job in left))
        for job, _ in run_jobs(run, left, config.workers):
            bar.update(task, advance=1, description=f"{job}, {chunk} seeds at a time")


def columns(rows: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """(n,) arrays by name, from the rows of `run_trial`."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def cell_json(cell: Cell) -> dict[str, Any]:
    """The cell as saved, with its name and the settings that its episodes resolve to."""
    resolved = asdict(replace(EnvConfig().override(**cell.settings).resolved(), hand="four_finger"))
    return {"name": cell.name, **asdict(cell), "resolved": resolved}


def _object_columns(config: EnvConfig, info: dict[str, Any] | None = None) -> dict[str, Any]:
    size = [*config.size, 0.0, 0.0, 0.0][:3]
    return {
        "shape": info["object_shape"] if info else config.shape,
        "size_x": size[0],
        "size_y": size[1],
        "size_z": size[2],
        "mass": info["object_mass"] if info else config.object_mass,
        "friction": info["object_friction"] if info else config.friction,
    }


def _summary(steps: list[dict[str, Any]], failure: str, detail: str) -> dict[str, Any]:
    """What an episode comes to; `failure` is "" where the object was held to the end."""
    if not steps:
        gone = dict.fromkeys(_NUMBERS, float("nan"))
        return {"failure": failure, "detail": detail, "status": "none", "held": False, **gone, "time": 0.0}
    last = steps[-1]
    drift = np.array([info["drift"] for info in steps])
    measured = np.array([info["measured_force"][:, 0].sum() for info in steps])
    commanded = np.array([info["commanded_force"][:, 0].sum() for info in steps])
    values = (
        last["time"], drift.mean(), drift.max(), drift[-1], max(info["tilt"] for info in steps), last["tilt"],
        last["slip_distance"], measured.mean(), measured.max(), commanded.mean(), last["peak_torque"],
        np.mean([info["iterations"] for info in steps]), last["contacts"], int(last["touching"].sum()),
        last["contact_changes"], max(info["stray_force"] for info in steps), np.mean([info["force_error"] for info in steps]),
        min(info["torque_margin"] for info in steps), sum(info["limited"] for info in steps),
        np.mean([info["saturated"] for info in steps]), any(info["saturated"] and info["drift"] < _IN_PLACE for info in steps[-_BEFORE:]),
    )  # fmt: skip
    numbers = dict(zip(_NUMBERS, map(float, values), strict=True))
    held = bool(last["is_success"]) and not failure
    return {"failure": failure, "detail": detail, "status": str(last["status"]), "held": held, **numbers}


_NUMBERS = (
    "time", "mean_drift", "max_drift", "end_drift", "max_tilt", "end_tilt", "slip_distance", "normal_force",
    "max_normal_force", "commanded_normal", "peak_torque", "iterations", "contacts", "touching", "contact_changes",
    "stray_force", "force_error", "torque_margin", "limited", "saturated", "cut_in_place",
)  # fmt: skip


@functools.cache
def _kinematics(hand: str | HandDescription) -> HandKinematics:
    return HandKinematics(hand if isinstance(hand, HandDescription) else HANDS[hand]())


@functools.cache
def _hand(name: str) -> str | HandDescription:
    """A hand's name, or the description of one in a file; what was repaired was told when the settings were checked."""
    if not name.endswith(".urdf"):
        return name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return HandDescription.from_urdf(name)
