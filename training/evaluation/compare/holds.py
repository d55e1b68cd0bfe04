"""Hold rates: episodes of the simulated hand, one row each.

An episode depends on its scenario and seed alone, so everything compared uses the same seeds.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from rich.console import Console

from grasp_env.config import EnvConfig
from grasp_env.config.randomize import OBJECT as RANDOM_OBJECT
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError, GraspWarning, InvalidInputError, SimulationError
from grasp_env.force.initial import InitialForceRule
from grasp_env.inputs.arguments import AllFaults, choice
from grasp_env.sim import HandKinematics, ObjectDescription
from grasp_env.sim.engine import class_of, engine_of
from grasp_env.sim.grasping.pads import with_soft_contacts
from grasp_env.sim.grasping.points import FRICTION_MARGIN, grasp_points
from grasp_env.sim.hand.description import HANDS, HandDescription
from training.data.episodes import episode
from training.evaluation.compare import errors, scenarios, soft_tips
from training.evaluation.compare.errors import Stage
from training.evaluation.compare.scenarios import (
    ENGINES,
    HOLDS_OF_STARTS,
    RANDOM_STARTS,
    RATES,
    Scenario,
    mesh_settings,
    short_name,
)
from training.evaluation.results.run import Run, check_counts
from training.evaluation.results.shards import map_shards
from training.evaluation.results.table import join, pd, summary, table

NO_START, NOT_PLACED = "no_start", "not_placed"
"""Failures: the grasp did not close or settle; no pose of hand or fingers was found."""
USUAL_EPISODES = {
    "env": 500,
    "hands": 100,
    "objects": 10,
    "transfer": 300,
    "soft": 200,
    "errors": 100,
}
QUICK_EPISODES = {"env": 4, "hands": 2, "objects": 2, "transfer": 2, "soft": 4, "errors": 1}
_CHUNK = 4
"""Number of seeds in a shard."""
_REDRAWS = 100
_BEFORE, _IN_PLACE = 25, 1e-3
"""Last agent steps, and drift [m], in which a cut torque counts as the cause of the loss."""
_TIMED, _ROUNDS = 100, 3
"""Number of agent steps whose rate is measured, and of repetitions."""
Shard = tuple[Scenario, Sequence[int]]
"""A scenario and some of its seeds, for a worker."""


@dataclass(frozen=True)
class HoldsConfig:
    """Settings of a comparison of hold rates.

    Attributes:
        kind: "env" (controllers of the four-finger hand), "hands" (hands against objects and
            disturbances), "objects" (the same with objects from mesh files), "transfer" (the same
            hands in both engines), "soft" (soft fingertips in both engines) or "errors" (controllers
            under errors of a real hand).
        hands, engines, episodes, objects, seed, tuning, quick: the options of `grasp evaluate`.
    """

    kind: str = "env"
    hands: tuple[str, ...] = ()
    engines: tuple[str, ...] = ()
    episodes: int = 0
    seed: int = 0
    quick: bool = False
    objects: tuple[str, ...] = ()
    tuning: int = 0

    def __post_init__(self) -> None:
        hint = ", or the path of a URDF, xacro or MJCF file that exists"
        with AllFaults() as check:
            check(check_counts, self, {"episodes": 0, "seed": 0, "tuning": 0})
            for name in self.hands:
                if not os.path.isfile(name):
                    check(choice, name, "hand", HANDS, hint)
            for name in self.engines:
                check(choice, name, "engine", RATES if self.kind == "errors" else ENGINES)
        hands = [short_name(name) for name in self.hands]
        objects = [mesh_settings(text)[0] for text in self.objects]
        for what, names in (("hands", hands), ("objects", objects)):
            if len(set(names)) < len(names):
                raise InvalidInputError(
                    f"{what} need different names, got {', '.join(names)}: rename a file"
                )
        if self.kind in ("hands", "objects") and not self.hands:
            raise InvalidInputError("name at least one hand, got none")

    def stages(self) -> list[Stage]:
        """Return the plans that follow each other; most kinds have one."""
        if self.kind != "errors":
            plan = self.plan()
            return [lambda rows: plan]
        hands = scenarios.PRESETS[:1] if self.quick else scenarios.PRESETS
        engines = self.engines or scenarios.BOTH
        tuning = self._episodes if self.quick else self.tuning or USUAL_EPISODES[self.kind]
        return errors.Errors(self.hands or hands, engines, tuning, self._episodes).stages()

    @property
    def _episodes(self) -> int:
        usual = USUAL_EPISODES[self.kind]
        return QUICK_EPISODES[self.kind] if self.quick else self.episodes or usual

    def plan(self) -> list[Scenario]:
        """Return the scenarios, of errors those of the tuning."""
        if self.kind == "errors":
            return self.stages()[0](table([]))
        episodes = self._episodes
        if self.kind == "env":
            return scenarios.controllers_plan(episodes, self.quick)
        if self.kind in ("hands", "objects"):
            engines = self.engines or scenarios.usual_engines()
            return scenarios.hands_plan(self.hands, engines, episodes, self.objects)
        if self.kind == "soft":
            return scenarios.soft_plan(episodes)
        return scenarios.transfer_plan(self.hands or scenarios.PRESETS, episodes)


def run(
    config: HoldsConfig,
    folder: Run | None = None,
    plan: Sequence[Scenario] | None = None,
    *,
    on: str = "processes",
    workers: int = 0,
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Play the episodes; return their rows, and the settings for run.json.

    `folder` keeps finished shards, `plan` replaces the scenarios of the config; for `on` and
    `workers` see `map_shards`.
    """
    for name in config.hands:
        if name not in HANDS:
            _print_repairs(lambda name=name: HandDescription.from_file(name))
    for text in config.objects:  # cut into convex pieces once, here
        _print_repairs(lambda text=text: ObjectDescription(**mesh_settings(text)[1]["object"]))
    keep = folder and folder.shards
    tables, maps, played = list[pd.DataFrame](), list[dict[str, Any]](), list[Scenario]()
    for stage in config.stages() if plan is None else [lambda rows: list(plan)]:
        following = stage(join(tables))
        shards = _shards(following, config.seed)
        rows, mapped = map_shards(work, shards, on=on, workers=workers, keep=keep, label="episodes")
        tables.append(rows)
        maps.append(mapped)
        played += following
    rows = join(tables)
    seconds = {name: sum(each[name] for each in maps) for name in ("wall_seconds", "cpu_seconds")}
    about = {
        "kind": config.kind,
        "settings": asdict(config),
        "quick": config.quick,
        "scenarios": [asdict(scenario) for scenario in played],
        "steps_per_second": _speeds(played),
        "map": {**maps[0], **seconds},
    }
    if config.kind == "errors":
        about["chosen"] = errors.named(errors.choices(summary(rows)))
    return rows, about


