"""Files are written whole or not at all: interrupts, full disks, other writers, leftovers."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from processes import start

from grasp_env.inputs.files import replacing
from training.program.cli import main

WRITER = """
import sys
from pathlib import Path
from grasp_env.inputs.files import replacing
path, letter, times = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
for _ in range(times):
    with replacing(path) as hidden, hidden.open("w") as file:
        for _ in range(100):
            file.write(letter * 1000)
            file.flush()
"""
SLEEPER = """
import os, sys, time
from pathlib import Path
from grasp_env.inputs.files import replacing
with replacing(Path(sys.argv[1])) as hidden:
    hidden.write_text("half")
    print(hidden, flush=True)
    time.sleep(600)
"""


def write(path: Path, text: str) -> None:
    with replacing(path) as hidden:
        assert hidden.name.endswith(path.suffix)
        hidden.write_text(text)


def hidden_names(folder: Path) -> list[str]:
    return sorted(name for name in os.listdir(folder) if name.startswith("."))


def test_readers_find_whole_files_while_threads_and_processes_write(tmp_path):
    path = tmp_path / "shared.txt"
    found = set[str]()
    failed = list[BaseException]()
    write(path, "z" * 100_000)

    def repeat(letter: str) -> None:
        try:
            for _ in range(200):
                write(path, letter * 100_000)
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=repeat, args=(letter,)) for letter in "ab"]
    with (
        start([sys.executable, "-c", WRITER, str(path), "c", "200"]) as first,
        start([sys.executable, "-c", WRITER, str(path), "d", "200"]) as second,
    ):
        for thread in threads:
            thread.start()
        while (
            any(thread.is_alive() for thread in threads)
            or first.poll() is None
            or second.poll() is None
        ):
            text = path.read_text()
            assert len(text) == 100_000
            assert len(set(text)) == 1
            found.add(text[0])
        assert (first.returncode, second.returncode) == (0, 0)
    assert failed == []
    assert len(found) >= 3
    assert os.listdir(tmp_path) == ["shared.txt"]


@pytest.mark.parametrize("suffix", [".json", ".npz", ".mp4"])
def test_what_a_killed_process_left_is_removed_after_a_day_and_nothing_else(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    with start(
        [sys.executable, "-c", SLEEPER, str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        left = Path(process.stdout.readline().strip())
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert (left.parent, left.suffix, left.read_text()) == (tmp_path, suffix, "half")
    folder = left.with_name(f"{left.name}.step-1")
    others = [tmp_path / name for name in (".a.json", "a.bak", ".git")]
    folder.mkdir()
    (folder / "part").write_text("half")
    for other in others:
        other.write_text("mine")
    write(path, "new")
    assert left.exists()  # its process may still write
    for old in (left, folder, *others):
        os.utime(old, (time.time() - 90_000.0,) * 2)
    write(tmp_path / "b.json", "new")
    assert sorted(tmp_path.iterdir()) == sorted([path, tmp_path / "b.json", *others])


def test_a_folder_is_replaced_as_a_whole(tmp_path):
    for text in ("old", "new"):
        with replacing(tmp_path / "step-2") as hidden:
            hidden.mkdir()
            (hidden / "deep").mkdir()
            (hidden / f"deep/{text}").write_text(text)
    assert [path.name for path in (tmp_path / "step-2").rglob("*")] == ["deep", "new"]
    assert hidden_names(tmp_path) == []


def test_a_block_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    folder = tmp_path / "folder"
    write(path, "old")
    folder.mkdir()
    (folder / "file").write_text("old")
    for target in (path, folder):
        for error in (ValueError("no"), KeyboardInterrupt()):
            with pytest.raises(type(error)), replacing(target) as hidden:  # noqa: PT012
                hidden.write_text("half")
                raise error
    with pytest.raises(OSError, match=f"directory: '{re.escape(str(folder))}'"):
        write(folder, "a file in place of a folder")
    assert (path.read_text(), (folder / "file").read_text()) == ("old", "old")
    assert hidden_names(tmp_path) == []


def test_content_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    done = list[tuple[str, str]]()
    sync, replace = os.fsync, os.replace

    def synced(handle: int) -> None:
        done.append(("sync", os.readlink(f"/proc/self/fd/{handle}")))
        sync(handle)

    def replaced(source: Any, target: Any) -> None:
        done.append(("rename", str(target)))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    with replacing(path) as hidden:
        hidden.write_text("new")
    assert done == [("sync", str(hidden)), ("rename", str(path)), ("sync", str(tmp_path))]

    def refuses(handle: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuses)
    number = errno.EINVAL  # a file system that cannot wait
    write(path, "newer")
    number = errno.ENOSPC  # one that reports a full disk late
    with pytest.raises(OSError, match=f"No space left on device: '{re.escape(str(path))}'"):
        write(path, "newest")
    assert path.read_text() == "newer"
    assert os.listdir(tmp_path) == ["a.json"]


def test_long_names_keep_their_suffix(tmp_path):
    for name in ("n" * 250 + ".npz", "\u00fc" * 120 + ".npz"):
        write(tmp_path / name, "whole")
        assert (tmp_path / name).read_text() == "whole"
        (tmp_path / name).unlink()
    assert os.listdir(tmp_path) == []
    with pytest.raises(OSError, match=r"File name too long: '.*/nnn"):
        write(tmp_path / ("n" * 256), "whole")


def test_links_stay_and_pipes_are_written_to(tmp_path):
    """A device, such as /dev/stdout, must not become a file: root could do that."""
    (tmp_path / "deep").mkdir()
    link = tmp_path / "link.json"
    target = tmp_path / "deep/target.json"
    link.symlink_to("deep/target.json")
    for text in ("new", "newer"):
        write(link, text)
        assert link.is_symlink()
        assert target.read_text() == text
    pipe = tmp_path / "pipe"
    got = list[str]()
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()), daemon=True)
    reader.start()
    write(pipe, "through")
    reader.join(10.0)
    assert got == ["through"]
    assert pipe.is_fifo()
    assert hidden_names(tmp_path) == hidden_names(tmp_path / "deep") == []


LIMITED = """
import resource, signal, sys
from training.program.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
sys.exit(main(sys.argv[1:]))
"""


def test_a_write_that_the_system_cuts_leaves_the_old_file(tmp_path):
    path = tmp_path / "my.json"
    path.write_text("old")
    words = [sys.executable, "-c", LIMITED, "solve", "--save-grasp", str(path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert (
        done.stderr
        == f"grasp: cannot write grasp file {path}: File too large; choose another path\n"
    )
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["my.json"]


@pytest.fixture
def full(monkeypatch):
    """A disk that is full when files are written by `Path`; the error of a write has no file name."""

    for name, write in (("write_bytes", Path.write_bytes), ("write_text", Path.write_text)):

        def fails(path: Path, *given: Any, write: Any = write, **options: Any) -> int:
            if not path.name.startswith("."):  # scratch files are on another disk
                return write(path, *given, **options)
            with path.open("wb") as file:
                file.write(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(Path, name, fails)


@pytest.mark.usefixtures("full")
@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("solve --save-grasp my.json", "my.json"),
        ("hand four_finger --draw hand.png", "hand.png"),
        ("demo --seconds 0.1 --video hand.png", "hand.png"),
        ("demo --seconds 0.1 --video hand.gif", "hand.gif"),
    ],
)
def test_commands_say_that_the_disk_is_full_and_how_to_mend_it(
    words, name, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("grasp: ")]
    assert re.fullmatch(
        rf"grasp: (cannot write grasp file )?{name}: No space left on device; .*choose another path",
        line,
    )
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("words", ["solve", "solve --json", "--help", "solve --wrench 1 2 --json"])
def test_a_full_disk_below_the_output_is_no_fault_of_the_program(words):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "training", *words.split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
        )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert ("No space left on device; free some space" in done.stderr) == ("1 2" not in words)
