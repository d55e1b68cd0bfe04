"""State of an interrupted training in one file."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from torch import nn

from grasp_env.errors import InvalidInputError, ModelFileError
from grasp_env.inputs.files import digest, file_fault, replacing
from training.evaluation.results import Run

SCHEMA = "grasp-force/training-state/1"
SPACE = 32_000_000
"""Free space needed before a training starts [bytes]: model and state, twice."""


@dataclass
class FitProgress:
    """Progress of a training.

    Attributes:
        step: optimisation steps taken.
        seconds: wall time of these steps.
        cpu_seconds: processor time of these steps, which other programs on the machine do not
            change.
        curve: rows of held-out scores.
    """

    step: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    curve: list[list[float]] = field(default_factory=list)


class StateFile:
    """File `<out>.state.safetensors`, replaced at every save, removed with the finished model.

    Args:
        out: stem of the model's files.
        settings: settings that decide the result; a state with other settings is refused.
    """

    def __init__(self, out: Path, settings: dict[str, Any]) -> None:
        self.path = out.with_name(f"{out.name}.state.safetensors")
        self._settings = json.loads(json.dumps(settings))  # as JSON, where tuples are lists

    @classmethod
    def begin(cls, out: Path | None, settings: dict[str, Any], resume: bool) -> StateFile | None:
        """Return the state file of a training, checked to be writable; None if `out` is None.

        Raises:
            InvalidInputError: the folder cannot be written, its disk is too full, or it holds an
                unfinished training.
            ModelFileError: nothing to resume, or a damaged or foreign file.
        """
        if out is None:
            return None
        state = cls(out, settings)
        Run.create(out.parent, "")
        free = shutil.disk_usage(out.parent).free
        if free < SPACE:
            raise InvalidInputError(
                f"{out.parent} has {free / 1e6:.0f} MB free, {SPACE / 1e6:.0f} MB are needed: make room or choose another --out"
            )
        if resume:
            state._read()
        elif state.path.exists():
            raise InvalidInputError(
                f"{state.path} is an unfinished training: add --resume, remove it, or choose another --out"
            )
        return state

    def save(
        self,
        module: nn.Module,
        optimiser: torch.optim.Optimizer,
        rng: np.random.Generator,
        now: FitProgress,
    ) -> None:
        """Write everything under a temporary name, then rename it."""
        weights = module.state_dict()
        values = {f"weight.{name}": value.detach() for name, value in weights.items()}
        for index, moments in optimiser.state_dict()["state"].items():
            values |= {f"moment.{index}.{name}": value for name, value in moments.items()}
        tensors = {name: np.ascontiguousarray(value.numpy()) for name, value in values.items()}
        meta = {
            "schema": SCHEMA,
            "settings": self._settings,
            **vars(now),
            "rng": rng.bit_generator.state,
            "sha256": _digest(tensors),
        }
        try:
            with replacing(self.path) as temporary:
                temporary.write_bytes(save(tensors, {"training": json.dumps(meta)}))
        except OSError as error:
            raise InvalidInputError(
                f"cannot write {self.path}, the last state is still whole: {file_fault(error, '--out')}"
            ) from None

    def restore(
        self, module: nn.Module, optimiser: torch.optim.Optimizer, rng: np.random.Generator
    ) -> FitProgress:
        """Restore the saved weights, moments and generator.

        Raises:
            ModelFileError: see `begin`.
        """
        tensors, meta = self._read()
        try:
            weights: dict[str, torch.Tensor] = {}
            moments: dict[int, dict[str, torch.Tensor]] = {}
            for key, value in tensors.items():
                kind, _, name = key.partition(".")
                if kind == "weight":
                    weights[name] = torch.from_numpy(value)
                elif kind == "moment":
                    index, name = name.split(".")
                    moments.setdefault(int(index), {})[name] = torch.from_numpy(value).clone()
            module.load_state_dict(weights)
            groups = optimiser.state_dict()["param_groups"]
            optimiser.load_state_dict({"state": moments, "param_groups": groups})
            rng.bit_generator.state = meta["rng"]
            curve = [[float(value) for value in row] for row in meta["curve"]]
            seconds = float(meta["seconds"])
            return FitProgress(int(meta["step"]), seconds, float(meta["cpu_seconds"]), curve)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise self._damaged(error) from None

    def remove(self) -> None:
        """Remove the file, once the model is saved."""
        self.path.unlink(missing_ok=True)

    def _read(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        if not self.path.is_file():
            raise ModelFileError(
                f"{self.path} does not exist, there is nothing to resume: leave --resume out"
            )
        try:
            with safe_open(self.path, framework="numpy") as file:
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  not a mapping
                meta = json.loads((file.metadata() or {})["training"])
            if meta["schema"] != SCHEMA:
                raise ModelFileError(
                    f"{self.path} has schema {meta['schema']!r}, this version reads {SCHEMA!r}"
                )
            if meta["sha256"] != _digest(tensors):
                raise ValueError("its sha256 does not fit")
            settings = dict(meta["settings"])
        except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
            if isinstance(error, ModelFileError):
                raise
            raise self._damaged(error) from None
        changes = "; ".join(
            f"{name} was {settings.get(name)!r}, is {self._settings.get(name)!r}"
            for name in sorted({*settings, *self._settings})
            if settings.get(name) != self._settings.get(name)
        )
        if changes:
            raise InvalidInputError(
                f"{self.path} was begun with other settings ({changes}): give the same settings with --resume"
            )
        return tensors, meta

    def _damaged(self, error: Exception) -> ModelFileError:
        return ModelFileError(
            f"{self.path} is truncated or was changed ({error}): remove it and train anew"
        )


def _digest(tensors: dict[str, np.ndarray]) -> str:
    return digest(*(name.encode() + tensors[name].tobytes() for name in sorted(tensors)))
