"""Starts that a user brings to the comparison by name: a callable of a module or a file, a saved model, an object from Python."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import os
import pickle
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle

from grasp_env._check import together
from grasp_env.errors import InvalidInputError, shown
from grasp_env.force import RULES, InitialForceRule, Objective
from policies import LearnedInitialForce
from training.cases.start_table import GIVEN_COLOURS, STARTS, Named

HOW = "NAME=module:rule, NAME=file.py:rule or NAME=saved model's path"
"""What a text may be."""
_NAME = re.compile("[A-Za-z][A-Za-z0-9_-]{0,39}")
_TAKEN = {*STARTS, "case", "optimum", "basis", "path", "reduced_flow", "newton"}
"""Names under which a run's arrays hold something else."""


@dataclass(frozen=True)
class Given:
    """The starts that a run was given, as its workers get them.

    Attributes:
        texts: each as `HOW` says; every process reads them for itself.
        objects: {name: rule} of Python, pickled, functions of a notebook too.
    """

    texts: tuple[str, ...] = ()
    objects: bytes = b""

    @classmethod
    def of(cls, texts: tuple[str, ...], starts: Mapping[str, Any] | None = None) -> Given:
        """Checked before anything runs.

        Args:
            texts: each as `HOW` says.
            starts: {name: rule, or a saved model's path}.

        Raises:
            InvalidInputError: a name that is none or is taken, what is not there, or is no rule; all faults at once.
        """
        paths = {name: os.fspath(made) for name, made in (starts or {}).items() if isinstance(made, str | os.PathLike)}
        texts = (*texts, *(f"{name}={path}" for name, path in paths.items()))
        objects = {name: made for name, made in (starts or {}).items() if name not in paths}
        names = [*(text.partition("=")[0] for text in texts), *objects]
        together(
            lambda: _check_names(names),
            *(lambda text=text: _read(text) for text in texts),
            *(lambda name=name: _rule(objects[name], name) for name in objects),
        )
        try:
            return cls(
                texts,
                cloudpickle.dumps({name: _rule(made, name) for name, made in objects.items()}) if objects else b"",
            )
        except Exception as error:
            raise InvalidInputError(
                f"the starts {', '.join(objects)} cannot be sent to the worker processes ({type(error).__name__}: {str(error)[:200]}): "
                "leave open files, locks and the like out of them"
            ) from error

    def rules(self, objective: Objective) -> dict[str, InitialForceRule]:
        """By name: rules of the package that `STARTS` has no row for, then the texts', then those from Python."""
        known = {row.how.name for row in STARTS.values() if isinstance(row.how, Named)}
        own = {name: rule(objective) for name, rule in RULES.items() if name not in known}
        read = {text.partition("=")[0]: _read(text) for text in self.texts}
        return {**own, **read, **(pickle.loads(self.objects) if self.objects else {})}

    def said(self) -> dict[str, str]:
        """What stands behind each name, for the run's files."""
        objects = pickle.loads(self.objects) if self.objects else {}
        return {text.partition("=")[0]: text.partition("=")[2] for text in self.texts} | {
            name: f"{type(made).__module__}.{getattr(made, '__qualname__', type(made).__qualname__)}"
            for name, made in objects.items()
        }


def _check_names(names: list[str]) -> None:
    wrong = [name for name in names if not _NAME.fullmatch(name)]
    if wrong:
        raise InvalidInputError(
            f"a start needs a name of letters, digits, - and _, at most 40, a letter first, got {', '.join(map(shown, wrong))}: "
            f"give {HOW}"
        )
    taken = sorted({name for name in names if name in _TAKEN or names.count(name) > 1})
    if taken:
        raise InvalidInputError(
            f"the name {', '.join(taken)} is taken: choose another than {', '.join(sorted(_TAKEN))}, a different one for each start"
        )
    if len(names) > len(GIVEN_COLOURS):
        raise InvalidInputError(
            f"a run compares at most {len(GIVEN_COLOURS)} starts of yours, got {len(names)}: make two runs"
        )


def model_path(what: str) -> Path | None:
    """The saved model that a text means, a folder's only one; None: it means none."""
    if os.path.isdir(what):
        stems = sorted(path.with_suffix("") for path in Path(what).glob("*.safetensors"))
        if len(stems) != 1:
            held = f"holds {', '.join(stem.name for stem in stems)}" if stems else "holds no saved model"
            raise InvalidInputError(f"the folder {what} {held}: give the path of one that `grasp fit` saved, or {HOW}")
        return stems[0]
    return Path(what) if what.endswith((".json", ".safetensors")) or os.path.isfile(f"{what}.json") else None


def _read(text: str) -> InitialForceRule:
    """What a text means."""
    name, _, what = text.partition("=")
    path = model_path(what)
    if path is not None:
        return LearnedInitialForce.load(path)
    place, _, attribute = what.rpartition(":")
    if what and not place and not os.path.exists(what):
        raise InvalidInputError(
            f"--start {text}: no such file or saved model is there ({what}.json is missing, too): give {HOW}"
        )
    if not place or not attribute:
        raise InvalidInputError(f"--start {text} is no start: give {HOW}")
    module = _imported(place, text)
    try:
        found = reduce(getattr, attribute.split("."), module)
    except AttributeError:
        callables = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise InvalidInputError(
            f"--start {text}: {place} has no {attribute!r}; it has {', '.join(callables[:20]) or 'nothing that can be called'}"
        ) from None
    return _rule(found, f"{name}={what}")


def _imported(place: str, text: str) -> ModuleType:
    """A module of the working directory or installed, or a file."""
    if os.getcwd() not in sys.path:  # as `python -m` has it; at the end, where it hides nothing
        sys.path.append(os.getcwd())
    try:
        if not place.endswith(".py"):
            return importlib.import_module(place)
        name = "start_of_" + re.sub(r"\W", "_", os.path.abspath(place))
        spec = importlib.util.spec_from_file_location(name, place)
        assert spec is not None
        assert spec.loader is not None
        module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up there
        spec.loader.exec_module(module)
        return module
    except Exception as error:
        missing = isinstance(error, FileNotFoundError) or (
            isinstance(error, ModuleNotFoundError) and (error.name or "") in place
        )
        why = (
            "is not there: neither in the working directory nor installed"
            if missing
            else f"fails with {type(error).__name__}: {str(error)[:200]}"
        )
        raise InvalidInputError(f"--start {text}: {place} {why}; give {HOW}") from error


def _rule(made: Any, what: str) -> InitialForceRule:
    """A rule of a callable; a class is called without arguments."""
    if inspect.isclass(made):
        try:
            made = made()
        except Exception as error:
            raise InvalidInputError(
                f"the start {what} is a class that cannot be made without arguments ({type(error).__name__}: {str(error)[:200]}): "
                "name an instance of it"
            ) from error
    if not callable(made):
        raise InvalidInputError(
            f"the start {what} is no rule but of type {type(made).__name__}: a rule takes (grasp, wrench) and returns an (N, 3) force"
        )
    rule: Callable[..., Any] = made
    return rule
