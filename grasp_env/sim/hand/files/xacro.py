"""Expand xacro files to URDF, without ROS."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.extras import need
from grasp_env.inputs.files import MEGABYTE
from grasp_env.sim.objects.apart import apart
from grasp_env.sim.xml_files import read_xml

_SECONDS = 30.0
_MAX_MEMORY = 1000 * MEGABYTE  # longest time [s] and largest memory [bytes] to expand a file
# start of the tag of a xacro element, for any address of the namespace
_ELEMENT = re.compile(r"\{[^}]*xacro/?\}")


def robot_of(
    path: Path, first: Element, expand: bool | None, arguments: Mapping[str, str]
) -> Element:
    """Return the robot of a file with the element `first`; xacro expands it with `arguments`.

    `expand` says whether it is a xacro file; None: its name ends in .xacro.
    """
    if path.suffix.lower() == ".xacro" if expand is None else expand:
        return _expanded(path.absolute(), arguments)
    if arguments:
        raise InvalidInputError(
            "xacro_args are given, but it is not expanded: rename it to .xacro, or pass xacro=True"
        )
    if any(_ELEMENT.match(element.tag) for element in first.iter()):
        raise InvalidInputError(
            "it has xacro elements, but is not expanded: rename it to .xacro, or pass xacro=True"
        )
    return first


def _expanded(file: Path, arguments: Mapping[str, str]) -> Element:
    """Return the robot of a xacro file, expanded in a process without environment variables."""
    need("xacro")
    shares = [
        *_folders("ROS_PACKAGE_PATH"),
        *(str(Path(folder, "share")) for folder in _folders("AMENT_PREFIX_PATH")),
    ]
    request = json.dumps({"file": str(file), "arguments": dict(arguments), "shares": shares})
    task = "grasp_env.sim.hand.files.expansion:expand"
    where = f"xacro cannot expand {file}"
    try:
        result = apart(
            task,
            f"expanding {file.name}",
            _SECONDS,
            memory=_MAX_MEMORY,
            variables={},
            request=np.array(request),
        )
    except (TimeoutError, ChildProcessError) as error:
        raise InvalidInputError(f"{where}: {str(error).splitlines()[-1]}") from None
    if "error" in result:
        raise InvalidInputError(f"{where}: {result['error']}")
    robot = read_xml(result["text"].tobytes())
    if robot.find("link") is None:
        raise InvalidInputError(
            f"{file} only defines macros, it has no <link>; give the file that calls them"
        )
    return robot


def _folders(variable: str) -> list[str]:
    return [folder for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
