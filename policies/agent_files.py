"""Files of a reinforcement-learning agent: safetensors, npz and JSON, hashed and never pickled."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from grasp_env.env.actions import MODES
from grasp_env.env.observation import bounds
from grasp_env.errors import ModelFileError
from grasp_env.inputs.files import WEIGHTS, as_path, digest, file_fault, parsed, replacing, unpacked
from policies.checkpoint import described, signed

SCHEMA = "grasp-force/rl-agent/3"
ENV_ID = "FourFingerGrasp-v0"
META = "agent.json"
STEM = "step-"
ACTIONS = tuple(mode for mode in MODES if mode != "none")
"""Action modes of agents."""
Parts = dict[str, dict[str, np.ndarray]]
"""Arrays by name, by the stem of their file."""
LARGEST_HAND = 1000
"""The numbers of fingers and of joints must be below this."""
_AGAIN = "copy the whole folder again, or train anew with `grasp rl`"


def write_checkpoint(
    parent: Path, steps: int, meta: dict[str, Any], tensors: Parts, arrays: Parts
) -> Path:
    """Write `<parent>/step-<steps>` whole or not at all; then remove the older checkpoints.

    Args:
        parent: folder of the checkpoints.
        steps: environment steps so far.
        meta: description of the agent, JSON-serialisable.
        tensors, arrays: by file stem, written as `<stem>.safetensors` and `<stem>.npz`.

    Raises:
        ModelFileError: the folder cannot be written; the older checkpoints are kept.
    """
    folder = parent / f"{STEM}{steps:09d}"
    blobs = {
        f"{stem}.safetensors": lambda values=values: save(values)
        for stem, values in tensors.items()
    }
    blobs |= {f"{stem}.npz": lambda values=values: _npz(values) for stem, values in arrays.items()}
    hashes = {}
    try:
        parent.mkdir(parents=True, exist_ok=True)
        with replacing(folder) as hidden:  # the same steps again: the newer files are kept
            hidden.mkdir()
            for name, make in blobs.items():
                blob = make()
                hashes[name] = digest(blob)
                (hidden / name).write_bytes(blob)
            body = {"schema": SCHEMA, "env_id": ENV_ID, **meta, "steps": steps, "files": hashes}
            (hidden / META).write_text(signed(body), encoding="utf-8")
    except OSError as error:
        raise ModelFileError(f"cannot write {folder}: {file_fault(error, '--out')}") from None
    for older in checkpoints(parent)[:-1]:
        shutil.rmtree(older, ignore_errors=True)
    return folder


def checkpoints(parent: Path) -> list[Path]:
    """Return the complete checkpoints of a folder, oldest first."""
    try:
        return sorted(path for path in parent.glob(f"{STEM}*") if os.path.isfile(path / META))
    except OSError:  # the name is too long, or the folder is not readable
        return []


def find_checkpoint(folder: str | Path) -> Path:
    """Return the newest checkpoint of a seed's folder, or the folder itself if it is a checkpoint.

    Raises:
        ModelFileError: the folder holds no checkpoint.
    """
    folder = as_path(folder, ModelFileError, "an agent's folder")
    # unlike Path.is_file it never raises for long names or unreadable folders
    if os.path.isfile(folder / META):
        return folder
    for parent in (folder / "checkpoints", folder):
        if found := checkpoints(parent):
            return found[-1]
    raise ModelFileError(
        f"{folder} holds no agent ({META} is missing): name a seed's folder of `grasp rl`, runs/rl/NAME/seed-0"
    )


def read_meta(folder: Path) -> dict[str, Any]:
    """Read and check the description of a checkpoint.

    Raises:
        ModelFileError: missing, not JSON, changed, or for another schema or environment.
    """
    file = folder / META
    meta = described(file, SCHEMA, "agent", "grasp rl")
    if meta.get("env_id") != ENV_ID:
        raise ModelFileError(
            f"agent {file} was trained on {meta.get('env_id')!r}, this version has {ENV_ID!r}: train anew"
        )
    if meta.get("action") not in ACTIONS:
        raise ModelFileError(
            f"agent {file} acts as {meta.get('action')!r}; known: {', '.join(ACTIONS)}"
        )
    fingers = meta.get("fingers")
    joints = meta.get("joints")
    if not (
        isinstance(fingers, int)
        and isinstance(joints, int)
        and 0 < fingers < LARGEST_HAND
        and 0 < joints < LARGEST_HAND
    ):
        raise ModelFileError(
            f"agent {file} is for a hand of {fingers!r} fingers and {joints!r} joints: {_AGAIN}"
        )
    observed = len(bounds(fingers, joints, meta["action"]))
    acted = MODES[meta["action"]].size(fingers)
    if (meta.get("observation_size"), meta.get("action_size")) != (observed, acted):
        raise ModelFileError(
            f"agent {file} goes from {meta.get('observation_size')!r} numbers to {meta.get('action_size')!r}; {ENV_ID} shows {observed} "
            f"of such a hand and takes {acted}: train anew"
        )
    return meta


def read_tensors(folder: Path, meta: dict[str, Any], stem: str) -> dict[str, np.ndarray]:
    """Read `<stem>.safetensors`, checked by its hash."""
    return _read(folder / f"{stem}.safetensors", meta, load)


def read_arrays(folder: Path, meta: dict[str, Any], stem: str) -> dict[str, np.ndarray]:
    """Read `<stem>.npz` without objects, checked by its hash."""
    return _read(folder / f"{stem}.npz", meta, unpacked)


def _read(
    file: Path, meta: dict[str, Any], read: Callable[[bytes], dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    def checked(blob: bytes) -> dict[str, np.ndarray]:
        if digest(blob) != meta["files"].get(file.name):
            raise ModelFileError(
                f"agent file {file} does not match its sha256: truncated or changed; {_AGAIN}"
            )
        return read(blob)

    what = f"agent file {file}"
    hint = f": {_AGAIN}"
    return parsed(file, checked, ModelFileError, what, "a file of arrays", hint, WEIGHTS)


def _npz(values: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **values)  # type: ignore[arg-type]
    return buffer.getvalue()
