"""The cache of processed meshes, and third-party algorithms in processes of their own."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import start
from trimesh import creation

from grasp_env.errors import InvalidInputError
from grasp_env.sim import ObjectDescription, progress
from grasp_env.sim.objects import cache, mesh, pieces
from grasp_env.sim.objects.apart import apart
from grasp_env.sim.objects.cache import cached, clear, entries, folder


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache, in memory and on disk."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    mesh._load.cache_clear()
    yield tmp_path / "cache"
    mesh._load.cache_clear()


def fail(*_: Any, **__: Any) -> Any:
    raise AssertionError("this should come from the cache")


def save(path: Path, *sides: float) -> str:
    creation.box(sides or (0.06, 0.05, 0.04)).export(path)
    return str(path)


def make(value: float = 3.0) -> Callable[[], dict[str, Any]]:
    return lambda: {"value": np.array(value)}


def test_entries_are_found_by_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path / "a.obj")
    item = ObjectDescription.from_mesh(path)
    (entry,) = entries()
    assert (entry.name, entry.use, entry.path.parent) == ("a.obj", "object", folder())
    assert folder().is_relative_to(tmp_path)
    assert entry.size == entry.path.stat().st_size
    monkeypatch.setattr(mesh, "_processed", fail)
    mesh._load.cache_clear()
    for again in (ObjectDescription.from_mesh(path), ObjectDescription.from_mesh(save(tmp_path / "b.obj"))):
        np.testing.assert_array_equal(again.faces[0], item.faces[0])
        np.testing.assert_array_equal(again.pieces[0], item.pieces[0])
        assert again.moments == item.moments
    ObjectDescription.from_mesh(path, 0.5)  # the scale is not part of the content
    assert len(entries()) == 1
    with pytest.raises(AssertionError, match="from the cache"):
        ObjectDescription.from_mesh(save(tmp_path / "a.obj", 0.06, 0.05, 0.041))
    assert clear() == 1
    assert entries() == []
    assert clear() == 0
    assert list(folder().iterdir()) == []


def test_the_newest_entry_comes_first() -> None:
    for age, name in ((50.0, "old"), (0.0, "new"), (99.0, "older")):
        cached(name, name, {"value"}, make())
        os.utime(folder() / f"{name}.npz", (time.time() - age, time.time() - age))
    assert [entry.name for entry in entries()] == ["new", "old", "older"]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
        lambda path: path.write_bytes(b""),
        lambda path: np.savez(path, other=np.zeros(3)),
        lambda path: np.savez(path, value=np.array([Path()], dtype=object)),  # a pickle would run code
    ],
    ids=["half", "empty", "other arrays", "a pickle"],
)
def test_a_damaged_entry_is_made_anew(spoil: Callable[[Path], Any]) -> None:
    cached("key", "name", {"value"}, make(1.0))
    spoil(folder() / "key.npz")
    assert len(entries()) == 1
    assert cached("key", "name", {"value"}, make(2.0))["value"] == 2.0
    assert cached("key", "name", {"value"}, fail)["value"] == 2.0


def test_without_a_folder_locks_or_patience(cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """None of these is an error, and none takes long."""
    monkeypatch.setattr(cache, "LONGEST_WAIT", 0.3)
    begun = time.monotonic()
    with cache._locked(folder() / "key.npz"):
        assert cached("key", "name", {"value"}, make())["value"] == 3.0
    assert 0.25 < time.monotonic() - begun < 10.0
    monkeypatch.setattr(cache, "LONGEST_WAIT", 150.0)

    def refuse(*_: Any) -> None:
        raise OSError(38, "no locks here")

    monkeypatch.setattr(cache.fcntl, "flock", refuse)
    assert cached("second", "name", {"value"}, make())["value"] == 3.0
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache_folder / "file"))
    (cache_folder / "file").write_text("not a folder")
    for value in (1.0, 2.0):
        assert cached("key", "name", {"value"}, make(value))["value"] == value
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

print(cached("key", "name", {"value"}, make)["value"].sum())
"""


def test_two_processes_make_one_entry(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with ExitStack() as stack:
        command = [sys.executable, "-c", WORKER, str(log)]
        running = [stack.enter_context(start(command, 60.0, stdout=-1, text=True)) for _ in range(2)]
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
"""


def test_work_apart_returns_crashes_raises_and_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    for task, message in (("crash", "exit code -11"), ("fail", "KeyError: 'inside'")):
        with pytest.raises(ChildProcessError, match=message):
            apart(f"tasks:{task}", "work", 60.0, x=np.arange(3.0))
    with pytest.raises(TimeoutError, match="more than 0 s"):
        apart("tasks:sleep", "work", 0.4, x=np.arange(3.0))
    assert capsys.readouterr().err == ""  # no terminal
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert apart("tasks:fine", "cutting", 60.0, x=np.arange(3.0))["twice"].tolist() == [0, 2, 4]
    assert "\rcutting, " in capsys.readouterr().err


def test_vhacd_cuts_what_coacd_crashes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    tasks: list[str] = []

    def crash(name: str, *_: Any, **given: Any) -> Any:
        tasks.append(name.rsplit("_", 1)[1])
        if tasks[-1] == "coacd" or len(tasks) > 2:
            raise ChildProcessError("crashed")
        return pieces.by_vhacd(**given)

    monkeypatch.setattr(pieces, "apart", crash)
    ring = creation.annulus(0.02, 0.04, 0.02, sections=8)
    solid = np.array(ring.vertices), np.array(ring.faces)
    assert len(pieces.convex_pieces(*solid, "ring")) > 1
    assert tasks == ["coacd", "vhacd"]
    with pytest.raises(InvalidInputError, match=r"cannot be cut .*crashed.*grasp object mend"):
        pieces.convex_pieces(*solid, "ring")
