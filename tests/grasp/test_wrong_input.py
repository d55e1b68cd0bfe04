"""Wrong input and the words of its errors; `tests/malformed` tries the rest at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from grasp_env.errors import (
    GraspError,
    InvalidInputError,
    RankDeficientGraspError,
    UnknownNameError,
)
from grasp_env.grasp import Grasp, gravity_wrench, presets, transform_wrench, wrench, wrench_about
from grasp_env.grasp.null_space import null_space_basis

GRASP = presets.tripod()
POSITIONS, NORMALS = GRASP.positions, GRASP.normals
LINE = np.array([[0.0, 0.0, 0.0], [0.01, 0.02, 0.03], [0.02, 0.04, 0.06]])


def made(**changes: Any) -> Callable[[], Grasp]:
    return partial(
        Grasp.from_contacts,
        **{"positions": POSITIONS, "normals": NORMALS, "friction": 0.5, **changes},
    )


def placed(positions: Any) -> Callable[[], Grasp]:
    return made(positions=positions, normals=np.tile([0.6, 0.0, 0.8], (len(positions), 1)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (made(positions=np.zeros((3, 2))), r"positions must have shape \(N, 3\), got \(3, 2\)"),
        (made(positions="here"), "positions must be numbers"),
        (made(positions=[[0.0, 0.0, 0.0], [1.0]]), "positions must be numbers"),
        (made(positions=POSITIONS * np.nan), "positions must be finite, got .*nan"),
        (made(positions=1e9 * POSITIONS), "give them in metres"),
        (
            made(positions=POSITIONS + 1e4),
            "within 100000 times their length.*put the object frame's origin near the contacts",
        ),
        (made(positions=[], normals=NORMALS[:2]), "positions must have shape"),
        (made(normals=NORMALS[:2]), r"normals must have shape \(3, 3\), got \(2, 3\)"),
        (made(normals=np.full((3, 3), np.inf)), "normals must be finite"),
        (made(normals=NORMALS * [[1.0], [0.0], [1.0]]), r"normal 1 is .* with length 0: divide"),
        *(
            (made(normals=NORMALS * off), rf"normal \d is .* with length {off:g}: divide")
            for off in (1.0101, 0.9899, 2.0)
        ),
        (made(friction=np.full(2, 0.5)), r"friction must have shape .*, got \(2,\)"),
        (made(friction="rough"), "friction must be numbers"),
        (made(friction=np.full((3, 1), 0.5)), r"friction must have shape .*, got \(3, 1\)"),
        (
            made(friction=[0.5, -0.1, 0.5]),
            r"friction must lie within 0.0001 to 10000 at every contact that is not frictionless, got \[0\.5, -0\.1, 0\.5\]",
        ),
        (made(friction=[[0.5, 0.0]] * 3), "friction must lie within"),
        (made(friction=1.001e4), "friction must lie within"),
        (made(tangents=np.tile([1.0, 0.0, 0.0], (3, 1))), "tangent 0 is .* along its normal"),
        (made(tangents=np.ones((2, 3))), "tangents must have shape"),
        (made(contact_model="soft"), "soft contacts need torsional_friction"),
        (made(contact_model=["hard"] * 2), "one name or 3 of them, got 2"),
        (made(contact_model="soft", torsional_friction=-0.1), "torsional_friction must lie within"),
        (
            made(contact_model="soft", torsional_friction=[0.1, 0.0, -1e-9]),
            "at every soft contact, or be 0, got",
        ),
        (
            made(contact_model="soft", torsional_friction=1e-16),
            "torsional_friction must lie within 1e-15",
        ),
        (
            made(contact_model="soft", torsional_friction=[0.1]),
            r"torsional_friction must have shape \(\) or \(3,\)",
        ),
        (
            made(contact_model="soft", torsional_friction=1e4),
            "at most 10000 times the grasp's length.*a fingertip has about 0.005 m",
        ),
        (
            made(contact_model="rigid"),
            "unknown contact model 'rigid': choose one of 'hard', 'soft'",
        ),
        (placed(np.empty((0, 3))), "at least one contact, got none"),
        *(
            (placed(points), "positions must lie within .* got 0 m")
            for points in (np.zeros((3, 3)), np.full((3, 3), 0.1))
        ),
        *(
            (
                lambda points=points: placed(points)().pseudoinverse,
                rf"rank\(G\) = [3-5] < 6 with {len(points)} contacts?:",
            )
            for points in (POSITIONS[:1], POSITIONS[:2], LINE, LINE + 0.2)
        ),
        (lambda: made(contact_model="frictionless")().pseudoinverse, r"rank\(G\)"),
        (placed(np.zeros((1001, 3))), "at most 1000 contacts, got 1001"),
        *(
            (
                partial(
                    Grasp.unchecked,
                    **(
                        {"positions": POSITIONS, "normals": NORMALS, "models": GRASP.models}
                        | {name: np.full((3, 3), odd)}
                    ),
                ),
                "finite|normals|centre",
            )
            for name in ("positions", "normals", "tangents")
            for odd in (0.0, np.nan, np.inf)
        ),
        (
            partial(Grasp.unchecked, POSITIONS, NORMALS, presets.paper_cuboid().models),
            "Grasp.from_contacts takes anything",
        ),
        (partial(replace, GRASP, friction=0.3), r"use Grasp\.from_contacts.*with_friction"),
        (partial(presets.preset, "cube"), r"unknown preset 'cube'.*'paper_cuboid'"),
        *(
            (partial(GRASP.wrench, odd), "force must")
            for odd in (np.zeros(9), np.zeros((4, 3)), np.full((3, 3), np.nan))
        ),
        (partial(GRASP.to_cone, np.zeros((4, 3))), r"force must have shape \(3, 3\)"),
        (
            partial(null_space_basis, GRASP, np.zeros((9, 3))),
            "reference must have 3 independent directions",
        ),
        (
            partial(transform_wrench, np.zeros(6), np.eye(2), np.zeros(3)),
            r"rotation must have shape \(3, 3\)",
        ),
        (
            partial(transform_wrench, np.zeros(6), 1.01 * np.eye(3), np.zeros(3)),
            "R\\^T R misses the identity by 0.0201, at most 1e-06",
        ),
        (
            partial(gravity_wrench, 1.0, rotation=np.diag([1.0, -1.0, 1.0])),
            r"is a reflection \(determinant -1\)",
        ),
        (
            partial(transform_wrench, np.zeros(6), np.eye(3), np.zeros(2)),
            r"translation must have shape \(3,\)",
        ),
        (partial(transform_wrench, np.zeros(5), np.eye(3), np.zeros(3)), "wrench must have shape"),
        (partial(gravity_wrench, 0.0), "mass must be a number > 0, got 0.0"),
        (partial(wrench_about, np.zeros(6), 0.0), r"point must have shape \(3,\)"),
        (partial(wrench.magnitude, np.zeros(5)), "wrench must have shape"),
        (
            partial(wrench.sample_ball, np.random.default_rng(0), 0),
            "count must be an integer >= 1, got 0",
        ),
        (
            partial(wrench.sample_magnitudes, np.random.default_rng(0), 3, 2.0, 1.0),
            "low must be <= high",
        ),
    ],
)
def test_wrong_input(call, message):
    with pytest.raises(GraspError, match=message) as caught:
        call()
    told = str(caught.value)
    kind = (
        UnknownNameError
        if "unknown" in told
        else RankDeficientGraspError
        if "rank(G)" in told
        else InvalidInputError
    )
    assert isinstance(caught.value, kind)
    assert isinstance(caught.value, ValueError)