def _shards(plan: Sequence[Scenario], seed: int) -> dict[str, Shard]:
    """Return the shards of scenarios, after a check that their engines are installed."""
    for name in {ENGINES[engine]["engine"]["name"] for one in plan for engine in one.engines}:
        class_of(engine_of(name), "simulator")  # reports a missing engine here, not in the workers
    shards: dict[str, Shard] = {}
    for scenario in plan:
        first = seed + scenario.skipped
        seeds = range(first, first + scenario.episodes)
        for k in range(0, len(seeds), _CHUNK):
            shards[f"{scenario.name}/{k:05d}"] = scenario, seeds[k : k + _CHUNK]
    return shards


def work(shard: Shard) -> pd.DataFrame:
    """Return the rows of a shard; this runs in a worker.

    A seed runs in all engines before the next seed.
    """
    scenario, seeds = shard
    return table(
        {
            **scenario.keys,
            "case": scenario.case,
            "engine": engine,
            "seed": seed,
            **trial(
                {**ENGINES[engine], **scenario.settings},
                scenario.random_objects,
                seed,
                soft=scenario.soft,
                same_grasp=scenario.same_grasp,
            ),
        }
        for seed in seeds
        for engine in scenario.engines
    )


def hold_of_start(
    scenario: str, start: str, rule: str | InitialForceRule, episodes: int, seed: int, steps: int
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a scenario's roll-outs from a start, one if it is deterministic."""
    settings = {**HOLDS_OF_STARTS[scenario], "duration": steps / 50}
    for k in range(episodes if scenario in RANDOM_STARTS else 1):
        keys = {
            "case": f"hold_{scenario}",
            "start": start,
            "method": "reduced_flow",
            "seed": seed + k,
            "problem": k,
        }
        yield {**keys, **trial(settings, False, seed + k, rule)}


def trial(
    settings: dict[str, Any],
    random_objects: bool,
    seed: int,
    rule: str | InitialForceRule | None = None,
    soft: bool = False,
    same_grasp: float | None = None,
) -> dict[str, Any]:
    """Play one episode in a new environment (see `settings_of`) and return its columns.

    With `random_objects` the seed draws the object, too, and with `soft` the load on soft
    fingertips. `rule` is the start of the optimisations; None: the environment's own. For
    `same_grasp` see `Scenario`.
    """
    config = settings_of(settings)
    redrawn = 0
    if same_grasp is not None:
        config, redrawn = draw_grasp(seed, config, same_grasp)
    elif random_objects:
        item, points, redrawn = draw_object(
            seed, config, config.controller.friction_margin if soft else FRICTION_MARGIN
        )
        config = config.override(object=item, contact_points=points, randomize=())
    if soft:
        config = soft_tips.with_load(config, seed)
    if rule is not None:
        config = config.override(initial_force=rule)
    row: dict[str, Any] = {"redrawn": redrawn, **_object(config)}
    infos = list[dict[str, Any]]()
    used = list[float]()
    try:
        with warnings.catch_warnings():
            # about the hand's structure, for every episode; the rows show the effect
            warnings.simplefilter("ignore", GraspWarning)
            with closing(FourFingerGrasp(config=config)) as env:
                for step in episode(env, seed):
                    infos.append(step.info)
                    if solution := env.solution:
                        used.append(float(np.nanmax(solution.friction_used)))
    except GraspError as error:
        failure = NOT_PLACED if isinstance(error, InvalidInputError) else NO_START
        lost = {"held": False, "failure": failure, "no_start": True, "status": None}
        return {**row, **lost, "detail": str(error)}
    return {
        **row,
        "no_start": False,
        **_object(config, infos[0]),
        **episode_columns(infos),
        "friction_used": max(used, default=None),
    }


def draw_object(
    seed: int, config: EnvConfig, friction_margin: float = FRICTION_MARGIN
) -> tuple[ObjectDescription, np.ndarray, int]:
    """Draw the random object of a seed within reach of the hand, in the ranges of `randomize`.

    Return the object, its contact points (N, 3) [m] in the object frame, and the number of objects
    drawn before it without a grasp; none of these depends on controller or engine. A hand without
    a fixed pose, which is placed anew for every object, has no points. The points are those of a
    grasp with `friction_margin` of the friction.
    """
    kinematics = _kinematics(config.hand)
    for redrawn, item in enumerate(_objects(seed, config)):
        if not kinematics.hand.placed:
            return item, np.zeros((0, 3)), 0
        try:
            points, _ = grasp_points(item, kinematics, None, friction_margin)
            return item, np.asarray(points), redrawn
        except GraspError:
            continue
    raise SimulationError(f"no grasp was found for any of {_REDRAWS} random objects of seed {seed}")


def draw_grasp(seed: int, config: EnvConfig, friction_margin: float) -> tuple[EnvConfig, int]:
    """Return settings with the random object of a seed, the hand's pose and the contact points.

    Both are those of a grasp with `friction_margin` of the friction, whatever the controller, the
    engine and the errors of `config`. A hand without a fixed pose is placed where it takes hold of
    the object in the default engine, with the default controller. The number is that of objects
    drawn before this one without a grasp.
    """
    if config.hand_description.placed:
        item, points, redrawn = draw_object(seed, config, friction_margin)
        return config.override(object=item, contact_points=points, randomize=()), redrawn
    same, redrawn = _placed(seed, config.hand, config.randomize, friction_margin)
    return config.override(**same, randomize=()), redrawn


@lru_cache(maxsize=512)
def _placed(
    seed: int, hand: str | HandDescription, randomize: tuple[tuple[str, Any], ...], margin: float
) -> tuple[dict[str, Any], int]:
    """Return hand, object and contact points of a hand that is placed; see `draw_grasp`."""
    reference = EnvConfig().override(hand=hand, **{"controller.friction_margin": margin})
    objects = _objects(seed, reference.override(randomize=dict(randomize)))
    for redrawn, item in enumerate(objects):
        with warnings.catch_warnings(), suppress(GraspError):
            warnings.simplefilter("ignore", GraspWarning)  # as in `trial`
            with closing(FourFingerGrasp(config=reference.override(object=item))) as env:
                scene = env.scene.config
            same = {"hand": scene.hand, "object": item, "contact_points": scene.contact_points}
            return same, redrawn
    raise SimulationError(f"no pose was found for any of {_REDRAWS} random objects of seed {seed}")


def _objects(seed: int, config: EnvConfig) -> Iterator[ObjectDescription]:
    """Yield the random objects of a seed, in the ranges of `randomize`."""
    rng = np.random.default_rng([seed, 0x0B1EC7])
    ranges = EnvConfig().override(randomize={**RANDOM_OBJECT, **dict(config.randomize)})
    for _ in range(_REDRAWS):
        yield with_soft_contacts(ranges.drawn(rng).object, config.hand_description)


def settings_of(settings: dict[str, Any]) -> EnvConfig:
    """Return the environment's settings of a scenario; "hand" may be the path of a file."""
    hand = {"hand": _hand(settings["hand"])} if "hand" in settings else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GraspWarning)  # repairs were printed when the run began
        return EnvConfig().override(**{**settings, **hand})


