"""Open a hand's file, and read the part of it that is the hand."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

from grasp_env._check import AllFaults
from grasp_env._extras import need
from grasp_env._files import parsed, read_xml, shown_path
from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.files.elements import FileJoint, FileLink, HandFile, names_of
from grasp_env.sim.hand.files.part import Part, check_mimics, find_part, find_root
from grasp_env.sim.hand.files.urdf import UrdfReader


def open_file(path: str | os.PathLike[str], tips: tuple[str, ...]) -> HandFile:
    """Return the reader of a file, chosen by its first element."""
    first: Element = parsed(path, read_xml, InvalidInputError, f"the file {shown_path(path)}", "XML")
    if first.tag == "robot":
        return UrdfReader(path, first)
    if first.tag == "mujoco":
        with need("mujoco"):
            from grasp_env.sim.hand.files.mjcf import MjcfReader
        return MjcfReader(path, tips)
    raise InvalidInputError(
        f"the first element is <{first.tag[:40]}>; a URDF starts with <robot name=...>, a MuJoCo model with <mujoco>"
    )


def read_part(
    file: HandFile, palm: str | None, tips: Mapping[str, Any]
) -> tuple[Part, dict[str, FileLink], list[FileJoint]]:
    """Return the part of a file that is the hand, its links by name and its joints.

    Raises:
        InvalidInputError: The file or the palm is not a hand; or the part is faulty, with a list of all faults.
    """
    root, fault = "", None
    try:
        root = find_root(file.names, file.ends)
    except InvalidInputError as error:
        fault = error
    part = Part(root, tuple(file.names))
    if fault is None:
        part = find_part(root, file.ends, file.fixed, file.mimics, palm)
    kept = set(part.links)
    inside = {joint for joint, parent, child in file.ends if parent in kept and child in kept}
    mimics = {joint: other for joint, other in file.mimics.items() if joint in inside}
    with AllFaults() as check:
        elements = check(file.elements, kept)
        if fault is not None:
            check.add(fault)
        check(_known, tips, file.names, part)
        check(check_mimics, file.ends, file.fixed, mimics)
    return part, *elements


def _known(tips: Mapping[str, Any], links: Sequence[str], part: Part) -> None:
    """Check that every fingertip is a link of the hand."""
    missing = [tip for tip in tips if tip not in links]
    if missing:
        raise InvalidInputError(f"no link is called {', '.join(map(repr, missing))}; links are {names_of(links)}")
    left = [tip for tip in tips if tip not in part.links]
    if left:
        raise InvalidInputError(
            f"the palm {part.root!r} does not carry the fingertips {names_of(left)}; its links are {names_of(part.links)}"
        )
