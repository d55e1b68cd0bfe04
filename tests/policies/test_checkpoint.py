"""Saved models: written whole, read with every check, nothing unpickled."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tracemalloc
from typing import Any

import numpy as np
import pytest

from grasp_env.errors import ModelFileError
from grasp_env.grasp import presets, wrench
from policies import LearnedInitialForce
from policies.checkpoint import MOST_TEXT, MOST_WEIGHTS, signature
from policies.learned import PRETRAINED


@pytest.fixture
def stem(tmp_path):
    for suffix in (".safetensors", ".json"):
        shutil.copy(PRETRAINED / f"four_finger{suffix}", tmp_path / f"m{suffix}")
    return tmp_path / "m"


def edit(stem, sign=True, **changes):
    """Changes a description, as somebody would who wants it to be read: with the digest of what it says then."""
    path = stem.with_suffix(".json")
    body = {**json.loads(path.read_text()), **changes}
    said = body.pop("sha256")
    path.write_text(json.dumps({**body, "sha256": signature(body) if sign else said}))


def of(stem) -> dict[str, Any]:
    return json.loads(stem.with_suffix(".json").read_text())


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
        ({"schema": "grasp-force/initial-force/3"}, "train anew"),
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
    edit(stem, numbers={**of(stem)["numbers"], "sizes": [16, 7, 6]})
    with pytest.raises(ModelFileError, match="do not fit"):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize("part", ["numbers", "ranges", "card", "weights"])
def test_the_digest_covers_what_the_description_says(stem, part):
    """Numbers, ranges and card, not the weights alone: nobody's model is another one unnoticed."""
    value = of(stem)[part]
    edit(stem, sign=False, **{part: {**value, "more": 1} if isinstance(value, dict) else value.upper()})
    with pytest.raises(ModelFileError, match="its own sha256"):
        LearnedInitialForce.load(stem)


HUGE = (1e9, 10**9, 10**400, -1, 0, 2.5, 4.0, True, "4", None, [], {}, [[4]])
WRONG = [
    *(("n_contacts", value) for value in (*HUGE, 2, 65)),
    *(("friction_degree", value) for value in HUGE if value != 0 or value is True),
    *(
        ("sizes", value)
        for value in (*HUGE, [8], [8, *[6] * 9], [8, 10**9, 6], [8, -6, 6], [8, 6.5, 6], [7, 6], [8, 5])
    ),
    *(("force_weight", value) for value in (-1.0, 0.0, 1e400, 10**400, "1", None, True)),
    *(("features", value) for value in (3, [], {"length": 1.0, "less": 2.0}, {"length": 0.0}, {"floor": 10**400})),
]


def test_numbers_that_no_model_has_are_refused_at_once(stem):
    """Bounded before anything is made of them: neither time nor memory."""
    numbers = of(stem)["numbers"]
    tracemalloc.start()
    try:
        for name, value in WRONG:
            if value in (1e400,):  # JSON has no infinity, but 1e400 is one
                text = json.dumps({**of(stem), "numbers": {**numbers, name: 0.125}}).replace("0.125", "1e400")
                stem.with_suffix(".json").write_text(text)
            else:
                edit(stem, numbers={**numbers, name: value})
            with pytest.raises(ModelFileError) as caught:
                LearnedInitialForce.load(stem)
            assert len(str(caught.value)) < 600
        assert tracemalloc.get_traced_memory()[1] < 10 * MOST_TEXT  # 10 MB: the weights, and safetensors' copy of them
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "pair", [[1.0], [1.0, 2.0, 3.0], [2.0, 1.0], ["a", "b"], 3, None, [None, 1.0], [0.0, 10**400], [True, 2]]
)
def test_ranges_that_are_none(stem, pair):
    edit(stem, ranges={**of(stem)["ranges"], "magnitude": pair})
    with pytest.raises(ModelFileError, match="malformed"):
        LearnedInitialForce.load(stem)


def test_not_json(stem):
    for text in (
        "not json",
        "[" * 100_000,
        '{"a":' * 100_000,
        "[]",
        "null",
        '{"schema": NaN}',
        "1" * 5000,
        '{"schema": ' + "9" * 4000 + "}",
    ):
        stem.with_suffix(".json").write_text(text)
        with pytest.raises(ModelFileError) as caught:
            LearnedInitialForce.load(stem)
        assert isinstance(caught.value, ValueError | OSError)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_weights_that_are_not_finite_in_float32_are_refused(stem, value):
    checkpoint = LearnedInitialForce.load(stem).checkpoint
    name = next(name for name in checkpoint.tensors if name != "reference")
    checkpoint.tensors[name] = checkpoint.tensors[name].astype(np.float64)
    checkpoint.tensors[name].flat[0] = value
    checkpoint.save(stem)
    with pytest.raises(ModelFileError, match="not finite"):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
def test_what_is_no_file_is_not_waited_for(stem, suffix):
    file = stem.with_suffix(suffix)
    file.unlink()
    for make in (
        file.mkdir,
        lambda: os.mkfifo(file),
        lambda: file.symlink_to("/dev/zero"),
        lambda: file.symlink_to(file),
    ):
        make()
        with pytest.raises(ModelFileError, match=r"folder, a pipe or a device|symbolic links"):
            LearnedInitialForce.load(stem)
        (file.rmdir if file.is_dir() else file.unlink)()


@pytest.mark.parametrize("path", ["", ".", "/", "a\0b", "x" * 5000, 5, None, b"bytes"])
def test_what_is_no_path(path):
    with pytest.raises(ModelFileError, match=r"path|No such file|too long|null"):
        LearnedInitialForce.load(path)


@pytest.mark.parametrize(("suffix", "most"), [(".json", MOST_TEXT), (".safetensors", MOST_WEIGHTS)])
def test_what_is_too_large_is_not_read(stem, suffix, most):
    with stem.with_suffix(suffix).open("r+b") as file:
        file.truncate(most + 1)  # a hole: no room on the disk
    with pytest.raises(ModelFileError, match="larger than"):
        LearnedInitialForce.load(stem)


def test_weights_of_other_types(stem):
    """What safetensors can hold and this cannot use: one error, whatever numpy makes of it."""
    for dtype in ("BF16", "F8_E4M3", "I64", "BOOL", "F16"):
        size = {"I64": 8, "BOOL": 1, "F8_E4M3": 1}.get(dtype, 2)
        header = json.dumps({"layers.0.weight": {"dtype": dtype, "shape": [2], "data_offsets": [0, 2 * size]}}).encode()
        blob = len(header).to_bytes(8, "little") + header + bytes(2 * size)
        stem.with_suffix(".safetensors").write_bytes(blob)
        edit(stem, weights=hashlib.sha256(blob).hexdigest())
        with pytest.raises(ModelFileError):
            LearnedInitialForce.load(stem)
