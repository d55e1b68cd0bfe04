"""The tracks, each generated from a seed.

A new track is a function of a random generator and an entry of `TRACKS`. Random numbers are rounded
to `DIGITS` significant digits, so that a seed gives the same bytes everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.force.package import grasp_of
from benchmarks.force.problems import Array, Problem, Session, Track
from benchmarks.force.record import coupled, grasp_of_hand, recorded, shares_joints, weight
from benchmarks.force.record import short as rounded
from grasp_env.errors import GraspError
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import unit_vectors
from grasp_env.quality import feasibility
from training.data.grasps import PRESETS, Recipe

DIGITS = 12
short = partial(rounded, digits=DIGITS)
GRASPS = Recipe(friction=(0.3, 1.0), own_friction=True, margin=0.02, basis=False)
"""Random grasps on cuboids, ellipsoids and cylinders, with a margin of force closure."""
LOAD = (2.0, 0.05)
"""Radii of the balls from which wrenches are drawn [N, N m]."""
TICK = 0.002
"""Time between the problems of a path [s]."""
CLEAR = 1e-3
"""Least margin (`feasibility`) of a feasible problem; infeasible ones have the opposite sign."""
LOOP_TICKS = 100
"""Ticks of a session of `loop`, before some are left out."""
LOOPS = {
    "four_finger, sphere": False,
    "allegro, sphere": False,
    "allegro, cuboid": True,
    "leap, cuboid": True,
    "shadow_hand_right, cuboid": False,
    "shadow_hand_right, cylinder": False,
}
"""Hands of `loop`; True: with joints of the two last fingers coupled."""
LIFTS, LIFTED = (0.04, 0.56, 0.62), 5
"""Places of a session at which a finger lifts, as shares of its length; duration [ticks]."""
Arrays = dict[str, Any]
Sessions = Iterator[tuple[str, Arrays]]


def contacts(positions: Array, normals: Array, friction: Array | float) -> Arrays:
    """Return the arrays of contacts (..., N, 3).

    o is the projection of e_x on the tangent plane, or of e_y where abs(n_x) > 0.9. This is the
    rule of `grasp_env.grasp.contact_frames`, in sums whose order no processor changes.
    """
    n = short(normals)
    n = n / np.sqrt(n[..., :1] * n[..., :1] + n[..., 1:2] * n[..., 1:2] + n[..., 2:] * n[..., 2:])
    axis = np.where(np.abs(n[..., :1]) > 0.9, np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    along = np.where(np.abs(n[..., :1]) > 0.9, n[..., 1:2], n[..., :1])
    o = axis - n * along
    o = o / np.sqrt(o[..., :1] * o[..., :1] + o[..., 1:2] * o[..., 1:2] + o[..., 2:] * o[..., 2:])
    t = n[..., [1, 2, 0]] * o[..., [2, 0, 1]] - n[..., [2, 0, 1]] * o[..., [1, 2, 0]]
    frames = np.stack([n, o, t], axis=-1)
    return {
        "positions": short(positions),
        "frames": frames,
        "friction": short(np.broadcast_to(friction, n.shape[:-1])),
    }


def arrays_of(grasp: Grasp) -> Arrays:
    """Return the arrays of one grasp."""
    fields = (grasp.positions, grasp.normals, grasp.friction)
    return fixed(contacts(*map(np.array, fields)))


def fixed(arrays: Arrays) -> Arrays:
    """Return arrays that are equal for all problems of a session."""
    return {name: array[None] for name, array in arrays.items()}


def moving(problems: list[Arrays]) -> Arrays:
    """Return the arrays of consecutive problems."""
    return {name: np.concatenate([arrays[name] for arrays in problems]) for name in problems[0]}


def ball(rng: np.random.Generator, count: int, size: float = 1.0) -> Array:
    """Draw wrenches (count, 6): force and moment in balls of radii `size` times `LOAD`."""
    vectors = unit_vectors(rng.standard_normal((count, 2, 3)))
    radii = rng.random((count, 2, 1)) ** (1.0 / 3.0)
    loads = vectors * radii * size * np.array(LOAD)[None, :, None]
    return short(loads.reshape(count, 6))


def wave(rng: np.random.Generator, count: int, size: float = 1.0) -> Array:
    """Draw wrenches (count, 6) on a smooth path: four sines of 0.3 to 3 Hz in every component."""
    time = TICK * np.arange(count)[:, None, None]
    rate = rng.uniform(0.3, 3.0, (6, 4))
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 4))
    sines = np.sin(2.0 * np.pi * rate * time + phase) * rng.standard_normal((6, 4))
    return short(0.35 * size * sines.sum(axis=2) * np.repeat(LOAD, 3))


def cold(rng: np.random.Generator) -> Sessions:
    """Seven grasps of each size, in turn."""
    for n, preset in PRESETS.items():
        grasps = [arrays_of(preset()), *(arrays_of(GRASPS.closed(rng, n)) for _ in range(6))]
        yield f"{n}", moving(10 * grasps) | {"wrench": ball(rng, 70)}


def smooth(rng: np.random.Generator) -> Sessions:
    """Known grasps along a smooth path."""
    for n, preset in PRESETS.items():
        yield f"{n}", arrays_of(preset()) | {"wrench": wave(rng, 150)}


def jumps(rng: np.random.Generator) -> Sessions:
    """Known grasps whose wrench jumps towards another one."""
    for n, preset in PRESETS.items():
        path = [ball(rng, 1)[0]]
        aims = ball(rng, 99)
        shares = rng.choice([0.1, 0.5, 1.0], 99)
        for aim, share in zip(aims, shares, strict=True):
            path.append(path[-1] + share * (aim - path[-1]))
        yield f"{n}", arrays_of(preset()) | {"wrench": short(path)}


def roll(rng: np.random.Generator) -> Sessions:
    """Contacts that roll along a smooth path."""
    for n in PRESETS:
        rolling = _rolling(rng, GRASPS.closed(rng, n), 100)
        yield f"{n}", rolling | {"wrench": wave(rng, 100)}


def lost(rng: np.random.Generator) -> Sessions:
    """Sessions in which another finger loses contact every ten problems."""
    for n in (4, 5, 6):
        grasp = GRASPS.closed(rng, n)
        while not all(_closes_without(grasp, k) for k in range(n)):
            grasp = GRASPS.closed(rng, n)
        touching = np.ones((100, n), dtype=bool)
        for k in range(10, 100, 20):
            touching[k : k + 10, (k // 20) % n] = False
        yield f"{n}", arrays_of(grasp) | {"touching": touching, "wrench": wave(rng, 100)}


def random(rng: np.random.Generator) -> Sessions:
    """A new grasp for every problem."""
    for n in range(3, 17):
        grasps = moving([arrays_of(GRASPS.closed(rng, n)) for _ in range(25)])
        yield f"{n}", grasps | {"wrench": ball(rng, 25)}


def hands(rng: np.random.Generator) -> Sessions:
    """A hand's contacts with the object's weight and a random wrench."""
    for name, hand in recorded():
        loads = short(weight(hand) + ball(rng, 15, 0.5))
        yield name, arrays_of(grasp_of_hand(hand)) | {"wrench": loads}


def own(rng: np.random.Generator) -> Sessions:
    """Loads of 0.3 to 0.95 of the largest that the motors can carry."""
    for name, hand in recorded():
        if not shares_joints(hand["jacobian"]):
            yield name, _limited(rng, hand, 20)


def shared(rng: np.random.Generator) -> Sessions:
    """The same with shared joints; a hand without any has those of its two last fingers coupled."""
    for name, hand in recorded():
        yield name, _limited(rng, hand if shares_joints(hand["jacobian"]) else coupled(hand), 15)


def margin(rng: np.random.Generator) -> Sessions:
    """The hands of `own` and `shared`: contacts roll, and every problem has another margin."""
    for name, hand in recorded():
        rolling = _rolling(rng, grasp_of_hand(hand), 15)
        share = short(rng.uniform(0.6, 1.0, 15))
        preload = short(rng.uniform(0.0, 2.0, rolling["friction"].shape))
        yield name, _limited(rng, hand, 15, **rolling, friction_margin=share, preload=preload)


def soft(rng: np.random.Generator) -> Sessions:
    """Two or three soft fingertips around an object of 40 to 80 mm."""
    for n in (2, 2, 2, 2, 3, 3):
        angles = np.arange(n) * 2.0 * np.pi / n + rng.uniform(-0.15, 0.15, n)
        outward = np.stack([np.cos(angles), np.sin(angles), rng.uniform(-0.15, 0.15, n)], axis=1)
        half = rng.uniform(0.02, 0.04)
        gamma = short(rng.uniform(0.002, 0.008, n))
        friction = rng.uniform(0.4, 0.9)
        tips = contacts(half * outward, -outward, friction) | {"torsional_friction": gamma}
        arrays = fixed(tips)
        loads = [w for w in ball(rng, 200, 0.5) if _depth(arrays, w) > CLEAR]
        yield f"{n}, {1000 * half:.0f} mm, {len(loads)}", arrays | {"wrench": np.array(loads[:30])}


def infeasible(rng: np.random.Generator) -> Sessions:
    """Contacts without force closure, weak motors, and soft pinches with limited squeeze."""
    for n in (3, 4, 5):
        problems = []
        loads = []
        while len(problems) < 25:
            grasp = GRASPS.draw(rng, n)
            load = ball(rng, 1)[0]
            if feasibility(grasp, load).margin < -CLEAR:
                problems.append(arrays_of(grasp))
                loads.append(load)
        yield f"no closure, {n}", moving(problems) | {"wrench": np.array(loads)}
    for name, hand in recorded()[::4]:
        arrays = _limited(rng, hand, 12)
        factors = _largest(arrays)[:, None] * rng.uniform(1.2, 3.0, (12, 1))
        yield f"weak motors, {name}", arrays | {"wrench": short(arrays["wrench"] * factors)}
    for half in (0.02, 0.03):
        inward = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        limits = {"torsional_friction": np.full(2, 0.005), "max_normal": np.full(2, 1.0)}
        arrays = fixed(contacts(half * inward[::-1], inward, 0.5) | limits)
        loads = [w for w in ball(rng, 200) if _depth(arrays, w) < -CLEAR]
        yield f"pinch, {1000 * half:.0f} mm", arrays | {"wrench": np.array(loads[:20])}


def hard(rng: np.random.Generator) -> Sessions:
    """Clustered contacts, grasps that nearly lose closure, all sizes, little friction."""
    for n in (3, 4, 5, 6):
        powers = (2, 2, 3, 3, 4, 4)
        loads = ball(rng, 24)
        problems = [_clustered(rng, n, 10.0 ** (-power - 2)) for power in powers]
        problems += [_next_to_losing_closure(rng, n, 10.0**-power) for power in powers]
        for k in range(12, 18):
            length = 10.0 ** rng.uniform(-2.0, 2.0)
            size = 10.0 ** rng.uniform(-5.0, 5.0)
            grasp = GRASPS.closed(rng, n)
            problems.append(
                fixed(contacts(length * grasp.positions, grasp.normals, grasp.friction))
            )
            loads[k] *= size * np.repeat([1.0, length], 3)
        problems += [_slippery(rng, n, 0.05) for _ in range(6)]
        yield f"{n}", moving(problems) | {"wrench": short(loads)}


def loop(rng: np.random.Generator) -> Sessions:
    """The control loop of a hand at 500 Hz, in which everything changes.

    Contacts roll. About each axis a finger's part of the Jacobian turns by up to 0.06 rad; every
    joint's column changes in length by up to 4 %, and its torque bias by up to 5 %. These follow
    sines. The wrench turns along a path of sines and swells twice: from 0.2 of the largest that
    contacts and motors hold, first to 0.98 of it, where limits bind, then to 1.04 of it, where no
    force exists. Between the swells a finger lifts for a few ticks, if the others hold the load.
    Ticks within `CLEAR` of losing or gaining a force are left out.
    """
    hands = dict(recorded())
    for name, joins in LOOPS.items():
        hand = coupled(hands[name]) if joins else hands[name]
        arrays = _moving(rng, hand, LOOP_TICKS)
        loads = wave(rng, LOOP_TICKS)
        knots = np.arange(0, LOOP_TICKS, 10)
        few = {key: a[knots] if len(a) > 1 else a for key, a in arrays.items()}
        largest = _largest(few | {"wrench": loads[knots]})
        size = np.interp(np.arange(LOOP_TICKS), knots, largest) * _swelling(LOOP_TICKS)
        arrays |= {"wrench": short(size[:, None] * loads)}
        arrays["touching"] = _lifting(rng, arrays)
        depths = [_depth(arrays, w, m) for m, w in enumerate(arrays["wrench"])]
        kept = np.abs(depths) > CLEAR
        label = f"{name}, coupled" if joins else name
        yield label, {key: a[kept] if len(a) > 1 else a for key, a in arrays.items()}


@dataclass(frozen=True)
class Recipes:
    """Recipe of a track.

    Attributes:
        make: yields its sessions as (name, arrays).
        text: description in one line.
        modes: modes of its runs.
        objectives: objectives.
        digits: "exact" if its references are computed in many digits.
    """

    make: Callable[[np.random.Generator], Sessions]
    text: str
    modes: tuple[str, ...] = ("persistent",)
    objectives: tuple[str, ...] = ("sum", "phi")
    digits: str = "double"


PATH = ("persistent", "warm")
TRACKS = {
    "cold": Recipes(cold, "the solver is set up for every problem; 3 to 5 contacts", ("cold",)),
    "smooth": Recipes(
        smooth, "the wrench follows a smooth path at 500 Hz; the contacts are fixed", PATH
    ),
    "jumps": Recipes(jumps, "the wrench jumps by 10, 50 or 100 % of the way to another one", PATH),
    "roll": Recipes(roll, "contacts roll by up to 5 mm while the wrench follows a path", PATH),
    "lost": Recipes(lost, "a contact is lost for ten problems, and regained", PATH),
    "random": Recipes(random, "other contacts in every problem, 3 to 16 of them"),
    "hands": Recipes(hands, "contacts of seven real hands that hold an object"),
    "own": Recipes(
        own,
        "real hands within their torque limits; each joint moves one finger",
        objectives=("sum",),
    ),
    "shared": Recipes(
        shared,
        "real hands within their torque limits; some joints move two fingers",
        objectives=("sum",),
    ),
    "soft": Recipes(soft, "pinches by two or three soft fingertips", objectives=("sum",)),
    "infeasible": Recipes(
        infeasible, "no force exists, and the answer is a proof", objectives=("sum",)
    ),
    "hard": Recipes(
        hard,
        "contacts 1e-4 to 1e-6 m apart, closure lost by 1e-2 to 1e-4 less friction, friction from 0.05, all sizes",
        digits="exact",
    ),
    "margin": Recipes(
        margin,
        "real hands within their torque limits; contacts roll, and forces keep a share of friction and preloads",
        objectives=("sum",),
    ),
    "loop": Recipes(
        loop,
        "a real hand's control loop: contacts and Jacobian move, limits bind now and then, fingers lift and land, some ticks are infeasible",
        objectives=("sum",),
    ),
}
"""Tracks in the order of the reports, which is part of their seeds: new ones go to the end."""


def generate(name: str, seed: int) -> Track:
    """Generate a track without references."""
    recipe = TRACKS[name]
    place = list(TRACKS).index(name)
    rng = np.random.default_rng([seed, place])
    sessions: dict[str, Session] = {}
    for label, arrays in recipe.make(rng):
        label = f"{label} ({len(sessions) + 1})" if label in sessions else label
        sessions[label] = Session(label, arrays, {})
    about = {
        "place": place,
        "seed": seed,
        "about": recipe.text,
        "modes": recipe.modes,
        "objectives": recipe.objectives,
        "digits": recipe.digits,
        "made": f"python -m benchmarks.force generate --seed {seed} {name}",
    }
    return Track(name, [*sessions.values()], about)


def _rolling(rng: np.random.Generator, grasp: Grasp, count: int) -> Arrays:
    """Return contacts that roll by up to 5 mm over a surface of 30 mm radius."""
    n = grasp.n_contacts
    time = TICK * np.arange(count)[:, None, None]
    rate = rng.uniform(0.5, 3.0, (n, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 2))
    moved = 0.0035 * np.sin(2.0 * np.pi * rate * time + phase)  # (count, N, 2) along o and t
    steps = np.einsum("nak,mnk->mna", grasp.frames[:, :, 1:], moved)
    normals = grasp.normals - steps / 0.03
    return contacts(grasp.positions + steps, normals, grasp.friction)


def _moving(rng: np.random.Generator, hand: dict[str, Any], count: int) -> Arrays:
    """Return a hand whose contacts roll and whose Jacobian and torque bias change; see `loop`."""
    rolling = _rolling(rng, grasp_of_hand(hand), count)
    jacobian = hand["jacobian"]
    n, _, joints = jacobian.shape
    turn = 0.06 * _sines(rng, count, (n, 3))
    grow = 1.0 + 0.04 * _sines(rng, count, (joints,))
    moved = np.repeat(jacobian[None], count, axis=0)  # (count, N, 6, J)
    for part in (slice(0, 3), slice(3, 6)):  # of points, and of fingertips
        moved[:, :, part] += np.cross(turn[..., None], jacobian[None, :, part], axis=2)
    bias = hand["torque_bias"] * (1.0 + 0.05 * _sines(rng, count, (joints,)))
    return rolling | {
        "jacobian": short(moved * grow[:, None, None]),
        "torque_limit": short(hand["torque_limit"])[None],
        "torque_bias": short(bias),
    }


def _sines(rng: np.random.Generator, count: int, shape: tuple[int, ...]) -> Array:
    """Draw sines (count, *shape) of 0.5 to 3 Hz, one in each number."""
    time = TICK * np.arange(count).reshape(-1, *(1 for _ in shape))
    rate = rng.uniform(0.5, 3.0, shape)
    phase = rng.uniform(0.0, 2.0 * np.pi, shape)
    return np.sin(2.0 * np.pi * rate * time + phase)


def _swelling(count: int) -> Array:
    """Return the sizes (count,) of the loads of `loop`, relative to the largest."""
    place = np.arange(count) / count
    size = np.full(count, 0.2)
    for begin, end, peak in ((0.1, 0.55, 0.98), (0.68, 1.0, 1.04)):
        inside = np.clip((place - begin) / (end - begin), 0.0, 1.0)
        size += (peak - 0.2) * np.sin(np.pi * inside)
    return size


def _lifting(rng: np.random.Generator, arrays: Arrays) -> NDArray[np.bool_]:
    """Return which contacts (M, N) touch: fingers lift where the loads of `loop` are small.

    A finger lifts only where the others hold the load.
    """
    count, n = arrays["positions"].shape[:2]
    touching = np.ones((count, n), dtype=bool)
    for place in LIFTS:
        begin = round(place * count)
        ticks = range(begin, begin + LIFTED)
        for finger in rng.permutation(n):
            others = arrays | {"touching": np.arange(n)[None] != finger}
            if all(_depth(others, arrays["wrench"][m], m) > CLEAR for m in ticks):
                touching[begin : begin + LIFTED, finger] = False
                break
    return touching


def _limited(rng: np.random.Generator, hand: dict[str, Any], count: int, **others: Array) -> Arrays:
    """Return a hand's arrays with loads of 0.3 to 0.95 of the largest in their direction."""
    grasp = grasp_of_hand(hand)
    limits = {name: short(hand[name])[None] for name in ("jacobian", "torque_limit", "torque_bias")}
    arrays = arrays_of(grasp) | limits | others | {"wrench": ball(rng, count)}
    factors = _largest(arrays) * rng.uniform(0.3, 0.95, count)
    return arrays | {"wrench": short(arrays["wrench"] * factors[:, None])}


