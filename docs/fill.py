"""The measured tables of README.md and of the pages: filled in from saved runs, so that no number is typed by hand.

python -m docs.fill                 writes every block <!-- results: NAME --> ... <!-- /results --> anew
python -m docs.fill --check         names the blocks that differ from the saved runs; exit code 1
python -m docs.fill --save FILE...  keeps what the tables need of a run's metrics.json or rl.json, or a benchmark's JSON

A table is a function of `TABLES`, what it reads of a run is a path of `KEPT`, both in tables.py. The runs lie in docs/results.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from docs.tables import KEPT, RESULTS, RUN, TABLES
from grasp_env._files import replacing

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"(<!-- results: (\w+) -->\n)(.*?)(<!-- /results -->)", re.DOTALL)


def pruned(tree: Any, paths: Sequence[tuple[str, ...]]) -> Any:
    """What lies on the paths; numbers with six digits, files without their folders.

    Example:
        >>> pruned({"a": {"x": 1, "y": 2.00000004}, "b": 3}, [("a|c", "y")])
        {'a': {'y': 2.0}}
    """
    if any(path == () or path[0] == "**" for path in paths) or not isinstance(tree, (dict, list)):
        return _short(tree)
    if isinstance(tree, list):
        below = [path[1:] for path in paths if path[0] == "*"]
        return [pruned(part, below) for part in tree]
    kept = {}
    for key, value in tree.items():
        below = [path[1:] for path in paths if any(_fits(key, part) for part in path[0].split("|"))]
        if below:
            kept[key] = pruned(value, below)
    return kept


def _fits(key: str, part: str) -> bool:
    return re.fullmatch(part.replace("*", ".*"), key) is not None


def _short(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _short(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_short(part) for part in tree]
    if isinstance(tree, str):  # a path says something about one machine only
        return re.sub(r"(?<!\S)/\S*/(?=\S)", "", tree)
    return float(f"{tree:.6g}") if isinstance(tree, float) else tree


def save(path: Path) -> str:
    """Keeps what the tables need of a run's file; the name that it has in docs/results."""
    tree = json.loads(path.read_text(encoding="utf-8"))
    named = {"training": "rl", "table_one": "reproduce"}  # runs that do not say of what kind they are
    kind = tree.get("kind") or tree.get("run", {}).get("kind")
    kind = kind or next((kind for key, kind in named.items() if key in tree), None)
    name = "env_speed" if kind == "env" and "rows" in tree else {"env": "hold"}.get(kind, kind)
    if name not in KEPT:
        raise SystemExit(f"{path} is a run of {kind!r}; tables are made of {', '.join(KEPT)}")
    if tree.get("quick") or tree.get("run", {}).get("quick"):
        raise SystemExit(f"{path} is a quick run, whose numbers are not quoted: run it in full")
    RESULTS.mkdir(exist_ok=True)
    with replacing(RESULTS / f"{name}.json") as target:
        text = json.dumps(pruned(tree, (RUN, *KEPT[name])), indent=1, allow_nan=False)
        target.write_text(text + "\n", encoding="utf-8")
    return name


def filled(text: str) -> tuple[str, list[str]]:
    """The text with its blocks made anew, and the names of those that changed."""
    changed = []

    def block(match: re.Match[str]) -> str:
        start, name, before, end = match.groups()
        if name not in TABLES:
            raise SystemExit(f"no table {name!r}; there are {', '.join(TABLES)}")
        now = TABLES[name]() + "\n"
        if now != before:
            changed.append(name)
        return start + now + end

    return BLOCK.sub(block, text), changed


def main(arguments: Sequence[str] | None = None) -> int:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--save", nargs="+", type=Path, default=[])
    given = parser.parse_args(arguments)
    for path in given.save:
        sys.stdout.write(f"{path} -> docs/results/{save(path)}.json\n")
    differ = 0
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text, changed = filled(page.read_text(encoding="utf-8"))
        differ += len(changed)
        for name in changed:
            sys.stdout.write(f"{page.name}: {name}{' differs from docs/results' if given.check else ''}\n")
        if changed and not given.check:
            with replacing(page) as target:
                target.write_text(text, encoding="utf-8")
    return int(given.check and differ > 0)


if __name__ == "__main__":
    sys.exit(main())
