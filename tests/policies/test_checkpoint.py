"""Saved models: written whole, checked when read, nothing unpickled."""

from __future__ import annotations

import hashlib
import json
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


def described(stem) -> dict[str, Any]:
    return json.loads(stem.with_suffix(".json").read_text())


def edit(stem, sign=True, **changes):
    """Changes a description, with the digest of the changed text or with the old one."""
    body = {**described(stem), **changes}
    old = body.pop("sha256")
    stem.with_suffix(".json").write_text(
        json.dumps({**body, "sha256": signature(body) if sign else old})
    )


def test_save_and_load_keep_every_bit(stem, tmp_path):
    rule = LearnedInitialForce.load(stem)
    grasp = presets.paper_cuboid()
    w = np.array(wrench.PAPER_CONSTANT)
    again = tmp_path / "deep" / "again.v2"
    # names with dots do not collide
    assert rule.checkpoint.save(again).name == "again.v2.safetensors"
    for path in (again, again.with_name("again.v2.json"), again.with_name("again.v2.safetensors")):
        np.testing.assert_array_equal(LearnedInitialForce.load(path)(grasp, w), rule(grasp, w))
    assert not list(again.parent.glob(".*"))  # no temporary left behind


def test_damaged_weights_are_refused(stem):
    weights = stem.with_suffix(".safetensors")
    whole = weights.read_bytes()
    for damaged in (whole[:1000], whole[:-1] + bytes([whole[-1] ^ 1]), b""):
        weights.write_bytes(damaged)
        with pytest.raises(ModelFileError, match="sha256"):
            LearnedInitialForce.load(stem)
    weights.unlink()
    with pytest.raises(ModelFileError, match="No such file"):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize("part", ["numbers", "ranges", "card", "weights"])
def test_the_digest_covers_the_whole_description(stem, part):
    value = described(stem)[part]
    edit(
        stem,
        sign=False,
        **{part: {**value, "more": 1} if isinstance(value, dict) else value.upper()},
    )
    with pytest.raises(ModelFileError, match="its own sha256"):
        LearnedInitialForce.load(stem)


RANGES = [[1.0], [2.0, 1.0], ["a", "b"], None, [0.0, 10**400], [True, 2]]
WRONG: list[dict[str, Any]] = [
    {"schema": "grasp-force/initial-force/3"},
    {"numbers": {}},
    {"ranges": {"magnitude": "x"}},
    {"card": 5},
    *({"ranges": {"friction": [0.2, 0.6], "magnitude": pair}} for pair in RANGES),
]
NUMBERS = [
    *(("n_contacts", value) for value in (10**9, 10**400, -1, 4.0, True, "4", None, 2, 65)),
    *(("friction_degree", value) for value in (10**9, -1, 2.5)),
    *(
        ("sizes", value)
        for value in (4, [8], [8, *[6] * 9], [8, 10**9, 6], [8, -6, 6], [8, 6.5, 6], [16, 7, 6])
    ),
    *(("force_weight", value) for value in (-1.0, 0.0, 10**400, "1", None, True)),
    *(
        ("features", value)
        for value in (3, {"length": 1.0, "less": 2.0}, {"floor": 0.0}, {"floor": 10**400})
    ),
]


def test_descriptions_of_no_model_are_refused_without_much_memory(stem):
    numbers = described(stem)["numbers"]
    whole = stem.with_suffix(".json").read_text()
    tracemalloc.start()
    try:
        for changes in (
            *WRONG,
            *({"numbers": {**numbers, name: value}} for name, value in NUMBERS),
        ):
            stem.with_suffix(".json").write_text(whole)
            edit(stem, **changes)
            with pytest.raises(ModelFileError, match="train anew") as caught:
                LearnedInitialForce.load(stem)
            assert len(str(caught.value)) < 600
        # 10 MB: the weights, and safetensors' copy of them
        assert tracemalloc.get_traced_memory()[1] < 10 * MOST_TEXT
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("text", ["not json", "[" * 100_000, "[]", '{"schema": NaN}', "1" * 5000])
def test_not_json(stem, text):
    stem.with_suffix(".json").write_text(text)
    with pytest.raises(ModelFileError):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_weights_that_are_not_finite_in_float32_are_refused(stem, value):
    checkpoint = LearnedInitialForce.load(stem).checkpoint
    checkpoint.tensors["pairs"] = checkpoint.tensors["pairs"].astype(np.float64)
    checkpoint.tensors["pairs"].flat[0] = value
    checkpoint.save(stem)
    with pytest.raises(ModelFileError, match="not finite"):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize(("dtype", "size"), [("BF16", 2), ("F8_E4M3", 1), ("I64", 8)])
def test_weights_of_other_types_are_refused(stem, dtype, size):
    header = json.dumps(
        {"layers.0.weight": {"dtype": dtype, "shape": [2], "data_offsets": [0, 2 * size]}}
    ).encode()
    blob = len(header).to_bytes(8, "little") + header + bytes(2 * size)
    stem.with_suffix(".safetensors").write_bytes(blob)
    edit(stem, weights=hashlib.sha256(blob).hexdigest())
    with pytest.raises(ModelFileError):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize(("suffix", "most"), [(".json", MOST_TEXT), (".safetensors", MOST_WEIGHTS)])
def test_files_have_a_bounded_size(stem, suffix, most):
    with stem.with_suffix(suffix).open("r+b") as opened:
        opened.truncate(most + 1)  # a hole: no room on the disk
    with pytest.raises(ModelFileError, match="larger than"):
        LearnedInitialForce.load(stem)


@pytest.mark.parametrize("path", ["", "/", "a\0b", "x" * 5000, None])
def test_what_is_no_path_is_refused(path):
    with pytest.raises(ModelFileError, match=r"path|No such file|too long|null"):
        LearnedInitialForce.load(path)
