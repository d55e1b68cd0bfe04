from __future__ import annotations

import numpy as np

from grasp_env.force import description_matrix
from grasp_env.grasp import Grasp


def test_eigenvalues_are_u_and_u_plus_minus_s() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        force, friction = rng.standard_normal((4, 3)), rng.uniform(0.1, 1.5, 4)
        u, s = friction * force[:, 0], np.hypot(force[:, 1], force[:, 2])
        expected = np.sort(np.concatenate([u, u - s, u + s]))
        eigenvalues = np.linalg.eigvalsh(description_matrix(force, friction))
        # rounding of a 12 x 12 eigenvalue problem of order one
        np.testing.assert_allclose(eigenvalues, expected, atol=1e-13)


def test_positive_definite_exactly_inside_the_cone() -> None:
    friction = np.array([0.5])
    for angle in np.linspace(0.0, 6.0, 13):
        side = np.array([[0.0, np.cos(angle), np.sin(angle)]])
        for normal, inside in ((2.0 + 1e-9, True), (2.0 - 1e-9, False), (-3.0, False)):
            force = side + np.array([[normal, 0.0, 0.0]])
            assert (np.linalg.eigvalsh(description_matrix(force, friction))[0] > 0.0) == inside


def test_cone_coordinates_there_and_back() -> None:
    rng = np.random.default_rng(1)
    force, friction = rng.standard_normal((5, 3)), rng.uniform(0.1, 1.5, 5)
    directions = rng.standard_normal((5, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    grasp = Grasp.from_contacts(-directions, directions, friction)
    kept = force.copy()
    x = grasp.to_cone(force)
    np.testing.assert_array_equal(x.reshape(5, 3)[:, 0], friction * force[:, 0])
    np.testing.assert_array_equal(x.reshape(5, 3)[:, 1:], force[:, 1:])
    np.testing.assert_allclose(grasp.to_force(x), force, rtol=3e-16)
    np.testing.assert_array_equal(force, kept)
