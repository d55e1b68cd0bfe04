"""Start rules in files, which an installed package reads."""

from __future__ import annotations

from importlib.metadata import entry_points
from os.path import isfile

from grasp_env.errors import MissingExtraError
from grasp_env.force.initial import InitialForceRule

READERS = "grasp_force.starts"
"""Group of entry points of packages: functions that read a rule from a path."""
_SUFFIXES = (".json", ".safetensors")


def is_saved(name: str) -> bool:
    """Return True for the path of a saved rule, with or without the suffix of one of its files."""
    return name.endswith(_SUFFIXES) or isfile(f"{name}.json")


def saved_rule(path: str) -> InitialForceRule:
    """Read a saved rule.

    Raises:
        ModelFileError: the file is missing, damaged or of another version.
        MissingExtraError: the package that reads it is not installed.
    """
    for entry in entry_points(group=READERS):
        return entry.load()(path)
    raise MissingExtraError(
        f"no installed package reads the start {path!r}: install grasp-force by pip, not from its sources alone"
    )