def _largest(arrays: Arrays) -> Array:
    """Return the largest feasible factor (M,) of each wrench, to 2 %."""
    out = []
    for m, wrench in enumerate(arrays["wrench"]):
        low, high = 0.0, 1.0
        while _depth(arrays, high * wrench, m) > 0.0 and high < 1e6:
            low, high = high, 4.0 * high
        while high - low > 0.02 * high:
            middle = 0.5 * (low + high)
            deep = _depth(arrays, middle * wrench, m) > 0.0
            low, high = (middle, high) if deep else (low, middle)
        out.append(low)
    return np.array(out)


def _depth(arrays: Arrays, wrench: Array, m: int = 0) -> float:
    """Return the depth of a problem's contacts that touch (`feasibility`) with another wrench."""
    fields: Arrays = {name: array[m if len(array) > 1 else 0] for name, array in arrays.items()}
    fields["wrench"] = wrench
    touching = fields.pop("touching", None)
    if touching is not None:
        whole = ("wrench", "torque_limit", "torque_bias", "friction_margin")
        fields |= {name: fields[name][touching] for name in fields if name not in whole}
    problem = Problem(**fields).shifted()
    grasp, limits = grasp_of(problem)
    return feasibility(grasp, problem.wrench, limits).margin


def _closes_without(grasp: Grasp, contact: int) -> bool:
    others = np.arange(grasp.n_contacts) != contact
    fields = (grasp.positions, grasp.normals, grasp.friction)
    try:
        return GRASPS.closes(Grasp.from_contacts(*(field[others] for field in fields)))
    except GraspError:
        return False


