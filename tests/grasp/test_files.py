"""Grasp files: every bit comes back, and errors name the file and the field."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from grasp.test_grasp import same
from problems import random_grasp

from grasp_env.errors import InvalidInputError
from grasp_env.grasp import Grasp, load_grasp, presets, save_grasp
from grasp_env.grasp.files import GraspFileError

PLAIN = {
    "positions": [[0.04, 0, 0], [-0.02, 0.03, 0], [-0.02, -0.03, 0]],
    "normals": [[-1, 0, 0], [0.6, -0.8, 0], [0.6, 0.8, 0]],
    "friction": 0.5,
}


def written(folder: Path, **changes: object) -> Path:
    file = folder / "grasp.json"
    file.write_text(json.dumps({k: v for k, v in {**PLAIN, **changes}.items() if v is not ...}))
    return file


def test_grasps_come_back_bit_by_bit(tmp_path):
    rng = np.random.default_rng(1)
    base = random_grasp(rng, 5)
    mu = [[0.5, 0.5], [0.3, 0.7], [1 / 3, 0.1], [0.4, 0.4], [0.5, 0.2]]
    models = {
        "contact_model": ["hard", "soft", "hard", "frictionless", "soft"],
        "torsional_friction": [0, 0.005, 0, 0, 0.1 / 3],
    }
    mixed = Grasp.from_contacts(base.positions, base.normals, mu, **models)
    turned = Grasp.from_contacts(
        base.positions, base.normals, 0.5, tangents=rng.standard_normal((5, 3))
    )
    # soft contacts may have no torsional friction, some of them or all
    models["torsional_friction"] = [0, 0.005, 0, 0, 0]
    some = Grasp.from_contacts(base.positions, base.normals, mu, **models)
    models["torsional_friction"] = np.zeros(5)
    none = Grasp.from_contacts(base.positions, base.normals, mu, **models)
    for grasp in (presets.tripod(), mixed, turned, some, none):
        file = save_grasp(grasp, tmp_path / "new folder" / "grasp.json")
        same(load_grasp(file), grasp)
        first = file.read_bytes()
        save_grasp(load_grasp(file), str(file))
        assert file.read_bytes() == first
        assert ("tangents" in json.loads(first)) == (grasp is turned)
        # no temporary file is left
        assert [f.name for f in file.parent.iterdir()] == ["grasp.json"]


def test_a_file_needs_three_keys(tmp_path):
    grasp = load_grasp(file := written(tmp_path))
    same(grasp, Grasp.from_contacts(**PLAIN))
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())  # the mark with which some editors begin
    same(load_grasp(file), grasp)
    soft = load_grasp(written(tmp_path, contact_model="soft", torsional_friction=0.005))
    assert (soft.models.torsional_friction == 0.005).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mu": 0.5}, r"unknown keys \['mu'\], missing keys \[\]; required are"),
        ({"normal": [], "normals": ...}, r"unknown keys \['normal'\], missing keys \['normals'\]"),
        ({"schema": "grasp-force/grasp/2"}, "has schema 'grasp-force/grasp/2', this version reads"),
        ({"units": {"positions": "mm"}}, "units must be .* got {'positions': 'mm'}: convert"),
        ({"units": "m"}, "units must be"),
        (
            {"friction": "0.5"},
            r"friction must be numbers of shape \(...\): they are of type <U3, got '0.5'",
        ),
        ({"friction": None}, "friction must be numbers"),
        ({"friction": 10**400}, "friction must be finite, got inf"),
        ({"positions": [[0, 0, 0], [1]]}, "positions must be numbers of shape"),
        ({"normals": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "normal 2 is .* with length 2: divide"),
        ({"tangents": None}, "tangents must be numbers .* leave the key out"),
        ({"contact_model": 3}, "contact_model must be a name or a list of N names, got 3.0"),
        ({"contact_model": "soft"}, "soft contacts need torsional_friction"),
        ("", "is not a JSON object of this format"),
        ("[1, 2]", "must be one JSON object"),
        ("\x80", "is not a JSON object"),
        ('{"friction": 1, "friction": 2}', "key 'friction' is given twice: keep one"),
        ("[" * 100_000, "is not a JSON object"),
    ],
)
def test_errors_name_the_file_and_the_field(changes, message, tmp_path):
    file = tmp_path / "grasp.json"
    if isinstance(changes, str):
        file.write_bytes(changes.encode("latin-1"))
    else:
        written(tmp_path, **changes)
    with pytest.raises(GraspFileError, match=message) as caught:
        load_grasp(file)
    assert f"grasp file {file}" in str(caught.value)
    assert isinstance(caught.value, OSError)


def test_files_that_cannot_be_read_or_written(tmp_path, monkeypatch):
    with pytest.raises(GraspFileError, match="a length of one to 1 %") as caught:
        load_grasp(file := written(tmp_path, normals=[[0.0, 0.0, 2.0]] * 3))
    assert isinstance(caught.value.__cause__, InvalidInputError)
    with pytest.raises(GraspFileError, match=r"cannot read grasp file .*none\.json: No such file"):
        load_grasp(tmp_path / "none.json")
    with pytest.raises(GraspFileError, match=r"cannot write grasp file .*choose another path"):
        save_grasp(presets.tripod(), file / "grasp.json")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    save_grasp(presets.tripod(), file)
    monkeypatch.setattr("os.replace", full)
    with pytest.raises(GraspFileError, match="No space left"):
        save_grasp(presets.paper_cuboid(), file)
    assert load_grasp(file).n_contacts == 3
    assert [f.name for f in tmp_path.iterdir()] == ["grasp.json"]
