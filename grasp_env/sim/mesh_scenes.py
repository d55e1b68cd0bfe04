"""Guards of mesh files that place meshes in a scene, .glb and .dae; see `mesh_files`."""

from __future__ import annotations

import json
import re
import struct
from collections import Counter
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from grasp_env._files import read_xml
from grasp_env.sim.mesh_limits import check_count, check_face_count, count_words

_GLB, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_ITEM_BYTES = {
    "VEC3": {5126: 12},
    "SCALAR": {5121: 1, 5123: 2, 5125: 4},
}  # bytes of each type of corners and of indices
_TRIANGLES = 4
_COSMETIC = ("KHR_materials", "KHR_texture", "EXT_texture", "KHR_lights")  # extensions that do not change corners


def guard_glb(blob: bytes) -> tuple[bytes, int]:
    """Rewrite a .glb with the triangles that its scene shows, and count them."""
    magic, version, claimed, length, kind = struct.unpack_from("<5I", blob)
    if (magic, version, kind) != (_GLB, 2, _JSON):
        raise ValueError("it is not a binary glTF 2 file")
    check_count(length, "bytes of JSON")
    size, kind = struct.unpack("<II", blob[20 + length : 28 + length].ljust(8, b" "))
    if (claimed := max(claimed, 20 + length, 28 + length + size if kind == _BINARY else 0)) > len(blob):
        raise ValueError(f"it has {len(blob)} bytes but claims {claimed}")
    tree, data = json.loads(blob[20 : 20 + length]), blob[28 + length : 28 + length + (size if kind == _BINARY else 0)]
    needed = [name for name in tree.get("extensionsRequired", []) if not str(name).startswith(_COSMETIC)]
    if needed:
        raise ValueError(
            f"it needs the extension {str(needed[0])[:50]!r}, which is not supported; export it uncompressed"
        )
    kept = ("children", "mesh", "matrix", "translation", "rotation", "scale")
    nodes = [{key: node[key] for key in kept if key in node} for node in tree["nodes"]]
    roots, placed, parts, faces, corners = tree["scenes"][tree.get("scene", 0)]["nodes"], Counter[int](), 0, 0, 0
    seen, left = [0] * check_count(len(nodes), "nodes"), list(roots)
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
            parts = check_count(parts + times, "parts of meshes")
            if (mode := part.get("mode", _TRIANGLES)) < _TRIANGLES:  # points and lines
                continue
            place, count = arrays.take(part["attributes"]["POSITION"], "VEC3")
            corners = check_count(corners + times * count, "corners")
            made: dict[str, Any] = {"attributes": {"POSITION": place}, "mode": mode}
            if "indices" in part:
                made["indices"], count = arrays.take(part["indices"], "SCALAR")
            faces = check_face_count(faces + times * (count // 3 if mode == _TRIANGLES else count - 2))
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
        begin, start = (_non_negative(part, "byteOffset", 0) for part in (accessor, view))
        all_of = _non_negative(view, "byteLength")
        size = step * (count - 1) + width
        if start + all_of > len(self.data):
            raise ValueError(f"a bufferView ends at byte {start + all_of} of {len(self.data)}")
        if count == 0 or step < width or begin + size > all_of:
            raise ValueError(f"its accessor {number} claims {count} times {width} bytes of a bufferView of {all_of}")
        self.known[number, form] = len(self.accessors), count
        self.accessors.append({key: accessor[key] for key in ("componentType", "count", "type")})
        self.accessors[-1]["bufferView"] = len(self.views)
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": size, "byteStride": step})
        self.size = check_count(self.size + size, "bytes of corners and faces")
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


def guard_dae(blob: bytes) -> tuple[bytes, int]:
    """Rewrite a .dae with the triangles that its scene shows, and count them."""
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
        words = check_count(words + sum(map(_text_words, geometry.iter())), "numbers")
    faces = parts = 0
    for node in scenes[0].iter(_COLLADA + "instance_geometry"):
        if (url := node.get("url", "")[1:]) not in known:
            raise ValueError(f"it places {url[:50]!r}, which is not in it")
        new, groups, count = known[url]
        node.set("url", new)
        parts, faces = check_count(parts + groups, "parts of meshes"), check_face_count(faces + count)
    check_count(sum(1 for _ in scenes[0].iter(_COLLADA + "node")), "nodes")
    return ElementTree.tostring(root), faces


def _text_words(element: Element) -> int:
    return count_words((element.text or "").encode())


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
        return check_face_count(sum(corners) // 3)
    if _name(group) == "polylist":
        check_count(sum(map(_text_words, counts)), "polygons")
        corners, claimed = [int(word) for part in counts for word in (part.text or "").split()], sum(corners)
        if sum(corners) != claimed:
            raise ValueError(f"its faces claim {sum(corners)} corners but it has {claimed}")
    if min(corners, default=3) < 3:
        raise ValueError("it has faces of fewer than three corners")
    return check_face_count(sum(corners) - 2 * len(corners))


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
        check_count(_text_words(numbers) // 3, "corners")
        if (wrong := re.search(r"[^-+.0-9eE\s]|[0-9]{51}", numbers.text or "")) is not None:
            raise ValueError(f"it has {wrong[0][:20]!r} where numbers are expected")


def _name(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return element.tag.rpartition("}")[2]
