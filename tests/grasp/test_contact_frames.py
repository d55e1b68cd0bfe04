from __future__ import annotations

import numpy as np
import pytest
from oracles.geometry import frame, grasp_matrix
from problems import GRASPS, random_grasp

from grasp_env.core import TANGENT_SWITCH
from grasp_env.grasp import Grasp
from grasp_env.grasp.contact import contact_frames


@pytest.fixture(scope="module")
def normals() -> np.ndarray:
    """Uniform directions, the six axes, and both sides of the switch of the tangents."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((500, 3))
    sides = TANGENT_SWITCH + np.array([-1e-9, 0.0, 1e-9])
    around = [[s * x, np.sqrt(1.0 - x * x) * np.cos(a), np.sqrt(1.0 - x * x) * np.sin(a)]
              for x in sides for s in (1.0, -1.0) for a in rng.uniform(0.0, 6.28, 5)]  # fmt: skip
    everything = np.concatenate([directions, np.eye(3), -np.eye(3), around])
    return everything / np.linalg.norm(everything, axis=1)[:, None]


def test_frames_are_right_handed_rotations_with_the_normal_first(normals: np.ndarray) -> None:
    frames = contact_frames(normals)
    n, o, t = frames.transpose(2, 0, 1)
    # rounding of a unit vector: a few 1e-16; near |n_x| = 0.9 the projection divides by 0.44 at least
    np.testing.assert_allclose(
        np.einsum("nji,njk->nik", frames, frames), np.tile(np.eye(3), (len(n), 1, 1)), atol=3e-15
    )
    np.testing.assert_array_equal(n, normals)
    np.testing.assert_allclose(np.cross(n, o), t, atol=1e-15)


def test_tangents_follow_the_written_rule(normals: np.ndarray) -> None:
    for normal, made in zip(normals, contact_frames(normals), strict=True):
        axis = np.eye(3)[1 if abs(normal[0]) > 0.9 else 0]
        projected = axis - normal * (axis @ normal)
        np.testing.assert_allclose(made[:, 1], projected / np.linalg.norm(projected), atol=3e-15)


def test_compiled_geometry_is_the_plain_one(normals: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    positions, friction = rng.uniform(-0.1, 0.1, normals.shape), rng.uniform(0.1, 2.0, len(normals))
    stretch = np.stack([friction, *np.ones((2, len(normals)))], axis=1)
    grasp = Grasp.from_contacts(positions, normals, friction)
    plain = contact_frames(normals)
    # the projection is written out, so only rounding may differ
    np.testing.assert_allclose(grasp.frames, plain, atol=3e-15)
    np.testing.assert_allclose(grasp.matrix, grasp_matrix(positions, plain), atol=3e-15)
    np.testing.assert_allclose(grasp.cone_matrix * stretch.reshape(-1), grasp.matrix, atol=3e-15)


def test_frames_along_given_tangents(normals: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    positions, tangents = rng.uniform(-0.1, 0.1, normals.shape), rng.standard_normal(normals.shape)
    tangents[::3] = normals[::3] + 1e-3 * tangents[::3]
    grasp = Grasp.from_contacts(positions, normals, 0.5, tangents=tangents)
    stretch = np.tile([0.5, 1.0, 1.0], (len(normals), 1))
    # what the projection loses where the tangent is within 1e-3 of the normal
    near = np.where(np.arange(len(normals)) % 3 == 0, 1e-11, 1e-13)[:, None, None]
    plain = np.array([frame(n, along) for n, along in zip(normals, tangents, strict=True)])
    frames = grasp.frames
    assert (np.abs(frames - plain) <= near).all()
    turned = np.einsum("nji,njk->nik", frames, frames)
    np.testing.assert_allclose(turned, np.tile(np.eye(3), (len(normals), 1, 1)), atol=3e-15)
    np.testing.assert_allclose(grasp.matrix, grasp_matrix(positions, frames), atol=3e-15)
    np.testing.assert_allclose(grasp.cone_matrix * stretch.reshape(-1), grasp.matrix, atol=3e-15)


@pytest.mark.parametrize("name", GRASPS)
def test_grasp_matrix_columns_are_force_and_moment(name: str) -> None:
    grasp = GRASPS[name]
    for k in range(grasp.n_contacts):
        for axis in range(3):
            push = grasp.frames[k, :, axis]
            column = np.concatenate([push, np.cross(grasp.positions[k], push)])
            np.testing.assert_allclose(grasp.matrix[:, 3 * k + axis], column, atol=1e-16)


def test_object_and_contact_frame_are_inverse() -> None:
    rng = np.random.default_rng(2)
    grasp = random_grasp(rng, 5)
    force = rng.standard_normal((5, 3))
    vectors = grasp.to_object_frame(force)
    np.testing.assert_allclose(grasp.to_contact_frame(vectors), force, atol=1e-14)
    # the same wrench, written without G
    expected = np.concatenate([vectors.sum(axis=0), np.cross(grasp.positions, vectors).sum(axis=0)])
    np.testing.assert_allclose(grasp.wrench(force), expected, atol=1e-14)
