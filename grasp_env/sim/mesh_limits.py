"""Limits of mesh files, and the checks that enforce them."""

from __future__ import annotations

import numpy as np

from grasp_env._files import MEGABYTE

MAX_FACES = 200_000  # triangles of a mesh
MAX_CORNERS = 3 * MAX_FACES  # corners, including those of no face
MAX_PARTS = 4000  # mesh parts in a scene, which take 0.3 ms each
MAX_NODES = 10_000  # nodes in a scene
MAX_FACE_WORDS = 20 * MAX_FACES  # words in the faces of a text file, including indices of normals and textures
MAX_GLB_BYTES = 100 * MEGABYTE  # of a .glb file, with pictures


class TooManyFacesError(Exception):
    """Error for a mesh of more than `MAX_FACES` triangles, with their number as its argument."""


def check_face_count(faces: int) -> int:
    """Return a number of triangles; raise if it is above `MAX_FACES`."""
    if faces > MAX_FACES:
        raise TooManyFacesError(faces)
    return faces


def check_count(found: int, most: int, what: str) -> int:
    """Return a number of things in a file, such as "corners"; raise if it is above `most`."""
    if found > most:
        raise ValueError(f"it has {found} {what}, allowed are up to {most}")
    return found


def count_words(text: bytes) -> int:
    """Count the words of a text without splitting it."""
    letters = np.frombuffer(b" " + text, np.uint8)
    inside = (letters != 32) & (letters - np.uint8(9) > 4)  # white space is 32 and 9 to 13
    return int(np.count_nonzero(inside[1:] & ~inside[:-1]))
