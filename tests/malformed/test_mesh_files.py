"""Mesh files of every kind: hostile ones are refused fast and with little memory, valid ones are read as trimesh reads them."""

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


def test_hostile_files_are_refused_fast_and_with_little_memory() -> None:
    done = subprocess.run([sys.executable, Path(__file__).with_name("meshes.py")], cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=300, check=False, env={"PYTHONPATH": ".", "OPENBLAS_NUM_THREADS": "1"})  # fmt: skip
    assert done.returncode == 0, done.stderr
    outcomes = json.loads(done.stdout)
    assert outcomes.keys() == HOSTILE.keys()
    for name, (message, seconds) in outcomes.items():
        assert re.search(HOSTILE[name][2], message), (name, message)
        assert len(message) < 500, name
        assert seconds < 10.0, name  # minutes without the limits


def triangles(corners: Any, faces: Any) -> list[Any]:
    """Each triangle from its smallest corner on, sorted."""
    found = np.asarray(corners)[np.asarray(faces)].round(5) + 0.0
    return sorted(min(tuple(map(tuple, np.roll(face, k, axis=0))) for k in range(3)) for face in found)


@pytest.mark.parametrize("name", VALID)
def test_valid_files_are_read(name: str) -> None:
    kind, blob = VALID[name]
    found = read_mesh_bytes(blob, kind, "it")
    assert (found[0].dtype, found[1].dtype) == (np.float64, np.int64)
    expected = triangles(CORNERS, FACES)
    if "placed" in name:
        doubled, shifted = np.multiply(CORNERS, (-2.0, -2.0, 2.0)), np.add(CORNERS, (5.0, 0.0, 0.0))
        numbers = np.vstack([FACES, np.array(FACES) + 4])[: 4 if kind == ".dae" else 8]
        expected = triangles(np.vstack([doubled, shifted]), numbers)
    assert triangles(*found) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_files_are_read_as_trimesh_reads_them(kind: str, tmp_path: Path) -> None:
    scene = trimesh.Scene([trimesh.creation.icosphere(1), trimesh.creation.box((1, 2, 3)).apply_translation((3, 0, 0))])
    whole: Any = scene.to_mesh()
    (scene if kind == ".glb" else whole).export(tmp_path / f"a{kind}")
    blob = (tmp_path / f"a{kind}").read_bytes()
    found = read_mesh(tmp_path / f"a{kind}", "it")
    other: Any = trimesh.load(io.BytesIO(blob), file_type=kind[1:], force="mesh", process=False)
    assert len(found[1]) == len(whole.faces)
    assert triangles(*found) == triangles(other.vertices, other.faces)


@pytest.mark.parametrize("name", VALID)
def test_damaged_files_are_meshes_or_refused(name: str) -> None:
    kind, blob = VALID[name]
    rng = np.random.default_rng(sum(name.encode()))
    for _ in range(100):
        damaged = bytearray(blob)
        for at in rng.integers(0, len(blob), rng.integers(1, 4)):
            flipped = damaged[at] ^ 1 << int(rng.integers(8))
            damaged[at] = int(rng.choice(np.array([rng.integers(256), 0, 255, ord("-"), ord("9"), flipped])))
        try:
            corners, faces = read_mesh_bytes(bytes(damaged), kind, "it")
        except InvalidInputError:
            continue
        assert corners.shape == (len(corners), 3)
        assert faces.shape == (len(faces), 3)
        assert 0 <= faces.min() <= faces.max() == len(corners) - 1
        assert np.isfinite(corners).all()


def test_advice_in_messages(tmp_path: Path) -> None:
    message, _ = outcome(".stl", HOSTILE["stl: 300,000 faces"][1])
    assert "allowed are up to 200000" in message
    assert "pip install trimesh fast-simplification" in message
    with pytest.raises(InvalidInputError, match=r"of no kind that is read: \.obj, \.stl"):
        read_mesh(tmp_path / "a.zip", "it")
    with pytest.raises(InvalidInputError, match="cannot read it"):
        read_mesh(tmp_path / "a.glb", "it")
