"""Starts that a user adds to the comparison: objects of a module or a file, and saved models."""

from __future__ import annotations

import importlib
import inspect
import os
import pickle
import re
import sys
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle

from grasp_env.errors import InvalidInputError, shown
from grasp_env.force.initial import InitialForceRule
from grasp_env.inputs.arguments import AllFaults
from grasp_env.inputs.files import import_file
from policies import LearnedInitialForce
from training.evaluation.compare.starts import GIVEN_COLOURS, STARTS

START = "--start NAME=module:rule, NAME=file.py:rule or NAME=saved model's path"
_NAME = re.compile("[A-Za-z][A-Za-z0-9_-]{0,39}")


@dataclass(frozen=True)
class Given:
    """Starts of a user, ready to be sent to workers.

    Attributes:
        packed: starts by name, pickled; code from files is pickled by value, so other machines need
            no copy.
        names: pairs (name, origin as text).
    """

    packed: bytes
    names: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, starts: tuple[str, ...] = ()) -> Given:
        """Load and check all starts (texts of the form `START`) before anything runs.

        Raises:
            InvalidInputError: an invalid or used name, a missing object, or one that is no rule. It
                lists all of them.
        """
        origins = [(name, what) for name, _, what in (text.partition("=") for text in starts)]
        names = [name for name, _ in origins]
        with AllFaults() as check:
            check(_check_names, names)
            rules = {text.partition("=")[0]: check(_start, text) for text in starts}
        try:
            packed = cloudpickle.dumps(rules)
        except Exception as error:
            raise InvalidInputError(
                f"the starts {', '.join(names)} cannot be sent to the worker processes ({type(error).__name__}: "
                f"{str(error)[:200]}): leave open files, locks and the like out of them"
            ) from error
        return cls(packed, tuple(origins))

    def unpack(self) -> dict[str, InitialForceRule]:
        """Return the starts by name."""
        return pickle.loads(self.packed)


def _check_names(names: list[str]) -> None:
    if wrong := [name for name in names if not _NAME.fullmatch(name)]:
        raise InvalidInputError(
            f"a start needs a name of letters, digits, - and _, at most 40, a letter first, got "
            f"{', '.join(map(shown, wrong))}: give {START}"
        )
    taken = sorted({name for name in names if name in STARTS or names.count(name) > 1})
    if taken:
        raise InvalidInputError(
            f"the name {', '.join(taken)} is taken: choose another than {', '.join(sorted(STARTS))}, a different one for each"
        )
    if len(names) > len(GIVEN_COLOURS):
        raise InvalidInputError(
            f"a run compares at most {len(GIVEN_COLOURS)} starts of yours, got {len(names)}: make two runs"
        )


def model_path(what: str) -> Path | None:
    """Return the path of a saved model, in a folder of its only one; None if `what` is no model."""
    if os.path.isdir(what):
        stems = sorted(path.with_suffix("") for path in Path(what).glob("*.safetensors"))
        if len(stems) != 1:
            names = ", ".join(stem.name for stem in stems) or "no saved model"
            raise InvalidInputError(
                f"the folder {what} holds {names}: give the path of one that `grasp fit` saved, or {START}"
            )
        return stems[0]
    is_model = what.endswith((".json", ".safetensors")) or os.path.isfile(f"{what}.json")
    return Path(what) if is_model else None


def _start(text: str) -> Any:
    what = text.partition("=")[2]
    path = model_path(what)
    if path is not None:
        return LearnedInitialForce.load(path)
    if what and ":" not in what and not os.path.exists(what):
        raise InvalidInputError(
            f"--start {text}: no such file or saved model is there (nor {what}.json): give {START}"
        )
    rule = _read(text)
    if inspect.isclass(rule):
        try:
            rule = rule()
        except Exception as error:
            raise InvalidInputError(
                f"--start {text} is a class that cannot be made without arguments ({type(error).__name__}: {str(error)[:200]}): name an "
                "instance of it"
            ) from error
    if not callable(rule):
        raise InvalidInputError(
            f"--start {text} is no rule but of type {type(rule).__name__}: a rule takes (grasp, wrench) and returns an (N, 3) force"
        )
    return rule


def _read(text: str) -> Any:
    """Load the object that NAME=module:object or NAME=file.py:object names."""
    source, _, attribute = text.partition("=")[2].rpartition(":")
    if not source or not attribute:
        raise InvalidInputError(f"--start {text} names nothing: give {START}")
    module = _imported(source, f"--start {text}")
    try:
        return reduce(getattr, attribute.split("."), module)
    except AttributeError:
        callables = [
            key
            for key, value in vars(module).items()
            if callable(value) and not key.startswith("_")
        ]
        raise InvalidInputError(
            f"--start {text}: {source} has no {attribute!r}; it has {', '.join(callables[:20]) or 'nothing that can be called'}"
        ) from None


def _imported(source: str, context: str) -> ModuleType:
    """Import an installed module, one of the working directory, or a file (pickled by value)."""
    # as with `python -m`; at the end, where it hides no other module
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        if not source.endswith(".py"):
            return importlib.import_module(source)
        name = "given_" + re.sub(r"\W", "_", os.path.abspath(source))
        module = import_file(source, name)
        cloudpickle.register_pickle_by_value(module)
        return module
    except Exception as error:
        why = f"fails with {type(error).__name__}: {str(error)[:200]}"
        if isinstance(error, FileNotFoundError) or (
            isinstance(error, ModuleNotFoundError) and (error.name or "") in source
        ):
            why = "is not there: neither in the working directory nor installed"
        raise InvalidInputError(f"{context}: {source} {why}; give {START}") from error
