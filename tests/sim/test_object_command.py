"""`grasp object`: shows what becomes of a mesh, mends torn ones, lists and clears the cache."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from grasp_env.errors import InvalidInputError
from grasp_env.sim import ObjectDescription
from grasp_env.sim.mesh_files import read_mesh
from grasp_env.sim.objects import apart
from grasp_env.sim.objects.closing import close_mesh
from training.cli import main
from training.commands import mending

BALL = trimesh.creation.icosphere(2, 0.05)
CORNERS, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)
TORN = FACES[np.arange(len(FACES)) % 3 != 0]
"""A ball without a third of its faces: its holes meet in corners."""


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


def test_show(tmp_path: Path, cache: Path, answer: Any, capsys: pytest.CaptureFixture[str]) -> None:
    ring = trimesh.creation.annulus(30.0, 50.0, 40.0, sections=8)
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
    code, told = answer("show", save(tmp_path / "open.obj", CORNERS, FACES[1:]))
    assert (code, told["faces"], told["pieces"], told["picture"]) == (0, len(FACES), 1, None)
    assert (told["volume"], *told["extent"]) == pytest.approx((BALL.volume, *BALL.extents))
    assert "holes were filled with 1 faces" in told["repaired"][0]


def test_a_torn_mesh_is_refused_mended_and_accepted(tmp_path: Path, answer: Any) -> None:
    path = save(tmp_path / "third.obj", CORNERS, TORN)
    with pytest.raises(InvalidInputError, match=r"is not closed.*mend it with `grasp object mend FILE`"):
        ObjectDescription.from_mesh(path)
    code, told = answer("mend", path)
    assert (code, told["out"]) == (0, str(tmp_path / "third_mended.obj"))
    assert (told["faces_before"], told["parts"], told["parts_left_out"]) == (len(TORN), 1, 0)
    corners, faces, changes = close_mesh(*read_mesh(told["out"], "it"), "it")
    assert (changes, len(faces)) == ([], told["faces_after"])
    assert np.ptp(corners, axis=0) == pytest.approx((0.1, 0.1, 0.1), rel=0.05)
    assert told["volume"] == pytest.approx(BALL.volume, rel=0.05)  # missing faces are guessed
    assert told["faces_kept"] > 0.3 * len(TORN)
    assert read_mesh(path, "it")[1].shape == TORN.shape  # the file stays


def test_all_parts_and_hollows_are_kept(tmp_path: Path, answer: Any) -> None:
    count, crumb = len(CORNERS), [[0.0, 0.3, 0.0], [0.1, 0.3, 0.0], [0.0, 0.3, 0.1]]
    corners = np.vstack([CORNERS, 0.5 * CORNERS, CORNERS + np.array((0.2, 0.0, 0.0)), crumb])
    faces = np.vstack([FACES[5:], FACES[:, ::-1] + count, TORN + 2 * count, np.array([[0, 1, 2]]) + 3 * count])
    code, told = answer("mend", save(tmp_path / "parts.obj", corners, faces))
    assert (code, told["parts"], told["parts_left_out"]) == (0, 3, 1)
    assert told["volume"] == pytest.approx((1.0 - 0.125 + 1.0) * BALL.volume, rel=0.05)
    corners, _, changes = close_mesh(*read_mesh(told["out"], "it"), "it")
    assert changes == []
    assert np.ptp(corners, axis=0) == pytest.approx((0.3, 0.1, 0.1), rel=0.05)


def test_a_closed_mesh_is_kept_and_nothing_is_overwritten_by_default(
    tmp_path: Path, answer: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / "ball.stl", 1e3 * CORNERS, FACES)
    out = tmp_path / "ball_mended.obj"
    out.write_text("mine")
    code, told = answer("mend", path)
    assert (code, out.read_text()) == (2, "mine")
    assert f"--out {out}" in told["error"]["message"]
    code, told = answer("mend", path, "--out", str(out))
    assert (code, told["faces_kept"], told["faces_after"], told["changes"]) == (0, len(FACES), len(FACES), [])
    assert told["volume"] == pytest.approx(1e9 * BALL.volume, rel=1e-5)  # in the unit of the file, which has 7 digits
    assert main(["object", "mend", path, "--out", str(out)]) == 0
    assert f"look at it: grasp object show {out} --draw {out.with_suffix('.png')}" in capsys.readouterr().out
    assert not list(tmp_path.glob(".*"))  # nothing half written


def test_mending_that_fails(tmp_path: Path, answer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    flat = save(tmp_path / "flat.obj", CORNERS * (1.0, 1.0, 0.0), FACES[:100])
    for words in ("cannot be mended", "Blender"):
        assert words in answer("mend", flat)[1]["error"]["message"]
    torn = save(tmp_path / "torn.obj", CORNERS, TORN)
    with monkeypatch.context() as patched:
        patched.setattr(mending, "LONGEST", 0.01)
        assert "did not end within" in answer("mend", torn)[1]["error"]["message"]
    monkeypatch.setattr(apart.sys, "executable", "/bin/false")
    assert "broke off" in answer("mend", torn)[1]["error"]["message"]
    assert not list(tmp_path.glob("*mended*"))


def test_list_and_clear(tmp_path: Path, cache: Path, answer: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert answer("list") == (0, {"folder": str(cache), "meshes": []})
    for name, mesh in (("ball", BALL), ("box", trimesh.creation.box((0.05, 0.06, 0.07)))):
        ObjectDescription.from_mesh(save(tmp_path / f"{name}.obj", mesh.vertices, mesh.faces))
    (cache / "spoiled.npz").write_bytes(b"no archive")
    told = {entry["name"]: entry for entry in answer("list")[1]["meshes"]}
    assert {name: entry["pieces"] for name, entry in told.items()} == {"ball.obj": 1, "box.obj": 1, "(not readable)": None}  # fmt: skip
    assert all(entry["bytes"] > 0 for entry in told.values())
    assert main(["object", "list"]) == 0
    assert f"in {cache}\n" in capsys.readouterr().out
    assert answer("clear")[1]["removed"] == 3
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("show", "needs a FILE"),
        ("list {ball}", "belongs to `grasp object show` and `grasp object mend`"),
        ("clear {ball}", "leave it out"),
        ("show {ball} --out a.obj", "--out belongs to `grasp object mend`"),
        ("show {ball} --size 1", "size must be an integer >= 16"),
        ("show {ball} --draw a.jpg", "must end in .png"),
        ("mend {ball} --out a.stl", "must end in .obj"),
        ("show {ball} --scale 100", "give --scale 0.001"),
        ("show nowhere.obj", "nowhere.obj"),
        ("mend nowhere.txt", ".obj, .stl"),
        ("show {ball} --draw /nowhere/a.png", "/nowhere"),
    ],
)
def test_errors_are_one_line(words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball = save(tmp_path / "ball.obj", CORNERS, FACES)
    assert main(["object", *words.format(ball=ball).split()]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