def episode_columns(infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the columns of an episode from the `info` of its steps.

    Drift, tilt and slip are given only if the object was held.
    """
    last = infos[-1]
    held = bool(last["is_success"])
    cut = any(info["saturated"] and info["drift"] < _IN_PLACE for info in infos[-_BEFORE:])
    if_held = {
        "drift": 1e3 * max(info["drift"] for info in infos),
        "tilt": float(np.degrees(max(info["tilt"] for info in infos))),
        "slip": 1e3 * last["slip_distance"],
    }
    columns: dict[str, Callable[[Any], Any]] = {
        "force_error": np.mean,
        "stray_force": max,
        "torque_margin": min,
        "limited": sum,
        "saturated": np.mean,
        "iterations": np.mean,
    }
    numbers = {name: float(over([info[name] for info in infos])) for name, over in columns.items()}
    return {
        "held": held,
        "failure": None if held else "torque" if cut else str(last["fault"]),
        "status": str(last["status"]),
        **(if_held if held else {}),
        **numbers,
        "iterations": round(numbers["iterations"]),
        "limited": round(numbers["limited"]),
        "overlap": 1e3 * last["overlap"],
        "stray_share": float(last["stray_share"]),
        "end_slip": 1e3 * last["slip_distance"],
        "time": float(last["time"]),
        "end_drift": 1e3 * last["drift"],
        "end_tilt": float(np.degrees(last["tilt"])),
        "normal_force": float(np.mean([info["measured_force"][:, 0].sum() for info in infos])),
        "commanded_force": float(np.mean([info["commanded_force"][:, 0].sum() for info in infos])),
        "peak_torque": float(last["peak_torque"]),
        "touching": int(last["touching"].sum()),
        "contact_changes": int(last["contact_changes"]),
        "contact_always": bool(all(info["touching"].all() for info in infos)),
    }


def _object(config: EnvConfig, info: dict[str, Any] | None = None) -> dict[str, Any]:
    item = config.object
    size = [*item.size, None, None, None][:3]
    return {
        "shape": info["object_shape"] if info else item.shape,
        **dict(zip(("size_x", "size_y", "size_z"), size, strict=True)),
        "mass": info["object_mass"] if info else item.mass,
        "friction": info["object_friction"] if info else item.friction,
    }


def _print_repairs(read: Callable[[], Any]) -> None:
    """Print the repairs made in reading a file, once; the workers read it silently.

    Raises:
        InvalidInputError: the file cannot be read.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read()
    for warning in caught:
        Console(stderr=True).print(f"repaired: {warning.message}", highlight=False, soft_wrap=True)


def _speeds(plan: Sequence[Scenario]) -> dict[str, float]:
    """Measure agent steps per second of every hand in every engine: its first scenario's best."""
    first: dict[str, dict[str, Any]] = {}
    for scenario in plan:
        for engine in scenario.engines:
            name = f"{scenario.keys.get('hand', 'four_finger')}, {engine}"
            first.setdefault(name, {**ENGINES[engine], **scenario.settings})
    out: dict[str, float] = {}
    for name, settings in first.items():
        config = settings_of(settings).override(randomize=())
        with warnings.catch_warnings(), suppress(GraspError):
            warnings.simplefilter("ignore", GraspWarning)  # as in `trial`
            with closing(FourFingerGrasp(config=config)) as env:
                for seed in range(_ROUNDS):
                    running = episode(env, seed, most=_TIMED)
                    begun = time.perf_counter()
                    steps = sum(1 for _ in running)
                    out[name] = max(out.get(name, 0.0), steps / (time.perf_counter() - begun))
    return out


@cache
def _kinematics(hand: str | HandDescription) -> HandKinematics:
    return HandKinematics(hand if isinstance(hand, HandDescription) else HANDS[hand]())


@cache
def _hand(name: str) -> str | HandDescription:
    if name in soft_tips.GRIPPERS:
        return soft_tips.GRIPPERS[name]()
    return name if name in HANDS else HandDescription.from_file(name)
