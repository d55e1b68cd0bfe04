"""Reader of all mesh files, of objects and of hands: trimesh, with a guard in front of it for each kind of file.

A guard compares the size that a file claims with its bytes, counts its triangles, and rewrites the file with its corners and triangles
only: trimesh sees no materials, pictures, scripts or names of other files. Files that are too large or use unsupported features are
refused first. No file takes more than 2 s or 1 GiB. Coordinates stay in the file's units and axes. This holds for a .dae, too: its <unit>
and <up_axis> are not applied, as a hand's scale factors include the unit, see `unit_of` of `hand.files.meshes`.
"""

from __future__ import annotations

import io
import json
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from grasp_env._check import Array
from grasp_env._extras import need
from grasp_env._files import MEGABYTE, parsed, read_xml, understood
from grasp_env.errors import InvalidInputError

__all__ = [
    "KINDS",
    "MAX_FACES",
    "key_lines",
    "key_places",
    "mesh_bytes",
    "obj_text",
    "one_newline",
    "read_mesh",
    "read_mesh_bytes",
]

MAX_FACES = 200_000
"""Largest number of triangles of a mesh."""
_MAX_CORNERS = 3 * MAX_FACES  # including those of no face
_MAX_TEXT_CORNERS = 2 * MAX_FACES  # corners of an .off or a .ply in text, which trimesh reads in 3 us each
_MAX_TEXT_BYTES = 20 * MEGABYTE  # bytes of these two: 1.5 s
_MAX_PARTS = 4000  # mesh parts in a scene: 0.3 ms each
_MAX_NODES = 10_000
_MAX_LINES = 3_000_000
_MAX_FACE_WORDS = 20 * MAX_FACES  # words in the faces of a text file, including indices of normals and textures
_MAX_HEADER_BYTES = 100_000  # bytes of the header of a .ply
_MAX_JSON_BYTES = 4 * MEGABYTE
_HINT = "; export it again as .obj or .stl"
_SIMPLER = (
    f"allowed are up to {MAX_FACES}; simplify it: pip install trimesh fast-simplification, then "
    f"trimesh.load(FILE, force='mesh').simplify_quadric_decimation(face_count={MAX_FACES // 2}).export('simple.obj')"
)
_POINT = rb"(?:([-+.\w]{1,50}[ \t]+[-+.\w]{1,50}[ \t]+[-+.\w]{1,50})(?!\S))?"  # "" if there are none


class _TooManyFacesError(Exception):
    """Error for a mesh of more than `MAX_FACES` triangles, with their number as its argument."""


def read_mesh(path: str | Path, name: str, hint: str = _HINT) -> tuple[Array, Any]:
    """Read a mesh file, regular or a pipe: corners (V, 3) float64 of its faces, in the file's units, and faces (F, 3) int64.

    Args:
        path: Path of an .obj, .stl, .ply, .off, .glb or .dae.
        name: Name of the mesh, for messages.
        hint: Advice if it is not a mesh, for messages.

    Raises:
        InvalidInputError: It is not a mesh, or too large.
        MissingExtraError: The extra `sim` is not installed.
    """
    return read_mesh_bytes(mesh_bytes(path, name, hint), Path(path).suffix.lower(), name, hint)


def mesh_bytes(path: str | Path, name: str, hint: str = _HINT) -> bytes:
    """Read the bytes of a mesh file of a supported kind, up to the largest size of that kind."""
    kind = Path(path).suffix.lower()
    if kind not in KINDS:
        raise InvalidInputError(f"{name} is of no kind that is read: {', '.join(KINDS)}; export it as one of them")
    return parsed(path, lambda blob: blob, InvalidInputError, name, f"a mesh of kind {kind}", hint, KINDS[kind][1])


