"""Scenarios of the hold rates, as data."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from grasp_env.errors import InvalidInputError


def usual_engines() -> tuple[str, ...]:
    """Return the name of the default engine, in a tuple."""
    from grasp_env.sim.engine import engine_of  # needs the extra `sim`, unlike the names below

    return (engine_of().name,)


@dataclass(frozen=True)
class Scenario:
    """Episodes of one kind, played in some engines with the same seeds.

    Attributes:
        case: a key of `LABELS`.
        keys: the other key columns of its rows, such as controller and hand.
        episodes: number of episodes in each engine.
        settings: settings of the environment, JSON-able.
        engines: keys of `ENGINES`; the others are compared with the first.
        random_objects: True if each seed draws its object.
        soft: True if fingertips are soft, and each seed draws a load of shear and torsion, see
            `soft_tips.with_load`.
        same_grasp: share of the friction for which each seed draws object, contact points and pose
            of the hand, the same for every controller and engine; None: the hand is placed anew.
        skipped: number of seeds before its first one.
    """

    case: str
    keys: dict[str, Any]
    episodes: int
    settings: dict[str, Any] = field(default_factory=dict)
    engines: tuple[str, ...] = field(default_factory=usual_engines)
    random_objects: bool = True
    soft: bool = False
    same_grasp: float | None = None
    skipped: int = 0

    @property
    def name(self) -> str:
        """Name that is unique in a plan."""
        keys = (
            f"{value:g}" if isinstance(value, float) else str(value) for value in self.keys.values()
        )
        return "/".join([self.case, *keys])


ENGINES: dict[str, dict[str, Any]] = {
    "bullet": {"engine": {"name": "bullet"}},
    "mujoco": {"engine": {"name": "mujoco"}},
    "faces": {"engine": {"name": "bullet", "mesh_contacts": "faces"}},
    "bullet_1000": {"engine": {"name": "bullet", "rate": 1000}},
    "pyramidal": {"engine": {"name": "mujoco", "cone": "pyramidal"}},
    "soft": {
        "engine": {
            "name": "mujoco",
            "time_constant": 0.02,
            "impedance": (0.9, 0.95, 1e-3, 0.5, 2.0),
            "impratio": 1.0,
        }
    },
    "noslip": {"engine": {"name": "mujoco", "noslip_iterations": 20}},
}
"""Settings of the environment by name of the engine."""
BOTH = ("bullet", "mujoco")
PRESETS = ("four_finger", "allegro", "leap")
"""Default hands of the comparison of engines."""
CONTROLLERS: dict[str, dict[str, Any]] = {
    "paper": {},
    "estimated": {"sensors.wrench": "estimated"},
    "constant_squeeze": {"controller.kind": "constant_squeeze"},
    "pd": {"controller.kind": "pd"},
}
RANDOM_WRENCH: dict[str, Any] = {
    "disturbance": {"name": "random", "force": 2.0, "moment": 0.06},
    "duration": 4.0,
}
WEAK_WRENCH: dict[str, Any] = {
    "disturbance": {"name": "random", "force": 0.6, "moment": 0.02},
    "duration": 4.0,
}
SMALL_OBJECTS: dict[str, Any] = {
    "randomize": {"shape": True, "size": (0.04, 0.08), "mass": (0.05, 0.3), "friction": (0.5, 1.0)}
}
"""Objects for hands of human size."""
OBJECTS: dict[str, dict[str, Any]] = {
    "cube": {"shape": "cuboid", "size": (0.05, 0.05, 0.05), "mass": 0.15, "friction": 0.7},
    "sphere": {"shape": "sphere", "size": (0.06,), "mass": 0.15, "friction": 0.7},
    "random": SMALL_OBJECTS,
}
PUSHES: dict[str, dict[str, Any]] = {
    "gravity": {"disturbance": "none", "duration": 4.0},
    "random": WEAK_WRENCH,
    "six_directions": {"task": "six_directions"},
}
SOFT_HANDS: dict[str, tuple[int, dict[str, Any]]] = {
    "jaws": (2, SMALL_OBJECTS),
    "three_finger": (4, {}),
    "four_finger": (4, {}),
}
"""Hands with soft fingertips: the divisor of the number of episodes, and their own objects."""
SOFT_MARGINS = {"soft": 0.8, "soft_pyramid": 0.5}
"""Friction margins by scenario; MuJoCo's pyramid contains what uses at most 1 / sqrt(3)."""
RATES = {"bullet": 1000, "mujoco": 2000}
"""Engines of the comparison under errors, and their steps per second.

The torque noise lets tips overlap the object in MuJoCo by up to 1.2 mm at 1000 steps per second and
by 0.3 mm at 2000; the limit is 0.5 mm.
"""
CONTROL_RATE = 1000


