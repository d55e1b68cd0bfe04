"""The site, which `make docs` builds, loads nothing from elsewhere, fits every window, and its
reference is complete."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from browser import browser, find_browser

pytest.importorskip("sphinx", reason="the extra docs is not installed")

from sphinx.util.inventory import InventoryFile

from grasp_env.task.disturbance import DISTURBANCES
from grasp_env.task.tasks import TASKS

ROOT = Path(__file__).parents[1]
MODULES = (
    *(
        f"grasp_env.{room}"
        for room in ("grasp", "force", "quality", "sim", "control", "env", "task", "config")
    ),
    "policies",
)
PUBLIC = [f"{module}.{name}" for module in MODULES for name in import_module(module).__all__]
WHOLE = ("grasp_env.errors", "grasp_env.grasp.presets", "grasp_env.grasp.wrench")
"""Modules without __all__: all their own classes and functions are public."""
INSIDE = {"grasp_env.errors.shown"}
PAGES = ("index.html", "mathematics.html", "api/force.html", "gallery/index.html", "search.html")

SHOWN_BY = {
    "grasp_env.force.ForceSolution": "grasp_env.force.optimize_force",
    "grasp_env.force.Status": "grasp_env.force.optimize_force",
    "policies.GraspForces": "policies.grasp_force",
    **{f"grasp_env.task.{kind.__name__}": "grasp_env.task.Task" for kind in TASKS.values()},
    **{
        f"grasp_env.task.{kind.__name__}": "grasp_env.task.DisturbanceSettings"
        for kind in DISTURBANCES.values()
    },
    "grasp_env.control.HandState": "grasp_env.control.HandController",
    "grasp_env.grasp.load_grasp": "grasp_env.grasp.save_grasp",
    **{
        f"grasp_env.grasp.presets.{name}": "grasp_env.grasp.presets.preset"
        for name in ("tripod", "five_finger_cuboid")
    },
    **{
        f"grasp_env.force.{name}": "grasp_env.force.FixedStep"
        for name in ("ArmijoStep", "ExactStep")
    },
}
"""Results, by the call that returns them, records, by their base, and variants, by the first: its
example shows them."""
NO_EXAMPLE = {"policies.Policy": "a protocol"}


def own(module: str) -> list[str]:
    """Return the public classes and functions that a module defines."""
    found = {
        name: value
        for name, value in vars(import_module(module)).items()
        if not name.startswith("_")
    }
    kinds = (inspect.isroutine, inspect.isclass)
    return [
        f"{module}.{name}"
        for name, value in found.items()
        if any(of(value) for of in kinds) and value.__module__ == module
    ]


PUBLIC += [name for module in WHOLE for name in own(module) if name not in INSIDE]


def thing(name: str) -> Any:
    module, _, last = name.rpartition(".")
    return getattr(import_module(module), last)


@pytest.fixture
def site():
    """Return the folder of the site as `make docs` has just built it."""
    folder = ROOT / "build/docs/html"
    assert folder.is_dir(), "the site is not built: run make docs, which also runs these tests"
    return folder


@pytest.mark.site
def test_every_public_name_has_an_entry(site):
    listed = InventoryFile.loads((site / "objects.inv").read_bytes(), uri="").data
    entries = {name for kind, names in listed.items() if kind.startswith("py:") for name in names}
    assert set(PUBLIC) <= entries, sorted(set(PUBLIC) - entries)


def documented(value: Any) -> str:
    """Return the docstring of its own, no inherited one."""
    return (
        inspect.cleandoc(vars(value).get("__doc__") or "")
        if inspect.isclass(value)
        else inspect.getdoc(value) or ""
    )


def members(value: type) -> Iterator[tuple[str, Any]]:
    """Yield the public methods and properties that a class defines itself."""
    for name, member in vars(value).items():
        called = member.__func__ if isinstance(member, staticmethod | classmethod) else member
        if not name.startswith("_") and (
            inspect.isfunction(called) or hasattr(called, "fget") or hasattr(called, "func")
        ):
            yield name, called


def takes(call: Callable[..., Any]) -> list[str]:
    return [name for name in inspect.signature(call).parameters if name not in ("self", "cls")]


def words(text: str) -> set[str]:
    return set(re.findall(r"\w+", text))


@pytest.mark.parametrize("name", PUBLIC)
def test_it_is_documented(name):
    value = thing(name)
    if not (inspect.isclass(value) or inspect.isroutine(value)):
        return  # a constant, see below
    text = documented(value)
    assert re.match(r".{15,}?[.:]\s", text + "\n", re.DOTALL), f"{name}: no summary"
    if inspect.isroutine(value):
        assert set(takes(value)) <= words(text), (
            f"{name}: {set(takes(value)) - words(text)} not documented"
        )
        return
    fields = (
        [field.name for field in dataclasses.fields(value) if field.init or field.repr]
        if dataclasses.is_dataclass(value)
        else []
    )
    fields += getattr(value, "_fields", ())
    constructor = vars(value).get("__init__")
    if inspect.isfunction(constructor) and not getattr(value, "_is_protocol", False):
        text += inspect.getdoc(constructor) or ""
        fields += takes(constructor)
    missing = {field for field in fields if not field.startswith("_")} - words(text)
    assert not missing, f"{name}: {missing} not documented"
    for member, call in members(value):
        said = inspect.getdoc(call) or ""
        assert said, f"{name}.{member}: no docstring"
        missing = set(takes(call)) - words(said) if inspect.isfunction(call) else set()
        assert not missing, f"{name}.{member}: {missing} not documented"


CONSTANTS = [
    name for name in PUBLIC if not (inspect.isclass(thing(name)) or inspect.isroutine(thing(name)))
]


@pytest.mark.site
def test_every_constant_is_explained(site):
    text = {page: page.read_text(encoding="utf-8") for page in (site / "api").glob("*.html")}
    for name in CONSTANTS:
        if inspect.ismodule(thing(name)):
            continue
        found = [
            re.search(rf'id="{re.escape(name)}".*?<dd>(.*?)</dd>', page, re.DOTALL)
            for page in text.values()
        ]
        said = next(re.sub(r"<[^>]+>", "", match.group(1)).strip() for match in found if match)
        assert len(said) > 15, name
        assert "Built-in" not in said, name


def has_example(name: str) -> bool:
    """Return True if the docstring of an object or of one of its members has an example."""
    value = thing(name)
    texts = [documented(value)]
    if inspect.isclass(value):
        texts += [inspect.getdoc(member) or "" for _, member in members(value)]
    return any(">>>" in text for text in texts)


def test_every_public_name_has_an_example_that_runs():
    for name in (*SHOWN_BY, *NO_EXAMPLE):
        assert name in PUBLIC, f"{name} needs no exception"
        assert not has_example(name), name
    for name in {*PUBLIC} - {*CONSTANTS, *NO_EXAMPLE}:
        error = inspect.isclass(thing(name)) and issubclass(thing(name), BaseException)
        assert error or has_example(SHOWN_BY.get(name, name)), name
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    rooms = re.search(r"^testpaths = (.*)$", settings, re.MULTILINE)
    assert rooms is not None
    assert "--doctest-modules" in settings
    assert {f'"{name.partition(".")[0]}"' for name in PUBLIC} <= set(
        re.findall(r'"\w+"', rooms.group(1))
    )


@pytest.mark.site
@pytest.mark.skipif(find_browser() is None, reason="there is no Chromium")
def test_it_fits_every_window_draws_formulas_finds_and_asks_for_nothing(site):
    with browser(find_browser() or "") as tab:
        for page, (width, scheme) in product(PAGES, ((390, "light"), (1280, "dark"))):
            tab.show(site / page, width, 800, prefers_color_scheme=scheme)
            assert tab.value("document.documentElement.scrollWidth") <= width, (page, width)
            colour = tab.value("getComputedStyle(document.body).backgroundColor")
            assert (sum(map(int, re.findall(r"\d+", colour)[:3])) < 200) == (scheme == "dark"), (
                page,
                colour,
            )
        tab.show(site / "mathematics.html", 1280, 800)
        assert tab.value("document.querySelectorAll('math').length") > 20
        heights = "[...document.querySelectorAll('.formula math')].map(m => m.getBoundingClientRect().height)"
        assert tab.value(f"Math.min(...{heights})") > 10
        tab.show(site / "search.html", 1280, 800)
        tab.value(
            "new Promise(done => { Search.performSearch('jacobian'); const wait = () =>"
            " /found|matching/.test(document.querySelector('.search-summary').innerText) ? done(true) : setTimeout(wait, 20);"
            " wait(); })"
        )
        assert tab.value(
            "[...document.querySelectorAll('#search-results li a')].some(a => a.href.includes('moving_contacts'))"
        )
        assert tab.errors == []
        assert [request for request in tab.requests if not request.startswith("file://")] == []