def read_mesh_bytes(blob: bytes, kind: str, name: str, hint: str = _HINT) -> tuple[Array, Any]:
    """Read a mesh as `read_mesh` does, from the bytes of a file of a kind such as ".obj"."""
    need("sim")

    def read(blob: bytes) -> tuple[Array, Any]:
        try:
            guarded, count = KINDS[kind][0](blob)
        except KeyError as missing:
            raise ValueError(f"it has no {missing}") from None
        return _by_trimesh(guarded, kind, _check_face_count(count))

    try:
        corners, faces = understood(blob, read, InvalidInputError, name, f"a mesh of kind {kind}", hint)
    except InvalidInputError as error:
        if isinstance(error.__cause__, _TooManyFacesError):
            raise InvalidInputError(f"{name} has {error.__cause__} faces, {_SIMPLER}") from None
        raise
    if len(faces) == 0:
        raise InvalidInputError(f"{name} holds no triangles{hint}")
    if not np.isfinite(corners).all() or np.abs(corners).max() > 1e6:  # squares would lose digits
        raise InvalidInputError(f"{name} has coordinates that are not finite or above 1e6{hint}")
    return corners, faces


def obj_text(parts: Iterable[tuple[Array, Any]]) -> str:
    """Return an .obj, with all digits, of parts that each have corners (V, 3) and faces (F, 3).

    Example:
        >>> print(obj_text([(np.eye(3), np.array([[0, 1, 2]]))]))
        o part0
        v 1.0 0.0 0.0
        v 0.0 1.0 0.0
        v 0.0 0.0 1.0
        f 1 2 3
        <BLANKLINE>
    """
    lines, before = list[str](), 1
    for number, (corners, faces) in enumerate(parts):
        lines.append(f"o part{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        lines += [f"f {i} {j} {k}" for i, j, k in (faces + before).tolist()]
        before += len(corners)
    return "\n".join([*lines, ""])


def _by_trimesh(blob: bytes, kind: str, count: int) -> tuple[Array, Any]:
    """Read corners and faces from a file that a guard has written and in which it has counted triangles."""
    import trimesh  # slow to import, and only meshes need it

    if count == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    with np.errstate(all="ignore"):  # numbers that are not finite are refused later
        mesh: Any = trimesh.load_mesh(io.BytesIO(blob), file_type=kind[1:], process=False, skip_materials=True, ignore_broken=False)  # fmt: skip
        faces = np.array(mesh.faces, dtype=np.int64)
        if faces.shape != (count, 3):
            raise ValueError(f"it has {count} triangles, of which {len(faces)} can be read")
        if faces.min() < 0 or faces.max() >= len(mesh.vertices):
            raise ValueError("it holds faces whose corners do not exist")
        mesh.remove_unreferenced_vertices()
        return np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)


def _check_face_count(faces: int) -> int:
    if faces > MAX_FACES:
        raise _TooManyFacesError(faces)
    return faces


def _check_count(found: int, most: int, what: str) -> int:
    if found > most:
        raise ValueError(f"it has {found} {what}, allowed are up to {most}")
    return found


def one_newline(text: bytes) -> bytes:
    """Return a text with Unix line ends and a newline in front, for which `key_lines` searches: several times as fast as `^`."""
    text = b"\n" + (text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text)
    _check_count(text.count(b"\n") - 1, _MAX_LINES, "lines")
    return text


def key_places(text: bytes, key: bytes) -> Iterator[int]:
    """Yield the offsets of the lines that begin with a word."""
    return (found.start() for found in re.finditer(rb"\n[ \t]*%s[ \t]" % key, text))


def key_lines(text: bytes, key: bytes, rest: bytes = b"(.*)") -> list[bytes]:
    """Return what follows a word in the lines that begin with it."""
    return re.findall(rb"\n[ \t]*%s[ \t]+%s" % (key, rest), text)


def _points(text: bytes, key: bytes) -> list[bytes]:
    """Return the three numbers that follow a word, for each line that begins with it."""
    found = key_lines(text, key, _POINT)
    if b"" in found:
        raise ValueError(
            f"it has a {key.decode()} with fewer than three coordinates, or with more than 50 characters in one"
        )
    _check_count(len(found), _MAX_CORNERS, "corners")
    return found


def _count_words(text: bytes) -> int:
    """Count the words of a text without splitting it."""
    letters = np.frombuffer(b" " + text, np.uint8)
    inside = (letters != 32) & (letters - np.uint8(9) > 4)  # white space is 32 and 9 to 13
    return int(np.count_nonzero(inside[1:] & ~inside[:-1]))


