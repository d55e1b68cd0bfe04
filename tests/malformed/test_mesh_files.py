"""Mesh files of every kind: hostile ones are refused soon and with little memory, spoiled ones in words, whole ones are read as others read them."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from malformed.meshes import CORNERS, FACES, HOSTILE, VALID, outcome

from grasp_env.errors import InvalidInputError
from grasp_env.sim.mesh_files import KINDS, read_mesh, read_mesh_bytes


@pytest.fixture(scope="module")
def outcomes() -> dict[str, tuple[str, float]]:
    """Of all hostile files, in one process of limited memory."""
    done = subprocess.run([sys.executable, Path(__file__).with_name("meshes.py")], cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=120, check=False, env={"PYTHONPATH": ".", "OPENBLAS_NUM_THREADS": "1"})  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_soon_and_with_little_memory(
    outcomes: dict[str, tuple[str, float]], name: str
) -> None:
    told, seconds = outcomes[name]
    assert re.search(HOSTILE[name][2], told), told
    assert len(told) < 500
    assert seconds < 10.0  # minutes without the limits; one to four seconds on two shared cores


def triangles(corners: Any, faces: Any) -> list[Any]:
    """Each triangle from its least corner on, sorted."""
    found = np.asarray(corners)[np.asarray(faces)].round(5) + 0.0
    turned = (min((tuple(map(tuple, np.roll(face, k, axis=0)))) for k in range(3)) for face in found)
    return sorted(turned)


@pytest.mark.parametrize("name", VALID)
def test_whole_files_are_read(name: str) -> None:
    kind, blob = VALID[name]
    found = read_mesh_bytes(blob, kind, "it")
    assert (found[0].dtype, found[1].dtype) == (np.float64, np.int64)
    expected = triangles(CORNERS, FACES)
    if "placed" in name:
        doubled = np.multiply(CORNERS, (-2.0, -2.0, 2.0))
        shifted = np.add(CORNERS, (5.0, 0.0, 0.0))
        numbers = np.vstack([FACES, np.array(FACES) + 4])[: 4 if name.startswith("dae") else 8]
        expected = triangles(np.vstack([doubled, shifted]), numbers)
    assert triangles(*found) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_files_are_read_as_trimesh_reads_them(kind: str, tmp_path: Path) -> None:
    scene = trimesh.Scene([trimesh.creation.icosphere(2), trimesh.creation.box((1, 2, 3)).apply_translation((3, 0, 0))])
    whole: Any = scene.to_mesh()
    (scene if kind == ".glb" else whole).export(tmp_path / f"a{kind}")
    blob = (tmp_path / f"a{kind}").read_bytes()
    found = read_mesh(tmp_path / f"a{kind}", "it")
    other: Any = trimesh.load(io.BytesIO(blob), file_type=kind[1:], force="mesh", process=False)
    assert len(found[1]) == len(whole.faces)
    assert triangles(*found) == triangles(other.vertices, other.faces)


@pytest.mark.parametrize("name", VALID)
def test_spoiled_files_are_meshes_or_refused_in_words(name: str) -> None:
    kind, blob = VALID[name]
    rng = np.random.default_rng(sum(name.encode()))
    for _ in range(300):
        spoiled = bytearray(blob)
        for at in rng.integers(0, len(blob), rng.integers(1, 4)):
            spoiled[at] = rng.choice(
                [rng.integers(256), 0, 255, ord("-"), ord("9"), spoiled[at] ^ 1 << rng.integers(8)]
            )
        cut = bytes(spoiled[: rng.integers(0, len(blob))] if rng.random() < 0.1 else spoiled)
        try:
            corners, faces = read_mesh_bytes(cut, kind, "it")
        except InvalidInputError:
            continue
        assert corners.shape == (len(corners), 3)
        assert faces.shape == (len(faces), 3)
        assert 0 <= faces.min() <= faces.max() == len(corners) - 1
        assert np.isfinite(corners).all()


def test_what_is_told_of_too_many_faces_says_how_to_have_fewer() -> None:
    told, _ = outcome(".stl", HOSTILE["stl: 300,000 faces"][1]())
    assert "allowed are up to 200000" in told
    assert "pip install trimesh fast-simplification" in told


def test_kinds_that_are_not_read(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"of no kind that is read: \.obj, \.stl"):
        read_mesh(tmp_path / "a.zip", "it")
    with pytest.raises(InvalidInputError, match="cannot read it"):
        read_mesh(tmp_path / "a.glb", "it")
