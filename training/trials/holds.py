"""Episodes for the hold rates: which settings, and what one episode leaves behind. A trial depends on its cell and seed alone."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.env import FourFingerGrasp
from grasp_env.errors import GraspError, SimulationError
from grasp_env.sim import HandKinematics, ObjectDescription
from grasp_env.sim.grasp_points import grasp_points
from grasp_env.sim.hand import HANDS
from grasp_env.sim.objects import random_object

NO_START = "no_start"
"""Failure of a trial whose grasp did not close or settle: it counts as an episode that was not held."""
_REDRAWS = 100

CONTROLLERS: dict[str, dict[str, Any]] = {
    "paper": {},
    "estimated": {"wrench": "estimated"},
    "constant_squeeze": {"controller": "constant_squeeze"},
    "pd": {"controller": "pd"},
}
BASELINES = ("constant_squeeze", "pd")
CONTROLLER_LABELS = {
    "paper": "paper's pipeline, wrench measured",
    "estimated": "paper's pipeline, wrench estimated",
    "constant_squeeze": "constant squeeze",
    "pd": "PD only",
}
ERRORS: dict[str, dict[str, Any]] = {
    "friction": {"friction_error": 0.25},
    "delay": {"sensor_delay": 0.010},
    "tactile": {"tactile_noise": 0.05},
    "force": {"force_noise": 0.05},
}
SAFE_START = {"friction_margin": 0.6}
"""Of the baselines where friction is over-estimated: every controller starts from the optimised grasp, which then settles."""
ALL_ERRORS: dict[str, Any] = {name: value for error in ERRORS.values() for name, value in error.items()}
SCENARIO_LABELS = {
    "objects": "random objects, random wrench",
    "six_directions": "random objects, six pushes of 10 N/kg, 2 s each",
    "path_0.25": "0.1 m cuboid, W_ext(t) x 0.25",
    "path_1": "0.1 m cuboid, W_ext(t) x 1",
    "friction": "friction over-estimated by 25 %",
    "delay": "everything measured 10 ms late",
    "tactile": "tactile noise 5 %",
    "force": "motor torque noise 5 %",
    "mild": "friction over-estimated by 25 %, motor torque noise 5 %, no delay",
    "all": "all four errors",
}
_RANDOM_WRENCH: dict[str, Any] = {
    "disturbance": "random", "random_force": 2.0, "random_moment": 0.06, "duration": 4.0,
}  # fmt: skip
CURVES: dict[str, dict[str, Any]] = {
    "mild": {**ERRORS["friction"], **ERRORS["force"], **SAFE_START},
    "all": {**ALL_ERRORS, **SAFE_START},
}
"""Scenarios in which friction margin or squeeze is swept."""
MARGINS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0)
SQUEEZES = (10.0, 20.0, 40.0, 60.0, 80.0, 120.0)


@dataclass(frozen=True)
class Cell:
    """One scenario under one controller.

    Attributes:
        scenario: a key of `SCENARIO_LABELS`.
        controller: a key of `CONTROLLERS`.
        episodes: how many.
        settings: of the environment, JSON-able.
        random_objects: whether each seed draws its object.
        swept: the value of the setting that is swept: [1] friction_margin or [N] squeeze; None where nothing is.
    """

    scenario: str
    controller: str
    episodes: int
    settings: dict[str, Any]
    random_objects: bool = True
    swept: float | None = None

    @property
    def name(self) -> str:
        """Unique in a plan."""
        return f"{self.scenario}/{self.controller}" + ("" if self.swept is None else f"/{self.swept:g}")


def plan(episodes: int, quick: bool = False) -> list[Cell]:
    """All cells: `episodes` of the main ones, fewer of the others.

    At most 100 of each robustness cell (60 where it is swept and not the paper's pipeline), an eighth of the six directions
    where the controller is not the paper's.
    """
    robust, long = (episodes, episodes) if quick else (min(episodes, 100), max(1, episodes // 8))
    cells = [Cell("objects", key, episodes, {**_RANDOM_WRENCH, **own}) for key, own in CONTROLLERS.items()]
    cells += [
        Cell("six_directions", key, episodes if key == "paper" else long, {"task": "six_directions", **own})
        for key, own in CONTROLLERS.items()
    ]
    for scale in (0.25, 1.0):  # nothing is random here: one episode says it all
        path = {"disturbance": "paper_path", "disturbance_scale": scale, "duration": 4.0}
        cells += [Cell(f"path_{scale:g}", key, 1, {**path, **own}, False) for key, own in CONTROLLERS.items()]
    for error, wrong in ERRORS.items():
        for key, own in CONTROLLERS.items():
            start = SAFE_START if error == "friction" and key in BASELINES else {}
            cells.append(Cell(error, key, robust, {**_RANDOM_WRENCH, **own, **wrong, **start}))
    margins, squeezes = ((0.6, 0.85), (20.0, 60.0)) if quick else (MARGINS, SQUEEZES)
    for scenario, wrong in CURVES.items():
        for key, own in CONTROLLERS.items():
            name, values = ("squeeze", squeezes) if key in BASELINES else ("friction_margin", margins)
            number = robust if key == "paper" else min(robust, 60)
            cells += [
                Cell(scenario, key, number, {**_RANDOM_WRENCH, **own, **wrong, name: value}, swept=value)
                for value in values
                if key != "estimated"
            ]
    return cells


def draw_object(seed: int, config: EnvConfig) -> tuple[ObjectDescription, np.ndarray, int]:
    """The random object of a seed: any shape, size, mass and friction of the config's ranges, that the hand can reach.

    Returns:
        The object, its contact points (N, 3) [m], object frame, and how many objects drawn before it no grasp was found for.
        None of it depends on the controller.
    """
    rng, kinematics = np.random.default_rng([seed, 0x0B1EC7]), _kinematics(config.hand)
    for redrawn in range(_REDRAWS):
        item = random_object(rng, size=config.size_range, mass=config.mass_range, friction=config.friction_range)
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
    config, redrawn = EnvConfig().override(**settings), 0
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
        return {**row, **_summary([], NO_START, str(error))}
    try:
        _, info = env.reset(seed=seed)
        row.update(_object_columns(config, info))
        nothing = np.zeros(env.action_space.shape or (1,), dtype=np.float32)
        steps: list[dict[str, Any]] = []
        done = False
        while not done:
            _, _, terminated, truncated, info = env.step(nothing)
            steps.append(info)
            done = terminated or truncated
        return {**row, **_summary(steps, str(info["failure"]), "")}
    finally:
        env.close()


def run_chunk(cell: dict[str, Any], seeds: list[int]) -> list[dict[str, Any]]:
    """The trials of some seeds, for a worker process."""
    return [run_trial(cell["settings"], cell["random_objects"], seed) for seed in seeds]


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
        last["contact_changes"], max(info["stray_force"] for info in steps),
    )  # fmt: skip
    numbers = dict(zip(_NUMBERS, map(float, values), strict=True))
    held = bool(last["is_success"]) and not failure
    return {"failure": failure, "detail": detail, "status": str(last["status"]), "held": held, **numbers}


_NUMBERS = (
    "time", "mean_drift", "max_drift", "end_drift", "max_tilt", "end_tilt", "slip_distance", "normal_force",
    "max_normal_force", "commanded_normal", "peak_torque", "iterations", "contacts", "touching", "contact_changes",
    "stray_force",
)  # fmt: skip


@functools.cache
def _kinematics(hand: str) -> HandKinematics:
    return HandKinematics(HANDS[hand]())