def _guard_obj(blob: bytes) -> tuple[bytes, int]:
    text = one_newline(blob).replace(b"\\\n", b" ")
    corners = _points(text, b"v")
    rows = key_lines(text, b"f", rb"(\S+[ \t]+\S+[ \t]+[^\s#][^\n#]*)")
    faces = b"\n".join(rows)
    count = _check_face_count(_count_words(faces) - 2 * len(rows))
    faces = re.sub(rb"/\S*", b"", faces)  # in 1/2/3 only the 1 is the index of a corner
    if (wrong := re.search(rb"[^-0-9\s]|[0-9]{9}|(?<![0-9])0", faces)) is not None:
        raise ValueError(f"it has faces whose corners do not exist: {faces[wrong.start() :][:9].decode('latin1')!r}")
    if b"-" in faces and re.compile(rb"\n[ \t]*v[ \t]").search(text, next(key_places(text, b"f"))):
        raise ValueError("it has corners after faces with negative indices; export it with indices from 1")
    return b"v " + b"\nv ".join(corners) + b"\nf " + faces.replace(b"\n", b"\nf ") + b"\n", count


def _guard_stl(blob: bytes) -> tuple[bytes, int]:
    count = int.from_bytes(blob[80:84], "little")
    if len(blob) == 84 + 50 * count:
        return blob, count
    corners = _points(one_newline(blob).lower(), b"vertex")
    if len(corners) % 3:
        raise ValueError(f"it has {len(corners)} vertex lines, not a multiple of three")
    if not corners and len(blob) > 84:
        raise ValueError(f"it has {len(blob)} bytes, but claims {count} triangles of 50 bytes after the first 84")
    return b"solid\nvertex " + b"\nvertex ".join(corners) + b"\nendsolid\n", len(corners) // 3


def _polygons(rows: Sequence[bytes], at: int = 0) -> tuple[bytes, int]:
    """Return the polygons of lines whose word `at` is the number of corners that follow, and their number of triangles; drop other words."""
    _check_count(_count_words(b"\n".join(rows)), _MAX_FACE_WORDS, "words of faces")
    cut = [words[at : at + 1 + int(words[at])] for words in map(bytes.split, rows)]
    if any(not 4 <= len(words) == 1 + int(words[0]) for words in cut):
        raise ValueError("it has a face with fewer numbers than it claims, or fewer than three")
    return b"\n".join(map(b" ".join, cut)), sum(map(len, cut)) - 3 * len(cut)


def _lines(text: bytes, claimed: int) -> list[bytes]:
    """Return the first `claimed` lines of a text that are not empty, and check that they are numbers of ordinary length."""
    rows = [row for row in one_newline(text).split(b"\n") if row.strip()][:claimed]
    if len(rows) < claimed:
        raise ValueError(f"it claims {claimed} lines of numbers where it has {len(rows)}")
    if (wrong := re.search(rb"[^-+.\w\s]|\w{51}", b"\n".join(rows))) is not None:
        raise ValueError(f"it has {wrong[0][:20].decode('latin1')!r} where it claims numbers")
    return rows


def _guard_off(blob: bytes) -> tuple[bytes, int]:
    text = re.sub(rb"#.*", b"", one_newline(blob))
    head = re.match(rb"\s*(?:ST)?C?N?OFF\s+([0-9]{1,12})[ \t]+([0-9]{1,12})(?:[ \t]+[0-9]{1,12})?[ \t]*(?:\n|\Z)", text)
    if head is None:
        raise ValueError("it does not begin with OFF and the numbers of corners and faces")
    corners, faces = _check_count(int(head[1]), _MAX_TEXT_CORNERS, "corners"), _check_face_count(int(head[2]))
    rows = _lines(text[head.end() :], corners + faces)
    polygons, count = _polygons(rows[corners:])
    return b"OFF\n%d %d 0\n" % (corners, faces) + b"\n".join([*rows[:corners], polygons]), count


_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")


