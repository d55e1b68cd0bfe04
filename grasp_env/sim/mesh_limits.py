"""Limits of mesh files, and the checks that enforce them."""

from __future__ import annotations

import numpy as np

from grasp_env._files import MEGABYTE

MAX_FACES = 200_000  # triangles of a mesh
MOST = {  # of each thing in a file
    "corners": 3 * MAX_FACES,  # including those of no face
    "corners in text": 2 * MAX_FACES,  # of an .off or a .ply, which trimesh reads in 3 us each
    "words of faces": 20 * MAX_FACES,  # including indices of normals and textures
    "numbers": 40 * MAX_FACES,
    "polygons": MAX_FACES,
    "lines": 3_000_000,
    "properties": 100,
    "parts of meshes": 4000,  # in a scene, which take 0.3 ms each
    "nodes": 10_000,
    "bytes of JSON": 4 * MEGABYTE,
    "bytes of corners and faces": 100 * MEGABYTE,
}


class TooManyFacesError(Exception):
    """Error for a mesh of more than `MAX_FACES` triangles, with their number as its argument."""


def check_face_count(faces: int) -> int:
    """Return a number of triangles; raise if it is above `MAX_FACES`."""
    if faces > MAX_FACES:
        raise TooManyFacesError(faces)
    return faces


def check_count(found: int, what: str) -> int:
    """Return a number of things in a file; raise if it is above `MOST`."""
    if found > MOST[what]:
        raise ValueError(f"it has {found} {what}, allowed are up to {MOST[what]}")
    return found


def count_words(text: bytes) -> int:
    """Count the words of a text without splitting it."""
    letters = np.frombuffer(b" " + text, np.uint8)
    inside = (letters != 32) & (letters - np.uint8(9) > 4)  # white space is 32 and 9 to 13
    return int(np.count_nonzero(inside[1:] & ~inside[:-1]))
