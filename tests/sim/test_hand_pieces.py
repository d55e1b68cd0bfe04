"""Pieces of a hand's meshes are kept by content; missing files, progress, the unit of a .dae."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from grasp_env.errors import InvalidInputError
from grasp_env.sim import mesh_files, progress
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.files import meshes, pieces
from grasp_env.sim.hand.tree import Geometry
from grasp_env.sim.objects.cache import entries
from training.cli import main

JOINT = '<parent link="palm"/><child link="finger"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="2"/>'
INERTIAL = '<inertial><mass value="0.1"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"/></inertial>'
TIP = {"finger": ((0.0, 0.0, 0.03), 0.004)}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder for the test alone."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def shape(role: str, mesh: str, scale: str = "1 1 1") -> str:
    return f'<{role}><geometry><mesh filename="{mesh}" scale="{scale}"/></geometry></{role}>'


def read(folder: Path, palm: str = "", finger: str = "", tips: Any = TIP) -> HandDescription:
    text = f'<robot name="r"><link name="palm">{palm}</link><joint name="bend" type="revolute">{JOINT}</joint><link name="finger">{INERTIAL}{finger}</link></robot>'
    (folder / "hand.urdf").write_text(text, encoding="utf-8")
    return HandDescription.from_urdf(folder / "hand.urdf", tips)


def bent() -> trimesh.Trimesh:
    """An L of two boxes that share no corner."""
    long, short = trimesh.creation.box((0.01, 0.01, 0.06)), trimesh.creation.box((0.03, 0.01, 0.01))
    return trimesh.util.concatenate([long, short.apply_translation((0.019, 0.0, -0.024))])


def fail(*_: Any, **__: Any) -> Any:
    raise AssertionError("this was to come from the cache")


def test_the_second_reading_makes_and_reads_nothing_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bent().export(tmp_path / "bent.stl")
    trimesh.creation.icosphere(2, 0.01).export(tmp_path / "seen.obj")
    palm, finger = shape("collision", "bent.stl", "1 -1 0.5"), shape("visual", "seen.obj")
    first = read(tmp_path, palm, finger, ["finger"])  # the fingertip is sought in what is seen
    assert len(first.palm.collision) == 2
    for module, name in ((pieces, "convex_pieces"), (mesh_files, "read_mesh_bytes"), (meshes, "_corners_exist")):
        monkeypatch.setattr(module, name, fail)
    again = read(tmp_path, palm, finger, ["finger"])
    assert (again.palm, again.links, again.fingertips) == (first.palm, first.links, first.fingertips)
    bent().apply_scale(1.1).export(tmp_path / "bent.stl")  # the same file with other content
    with pytest.raises(AssertionError, match="from the cache"):
        read(tmp_path, palm, finger, ["finger"])


def test_pieces_of_arrays_are_kept_by_content(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bent()
    corners, faces = np.array(mesh.vertices), np.array(mesh.faces)
    found = pieces.kept_pieces(corners, faces, "bent")
    made = pieces.convex_pieces(corners, faces)
    assert len(found) == len(made) == 2
    for one, other in zip(found, made, strict=True):
        assert {tuple(row) for row in one.tolist()} == {tuple(row) for row in other.tolist()}
    monkeypatch.setattr(pieces, "convex_pieces", fail)
    for one, other in zip(pieces.kept_pieces(corners, faces.astype(np.int32), "again"), found, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(AssertionError, match="from the cache"):
        pieces.kept_pieces(1.1 * corners, faces, "other")


def test_a_hands_meshes_are_listed_as_such(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bent().export(tmp_path / "bent.stl")
    read(tmp_path, finger=shape("collision", "bent.stl"))
    ((name, use),) = ((entry.name, entry.use) for entry in entries())
    assert (name, use) == ("bent.stl", "hand")
    assert main(["object", "list", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["meshes"]
    assert (told["name"], told["use"], told["pieces"]) == ("bent.stl", "hand", 2)
    assert main(["object", "clear"]) == 0
    assert entries() == []


def test_all_missing_meshes_are_told_before_any_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bent().export(tmp_path / "bent.stl")
    monkeypatch.setattr(mesh_files, "mesh_bytes", fail)
    monkeypatch.setattr(pieces, "mesh_bytes", fail)
    palm = shape("collision", "bent.stl") + shape("collision", "meshes/a.stl") + shape("visual", "c.stl")
    finger = shape("collision", "package://hand/b.obj") + shape("collision", "meshes/a.stl")
    with pytest.raises(InvalidInputError) as told:
        read(tmp_path, palm, finger)
    assert "'meshes/a.stl' (palm, finger), 'package://hand/b.obj' (finger). Download" in str(told.value)
    assert "c.stl" not in str(told.value)  # one to look at is left out


def test_progress_is_shown_on_a_terminal_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "PATIENCE", -1.0)
    bent().export(tmp_path / "bent.stl")
    trimesh.creation.box((0.01, 0.02, 0.03)).export(tmp_path / "box.stl")
    palm, finger = shape("collision", "bent.stl"), shape("collision", "box.stl") + shape("collision", "bent.stl")
    read(tmp_path, palm, finger)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    read(tmp_path, palm, finger)
    lines = capsys.readouterr().err.split("\r")
    assert [line.split("] ")[-1].split(",")[0] for line in lines[1:]] == [
        f"{done} of 2 hand.urdf: convex pieces of meshes" for done in range(3)
    ]
    assert lines[-1].endswith("\n")


BOX_DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{unit}
<up_axis>Y_UP</up_axis></asset><library_geometries><geometry id="g"><mesh><source id="s"><float_array id="a" count="{count}">{corners}</float_array>
<technique_common><accessor source="#a" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="S"><node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#S"/></scene></COLLADA>"""