def _guard_ply(blob: bytes) -> tuple[bytes, int]:
    # "\r" alone may end a line of the header; in the binary data it is a number
    end = re.compile(rb"end_header[ \t]*(?:\r\n|\n|\r)").search(blob, 0, _MAX_HEADER_BYTES)
    head = "" if end is None else one_newline(blob[: end.end()]).decode("latin1")
    form = re.search(r"\nformat\s+(ascii|binary_little_endian|binary_big_endian)\s", head)
    parts = re.split(r"\nelement\s+(\S+)\s+([0-9]{1,12})\s*?(?=\n)", head)
    if end is None or form is None or parts[1::3][:2] != ["vertex", "face"]:
        raise ValueError(
            f"it has no header within {_MAX_HEADER_BYTES} bytes with a format, element vertex and element face"
        )
    if form[1] == "ascii" and len(blob) > _MAX_TEXT_BYTES:
        raise ValueError(f"it is larger than {_MAX_TEXT_BYTES // MEGABYTE} MB; write it in binary")
    most = _MAX_TEXT_CORNERS if form[1] == "ascii" else _MAX_CORNERS
    corners, faces = _check_count(int(parts[2]), most, "corners"), _check_face_count(int(parts[5]))
    of_corner, of_face = ([line.split() for line in re.findall(r"\nproperty\s+(.*)", parts[k])] for k in (3, 6))
    _check_count(len(of_corner) + len(of_face), 100, "properties")
    listed = next((number for number, words in enumerate(of_face) if words[0] == "list"), None)
    if listed is None or of_face[listed][-1] not in _CORNERS or any(words[0] == "list" for words in of_corner):
        raise ValueError(f"its faces have no list {_CORNERS[0]}, or it has a list before it")
    body, order = blob[end.end() :], _PLY_ORDERS[form[1]]
    if order:
        at = _ply_row(body, 0, of_corner, order).itemsize * corners
        row = _ply_row(body, at, of_face, order)
        found = body[at : at + faces * row.itemsize]
        lengths = np.frombuffer(found, row)[[name for name in row.names or () if name[0] == "n"]]
        if len(lengths) < faces or (lengths != lengths[:1]).any():
            raise ValueError(
                f"its {len(body)} bytes are not {corners} corners and {faces} faces of equal size; triangulate it"
            )
        body, count = body[: at + len(found)], faces * max(row[f"f{listed}"].shape[0] - 2, 0)
    else:
        rows = _lines(body, corners + faces)
        polygons, count = _polygons(rows[corners:], listed)
        body, of_face = b"\n".join([*rows[:corners], polygons]), [["list", "int", "int", _CORNERS[0]]]
    written = f"ply\nformat {form[1]} 1.0\n"
    for name, total, properties in ("vertex", corners, of_corner), ("face", faces, of_face):
        written += f"element {name} {total}\n"
        for number, (*kind, known) in enumerate(properties):
            # trimesh would take other properties than coordinates and indices for colours and textures
            known = known if known in ("x", "y", "z", *_CORNERS) else f"p{number}"
            written += f"property {' '.join(kind)} {known}\n"
    return f"{written}end_header\n".encode() + body, count


def _ply_row(body: bytes, at: int, properties: list[list[str]], order: str) -> np.dtype[Any]:
    """Return the layout of an element in bytes, if its lists are all as long as those of the first one."""
    fields = list[Any]()
    for number, (*kind, _) in enumerate(properties):
        size = ()
        if kind[0] == "list":
            length = np.dtype(order + _PLY_TYPES[kind[1]])
            first = body[at + np.dtype(fields).itemsize :][: length.itemsize]
            size = (int.from_bytes(first, "big" if order == ">" else "little", signed=length.kind == "i"),)
            fields.append((f"n{number}", length))
            if length.kind == "f" or size[0] < 0:
                raise ValueError("it has lists whose lengths are not integers >= 0")
        fields.append((f"f{number}", order + _PLY_TYPES[kind[-1]], size))
    return np.dtype(fields)


_GLB, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_ITEM_BYTES = {
    "VEC3": {5126: 12},
    "SCALAR": {5121: 1, 5123: 2, 5125: 4},
}  # bytes of each type of corners and of indices
_TRIANGLES = 4
_COSMETIC = ("KHR_materials", "KHR_texture", "EXT_texture", "KHR_lights")
"""Prefixes of extensions that do not change corners."""


