"""Draws docs/static/rooms.svg: the rooms of the code, from its imports and includes.

python -m docs.rooms
"""

from __future__ import annotations

import ast
import re
import sys
from functools import cache
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).parents[1]
HEADERS = ROOT / "grasp_env/core/include/grasp"
PICTURE = ROOT / "docs/static/rooms.svg"
PACKAGES = ("grasp_env", "policies", "training", "benchmarks")
WHOLE = {"policies", "benchmarks"}
"""Packages that are one room."""
DOORS = ("", "__main__")
"""Modules outside the rooms: the package itself and `python -m`."""
JOURNEYS = {
    1: ("force", "inputs", "grasp", "core", "optimizer", "newton", "phi"),
    2: ("env", "control", "sim", "core", "hand", "optimizer"),
    3: ("program", "evaluation", "env", "force"),
}
"""Rooms on the three ways that docs/architecture.md describes, by number."""
WIDTH, BOX, HEIGHT, STEP = 1180, 88, 30, 66
"""Width of the picture, width and height of a room, distance between rows [pixels]."""


@cache
def tree(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path) -> set[str]:
    """Return the absolute names that a file imports, in functions and for type checking too."""
    names: set[str] = set()
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = [node.module] if node.module else []
            base = ".".join([*package[: len(package) + 1 - node.level], *module])
            start = base if node.level else str(node.module)
            names.update(f"{start}.{alias.name}" for alias in node.names)
            names.add(start)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "import_module":
            literals = [a for a in node.args if isinstance(a, ast.Constant)]
            names.update(str(literal.value) for literal in literals)
    return names


def files(*parts: str) -> list[Path]:
    """Return the Python files of a package."""
    return sorted((ROOT / Path(*parts)).rglob("*.py"))


def modules(package: str) -> dict[str, Path]:
    """Return the files of a package by module name."""
    parts = {path.relative_to(ROOT).with_suffix("").parts: path for path in files(package)}
    return {
        ".".join(names[:-1] if names[-1] == "__init__" else names): path
        for names, path in parts.items()
    }


def module_arrows(*packages: str) -> dict[str, set[str]]:
    """Return the modules of packages that each of their modules imports.

    `from room import module` means the module.
    """
    paths = {name: path for package in packages for name, path in modules(package).items()}
    arrows = {}
    for name, path in paths.items():
        imported = imports(path) & set(paths)
        parents = {
            one for one in imported if any(other.startswith(f"{one}.") for other in imported)
        }
        direct = {
            str(node.module)
            for node in ast.walk(tree(path))
            if isinstance(node, ast.ImportFrom)
            and any(f"{node.module}.{alias.name}" not in paths for alias in node.names)
        }
        arrows[name] = imported - (parents - direct) - {name}
    return arrows


def header_arrows() -> dict[str, set[str]]:
    """Return the headers that each header of the core includes, as paths below `grasp/`."""
    include = re.compile(r"#include <grasp/([^>]+)>")
    return {
        str(path.relative_to(HEADERS)): set(include.findall(path.read_text(encoding="utf-8")))
        for path in HEADERS.rglob("*.hpp")
    }


def python_rooms() -> dict[str, set[str]]:
    """Return the rooms that each room of Python imports."""

    def room(module: str) -> str:
        package, _, rest = module.partition(".")
        return package if package in WHOLE else rest.partition(".")[0]

    rooms: dict[str, set[str]] = {}
    for name, targets in module_arrows(*PACKAGES).items():
        here = room(name)
        if here not in DOORS:
            rooms.setdefault(here, set()).update(map(room, targets))
    return {here: others - {here, *DOORS} for here, others in rooms.items()}


def core_rooms() -> dict[str, set[str]]:
    """Return the folders and public headers that each of the core includes."""
    rooms: dict[str, set[str]] = {}
    for name, targets in header_arrows().items():
        here = name.partition("/")[0]
        rooms.setdefault(here, set()).update(target.partition("/")[0] for target in targets)
    return {here: others - {here} for here, others in rooms.items()}


def needed(rooms: dict[str, set[str]]) -> dict[str, set[str]]:
    """Leave out the arrows that follow from others."""

    def below(room: str) -> set[str]:
        return rooms[room].union(*map(below, rooms[room]))

    return {
        room: others - set().union(*map(below, others)) if others else set()
        for room, others in rooms.items()
    }


def rows(rooms: dict[str, set[str]]) -> list[list[str]]:
    """Return the rooms in rows, the lowest first: each stands above all that it uses."""

    @cache
    def rank(room: str) -> int:
        return 1 + max(map(rank, rooms[room]), default=-1)

    count = 1 + max(map(rank, rooms))
    return [sorted(room for room in rooms if rank(room) == level) for level in range(count)]


def column(rooms: dict[str, set[str]], title: str, left: float, right: float, floor: int) -> str:
    """Draw the rooms between two positions [pixels], the lowest row at `floor`."""
    arrows = needed(rooms)
    at: dict[str, tuple[float, float]] = {}
    parts: list[str] = []
    for level, names in enumerate(rows(rooms)):
        gap = (right - left) / len(names)
        for place, name in enumerate(names):
            at[name] = left + gap * (place + 0.5), floor - STEP * level
    for name, others in arrows.items():
        for other in sorted(others):
            (x1, y1), (x2, y2) = at[name], at[other]
            parts.append(
                f'<path d="M{x1:.0f} {y1 + HEIGHT / 2:.0f} C{x1:.0f} {y1 + STEP * 0.6:.0f} '
                f'{x2:.0f} {y2 - STEP * 0.6:.0f} {x2:.0f} {y2 - HEIGHT / 2 - 5:.0f}"/>'
            )
    for name, (x, y) in at.items():
        numbers = "".join(str(number) for number, stops in JOURNEYS.items() if name in stops)
        parts.append(
            f'<rect x="{x - BOX / 2:.0f}" y="{y - HEIGHT / 2:.0f}" width="{BOX}" '
            f'height="{HEIGHT}" rx="5"/><text x="{x:.0f}" y="{y + 5:.0f}">{escape(name)}</text>'
        )
        if numbers:
            parts.append(
                f'<text class="way" x="{x + BOX / 2 + 2:.0f}" y="{y - 8:.0f}">{numbers}</text>'
            )
    middle = (left + right) / 2
    parts.append(f'<text class="title" x="{middle:.0f}" y="{floor + 46}">{escape(title)}</text>')
    return "\n".join(parts)


def picture() -> str:
    """Return the picture as SVG."""
    python = python_rooms()
    core = core_rooms()
    floor = 30 + STEP * max(len(rows(python)) - 1, len(rows(core)) - 1)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {floor + 60}">
<style>
svg {{ background: #ffffff; font: 14px sans-serif; }}
rect {{ fill: #eef3f9; stroke: #0b5394; }}
path {{ fill: none; stroke: #8a97a8; marker-end: url(#head); }}
text {{ text-anchor: middle; fill: #101010; }}
.way {{ text-anchor: start; font-size: 11px; fill: #b3402d; }}
.title {{ font-weight: bold; }}
</style>
<defs><marker id="head" viewBox="0 0 6 6" refX="3" refY="3" markerWidth="6" markerHeight="6"
orient="auto"><path d="M0 0L6 3L0 6z" style="fill:#8a97a8;stroke:none;marker-end:none"/>
</marker></defs>
{column(python, "Python", 0, WIDTH * 0.54, floor)}
{column(core, "core: folders and public headers of grasp/", WIDTH * 0.56, WIDTH, floor)}
</svg>
"""


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
    sys.stdout.write(f"{PICTURE.relative_to(ROOT)}\n")
