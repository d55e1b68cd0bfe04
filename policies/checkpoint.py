"""Saved models: `<name>.safetensors` (weights) beside `<name>.json` (what they mean). Nothing is unpickled."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from grasp_env.errors import ModelFileError

SCHEMA = "grasp-force/initial-force/2"
KINDS = ("fixed_grasp", "any_grasp")


@dataclass(frozen=True)
class Checkpoint:
    """A trained initial force.

    Attributes:
        kind: "fixed_grasp" (`fixed_grasp.py`) or "any_grasp" (`any_grasp.py`), which say what it must hold.
        tensors: arrays by name, float32 or float64.
        numbers: shape and normalisation, as JSON has them.
        ranges: (least, most) of what was seen in training, by name.
        card: data, seed, command, time, scores, versions: for people.
    """

    kind: str
    tensors: dict[str, np.ndarray]
    numbers: dict[str, Any]
    ranges: dict[str, tuple[float, float]]
    card: dict[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path) -> Path:
        """Writes `<path>.safetensors` and `<path>.json`, each under a temporary name first."""
        stem = _stem(path)
        stem.parent.mkdir(parents=True, exist_ok=True)
        blob = save({name: np.ascontiguousarray(value) for name, value in self.tensors.items()})
        meta = {
            "schema": SCHEMA,
            "kind": self.kind,
            "sha256": hashlib.sha256(blob).hexdigest(),
            "numbers": self.numbers,
            "ranges": {name: list(pair) for name, pair in self.ranges.items()},
            "card": self.card,
        }
        text = (json.dumps(meta, indent=2, allow_nan=False) + "\n").encode()
        _replace(_file(stem, ".safetensors"), blob)
        _replace(_file(stem, ".json"), text)
        return _file(stem, ".safetensors")

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Reads and checks a saved model.

        Args:
            path: either of the two files, or their common stem.

        Raises:
            ModelFileError: missing, not JSON, another schema or kind, changed weights, numbers that are not finite.
        """
        stem = _stem(path)
        meta = _read_meta(_file(stem, ".json"))
        file = _file(stem, ".safetensors")
        try:
            blob = file.read_bytes()
        except OSError as error:
            raise ModelFileError(
                f"model weights {file}: {error.strerror}; a model is two files, .safetensors and .json"
            ) from None
        if hashlib.sha256(blob).hexdigest() != meta.get("sha256"):
            raise ModelFileError(
                f"model weights {file} do not match the sha256 in their .json: the file is truncated or was changed; copy both files again or train anew"
            )
        try:
            checkpoint = cls(
                kind=str(meta["kind"]),
                tensors=load(blob),
                numbers=dict(meta["numbers"]),
                ranges={str(name): (float(low), float(high)) for name, (low, high) in meta["ranges"].items()},
                card=dict(meta["card"]),
            )
        except (SafetensorError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise malformed(stem, error) from None
        if checkpoint.kind not in KINDS:
            raise ModelFileError(f"model {stem} is of kind {checkpoint.kind!r}, this version knows {KINDS}")
        for name, value in checkpoint.tensors.items():
            if value.dtype not in (np.float32, np.float64) or not np.isfinite(value).all():
                raise ModelFileError(f"model {stem}: tensor {name!r} is not finite; train anew with `grasp fit`")
        return checkpoint

    def expect(self, shapes: dict[str, tuple[int, ...]]) -> None:
        """Raises `ModelFileError` unless the tensors are exactly these."""
        got = {name: value.shape for name, value in self.tensors.items()}
        if got != shapes:
            wrong = sorted(name for name in {*got, *shapes} if got.get(name) != shapes.get(name))
            raise ModelFileError(
                f"{self.kind} model: tensors {', '.join(wrong[:4])} do not fit its numbers {self.numbers}; copy both files "
                "again or train anew with `grasp fit`"
            )


def malformed(name: object, error: Exception) -> ModelFileError:
    """The error for a file that lacks what it should hold."""
    return ModelFileError(f"model {name}: incomplete or malformed ({error!r}); train anew with `grasp fit`")


def _stem(path: str | Path) -> Path:
    path = Path(path)
    return path.with_suffix("") if path.suffix in (".safetensors", ".json") else path


def _file(stem: Path, suffix: str) -> Path:
    return stem.with_name(stem.name + suffix)  # with_suffix would take "model.v2" for a suffix


def _read_meta(file: Path) -> dict[str, Any]:
    try:
        meta = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelFileError(
            f"model description {file}: {error.strerror}; a model is two files, .safetensors and .json"
        ) from None
    except (ValueError, RecursionError) as error:
        raise ModelFileError(f"model description {file} is not JSON ({error})") from None
    schema = meta.get("schema") if isinstance(meta, dict) else None
    if schema != SCHEMA:
        raise ModelFileError(
            f"model description {file} has schema {schema!r}, this version reads {SCHEMA!r}: train anew with `grasp fit`"
        )
    return meta


def _replace(file: Path, data: bytes) -> None:
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)
