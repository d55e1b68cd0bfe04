"""Open edges of meshes: sides with corners of others on them, and walls between joined solids."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from trimesh import Trimesh, creation
from trimesh.transformations import random_rotation_matrix

from grasp_env.sim.mesh_shape import volume
from grasp_env.sim.objects.closing import close_mesh
from grasp_env.sim.objects.seams import without_sheets

SIDES = (0.06, 0.05, 0.04)
WHOLE = float(np.prod(SIDES))
SPLIT = "faces were split where corners of others lie on their sides"


def box(length: float, start: float) -> Trimesh:
    return creation.box((length, *SIDES[1:])).apply_translation((start + 0.5 * length, 0.0, 0.0))


def mesh(corners: Any, faces: Any) -> Trimesh:
    return Trimesh(corners, faces, process=False)


def with_corners_on_a_side(*shares: float) -> Trimesh:
    """A box one of whose faces is a fan at one side; its neighbour keeps the long side."""
    solid = box(SIDES[0], 0.0)
    corners = np.array(solid.vertices)
    first, last, apex = solid.faces[0].tolist()
    middle = [corners[first] + share * (corners[last] - corners[first]) for share in shares]
    chain = [first, *range(len(corners), len(corners) + len(shares)), last]
    fan = [(low, high, apex) for low, high in pairwise(chain)]
    return mesh(np.vstack([corners, *middle]), np.vstack([solid.faces[1:], fan]))


def with_a_wall(length: float) -> Trimesh:
    """A box, and one of this length on its side; the wall between them belongs to one of them."""
    whole, other = box(SIDES[0], -SIDES[0]), box(length, 0.0)
    faces = np.array(other.faces)[np.array(other.face_normals)[:, 0] > -0.5]
    return mesh(np.vstack([whole.vertices, other.vertices]), np.vstack([whole.faces, 8 + faces]))


CASES: dict[str, tuple[Callable[[], Trimesh], float, str]] = {
    "a corner on a side": (lambda: with_corners_on_a_side(0.3), WHOLE, f"1 {SPLIT}"),
    "three corners": (lambda: with_corners_on_a_side(0.2, 0.5, 0.9), WHOLE, f"1 {SPLIT}"),
    "a wall": (lambda: with_a_wall(0.06), 2.0 * WHOLE, "2 faces of inner walls were dropped"),
    "a wall by a thin plate": (
        lambda: with_a_wall(0.01),
        7.0 / 6.0 * WHOLE,
        "2 faces of inner walls were dropped",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_solid_is_closed_exactly(name):
    make, expected, message = CASES[name]
    solid = make()
    solid.apply_transform(random_rotation_matrix(np.random.default_rng(4).random(3)))
    corners, faces, changes = close_mesh(np.array(solid.vertices), np.array(solid.faces), "mesh")
    assert message in changes
    assert not any("holes" in change for change in changes)
    assert volume(corners, faces) == pytest.approx(expected, rel=1e-9)
    assert mesh(corners, faces).is_watertight


def test_a_thin_part_between_others_is_no_wall():
    """Without its sides the mesh would be closed, too, and they are smaller than the walls."""
    thin, end = with_a_wall(0.004), box(0.05, 0.004)
    faces = np.array(end.faces)[np.array(end.face_normals)[:, 0] > -0.5]
    corners = np.vstack([thin.vertices, end.vertices])
    faces = np.vstack([thin.faces, len(thin.vertices) + faces])
    corners, faces, changes = close_mesh(corners, faces, "mesh")
    assert "4 faces of inner walls were dropped" in changes
    assert volume(corners, faces) == pytest.approx(0.114 / 0.06 * WHOLE, rel=1e-9)


def test_an_open_part_is_no_wall():
    """Without it the mesh would be closed, but the object would have lost a part."""
    handle = creation.annulus(0.01, 0.012, 0.1)
    tube = np.array(handle.faces)[np.abs(np.array(handle.face_normals)[:, 2]) < 0.5]
    corners = np.vstack([box(0.2, 0.0).vertices, handle.vertices])
    faces = np.vstack([box(0.2, 0.0).faces, 8 + tube])
    assert len(without_sheets(corners, faces)) == len(faces)
