"""Saved models: `<name>.safetensors` (weights) beside `<name>.json` (what they mean). Nothing is unpickled."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from grasp_env.errors import ModelFileError
from policies.features import N_FEATURES, Features

SCHEMA = "grasp-force/initial-force/1"


@dataclass(frozen=True)
class Checkpoint:
    """A trained initial force.

    Attributes:
        weights: "layers.<i>.weight" (out, in) and "layers.<i>.bias" (out,), float32.
        reference: (3N, 3N - 6) object-frame null-space directions that the outputs belong to.
        sizes: layer widths, inputs first.
        features: normalisation of the inputs.
        n_contacts: N.
        force_weight, barrier_weight: the Phi whose optima were learned.
        magnitude_range: [N] of |(force, moment / length)| seen in training.
        friction_range: of the friction coefficient seen in training.
        card: data, seed, command, time, scores, versions: for people.
    """

    weights: dict[str, np.ndarray]
    reference: np.ndarray
    sizes: tuple[int, ...]
    features: Features
    n_contacts: int
    force_weight: float
    barrier_weight: float
    magnitude_range: tuple[float, float]
    friction_range: tuple[float, float]
    card: dict[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path) -> Path:
        """Writes `<path>.safetensors` and `<path>.json`, each under a temporary name first."""
        stem = _stem(path)
        stem.parent.mkdir(parents=True, exist_ok=True)
        tensors: dict[str, np.ndarray] = {
            name: np.ascontiguousarray(value, dtype=np.float32) for name, value in self.weights.items()
        }
        tensors["reference"] = np.ascontiguousarray(self.reference, dtype=np.float64)
        blob = save(tensors)
        meta = {
            "schema": SCHEMA,
            "sha256": hashlib.sha256(blob).hexdigest(),
            "sizes": list(self.sizes),
            "features": asdict(self.features),
            "n_contacts": self.n_contacts,
            "force_weight": self.force_weight,
            "barrier_weight": self.barrier_weight,
            "magnitude_range": list(self.magnitude_range),
            "friction_range": list(self.friction_range),
            "card": self.card,
        }
        _replace(_file(stem, ".safetensors"), blob)
        _replace(_file(stem, ".json"), (json.dumps(meta, indent=2) + "\n").encode())
        return _file(stem, ".safetensors")

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Reads and checks a saved model.

        Args:
            path: either of the two files, or their common stem.

        Raises:
            ModelFileError: missing, not JSON, another schema, changed weights, or shapes that do not fit.
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
            tensors = load(blob)
            reference = tensors.pop("reference")
            features = Features(**{name: float(value) for name, value in meta["features"].items()})
            checkpoint = cls(
                weights=tensors,
                reference=reference,
                sizes=tuple(int(size) for size in meta["sizes"]),
                features=features,
                n_contacts=int(meta["n_contacts"]),
                force_weight=float(meta["force_weight"]),
                barrier_weight=float(meta["barrier_weight"]),
                magnitude_range=(float(meta["magnitude_range"][0]), float(meta["magnitude_range"][1])),
                friction_range=(float(meta["friction_range"][0]), float(meta["friction_range"][1])),
                card=dict(meta["card"]),
            )
        except (SafetensorError, KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise ModelFileError(
                f"model {stem}: incomplete or malformed ({error!r}); train anew with `grasp fit`"
            ) from None
        checkpoint._check_shapes(stem)
        return checkpoint

    def flat_weights(self) -> np.ndarray:
        """All layers as one float32 vector, each (inputs x outputs) then bias: for the compiled inference."""
        parts = []
        for layer in range(len(self.sizes) - 1):
            parts += [self.weights[f"layers.{layer}.weight"].T.ravel(), self.weights[f"layers.{layer}.bias"]]
        return np.concatenate(parts).astype(np.float32)

    def _check_shapes(self, stem: Path) -> None:
        want: dict[str, tuple[int, ...]] = {}
        for layer, (inputs, outputs) in enumerate(zip(self.sizes[:-1], self.sizes[1:], strict=True)):
            want[f"layers.{layer}.weight"] = (outputs, inputs)
            want[f"layers.{layer}.bias"] = (outputs,)
        got = {name: value.shape for name, value in self.weights.items()}
        ends = (N_FEATURES, 3 * self.n_contacts - 6)
        if (
            got != want
            or (self.sizes[0], self.sizes[-1]) != ends
            or self.reference.shape != (3 * self.n_contacts, ends[1])
        ):
            raise ModelFileError(
                f"model {stem}: weights of shapes {got} do not fit sizes {self.sizes} for {self.n_contacts} contacts"
            )
        if not all(np.isfinite(value).all() for value in (*self.weights.values(), self.reference)):
            raise ModelFileError(f"model {stem}: weights are not finite; train anew with `grasp fit`")


def _stem(path: str | Path) -> Path:
    path = Path(path)
    return path.with_suffix("") if path.suffix in (".safetensors", ".json") else path


def _file(stem: Path, suffix: str) -> Path:
    return stem.with_name(stem.name + suffix)  # with_suffix would take "model.v2" for a suffix


def _read_meta(file: Path) -> dict[str, Any]:
    try:
        meta = json.loads(file.read_text())
    except OSError as error:
        raise ModelFileError(
            f"model description {file}: {error.strerror}; a model is two files, .safetensors and .json"
        ) from None
    except ValueError as error:
        raise ModelFileError(f"model description {file} is not JSON ({error})") from None
    schema = meta.get("schema") if isinstance(meta, dict) else None
    if schema != SCHEMA:
        raise ModelFileError(
            f"model description {file} has schema {schema!r}, this version reads {SCHEMA!r}: train anew with `grasp fit`"
        )
    return meta


def _replace(file: Path, data: bytes) -> None:
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    temporary.write_bytes(data)
    os.replace(temporary, file)
