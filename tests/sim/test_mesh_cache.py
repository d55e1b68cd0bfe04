"""`grasp object`, the cache of processed meshes, and processes of their own."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from processes import start
from trimesh import creation

from grasp_env.errors import InvalidInputError
from grasp_env.sim import ObjectDescription, progress
from grasp_env.sim.bullet_body import create_body
from grasp_env.sim.objects import cache, mesh, pieces
from grasp_env.sim.objects.apart import apart
from grasp_env.sim.objects.cache import cached, clear, entries, folder
from grasp_env.sim.objects.closing import close_mesh
from grasp_env.sim.objects.reading import open_mesh, read_mesh
from training.program.cli import main
from training.program.commands import mesh_repair

pytestmark = pytest.mark.usefixtures("own_cache")

BALL = trimesh.creation.icosphere(2, 0.05)
CORNERS = np.asarray(BALL.vertices)
FACES = np.asarray(BALL.faces)
TORN = FACES[np.arange(len(FACES)) % 3 != 0]
"""A ball without a third of its faces: its holes meet in corners."""


def save(path: Path, corners: Any, faces: Any) -> str:
    trimesh.Trimesh(corners, faces, process=False).export(path)
    return str(path)


@pytest.fixture
def answer(capsys):
    def ask(*words: str) -> tuple[int, dict[str, Any]]:
        capsys.readouterr()
        code = main(["object", *words, "--json"])
        return code, json.loads(capsys.readouterr().out)

    return ask


def test_show(tmp_path, answer, capsys):
    ring = trimesh.creation.annulus(30.0, 50.0, 40.0, sections=8)
    ring.apply_translation((0.0, 0.0, 7.0))
    path = save(tmp_path / "ring.obj", ring.vertices, ring.faces)
    words = f"object show {path} --scale 0.001 --draw {tmp_path / 'ring.png'} --size 64"
    assert main(words.split()) == 0
    told = capsys.readouterr().out
    for words in (
        "ring.obj",
        str(len(ring.faces)),
        "100.0 x 100.0 x 40.0",
        f"{1e-3 * ring.volume:.4g}",
        "0.0 0.0 7.0",
    ):
        assert words in told
    assert "repaired" not in told
    assert f"kept in {folder()}\n" in told
    picture = np.array(Image.open(tmp_path / "ring.png")).astype(int)
    assert picture.shape == (64, 128, 3)
    # of colour: the mesh has one pale one, pieces have strong ones
    spread = np.ptp(picture, axis=2)
    assert spread[:, :64].max() < 60 < spread[:, 64:].max()
    (reddest,) = {row.argmax() for row in picture[:, :64][spread[:, :64] > 15]}
    assert reddest == 0
    # pieces of several hues
    assert {row.argmax() for row in picture[:, 64:][spread[:, 64:] > 30]} == {0, 1, 2}
    code, told = answer("show", save(tmp_path / "open.obj", CORNERS, FACES[1:]))
    assert (code, told["faces"], told["pieces"], told["picture"]) == (0, len(FACES), 1, None)
    assert (told["volume"], *told["extent"]) == pytest.approx((BALL.volume, *BALL.extents))
    assert "holes were filled with 1 faces" in told["repaired"][0]


def test_a_torn_mesh_is_mended(tmp_path, answer):
    count = len(CORNERS)
    crumb = [[0.0, 0.3, 0.0], [0.1, 0.3, 0.0], [0.0, 0.3, 0.1]]
    corners = np.vstack([CORNERS, 0.5 * CORNERS, CORNERS + np.array((0.2, 0.0, 0.0)), crumb])
    torn = np.vstack(
        [FACES[5:], FACES[:, ::-1] + count, TORN + 2 * count, np.array([[0, 1, 2]]) + 3 * count]
    )
    path = save(tmp_path / "parts.obj", corners, torn)
    with pytest.raises(
        InvalidInputError, match=r"is not closed.*repair it with `grasp object mend FILE`"
    ):
        ObjectDescription.from_mesh(path)
    code, told = answer("mend", path)
    assert (code, told["out"]) == (0, str(tmp_path / "parts_mended.obj"))
    assert (told["faces_before"], told["parts"], told["parts_left_out"]) == (len(torn), 3, 1)
    # missing faces are guessed
    assert told["volume"] == pytest.approx((1.0 - 0.125 + 1.0) * BALL.volume, rel=0.05)
    assert told["faces_kept"] > 0.3 * len(torn)
    corners, faces, changes = close_mesh(*read_mesh(open_mesh(told["out"], "it")), "it")
    assert (changes, len(faces)) == ([], told["faces_after"])
    assert np.ptp(corners, axis=0) == pytest.approx((0.3, 0.1, 0.1), rel=0.05)
    assert read_mesh(open_mesh(path, "it"))[1].shape == torn.shape  # the file stays


def test_nothing_is_overwritten_by_default(tmp_path, answer):
    path = save(tmp_path / "ball.stl", 1e3 * CORNERS, FACES)
    out = tmp_path / "ball_mended.obj"
    out.write_text("mine")
    code, told = answer("mend", path)
    assert (code, out.read_text()) == (2, "mine")
    assert f"--out {out}" in told["error"]["message"]
    code, told = answer("mend", path, "--out", str(out))
    assert (code, told["changes"]) == (0, [])
    assert told["faces_kept"] == told["faces_after"] == len(FACES)
    # in the unit of the file, which has 7 digits
    assert told["volume"] == pytest.approx(1e9 * BALL.volume, rel=1e-5)
    assert not list(tmp_path.glob(".*"))  # nothing half written


def test_mending_that_fails(tmp_path, answer, monkeypatch):
    flat = save(tmp_path / "flat.obj", CORNERS * (1.0, 1.0, 0.0), FACES[:100])
    for words in ("cannot be repaired", "Blender"):
        assert words in answer("mend", flat)[1]["error"]["message"]
    torn = save(tmp_path / "torn.obj", CORNERS, TORN)
    with monkeypatch.context() as patched:
        patched.setattr(mesh_repair, "LONGEST", 0.01)
        assert "did not end within" in answer("mend", torn)[1]["error"]["message"]

    def crash(*_: Any, **__: Any) -> Any:
        raise ChildProcessError("exit code -11")

    monkeypatch.setattr(mesh_repair, "apart", crash)
    assert "broke off" in answer("mend", torn)[1]["error"]["message"]
    assert not list(tmp_path.glob("*mended*"))


def test_list_and_clear(tmp_path, answer, capsys):
    assert answer("list") == (0, {"folder": str(folder()), "entries": []})
    for name, solid in (("ball", BALL), ("box", trimesh.creation.box((0.05, 0.06, 0.07)))):
        ObjectDescription.from_mesh(save(tmp_path / f"{name}.obj", solid.vertices, solid.faces))
    (folder() / "spoiled.npz").write_bytes(b"no archive")
    told = {entry["name"]: entry for entry in answer("list")[1]["entries"]}
    assert {name: entry["pieces"] for name, entry in told.items()} == {
        "ball.obj": 1,
        "box.obj": 1,
        "(not readable)": None,
    }
    assert all(entry["bytes"] > 0 for entry in told.values())
    assert main(["object", "list"]) == 0
    assert f"in {folder()}\n" in capsys.readouterr().out
    assert answer("clear")[1]["removed"] == 3
    assert list(folder().iterdir()) == []


WRONG = [
    ("show", "needs a FILE"),
    ("list {ball}", "belongs to `grasp object show` and `grasp object mend`"),
    ("show {ball} --out a.obj", "--out belongs to `grasp object mend`"),
    ("show {ball} --draw a.jpg", "must end in .png"),
    ("show {ball} --scale 100", "give --scale 1 if the file is in metres (100 mm large)\n"),
    ("show {ball} --size 1", "size must be an integer >= 16"),
    ("mend nowhere.txt", ".obj, .stl"),
    ("show {ball} --draw /nowhere/a.png", "/nowhere"),
]


@pytest.mark.parametrize(("words", "message"), WRONG)
def test_errors_are_one_line(words, message, tmp_path, capsys):
    ball = save(tmp_path / "ball.obj", CORNERS, FACES)
    assert main(["object", *words.format(ball=ball).split()]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1


def fail(*_: Any, **__: Any) -> Any:
    raise AssertionError("this should come from the cache")


def box(path: Path, *sides: float) -> str:
    creation.box(sides or (0.06, 0.05, 0.04)).export(path)
    return str(path)


def make(value: float = 3.0) -> Callable[[], dict[str, Any]]:
    return lambda: {"value": np.array(value)}


def test_entries_are_found_by_content(tmp_path, monkeypatch):
    path = box(tmp_path / "a.obj")
    item = ObjectDescription.from_mesh(path)
    (entry,) = entries()
    assert (entry.name, entry.use, entry.path.parent) == ("a.obj", "object", folder())
    assert folder().is_relative_to(tmp_path)
    assert entry.size == entry.path.stat().st_size
    monkeypatch.setattr(mesh, "_processed", fail)
    mesh._load.cache_clear()
    for again in (
        ObjectDescription.from_mesh(path),
        ObjectDescription.from_mesh(box(tmp_path / "b.obj")),
    ):
        np.testing.assert_array_equal(again.faces[0], item.faces[0])
        np.testing.assert_array_equal(again.pieces[0], item.pieces[0])
        assert again.moments == item.moments
    ObjectDescription.from_mesh(path, 0.5)  # the scale is not part of the content
    assert len(entries()) == 1
    with pytest.raises(AssertionError, match="from the cache"):
        ObjectDescription.from_mesh(box(tmp_path / "a.obj", 0.06, 0.05, 0.041))
    cached("newer", "newer", make())
    os.utime(folder() / "newer.npz", (time.time() + 50.0,) * 2)
    assert [each.name for each in entries()] == ["newer", "a.obj"]
    assert (clear(), entries(), clear()) == (2, [], 0)
    assert list(folder().iterdir()) == []


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
        lambda path: path.write_bytes(b""),
        # a pickle would run code
        lambda path: np.savez(path, value=np.array([Path()], dtype=object)),
    ],
    ids=["half", "empty", "a pickle"],
)
def test_a_damaged_entry_is_made_anew(spoil):
    cached("key", "name", make(1.0))
    spoil(folder() / "key.npz")
    assert len(entries()) == 1
    assert cached("key", "name", make(2.0))["value"] == 2.0
    assert cached("key", "name", fail)["value"] == 2.0


def test_without_a_folder_locks_or_patience(tmp_path, monkeypatch):
    """None of these is an error, and none takes long."""
    monkeypatch.setattr(cache, "LONGEST_WAIT", 0.3)
    begun = time.monotonic()
    with cache._locked(folder() / "key.npz"):
        assert cached("key", "name", make())["value"] == 3.0
    assert 0.25 < time.monotonic() - begun < 10.0
    monkeypatch.setattr(cache, "LONGEST_WAIT", 150.0)

    def refuse(*_: Any) -> None:
        raise OSError(38, "no locks here")

    monkeypatch.setattr(cache.fcntl, "flock", refuse)
    assert cached("second", "name", make())["value"] == 3.0
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    (tmp_path / "file").write_text("not a folder")
    for value in (1.0, 2.0):
        assert cached("key", "name", make(value))["value"] == value
    assert (entries(), clear()) == ([], 0)
    assert time.monotonic() - begun < 30.0


WORKER = """
import sys, time
import numpy as np
from grasp_env.sim.objects.cache import cached

