"""Contact models: scalings, ranks and refusals. What solvers make of them is tested beside the solvers."""

from __future__ import annotations

import numpy as np
import pytest
from problems import random_grasp

from grasp_env.errors import InvalidInputError, RankDeficientGraspError, UnknownNameError
from grasp_env.force import Objective
from grasp_env.grasp import Grasp, presets

PINCH = {"positions": [[0, 0, -0.02], [0, 0, 0.02]], "normals": [[0, 0, 1], [0, 0, -1]], "friction": 0.5}


def test_elliptic_cone_becomes_round() -> None:
    grasp = presets.tripod([[0.5, 0.5], [0.2, 0.8], [1.0, 0.25]])
    np.testing.assert_allclose(grasp.friction, [0.5, 0.4, 0.5])
    rng = np.random.default_rng(0)
    for _ in range(100):
        angle, normal = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.1, 10, 3)
        mu = grasp.models.friction
        edge = np.stack([normal, mu[:, 0] * normal * np.cos(angle), mu[:, 1] * normal * np.sin(angle)], axis=1)
        u, o, t = grasp.to_cone(edge).reshape(-1, 3).T
        np.testing.assert_allclose(np.hypot(o, t), u, rtol=1e-14)
        np.testing.assert_allclose(grasp.to_force(grasp.to_cone(edge)), edge, rtol=1e-15)
        np.testing.assert_allclose(grasp.cone_matrix @ grasp.to_cone(edge), grasp.wrench(edge), atol=1e-14)


def test_round_elliptic_is_round() -> None:
    same, plain = presets.tripod(np.full((3, 2), 0.5)), presets.tripod(0.5)
    np.testing.assert_array_equal(same.cone_matrix, plain.cone_matrix)
    np.testing.assert_array_equal(same.pseudoinverse, plain.pseudoinverse)


def test_frictionless_contacts_push_only() -> None:
    rng = np.random.default_rng(1)
    plain = random_grasp(rng, 5)
    grasp = Grasp.from_contacts(plain.positions, plain.normals, 0.5, contact_model=["hard"] * 4 + ["frictionless"])
    assert (grasp.cone_matrix[:, 13:] == 0.0).all()
    assert (grasp.pseudoinverse[13:] == 0.0).all()
    assert grasp.friction[4] == 0.0
    force = rng.standard_normal((5, 3))
    np.testing.assert_array_equal(grasp.to_force(grasp.to_cone(force))[4], [force[4, 0], 0.0, 0.0])
    with pytest.raises(RankDeficientGraspError, match="rank"):
        Grasp.from_contacts(plain.positions, plain.normals, 0.5, contact_model="frictionless")


def test_two_soft_contacts_have_rank_six_and_two_hard_ones_not() -> None:
    grasp = Grasp.from_contacts(**PINCH, contact_model="soft", torsional_friction=0.005)
    whole = np.concatenate([grasp.matrix, grasp.torsion_matrix], axis=1)
    assert np.linalg.matrix_rank(whole) == 6
    assert not grasp.hard
    np.testing.assert_allclose(grasp.wrench(np.zeros((2, 3)), [0.1, 0.0]), [0, 0, 0, 0, 0, 0.1])
    assert grasp.residual(np.zeros((2, 3)), np.array([0, 0, 0, 0, 0, -0.1]), np.array([0.1, 0.0])) == 0.0
    with pytest.raises(RankDeficientGraspError, match="two soft ones"):
        Grasp.from_contacts(**PINCH)


def test_given_tangents_are_projected() -> None:
    plain = presets.tripod()
    turned = Grasp.from_contacts(plain.positions, plain.normals, 0.5, tangents=np.tile([0.1, 0.2, 3.0], (3, 1)))
    for normal, frame in zip(turned.normals, turned.frames, strict=True):
        assert abs(frame[:, 1] @ normal) < 1e-15
        assert frame[:, 1] @ [0.1, 0.2, 3.0] > 0.0
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1.0)
    again = turned.with_friction(0.3)
    np.testing.assert_allclose(again.frames, turned.frames, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"contact_model": "soft"}, "soft contacts need torsional_friction"),
        ({"contact_model": "soft", "torsional_friction": 0.0}, "torsional_friction must be > 0"),
        ({"contact_model": "soft", "torsional_friction": [0.1]}, r"torsional_friction must have shape \(3,\)"),
        ({"contact_model": ["hard", "hard"]}, "contact_model must be one name or 3 of them, got 2"),
        ({"tangents": np.tile([1.0, 0.0, 0.0], (3, 1))}, "tangent 0 is .* along its normal"),
        ({"friction": [[0.5, 0.0]] * 3}, "friction must be > 0"),
    ],
)
def test_wrong_models(change: dict, message: str) -> None:
    preset = presets.tripod()
    given = {"positions": preset.positions, "normals": preset.normals, "friction": 0.5, **change}
    with pytest.raises(InvalidInputError, match=message):
        Grasp.from_contacts(**given)


def test_unknown_model() -> None:
    preset = presets.tripod()
    with pytest.raises(UnknownNameError, match="unknown contact model 'rigid': choose one of 'hard', 'soft'"):
        Grasp.from_contacts(preset.positions, preset.normals, 0.5, contact_model="rigid")


def test_weights_per_contact() -> None:
    with pytest.raises(ValueError, match="force_weight has 2 entries, the grasp 3 contacts"):
        Objective([1.0, 2.0]).weights(3)
    with pytest.raises(ValueError, match=r"barrier_weight\[1\] must be finite and > 0"):
        Objective(1.0, [0.1, 0.0])
    assert Objective([1.0, 2.0], 0.1) == Objective((1.0, 2.0), 0.1)
    assert hash(Objective([1.0, 2.0])) == hash(Objective((1.0, 2.0)))
