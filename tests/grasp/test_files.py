from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from problems import GRASPS, random_grasp

from grasp_env.errors import GraspError, RankDeficientGraspError
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.files import SCHEMA, GraspFileError, load_grasp, save_grasp

PLAIN = {
    "positions": [[0.04, 0, 0], [-0.02, 0.03, 0], [-0.02, -0.03, 0]],
    "normals": [[-1, 0, 0], [0.6, -0.8, 0], [0.6, 0.8, 0]],
    "friction": 0.5,
}


def _same(a: Grasp, b: Grasp) -> None:
    for one, other in ((a, b), (a.models, b.models)):
        for name in (each.name for each in fields(one)):
            value = getattr(one, name)
            if isinstance(value, np.ndarray):
                assert value.tobytes() == getattr(other, name).tobytes(), name  # every bit, signs of zeros too
            elif name != "models":
                assert value == getattr(other, name), name


def _written(folder: Path, **changes: object) -> Path:
    file = folder / "grasp.json"
    file.write_text(json.dumps({k: v for k, v in {**PLAIN, **changes}.items() if v is not ...}))
    return file


@pytest.mark.parametrize("name", GRASPS)
def test_named_grasps_come_back_bit_by_bit(name: str, tmp_path: Path) -> None:
    file = save_grasp(GRASPS[name], tmp_path / "new folder" / "grasp.json")
    _same(load_grasp(file), GRASPS[name])
    first = file.read_bytes()
    save_grasp(load_grasp(file), str(file))
    assert file.read_bytes() == first
    assert [f.name for f in file.parent.iterdir()] == ["grasp.json"]  # nothing temporary is left


def test_all_models_come_back(tmp_path: Path) -> None:
    plain = random_grasp(np.random.default_rng(0), 5)
    grasp = Grasp.from_contacts(
        plain.positions, plain.normals, [[0.5, 0.5], [0.3, 0.7], [1 / 3, 0.1], [0.4, 0.4], [0.5, 0.2]],
        contact_model=["hard", "soft", "hard", "frictionless", "soft"], torsional_friction=[0, 0.005, 0, 0, 0.1 / 3],
    )  # fmt: skip
    file = save_grasp(grasp, tmp_path / "grasp.json")
    _same(load_grasp(file), grasp)
    written = json.loads(file.read_text())
    assert written["schema"] == SCHEMA
    assert written["units"]["torsional_friction"] == "m"
    assert written["friction"][3] == [0.0, 0.0]
    assert "tangents" not in written  # they are the rule's


def test_given_tangents_come_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    plain = random_grasp(rng, 6)
    grasp = Grasp.from_contacts(plain.positions, plain.normals, 0.5, tangents=rng.standard_normal((6, 3)))
    assert np.abs(grasp.frames - plain.frames).max() > 0.5
    loaded = load_grasp(save_grasp(grasp, tmp_path / "grasp.json"))
    _same(loaded, grasp)


def test_a_file_by_hand_needs_three_keys(tmp_path: Path) -> None:
    grasp = load_grasp(_written(tmp_path))
    _same(grasp, Grasp.from_contacts(**PLAIN))
    marked = tmp_path / "grasp.json"
    marked.write_bytes(b"\xef\xbb\xbf" + marked.read_bytes())  # some editors begin files with this mark
    _same(load_grasp(marked), grasp)
    soft = load_grasp(_written(tmp_path, contact_model="soft", torsional_friction=0.005))
    assert (soft.models.torsional_friction == 0.005).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mu": 0.5}, r"unknown keys \['mu'\], missing keys \[\]; required are"),
        ({"normals": ...}, r"unknown keys \[\], missing keys \['normals'\]"),
        ({"normal": [], "normals": ...}, r"unknown keys \['normal'\], missing keys \['normals'\]"),
        (
            {"schema": "grasp-force/grasp/2"},
            "has schema 'grasp-force/grasp/2', this version reads 'grasp-force/grasp/1'",
        ),
        ({"schema": None}, "has schema None"),
        ({"units": {"positions": "mm"}}, "units must be .* got {'positions': 'mm'}: convert"),
        ({"units": "m"}, "units must be"),
        ({"friction": "0.5"}, r"friction must be numbers of shape \(\): text is no number, got '0.5'"),
        ({"friction": True}, "friction must be numbers"),
        ({"friction": None}, "friction must be numbers"),
        ({"friction": 0}, "friction must be > 0"),
        ({"friction": [0.5, 0.5]}, r"friction must have shape \(3,\), got \(2,\)"),
        ({"friction": 10**400}, "friction must be finite, got inf"),
        ({"positions": [[0, 0, 0], [1]]}, "positions must be numbers of shape"),
        ({"positions": [[0, 0, float("nan")]] * 3}, "positions must be finite, got .*nan"),
        ({"normals": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "normal 2 is .* with length 2: divide"),
        ({"tangents": [[1, 0, 0]] * 3}, "tangent 0 is .* along its normal"),
        ({"tangents": "x"}, "tangents must be numbers of shape"),
        ({"tangents": None}, "tangents must be numbers .* leave the key out"),
        ({"positions": [["0", "0", "1"]] * 3}, "positions must be numbers of shape .* text is no number"),
        ({"positions": [[True, 0, 1]] * 3}, "positions must be numbers of shape .* no numbers"),
        ({"contact_model": 3}, "contact_model must be a name or a list of N names, got 3.0"),
        ({"contact_model": "rigid"}, "unknown contact model 'rigid'"),
        ({"contact_model": ["hard"]}, "contact_model must be one name or 3 of them, got 1"),
        ({"contact_model": "soft"}, "soft contacts need torsional_friction"),
    ],
)
def test_errors_name_the_file_and_the_field(changes: dict, message: str, tmp_path: Path) -> None:
    file = _written(tmp_path, **changes)
    with pytest.raises(GraspFileError, match=message) as caught:
        load_grasp(file)
    assert f"grasp file {file}" in str(caught.value)
    assert isinstance(caught.value, GraspError)
    assert isinstance(caught.value, OSError)


def test_the_grasps_own_error_is_the_cause(tmp_path: Path) -> None:
    with pytest.raises(GraspFileError, match=r"rank\(G\) = \d < 6") as caught:
        load_grasp(_written(tmp_path, contact_model="frictionless"))
    assert isinstance(caught.value.__cause__, RankDeficientGraspError)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not a JSON object of this format"),
        ("{'positions': []}", "is not a JSON object of this format"),
        ('{"friction": 1, "friction": 2}', "key 'friction' is given twice: keep one"),
        ("[1, 2]", "must be one JSON object"),
        ("[" * 100_000, "is not a JSON object"),
        ("\x80", "is not a JSON object"),
    ],
)
def test_files_that_are_no_json_objects(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "grasp.json"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(GraspFileError, match=message):
        load_grasp(file)


def test_files_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(GraspFileError, match=r"cannot read grasp file .*none\.json: No such file"):
        load_grasp(tmp_path / "none.json")
    (tmp_path / "file").write_text("")
    with pytest.raises(GraspFileError, match=r"cannot write grasp file .*choose another path"):
        save_grasp(presets.tripod(), tmp_path / "file" / "grasp.json")


def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = save_grasp(presets.tripod(), tmp_path / "grasp.json")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(GraspFileError, match="No space left"):
        save_grasp(presets.paper_cuboid(), file)
    assert load_grasp(file).n_contacts == 3
    assert [f.name for f in tmp_path.iterdir()] == ["grasp.json"]
