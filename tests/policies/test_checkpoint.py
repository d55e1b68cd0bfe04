"""Saved models: written whole, read with every check, nothing unpickled."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from grasp_env.errors import ModelFileError
from grasp_env.grasp import presets, wrench
from policies import LearnedInitialForce
from policies.learned import MODELS, PRETRAINED


@pytest.fixture(params=MODELS)
def stem(request, tmp_path):
    for suffix in (".safetensors", ".json"):
        shutil.copy(PRETRAINED / f"{request.param}{suffix}", tmp_path / f"m{suffix}")
    return tmp_path / "m"


def edit(stem, **changes):
    path = stem.with_suffix(".json")
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_save_and_load_keep_every_bit(stem, tmp_path):
    rule, grasp, w = LearnedInitialForce.load(stem), presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    again = tmp_path / "deep" / "again.v2"
    assert rule.checkpoint.save(again).name == "again.v2.safetensors"
    for path in (again, again.with_name("again.v2.json"), again.with_name("again.v2.safetensors")):
        np.testing.assert_array_equal(LearnedInitialForce.load(path)(grasp, w), rule(grasp, w))
    assert not list(again.parent.glob(".*"))  # no temporary left behind


def test_names_with_dots_do_not_collide(stem, tmp_path):
    checkpoint = LearnedInitialForce.load(stem).checkpoint
    one, two = (checkpoint.save(tmp_path / f"model.v{k}") for k in (1, 2))
    assert one != two


def test_truncated_changed_and_missing_weights(stem):
    weights = stem.with_suffix(".safetensors")
    whole = weights.read_bytes()
    for damaged in (whole[:1000], whole[:-1] + bytes([whole[-1] ^ 1]), b""):
        weights.write_bytes(damaged)
        with pytest.raises(ModelFileError, match="sha256"):
            LearnedInitialForce.load(stem)
    weights.unlink()
    with pytest.raises(ModelFileError, match="No such file"):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"schema": "other/7"}, "other/7"),
        ({"schema": "grasp-force/initial-force/1"}, "train anew"),
        ({"kind": "another"}, "another"),
        ({"kind": 3}, "'3'"),
        ({"numbers": {}}, "malformed"),
        ({"numbers": []}, "malformed"),
        ({"ranges": {"magnitude": "x"}}, "malformed"),
        ({"ranges": {}}, "malformed"),
        ({"card": 5}, "malformed"),
    ],
)
def test_foreign_and_malformed_descriptions(stem, changes, match):
    edit(stem, **changes)
    with pytest.raises(ModelFileError, match=match):
        LearnedInitialForce.load(stem)


def test_numbers_that_do_not_fit_the_weights(stem):
    numbers = json.loads(stem.with_suffix(".json").read_text())["numbers"]
    if "sizes" in numbers:
        edit(stem, numbers={**numbers, "sizes": [8, 7, 6]})
    else:
        edit(stem, numbers={**numbers, "layers": 9})
    with pytest.raises(ModelFileError, match="do not fit"):
        LearnedInitialForce.load(stem)


def test_not_json(stem):
    for text in ("not json", "[" * 100_000, "[]", "null"):
        stem.with_suffix(".json").write_text(text)
        with pytest.raises(ModelFileError) as caught:
            LearnedInitialForce.load(stem)
        assert isinstance(caught.value, ValueError | OSError)


def test_the_other_kind_of_weights(tmp_path, stem):
    other = PRETRAINED / (
        "four_finger" if "layers" in LearnedInitialForce.load(stem).checkpoint.numbers else "any_grasp"
    )
    meta = json.loads(other.with_suffix(".json").read_text())
    blob = json.loads(stem.with_suffix(".json").read_text())
    edit(stem, kind=meta["kind"], numbers=meta["numbers"], ranges=meta["ranges"], sha256=blob["sha256"])
    with pytest.raises(ModelFileError, match="do not fit"):
        LearnedInitialForce.load(stem)


def test_nan_weights_are_refused(stem):
    checkpoint = LearnedInitialForce.load(stem).checkpoint
    name = next(iter(checkpoint.tensors))
    checkpoint.tensors[name].flat[0] = np.nan
    checkpoint.save(stem)
    with pytest.raises(ModelFileError, match="not finite"):
        LearnedInitialForce.load(stem)
