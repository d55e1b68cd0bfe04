"""Mesh files: small valid ones of every kind, and hostile ones, which claim more than they hold or need too much.

As a program, it reads every hostile file under a memory limit and prints the outcomes as JSON.
"""

from __future__ import annotations

import json
import resource
import struct
import sys
import time
from typing import Any

MAX_MEMORY = 2**30
"""Address space that reading a file may take, besides that of the interpreter [bytes]."""

CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
_FLOATS = b"".join(struct.pack("<3f", *corner) for corner in CORNERS)
_NUMBERS = b"".join(struct.pack("<3H", *face) for face in FACES)
_PLACES = "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS).encode()
_PARAMS = "".join(f'<param name="{name}" type="float"/>' for name in "XYZ")
_NAMESPACE = "http://www.collada.org/2005/11/COLLADASchema"


def glb(tree: Any, data: bytes = b"") -> bytes:
    """Return a .glb of a JSON tree and its data."""
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
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
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}], "accessors": [corners, faces],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "buffers": [{"byteLength": 72}],
    }  # fmt: skip
    for path, value in changes.items():
        *parts, name = path.split("__")
        place: Any = tree
        for part in parts:
            place = place[int(part) if part.isdecimal() else part]
        place[name] = value
    return tree


def tetrahedron(**changes: Any) -> bytes:
    return glb(gltf(**changes), _FLOATS + _NUMBERS)


def dae(scene: str = '<node><instance_geometry url="#g"/></node>', faces: str = "", head: str = "") -> bytes:
    """Return a .dae of a tetrahedron, with `faces` in place of its <triangles> and `head` before the root."""
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


def ply(form: str, corners: int, faces: int, body: bytes, more: str = "", numbers: str = "uchar int") -> bytes:
    return (
        f"ply\nformat {form} 1.0\nelement vertex {corners}\nproperty float x\nproperty float y\nproperty float z\n{more}"
        f"element face {faces}\nproperty list {numbers} vertex_indices\nend_header\n"
    ).encode() + body


def stl(count: int, body: bytes) -> bytes:
    return bytes(80) + struct.pack("<I", count) + body


_TEXT_FACES = "".join("3 {} {} {}\n".format(*face) for face in FACES).encode()
_STL = b"".join(struct.pack("<12fH", 0, 0, 1, *(x for k in face for x in CORNERS[k]), 0) for face in FACES)
VALID: dict[str, tuple[str, bytes]] = {
    "obj": (".obj", b"mtllib a.mtl\n" + _PLACES.replace(b"\n", b"\nv ").join((b"v ", b"")).removesuffix(b"v ")
            + b"vt 0 0\nvn 0 0 1\nf 1/1/1 3/1/1 2/1/1\nf 1//1 2//1 4//1\nf -4 -1 -2\nf 2 3 4 # last\n"),
    "stl": (".stl", stl(4, _STL)),
    "stl of words": (".stl", b"solid a\n" + b"".join(
        b"facet normal 0 0 1\n outer loop\n" + b"".join(b"  vertex %d %d %d\n" % CORNERS[k] for k in face) + b" endloop\nendfacet\n"
        for face in FACES) + b"endsolid a\n"),
    "ply of words": (".ply", ply("ascii", 4, 4, _PLACES + _TEXT_FACES)),
    "ply": (".ply", ply("binary_little_endian", 4, 4, _FLOATS + b"".join(struct.pack("<B3i", 3, *face) for face in FACES))),
    "ply, the other order": (".ply", ply(
        "binary_big_endian", 4, 4, b"".join(struct.pack(">3f", *corner) for corner in CORNERS)
        + b"".join(struct.pack(">B3i", 3, *face) for face in FACES))),
    "off": (".off", b"OFF # a comment\n4 4 6\n" + _PLACES + _TEXT_FACES),
    "glb": (".glb", tetrahedron()),
    "glb, placed": (".glb", tetrahedron(nodes=[{"children": [1, 2]}, {"mesh": 0, "rotation": [0, 0, 1, 0], "scale": [2, 2, 2]},
                                               {"mesh": 0, "translation": [5, 0, 0]}])),
    "glb, one view": (".glb", tetrahedron(bufferViews=[{"buffer": 0, "byteLength": 72}], accessors__1__bufferView=0, accessors__1__byteOffset=48)),
    "dae": (".dae", dae()),
    "dae, polygons": (".dae", dae(faces='<polylist count="4"><input semantic="VERTEX" source="#v" offset="0"/><vcount>3 3 3 3</vcount><p>'
                                  + " ".join(str(k) for face in FACES for k in face) + "</p></polylist>")),
    "dae, placed": (".dae", dae('<node><rotate>0 0 1 180</rotate><scale>2 2 2</scale><instance_geometry url="#g"/></node>')),
}  # fmt: skip
"""Kind and content of valid files, by name."""


