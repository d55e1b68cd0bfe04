"""Saved models: `<name>.safetensors` (weights) and `<name>.json` (description).

A file may come from an untrusted source: nothing is unpickled, and sizes and numbers are checked
before anything is allocated.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from grasp_env.errors import ModelFileError, shown
from grasp_env.inputs.files import TEXT, as_path, digest, parsed, replacing, understood

SCHEMA = "grasp-force/initial-force/5"
MOST_TEXT, MOST_WEIGHTS = 1 << 20, 1 << 26
"""Largest sizes of the two files [bytes]; the shipped ones have 6,000 and 63,000."""
_AGAIN = "copy both files again or train anew with `grasp fit`"


@dataclass(frozen=True)
class Checkpoint:
    """A trained initial force.

    Attributes:
        tensors: arrays by name, float32 or float64.
        numbers: shape and normalisation, as in the JSON file.
        ranges: (least, largest) values of training, by name.
        card: model card with data, seed, command, time, scores, versions.
    """

    tensors: dict[str, np.ndarray]
    numbers: dict[str, Any]
    ranges: dict[str, tuple[float, float]]
    card: dict[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path) -> Path:
        """Write `<path>.safetensors` and `<path>.json`, each under a temporary name first."""
        stem = _stem(path)
        stem.parent.mkdir(parents=True, exist_ok=True)
        blob = save({name: np.ascontiguousarray(value) for name, value in self.tensors.items()})
        ranges = {name: list(pair) for name, pair in self.ranges.items()}
        body = {
            "schema": SCHEMA,
            "weights": digest(blob),
            "numbers": self.numbers,
            "ranges": ranges,
            "card": self.card,
        }
        replace(_file(stem, ".safetensors"), blob)
        replace(_file(stem, ".json"), signed(body).encode())
        return _file(stem, ".safetensors")

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Read and check a saved model.

        Args:
            path: either of the two files, or their common stem.

        Raises:
            ModelFileError: missing, too large, not JSON, another schema, changed, or not finite in
                float32.
        """
        stem = _stem(path)
        file = _file(stem, ".safetensors")
        about = _file(stem, ".json")
        meta = described(about, SCHEMA, "model description", "grasp fit", MOST_TEXT)

        def tensors(blob: bytes) -> dict[str, np.ndarray]:
            if digest(blob) != meta["weights"]:
                raise ModelFileError(
                    f"model weights {file} do not match the sha256 in their .json: the file is truncated or was changed; {_AGAIN}"
                )
            arrays = load(blob)
            for name, value in arrays.items():
                if (
                    value.dtype not in (np.float32, np.float64)
                    or not (np.abs(value) <= np.finfo(np.float32).max).all()
                ):
                    raise ValueError(f"tensor {name[:40]!r} is not finite in float32")
            return arrays

        def rest(meta: dict[str, Any]) -> tuple[Any, ...]:
            ranges = {name: (low, high) for name, (low, high) in meta["ranges"].items()}
            return dict(meta["numbers"]), ranges, dict(meta["card"])

        hint = f"; {_AGAIN}"
        what = f"model weights {file}"
        arrays = parsed(
            file, tensors, ModelFileError, what, "a file of weights", hint, MOST_WEIGHTS
        )
        what = f"model description {about}"
        return cls(arrays, *understood(meta, rest, ModelFileError, what, "complete", hint))

    def expect(self, shapes: dict[str, tuple[int, ...]]) -> None:
        """Raise `ModelFileError` unless the tensors have exactly these names and shapes."""
        got = {name: value.shape for name, value in self.tensors.items()}
        if got != shapes:
            wrong = sorted(name for name in {*got, *shapes} if got.get(name) != shapes.get(name))
            raise ModelFileError(
                f"model: tensors {', '.join(name[:40] for name in wrong[:4])} do not fit its numbers; {_AGAIN}"
            )


def signed(body: dict[str, Any]) -> str:
    """Return the text of a description with its hash, as `described` reads it."""
    return json.dumps({**body, "sha256": signature(body)}, indent=2, allow_nan=False) + "\n"


def signature(body: dict[str, Any]) -> str:
    """Return the hash of a description."""
    return digest(json.dumps(body, sort_keys=True, allow_nan=False).encode())


def described(file: Path, schema: str, what: str, command: str, most: int = TEXT) -> dict[str, Any]:
    """Read a JSON description.

    Args:
        file: path.
        schema: expected value of "schema".
        what, command: kind of file and the command that writes it, for messages.
        most: largest size [bytes].

    Raises:
        ModelFileError: missing, too large, not JSON, of another schema, or changed.
    """

    def read(blob: bytes) -> dict[str, Any]:
        meta = json.loads(blob.decode())
        stored = meta.get("schema") if isinstance(meta, dict) else None
        if stored != schema:
            fault = f"has schema {shown(stored)}, this version reads {schema!r}: train anew with `{command}`"
            raise ModelFileError(f"{what} {file} {fault}")
        if meta.pop("sha256", None) != signature(meta):  # which refuses nan
            raise ModelFileError(
                f"{what} {file} does not match its own sha256: it was changed{again}"
            )
        return meta

    again = f"; copy all files again or train anew with `{command}`"
    return parsed(file, read, ModelFileError, f"{what} {file}", "JSON", again, most)


def _stem(path: str | Path) -> Path:
    path = as_path(path, ModelFileError, "a model's file")
    return path.with_suffix("") if path.suffix in (".safetensors", ".json") else path


def _file(stem: Path, suffix: str) -> Path:
    if not stem.name:
        raise ModelFileError(f"a model's path is needed, got {str(stem)!r}, a folder")
    return stem.with_name(stem.name + suffix)  # with_suffix would take "model.v2" for a suffix


def replace(file: Path, data: bytes) -> None:
    """Write a file atomically."""
    with replacing(file) as temporary:
        temporary.write_bytes(data)
