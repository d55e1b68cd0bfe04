"""Rules that find common mistakes in contacts, limits and wrenches.

Rules that can be near certain take a few microseconds while they find nothing, because every
`optimize_force` calls them. They read `Grasp.contacts`, which is faster than the attributes of a
new grasp.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env.grasp.grasp import Grasp, transmitted_matrix
from grasp_env.inputs.arguments import Array, Wrench

LONGEST = 5.0
"""Length of a grasp, or lever of a joint, beyond which lengths are in millimetres [m]."""
ROUGHEST = 2.0
"""Friction coefficient of the roughest rubber."""
DEGREES = 5.0
"""Friction coefficient beyond which it is an angle."""
WIDEST_PATCH = 0.1
"""Torsional friction that needs a contact patch as wide as a hand [m]."""
FAR, VERY_FAR = 8.0, 15.0
"""Distance of the origin from the contacts, in lengths of the grasp; no tool reaches the second."""
ARM = 0.4
"""Distance of the origin that can be near certain to be a mistake [m]."""
SHORT_LEVER = 4.0
"""Moment over force of a usual wrench, in lengths or reaches (length plus origin's distance)."""
LONG_LEVER = 20.0
"""Moment over force of a wrench that hardly pushes, in reaches."""
PURE_MOMENT = 50.0
"""Moment over the grasp's length, without any force, that is large [N]."""
TURNING = 10.0
"""Moment over the grasp's length that is too small to mistake for a force [N]."""
STRONGEST, WEAKEST = 500.0, 1.0 / 300.0
"""Torque limit over the torque that a load needs, beyond which its unit is wrong."""
SMALLEST_LOAD = 0.1
"""Load below which torque limits are not judged [N]."""
LARGEST_CONDITION = 1e3
"""Condition number of G, moments over the length, above which wrenches need very large forces."""
SMALLEST_DISTANCE = 0.01
"""Distance of two contacts, in lengths of the grasp, below which they act like one contact."""
LITTLE_LEFT = 0.9
"""Share of the friction beyond which small errors let an object slip."""
_CONVERGED = core.codes()["converged"]

Mistakes = Iterator[tuple[bool, str]]
"""Likely mistakes: True if no plausible problem looks like this, and the text."""


def all_outward(grasp: Grasp) -> Mistakes:
    """Judge normals that all point away from the centre of the contacts."""
    contacts = grasp.contacts
    mean = np.vdot(contacts.positions - contacts.centre, contacts.normals)  # nearly always negative
    if mean > 0.0 and _away(grasp).all():
        yield (
            True,
            f"all {grasp.n_contacts} normals point away from the centre of the contacts: normals must point INTO the object; change their "
            "sign, unless the fingers press outwards from inside a hole",
        )


def some_outward(grasp: Grasp) -> Mistakes:
    """Judge normals of which some point outwards, if turning these round allows a squeeze."""
    away = _away(grasp)
    models = grasp.models
    if not away.any() or away.all() or _can_squeeze(grasp.contacts):
        return
    # forces without torsion do not balance every wrench
    if models.transmitted.sum() - grasp.null_dimension < 6:
        return
    normals = np.where(away[:, None], -grasp.normals, grasp.normals)
    properties = models.cone_scale, models.torsional_friction, grasp.contacts.tangents
    if _can_squeeze(core.Contacts.put(grasp.positions, normals, *properties)):
        yield (
            False,
            f"the normals of contacts {np.nonzero(away)[0].tolist()} point away from the centre of the contacts, and the fingers cannot "
            "squeeze the object; with these normals reversed they could: normals must point INTO the object",
        )


def _away(grasp: Grasp) -> np.ndarray:
    """Return (N,) True for normals that point away from the centre of the contacts."""
    along = ((grasp.positions - grasp.centre) * grasp.normals).sum(axis=1)
    return along > 1e-9 * grasp.length


def _can_squeeze(contacts: core.Contacts) -> bool:
    """True if some force strictly inside the friction cones balances itself."""
    count = contacts.count
    results = np.zeros(6), np.empty((count, 3)), np.empty(count), np.empty(6)
    solver = core.ForceOptimizer(core.Problem(contacts))
    return solver.deepest(*results)[0] == _CONVERGED


def contact_units(grasp: Grasp) -> Mistakes:
    """Judge the units of positions, friction and torsional friction."""
    length = grasp.contacts.length
    if length > LONGEST:
        yield (
            True,
            f"the contacts lie {length:.3g} m from their centre (root mean square): positions are in metres; divide millimetres by 1000",
        )
    if grasp.largest_friction > ROUGHEST:
        friction = grasp.models.friction.max(axis=1)
        worst = int(friction.argmax())
        yield (
            bool(friction[worst] > DEGREES),
            f"friction is {friction[worst]:.3g} at contact {worst}: rubber reaches 1 to 2; give the coefficient, tan(friction angle), "
            "not an angle in degrees",
        )
    if not grasp.hard:
        torsion = grasp.models.torsional_friction
        worst = int(torsion.argmax())
        if torsion[worst] > WIDEST_PATCH:
            yield (
                False,
                f"torsional_friction is {torsion[worst]:.3g} m at contact {worst}: a fingertip has about 0.005 m; divide millimetres "
                "by 1000",
            )


def lever_units(jacobian: Array) -> Mistakes:
    """Judge the units of a Jacobian (N, 3 or 6, J)."""
    longest = np.abs(jacobian[:, :3]).max()
    if longest > LONGEST:
        yield (
            True,
            f"the Jacobian's largest entry is {longest:.3g} m: a joint that far from its contact would be larger than a robot; lengths are "
            "in metres, divide the linear rows by 1000 if they are in millimetres",
        )


def frame_and_order(grasp: Grasp, wrench: Wrench) -> Mistakes:
    """Judge the reference point of a wrench's moment, and the order and units of the wrench."""
    size = grasp.contacts.length
    force, moment, turning, distance = _sizes(grasp, wrench)
    reach = size + distance
    # the force acts near the origin, which is far from the contacts
    if (
        distance > FAR * size
        and moment < SHORT_LEVER * size * force
        and turning > FAR * size * force
    ):
        yield (
            distance > VERY_FAR * size and distance > ARM,
            f"the contacts are {distance:.3g} m from the origin, but the wrench's force acts within {max(1e-3, moment / force):.2g} m of "
            "it: is its moment about another point (the centre of mass)? Give both in one frame, the moment about the origin of the "
            "positions (in Python wrench_about shifts it), unless the object reaches that far",
        )
    # force and moment make sense only if they change places
    if (
        force > 0.0
        and turning > LONG_LEVER * reach * force
        and force < SHORT_LEVER * reach * moment
        and moment > TURNING * size
    ):
        yield (
            True,
            f"the wrench's moment of {turning:.3g} N m is that of its force of {force:.3g} N at {turning / force:.2g} m from contacts "
            f"that span {size:.2g} m: a wrench is force [N] first, then moment [N m]; exchange them, or divide the moment by 1000 if it "
            "is in N mm",
        )
    elif force == 0.0 and turning > PURE_MOMENT * size:
        yield (
            False,
            f"the wrench is a moment of {turning:.3g} N m without a force, on contacts that span {size:.2g} m: a wrench is force [N] "
            "first, then moment [N m]; exchange them, unless the fingers turn something",
        )


def _sizes(grasp: Grasp, wrench: Wrench) -> tuple[float, float, float, float]:
    """Return |force|, |moment|, |moment about the contacts' centre| and |centre| [N, N m, m]."""
    (fx, fy, fz, mx, my, mz), (x, y, z) = wrench.tolist(), grasp.contacts.centre.tolist()
    turning = hypot(mx - (y * fz - z * fy), my - (z * fx - x * fz), mz - (x * fy - y * fx))
    return hypot(fx, fy, fz), hypot(mx, my, mz), turning, hypot(x, y, z)


def little_margin(grasp: Grasp, wrench: Wrench) -> Mistakes:
    """Judge how much of the friction the optimum without a margin uses."""
    solution: Any = core.ForceOptimizer(core.Problem(grasp.contacts)).solve(wrench)
    if not solution.has_force:
        return
    worst = int(solution.friction_used.argmax())
    used = float(solution.friction_used[worst])
    if used > LITTLE_LEFT:
        yield (
            False,
            f"the optimum without a margin uses {used:.3g} of the friction at contact {worst}: it slips there if the friction is {1.0 - used:.1%} "
            "lower than given, or under a slightly different load; take margin=0.9, 0.75 or 0.5 where the friction is known to 10, 25 or 50 %, "
            "and a preload against errors of the load: Margin(0.75, preload=0.5)",
        )


def torque_units(grasp: Grasp, wrench: Wrench, jacobian: Array, torque_limit: Array) -> Mistakes:
    """Judge the units of torque limits (J,) by the torques that the wrench needs."""
    force, _, turning, _ = _sizes(grasp, wrench)
    # a single contact has no length
    if force * grasp.length + turning < SMALLEST_LOAD * grasp.length:
        return
    solution: Any = core.ForceOptimizer(core.Problem(grasp.contacts)).solve(wrench)
    if not solution.has_force:
        return
    pushed = np.hstack([solution.object_force, solution.torsion[:, None] * grasp.normals])
    needed = np.abs(np.einsum("nrj,nr->j", jacobian, pushed[:, : jacobian.shape[1]]))
    with np.errstate(divide="ignore"):
        shares = torque_limit / needed
    weakest = int(shares.argmin())
    share = shares[weakest]
    seen = f"{needed[weakest]:.3g} of {torque_limit[weakest]:.3g} N m): limits are in N m"
    if STRONGEST < share < np.inf:
        yield (
            False,
            f"every torque limit is more than 500 times what this load needs (joint {weakest}: {seen}; divide mN m by 1000",
        )
    elif share < WEAKEST:
        yield (
            False,
            f"this load needs {1.0 / share:.2g} times the torque limit of joint {weakest} ({seen}, and the Jacobian's linear rows in "
            "metres",
        )


def coincident(grasp: Grasp) -> Mistakes:
    """Judge contacts that lie close together."""
    apart = np.linalg.norm(grasp.positions[:, None] - grasp.positions, axis=2)
    first, second = np.nonzero(np.triu(apart < SMALLEST_DISTANCE * grasp.length, 1))
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        yield (
            False,
            f"contacts {i} and {j} are {1e3 * apart[i, j]:.3g} mm apart, {100 * apart[i, j] / grasp.length:.2g} % of the grasp's "
            "length: they act like one contact; drop one or correct its position",
        )


def condition(grasp: Grasp) -> Mistakes:
    """Judge a G that is nearly singular."""
    if grasp.rank < 6:
        yield (
            False,
            f"rank(G) = {grasp.rank} < 6: the contacts balance only some wrenches, and contacts on a line none with a moment about that "
            "line; add a contact, friction, or soft fingertips if the object can turn",
        )
        return
    centre = grasp.positions.mean(axis=0)
    here, centred = (_condition_number(grasp, about) for about in (np.zeros(3), centre))
    if centred > LARGEST_CONDITION:
        yield (
            False,
            f"G is nearly singular, condition number {centred:.2g}: some wrenches need forces that much larger than others; "
            "spread the contacts, away from one common line, or add friction, torsion or a contact",
        )
    elif here > LARGEST_CONDITION:
        yield (
            False,
            f"G has condition number {here:.2g}, but {centred:.2g} with moments about the centre of the contacts: the object "
            f"frame's origin is {np.linalg.norm(centre):.3g} m away; put it near the contacts",
        )


def _condition_number(grasp: Grasp, about: Array) -> float:
    """Return the condition number of G, moments about `about` (3,) [m] divided by the length."""
    matrix = transmitted_matrix(grasp, grasp.length)
    matrix[3:] -= np.cross(about, matrix[:3].T).T
    matrix[3:] /= grasp.length
    values = np.linalg.svd(matrix, compute_uv=False)
    return float(values[0] / values[-1])