def _guard_glb(blob: bytes) -> tuple[bytes, int]:
    magic, version, claimed, length, kind = struct.unpack_from("<5I", blob)
    if (magic, version, kind) != (_GLB, 2, _JSON):
        raise ValueError("it is not a binary glTF 2 file")
    _check_count(length, _MAX_JSON_BYTES, "bytes of JSON")
    size, kind = struct.unpack("<II", blob[20 + length : 28 + length].ljust(8, b" "))
    if (claimed := max(claimed, 20 + length, 28 + length + size if kind == _BINARY else 0)) > len(blob):
        raise ValueError(f"it has {len(blob)} bytes where it claims {claimed}")
    tree, data = json.loads(blob[20 : 20 + length]), blob[28 + length : 28 + length + (size if kind == _BINARY else 0)]
    needed = [name for name in tree.get("extensionsRequired", []) if not str(name).startswith(_COSMETIC)]
    if needed:
        raise ValueError(
            f"it needs the extension {str(needed[0])[:50]!r}, which is not supported; export it uncompressed"
        )
    kept = ("children", "mesh", "matrix", "translation", "rotation", "scale")
    nodes = [{key: node[key] for key in kept if key in node} for node in tree["nodes"]]
    roots, placed, parts, faces, corners = tree["scenes"][tree.get("scene", 0)]["nodes"], Counter[int](), 0, 0, 0
    seen, left = [0] * _check_count(len(nodes), _MAX_NODES, "nodes"), list(roots)
    while left:
        node = nodes[number := left.pop()]
        seen[number] += 1
        # glTF requires a tree: each node has one parent, so that there are no cycles
        if seen[number] > 1:
            raise ValueError(f"its node {number} is a child of two nodes or of itself")
        left += node.get("children", [])
        placed.update([node["mesh"]] if "mesh" in node else [])
    arrays, meshes = _Arrays(tree, data), [{"primitives": []} for _ in tree.get("meshes", [])]
    for number, times in placed.items():
        for part in tree["meshes"][number]["primitives"]:
            parts = _check_count(parts + times, _MAX_PARTS, "parts of meshes")
            if (mode := part.get("mode", _TRIANGLES)) < _TRIANGLES:  # points and lines
                continue
            place, count = arrays.take(part["attributes"]["POSITION"], "VEC3")
            corners = _check_count(corners + times * count, _MAX_CORNERS, "corners")
            made: dict[str, Any] = {"attributes": {"POSITION": place}, "mode": mode}
            if "indices" in part:
                made["indices"], count = arrays.take(part["indices"], "SCALAR")
            faces = _check_face_count(faces + times * (count // 3 if mode == _TRIANGLES else count - 2))
            meshes[number]["primitives"].append(made)
    for node in nodes:
        if "mesh" in node and not meshes[node["mesh"]]["primitives"]:
            del node["mesh"]  # trimesh would lose the pose of its children
    reduced = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": roots}], "nodes": nodes, "meshes": meshes,
        "accessors": arrays.accessors, "bufferViews": arrays.views, "buffers": [{"byteLength": arrays.size}],
    }  # fmt: skip
    text, data = json.dumps(reduced).encode(), b"".join(arrays.pieces)
    chunks = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(data), _BINARY) + data
    return struct.pack("<III", _GLB, 2, 12 + len(chunks)) + chunks, faces


