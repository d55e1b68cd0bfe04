"""Random grasps, wrenches and limits; every problem is drawn from its own seed."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from force.clarabel_reference import Reference
from problems import random_grasp as on_ellipsoid

from grasp_env.errors import InvalidInputError, RankDeficientGraspError
from grasp_env.force import ForceLimits
from grasp_env.grasp import Grasp
from grasp_env.quality import feasibility

Array = np.ndarray
KINDS = ("hard", "elliptic", "soft", "frictionless", "mixed")
MODELS = ("hard", "elliptic", "frictionless", "soft", "mixed")
TROUBLES = ("plain", "clustered", "flat", "parallel", "edge", "friction")


@dataclass(frozen=True)
class Drawn:
    """A problem; weights: omega and lambda of Phi."""

    kind: str
    grasp: Grasp
    wrench: Array
    limits: ForceLimits | None = None
    weights: tuple[float, float] = (1.0, 0.01)


def random_grasp(rng: np.random.Generator, kind: str, most: int = 20) -> Grasp:
    """Contacts on an ellipsoid or a box of 1 mm to 10 m away from the origin; normals off by some
    degrees; friction 0.1 to 1.2.

    Frictionless grasps have nine contacts or more; of the largest three in a hundred have 50 or
    100.
    """
    count = int(rng.integers(2 if kind == "soft" else 3, most + 1))
    if most >= 20 and rng.random() < 0.03:
        count = int(rng.choice([50, 100]))
    if kind == "frictionless":
        count = max(count, 9)
    size = 10.0 ** rng.uniform(-3.0, 1.0)
    axes = size * rng.uniform(0.4, 1.0, 3)
    if rng.random() < 0.5:
        directions = rng.standard_normal((count, 3))
        positions = directions / np.linalg.norm(directions, axis=1)[:, None] * axes
        normals = -positions / axes**2
    else:
        face = rng.integers(0, 3, count)
        side = rng.choice([-1.0, 1.0], count)
        positions = rng.uniform(-1.0, 1.0, (count, 3))
        normals = np.zeros((count, 3))
        positions[np.arange(count), face], normals[np.arange(count), face] = side, -side
        positions = positions * axes
    normals = normals / np.linalg.norm(normals, axis=1)[:, None] + 0.1 * rng.standard_normal(
        (count, 3)
    )
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    shape = (count, 2) if kind in ("elliptic", "mixed") else count
    names = {"mixed": list(rng.choice(["hard", "soft", "frictionless"], count)), "elliptic": "hard"}
    positions = positions + size * rng.uniform(-2.0, 2.0, 3)
    friction = rng.uniform(0.1, 1.2, shape)
    gamma = size * 10.0 ** rng.uniform(-3.0, 0.0, count)
    model = names.get(kind, kind)
    return Grasp.from_contacts(
        positions, normals, friction, contact_model=model, torsional_friction=gamma
    )


def some_grasp(rng: np.random.Generator, kind: str, most: int = 20) -> Grasp:
    """`random_grasp`, drawn again while its G has not rank 6 (few contacts, some frictionless)."""
    while True:
        with suppress(RankDeficientGraspError):
            return random_grasp(rng, kind, most=most)


def random_wrench(
    rng: np.random.Generator, grasp: Grasp, least: float = 1e-6, most: float = 1e4
) -> Array:
    """A wrench of `least` to `most` newtons at the centre of the contacts, with or without a moment
    about it."""
    size = 10.0 ** rng.uniform(np.log10(least), np.log10(most))
    force = size * rng.standard_normal(3)
    moment = size * grasp.length * rng.choice([0.0, 0.1, 1.0]) * rng.standard_normal(3)
    return np.concatenate([force, moment + np.cross(grasp.positions.mean(axis=0), force)])


def random_limits(rng: np.random.Generator, grasp: Grasp, size: float) -> ForceLimits:
    """Normal forces and torques of joints that couple all contacts, tight to loose for wrenches of
    `size` newtons."""
    count = grasp.n_contacts
    given = {}
    if rng.random() < 0.6:
        given["max_normal"] = size * 10.0 ** rng.uniform(
            -0.7, 1.0, count if rng.random() < 0.5 else None
        )
    if rng.random() < 0.5:
        given["min_normal"] = 0.3 * np.min(given.get("max_normal", size)) * rng.uniform()
    if rng.random() < 0.6:
        joints = int(rng.integers(1, 7))
        given["jacobian"] = grasp.length * rng.standard_normal(
            (count, int(rng.choice([3, 6])), joints)
        )
        given["torque_limit"] = size * grasp.length * 10.0 ** rng.uniform(-0.3, 1.5, joints)
        if rng.random() < 0.5:
            given["torque_bias"] = 0.1 * given["torque_limit"] * rng.uniform(-1.0, 1.0, joints)
    return ForceLimits(**given)


def own_joints(rng: np.random.Generator, count: int, each: int = 3, rows: int = 3) -> Array:
    """(N, rows, J) of fingers with `each` joints of their own, levers of some centimetres."""
    jacobian = np.zeros((count, rows, each * count))
    for k in range(count):
        jacobian[k, :, each * k : each * (k + 1)] = 0.05 * rng.standard_normal((rows, each))
    return jacobian


def finger_limits(rng: np.random.Generator, count: int, tight: float = 1.0) -> ForceLimits:
    """Torques of two to four joints a finger, some without limit, with bias; normal forces now and
    then."""
    each = int(rng.choice([2, 3, 4]))
    torque = tight * rng.uniform(0.1, 0.4, each * count)
    torque[rng.random(len(torque)) < 0.1] = np.inf
    given = {}
    if rng.random() < 0.4:
        given["max_normal"] = tight * rng.uniform(4.0, 12.0, count)
    if rng.random() < 0.3:
        given["min_normal"] = rng.uniform(0.0, 0.3, count)
    bias = 0.02 * rng.standard_normal(each * count)
    return ForceLimits(
        jacobian=own_joints(rng, count, each), torque_limit=torque, torque_bias=bias, **given
    )


def hard_problem(rng: np.random.Generator) -> Drawn:
    """A problem with one of the troubles."""
    trouble, model, grasp = troubled(rng)
    size = 10.0 ** rng.uniform(-6.0, 5.0)
    force = rng.standard_normal(3) * (rng.random() < 0.9)
    moment = grasp.length * rng.choice([0.0, 1e-3, 1.0], p=(0.3, 0.2, 0.5)) * rng.standard_normal(3)
    middle = grasp.positions.mean(axis=0)
    wrench = size * np.concatenate([force, moment + np.cross(middle, force)])
    weights = (
        (1.0, 0.01)
        if rng.random() < 0.5
        else (10.0 ** rng.uniform(-4, 4), 10.0 ** rng.uniform(-8, 4))
    )
    return Drawn(f"{trouble}, {model}", grasp, wrench, None, weights)


def troubled(
    rng: np.random.Generator, troubles: tuple[str, ...] = TROUBLES
) -> tuple[str, str, Grasp]:
    """Return a trouble, a contact model, and such a grasp."""
    while True:
        trouble = str(rng.choice(troubles))
        model = str(rng.choice(MODELS, p=(0.4, 0.2, 0.05, 0.25, 0.1)))
        # contacts on one line, or out of range: another
        with suppress(RankDeficientGraspError, InvalidInputError):
            return trouble, model, hard_grasp(rng, trouble, model)


def hard_grasp(rng: np.random.Generator, trouble: str, model: str) -> Grasp:
    """3 to 50 contacts, mostly few, on an ellipsoid or a box, with one of the troubles."""
    count = int(
        min(
            50,
            (9 if model == "frictionless" else 3)
            + rng.geometric(0.2)
            - 1
            + 40 * (rng.random() < 0.02),
        )
    )
    axes = rng.uniform(0.4, 1.0, 3)
    if trouble == "flat":
        axes[2] = 10.0 ** rng.uniform(-6.0, -2.0)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = directions * axes
    normals = -directions / axes if trouble != "flat" else -directions * (1.0, 1.0, 0.01)
    if trouble == "parallel":  # two faces, slightly tilted
        normals = np.where(directions[:, 2:] > 0.0, -1.0, 1.0) * (0.0, 0.0, 1.0)
        normals = normals + 10.0 ** rng.uniform(-6.0, -1.0) * rng.standard_normal((count, 3))
    if trouble == "clustered":
        groups = int(rng.integers(1, 4))
        apart = 10.0 ** rng.uniform(-6.0, -3.0)
        of = rng.integers(0, groups, count)
        points = points[of] + apart * rng.standard_normal((count, 3))
        normals = normals[
            of if rng.random() < 0.5 else np.arange(count)
        ] + apart * rng.standard_normal((count, 3))
    normals += 0.05 * rng.standard_normal((count, 3)) * (trouble in ("plain", "flat"))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    size = 10.0 ** rng.uniform(-3.0, 1.0)
    shape = (count, 2) if model in ("elliptic", "mixed") else count
    friction = (
        10.0 ** rng.uniform(-3.0, 1.0, shape)
        if trouble == "friction"
        else rng.uniform(0.2, 1.2, shape)
    )
    names = {"mixed": list(rng.choice(["hard", "soft", "frictionless"], count)), "elliptic": "hard"}
    points = size * (points + rng.choice([0.0, 1.0, 10.0]) * rng.standard_normal(3))
    options = {
        "contact_model": names.get(model, model),
        "torsional_friction": size * 10.0 ** rng.uniform(-4.0, 0.0, count),
    }

    def made(part: float) -> Grasp:
        return Grasp.from_contacts(points, normals, part * friction, **options)

    if trouble != "edge" or model == "frictionless":
        return made(1.0)
    low, high = 1e-3, 10.0  # friction slightly above the least one with force closure
    for _ in range(20):
        middle = np.sqrt(low * high)
        low, high = (
            (low, middle) if Reference(made(middle)).margin(np.zeros(6)) > 1e-9 else (middle, high)
        )
    return made(high * (1.0 + 10.0 ** rng.uniform(-6.0, -1.0)))


def limited(rng: np.random.Generator) -> Drawn:
    """Any contacts within limits of the wrench's size."""
    grasp = some_grasp(rng, kind := str(rng.choice(KINDS)), most=12)
    wrench = random_wrench(rng, grasp)
    return Drawn(f"limits, {kind}", grasp, wrench, random_limits(rng, grasp, _size(grasp, wrench)))


