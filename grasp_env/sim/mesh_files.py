"""The one reader of mesh files, of objects and of hands: trimesh, behind a guard for each kind.

A guard holds what a file claims of its size against its bytes, counts its triangles, and writes a file of the same kind anew that
has its corners and triangles only: trimesh sees no materials, pictures, scripts or names of other files. What is too large or of a
feature that is not read is refused before; no file takes more than 2 s or 1 GiB. Coordinates stay in the file's units and axes, in a
.dae too, whose <unit> and <up_axis> are not applied: a hand's factors hold the former, see `unit_of` of `hand.files.meshes`.
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
    "MOST_FACES",
    "key_lines",
    "key_places",
    "mesh_bytes",
    "obj_text",
    "one_newline",
    "read_mesh",
    "read_mesh_bytes",
]

MOST_FACES = 200_000
"""Triangles of a mesh."""
_MOST_CORNERS = 3 * MOST_FACES  # those that no face names among them
_MOST_IN_WORDS = 2 * MOST_FACES  # of an .off and a .ply of words, whose numbers trimesh reads in 3 us a corner
_WORDS = 20 * MEGABYTE  # of these two: 1.5 s
_MOST_PARTS = 4000  # of meshes that a scene places: 0.3 ms each
_MOST_NODES = 10_000
_MOST_LINES = 3_000_000
_MOST_WORDS = 20 * MOST_FACES  # of the faces of a text, with numbers of normals and textures
_LONGEST_HEAD = 100_000  # bytes of a .ply
_LONGEST_JSON = 4 * MEGABYTE
_HINT = "; export it again as .obj or .stl"
_SIMPLER = (
    f"allowed are up to {MOST_FACES}; simplify it: pip install trimesh fast-simplification, then "
    f"trimesh.load(FILE, force='mesh').simplify_quadric_decimation(face_count={MOST_FACES // 2}).export('simple.obj')"
)
_POINT = rb"(?:([-+.\w]{1,50}[ \t]+[-+.\w]{1,50}[ \t]+[-+.\w]{1,50})(?!\S))?"  # "" where there is none


class _TooManyFacesError(Exception):
    """A mesh of more than `MOST_FACES` triangles; `args` is how many."""


def read_mesh(path: str | Path, name: str, hint: str = _HINT) -> tuple[Array, Any]:
    """Corners (V, 3) float64 in the file's units, those that a face names, and faces (F, 3) int64 of a mesh file, regular or a pipe.

    Args:
        path: Of an .obj, .stl, .ply, .off, .glb or .dae.
        name: Of the mesh, for messages.
        hint: What to do where it is no mesh, for messages.

    Raises:
        InvalidInputError: Not a mesh, or one too large.
        MissingExtraError: Without the extra `sim`.
    """
    return read_mesh_bytes(mesh_bytes(path, name, hint), Path(path).suffix.lower(), name, hint)


def mesh_bytes(path: str | Path, name: str, hint: str = _HINT) -> bytes:
    """The bytes of a mesh file of one of the kinds that are read, and not larger than these may be."""
    kind = Path(path).suffix.lower()
    if kind not in KINDS:
        raise InvalidInputError(f"{name} is of no kind that is read: {', '.join(KINDS)}; export it as one of them")
    return parsed(path, lambda blob: blob, InvalidInputError, name, f"a mesh of kind {kind}", hint, KINDS[kind][1])


def read_mesh_bytes(blob: bytes, kind: str, name: str, hint: str = _HINT) -> tuple[Array, Any]:
    """The same of a file's bytes, of a kind such as ".obj"."""
    need("sim")

    def read(blob: bytes) -> tuple[Array, Any]:
        try:
            guarded, count = KINDS[kind][0](blob)
        except KeyError as missing:
            raise ValueError(f"it has no {missing}") from None
        return _by_trimesh(guarded, kind, _few_faces(count))

    try:
        corners, faces = understood(blob, read, InvalidInputError, name, f"a mesh of kind {kind}", hint)
    except InvalidInputError as error:
        if isinstance(error.__cause__, _TooManyFacesError):
            raise InvalidInputError(f"{name} has {error.__cause__} faces, {_SIMPLER}") from None
        raise
    if len(faces) == 0:
        raise InvalidInputError(f"{name} holds no triangles{hint}")
    if not np.isfinite(corners).all() or np.abs(corners).max() > 1e6:  # squares lose their digits
        raise InvalidInputError(f"{name} has coordinates that are not finite or above 1e6{hint}")
    return corners, faces


