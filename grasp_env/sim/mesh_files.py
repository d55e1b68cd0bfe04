"""Mesh files of objects and of hands: the kinds that are read, and their reading by trimesh.

`read_files` runs in a process of its own, see `objects.reading`. Coordinates stay in the file's
units and axes. The <unit> and <up_axis> of a .dae are not applied, as a hand's scale factors
include the unit, see `unit_of` of `hand.files.meshes`.
"""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
from collections.abc import Iterable
from typing import Any, NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.inputs.files import MEGABYTE
from grasp_env.sim.xml_files import read_xml

MAX_FACES = 200_000
"""Largest number of triangles of a mesh."""
MAX_MEMORY = 2000 * MEGABYTE
"""Largest memory for reading [bytes]; files of `MAX_FACES` need a third of it."""
_MEGABYTES = {".obj": 40, ".stl": 80, ".ply": 40, ".off": 20, ".glb": 100, ".dae": 40}
KINDS = {kind: size * MEGABYTE for kind, size in _MEGABYTES.items()}
"""Largest size [bytes] of each kind of file: twice that of `MAX_FACES`, with pictures in a .glb."""
EXPORT = "export it again as .obj or .stl"
SIMPLIFY = (
    f"allowed are up to {MAX_FACES} faces; simplify it: pip install trimesh fast-simplification, then "
    f"trimesh.load(FILE, force='mesh').simplify_quadric_decimation(face_count={MAX_FACES // 2}).export('simple.obj')"
)

_NO_CORNERS = "it has faces with corners that do not exist"
TOO_MUCH_MEMORY = f"needs more than {MAX_MEMORY // MEGABYTE} MB to be read; {SIMPLIFY}"


