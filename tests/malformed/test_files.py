"""Files that nobody means to give: devices, pipes, folders, endless or broken ones. Each reader says so, soon, in one of the project's errors."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from grasp_env import _files
from grasp_env._files import read_bytes, unpacked
from grasp_env.errors import GraspError
from grasp_env.grasp import load_grasp, presets, save_grasp
from grasp_env.sim import HandDescription
from grasp_env.sim.objects.description import ObjectDescription
from policies.agent import TrainedAgent
from training.cli import main
from training.results import Run, table


def agent(path: Path) -> Any:
    """The agent whose description is that file."""
    folder = path.parent / f"agent of {path.name}"
    folder.mkdir(exist_ok=True)
    link = folder / "agent.json"
    link.unlink(missing_ok=True)
    link.symlink_to(path)
    return TrainedAgent.load(folder)


def mesh(path: Path) -> Any:
    """The object whose mesh is that file, under a name that a mesh may have."""
    link = path.parent / f"{path.name}.obj"
    link.unlink(missing_ok=True)
    link.symlink_to(path)
    return ObjectDescription("mesh", (1.0,), mesh=str(link))


READERS: dict[str, Callable[[Path], Any]] = {
    "grasp": load_grasp,
    "urdf": lambda path: HandDescription.from_urdf(path, ["tip"]),
    "mesh": mesh,
    "agent": agent,
    "run": lambda path: Run(path.parent).read_json(path.name),
    "table": table.read,
}


def sparse(path: Path) -> None:
    """A terabyte of zeros that takes no room."""
    with path.open("wb") as file:
        file.truncate(2**40)


@cache
def bomb() -> bytes:
    """A megabyte that would be a gigabyte of zeros."""
    blob = io.BytesIO()
    with (
        zipfile.ZipFile(blob, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed,
        packed.open("a.npy", "w") as entry,
    ):
        np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": (1000, 1 << 17)})
        for _ in range(1000):
            entry.write(bytes(1 << 20))
    return blob.getvalue()


def boaster(path: Path) -> None:
    """An array whose header claims more numbers than there are atoms."""
    with zipfile.ZipFile(path, "w") as packed, packed.open("a.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": (10**15, 10**3)})


@cache
def equal() -> bytes:
    """A table of 150 million equal numbers in half a megabyte."""
    blob = io.BytesIO()
    rows = pyarrow.table({"iterations": np.zeros(5_000_000, np.int64)})
    with pyarrow.parquet.ParquetWriter(blob, rows.schema, compression="zstd") as writer:
        for _ in range(30):
            writer.write_table(rows)
    return blob.getvalue()


FILES: dict[str, Callable[[Path], Any]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b""),
    "folder": lambda path: path.mkdir(),
    "pipe without a writer": os.mkfifo,
    "endless device": lambda path: path.symlink_to("/dev/zero"),
    "random device": lambda path: path.symlink_to("/dev/urandom"),
    "null device": lambda path: path.symlink_to("/dev/null"),
    "link to itself": lambda path: path.symlink_to(path),
    "a terabyte": sparse,
    "binary": lambda path: path.write_bytes(bytes(range(256)) * 100),
    "half a letter": lambda path: path.write_bytes(b'{"a": "\xc3'),
    "surrogate": lambda path: path.write_bytes(b'{"positions": "\\ud800", "normals": 1, "friction": 1}'),
    "nested lists": lambda path: path.write_text("[" * 100_000 + "]" * 100_000),
    "nested within the parser's depth": lambda path: path.write_text(
        json.dumps({"normals": [], "friction": 1}).replace("[]", "[" * 900 + "]" * 900)[:-1] + ', "positions": 1}'
    ),
    "nested objects": lambda path: path.write_text('{"a":' * 100_000 + "1" + "}" * 100_000),
    "nested elements": lambda path: path.write_text("<robot>" + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>"),
    "entities": lambda path: path.write_text(
        "<!DOCTYPE robot ["
        + "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10 if k else "a" * 10}">' for k in range(12))
        + ']><robot name="&e11;"/>'
    ),
    "not a number": lambda path: path.write_text('{"positions": [[NaN, 0, 0]], "normals": [[1, 0, 0]], "friction": Infinity}'),
    "a long number": lambda path: path.write_text('{"friction": ' + "9" * 100_000 + ', "positions": 1, "normals": 1}'),
    "a million contacts": lambda path: path.write_text(
        json.dumps({"positions": [[0, 0, 1]] * 1_000_000, "normals": [[0, 0, 1]] * 1_000_000, "friction": 1})
    ),
    "wrong kinds": lambda path: path.write_text('{"rows": 3, "kind": "solver", "schema": [], "positions": {}, "normals": null}'),
    "a list": lambda path: path.write_text("[1, 2]"),
    "arrays that unpack to gigabytes": lambda path: path.write_bytes(bomb()),
    "arrays that claim to be large": boaster,
    "a key twice among a hundred thousand": lambda path: path.write_text("{" + "".join(f'"{k}":1,' for k in range(100_000)) + '"0":1}'),
    "equal values without end": lambda path: path.write_bytes(equal()),
}  # fmt: skip


def test_arrays_have_the_bytes_that_they_claim() -> None:
    blob = io.BytesIO()
    np.savez(blob, a=np.arange(6.0).reshape(2, 3), b=np.array("text"), c=np.zeros(0))
    assert {name: array.shape for name, array in unpacked(blob.getvalue()).items()} == {"a": (2, 3), "b": (), "c": (0,)}
    with zipfile.ZipFile(blob, "w") as packed, packed.open("a.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": (10**9,)})
        entry.write(bytes(80))
    with pytest.raises(ValueError, match=r"'a.npy' claims 8000000000 bytes of 208"):
        unpacked(blob.getvalue())


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_refuses_in_words_and_soon(reader: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "given"
    FILES[kind](path)
    begin = time.process_time()
    # JSON is what it is: a run's file may be any
    if reader == "run" and kind in ("not a number", "wrong kinds", "a list", "surrogate", "nested within the parser's depth", "a key twice among a hundred thousand"):  # fmt: skip
        READERS[reader](path)
        return
    with pytest.raises(GraspError) as caught:
        READERS[reader](path)
    assert len(str(caught.value)) < 2000
    assert time.process_time() - begin < 10.0


def test_a_pipe_is_read_while_it_is_written(tmp_path: Path) -> None:
    text = save_grasp(presets.tripod(), tmp_path / "grasp.json").read_text()
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    out = os.open(pipe, os.O_RDWR)

    def write() -> None:
        for part in (text[:50], text[50:]):
            time.sleep(0.05)
            os.write(out, part.encode())
        os.close(out)

    writer = threading.Thread(target=write)
    writer.start()
    assert load_grasp(pipe).n_contacts == 3
    writer.join()


def test_a_silent_pipe_and_an_endless_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_files, "PATIENCE", 0.1)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    out = os.open(pipe, os.O_RDWR)
    with pytest.raises(OSError, match="nothing comes out of this pipe"):
        read_bytes(pipe)
    os.write(out, b"a" * 60_000)
    with pytest.raises(OSError, match="larger than"):
        read_bytes(pipe, 50_000)
    os.close(out)


@pytest.mark.parametrize("path", ["", "\0", None, 3.0, b"\xff\0", object()])
def test_what_is_no_path(path: Any) -> None:
    with pytest.raises(OSError, match=r"no path|No such file"):
        read_bytes(path)
    for reader in ("grasp", "urdf"):
        with pytest.raises(GraspError):
            READERS[reader](path)


def grasp(*words: str, text: str = "") -> subprocess.CompletedProcess[str]:
    """The command line, in a process of its own."""
    return subprocess.run([sys.executable, "-m", "training.cli", *words], input=text, capture_output=True, text=True, timeout=120, check=False)  # fmt: skip


def test_the_command_reads_a_pipe_and_refuses_a_device(tmp_path: Path) -> None:
    text = save_grasp(presets.tripod(), tmp_path / "grasp.json").read_text()
    wrench = ("--wrench", "0", "0", "-1", "0", "0", "0", "--method", "newton")
    assert grasp("solve", "--grasp", "/dev/stdin", *wrench, text=text).returncode == 0
    for path, told in (("/dev/zero", "a device"), (str(tmp_path), "a folder")):
        refused = grasp("solve", "--grasp", path, *wrench)
        assert (refused.returncode, refused.stdout) == (2, "")
        assert refused.stderr.startswith("grasp: cannot read grasp file")
        assert told in refused.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "--friction", "1e300"),
        ("solve", "--friction", "nan"),
        ("solve", "--tolerance", "-1"),
        ("solve", "--barrier-weight", "1e-300"),
        ("solve", "--wrench", "1e300", "0", "0", "0", "0", "0"),
        ("solve", "--max-normal", "-1"),
        ("evaluate", "starts", "--wrenches", "0"),
        ("evaluate", "env", "--episodes", "-1"),
        ("fit", "--seconds", "nan"),
        ("rl", "--steps", "0"),
        ("report", "/dev"),
        ("report", "a" * 300),
        ("solve", "--initial", "a" * 300),
        ("demo", "--seconds", "inf", "--video", "hand.gif"),
    ],
    ids=" ".join,
)
def test_commands_given_wrong_numbers(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = () if words[0] in ("solve", "report", "demo") else ("--out", str(tmp_path))
    try:
        code = main([*words, *out])
    except SystemExit as stop:  # settings that the command line checks as it reads them
        code = stop.code
    told = capsys.readouterr().err
    assert code == 2
    assert told.startswith("grasp: ") or "Error parsing" in told
