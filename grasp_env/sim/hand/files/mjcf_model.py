"""Compile MuJoCo model files (MJCF) in a separate process, and read the compiled model."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.inputs.files import HEAD, stand_in
from grasp_env.sim.hand.files.meshes import PARENTS
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.mujoco_api import mujoco
from grasp_env.sim.objects.apart import apart

_SECONDS = 30.0
_MAX_MEMORY = 8 << 30  # longest time [s] and largest memory [bytes] to compile a file
_UNNAMED = "MuJoCo Model"  # name that MuJoCo gives to a model without one
_UNKNOWN = re.compile(r"unrecognized attribute: '(?P<name>\w+)'\s+Element '(?P<element>\w+)'")
_WITHOUT_BODIES = ("option", "flag", "size", "statistic", "global", "quality", "map", "headlight")
# fields with the number of elements of each kind
_COUNTS = {"body": "nbody", "joint": "njnt", "actuator": "nu"}


def load_model(path: Path) -> tuple[Any, bool, list[str]]:
    """Return the compiled model of a file, True if its angles are degrees, and what was left out."""
    where = f"cannot read the MuJoCo model {path}"
    task = f"{__name__}:compile_mjcf"
    text = f"compiling {path.name}"
    try:
        compiled = apart(
            task, text, _SECONDS, memory=_MAX_MEMORY, path=np.array(str(path.absolute()))
        )
    except (TimeoutError, ChildProcessError) as error:
        raise InvalidInputError(
            f"{where}: MuJoCo's compiler failed: {str(error).splitlines()[-1]}"
        ) from None
    if "error" in compiled:
        raise InvalidInputError(f"{where}: {' '.join(str(compiled['error']).split())}")
    name = "model.mjb"
    model = mujoco.MjModel.from_binary_path(name, {name: compiled["model"].tobytes()})
    return model, bool(compiled["degrees"]), compiled["left_out"].tolist()


def compile_mjcf(path: Any) -> dict[str, Any]:
    """Return the binary "model", uint8; "degrees", True if its angles are; and the attributes that
    were "left_out"; or the "error".

    `apart` runs this function.
    """
    file = Path(str(path))
    first, spec = "", None
    for folder in list(file.parents)[: PARENTS + 1]:
        try:
            spec, left_out = _spec(file, folder)
            model = spec.compile()
        except (ValueError, RuntimeError, MemoryError, ParseError, OSError) as error:
            first = _stand_ins(spec, folder) or first or str(error) or type(error).__name__
            continue
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        degrees = np.array(bool(spec.compiler.degree))
        return {"model": buffer, "degrees": degrees, "left_out": np.array(left_out, dtype=np.str_)}
    return {"error": np.array(first)}


def _stand_ins(spec: Any, folder: Path) -> str:
    """Return a sentence about a mesh or texture that is something else, see `stand_in`, or ""."""
    if spec is None:
        return ""
    for within, elements in ((spec.meshdir, spec.meshes), (spec.texturedir, spec.textures)):
        for element in elements:
            file = folder / within / element.file
            if not file.is_file():
                continue
            with suppress(OSError), file.open("rb") as opened:
                other, remedy = stand_in(opened.read(HEAD))
                if other:
                    return f"{file} is a {other}: {remedy}"
    return ""


def _spec(file: Path, folder: Path) -> tuple[Any, list[str]]:
    """Return the specification in a file, with mesh names relative to a folder.

    Also return the attributes that this MuJoCo does not know and that were left out, in words:
    those of `_WITHOUT_BODIES`, which change neither bodies nor joints.
    """
    os.chdir(folder)
    tree: Element | None = None
    left_out = list[str]()
    while True:
        try:
            if tree is None and folder == file.parent and file.suffix == ".xml":
                return mujoco.MjSpec.from_file(str(file)), left_out
            text = file.read_text() if tree is None else tostring(tree, "unicode")
            spec = mujoco.MjSpec.from_string(text)
            spec.modelfiledir = str(folder)
            return spec, left_out
        except ValueError as error:
            unknown = _UNKNOWN.search(str(error))
            if not unknown or unknown["element"] not in _WITHOUT_BODIES:
                raise
            tree = _with_includes(file, file.parent) if tree is None else tree
            found = [
                each
                for each in tree.iter(unknown["element"])
                if each.get(unknown["name"]) is not None
            ]
            if not found:
                raise
            for element in found:
                del element.attrib[unknown["name"]]
            left_out.append(f"{unknown['name']!r} of <{unknown['element']}>")


def _with_includes(file: Path, folder: Path) -> Element:
    """Return the XML of a file, with the children of included files in place of `include`."""
    root = fromstring(file.read_text())
    for parent in list(root.iter()):
        for position, child in reversed(list(enumerate(parent))):
            if child.tag == "include":
                parent[position : position + 1] = _with_includes(
                    folder / child.get("file", ""), folder
                )
    return root


def model_name(model: Any, path: Path) -> str:
    """Return the name of a model, or the name of its file if it has none."""
    name = _text(model.names, 0)
    return path.stem if name in ("", _UNNAMED) else name


def name_of(model: Any, kind: str, number: int) -> str:
    """Return the name of a "body", "joint" or "actuator", or its kind and number if it has none."""
    element = getattr(model, kind)
    if name := element(number).name:
        return name
    name = f"{kind}{number}"
    taken = {element(other).name for other in range(getattr(model, _COUNTS[kind]))}
    while name in taken:
        name += "_"
    return name


def mesh_file(model: Any, mesh: int, path: Path) -> Path | None:
    """Return the file of a mesh in the model of the file `path`; None if there is none."""
    address = int(model.mesh_pathadr[mesh])
    file = path.absolute().parent / _text(model.paths, address)  # an absolute name stays
    return file if address >= 0 and file.is_file() else None


def frame_of(position: Array, quaternion: Array) -> Frame:
    """Make a frame from a position [m], (3,), and a quaternion w, x, y, z."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=float))
    return Frame(matrix.reshape(3, 3), np.array(position, dtype=float))


def _text(blob: Any, address: int) -> str:
    return bytes(blob[address:]).split(b"\0", 1)[0].decode(errors="replace")