def make():
    with open(sys.argv[1], "a") as file:
        file.write("made\\n")
    time.sleep(0.5)
    return {"value": np.arange(5)}

print(cached("key", "name", make)["value"].sum())
"""


def test_two_processes_make_one_entry(tmp_path):
    log = tmp_path / "log"
    with ExitStack() as stack:
        command = [sys.executable, "-c", WORKER, str(log)]
        running = [
            stack.enter_context(start(command, 60.0, stdout=-1, text=True)) for _ in range(2)
        ]
        assert [process.communicate()[0].strip() for process in running] == ["10"] * 2
    assert log.read_text() == "made\n"
    assert [entry.name for entry in entries()] == ["name"]
    assert {path.suffix for path in folder().iterdir()} <= {".npz", ".lock"}


# --- processes


TASKS = """
import os, time
import numpy as np

def fine(x):
    time.sleep(0.3)
    return {"twice": 2 * x}

def crash(x):
    os.kill(os.getpid(), 11)

def fail(x):
    raise KeyError("inside")

def sleep(x):
    time.sleep(60.0)

def fill(x):
    bytearray(200_000_000)
    return {}

def nap(x):
    import time
    time.sleep(0.6)
    return {}

def spin(x):
    while True:
        x = x + 1.0

def names():
    return {"names": np.array([*os.environ])}