class _Arrays:
    """Arrays taken from a .glb: their `accessors` and `views` in JSON, and their bytes, one after another."""

    def __init__(self, tree: dict[str, Any], data: bytes) -> None:
        self.tree, self.data, self.size, self.pieces = tree, data, 0, list[bytes]()
        self.accessors, self.views = list[dict[str, Any]](), list[dict[str, int]]()
        self.known = dict[Any, tuple[int, int]]()

    def take(self, number: Any, form: str) -> tuple[int, int]:
        """Take an accessor over; return its new index and its number of items."""
        if (number, form) in self.known:
            return self.known[number, form]
        accessor = self.tree["accessors"][number]
        width = _ITEM_BYTES[form].get(accessor["componentType"])
        if "sparse" in accessor or "bufferView" not in accessor or accessor["type"] != form or width is None:
            raise ValueError(
                f"its accessor {number} is sparse, empty or of an unsupported type; export it uncompressed"
            )
        view = self.tree["bufferViews"][accessor["bufferView"]]
        if _non_negative(view, "buffer") != 0 or "uri" in self.tree["buffers"][0]:
            raise ValueError("its data are in another file; export it as one .glb")
        count, step = _non_negative(accessor, "count"), _non_negative(view, "byteStride", 0) or width
        begin, start, all_of = (
            _non_negative(accessor, "byteOffset", 0),
            _non_negative(view, "byteOffset", 0),
            _non_negative(view, "byteLength"),
        )
        size = step * (count - 1) + width
        if start + all_of > len(self.data):
            raise ValueError(f"a bufferView ends at byte {start + all_of} of {len(self.data)}")
        if count == 0 or step < width or begin + size > all_of:
            raise ValueError(f"its accessor {number} claims {count} times {width} bytes of a bufferView of {all_of}")
        self.known[number, form] = len(self.accessors), count
        self.accessors.append({key: accessor[key] for key in ("componentType", "count", "type")})
        self.accessors[-1]["bufferView"] = len(self.views)
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": size, "byteStride": step})
        self.size = _check_count(self.size + size, KINDS[".glb"][1], "bytes of corners and faces")
        self.pieces.append(self.data[start + begin : start + begin + size])
        return self.known[number, form]


def _non_negative(tree: dict[str, Any], key: str, missing: int | None = None) -> int:
    """Return a non-negative integer of the JSON."""
    found = tree.get(key, missing)
    if type(found) is not int or not 0 <= found < 2**40:
        raise ValueError(f"its {key} is {str(found)[:50]}, not an integer >= 0")
    return found


_MAX_INPUTS = 16  # indices at each corner of a face
_COLLADA = "{http://www.collada.org/2005/11/COLLADASchema}"
_GROUPS = ("triangles", "polylist", "polygons", "tristrips", "trifans")
_UNSUPPORTED = ("instance_node", "instance_controller", "skew", "lookat", "ph")
_CHILDREN = {
    "COLLADA": ("library_geometries", "library_visual_scenes", "scene"), "scene": ("instance_visual_scene",),
    "library_visual_scenes": ("visual_scene",), "visual_scene": ("node",),
    "node": ("node", "matrix", "translate", "rotate", "scale", "instance_geometry"), "library_geometries": ("geometry",),
    "geometry": ("mesh",), "mesh": ("source", "vertices", *_GROUPS), "vertices": ("input",), "source": ("float_array", "technique_common"),
    "technique_common": ("accessor",), "accessor": ("param",), **dict.fromkeys(_GROUPS, ("input", "vcount", "p")),
}  # fmt: skip
"""Child elements that are kept of each element of a .dae."""


def _guard_dae(blob: bytes) -> tuple[bytes, int]:
    root = read_xml(blob)
    left = [root]
    while left:
        element = left.pop()
        element.tag = _COLLADA + element.tag.rpartition("}")[2]
        kept = _CHILDREN.get(_name(element), ())
        if (unread := next((_name(child) for child in element if _name(child) in _UNSUPPORTED), None)) is not None:
            raise ValueError(f"it has <{unread}>, which is not supported; export it with transformed meshes")
        element[:] = [child for child in element if _name(child) in kept]
        left += element
    scene = root.find(f"{_COLLADA}scene/{_COLLADA}instance_visual_scene")
    wanted = "" if scene is None else scene.get("url", "")[1:]
    scenes = [found for found in root.iter(_COLLADA + "visual_scene") if found.get("id") == wanted]
    if len(scenes) != 1:
        raise ValueError("it has no scene that places its meshes")
    for library in root.iter(_COLLADA + "library_visual_scenes"):
        library[:] = [found for found in library if found is scenes[0]]
    known, words = dict[str | None, tuple[str, int, int]](), 0
    for number, geometry in enumerate(root.iter(_COLLADA + "geometry")):
        groups = [group for name in _GROUPS for group in geometry.iter(_COLLADA + name)]
        known[geometry.get("id")] = f"#g{number}", len(groups), sum(map(_faces_of_group, groups))
        geometry.set("id", f"g{number}")
        _check_sources(geometry)
        words = _check_count(words + sum(map(_text_words, geometry.iter())), 2 * _MAX_FACE_WORDS, "numbers")
    faces = parts = 0
    for node in scenes[0].iter(_COLLADA + "instance_geometry"):
        if (url := node.get("url", "")[1:]) not in known:
            raise ValueError(f"it places {url[:50]!r}, which is not in it")
        new, groups, count = known[url]
        node.set("url", new)
        parts, faces = _check_count(parts + groups, _MAX_PARTS, "parts of meshes"), _check_face_count(faces + count)
    _check_count(sum(1 for _ in scenes[0].iter(_COLLADA + "node")), _MAX_NODES, "nodes")
    return ElementTree.tostring(root), faces


