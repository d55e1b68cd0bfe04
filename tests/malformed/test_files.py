"""Wrong files: missing, empty, folders, broken or of another kind. Each reader refuses them in
words."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sim.mesh_samples import ENTITIES
from urdf_text import small, solid

from grasp_env.control import Recording
from grasp_env.errors import GraspError
from grasp_env.grasp import load_grasp, presets, save_grasp
from grasp_env.inputs.files import read_bytes, stand_in
from grasp_env.sim import HandDescription
from grasp_env.sim.objects.description import ObjectDescription
from policies.agent import TrainedAgent
from training.evaluation.results import Run, table
from training.program.cli import main


def agent(path: Path) -> Any:
    """The agent whose description is that file."""
    folder = path.parent / f"agent of {path.name}"
    folder.mkdir(exist_ok=True)
    (folder / "agent.json").symlink_to(path)
    return TrainedAgent.load(folder)


def mesh(path: Path) -> Any:
    """The object whose mesh is that file, under a name that a mesh may have."""
    link = path.parent / f"{path.name}.obj"
    link.symlink_to(path)
    return ObjectDescription("mesh", (1.0,), mesh=str(link))


def recording(path: Path) -> Any:
    """The recording that is that file, under a name that a recording may have."""
    link = path.parent / f"{path.name}.csv"
    link.symlink_to(path)
    return Recording.load(link)


READERS: dict[str, Callable[[Path], Any]] = {
    "grasp": load_grasp,
    "urdf": lambda path: HandDescription.from_urdf(path, ["tip"]),
    "mesh": mesh,
    "agent": agent,
    "run": lambda path: Run(path.parent).read_json(path.name),
    "table": table.read,
    "recording": recording,
}
FILES: dict[str, Callable[[Path], Any]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b""),
    "folder": lambda path: path.mkdir(),
    "too large": lambda path: path.write_bytes(bytes(41_000_000)),
    "half a letter": lambda path: path.write_bytes(b'{"a": "\xc3'),
    "entities": lambda path: path.write_text(f'<!DOCTYPE robot [{ENTITIES}]><robot name="&e9;"/>'),
    "not a number": lambda path: path.write_text(
        '{"positions": [[NaN, 0, 0]], "normals": [[1, 0, 0]], "friction": Infinity}'
    ),
    "wrong kinds": lambda path: path.write_text(
        '{"rows": 3, "kind": "solver", "schema": [], "positions": {}, "normals": null}'
    ),
    "a list": lambda path: path.write_text("[1, 2]"),
}
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
PAGE = "is a web page: it was saved in place of the file"
STAND_INS = {
    "pointer": (POINTER, "is a Git LFS pointer: run `git lfs pull`"),
    "page": (b"\n\n<!DOCTYPE html>\n<html lang='en'>", PAGE),
    "page without a type": (b"<html><body>404</body></html>", PAGE),
    "page with a mark": (b"\xef\xbb\xbf<!-- saved --> <HTML>", PAGE),
    "page in XML": (
        b'<?xml version="1.0"?>\n<!DOCTYPE html PUBLIC "-//W3C//DTD XHTML 1.0 Strict//EN">',
        PAGE,
    ),
    "gzip": (gzip.compress(b"robot"), "is a gzip archive: unpack it"),
}


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_refuses_in_words_and_names_what_people_have_in_place_of_a_file(
    reader, tmp_path
):
    for kind, make in FILES.items():
        path = tmp_path / kind
        make(path)
        # any JSON is a run's file
        if reader == "run" and kind in ("not a number", "wrong kinds", "a list"):
            READERS[reader](path)
            continue
        with pytest.raises(GraspError) as caught:
            READERS[reader](path)
        assert len(str(caught.value)) < 2000
    for kind, (content, message) in STAND_INS.items():
        (tmp_path / kind).write_bytes(content)
        with pytest.raises(GraspError, match=message):
            READERS[reader](tmp_path / kind)


@pytest.mark.parametrize(
    "text", [b"<robot/>", b"<htmlx/>", b"<!--a--><robot/>", b"version https://example.org/"]
)
def test_other_files_are_not(text):
    assert stand_in(text) == ("", "")


MJCF = (
    '<mujoco><compiler meshdir="meshes" texturedir="meshes"/><asset>{}</asset><worldbody><body><geom size="0.1"/><body><joint/><geom '
    'type="mesh" mesh="a"/></body></body></worldbody></mujoco>'
)


@pytest.mark.parametrize("kind", ["stl", "obj", "dae"])
def test_meshes_of_a_hand_that_are_pointers_are_named(kind, tmp_path):
    (tmp_path / "meshes").mkdir()
    mesh = tmp_path / "meshes" / f"a.{kind}"
    mesh.write_bytes(POINTER)
    shape = f'<mesh filename="package://hand/meshes/a.{kind}"/>'
    (tmp_path / "hand.urdf").write_text(small(solid(shape)))
    told = rf"link 'finger', <collision>.*: the mesh {mesh} is a Git LFS pointer: run `git lfs pull` in its repository"
    with pytest.raises(GraspError, match=told):
        HandDescription.from_file(tmp_path / "hand.urdf")
    (tmp_path / "hand.urdf").write_text(
        small(solid('<sphere radius="0.01"/>') + solid(shape, role="visual"))
    )
    with pytest.warns(
        UserWarning,
        match=r"visual meshes that are Git LFS pointers \(run `git lfs pull`.* are left out: 'package",
    ):
        HandDescription.from_file(tmp_path / "hand.urdf")


@pytest.mark.parametrize(
    "asset",
    [
        '<mesh name="a" file="a.stl"/>',
        '<mesh name="a" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/><texture name="t" type="2d" file="a.stl" content_type="image/png"/>',
    ],
)
def test_files_of_a_mujoco_model_that_are_pointers_are_named(asset, tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.stl").write_bytes(POINTER)
    (tmp_path / "own").mkdir()
    for folder in (tmp_path, tmp_path / "own"):  # meshes are looked for above the file, too
        (folder / "hand.xml").write_text(MJCF.format(asset))
        with pytest.raises(GraspError, match=r"a\.stl is a Git LFS pointer: run `git lfs pull`"):
            HandDescription.from_file(folder / "hand.xml")


def test_sdf_is_named(tmp_path):
    (tmp_path / "model.sdf").write_text(
        '<?xml version="1.0"?><sdf version="1.6"><model name="hand"/></sdf>'
    )
    with pytest.raises(
        GraspError, match="it is SDF, which is not read: give the hand's URDF, xacro or MJCF"
    ):
        HandDescription.from_file(tmp_path / "model.sdf")


@pytest.mark.parametrize("path", ["", "\0", None])
def test_what_is_no_path(path):
    with pytest.raises(OSError, match=r"not a path|No such file"):
        read_bytes(path)
    for reader in ("grasp", "urdf"):
        with pytest.raises(GraspError):
            READERS[reader](path)


def test_a_file_or_pipe_that_is_too_large_is_refused(tmp_path):
    path = tmp_path / "large"
    pipe = tmp_path / "pipe"
    path.write_bytes(b"x" * 11)
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_bytes, args=(b"x" * 11,), daemon=True)
    writer.start()
    for given in (path, pipe):
        with pytest.raises(OSError, match="larger than"):
            read_bytes(given, 10)
    writer.join()
    assert read_bytes(path, 11) == b"x" * 11


def grasp(*words: str, text: str = "") -> subprocess.CompletedProcess[str]:
    """The command line, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "training", *words],
        input=text,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_the_command_reads_what_is_piped_into_it_and_refuses_a_folder(tmp_path):
    text = save_grasp(presets.tripod(), tmp_path / "grasp.json").read_text()
    wrench = ("--wrench", "0", "0", "-1", "0", "0", "0", "--method", "newton")
    assert grasp("solve", "--grasp", "/dev/stdin", *wrench, text=text).returncode == 0
    refused = grasp("solve", "--grasp", str(tmp_path), *wrench)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert (
        refused.stderr
        == f"grasp: cannot read grasp file {tmp_path}: Is a directory; check the path\n"
    )


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "--friction", "1e300"),
        ("solve", "--wrench", "1e300", "0", "0", "0", "0", "0"),
        ("evaluate", "starts", "--wrenches", "0"),
        ("evaluate", "env", "--episodes", "-1"),
        ("fit", "--seconds", "nan"),
        ("rl", "--steps", "0"),
        ("report", "/dev"),
        ("solve", "--initial", "nearest"),
        ("demo", "--seconds", "inf", "--video", "hand.gif"),
    ],
    ids=" ".join,
)
def test_commands_given_wrong_numbers(words, tmp_path, capsys):
    out = () if words[0] in ("solve", "report", "demo") else ("--out", str(tmp_path))
    try:
        code = main([*words, *out])
    except SystemExit as stop:  # settings that the command line checks as it reads them
        code = stop.code
    told = capsys.readouterr().err
    assert code == 2
    assert told.startswith("grasp: ") or "Error parsing" in told