ENTITIES = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10 if k else "1 " * 10}">' for k in range(10))
HOSTILE: dict[str, tuple[str, bytes, str]] = {
    "obj: 250,000 faces": (".obj", b"v 0 0 0\n" + b"f 1 2 3\n" * 250_000, "250000 faces"),
    "obj: a polygon of a million corners": (".obj", b"v 0 0 0\nf " + b"1 " * 1_000_000, "999998 faces"),
    "obj: corners": (".obj", b"v 0 0 0\n" * 1_000_000, "1000000 corners"),
    "obj: empty lines": (".obj", b"\n" * 4_000_000, "4000000 lines"),
    "obj: a number of a million digits": (".obj", b"v 0 0 " + b"1" * 1_000_000, "more than 50 characters"),
    "obj: an index of 0": (".obj", b"v 0 0 0\nf 0 1 1\n", "do not exist"),
    "obj: corners behind faces that count backwards": (".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -3\nv 0 0 1\n", "indices from 1"),
    "obj: the most corners and faces": (".obj", b"v 0.000000000001 0.00000000001 0\n" * 600_000 + b"f 1 2 3\n" * 199_998 + b"f 1 2 3 4\n", "^$"),
    "stl: claims more": (".stl", stl(2**32 - 1, bytes(500)), "claims 4294967295 triangles"),
    "stl: 300,000 faces": (".stl", stl(300_000, bytes(15_000_000)), "300000 faces"),
    "stl: half a triangle": (".stl", b"solid\nvertex 0 0 0\nvertex 0 0 0\n", "multiple of three"),
    "ply: corners that are not there": (".ply", ply("ascii", 1000, 4, b"0 0 0\n"), "claims 1004 lines of numbers but has 1"),
    "ply: a billion": (".ply", ply("binary_little_endian", 10**9, 1, b""), "1000000000 corners"),
    "ply: a list that is not there": (".ply", ply("binary_little_endian", 1, 1, bytes(12) + b"\xff" * 4, numbers="int uchar"), "not integers >= 0"),
    "ply: a header without an end": (".ply", b"ply\nformat ascii 1.0\n" + b"comment\n" * 250_000, "no header within 100000 bytes"),
    "ply: elements before": (".ply", ply("ascii", 1, 1, b"0 0 0\n").replace(b"element vertex", b"element other 999999999999\nproperty float x\nelement vertex"), "no header .* element vertex"),
    "ply: faces of three and four corners": (".ply", ply("binary_little_endian", 4, 2, _FLOATS + struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)), "triangulate it"),
    "off: a face that is not there": (".off", b"OFF\n1 1 0\n0 0 0\n9999999 0\n", "fewer numbers"),
    "glb: points without bytes": (".glb", tetrahedron(accessors=[{"componentType": 5126, "count": 120_000_000, "type": "VEC3"}, gltf()["accessors"][1]]), "accessor 0 is sparse, empty"),
    "glb: a view beyond the bytes": (".glb", tetrahedron(bufferViews__0__byteLength=10**9), "ends at byte 1000000000"),
    "glb: below 0": (".glb", tetrahedron(bufferViews__0__byteOffset=-8), "not an integer >= 0"),
    "glb: a stride of 0 bytes": (".glb", tetrahedron(bufferViews__0__byteStride=1), "claims"),
    "glb: another file": (".glb", tetrahedron(buffers__0__uri="/etc/passwd"), "another file"),
    "glb: Draco": (".glb", tetrahedron(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco"),
    "glb: a circle": (".glb", tetrahedron(nodes=[{"mesh": 0, "children": [0]}]), "child of two nodes or of itself"),
    "glb: 50,000 parts": (".glb", tetrahedron(meshes__0__primitives=gltf()["meshes"][0]["primitives"] * 50_000), "4001 parts"),
    "glb: views of one byte many times": (".glb", glb(gltf(accessors=[{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}] * 4000, meshes=[{"primitives": [{"attributes": {"POSITION": k}} for k in range(4000)]}], bufferViews=[{"buffer": 0, "byteLength": 900_000, "byteStride": 250_000}]), bytes(900_000)), "bytes of corners"),
    "glb: long JSON": (".glb", glb(b"[" * 5_000_000), "5000000 bytes of JSON"),
    "glb: a long file": (".glb", tetrahedron()[:8] + b"\xff" * 4 + tetrahedron()[12:], "claims 4294967295"),
    "dae: entities": (".dae", dae(head=f"<!DOCTYPE COLLADA [{ENTITIES}]>", faces="&e9;"), "DOCTYPE"),
    "dae: a circle": (".dae", dae('<node id="n"><instance_node url="#n"/></node>'), "<instance_node>, which is not supported"),
    "dae: nodes in one another": (".dae", dae("<node>" * 50_000 + "</node>" * 50_000), "nested too deep|50000 nodes"),
    "dae: not a number": (".dae", dae().replace(b"\n1 0 0", b"\nnan 0 0"), "'n' where numbers are expected"),
    "dae: a corner below 0": (".dae", dae().replace(b"<p>0 0", b"<p>-1 0"), "do not exist: '-1"),
    "dae: 300,000 faces": (".dae", dae(faces=f'<triangles><input semantic="VERTEX" source="#v" offset="0"/><p>{"1 " * 900_000}</p></triangles>'), "300000 faces"),
    "dae: claims more": (".dae", dae().replace(b'count="12"', b'count="2000000000"'), "^$"),
    "dae: an input far away": (".dae", dae(faces='<triangles><input semantic="VERTEX" source="#v" offset="4000000000"/><p>0 1 2</p></triangles>'), "more than 16 inputs"),
}  # fmt: skip
"""Kind, content and fragment of the message of hostile files, by name; "^$" if it is a mesh after all."""


def outcome(kind: str, blob: bytes) -> tuple[str, float]:
    """Read a file; return the error message, "" for a mesh, and the time [s]."""
    from grasp_env.errors import InvalidInputError
    from grasp_env.sim.mesh_files import read_mesh_bytes

    begun = time.process_time()
    try:
        read_mesh_bytes(blob, kind, "it")
        told = ""
    except InvalidInputError as error:
        told = str(error)
    return told, time.process_time() - begun


def main() -> None:
    """Print the outcome of each hostile file."""
    outcome(*VALID["obj"])  # imports
    with open("/proc/self/statm") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MAX_MEMORY, resource.RLIM_INFINITY))
    json.dump({name: outcome(kind, blob) for name, (kind, blob, _) in HOSTILE.items()}, sys.stdout)


if __name__ == "__main__":
    main()