def _text_words(element: Element) -> int:
    return _count_words((element.text or "").encode())


def _faces_of_group(group: Element) -> int:
    """Reduce a group of faces of a .dae to the indices of its corners, and return its number of triangles."""
    inputs, lists, counts = (group.findall(_COLLADA + name) for name in ("input", "p", "vcount"))
    vertex = next((entry for entry in inputs if entry.get("semantic") == "VERTEX"), None)
    offsets = [int(entry.get("offset", "")) for entry in inputs]
    if vertex is None or min(offsets) < 0 or max(offsets) >= _MAX_INPUTS:
        raise ValueError(f"its faces have no input VERTEX, or more than {_MAX_INPUTS} inputs")
    for text in (part.text or "" for part in [*lists, *counts]):
        if (wrong := re.search(r"[^0-9\s]|[0-9]{9}", text)) is not None:
            raise ValueError(f"its faces name corners that do not exist: {text[wrong.start() :][:9]!r}")
    # a copy of the vertex input keeps the largest offset, which tells how many indices each corner has
    last = Element(vertex.tag, {**vertex.attrib, "offset": str(max(offsets))})
    group[:] = [vertex, last, *counts, *lists]
    corners = [_text_words(part) // (max(offsets) + 1) for part in lists]
    if _name(group) == "triangles":
        return _check_face_count(sum(corners) // 3)
    if _name(group) == "polylist":
        _check_count(sum(map(_text_words, counts)), MAX_FACES, "polygons")
        corners, claimed = [int(word) for part in counts for word in (part.text or "").split()], sum(corners)
        if sum(corners) != claimed:
            raise ValueError(f"its faces claim {sum(corners)} corners where it has {claimed}")
    if min(corners, default=3) < 3:
        raise ValueError("it has faces of fewer than three corners")
    return _check_face_count(sum(corners) - 2 * len(corners))


def _check_sources(geometry: Element) -> None:
    """Remove all sources but the coordinates of corners, and check that these are plain lists of numbers."""
    for vertices in geometry.iter(_COLLADA + "vertices"):
        vertices[:] = [entry for entry in vertices if entry.get("semantic") == "POSITION"]
    wanted = {entry.get("source") for vertices in geometry.iter(_COLLADA + "vertices") for entry in vertices}
    for mesh in geometry:
        mesh[:] = [part for part in mesh if _name(part) != "source" or f"#{part.get('id')}" in wanted]
    for accessor in geometry.iter(_COLLADA + "accessor"):
        if int(accessor.get("stride", "1")) != len(accessor) or accessor.get("offset", "0") != "0":
            raise ValueError("its corners are strided in a list of numbers, which is not supported")
    for numbers in geometry.iter(_COLLADA + "float_array"):
        _check_count(_text_words(numbers) // 3, _MAX_CORNERS, "corners")
        if (wrong := re.search(r"[^-+.0-9eE\s]|[0-9]{51}", numbers.text or "")) is not None:
            raise ValueError(f"it has {wrong[0][:20]!r} where it claims numbers")


def _name(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return element.tag.rpartition("}")[2]


KINDS: dict[str, tuple[Callable[[bytes], tuple[bytes, int]], int]] = {
    ".obj": (_guard_obj, 40 * MEGABYTE),
    ".stl": (_guard_stl, 80 * MEGABYTE),
    ".ply": (_guard_ply, 40 * MEGABYTE),
    ".off": (_guard_off, _MAX_TEXT_BYTES),
    ".glb": (_guard_glb, 100 * MEGABYTE),
    ".dae": (_guard_dae, 40 * MEGABYTE),
}
"""Guard and largest size [bytes] of each kind of file: twice that of `MAX_FACES` with normals and textures, and pictures in a .glb."""
