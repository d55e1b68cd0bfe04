"""Mesh files: small valid ones of every kind, and wrong ones."""

from __future__ import annotations

import json
import struct
from typing import Any

CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
_FLOATS = b"".join(struct.pack("<3f", *corner) for corner in CORNERS)
_NUMBERS = b"".join(struct.pack("<3H", *face) for face in FACES)
_PLACES = "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS).encode()
_PARAMS = "".join(f'<param name="{name}" type="float"/>' for name in "XYZ")
_NAMESPACE = "http://www.collada.org/2005/11/COLLADASchema"


def glb(tree: Any, data: bytes = b"") -> bytes:
    """Return a .glb of a JSON tree and its data."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if data:
        chunks += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf(**changes: Any) -> dict[str, Any]:
    """Return the JSON of a tetrahedron; `accessors__0__count=3` changes an entry."""
    corners = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}
    faces = {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"}
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [corners, faces],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 24},
        ],
        "buffers": [{"byteLength": 72}],
    }
    for path, value in changes.items():
        *parts, name = path.split("__")
        place: Any = tree
        for part in parts:
            place = place[int(part) if part.isdecimal() else part]
        place[name] = value
    return tree


def tetrahedron(**changes: Any) -> bytes:
    return glb(gltf(**changes), _FLOATS + _NUMBERS)


def dae(
    scene: str = '<node><instance_geometry url="#g"/></node>', faces: str = "", head: str = ""
) -> bytes:
    """Return a .dae of a tetrahedron, with `faces` in place of its <triangles> and `head` before
    the root."""
    numbers = " ".join(f"{k} 0" for face in FACES for k in face)
    triangles = (
        f'<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><input semantic="NORMAL" source="#n" offset="1"/>'
        f"<p>{numbers}</p></triangles>"
    )
    return (
        f'<?xml version="1.0"?>{head}<COLLADA xmlns="{_NAMESPACE}"><library_geometries><geometry id="g"><mesh><source id="s">'
        f'<float_array id="a" count="12">{_PLACES.decode()}</float_array><technique_common><accessor count="4" stride="3">'
        f'{_PARAMS}</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#s"/></vertices>{faces or triangles}'
        f'</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="S">{scene}</visual_scene>'
        '</library_visual_scenes><scene><instance_visual_scene url="#S"/></scene></COLLADA>'
    ).encode()


def ply(form: str, corners: int, faces: int, body: bytes, more: str = "") -> bytes:
    return (
        f"ply\nformat {form} 1.0\nelement vertex {corners}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\n{more}end_header\n"
    ).encode() + body


def stl(count: int, body: bytes) -> bytes:
    return bytes(80) + struct.pack("<I", count) + body


_TEXT_FACES = "".join("3 {} {} {}\n".format(*face) for face in FACES).encode()
_STL = b"".join(
    struct.pack("<12fH", 0, 0, 1, *(x for k in face for x in CORNERS[k]), 0) for face in FACES
)
_CAMERA = {"cameras": [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]}
_POINTS = {"primitives": [{"attributes": {"POSITION": 0}, "mode": 2}]}
_TWO = [
    b"facet normal 0 0 1\n outer loop\n"
    + b"".join(b"  vertex %d %d %d\n" % CORNERS[k] for k in face)
    + b" endloop\nendfacet\n"
    for face in FACES
]
_UV = "property list uchar float texcoord\n"
VALID: dict[str, tuple[str, bytes]] = {
    "obj": (
        ".obj",
        b"mtllib a.mtl\n"
        + _PLACES.replace(b"\n", b"\nv ").join((b"v ", b"")).removesuffix(b"v ")
        + b"vt 0 0\nvn 0 0 1\nusemtl b\nf 1/1/1 3/1/1 2/1/1\nusemtl a\nf 1//1 2//1 4//1\nusemtl b\nf -4 -1 -2\nf 2 3 \\\n4 # last\n",
    ),
    "stl": (".stl", stl(4, _STL)),
    "stl of words": (
        ".stl",
        b"solid a\n"
        + b"".join(_TWO[:2])
        + b"endsolid a\nSOLID b\n"
        + b"".join(_TWO[2:]).upper()
        + b"ENDSOLID b\n",
    ),
    "ply of words": (".ply", ply("ascii", 4, 4, (_PLACES + _TEXT_FACES).replace(b"\n", b"\r\n"))),
    "ply with textures": (
        ".ply",
        ply(
            "ascii",
            4,
            4,
            _PLACES
            + _TEXT_FACES.replace(b"\n", b" 6 0 0 0 1 1 1\n", 3).replace(
                b"3 1 2 3\n", b"3 1 2 3 0\n"
            ),
            _UV,
        ),
    ),
    "ply": (
        ".ply",
        ply(
            "binary_little_endian",
            4,
            4,
            _FLOATS + b"".join(struct.pack("<B3i", 3, *face) for face in FACES),
        ),
    ),
    "ply, the other order": (
        ".ply",
        ply(
            "binary_big_endian",
            4,
            4,
            b"".join(struct.pack(">3f", *corner) for corner in CORNERS)
            + b"".join(struct.pack(">B3i", 3, *face) for face in FACES),
        ),
    ),
    "off": (".off", b"OFF # a comment\n4 4 6\n" + _PLACES + b"\n" + _TEXT_FACES),
    "glb": (".glb", tetrahedron()),
    "glb, placed": (
        ".glb",
        tetrahedron(
            nodes=[
                {"children": [1, 2]},
                {"mesh": 0, "rotation": [0, 0, 1, 0], "scale": [2, 2, 2]},
                {"mesh": 0, "translation": [5, 0, 0]},
            ]
        ),
    ),
    "glb, placed by others": (
        ".glb",
        tetrahedron(
            **_CAMERA,
            scenes=[{"nodes": [0, 2]}],
            meshes=[*gltf()["meshes"], _POINTS],
            nodes=[
                {"camera": 0, "scale": [2, 2, 2], "children": [1]},
                {"mesh": 0, "rotation": [0, 0, 1, 0]},
                {"mesh": 1, "translation": [5, 0, 0], "children": [3]},
                {"mesh": 0},
            ],
        ),
    ),
    "glb, one view": (
        ".glb",
        tetrahedron(
            bufferViews=[{"buffer": 0, "byteLength": 72}],
            accessors__1__bufferView=0,
            accessors__1__byteOffset=48,
        ),
    ),
    "dae": (".dae", dae()),
    "dae, polygons": (
        ".dae",
        dae(
            faces='<polylist count="4"><input semantic="VERTEX" source="#v" offset="0"/><vcount>3 3 3 3</vcount><p>'
            + " ".join(str(k) for face in FACES for k in face)
            + "</p></polylist>"
        ),
    ),
    "dae, placed": (
        ".dae",
        dae(
            '<node><rotate>0 0 1 180</rotate><scale>2 2 2</scale><instance_geometry url="#g"/></node>'
        ),
    ),
}
"""Kind and content of valid files, by name."""

ENTITIES = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10 if k else "1 " * 10}">' for k in range(10))
_THREE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
_NODES = "<node>" * 50_000 + "</node>" * 50_000
WRONG: dict[str, tuple[bytes, str]] = {
    "obj: 250,000 faces": (
        _THREE + b"f 1 2 3\n" * 250_000,
        "has 250000 faces, allowed are up to 200000 .* pip install",
    ),
    "obj: corners from 0": (_THREE + b"f 0 1 2\n", "count corners from 0; .* add 1"),
    "obj: a corner that is not there": (_THREE + b"f 1 2 4\n", "corners that do not exist"),
    "obj: corners behind faces that count backwards": (
        _THREE + b"f -1 -2 -3\nv 0 0 1\n",
        "indices from 1",
    ),
    "obj: decimal commas": (b"v 0,5 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "could not be read as .obj"),
    "obj: an stl": (stl(4, _STL), "holds no triangles"),
    "obj: far away": (b"v 0 0 1e9\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite or above 1e6"),
    "stl: cut short": (stl(4, _STL)[:-1], "neither a whole binary file"),
    "stl: words cut short": (
        b"solid a\n" + _TWO[0],
        "neither a whole binary file nor a text from `solid` to `endsolid`",
    ),
    "ply: words cut short": (
        ply("ascii", 4, 4, _PLACES + _TEXT_FACES[:-8]),
        "cut short: it claims 8 lines of numbers but has 7",
    ),
    "ply: a billion": (ply("binary_little_endian", 10**9, 1, b""), "could not be read as .ply"),
    "ply: a corner below 0": (
        ply("ascii", 4, 4, _PLACES + _TEXT_FACES.replace(b"3 0", b"3 -1")),
        "corners that do not exist",
    ),
    "off: cut short": (b"OFF\n4 4 6\n" + _PLACES + _TEXT_FACES[:-8], "cut short"),
    "off: a page": (b"a page", "does not begin with OFF"),
    "glb: a view beyond the bytes": (
        tetrahedron(bufferViews__0__byteLength=10**9),
        "could not be read as .glb",
    ),
    "glb: another file": (
        tetrahedron(buffers__0__uri="/etc/passwd"),
        "refers to the file '/etc/passwd'",
    ),
    "glb: an address": (
        tetrahedron(buffers__0__uri="http://127.0.0.1/a"),
        "refers to the file 'http://127.0.0.1/a'",
    ),
    "glb: Draco": (
        tetrahedron(extensionsRequired=["KHR_draco_mesh_compression"]),
        "KHR_draco.* export it uncompressed",
    ),
    "glb: fans": (tetrahedron(meshes__0__primitives__0__mode=6), "triangle fans"),
    "dae: entities": (dae(head=f"<!DOCTYPE COLLADA [{ENTITIES}]>", faces="&e9;"), "DOCTYPE"),
    "dae: a circle": (
        dae('<node id="n"><instance_node url="#n"/></node>'),
        "could not be read as .dae",
    ),
    "dae: a skin": (
        dae('<node><instance_controller url="#c"/></node>'),
        "could not be read as .dae",
    ),
    "dae: nodes in one another": (dae(_NODES), "nested too deep|exit code"),
    "dae: not a number": (
        dae().replace(b"\n1 0 0", b"\nnan 0 0"),
        "coordinates that are not numbers",
    ),
    "dae: a corner below 0": (dae().replace(b"<p>0 0", b"<p>-1 0"), "corners that do not exist"),
    "dae: strided": (dae().replace(b'stride="3"', b'stride="4"'), "strided"),
}
"""Content and fragment of the message of wrong files, by kind and name."""
HEAVY = tetrahedron(
    accessors=[
        {"componentType": 5126, "count": 200_000_000, "type": "VEC3"},
        gltf()["accessors"][1],
    ]
)
"""A .glb of a few hundred bytes that stands for 2.4 GB of zeros."""
LONG = tetrahedron(meshes__0__primitives=gltf()["meshes"][0]["primitives"] * 50_000)
"""A .glb that trimesh reads for minutes."""