@dataclass(frozen=True)
class Error:
    """Error of a real hand: a row of the comparison under errors.

    Attributes:
        label: its name in tables.
        settings: settings of the environment.
    """

    label: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class Group:
    """Errors for which a controller has the same settings, because it knows the friction as well.

    Attributes:
        label: its name in tables.
        margin: share of the friction for which grasps are drawn, the same for all controllers.
        errors: the errors by case.
        tuned_on: the hardest of them, on which the settings are chosen.
    """

    label: str
    margin: float
    errors: dict[str, Error]
    tuned_on: tuple[str, ...]


@dataclass(frozen=True)
class Rival:
    """Controller of the comparison under errors.

    Attributes:
        label: its name in tables.
        settings: settings of the environment, whatever the group.
        candidates: settings of the controller that are tried, by group, without `controller.` in
            their names, which are columns. Of a single candidate nothing is chosen.
    """

    label: str
    settings: dict[str, Any]
    candidates: dict[str, tuple[dict[str, float], ...]]


_FRICTION = {"controller.friction_error": 0.25}
_DELAY = {"sensors.delay": 0.010, "sensors.joint_delay": 0.002}
_NOISE = {"motors.noise": 0.05}
_ESTIMATED = {"sensors.wrench": "estimated"}
_FOUR = {**_FRICTION, **_DELAY, **_NOISE, "sensors.tactile_noise": 0.05}
GROUPS: dict[str, Group] = {
    "known_10": Group(
        "friction known, margin for an error of 10 %",
        0.75,
        {
            "none": Error("no error", {}),
            "estimated": Error("wrench estimated", _ESTIMATED),
            "delay": Error("contacts and pose 10 ms late, joints 2 ms", _DELAY),
            "noise": Error("torque noise of 5 %, drawn every 4 ms", _NOISE),
            "drift": Error("torque drift of 5 %, within 0.3 s", {"motors.drift": 0.05}),
            "gain": Error("motor gains off by 5 %", {"motors.gain_error": 0.05}),
            "joint_friction": Error("joint friction of 0.01 N m", {"motors.friction": 0.01}),
        },
        tuned_on=("noise", "drift"),
    ),
    "known_25": Group(
        "friction 25 % too high",
        0.5,
        {
            "friction": Error("friction 25 % too high", _FRICTION),
            "four": Error("friction, delay, torque noise, tactile noise of 5 %", _FOUR),
            "five": Error("the same four, wrench estimated", {**_FOUR, **_ESTIMATED}),
        },
        tuned_on=("five",),
    ),
}
"""Errors of a real hand. To add one, add an entry to its group."""
_SQUEEZES = dict.fromkeys(GROUPS, tuple({"squeeze": force} for force in (10.0, 20.0, 40.0, 80.0)))


def _margins(*pairs: tuple[float, float]) -> tuple[dict[str, float], ...]:
    return tuple({"friction_margin": margin, "preload": preload} for margin, preload in pairs)


ROBUST, EQUAL = "robust", "equal_squeeze"
RIVALS: dict[str, Rival] = {
    ROBUST: Rival(
        "optimised, margin and preload",
        {},
        {
            "known_10": _margins((0.85, 1.0), (0.75, 1.0), (0.65, 1.0), (0.75, 0.5)),
            "known_25": _margins((0.6, 1.0), (0.5, 1.0), (0.45, 1.5), (0.4, 1.0)),
        },
    ),
    EQUAL: Rival("constant squeeze, same force", {"controller.kind": "constant_squeeze"}, {}),
    "constant_squeeze": Rival(
        "constant squeeze", {"controller.kind": "constant_squeeze"}, _SQUEEZES
    ),
    "pd": Rival("PD only", {"controller.kind": "pd"}, _SQUEEZES),
    "paper": Rival(
        "optimised, margin 0.85",
        {"controller.friction_margin": 0.85},
        dict.fromkeys(GROUPS, ({},)),
    ),
}
"""Controllers that are compared under errors. To add one, add an entry.

`EQUAL` has no candidates: in every row its squeeze is the mean commanded normal force of `ROBUST`.
"""
PATH_SCALE = 0.1
"""Scale of W_ext(t) in the roll-outs of starts."""
HOLDS_OF_STARTS: dict[str, dict[str, Any]] = {
    "gravity": {"disturbance": "none"},
    "constant": {"disturbance": "constant"},
    "paper_path": {"disturbance": {"name": "paper_path", "scale": PATH_SCALE}},
    "random": {"disturbance": "random"},
    "late": {"disturbance": "random", "sensors.wrench_delay": 1},
    "unknown": {"disturbance": "random", "sensors.wrench": "none"},
    "impulses": {"disturbance": "impulses", "randomize": ("shape", "size", "mass", "friction")},
}
"""Scenarios of the four-finger hand in which starts are compared, as cases hold_<name>."""
RANDOM_STARTS = ("random", "late", "unknown", "impulses")
"""Those of them that are random."""

