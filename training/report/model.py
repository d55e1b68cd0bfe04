"""What a report is made of: sections of notes, tables, figures and folded parts, the same for the page and the markdown."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from training.runs.words import number

Kind = Literal["", "best", "good", "bad", "open"]


@dataclass(frozen=True)
class Cell:
    """A table's cell.

    Attributes:
        text: what it says.
        kind: "best" of its row, "good" (met), "bad" (missed), "open" (not measured); never said by colour alone.
    """

    text: str
    kind: Kind = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: what it shows, in a line; read aloud first.
        columns: their headings; the first names the rows.
        rows: of as many cells.
        words: how many leading columns hold words, not numbers.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell | str]]
    words: int = 1

    @property
    def cells(self) -> list[list[Cell]]:
        """The rows, every entry a `Cell`."""
        return [[value if isinstance(value, Cell) else Cell(value) for value in row] for row in self.rows]


@dataclass(frozen=True)
class Picture:
    """A figure.

    Attributes:
        name: of its file in figures/, without suffix.
        title: above it.
        caption: what else there is to say; may be empty.
        alt: what it shows, for those who do not see it.
        legend: (label, colour variable, dashed) of every line.
        svg: for the page; empty: `sources` has it.
        file: that the markdown shows, from the page on.
        sources: data URIs of a picture that moves: "moving", "still".
    """

    name: str
    title: str
    caption: str
    alt: str
    legend: Sequence[tuple[str, str, bool]] = ()
    svg: str = ""
    file: str = ""
    sources: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Fold:
    """Parts that are closed until asked for."""

    summary: str
    blocks: Sequence[Table | Picture | Fold]
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Section:
    """A part of the report with a heading.

    Attributes:
        key: its anchor.
        title: its heading.
        notes: paragraphs before the rest.
        blocks: tables, figures and folds, in order.
        items: a list after the paragraphs.
    """

    key: str
    title: str
    notes: Sequence[str] = ()
    blocks: Sequence[Table | Picture | Fold] = ()
    items: Sequence[str] = ()


def data_uri(data: bytes, kind: str) -> str:
    """A picture of that kind (png, webp, jpeg) as text in a page."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def at(tree: Any, *keys: str) -> Any:
    """tree[keys[0]][keys[1]]..., None where a key is missing on the way: an older or a quick run lacks some numbers.

    Example:
        >>> at({"a": {"b": 3}}, "a", "b"), at({"a": None}, "a", "b"), at({}, "a")
        (3, None, None)
    """
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def present(blocks: Iterable[Table | Picture | Fold | None]) -> list[Table | Picture | Fold]:
    """Those that have something to show."""
    kept: list[Table | Picture | Fold] = []
    for block in blocks:
        if (
            block is None
            or (isinstance(block, Table) and not block.rows)
            or (isinstance(block, Fold) and not block.blocks)
        ):
            continue
        kept.append(block)
    return kept


def flat(tree: dict[str, Any], before: str = "") -> list[tuple[str, str]]:
    """(dotted key, text) of the short entries of nested dictionaries; long lists are counted.

    Example:
        >>> flat({"seconds": {"total": 12.34567}, "hidden": [128, 128], "name": "x", "curve": list(range(99))})
        [('seconds.total', '12.3'), ('hidden', '128, 128'), ('name', 'x'), ('curve', '99 values')]
    """
    out: list[tuple[str, str]] = []
    for key, value in tree.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            out += flat(value, f"{name}.")
        elif isinstance(value, list):
            plain = len(value) <= 8 and not any(isinstance(part, (list, dict)) for part in value)
            out.append((name, ", ".join(map(_text, value)) if plain else f"{len(value)} values"))
        else:
            out.append((name, _text(value)))
    return out


def _text(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "–", True: "yes", False: "no"}[value]
    return number(value) if isinstance(value, (int, float)) else str(value)