def obj_text(parts: Iterable[tuple[Array, Any]]) -> str:
    """Return the .obj, with all digits, of parts with corners (V, 3) and faces (F, 3) each."""
    lines = list[str]()
    first = 1
    for number, (corners, faces) in enumerate(parts):
        lines.append(f"o part{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        lines += [f"f {i} {j} {k}" for i, j, k in (faces + first).tolist()]
        first += len(corners)
    return "\n".join([*lines, ""])


class _FileFault(Exception):
    """Why a file is not read, and the remedy."""


def read_files(kinds: Any, **files: Any) -> dict[str, Any]:
    """Read files "file0", "file1", ..., uint8, of `kinds` such as ".obj"; `apart` runs this.

    Returns the used "corners0", (V, 3) float64, in the file's units, and "faces0", (F, 3) int64;
    or "fault0", what is wrong with the file.
    """
    meshes = dict[str, Any]()
    for number, kind in enumerate(kinds.tolist()):
        try:
            corners, faces = _by_trimesh(files[f"file{number}"].tobytes(), kind)
            meshes |= {f"corners{number}": corners, f"faces{number}": faces}
            continue
        except _FileFault as error:
            fault = str(error)
        except MemoryError:
            if len(kinds) > 1:  # the other files may have taken the memory
                raise
            fault = TOO_MUCH_MEMORY
        except Exception as error:  # each format has its own
            fault = f"could not be read as {kind}: {_reason(error)}; {EXPORT}"
        meshes[f"fault{number}"] = np.array(fault)
    return meshes


def _reason(problem: Exception) -> str:
    if isinstance(problem, RecursionError):
        return "it is nested too deep"
    if isinstance(problem, IndexError) and "out of bounds" in str(problem):
        return _NO_CORNERS
    return str(problem).strip().partition("\n")[0][:300] or "its parts contradict each other"


class _NoOtherFiles:
    """A resolver that lets trimesh open no other file."""

    def get(self, name: str) -> NoReturn:
        raise _FileFault(
            f"refers to the file {name[:100]!r}, which is not read; export all of it as one file"
        )

    __getitem__ = get


def _by_trimesh(blob: bytes, kind: str) -> tuple[Array, Any]:
    """Return the used corners and the faces, in the file's order."""
    import trimesh  # slow to import

    blob = _PLAIN[kind](blob)
    options = {"fix_texture": False} if kind == ".ply" else {"ignore_broken": False}
    with np.errstate(all="ignore"), warnings.catch_warnings():
        # after which numpy would drop the rest
        warnings.filterwarnings("error", "string or file could not be read")
        mesh: Any = trimesh.load_mesh(
            io.BytesIO(blob),
            file_type=kind[1:],
            resolver=_NoOtherFiles(),
            process=False,
            skip_materials=True,
            **options,
        )
        faces = np.array(getattr(mesh, "faces", []), dtype=np.int64)
        if len(faces) == 0:
            raise _FileFault(f"holds no triangles; {EXPORT}")
        if len(faces) > MAX_FACES:
            raise _FileFault(f"has {len(faces)} faces, {SIMPLIFY}")
        if faces.min() < 0:
            raise ValueError(_NO_CORNERS)
        mesh.remove_unreferenced_vertices()
        corners = np.array(mesh.vertices, dtype=float)
        faces = np.array(mesh.faces, dtype=np.int64)
    if not np.isfinite(corners).all() or np.abs(corners).max() > 1e6:  # squares would lose digits
        raise _FileFault(f"has coordinates that are not finite or above 1e6; {EXPORT}")
    return corners, faces


def unix_lines(text: bytes) -> bytes:
    """Replace all line ends by Unix line ends."""
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


def _plain_obj(blob: bytes) -> bytes:
    """Keep only corners and faces: textures and materials would split corners and move faces."""
    text = b"\n" + unix_lines(blob).replace(b"\\\n", b" ")
    corners = re.findall(rb"\n[ \t]*v[ \t]+(\S+[ \t]+\S+[ \t]+\S+)", text)
    rows = re.findall(rb"\n[ \t]*f[ \t]+(\S+[ \t]+\S+[ \t]+[^\s#][^\n#]*)", text)
    # in 1/2/3 only the 1 is the index of a corner
    faces = re.sub(rb"/\S*", b"", b"\nf ".join(rows))
    if re.search(rb"(?<![0-9])0", faces):
        raise _FileFault(
            "has faces that count corners from 0; an .obj counts from 1, so add 1 to each"
        )
    if b"-" in faces and re.search(rb"\n[ \t]*f[ \t](?s:.*)\n[ \t]*v[ \t]", text):
        raise _FileFault(
            "has corners after faces with negative indices; export it with indices from 1"
        )
    return b"v " + b"\nv ".join(corners) + b"\nf " + faces + b"\n" if corners and rows else b""


def _plain_stl(blob: bytes) -> bytes:
    """Merge the solids of a text to one."""
    if len(blob) == 84 + 50 * int.from_bytes(blob[80:84], "little"):
        return blob
    text = unix_lines(blob).lower()
    if b"endsolid" not in text:
        raise ValueError("it is neither a whole binary file nor a text from `solid` to `endsolid`")
    corners = re.findall(rb"\n[ \t]*vertex[ \t]+(\S+[ \t]+\S+[ \t]+\S+)", text)
    return b"solid\nvertex " + b"\nvertex ".join(corners) + b"\nendsolid\n"


def _plain_ply(blob: bytes) -> bytes:
    """Hide the faces' textures, which trimesh may not read, and check a text's length."""
    head, end, body = blob.partition(b"end_header")
    if b"ascii" in head[:100]:
        count = sum(map(int, re.findall(rb"\nelement \S+ ([0-9]+)", head)))
        head = unix_lines(head)
        body = b"\n" + _whole(body, count)
    return head.replace(b"texcoord", b"unused") + end + body


def _plain_off(blob: bytes) -> bytes:
    """Drop comments and check the length, as trimesh ignores missing faces."""
    text = re.sub(rb"#.*", b"", unix_lines(blob))
    head = re.match(rb"\s*[A-Z]*OFF\s+([0-9]+)[ \t]+([0-9]+).*", text)
    if head is None:
        raise ValueError("it does not begin with OFF and the numbers of corners and faces")
    return head[0] + b"\n" + _whole(text[head.end() :], int(head[1]) + int(head[2]))


def _whole(text: bytes, claimed: int) -> bytes:
    """Drop empty lines, and raise an error if fewer are left than are claimed."""
    lines = [line for line in unix_lines(text).split(b"\n") if line.strip()]
    if len(lines) < claimed:
        raise ValueError(
            f"it is cut short: it claims {claimed} lines of numbers but has {len(lines)}"
        )
    return b"\n".join(lines)


_TRIANGLES, _STRIP = 4, 5
# extensions that do not change corners
_COSMETIC = ("KHR_materials", "KHR_texture", "EXT_texture", "KHR_lights")


def _plain_glb(blob: bytes) -> bytes:
    """Drop cameras, points and lines, as trimesh loses the pose of their nodes' children."""
    end = 20 + int.from_bytes(blob[12:16], "little")
    tree = json.loads(blob[20:end])
    for name in tree.get("extensionsRequired", []):
        if not name.startswith(_COSMETIC):
            raise _FileFault(
                f"needs the extension {name[:50]}, which is not supported; export it uncompressed"
            )
    for mesh in tree.get("meshes", []):
        mesh["primitives"] = [
            entry for entry in mesh["primitives"] if entry.get("mode", _TRIANGLES) >= _TRIANGLES
        ]
        for entry in mesh["primitives"]:
            positions = tree["accessors"][entry["attributes"]["POSITION"]]
            if entry.get("mode", _TRIANGLES) > _STRIP or "sparse" in positions:
                raise _FileFault(
                    "has triangle fans or sparse corners, which are not supported; export plain triangles"
                )
    for node in tree.get("nodes", []):
        node.pop("camera", None)
        if "mesh" in node and not tree["meshes"][node["mesh"]]["primitives"]:
            del node["mesh"]
    text = json.dumps(tree).encode()
    return blob[:12] + struct.pack("<I", len(text)) + blob[16:20] + text + blob[end:]


_COLLADA = "{http://www.collada.org/2005/11/COLLADASchema}"
_GROUPS = ("triangles", "polylist", "polygons", "tristrips", "trifans")
_ONLY = {
    "COLLADA": ("asset", "library_geometries", "library_nodes", "library_visual_scenes", "scene"),
    "mesh": ("source", "vertices", *_GROUPS),
}
"""Child elements that are kept of some elements of a .dae."""
_DECORATION = ("bind_material", "extra", "instance_camera", "instance_light")


def _plain_dae(blob: bytes) -> bytes:
    """Keep only corners and faces: normals and textures would split corners."""
    root = read_xml(blob)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    for element in root.iter():
        kept = _ONLY.get(element.tag)
        element[:] = [
            child
            for child in element
            if (child.tag in kept if kept else child.tag not in _DECORATION)
        ]
        if element.tag in _GROUPS:
            _drop_inputs(element)
        elif element.tag == "mesh":
            _drop_sources(element)
    for element in root.iter():
        element.tag = _COLLADA + element.tag
    return ElementTree.tostring(root)


def _drop_inputs(group: Element) -> None:
    """Keep only the corners' indices of a group of faces; check what pycollada would misread."""
    inputs = group.findall("input")
    vertex = next((entry for entry in inputs if entry.get("semantic") == "VERTEX"), None)
    if vertex is None or group.find("ph") is not None:
        raise _FileFault("has faces without an input VERTEX, or with holes; triangulate it")
    if any("-" in (indices.text or "") for indices in group.iter("p")):
        raise ValueError(_NO_CORNERS)
    # a copy of the vertex input keeps the largest offset: the number of indices per corner - 1
    last = max((entry.get("offset", "") for entry in inputs), key=int)
    group[:] = [
        vertex,
        Element("input", {**vertex.attrib, "offset": last}),
        *group.findall("vcount"),
        *group.findall("p"),
    ]


def _drop_sources(mesh: Element) -> None:
    """Keep only the corners' coordinates of a mesh; check what pycollada would misread."""
    names = set[str]()
    for vertices in mesh.findall("vertices"):
        vertices[:] = [entry for entry in vertices if entry.get("semantic") == "POSITION"]
        names |= {entry.get("source", "")[1:] for entry in vertices}
    mesh[:] = [child for child in mesh if child.tag != "source" or child.get("id") in names]
    for accessor in mesh.iter("accessor"):
        if int(accessor.get("stride", "1")) != len(accessor) or accessor.get("offset", "0") != "0":
            raise ValueError("its corners are strided in a list of numbers, which is not supported")
    if any("nan" in (numbers.text or "").lower() for numbers in mesh.iter("float_array")):
        raise ValueError("it has coordinates that are not numbers")


_PLAIN = {
    ".obj": _plain_obj,
    ".stl": _plain_stl,
    ".ply": _plain_ply,
    ".off": _plain_off,
    ".glb": _plain_glb,
    ".dae": _plain_dae,
}
"""For each kind of file, the function that reduces its bytes to what trimesh must read."""