_OBJECT_LABELS = {"cube": "cube of 50 mm", "sphere": "sphere of 60 mm", "random": "random objects"}
_PUSH_LABELS = {"gravity": "gravity", "random": "random wrench", "six_directions": "six pushes"}
LABELS: dict[str, str] = {
    "objects": "random objects, random wrench",
    "six_directions": "random objects, six pushes of 10 N/kg, 2 s each",
    "path_0.25": "0.1 m cuboid, W_ext(t) x 0.25",
    "path_1": "0.1 m cuboid, W_ext(t) x 1",
    **{case: error.label for group in GROUPS.values() for case, error in group.errors.items()},
    "weak": "random objects, weak random wrench",
    "contacts": "random wrench, contacts of other kinds",
    "margin": "random wrench, friction margin 0.7",
    "squeeze": "constant squeeze",
    "pd": "PD only",
    **{
        case: f"soft tips, shear and torsion at once, margin {margin:g}"
        for case, margin in SOFT_MARGINS.items()
    },
    **{
        f"{item}_{push}": f"{_OBJECT_LABELS[item]}, {_PUSH_LABELS[push]}"
        for item in OBJECTS
        for push in PUSHES
    },
    **{f"mesh_{push}": label for push, label in _PUSH_LABELS.items()},
    "hold_gravity": "gravity alone",
    "hold_constant": "gravity + the paper's constant wrench",
    "hold_paper_path": f"gravity + W_ext(t) x {PATH_SCALE:g}",
    "hold_random": "gravity + random wrench (Ornstein-Uhlenbeck, 0.6 N / 0.02 N m per axis)",
    "hold_late": "the same random wrench, known to the controller 4 ms late",
    "hold_unknown": "the same random wrench, unknown to the controller: pose feedback alone",
    "hold_impulses": "gravity + impacts (half sines of 5 N / 0.1 N m, 0.05 s) on random objects",
}
"""Names of the scenarios for tables."""
CONTROLLER_LABELS = {
    "paper": "paper's pipeline, wrench measured",
    "estimated": "paper's pipeline, wrench estimated",
    "constant_squeeze": "constant squeeze",
    "pd": "PD only",
}