def _clustered(rng: np.random.Generator, count: int, distance: float) -> Arrays:
    """Draw a grasp whose last contact of four or more is this distance [m] from the first."""
    while True:
        grasp = GRASPS.closed(rng, count)
        positions = np.array(grasp.positions)
        normals = np.array(grasp.normals)
        if count > 3:
            positions[-1] = positions[0] + distance * grasp.frames[0, :, 1]
            normals[-1] = normals[0]
        arrays = fixed(contacts(positions, normals, grasp.friction))
        if _depth(arrays, np.zeros(6)) > CLEAR:
            return arrays


def _slippery(rng: np.random.Generator, count: int, friction: float) -> Arrays:
    """Draw a grasp that closes with this friction, or after many tries with a little more."""
    while True:
        for _ in range(200):
            try:
                arrays = arrays_of(GRASPS.draw(rng, count).with_friction(float(f"{friction:.6g}")))
            except GraspError:
                continue
            if _depth(arrays, np.zeros(6)) > 1e-4:
                return arrays
        friction *= 1.5


def _next_to_losing_closure(rng: np.random.Generator, count: int, above: float) -> Arrays:
    """Draw a grasp whose friction is this share above the least with which it closes."""
    while True:
        grasp = GRASPS.closed(rng, count)
        low, high = (1e-3, 1.0)

        def closes(friction: float, grasp: Grasp = grasp) -> bool:
            return feasibility(grasp.with_friction(friction), np.zeros(6)).margin > 0.0

        if closes(low) or not closes(high):
            continue
        while high - low > 1e-9:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if closes(middle) else (middle, high)
        return arrays_of(grasp.with_friction(float(f"{high * (1.0 + above):.7g}")))
