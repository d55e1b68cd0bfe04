"""Grasp files: JSON that people can write, with the same checks as `Grasp.from_contacts`.

A file needs three keys; the others have the defaults of `Grasp.from_contacts`:

    {"positions": [[0.04, 0, 0], [-0.02, 0.03, 0], [-0.02, -0.03, 0]],
     "normals": [[-1, 0, 0], [0.6, -0.8, 0], [0.6, 0.8, 0]],
     "friction": 0.5}
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env.errors import GraspError, GraspFileError, shown
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs.files import MEGABYTE, as_path, file_fault, read_json, replacing

SCHEMA = "grasp-force/grasp/1"
"""Name and version of the format."""
UNITS = {
    "positions": "m",
    "normals": "1",
    "friction": "1",
    "torsional_friction": "m",
    "tangents": "1",
}
"""Units of the keys; a file may state only these."""
_REQUIRED = ("positions", "normals", "friction")
_OPTIONAL = ("contact_model", "torsional_friction", "tangents")
_MAX_BYTES = 8 * MEGABYTE  # the largest grasp with all digits takes less than 1, a hand 2
_HEADER = ("schema", "units")
EXTENSIONS = ("hand",)
"""Keys of other parts of the project: `HandGrasp.save` writes the hand."""


def save_grasp(grasp: Grasp, path: str | Path) -> Path:
    """Write a grasp as JSON and return the path.

    Numbers are written with all digits. Tangents are omitted if they follow the rule of
    `contact_frames`. Missing folders are created; an existing file is replaced atomically.

    Raises:
        GraspFileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from grasp_env.grasp import presets
        >>> folder = tempfile.TemporaryDirectory()
        >>> load_grasp(save_grasp(presets.tripod(), f"{folder.name}/tripod.json")).friction
        array([0.5, 0.5, 0.5])
        >>> folder.cleanup()
    """
    return write_plain(to_plain(as_grasp(grasp)), path)


def write_plain(values: dict[str, Any], path: str | Path) -> Path:
    """Write what `to_plain` returns, or a dict with more keys from `EXTENSIONS`, as `save_grasp`."""
    file = as_path(path, GraspFileError, "a grasp's file")
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in values.items()]
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            temporary.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    except OSError as error:
        raise GraspFileError(f"cannot write grasp file {file}: {file_fault(error)}") from error
    return file


def load_grasp(path: str | Path) -> Grasp:
    """Read a grasp from the JSON file at `path`; the top of this module has an example.

    If `schema` and `units` are given, they must be those of this version.

    Raises:
        GraspFileError: the file is missing, is not JSON, has an unknown, repeated or missing key,
            other units, another schema, or values that are not a grasp. The message names the file
            and the field; `__cause__` is the error of `from_contacts`.
    """
    return of_plain(*read_plain(path))


def read_plain(path: str | Path) -> tuple[dict[str, Any], str]:
    """Return the object in a grasp's file, not checked, and the file's name in messages."""
    file = as_path(path, GraspFileError, "a grasp's file")
    values = read_json(
        file, GraspFileError, "grasp file", _MAX_BYTES, parse_int=float, object_pairs_hook=_unique
    )
    return values, f"grasp file {file}"


def of_plain(values: Any, name: str) -> Grasp:
    """Return the grasp in a dict of a grasp's file; `name` is that of the file, for messages."""
    _check_keys(values, name)
    for key in ("torsional_friction", "tangents"):
        if key in values and values[key] is None:
            raise GraspFileError(
                f"{name}: {key} must be numbers or lists of numbers, got None: leave the key out"
            )
    models = values.get("contact_model", "hard")
    if not isinstance(models, str | list):
        raise GraspFileError(
            f"{name}: contact_model must be a name or a list of N names, got {shown(models)}"
        )
    arguments = {key: values[key] for key in (*_REQUIRED, *_OPTIONAL) if key in values}
    try:
        return Grasp.from_contacts(**arguments)
    except GraspError as error:
        raise GraspFileError(f"{name}: {error}") from error


def to_plain(grasp: Grasp) -> dict[str, Any]:
    """Return the dict of a grasp's file."""
    models = grasp.models
    mu = models.friction
    arguments: dict[str, Any] = {
        "positions": grasp.positions.tolist(),
        "normals": grasp.normals.tolist(),
        "friction": (mu[:, 0] if (mu[:, 0] == mu[:, 1]).all() else mu).tolist(),
        "contact_model": list(models.names),
    }
    if "soft" in models.names:
        arguments["torsional_friction"] = models.torsional_friction.tolist()
    if not np.array_equal(Grasp.from_contacts(**arguments).frames, grasp.frames):
        arguments["tangents"] = grasp.frames[:, :, 1].tolist()
    return {
        "schema": SCHEMA,
        "units": {key: unit for key, unit in UNITS.items() if key in arguments},
        **arguments,
    }


def _check_keys(values: Any, name: str) -> None:
    """Check the keys and the header of a file; huge integers are inf."""
    if not isinstance(values, dict):
        raise GraspFileError(f"{name} must be one JSON object {{...}}, got {shown(values)}")
    if values.get("schema", SCHEMA) != SCHEMA:
        raise GraspFileError(
            f"{name} has schema {shown(values['schema'])}, this version reads {SCHEMA!r}: convert it, or leave the "
            "key out of a file written by hand"
        )
    allowed = (*_HEADER, *_REQUIRED, *_OPTIONAL, *EXTENSIONS)
    unknown = [key for key in values if key not in allowed]
    missing = [key for key in _REQUIRED if key not in values]
    if unknown or missing:
        raise GraspFileError(
            f"{name}: unknown keys {shown(unknown)}, missing keys {missing}; required are {list(_REQUIRED)}, "
            f"allowed besides {[*_OPTIONAL, *_HEADER]}"
        )
    units = values.get("units", {})
    if not isinstance(units, dict) or any(UNITS.get(key) != unit for key, unit in units.items()):
        raise GraspFileError(
            f"{name}: units must be {UNITS} or part of it, got {shown(units)}: convert the numbers"
        )


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict[str, Any]()
    for key, value in pairs:
        if key in values:
            raise ValueError(f"key {shown(key)} is given twice: keep one")
        values[key] = value
    return values
