"""`HandKinematics.contacts`: the contact points of the fingertips, from joint angles."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics, ObjectDescription

KINEMATICS = HandKinematics(HandDescription.allegro())
HOME = KINEMATICS.home
TIPS = KINEMATICS.tips(HOME)
TURN = Rotation.from_rotvec([0.4, -0.7, 0.2])
PLACE = np.array([0.02, -0.01, 0.05])
POSE = np.concatenate([PLACE, TURN.as_quat()])
INWARD = np.tile([0.6, 0.0, -0.8], (4, 1))


def test_contacts_on_a_ball():
    """By hand: the normals point to the centre. Rounding is the only error."""
    points, normals, gaps = KINEMATICS.contacts(HOME, ObjectDescription("sphere", (0.06,)), POSE)
    away = np.linalg.norm(PLACE - TIPS, axis=1, keepdims=True)
    assert_allclose(normals, (PLACE - TIPS) / away, atol=1e-12)
    assert_allclose(points, TIPS + KINEMATICS.tip_radii[:, None] * normals, atol=1e-12)
    assert_allclose(gaps, away[:, 0] - 0.03 - KINEMATICS.tip_radii, atol=1e-12)


def test_contacts_on_a_turned_box():
    """The point of the surface lies a gap from the contact point, along the normal."""
    box = ObjectDescription("cuboid", (0.05, 0.03, 0.08))
    points, normals, gaps = KINEMATICS.contacts(HOME, box, POSE)
    nearest = TURN.inv().apply(points + gaps[:, None] * normals - PLACE)
    half = np.array([0.025, 0.015, 0.04])
    assert (np.abs(nearest) <= half + 1e-12).all()
    assert_allclose(np.abs(np.abs(nearest) - half).min(axis=1), 0.0, atol=1e-12)


def test_an_object_is_at_the_origin_by_default():
    item = ObjectDescription("sphere", (0.06,))
    plain = KINEMATICS.contacts(HOME, item)
    placed = KINEMATICS.contacts(HOME, item, [0, 0, 0, 0, 0, 0, 1])
    for one, other in zip(plain, placed, strict=True):
        assert_allclose(one, other, atol=1e-15)


def test_normals_without_an_object():
    points, normals, gaps = KINEMATICS.contacts(HOME, normals=1.005 * INWARD)
    assert_allclose(normals, INWARD, atol=1e-12)  # of exact length
    assert_allclose(points, TIPS + KINEMATICS.tip_radii[:, None] * INWARD, atol=1e-12)
    assert np.isnan(gaps).all()


BALL = ObjectDescription("sphere", (0.06,))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "give an item or normals, and not both"),
        ({"item": BALL, "normals": INWARD}, "give an item or normals, and not both"),
        ({"item": "sphere"}, "item must be an ObjectDescription"),
        ({"normals": INWARD, "pose": POSE}, "a pose belongs to an item"),
        ({"normals": INWARD[:3]}, r"normals must have shape \(4, 3\)"),
        ({"normals": 2.0 * INWARD}, "normals must have length 1, to 1 %"),
        ({"normals": np.nan * INWARD}, "normals must be finite"),
        ({"item": BALL, "pose": POSE[:6]}, r"pose must have shape \(7,\)"),
        ({"item": BALL, "pose": np.zeros(7)}, "quaternion of a pose must have length 1"),
    ],
)
def test_wrong_arguments_are_named(given, words):
    with pytest.raises(InvalidInputError, match=words):
        KINEMATICS.contacts(HOME, **given)


def test_wrong_angles_are_named():
    with pytest.raises(InvalidInputError, match="angles must have shape"):
        KINEMATICS.contacts(HOME[:3], BALL)