"""


def test_work_apart_returns_raises_and_ends(tmp_path, capsys, monkeypatch):
    (tmp_path / "tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    for task, message in (("crash", "exit code -11"), ("fail", "KeyError: 'inside'")):
        with pytest.raises(ChildProcessError, match=message):
            apart(f"tasks:{task}", "work", 60.0, x=np.arange(3.0))
    with pytest.raises(TimeoutError, match=r"more than 0\.4 s"):
        apart("tasks:sleep", "work", 0.4, x=np.arange(3.0))
    assert capsys.readouterr().err == ""  # no terminal
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert apart("tasks:fine", "cutting", 60.0, x=np.arange(3.0))["twice"].tolist() == [0, 2, 4]
    assert "\rcutting, " in capsys.readouterr().err


def test_work_apart_has_its_own_memory_and_environment(tmp_path, monkeypatch):
    (tmp_path / "tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("GRASP_SECRET", "secret")
    assert apart("tasks:fill", "work", 60.0, memory=300_000_000, x=np.arange(3.0)) == {}
    with pytest.raises(ChildProcessError, match="MemoryError"):
        apart("tasks:fill", "work", 60.0, memory=100_000_000, x=np.arange(3.0))
    # Python sets LC_CTYPE
    needed = {"PYTHONPATH", "LC_CTYPE", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "PYTHONHOME"}
    seen = apart("tasks:names", "work", 60.0, variables={"OWN": "1"})["names"]
    assert set(seen) - needed == {"OWN"}
    assert "GRASP_SECRET" in apart("tasks:names", "work", 60.0)["names"]


def ring(sections: int = 8) -> tuple[Any, Any]:
    made = creation.annulus(0.02, 0.04, 0.02, sections=sections)
    return np.array(made.vertices), np.array(made.faces)


def test_vhacd_cuts_what_coacd_crashes_on(monkeypatch):
    tasks: list[str] = []

    def crash(name: str, *_: Any, **given: Any) -> Any:
        tasks.append(name.rsplit("_", 1)[1])
        if tasks[-1] == "coacd" or len(tasks) > 4:
            raise ChildProcessError("crashed")
        return pieces.by_vhacd(**given)

    monkeypatch.setattr(pieces, "apart", crash)
    assert len(pieces.convex_pieces(*ring(), "ring").corners) > 1
    assert tasks == ["coacd", "coacd", "coacd", "vhacd"]
    with pytest.raises(InvalidInputError, match=r"cannot be cut .*crashed.*grasp object mend"):
        pieces.convex_pieces(*ring(), "ring")


def hull_of_all(corners: Any, faces: Any, concavity: Any) -> dict[str, Any]:
    """A cut that fills the hollow of a mesh."""
    return {"points": corners, "counts": np.array([len(corners)])}


def test_the_excess_of_pieces_is_measured():
    """A hull fills the hole of a ring: its middle is 20 mm from the nearest face, and it has the
    volume of the whole disc, 4 / 3 of the ring's.
    """
    corners, faces = ring(64)
    excess = pieces.measured_excess([corners], corners, faces)
    # the middle of the top is half of the height from the middle of the hole, which is nearer
    # to no face than its rim is
    assert 0.0185 < excess.distance <= 0.02  # of 10,000 points one is near the middle
    assert excess.volume == pytest.approx(1.0 / 3.0, rel=1e-6)


def test_pieces_that_stand_out_are_told_and_faces_collide(tmp_path, monkeypatch, answer):
    monkeypatch.setattr(
        pieces, "apart", lambda *_, **given: hull_of_all(given["corners"], given["faces"], 0)
    )
    file = save(tmp_path / "ring.obj", *ring(64))
    with pytest.warns(
        UserWarning, match=r"stand out by up to (19|20)\.\d mm and have 33% more volume"
    ):
        item = ObjectDescription.from_mesh(file, mass=0.1)
    assert item.has_coarse_pieces
    code, told = answer("show", file)
    assert (code, told["pieces"], told["parts"]) == (0, 1, 1)
    assert 0.0185 < told["pieces_stand_out"] <= 0.02
    assert told["pieces_volume_share"] == pytest.approx(1.0 / 3.0, rel=1e-6)
    # the default of Bullet: the middle of the hole touches nothing
    client = pytest.importorskip("pybullet").connect(2)
    try:
        for contacts, inside in ((None, False), ("pieces", True), ("faces", False)):
            assert _touches_middle(client, item, contacts) == inside
    finally:
        pytest.importorskip("pybullet").disconnect(client)


def _touches_middle(client: int, item: ObjectDescription, contacts: str | None) -> bool:
    """True if a ball of 5 mm in the middle of an object touches it."""
    bullet = pytest.importorskip("pybullet")
    body = create_body(client, item, contacts)
    ball = bullet.createMultiBody(
        1.0,
        bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.005, physicsClientId=client),
        physicsClientId=client,
    )
    found = bullet.getClosestPoints(body, ball, 0.0, physicsClientId=client)
    for made in (body, ball):
        bullet.removeBody(made, physicsClientId=client)
    return bool(found)


def test_what_a_time_limit_made_is_not_kept(tmp_path, monkeypatch):
    runs: list[tuple[str, float]] = []

    def late(name: str, *_: Any, **given: Any) -> Any:
        runs.append((name.rsplit("_", 1)[1], float(given["concavity"])))
        if runs[-1][0] == "coacd":
            raise TimeoutError("it took more than 30 s")
        return pieces.by_vhacd(**given)

    monkeypatch.setattr(pieces, "apart", late)
    file = save(tmp_path / "ring.obj", *ring())
    for _ in range(2):
        mesh._load.cache_clear()
        mesh.load_mesh(file, 1.0, tell=False)
    # after the usual cut a coarser one, and none that is finer
    assert runs == [("coacd", 0.03), ("coacd", 0.06), ("vhacd", 0.02)] * 2
    assert entries() == []


def test_processor_time_is_limited_not_the_time_of_a_run(tmp_path, monkeypatch):
    (tmp_path / "tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert apart("tasks:nap", "work", 0.2, x=np.arange(3.0)) == {}
    begun = time.monotonic()
    with pytest.raises(TimeoutError, match="more than 1 s"):
        apart("tasks:spin", "work", 1.0, x=np.arange(3.0))
    assert time.monotonic() - begun < 10.0
