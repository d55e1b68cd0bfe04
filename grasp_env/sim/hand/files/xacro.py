"""Expand xacro files to URDF with xacrodoc, without ROS."""

from __future__ import annotations

import re
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from grasp_env._extras import need
from grasp_env._files import parsed, read_xml
from grasp_env.errors import GraspError, InvalidInputError
from grasp_env.sim.hand.files.meshes import PARENTS

_ELEMENT = re.compile(r"\{[^}]*xacro/?\}")  # start of the tag of a xacro element, for any address of the namespace


def is_xacro(path: Path, robot: Element) -> bool:
    """Return True if a file is named like a xacro file or has a xacro element."""
    return path.suffix == ".xacro" or any(_ELEMENT.match(element.tag) for element in robot.iter())


def expanded(path: Path) -> Element:
    """Return the robot of a xacro file, its arguments at their defaults.

    `$(find package)` searches the folders above the file and their siblings. Xacro evaluates expressions in the file, so read
    only files that you trust.
    """
    file = path.absolute()
    with need("xacro"):
        import xacro  # xacrodoc lets it find packages without ROS
        import xacrodoc
    xacrodoc.packages.reset()
    xacrodoc.packages.update_package_cache(_packages(file))
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            document: Any = xacro.process_file(str(file))
            robot = read_xml(document.toxml().encode())
    except Exception as error:  # xacro does not catch errors of expressions
        raise InvalidInputError(
            f"xacro cannot expand {file}: {' '.join(str(error).split()) or type(error).__name__}"
        ) from error
    if robot.find("link") is None:
        raise InvalidInputError(f"{file} only defines macros, it has no <link>; give the file that calls them")
    return robot


def _packages(file: Path) -> dict[str, str]:
    """Return the folders of ROS packages by name: those above the file and their siblings."""
    found = dict[str, str]()
    for folder in list(file.parents)[: PARENTS + 1]:
        for manifest in [folder / "package.xml", *sorted(folder.glob("*/package.xml"))]:
            with suppress(GraspError):  # missing, or not XML
                package = parsed(manifest, read_xml, InvalidInputError, str(manifest), "XML")
                found.setdefault(package.findtext("name", "").strip(), str(manifest.parent))
    return found