def box_dae(unit: str) -> str:
    """A box of 20 x 30 x 40."""
    box = trimesh.creation.box((20.0, 30.0, 40.0))
    rows = (" ".join(map(str, array.ravel().tolist())) for array in (box.vertices, box.faces))
    corners, faces = rows
    return BOX_DAE.format(unit=unit, count=24, corners=corners, faces=faces)


@pytest.mark.parametrize(
    ("unit", "scale"),
    [
        ('<unit meter="0.001" name="millimetre"/>', "1 1 1"),
        ("<unit name='centimetre' meter='0.01'/>", "0.1 0.1 0.1"),
        ("<unit/>", "0.001 0.001 0.001"),
        ("", "0.001 0.001 0.001"),
    ],
)
def test_the_unit_of_a_dae_counts_where_a_hand_touches_and_is_seen(tmp_path: Path, unit: str, scale: str) -> None:
    """As in ROS; the axis that points up does not."""
    (tmp_path / "box.dae").write_text(box_dae(unit))
    hand = read(tmp_path, shape("collision", "box.dae", scale) + shape("visual", "box.dae", scale))
    (hull,), (look,) = hand.palm.collision, hand.palm.visual
    np.testing.assert_allclose(np.ptp(np.array(hull.corners), axis=0), (0.02, 0.03, 0.04), atol=1e-12)
    # engines multiply the file's numbers by `size`: neither Bullet nor the reader of MuJoCo's pictures applies the unit
    assert look == Geometry("mesh", look.size, file=str(tmp_path / "box.dae"))
    assert look.size == pytest.approx((0.001, 0.001, 0.001))


@pytest.mark.parametrize("unit", ["0", "-1", "nan", "inf", "inch"])
def test_units_that_are_none_are_refused(tmp_path: Path, unit: str) -> None:
    (tmp_path / "box.dae").write_text(box_dae(f'<unit meter="{unit}"/>'))
    with pytest.raises(InvalidInputError, match=f'<unit meter="{unit}">, which must be a number of metres above 0'):
        read(tmp_path, shape("collision", "box.dae"))
