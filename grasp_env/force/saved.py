"""Start rules in files, which an installed package reads."""

from __future__ import annotations

from importlib.metadata import entry_points
from os.path import isfile

from grasp_env.errors import MissingExtraError
from grasp_env.force.initial import NAMES, InitialForceRule

READERS = "grasp_force.starts"
"""Group of the entry point that reads a rule from a path."""
_SUFFIXES = (".json", ".safetensors")


def is_saved(name: str) -> bool:
    """Return True for the path of a saved rule, with or without the suffix of one of its files.

    Names of rules come first, whatever files there are. A text with a slash is a path, also of a
    missing file.

    Example:
        >>> is_saved("runs/fit/mine"), is_saved("mine.json"), is_saved("previous"), is_saved("typo")
        (True, True, False, False)
    """
    if name in NAMES:
        return False
    return "/" in name or "\\" in name or name.endswith(_SUFFIXES) or isfile(f"{name}.json")


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