def tight(rng: np.random.Generator) -> Drawn:
    """Limits that most wrenches exceed, also on contacts close to each other or to losing force
    closure."""
    _, kind, grasp = troubled(rng, ("plain", "plain", "clustered", "flat", "edge"))
    wrench = random_wrench(rng, grasp, 1e-3, 1e3)
    limits = random_limits(rng, grasp, _size(grasp, wrench) * 10.0 ** rng.uniform(-1.5, 0.3))
    return Drawn(f"tight limits, {kind}", grasp, wrench, limits)


def fingers(rng: np.random.Generator) -> Drawn:
    """Hard contacts of fingers with their own joints, the limits of the specialised Newton."""
    grasp = closed(rng, int(rng.integers(3, 8)))
    wrench = rng.standard_normal(6) * [1.0, 1.0, 1.0, 0.03, 0.03, 0.03]
    return Drawn(
        "fingers",
        grasp,
        wrench,
        finger_limits(rng, grasp.n_contacts, 10.0 ** rng.uniform(-0.3, 0.3)),
    )


def closed(rng: np.random.Generator, count: int) -> Grasp:
    """Contacts on an ellipsoid of some centimetres, with force closure."""
    while True:
        grasp = on_ellipsoid(rng, count)
        if feasibility(grasp, np.zeros(6)).feasible:
            return grasp


def nearly_lost(rng: np.random.Generator) -> Drawn:
    """Problems that are hard for the general program; the loose limits send hard contacts there
    too."""
    trouble, _, grasp = troubled(rng, ("clustered", "flat", "edge"))
    return Drawn(trouble, grasp, random_wrench(rng, grasp, 0.1, 10.0), ForceLimits(max_normal=1e11))


def _size(grasp: Grasp, wrench: Array) -> float:
    return float(np.abs(Reference(grasp).load(wrench)).max())


FAMILIES = {
    "limited": limited,
    "tight": tight,
    "fingers": fingers,
    "nearly lost": nearly_lost,
    "hard": hard_problem,
}


def problem(family: str, seed: int, index: int) -> Drawn:
    """Return problem number `index` of a seed."""
    return FAMILIES[family](np.random.default_rng([seed, index]))
