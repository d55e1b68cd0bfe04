"""Contacts that are valid but look like a mistake, said in words."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, warn
from grasp_env.core import ForceOptimizer, codes
from grasp_env.grasp.grasp import Grasp, as_grasp

LARGEST_LENGTH = 5.0
"""[m] a grasp's length beyond which its positions are probably millimetres."""
LARGEST_FRICTION = 2.0
"""Coulomb coefficients beyond it are rare even for rubber."""
LARGEST_TORSIONAL_FRICTION = 0.1
"""[m] gamma beyond it would need a contact patch as large as a hand."""
LARGEST_CONDITION = 1e3
"""Condition number of G, moments over the grasp's length, beyond which some wrenches need huge forces."""
SMALLEST_DISTANCE = 0.01
"""Contacts closer together than this part of the grasp's length hardly help each other."""


def advise(grasp: Grasp) -> list[str]:
    """What looks wrong about a grasp, one text each; empty when nothing does. Nothing is printed or raised.

    Looks for normals that point out of the object, millimetres, friction beyond 2, contacts that nearly coincide and a
    nearly singular G. Every text says what was seen, when it may be right, and what to change.

    Args:
        grasp: a valid grasp.

    Example:
        >>> from grasp_env.grasp import presets
        >>> good = presets.tripod()
        >>> advise(good)
        []
        >>> print(*advise(Grasp.from_contacts(good.positions, -good.normals, 0.5)))
        all 3 normals point away from the centre of the contacts: normals must point INTO the object; ...
    """
    as_grasp(grasp)
    return [*_normals(grasp), *_sizes(grasp), *_coincident(grasp), *_condition(grasp)]


def warn_of(grasp: Grasp) -> None:
    """Warns of the two commonest mistakes, normals that all point outwards and millimetres, in a fraction of a microsecond.

    For where a grasp is first met, not for every call: the warning is a `GraspWarning` at the line outside of this package.
    """
    contacts = grasp.contacts
    if contacts.length > LARGEST_LENGTH or contacts.outwards:
        warn("; ".join([*_normals(grasp), *_sizes(grasp)]))


def _squeezes(grasp: Grasp) -> bool:
    """True if the contacts have force closure, as `quality.force_closure` finds it, in a few microseconds."""
    count = grasp.n_contacts
    solver = ForceOptimizer.make(grasp.contacts)
    code, _, _ = solver.deepest(np.zeros(6), np.empty((count, 3)), np.empty(count), np.empty(6))
    return code == codes()["converged"]


def _normals(grasp: Grasp) -> list[str]:
    towards = np.einsum("ij,ij->i", grasp.normals, grasp.positions.mean(axis=0) - grasp.positions)
    away = towards < -1e-9 * grasp.length
    if away.all():
        return [
            f"all {len(away)} normals point away from the centre of the contacts: normals must point INTO the object; "
            "change their sign, unless the fingers press outwards from inside a hole"
        ]
    # turning ALL normals round never changes force closure, turning some does
    turned = np.where(away[:, None], -grasp.normals, grasp.normals)
    if away.any() and not _squeezes(grasp) and _squeezes(Grasp.unchecked(grasp.positions, turned, grasp.models)):
        return [
            f"the normals of contacts {np.flatnonzero(away).tolist()} point away from the centre of the contacts, and the "
            "fingers cannot squeeze the object; with these normals turned round they could: normals must point INTO the object"
        ]
    return []


def _sizes(grasp: Grasp) -> list[str]:
    said = []
    if grasp.length > LARGEST_LENGTH:
        said.append(
            f"the contacts lie {grasp.length:.3g} m from their centre (root mean square): positions are in metres; "
            "divide millimetres by 1000"
        )
    high = (grasp.models.friction > LARGEST_FRICTION).any(axis=1)
    if high.any():
        worst = int(grasp.models.friction.max(axis=1).argmax())
        said.append(
            f"friction is {grasp.models.friction[worst].max():.3g} at contact {worst}: rubber reaches 1 to 2; give the "
            "coefficient, tan(friction angle), not an angle in degrees"
        )
    gamma = grasp.models.torsional_friction
    if (gamma > LARGEST_TORSIONAL_FRICTION).any():
        worst = int(gamma.argmax())
        said.append(
            f"torsional_friction is {gamma[worst]:.3g} m at contact {worst}: a fingertip has about 0.005 m; divide "
            "millimetres by 1000"
        )
    return said


def _coincident(grasp: Grasp) -> list[str]:
    apart = np.linalg.norm(grasp.positions[:, None] - grasp.positions, axis=2)
    first, second = np.nonzero(np.triu(apart < SMALLEST_DISTANCE * grasp.length, 1))
    return [
        f"contacts {i} and {j} are {1e3 * apart[i, j]:.3g} mm apart, {100 * apart[i, j] / grasp.length:.2g} % of the grasp's "
        "length: they act like one contact; drop one or correct its position"
        for i, j in zip(first.tolist(), second.tolist(), strict=True)
    ]


def _condition(grasp: Grasp) -> list[str]:
    centre = grasp.positions.mean(axis=0)
    here, centred = (_condition_number(grasp, about) for about in (np.zeros(3), centre))
    if centred > LARGEST_CONDITION:
        return [
            f"G is nearly singular, condition number {centred:.2g}: some wrenches need forces that much larger than others; "
            "spread the contacts, away from one common line, or add friction, torsion or a contact"
        ]
    if here > LARGEST_CONDITION:
        return [
            f"G has condition number {here:.2g}, but {centred:.2g} with moments about the centre of the contacts: the object "
            f"frame's origin is {np.linalg.norm(centre):.3g} m away; put it near the contacts"
        ]
    return []


def _condition_number(grasp: Grasp, about: Array) -> float:
    matrix = grasp.matrix * (grasp.models.cone_scale > 0.0).reshape(-1)
    whole = np.concatenate([matrix, grasp.torsion_matrix * grasp.length], axis=1)
    whole[3:] -= np.cross(about, whole[:3].T).T
    whole[3:] /= grasp.length
    values = np.linalg.svd(whole, compute_uv=False)
    return float(values[0] / values[-1])