def controllers_plan(episodes: int, quick: bool = False) -> list[Scenario]:
    """Plan the four-finger hand's scenarios with all controllers.

    The six directions have an eighth of the `episodes` for controllers other than the paper's.
    """
    eighth = episodes if quick else max(1, episodes // 8)

    def scenario(case: str, key: str, count: int, settings: dict[str, Any]) -> Scenario:
        settings = {**settings, **CONTROLLERS[key]}
        random = not case.startswith("path")
        return Scenario(case, {"controller": key}, count, settings, random_objects=random)

    plan = [scenario("objects", key, episodes, RANDOM_WRENCH) for key in CONTROLLERS]
    for key in CONTROLLERS:
        count = episodes if key == "paper" else eighth
        plan.append(scenario("six_directions", key, count, {"task": "six_directions"}))
    for scale in (0.25, 1.0):  # deterministic: one episode suffices
        path = {"disturbance": {"name": "paper_path", "scale": scale}, "duration": 4.0}
        plan += [scenario(f"path_{scale:g}", key, 1, path) for key in CONTROLLERS]
    return plan


def transfer_plan(hands: Sequence[str], episodes: int) -> list[Scenario]:
    """Plan the same hands (names or files), objects and controllers in both engines.

    Each hand has `episodes` of random objects under a random wrench, and a third in other
    scenarios. Only the four-finger hand varies the contact models.
    """
    plan: list[Scenario] = []
    for hand in hands:
        keys = {"hand": short_name(hand)}
        if hand != "four_finger":
            settings = {"hand": hand, **SMALL_OBJECTS, **WEAK_WRENCH}
            plan.append(Scenario("weak", keys, episodes, settings, BOTH))
            continue
        third = max(1, episodes // 3)
        models = (*BOTH, "bullet_1000", "noslip", "pyramidal", "soft")
        for case, engines, count, settings in (
            ("objects", BOTH, episodes, {}),
            ("contacts", models, third, {}),
            ("margin", (*BOTH, "pyramidal", "soft"), third, {"controller.friction_margin": 0.7}),
            ("six_directions", BOTH, third, {"task": "six_directions"}),
            ("estimated", (*BOTH, "bullet_1000"), episodes, CONTROLLERS["estimated"]),
            ("squeeze", BOTH, third, CONTROLLERS["constant_squeeze"]),
            ("pd", BOTH, third, CONTROLLERS["pd"]),
        ):
            wrench = {} if "task" in settings else RANDOM_WRENCH
            settings = {"hand": hand, **wrench, **settings}
            plan.append(Scenario(case, keys, count, settings, engines))
    return plan


def soft_plan(episodes: int) -> list[Scenario]:
    """Plan soft fingertips under shear and torsion in both engines, with both cones of MuJoCo.

    Half of the `episodes` are those of a gripper.
    """
    return [
        Scenario(
            case,
            {"hand": hand},
            max(1, episodes // share),
            {"hand": hand, "controller.friction_margin": margin, **objects},
            (*BOTH, "pyramidal"),
            soft=True,
        )
        for case, margin in SOFT_MARGINS.items()
        for hand, (share, objects) in SOFT_HANDS.items()
    ]


def mesh_settings(text: str) -> tuple[str, dict[str, Any]]:
    """Return name and settings of an object from a mesh file, FILE or FILE=SCALE.

    Example:
        >>> mesh_settings("parts/duck.obj=0.06")
        ('duck', {'object': {'shape': 'mesh', 'mesh': 'parts/duck.obj', 'size': (0.06,), 'mass':
        0.15, 'friction': 0.7}})
    """
    path, equals, scale = text.rpartition("=")
    if not equals or "/" in scale or "\\" in scale:  # the sign belongs to a folder's name
        path, scale = text, "1"
    try:
        size = (float(scale),)
    except ValueError:
        raise InvalidInputError(
            f"object {text!r} must be FILE or FILE=SCALE, such as duck.obj=0.001"
        ) from None
    name = path.replace("\\", "/").rsplit("/", 1)[-1].rsplit(".", 1)[0]
    body = {name: OBJECTS["cube"][name] for name in ("mass", "friction")}
    return name, {"object": {"shape": "mesh", "mesh": path, "size": size, **body}}


def hands_plan(
    hands: Iterable[str], engines: Sequence[str], episodes: int, objects: Sequence[str] = ()
) -> list[Scenario]:
    """Plan all combinations of hands, objects and pushes.

    Hands are names or files; objects are mesh files (see `mesh_settings`), or else `OBJECTS`.

    Each random scenario has `episodes`, a deterministic one has one.
    """
    items: list[Any] = [
        ("mesh", {"object": name}, settings) for name, settings in map(mesh_settings, objects)
    ]
    items = items or [(item, {}, settings) for item, settings in OBJECTS.items()]
    return [
        Scenario(
            f"{item}_{push}",
            {"hand": short_name(hand), **keys},
            episodes if "random" in (item, push) else 1,
            {"hand": hand, **settings, **PUSHES[push]},
            tuple(engines),
            item == "random",
        )
        for hand in hands
        for item, keys, settings in items
        for push in PUSHES
    ]


def short_name(hand: str) -> str:
    """Return a hand's name in tables and files: the name of its file, without suffixes.

    Example:
        >>> short_name("/robots/leap/leap_right.urdf.xacro"), short_name("hands/2f85.xml"), short_name("allegro")
        ('leap_right', '2f85', 'allegro')
    """
    name = hand.replace("\\", "/").rsplit("/", 1)[-1]
    for kind in (".xacro", ".xml", ".mjcf", ".urdf"):
        name = name.removesuffix(kind)
    return name
