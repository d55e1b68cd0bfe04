"""Internal forces: their number for every contact model, and bases that follow moving contacts."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from oracles import geometry
from problems import GRASPS, random_grasp

from grasp_env.core import TANGENT_SWITCH
from grasp_env.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis


def in_object_frame(grasp: Grasp, basis: np.ndarray) -> np.ndarray:
    return np.einsum("nij,njk->nik", grasp.frames, basis.reshape(grasp.n_contacts, 3, -1)).reshape(
        basis.shape
    )


def assert_basis(grasp: Grasp, basis: np.ndarray) -> None:
    assert basis.shape == (3 * grasp.n_contacts, grasp.null_dimension)
    np.testing.assert_allclose(
        grasp.matrix @ basis, 0.0, atol=2e-14 * max(1.0, np.abs(grasp.matrix).max())
    )
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)
    assert not basis[
        np.repeat([name == "frictionless" for name in grasp.models.names], 3)
        & (np.arange(len(basis)) % 3 > 0)
    ].any()


def test_a_basis_near_another_grasps_is_the_polar_factor_of_its_projection():
    grasp = random_grasp(np.random.default_rng(0), 4)
    nominal = reference_basis(GRASPS["cuboid, 4"])
    here = np.einsum("nba,nbk->nak", grasp.frames, nominal.reshape(4, 3, -1)).reshape(nominal.shape)
    np.testing.assert_allclose(
        null_space_basis(grasp, nominal), geometry.polar_basis(here, grasp.matrix), atol=1e-9
    )


def made(positions: Any, normals: Any, models: str | list[str], friction: Any = 0.5) -> Grasp:
    """A grasp with torsional friction of a tenth of its size where a contact is soft."""
    each = [models] * len(positions) if isinstance(models, str) else models
    gamma = 0.1 * geometry.unit_frame(np.array(positions))[1]
    soft = {"torsional_friction": gamma} if "soft" in each else {}
    return Grasp.from_contacts(positions, normals, friction, contact_model=each, **soft)


LINE = np.outer([-0.02, 0.0, 0.02], np.eye(3)[0]), np.eye(3)[[0, 1, 2]]
RING = [[0.03, 0, 0], [-0.015, 0.026, 0], [-0.015, -0.026, 0], [0.0, 0.0, 0.03]]
FACES = np.concatenate([np.eye(3), -np.eye(3), np.eye(3)])[[0, 3, 1, 4, 2, 5, 6, 7, 8]]
NINE = (
    -0.03 * FACES
    + 0.01 * np.roll(FACES, 1, axis=1) * np.array([1, -1, 1, -1, 1, -1, -1, -1, -1])[:, None]
)
INWARD = -np.array(RING) / np.linalg.norm(RING, axis=1)[:, None]

NUMBERS = {
    # name: grasp, independent internal forces, those of forces and torsions together
    "three hard": (made(RING[:3], INWARD[:3], "hard"), 3, 3),
    "three elliptic": (made(RING[:3], INWARD[:3], "hard", [[0.5, 0.2]] * 3), 3, 3),
    "two soft": (made([RING[0], [-0.03, 0, 0]], [INWARD[0], -INWARD[0]], "soft"), 1, 2),
    "two soft, hard between": (made(*LINE, ["soft", "hard", "soft"]), 4, 5),
    "three soft": (made(RING[:3], INWARD[:3], "soft"), 3, 6),
    "three soft on a line": (made(*LINE, "soft"), 4, 6),
    "three hard, one frictionless": (
        made(RING, INWARD, ["hard", "hard", "hard", "frictionless"]),
        4,
        4,
    ),
    # a frictionless contact turns the object about the line between the others, unless it pushes
    # through that line
    "hard, soft, frictionless": (
        made(RING[:3], [*INWARD[:2], [0.0, 0.6, 0.8]], ["hard", "soft", "frictionless"]),
        1,
        2,
    ),
    "hard, soft, frictionless in a plane": (
        made(RING[:3], INWARD[:3], ["hard", "soft", "frictionless"]),
        2,
        2,
    ),
    "two soft, two frictionless": (
        made(RING, INWARD, ["soft", "soft", "frictionless", "frictionless"]),
        2,
        4,
    ),
    "nine frictionless": (made(NINE, FACES, "frictionless"), 3, 3),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_internal_forces_are_counted_for_every_model(name):
    grasp, forces, whole = NUMBERS[name]
    names = list(grasp.models.names)
    assert grasp.null_dimension == forces
    assert geometry.internal_dimensions(grasp.positions, grasp.normals, names) == (forces, whole)
    assert_basis(grasp, null_space_basis(grasp))


def test_random_grasps_of_mixed_contacts():
    rng = np.random.default_rng(0)
    met = Counter[tuple[bool, bool]]()
    for trial in range(320):
        count = int(rng.integers(2, 9))
        models = [
            str(name)
            for name in rng.choice(["hard", "soft", "frictionless"], count, p=[0.4, 0.4, 0.2])
        ]
        normals = rng.standard_normal((count, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        size = 10.0 ** rng.uniform(-5, 3)
        # every fourth on a line
        at = rng.standard_normal((count, 3)) * [1.0, *([trial % 4 > 0] * 2)]
        positions = size * (at + 3.0 * rng.standard_normal(3))
        grasp = made(positions, normals, models, rng.uniform(0.2, 1.0, (count, 2)))
        forces, whole = geometry.internal_dimensions(positions, normals, models)
        four = sum({"hard": 3, "soft": 4, "frictionless": 1}[name] for name in models)
        assert (grasp.null_dimension, four - grasp.rank) == (forces, whole), models
        reference = reference_basis(grasp)
        assert_basis(grasp, basis := null_space_basis(grasp, reference))
        # about the contacts' centre and in their size, with plain sums
        np.testing.assert_allclose(in_object_frame(grasp, basis), reference, atol=1e-12)
        vectors = reference.reshape(count, 3, -1).transpose(0, 2, 1)
        arms = (positions - positions.mean(axis=0)) / size
        np.testing.assert_allclose(vectors.sum(axis=0), 0.0, atol=1e-13)
        np.testing.assert_allclose(np.cross(arms[:, None], vectors).sum(axis=0), 0.0, atol=1e-12)
        met["frictionless" in models, bool(whole < forces + models.count("soft"))] += 1
    # with and without frictionless contacts, and with torsions that the rank needs
    assert sum(met.values()) > 200
    assert len(met) == 4
    assert min(met.values()) > 15


def rolled(angle: float) -> Grasp:
    """Four contacts on a sphere of 50 mm that roll with `angle`; the first normal sweeps from e_z
    to e_x and on."""
    s = np.sin(angle)
    c = np.cos(angle)
    out = np.array(
        [
            [s, 0, c],
            [-0.8 * s, 0.6, -0.8 * c],
            [0.3 * c, -0.9, 0.2 + 0.1 * s],
            [-0.5, 0.4 * np.cos(2 * angle), -0.7],
        ]
    )
    out /= np.linalg.norm(out, axis=1)[:, None]
    return Grasp.from_contacts(0.05 * out, -out, 0.6)


def test_the_basis_is_smooth_where_the_tangents_switch():
    centre = float(np.arcsin(TANGENT_SWITCH))  # |n_x| = sin(angle) of the first contact
    reference = reference_basis(rolled(centre - 0.1))

    def moves(step: float) -> tuple[float, float]:
        a = rolled(centre - step)
        b = rolled(centre + step)
        x = null_space_basis(a, reference)
        y = null_space_basis(b, reference)
        assert_basis(a, x)
        return np.abs(in_object_frame(b, y) - in_object_frame(a, x)).max(), np.abs(y - x).max()

    (fine, jump), (coarse, _) = moves(1e-6), moves(1e-5)
    assert fine == pytest.approx(0.1 * coarse, rel=1e-3)  # differentiable
    assert jump > 0.1  # in contact frames


@pytest.mark.parametrize(
    "name",
    [
        "two soft",
        "three soft",
        "three hard, one frictionless",
        "hard, soft, frictionless",
        "two soft, two frictionless",
        "nine frictionless",
    ],
)
def test_the_basis_is_smooth_for_every_model(name):
    nominal = NUMBERS[name][0]
    rng = np.random.default_rng(0)
    shift, turn = rng.standard_normal((2, nominal.n_contacts, 3)) * [[[0.01]], [[0.5]]]
    reference = reference_basis(nominal)

    def basis(s: float) -> np.ndarray:
        normals = nominal.normals + s * turn
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        grasp = made(nominal.positions + s * shift, normals, list(nominal.models.names))
        assert_basis(grasp, found := null_space_basis(grasp, reference))
        return in_object_frame(grasp, found)

    for s in (0.0, 0.1, 0.2):
        fine, coarse = ((basis(s + step) - basis(s - step)) / (2.0 * step) for step in (1e-5, 1e-4))
        np.testing.assert_allclose(fine, coarse, atol=1e-6 * np.abs(coarse).max())  # differentiable
        assert np.abs(fine).max() > 0.01  # it follows the contacts
