"""Reader of all mesh files, of objects and of hands: trimesh, with a guard in front of it for each kind of file.

A guard compares the size that a file claims with its bytes, counts its triangles, and rewrites the file with its corners and triangles
only: trimesh sees no materials, pictures, scripts or names of other files. Files that are too large or use unsupported features are
refused first. No file takes more than 2 s or 1 GiB. Coordinates stay in the file's units and axes. This holds for a .dae, too: its <unit>
and <up_axis> are not applied, as a hand's scale factors include the unit, see `unit_of` of `hand.files.meshes`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env._extras import need
from grasp_env._files import MEGABYTE, parsed, understood
from grasp_env.errors import InvalidInputError
from grasp_env.sim.mesh_limits import MAX_FACES, TooManyFacesError, check_count, check_face_count, count_words
from grasp_env.sim.mesh_scenes import guard_dae, guard_glb

_MAX_TEXT_BYTES = 20 * MEGABYTE  # bytes of an .off or a .ply in text: 1.5 s
_MAX_HEADER_BYTES = 100_000  # bytes of the header of a .ply
_HINT = "; export it again as .obj or .stl"
_SIMPLER = (
    f"allowed are up to {MAX_FACES}; simplify it: pip install trimesh fast-simplification, then "
    f"trimesh.load(FILE, force='mesh').simplify_quadric_decimation(face_count={MAX_FACES // 2}).export('simple.obj')"
)
_POINT = rb"(?:([-+.\w]{1,50}[ \t]+[-+.\w]{1,50}[ \t]+[-+.\w]{1,50})(?!\S))?"  # "" if there are none


def read_mesh(path: str | Path, name: str, hint: str = _HINT) -> tuple[Array, Any]:
    """Read a mesh file, regular or a pipe: corners (V, 3) float64 of its faces, in the file's units, and faces (F, 3) int64.

    An InvalidInputError begins with `name`; if the file is not a mesh, it ends with `hint`.
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
        return _by_trimesh(guarded, kind, check_face_count(count))

    try:
        corners, faces = understood(blob, read, InvalidInputError, name, f"a mesh of kind {kind}", hint)
    except InvalidInputError as error:
        if isinstance(error.__cause__, TooManyFacesError):
            raise InvalidInputError(f"{name} has {error.__cause__} faces, {_SIMPLER}") from None
        raise
    if len(faces) == 0:
        raise InvalidInputError(f"{name} holds no triangles{hint}")
    if not np.isfinite(corners).all() or np.abs(corners).max() > 1e6:  # squares would lose digits
        raise InvalidInputError(f"{name} has coordinates that are not finite or above 1e6{hint}")
    return corners, faces


def obj_text(parts: Iterable[tuple[Array, Any]]) -> str:
    """Return an .obj, with all digits, of parts that each have corners (V, 3) and faces (F, 3)."""
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


def one_newline(text: bytes) -> bytes:
    """Return a text with Unix line ends and a newline in front, for which `key_lines` searches: several times as fast as `^`."""
    text = b"\n" + (text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text)
    check_count(text.count(b"\n") - 1, "lines")
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
    check_count(len(found), "corners")
    return found


def _guard_obj(blob: bytes) -> tuple[bytes, int]:
    text = one_newline(blob).replace(b"\\\n", b" ")
    corners = _points(text, b"v")
    rows = key_lines(text, b"f", rb"(\S+[ \t]+\S+[ \t]+[^\s#][^\n#]*)")
    faces = b"\n".join(rows)
    count = check_face_count(count_words(faces) - 2 * len(rows))
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
    check_count(count_words(b"\n".join(rows)), "words of faces")
    cut = [words[at : at + 1 + int(words[at])] for words in map(bytes.split, rows)]
    if any(not 4 <= len(words) == 1 + int(words[0]) for words in cut):
        raise ValueError("it has a face with fewer numbers than it claims, or fewer than three")
    return b"\n".join(map(b" ".join, cut)), sum(map(len, cut)) - 3 * len(cut)


def _lines(text: bytes, claimed: int) -> list[bytes]:
    """Return the first `claimed` lines of a text that are not empty, and check that they are numbers of ordinary length."""
    rows = [row for row in one_newline(text).split(b"\n") if row.strip()][:claimed]
    if len(rows) < claimed:
        raise ValueError(f"it claims {claimed} lines of numbers but has {len(rows)}")
    if (wrong := re.search(rb"[^-+.\w\s]|\w{51}", b"\n".join(rows))) is not None:
        raise ValueError(f"it has {wrong[0][:20].decode('latin1')!r} where numbers are expected")
    return rows


def _guard_off(blob: bytes) -> tuple[bytes, int]:
    text = re.sub(rb"#.*", b"", one_newline(blob))
    head = re.match(rb"\s*(?:ST)?C?N?OFF\s+([0-9]{1,12})[ \t]+([0-9]{1,12})(?:[ \t]+[0-9]{1,12})?[ \t]*(?:\n|\Z)", text)
    if head is None:
        raise ValueError("it does not begin with OFF and the numbers of corners and faces")
    corners, faces = check_count(int(head[1]), "corners in text"), check_face_count(int(head[2]))
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
    what = "corners in text" if form[1] == "ascii" else "corners"
    corners, faces = check_count(int(parts[2]), what), check_face_count(int(parts[5]))
    of_corner, of_face = ([line.split() for line in re.findall(r"\nproperty\s+(.*)", parts[k])] for k in (3, 6))
    check_count(len(of_corner) + len(of_face), "properties")
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


KINDS: dict[str, tuple[Callable[[bytes], tuple[bytes, int]], int]] = {
    ".obj": (_guard_obj, 40 * MEGABYTE),
    ".stl": (_guard_stl, 80 * MEGABYTE),
    ".ply": (_guard_ply, 40 * MEGABYTE),
    ".off": (_guard_off, _MAX_TEXT_BYTES),
    ".glb": (guard_glb, 100 * MEGABYTE),
    ".dae": (guard_dae, 40 * MEGABYTE),
}
"""Guard and largest size [bytes] of each kind of file: twice that of `MAX_FACES` with normals and textures, and pictures in a .glb."""