def obj_text(parts: Iterable[tuple[Array, Any]]) -> str:
    """An .obj of parts, each of corners (V, 3) and faces (F, 3), with all digits.

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
    """Corners and faces of a file that a guard has written, which says how many triangles it has."""
    import trimesh  # slow to import, and only meshes need it

    if count == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    with np.errstate(all="ignore"):  # numbers that are not finite are told later
        mesh: Any = trimesh.load_mesh(io.BytesIO(blob), file_type=kind[1:], process=False, skip_materials=True, ignore_broken=False)  # fmt: skip
        faces = np.array(mesh.faces, dtype=np.int64)
        if faces.shape != (count, 3):
            raise ValueError(f"it has {count} triangles, of which {len(faces)} are understood")
        if faces.min() < 0 or faces.max() >= len(mesh.vertices):
            raise ValueError("it holds faces whose corners do not exist")
        mesh.remove_unreferenced_vertices()
        return np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)


def _few_faces(faces: int) -> int:
    if faces > MOST_FACES:
        raise _TooManyFacesError(faces)
    return faces


def _few(found: int, most: int, what: str) -> int:
    if found > most:
        raise ValueError(f"it has {found} {what}, allowed are up to {most}")
    return found


def one_newline(text: bytes) -> bytes:
    """A text whose lines end as on Unix, and one such end before it: `key_lines` looks for it, which is several times as fast as `^`."""
    text = b"\n" + (text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text)
    _few(text.count(b"\n") - 1, _MOST_LINES, "lines")
    return text


def key_places(text: bytes, key: bytes) -> Iterator[int]:
    """Offsets of the lines that begin with a word."""
    return (found.start() for found in re.finditer(rb"\n[ \t]*%s[ \t]" % key, text))


def key_lines(text: bytes, key: bytes, rest: bytes = b"(.*)") -> list[bytes]:
    """What follows a word in the lines that begin with it."""
    return re.findall(rb"\n[ \t]*%s[ \t]+%s" % (key, rest), text)


def _points(text: bytes, key: bytes) -> list[bytes]:
    """The three numbers that follow a word in each line that begins with it."""
    found = key_lines(text, key, _POINT)
    if b"" in found:
        raise ValueError(f"it has a {key.decode()} of fewer than three coordinates, or of more than 50 characters each")
    _few(len(found), _MOST_CORNERS, "corners")
    return found


def _count_words(text: bytes) -> int:
    """Words of a text, without cutting it."""
    letters = np.frombuffer(b" " + text, np.uint8)
    inside = (letters != 32) & (letters - np.uint8(9) > 4)  # blanks are 32 and 9 to 13
    return int(np.count_nonzero(inside[1:] & ~inside[:-1]))


def _guard_obj(blob: bytes) -> tuple[bytes, int]:
    text = one_newline(blob).replace(b"\\\n", b" ")
    corners = _points(text, b"v")
    rows = key_lines(text, b"f", rb"(\S+[ \t]+\S+[ \t]+[^\s#][^\n#]*)")
    faces = b"\n".join(rows)
    count = _few_faces(_count_words(faces) - 2 * len(rows))
    faces = re.sub(rb"/\S*", b"", faces)  # of 1/2/3 only the 1 is the number of a corner
    if (wrong := re.search(rb"[^-0-9\s]|[0-9]{9}|(?<![0-9])0", faces)) is not None:
        raise ValueError(f"it has faces whose corners do not exist: {faces[wrong.start() :][:9].decode('latin1')!r}")
    if b"-" in faces and re.compile(rb"\n[ \t]*v[ \t]").search(text, next(key_places(text, b"f"))):
        raise ValueError("it has corners behind faces that count corners backwards; export it with numbers from 1 on")
    return b"v " + b"\nv ".join(corners) + b"\nf " + faces.replace(b"\n", b"\nf ") + b"\n", count


def _guard_stl(blob: bytes) -> tuple[bytes, int]:
    count = int.from_bytes(blob[80:84], "little")
    if len(blob) == 84 + 50 * count:
        return blob, count
    corners = _points(one_newline(blob).lower(), b"vertex")
    if len(corners) % 3:
        raise ValueError(f"it has {len(corners)} lines of a vertex, which are no whole triangles")
    if not corners and len(blob) > 84:
        raise ValueError(f"it has {len(blob)} bytes, but claims {count} triangles of 50 bytes after the first 84")
    return b"solid\nvertex " + b"\nvertex ".join(corners) + b"\nendsolid\n", len(corners) // 3


def _polygons(rows: Sequence[bytes], at: int = 0) -> tuple[bytes, int]:
    """The polygons of lines whose word `at` is how many corners follow, without what stands around them, and how many triangles they are."""
    _few(_count_words(b"\n".join(rows)), _MOST_WORDS, "words of faces")
    cut = [words[at : at + 1 + int(words[at])] for words in map(bytes.split, rows)]
    if any(not 4 <= len(words) == 1 + int(words[0]) for words in cut):
        raise ValueError("it has a face of fewer numbers than it claims, or than three")
    return b"\n".join(map(b" ".join, cut)), sum(map(len, cut)) - 3 * len(cut)


def _lines(text: bytes, claimed: int) -> list[bytes]:
    """The first lines of a text that hold something, as many as are claimed, of numbers of ordinary length."""
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
        raise ValueError("it does not begin with OFF, the number of corners and that of faces")
    corners, faces = _few(int(head[1]), _MOST_IN_WORDS, "corners"), _few_faces(int(head[2]))
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
    # "\r" alone ends a line of a header, too; in the bytes after it that is a number
    end = re.compile(rb"end_header[ \t]*(?:\r\n|\n|\r)").search(blob, 0, _LONGEST_HEAD)
    head = "" if end is None else one_newline(blob[: end.end()]).decode("latin1")
    form = re.search(r"\nformat\s+(ascii|binary_little_endian|binary_big_endian)\s", head)
    parts = re.split(r"\nelement\s+(\S+)\s+([0-9]{1,12})\s*?(?=\n)", head)
    if end is None or form is None or parts[1::3][:2] != ["vertex", "face"]:
        raise ValueError(
            f"it has no header within {_LONGEST_HEAD} bytes with a format, element vertex and element face"
        )
    if form[1] == "ascii" and len(blob) > _WORDS:
        raise ValueError(f"it is larger than {_WORDS // MEGABYTE} MB; write it as bytes")
    most = _MOST_IN_WORDS if form[1] == "ascii" else _MOST_CORNERS
    corners, faces = _few(int(parts[2]), most, "corners"), _few_faces(int(parts[5]))
    of_corner, of_face = ([line.split() for line in re.findall(r"\nproperty\s+(.*)", parts[k])] for k in (3, 6))
    _few(len(of_corner) + len(of_face), 100, "properties")
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
            raise ValueError(f"its {len(body)} bytes are not {corners} corners and {faces} equal faces; triangulate it")
        body, count = body[: at + len(found)], faces * max(row[f"f{listed}"].shape[0] - 2, 0)
    else:
        rows = _lines(body, corners + faces)
        polygons, count = _polygons(rows[corners:], listed)
        body, of_face = b"\n".join([*rows[:corners], polygons]), [["list", "int", "int", _CORNERS[0]]]
    written = f"ply\nformat {form[1]} 1.0\n"
    for name, total, properties in ("vertex", corners, of_corner), ("face", faces, of_face):
        written += f"element {name} {total}\n"
        for number, (*kind, known) in enumerate(properties):
            # others than the places and the numbers of corners would be taken for colours and textures
            known = known if known in ("x", "y", "z", *_CORNERS) else f"p{number}"
            written += f"property {' '.join(kind)} {known}\n"
    return f"{written}end_header\n".encode() + body, count


def _ply_row(body: bytes, at: int, properties: list[list[str]], order: str) -> np.dtype[Any]:
    """How an element lies in bytes if its lists are all as long as those of the first."""
    fields = list[Any]()
    for number, (*kind, _) in enumerate(properties):
        size = ()
        if kind[0] == "list":
            length = np.dtype(order + _PLY_TYPES[kind[1]])
            first = body[at + np.dtype(fields).itemsize :][: length.itemsize]
            size = (int.from_bytes(first, "big" if order == ">" else "little", signed=length.kind == "i"),)
            fields.append((f"n{number}", length))
            if length.kind == "f" or size[0] < 0:
                raise ValueError("it has lists whose lengths are no whole numbers from 0")
        fields.append((f"f{number}", order + _PLY_TYPES[kind[-1]], size))
    return np.dtype(fields)


_GLB, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FORMS = {"VEC3": {5126: 12}, "SCALAR": {5121: 1, 5123: 2, 5125: 4}}  # of corners and of their numbers: bytes of each
_TRIANGLES = 4
_LOOKS = ("KHR_materials", "KHR_texture", "EXT_texture", "KHR_lights")
"""Extensions, as their names begin, that change no corner."""


def _guard_glb(blob: bytes) -> tuple[bytes, int]:
    magic, version, claimed, length, kind = struct.unpack_from("<5I", blob)
    if (magic, version, kind) != (_GLB, 2, _JSON):
        raise ValueError("it does not begin as glTF 2 in one file")
    _few(length, _LONGEST_JSON, "bytes of JSON")
    size, kind = struct.unpack("<II", blob[20 + length : 28 + length].ljust(8, b" "))
    if (claimed := max(claimed, 20 + length, 28 + length + size if kind == _BINARY else 0)) > len(blob):
        raise ValueError(f"it has {len(blob)} bytes where it claims {claimed}")
    tree, data = json.loads(blob[20 : 20 + length]), blob[28 + length : 28 + length + (size if kind == _BINARY else 0)]
    needed = [name for name in tree.get("extensionsRequired", []) if not str(name).startswith(_LOOKS)]
    if needed:
        raise ValueError(f"it needs the extension {str(needed[0])[:50]!r}, which is not read; export it uncompressed")
    kept = ("children", "mesh", "matrix", "translation", "rotation", "scale")
    nodes = [{key: node[key] for key in kept if key in node} for node in tree["nodes"]]
    roots, placed, parts, faces, corners = tree["scenes"][tree.get("scene", 0)]["nodes"], Counter[int](), 0, 0, 0
    seen, left = [0] * _few(len(nodes), _MOST_NODES, "nodes"), list(roots)
    while left:
        node = nodes[number := left.pop()]
        seen[number] += 1
        # a tree, says glTF: a node has one place, so that there are no more places than nodes, and no circle
        if seen[number] > 1:
            raise ValueError(f"its node {number} is a child of two nodes or of itself")
        left += node.get("children", [])
        placed.update([node["mesh"]] if "mesh" in node else [])
    arrays, meshes = _Arrays(tree, data), [{"primitives": []} for _ in tree.get("meshes", [])]
    for number, times in placed.items():
        for part in tree["meshes"][number]["primitives"]:
            parts = _few(parts + times, _MOST_PARTS, "parts of meshes")
            if (mode := part.get("mode", _TRIANGLES)) < _TRIANGLES:  # points and lines
                continue
            place, count = arrays.take(part["attributes"]["POSITION"], "VEC3")
            corners = _few(corners + times * count, _MOST_CORNERS, "corners")
            made: dict[str, Any] = {"attributes": {"POSITION": place}, "mode": mode}
            if "indices" in part:
                made["indices"], count = arrays.take(part["indices"], "SCALAR")
            faces = _few_faces(faces + times * (count // 3 if mode == _TRIANGLES else count - 2))
            meshes[number]["primitives"].append(made)
    for node in nodes:
        if "mesh" in node and not meshes[node["mesh"]]["primitives"]:
            del node["mesh"]  # trimesh would lose the place of its children
    reduced = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": roots}], "nodes": nodes, "meshes": meshes,
        "accessors": arrays.accessors, "bufferViews": arrays.views, "buffers": [{"byteLength": arrays.size}],
    }  # fmt: skip
    text, data = json.dumps(reduced).encode(), b"".join(arrays.pieces)
    chunks = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(data), _BINARY) + data
    return struct.pack("<III", _GLB, 2, 12 + len(chunks)) + chunks, faces


class _Arrays:
    """The arrays that are taken from a .glb: `accessors` and `views` of them in JSON, and their bytes, one after another."""

    def __init__(self, tree: dict[str, Any], data: bytes) -> None:
        self.tree, self.data, self.size, self.pieces = tree, data, 0, list[bytes]()
        self.accessors, self.views = list[dict[str, Any]](), list[dict[str, int]]()
        self.known = dict[Any, tuple[int, int]]()

    def take(self, number: Any, form: str) -> tuple[int, int]:
        """The new number of an accessor, and how many it has."""
        if (number, form) in self.known:
            return self.known[number, form]
        accessor = self.tree["accessors"][number]
        width = _FORMS[form].get(accessor["componentType"])
        if "sparse" in accessor or "bufferView" not in accessor or accessor["type"] != form or width is None:
            raise ValueError(f"its accessor {number} is sparse, empty or of other numbers; export it uncompressed")
        view = self.tree["bufferViews"][accessor["bufferView"]]
        if _whole(view, "buffer") != 0 or "uri" in self.tree["buffers"][0]:
            raise ValueError("its numbers lie in another file; export it as one .glb")
        count, step = _whole(accessor, "count"), _whole(view, "byteStride", 0) or width
        begin, start, all_of = (
            _whole(accessor, "byteOffset", 0),
            _whole(view, "byteOffset", 0),
            _whole(view, "byteLength"),
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
        self.size = _few(self.size + size, KINDS[".glb"][1], "bytes of corners and faces")
        self.pieces.append(self.data[start + begin : start + begin + size])
        return self.known[number, form]


def _whole(tree: dict[str, Any], key: str, missing: int | None = None) -> int:
    """A whole number of the JSON that is not below 0."""
    found = tree.get(key, missing)
    if type(found) is not int or not 0 <= found < 2**40:
        raise ValueError(f"its {key} is {str(found)[:50]}, not a whole number from 0")
    return found


_MOST_INPUTS = 16  # numbers of each corner of a face
_COLLADA = "{http://www.collada.org/2005/11/COLLADASchema}"
_GROUPS = ("triangles", "polylist", "polygons", "tristrips", "trifans")
_UNREAD = ("instance_node", "instance_controller", "skew", "lookat", "ph")
_WITHIN = {
    "COLLADA": ("library_geometries", "library_visual_scenes", "scene"), "scene": ("instance_visual_scene",),
    "library_visual_scenes": ("visual_scene",), "visual_scene": ("node",),
    "node": ("node", "matrix", "translate", "rotate", "scale", "instance_geometry"), "library_geometries": ("geometry",),
    "geometry": ("mesh",), "mesh": ("source", "vertices", *_GROUPS), "vertices": ("input",), "source": ("float_array", "technique_common"),
    "technique_common": ("accessor",), "accessor": ("param",), **dict.fromkeys(_GROUPS, ("input", "vcount", "p")),
}  # fmt: skip
"""What is kept of each element of a .dae."""


def _guard_dae(blob: bytes) -> tuple[bytes, int]:
    root = read_xml(blob)
    left = [root]
    while left:
        element = left.pop()
        element.tag = _COLLADA + element.tag.rpartition("}")[2]
        kept = _WITHIN.get(_name(element), ())
        if (unread := next((_name(child) for child in element if _name(child) in _UNREAD), None)) is not None:
            raise ValueError(f"it has <{unread}>, which is not read; export it with its meshes in their places")
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
        words = _few(words + sum(map(_text_words, geometry.iter())), 2 * _MOST_WORDS, "numbers")
    faces = parts = 0
    for node in scenes[0].iter(_COLLADA + "instance_geometry"):
        if (url := node.get("url", "")[1:]) not in known:
            raise ValueError(f"it places {url[:50]!r}, which is not in it")
        new, groups, count = known[url]
        node.set("url", new)
        parts, faces = _few(parts + groups, _MOST_PARTS, "parts of meshes"), _few_faces(faces + count)
    _few(sum(1 for _ in scenes[0].iter(_COLLADA + "node")), _MOST_NODES, "nodes")
    return ElementTree.tostring(root), faces


def _text_words(element: Element) -> int:
    return _count_words((element.text or "").encode())


def _faces_of_group(group: Element) -> int:
    """Triangles of a group of a .dae, in which only the numbers of corners are left to be looked up."""
    inputs, lists, counts = (group.findall(_COLLADA + name) for name in ("input", "p", "vcount"))
    vertex = next((entry for entry in inputs if entry.get("semantic") == "VERTEX"), None)
    offsets = [int(entry.get("offset", "")) for entry in inputs]
    if vertex is None or min(offsets) < 0 or max(offsets) >= _MOST_INPUTS:
        raise ValueError(f"its faces have no input VERTEX, or more than {_MOST_INPUTS} inputs")
    for text in (part.text or "" for part in [*lists, *counts]):
        if (wrong := re.search(r"[^0-9\s]|[0-9]{9}", text)) is not None:
            raise ValueError(f"its faces name corners that do not exist: {text[wrong.start() :][:9]!r}")
    # the last input says how many numbers there are for each corner; what they mean but for the place is not looked up
    last = Element(vertex.tag, {**vertex.attrib, "offset": str(max(offsets))})
    group[:] = [vertex, last, *counts, *lists]
    corners = [_text_words(part) // (max(offsets) + 1) for part in lists]
    if _name(group) == "triangles":
        return _few_faces(sum(corners) // 3)
    if _name(group) == "polylist":
        _few(sum(map(_text_words, counts)), MOST_FACES, "polygons")
        corners, claimed = [int(word) for part in counts for word in (part.text or "").split()], sum(corners)
        if sum(corners) != claimed:
            raise ValueError(f"its faces claim {sum(corners)} corners where it has {claimed}")
    if min(corners, default=3) < 3:
        raise ValueError("it has faces of fewer than three corners")
    return _few_faces(sum(corners) - 2 * len(corners))


def _check_sources(geometry: Element) -> None:
    """Leaves the places of corners, whose numbers have to be read as they are written."""
    for vertices in geometry.iter(_COLLADA + "vertices"):
        vertices[:] = [entry for entry in vertices if entry.get("semantic") == "POSITION"]
    wanted = {entry.get("source") for vertices in geometry.iter(_COLLADA + "vertices") for entry in vertices}
    for mesh in geometry:
        mesh[:] = [part for part in mesh if _name(part) != "source" or f"#{part.get('id')}" in wanted]
    for accessor in geometry.iter(_COLLADA + "accessor"):
        if int(accessor.get("stride", "1")) != len(accessor) or accessor.get("offset", "0") != "0":
            raise ValueError("its corners are every so many of a list of numbers, which is not read")
    for numbers in geometry.iter(_COLLADA + "float_array"):
        _few(_text_words(numbers) // 3, _MOST_CORNERS, "corners")
        if (wrong := re.search(r"[^-+.0-9eE\s]|[0-9]{51}", numbers.text or "")) is not None:
            raise ValueError(f"it has {wrong[0][:20]!r} where it claims numbers")


def _name(element: Element) -> str:
    """Without that of its format."""
    return element.tag.rpartition("}")[2]


KINDS: dict[str, tuple[Callable[[bytes], tuple[bytes, int]], int]] = {
    ".obj": (_guard_obj, 40 * MEGABYTE),
    ".stl": (_guard_stl, 80 * MEGABYTE),
    ".ply": (_guard_ply, 40 * MEGABYTE),
    ".off": (_guard_off, _WORDS),
    ".glb": (_guard_glb, 100 * MEGABYTE),
    ".dae": (_guard_dae, 40 * MEGABYTE),
}
"""What guards each kind of file, and the most bytes of it: twice what `MOST_FACES` with normals and textures take, and pictures in a .glb."""
