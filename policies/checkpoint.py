"""Saved models: `<name>.safetensors` (weights) and `<name>.json` (description). Nothing is unpickled.

A file may come from an untrusted source: sizes and numbers are checked before anything is allocated.
"""

from __future__ import annotations

import json
import math
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from grasp_env._files import as_path, digest, replacing
from grasp_env.errors import ModelFileError, shown

SCHEMA = "grasp-force/initial-force/5"
MOST_TEXT, MOST_WEIGHTS = 1 << 20, 1 << 26
"""Largest sizes of the two files [bytes]; the shipped ones have 6,000 and 63,000."""
MOST_CONTACTS = 64
"""Largest number of contacts of a model."""
FAULTS = (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError)
"""Errors that an incomplete or malformed description causes."""
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
        body = {
            "schema": SCHEMA,
            "weights": digest(blob),
            "numbers": self.numbers,
            "ranges": {name: list(pair) for name, pair in self.ranges.items()},
            "card": self.card,
        }
        text = (json.dumps({**body, "sha256": signature(body)}, indent=2, allow_nan=False) + "\n").encode()
        replace(_file(stem, ".safetensors"), blob)
        replace(_file(stem, ".json"), text)
        return _file(stem, ".safetensors")

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Read and check a saved model.

        Args:
            path: either of the two files, or their common stem.

        Raises:
            ModelFileError: missing, no regular file, too large, not JSON, another schema, changed, numbers that are not finite
                in float32.
        """
        stem = _stem(path)
        meta = _read_meta(_file(stem, ".json"))
        file = _file(stem, ".safetensors")
        blob = _read(file, MOST_WEIGHTS)
        if digest(blob) != meta.get("weights"):
            raise ModelFileError(
                f"model weights {file} do not match the sha256 in their .json: the file is truncated or was changed; {_AGAIN}"
            )
        try:
            checkpoint = cls(
                tensors=load(blob),
                numbers=dict(meta["numbers"]),
                ranges={str(name): _pair(pair) for name, pair in meta["ranges"].items()},
                card=dict(meta["card"]),
            )
        except (SafetensorError, *FAULTS) as error:
            raise malformed(stem, error) from None
        for name, value in checkpoint.tensors.items():
            if value.dtype not in (np.float32, np.float64) or not (np.abs(value) <= np.finfo(np.float32).max).all():
                raise ModelFileError(
                    f"model {stem}: tensor {name[:40]!r} is not finite in float32; train anew with `grasp fit`"
                )
        return checkpoint

    def expect(self, shapes: dict[str, tuple[int, ...]]) -> None:
        """Raise `ModelFileError` unless the tensors have exactly these names and shapes."""
        got = {name: value.shape for name, value in self.tensors.items()}
        if got != shapes:
            wrong = sorted(name for name in {*got, *shapes} if got.get(name) != shapes.get(name))
            raise ModelFileError(
                f"model: tensors {', '.join(name[:40] for name in wrong[:4])} do not fit its numbers; {_AGAIN}"
            )


def malformed(name: object, error: Exception) -> ModelFileError:
    """Return the error for an incomplete file."""
    said = f"{type(error).__name__}: {error}"[:200]
    return ModelFileError(f"model {name}: incomplete or malformed ({said}); train anew with `grasp fit`")


def whole(value: Any, name: str, least: int, most: int) -> int:
    """Return an integer of a description within its bounds, or raise `ValueError`; 2.0 is not an integer."""
    if type(value) is not int or not least <= value <= most:
        raise ValueError(f"{name} must be an integer from {least} to {most}, got {shown(value)}")
    return value


def number(value: Any, name: str, least: float = -math.inf) -> float:
    """Return a finite number of a description above `least`, or raise `ValueError`."""
    # compared without conversion, because integers may exceed floats
    if type(value) not in (int, float) or not (-MOST_NUMBER <= value <= MOST_NUMBER and value > least):
        raise ValueError(
            f"{name} must be a finite number{f' > {least:g}' if least > -math.inf else ''}, got {shown(value)}"
        )
    return float(value)


MOST_NUMBER = 1e15
"""Largest magnitude of a number of a description."""


def _pair(value: Any) -> tuple[float, float]:
    low, high = (number(v, "a range's end") for v in value)
    if not low <= high:
        raise ValueError(f"a range from {low:g} to {high:g}")
    return low, high


def signature(body: dict[str, Any]) -> str:
    """Return the hash of a description."""
    return digest(json.dumps(body, sort_keys=True, allow_nan=False).encode())


def _stem(path: str | Path) -> Path:
    path = as_path(path, ModelFileError, "a model's file")
    return path.with_suffix("") if path.suffix in (".safetensors", ".json") else path


def _file(stem: Path, suffix: str) -> Path:
    if not stem.name:
        raise ModelFileError(f"a model's path is needed, got {str(stem)!r}, a folder")
    return stem.with_name(stem.name + suffix)  # with_suffix would take "model.v2" for a suffix


def _read(file: Path, most: int) -> bytes:
    """Read a regular file of at most `most` bytes."""
    try:
        about = file.stat()
        if not stat.S_ISREG(about.st_mode):
            raise OSError(0, "it is a folder, a pipe or a device")
        if about.st_size > most:
            raise OSError(0, f"it is larger than {most >> 20} MiB")
        with file.open("rb") as opened:
            blob = opened.read(about.st_size)
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        said = getattr(error, "strerror", None) or error
        raise ModelFileError(f"model file {file}: {said}; a model is two files, .safetensors and .json") from None
    return blob


def _read_meta(file: Path) -> dict[str, Any]:
    """Read a description, and check its schema and its hash."""
    blob = _read(file, MOST_TEXT)
    try:
        meta = json.loads(blob.decode(), parse_constant=_refuse)
        schema = meta.get("schema") if isinstance(meta, dict) else None
        if schema != SCHEMA:
            raise ModelFileError(
                f"model description {file} has schema {shown(schema)}, this version reads {SCHEMA!r}: train anew with `grasp fit`"
            )
        right = meta.pop("sha256", None) == signature(meta)
    except ModelFileError:
        raise
    except FAULTS as error:
        said = "nested too deep" if isinstance(error, RecursionError) else str(error)[:200]
        raise ModelFileError(f"model description {file} is not JSON ({said})") from None
    if not right:
        raise ModelFileError(f"model description {file} does not match its own sha256: it was changed; {_AGAIN}")
    return meta


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not a number")


def replace(file: Path, data: bytes) -> None:
    """Write a file atomically."""
    with replacing(file) as temporary:
        temporary.write_bytes(data)
