"""Mesh files: valid ones are read as trimesh reads them, wrong ones end nothing."""

from __future__ import annotations

import io
import re
import time
from typing import Any

import numpy as np
import pytest
import trimesh
from sim.mesh_samples import CORNERS, FACES, HEAVY, LONG, VALID, WRONG

from grasp_env.errors import InvalidInputError
from grasp_env.sim import mesh_files
from grasp_env.sim.mesh_files import KINDS
from grasp_env.sim.objects import reading
from grasp_env.sim.objects.reading import MeshFile, open_mesh, read_mesh, read_meshes


def triangles(corners: Any, faces: Any) -> list[Any]:
    """Each triangle from its smallest corner on, in the file's order."""
    found = np.asarray(corners)[np.asarray(faces)].round(5) + 0.0
    return [min(tuple(map(tuple, np.roll(face, k, axis=0))) for k in range(3)) for face in found]


def test_valid_files_are_read_by_one_process(monkeypatch):
    """Corners and faces stay in the file's order, whatever their materials; poses of nodes are
    applied."""
    runs = list[str]()
    apart = reading.apart
    monkeypatch.setattr(
        reading,
        "apart",
        lambda task, text, *given, **more: runs.append(text) or apart(task, text, *given, **more),
    )
    found = read_meshes([MeshFile(blob, kind, name) for name, (kind, blob) in VALID.items()])
    assert runs == [f"reading {len(VALID)} mesh files, once for this content"]
    doubled = np.multiply(CORNERS, (-2.0, -2.0, 2.0))
    shifted = np.add(CORNERS, (5.0, 0.0, 0.0))
    for (name, (kind, _)), mesh in zip(VALID.items(), found, strict=True):
        assert not isinstance(mesh, InvalidInputError), mesh
        assert (mesh[0].dtype, mesh[1].dtype) == (np.float64, np.int64)
        expected = triangles(CORNERS, FACES)
        if "placed" in name:
            numbers = np.vstack([FACES, np.array(FACES) + 4])[: 4 if kind == ".dae" else 8]
            expected = triangles(np.vstack([doubled, shifted]), numbers)
        assert (
            sorted(triangles(*mesh)) == sorted(expected)
            if kind == ".glb"
            else triangles(*mesh) == expected
        ), name


def test_files_are_read_as_trimesh_reads_them(tmp_path):
    scene = trimesh.Scene(
        [
            trimesh.creation.icosphere(1),
            trimesh.creation.box((1, 2, 3)).apply_translation((3, 0, 0)),
        ]
    )
    whole: Any = scene.to_mesh()
    for kind in KINDS:
        (scene if kind == ".glb" else whole).export(tmp_path / f"a{kind}")
    files = [open_mesh(tmp_path / f"a{kind}", "it") for kind in KINDS]
    for kind, file, found in zip(KINDS, files, read_meshes(files), strict=True):
        other: Any = trimesh.load(
            io.BytesIO(file.content), file_type=kind[1:], force="mesh", process=False
        )
        assert not isinstance(found, InvalidInputError)
        assert len(found[1]) == len(whole.faces)
        assert triangles(*found) == triangles(other.vertices, other.faces)


def test_wrong_files_are_told_in_one_sentence_each():
    told = read_meshes(
        [
            MeshFile(blob, f".{name.partition(':')[0]}", f"the mesh {name}")
            for name, (blob, _) in WRONG.items()
        ]
    )
    for (name, (_, message)), error in zip(WRONG.items(), told, strict=True):
        assert isinstance(error, InvalidInputError), name
        assert re.fullmatch(rf"the mesh {re.escape(name)} .*({message}).*", str(error)), (
            name,
            str(error),
        )
        assert "; " in str(error), name  # the remedy
        assert len(str(error)) < 500, name


