"""Which episodes tell the hold rates: scenarios, controllers, what is swept. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

NO_START = "no_start"
"""Failure of a trial whose grasp did not close or settle: it counts as an episode that was not held."""
NOT_PLACED = "not_placed"
"""Failure of one for which no place of the hand or of its fingers was found."""
NOT_STARTED = (NO_START, NOT_PLACED)

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
_ERROR_LABELS = {
    "friction": f"friction over-estimated by {100 * ALL_ERRORS['friction_error']:g} %",
    "delay": f"everything measured {1e3 * ALL_ERRORS['sensor_delay']:g} ms late",
    "tactile": f"tactile noise {100 * ALL_ERRORS['tactile_noise']:g} %",
    "force": f"motor torque noise {100 * ALL_ERRORS['force_noise']:g} %",
}
SCENARIO_LABELS = {
    "objects": "random objects, random wrench",
    "six_directions": "random objects, six pushes of 10 N/kg, 2 s each",
    "path_0.25": "0.1 m cuboid, W_ext(t) x 0.25",
    "path_1": "0.1 m cuboid, W_ext(t) x 1",
    **_ERROR_LABELS,
    "mild": f"{_ERROR_LABELS['friction']}, {_ERROR_LABELS['force']}, no delay",
    "all": "all four errors",
}
RANDOM_WRENCH: dict[str, Any] = {
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
    cells = [Cell("objects", key, episodes, {**RANDOM_WRENCH, **own}) for key, own in CONTROLLERS.items()]
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
            cells.append(Cell(error, key, robust, {**RANDOM_WRENCH, **own, **wrong, **start}))
    margins, squeezes = ((0.6, 0.85), (20.0, 60.0)) if quick else (MARGINS, SQUEEZES)
    for scenario, wrong in CURVES.items():
        for key, own in CONTROLLERS.items():
            name, values = ("squeeze", squeezes) if key in BASELINES else ("friction_margin", margins)
            number = robust if key == "paper" else min(robust, 60)
            cells += [
                Cell(scenario, key, number, {**RANDOM_WRENCH, **own, **wrong, name: value}, swept=value)
                for value in values
                if key != "estimated"
            ]
    return cells
