"""`grasp object`: shows what becomes of a mesh, mends torn ones, and looks after what is kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from grasp_env.errors import GraspWarning, InvalidInputError
from grasp_env.sim import ObjectDescription
from grasp_env.sim.mesh_files import read_mesh
from grasp_env.sim.objects import apart
from grasp_env.sim.objects.closing import closed
from training.cli import main
from training.commands import mending

BALL = trimesh.creation.icosphere(3, 0.05)
CORNERS, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)
TORN = FACES[np.arange(len(FACES)) % 3 != 0]
"""A ball without a third of its faces: its holes meet in corners."""


def holes(count: int) -> Any:
    """The ball's faces without the three neighbours of `count` faces far from one another, which hang by their corners."""
    gone, used = list[int](), set[int]()
    for face in FACES:
        shared = np.isin(FACES, face).sum(axis=1)
        near = set(FACES[shared > 0].ravel().tolist())
        if not near & used and len(gone) < 3 * count:
            gone += np.flatnonzero(shared == 2).tolist()
            used |= near
    assert len(gone) == 3 * count
    return np.delete(FACES, gone, axis=0)


def save(path: Path, corners: Any, faces: Any) -> str:
    trimesh.Trimesh(corners, faces, process=False).export(path)
    return str(path)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder for the test alone."""
    monkeypatch.setattr("platformdirs.user_cache_path", lambda *_, **__: tmp_path / "cache")
    return tmp_path / "cache" / "objects"


@pytest.fixture
def answer(capsys: pytest.CaptureFixture[str]) -> Any:
    def ask(*words: str) -> tuple[int, dict[str, Any]]:
        capsys.readouterr()
        code = main(["object", *words, "--json"])
        return code, json.loads(capsys.readouterr().out)

    return ask


def test_a_mesh_is_told_and_drawn(tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ring = trimesh.creation.annulus(30.0, 50.0, 40.0)
    ring.apply_translation((0.0, 0.0, 7.0))
    path = save(tmp_path / "ring.obj", ring.vertices, ring.faces)
    assert main(["object", "show", path, "--scale", "0.001", "--draw", str(tmp_path / "ring.png"), "--size", "64"]) == 0
    told = capsys.readouterr().out
    for words in ("ring.obj", str(len(ring.faces)), "100.0 x 100.0 x 40.0", f"{1e-3 * ring.volume:.4g}", "0.0 0.0 7.0"):
        assert words in told
    assert "repaired" not in told
    assert f"kept in {cache}\n" in told
    picture = np.array(Image.open(tmp_path / "ring.png")).astype(int)
    assert picture.shape == (64, 128, 3)
    spread = np.ptp(picture, axis=2)  # of colour: the mesh has one pale one, pieces have strong ones
    assert spread[:, :64].max() < 60 < spread[:, 64:].max()
    (reddest,) = {row.argmax() for row in picture[:, :64][spread[:, :64] > 15]}
    assert reddest == 0
    assert {row.argmax() for row in picture[:, 64:][spread[:, 64:] > 30]} == {0, 1, 2}  # pieces of several hues


def test_repairs_are_told(tmp_path: Path, answer: Any, capsys: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path / "open.obj", CORNERS, FACES[1:])
    code, told = answer("show", path)
    assert code == 0
    assert (told["faces"], told["pieces"], told["picture"]) == (len(FACES), 1, None)
    assert told["volume"] == pytest.approx(BALL.volume)
    assert told["extent"] == pytest.approx(BALL.extents)
    (repaired,) = told["repaired"]
    assert "holes were filled with 1 faces" in repaired
    assert main(["object", "show", path]) == 0
    assert f"repaired: {repaired}" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["third", "ten"])
def test_a_torn_mesh_is_refused_mended_and_accepted(tmp_path: Path, name: str, answer: Any) -> None:
    faces = {"third": TORN, "ten": holes(10)}[name]
    path = save(tmp_path / f"{name}.obj", CORNERS, faces)
    with pytest.raises(InvalidInputError, match=r"is not closed.*mend it with `grasp object mend FILE`"):
        ObjectDescription.from_mesh(path)
    code, told = answer("mend", path)
    assert code == 0
    assert told["out"] == str(tmp_path / f"{name}_mended.obj")
    assert (told["faces_before"], told["parts"], told["parts_left_out"]) == (len(faces), 1, 0)
    item = ObjectDescription.from_mesh(told["out"])  # a warning would be an error: nothing is left to repair
    assert len(item.faces[1]) == told["faces_after"]
    assert item.extent == pytest.approx((0.1, 0.1, 0.1), rel=0.05)
    assert told["volume"] == pytest.approx(BALL.volume, rel=0.05)  # what is missing is guessed
    assert told["faces_kept"] > 0.3 * len(faces)
    assert read_mesh(path, "it")[1].shape == faces.shape  # the file stays


def test_separate_holes_are_filled_without_mending(tmp_path: Path) -> None:
    path = save(tmp_path / "holes.obj", CORNERS, np.delete(FACES, np.arange(0, len(FACES), len(FACES) // 10), axis=0))
    with pytest.warns(GraspWarning, match="filled with 10 faces"):
        assert len(ObjectDescription.from_mesh(path).faces[1]) == len(FACES)


def test_all_parts_and_hollows_are_kept(tmp_path: Path, answer: Any) -> None:
    inner = FACES[:, ::-1] + len(CORNERS)
    other = TORN + 2 * len(CORNERS)
    crumb = np.array([[0, 1, 2]]) + 3 * len(CORNERS)
    corners = np.vstack(
        [
            CORNERS,
            0.5 * CORNERS,
            CORNERS + np.array((0.2, 0.0, 0.0)),
            [[0.0, 0.3, 0.0], [0.1, 0.3, 0.0], [0.0, 0.3, 0.1]],
        ]
    )
    path = save(tmp_path / "parts.obj", corners, np.vstack([FACES[5:], inner, other, crumb]))
    code, told = answer("mend", path)
    assert code == 0
    assert (told["parts"], told["parts_left_out"]) == (3, 1)
    assert told["volume"] == pytest.approx((1.0 - 0.125 + 1.0) * BALL.volume, rel=0.05)
    corners, _, changes = closed(*read_mesh(told["out"], "it"), "it")
    assert changes == []
    assert np.ptp(corners, axis=0) == pytest.approx((0.3, 0.1, 0.1), rel=0.05)


def test_a_closed_mesh_stays_as_it_is(tmp_path: Path, answer: Any, capsys: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path / "ball.stl", 1e3 * CORNERS, FACES)
    out = tmp_path / "whole.obj"
    code, told = answer("mend", path, "--out", str(out))
    assert (code, told["faces_kept"], told["faces_after"], told["changes"]) == (0, len(FACES), len(FACES), [])
    assert told["volume"] == pytest.approx(1e9 * BALL.volume, rel=1e-5)  # in the unit of the file, which has 7 digits
    assert main(["object", "mend", path, "--out", str(out)]) == 0  # --out may exist
    assert f"look at it: grasp object show {out} --draw {out.with_suffix('.png')}" in capsys.readouterr().out


def test_nothing_is_overwritten_unasked(tmp_path: Path, answer: Any) -> None:
    path = save(tmp_path / "ball.obj", CORNERS, FACES)
    kept = tmp_path / "ball_mended.obj"
    kept.write_text("mine")
    code, told = answer("mend", path)
    assert (code, kept.read_text()) == (2, "mine")
    assert f"--out {kept}" in told["error"]["message"]
    assert answer("mend", path, "--out", str(kept))[0] == 0
    assert kept.read_text() != "mine"
    assert {entry.name for entry in tmp_path.glob(".*")} == set()  # nothing half written


def test_what_cannot_be_mended_says_what_to_do(tmp_path: Path, answer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    flat = save(tmp_path / "flat.obj", CORNERS * (1.0, 1.0, 0.0), FACES[:100])
    one = save(tmp_path / "one.obj", CORNERS, FACES[:1])
    for path in (flat, one):
        code, told = answer("mend", path)
        assert code == 2
        assert "cannot be mended" in told["error"]["message"]
        assert "Blender" in told["error"]["message"]
    torn = save(tmp_path / "torn.obj", CORNERS, TORN)
    monkeypatch.setattr(mending, "LONGEST", 0.01)
    assert "did not end within" in answer("mend", torn)[1]["error"]["message"]
    monkeypatch.undo()
    monkeypatch.setattr(apart.sys, "executable", "/bin/false")
    assert "broke off" in answer("mend", torn)[1]["error"]["message"]
    assert not list(tmp_path.glob("*mended*"))


def test_what_is_kept_is_listed_and_removed(
    tmp_path: Path, cache: Path, answer: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert answer("list") == (0, {"folder": str(cache), "meshes": []})
    for name in ("ball", "box"):
        mesh = BALL if name == "ball" else trimesh.creation.box((0.05, 0.06, 0.07))
        ObjectDescription.from_mesh(save(tmp_path / f"{name}.obj", mesh.vertices, mesh.faces))
    (cache / "spoiled.npz").write_bytes(b"no archive")
    told = {entry["name"]: entry for entry in answer("list")[1]["meshes"]}
    assert {name: entry["pieces"] for name, entry in told.items()} == {"ball.obj": 1, "box.obj": 1, "(not readable)": None}  # fmt: skip
    assert all(entry["bytes"] > 0 for entry in told.values())
    assert main(["object", "list"]) == 0
    people = capsys.readouterr().out
    assert "3 meshes" in people
    assert f"in {cache}\n" in people
    assert main(["object", "clear"]) == 0
    assert "removed 3 meshes" in capsys.readouterr().out
    assert answer("clear")[1]["removed"] == 0
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("show", "needs a FILE"),
        ("mend", "needs a FILE"),
        ("list {ball}", "belongs to `grasp object show` and `grasp object mend`"),
        ("clear {ball}", "leave it out"),
        ("mend {ball} --scale 0.1", "--scale belongs to `grasp object show`"),
        ("show {ball} --out a.obj", "--out belongs to `grasp object mend`"),
        ("show {ball} --size 1", "size must be an integer >= 16"),
        ("show {ball} --draw a.jpg", "must end in .png"),
        ("mend {ball} --out a.stl", "must end in .obj"),
        ("show {ball} --scale 100", "give --scale 0.001"),
        ("show {ball} --scale 0", "scale"),
        ("show nowhere.obj", "nowhere.obj"),
        ("mend nowhere.obj", "nowhere.obj"),
        ("mend nowhere.txt", ".obj, .stl"),
        ("show {ball} --draw /nowhere/a.png", "/nowhere"),
        ("mend {ball} --out /nowhere/a.obj", "/nowhere"),
    ],
)
def test_errors_are_one_line(words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball = save(tmp_path / "ball.obj", CORNERS, FACES)
    assert main(["object", *words.format(ball=ball).split()]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