@pytest.mark.parametrize(
    ("seconds", "blob", "message"),
    [
        (
            60.0,
            HEAVY,
            "bomb needs more than 2000 MB to be read; allowed are up to 200000 faces; simplify it",
        ),
        (
            3.0,
            LONG,
            "bomb took more than 3 s to be read as .glb; allowed are up to 200000 faces; simplify it",
        ),
    ],
    ids=["memory", "time"],
)
def test_a_bomb_ends_in_a_sentence(seconds, blob, message, monkeypatch):
    monkeypatch.setattr(reading, "SECONDS", seconds)
    begun = time.monotonic()
    with pytest.raises(InvalidInputError, match=message):
        read_mesh(MeshFile(blob, ".glb", "bomb"))
    assert time.monotonic() - begun < seconds + 30.0


@pytest.mark.parametrize(
    ("end", "message"),
    [
        (
            ChildProcessError("exit code -11"),
            r"bad made trimesh crash \(exit code -11\); export it again as",
        ),
        (ChildProcessError("Traceback\nMemoryError: no room\n"), "bad needs more than 2000 MB"),
        (TimeoutError("it took more than 30 s"), "bad took more than 30 s to be read as .off"),
    ],
)
def test_a_crash_costs_no_file_beside_it(end, message, monkeypatch):
    def run(*_: Any, kinds: Any, memory: int, variables: Any, **files: Any) -> Any:
        if ".off" in kinds:
            raise end
        return mesh_files.read_files(kinds, **files)

    monkeypatch.setattr(reading, "apart", run)
    good = [MeshFile(blob, kind, name) for name, (kind, blob) in VALID.items() if kind != ".off"]
    found = read_meshes([*good, MeshFile(b"OFF", ".off", "bad")])
    assert not any(isinstance(mesh, InvalidInputError) for mesh in found[:-1])
    assert re.match(message, str(found[-1]))


def test_memory_is_told_of_a_file_alone(monkeypatch):
    """Files that need too much memory together may each need little, so the process of several
    files ends and each is read alone."""

    def load(blob: bytes, kind: str) -> Any:
        raise MemoryError

    monkeypatch.setattr(mesh_files, "_by_trimesh", load)
    file = np.zeros(1, np.uint8)
    assert (
        mesh_files.read_files(np.array([".obj"]), file0=file)["fault0"]
        == mesh_files.TOO_MUCH_MEMORY
    )
    with pytest.raises(MemoryError):
        mesh_files.read_files(np.array([".obj", ".stl"]), file0=file, file1=file)

    rng = np.random.default_rng(0)
    files = list[MeshFile]()
    for name, (kind, blob) in VALID.items():
        for _ in range(30):
            damaged = bytearray(blob)
            for at in rng.integers(0, len(blob), rng.integers(1, 4)):
                flipped = damaged[at] ^ 1 << int(rng.integers(8))
                damaged[at] = int(
                    rng.choice(np.array([rng.integers(256), 0, 255, ord("-"), ord("9"), flipped]))
                )
            files.append(MeshFile(bytes(damaged), kind, name))
    meshes = [found for found in read_meshes(files) if not isinstance(found, InvalidInputError)]
    assert 40 < len(meshes) < 400
    for corners, faces in meshes:
        assert corners.shape == (len(corners), 3)
        assert faces.shape == (len(faces), 3)
        assert 0 <= faces.min() <= faces.max() == len(corners) - 1
        assert np.isfinite(corners).all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.zip", b"", r"the mesh is not of a supported type: \.obj, \.stl, .*; export it"),
        ("a.glb", None, r"cannot read the mesh: No such file or directory; check the path"),
        ("a.obj", b"", "the mesh is empty; export it again"),
        ("a.off", 10**9, r"cannot read the mesh: it is larger than 20 MB; .* simplify it"),
    ],
)
def test_files_that_are_not_opened(name, content, message, tmp_path):
    path = tmp_path / name
    if isinstance(content, int):
        with path.open("wb") as file:
            file.truncate(content)
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(InvalidInputError, match=message):
        open_mesh(path, "the mesh")
