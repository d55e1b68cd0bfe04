"""What a page is made of (sections of notes, tables, figures and folded parts), and how it is written as markdown and HTML."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from training.report.style import close, variables
from training.runs import Run
from training.runs.claims import ranked
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

    @classmethod
    def of(cls, caption: str, columns: Columns, items: Iterable[tuple[Any, ...]], words: int = 1) -> Table:
        """A row per item, whose parts every column is asked about: a new number is a new line of `columns`."""
        rows = [[said(*item) for _, said in columns] for item in items]
        return cls(caption, [heading for heading, _ in columns], rows, words)

    @property
    def cells(self) -> list[list[Cell]]:
        """The rows, every entry a `Cell`."""
        return [[value if isinstance(value, Cell) else Cell(value) for value in row] for row in self.rows]


Columns = Sequence[tuple[str, Callable[..., Cell | str]]]
"""(heading, what it says) of every column."""


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
        sources: data URIs of a picture that is no SVG: "still", and "moving" where it moves.
        wide: whether it takes a row for itself.
    """

    name: str
    title: str
    caption: str
    alt: str
    legend: Sequence[tuple[str, str, bool]] = ()
    svg: str = ""
    file: str = ""
    sources: dict[str, str] = field(default_factory=dict)
    wide: bool = False


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
        lead: what was found, sentences whose words before a colon are set in bold.
        notes: paragraphs before the rest.
        blocks: tables, figures and folds, in order.
        items: a list after the paragraphs.
    """

    key: str
    title: str
    notes: Sequence[str] = ()
    blocks: Sequence[Table | Picture | Fold] = ()
    items: Sequence[str] = ()
    lead: Sequence[str] = ()

    @property
    def led(self) -> list[tuple[str, str]]:
        """(what it is about, what was found) of the first sentences."""
        return [(head, text) if text else ("", head) for head, _, text in (said.partition(":") for said in self.lead)]


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


def shown(*keys: str, digits: int = 3) -> Callable[..., str]:
    """A column that shows the number at these keys of an item's last part."""
    return lambda *item: number(at(item[-1], *keys), digits)


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


def write_page(
    run: Run, title: str, quick: bool, sections: Iterable[Section | None], name: str = "report", html: bool = True
) -> None:
    """Writes <name>.md and <name>.html; sections without anything in them are left out.

    Args:
        run: receives them.
        title: of the page.
        quick: says so at the top.
        sections: in their order.
        name: of the files.
        html: whether the second is written.
    """
    kept = [
        section for section in sections if section is not None and (section.blocks or section.items or section.lead)
    ]
    context = {"title": title, "quick": quick, "sections": kept, "light": variables(False), "dark": variables(True)}
    for kind in ("md", "html") if html else ("md",):
        run.write_text(f"{name}.{kind}", _render(f"report.{kind}.j2", context))


def png(run: Run, file: str, figure: Figure, title: str, caption: str, alt: str = "") -> Picture:
    """Saves a figure as a .png of the run, frees it, and is its picture for a page."""
    path = run.write(file, lambda target: figure.savefig(target, format="png", dpi=130))
    wide = figure.get_figwidth() > 6.0
    close(figure)
    still = {"still": data_uri(path.read_bytes(), "png")}
    return Picture(path.stem, title, caption, alt or caption or title, file=file, sources=still, wide=wide)


def _render(template: str, context: dict[str, Any]) -> str:
    """A template of this room, filled; one that names what `context` lacks raises."""
    environment = Environment(
        loader=PackageLoader("training.report", "templates"),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["table"] = lambda block: isinstance(block, Table)
    environment.tests["picture"] = lambda block: isinstance(block, Picture)
    environment.tests["fold"] = lambda block: isinstance(block, Fold)
    return environment.get_template(template).render(context)


def claims_section(metrics: dict[str, Any]) -> Section:
    """What was asked, what was measured; missed first, then not measured, then met."""
    verdicts = {False: Cell("NO", "bad"), None: Cell("not measured", "open"), True: Cell("yes", "good")}
    claims = ranked(metrics.get("claims", []))
    counts = {verdict: sum(row["met"] is verdict for row in claims) for verdict in verdicts}
    text = f"{counts[True]} of {len(claims)} met, {counts[False]} missed, {counts[None]} not measured in this run."
    rows = [[verdicts[row["met"]], pretty(row["claim"]), pretty(row["asked"]), row["measured"]] for row in claims]
    table = Table("Claims, the missed ones first", ("met", "claim", "asked", "measured"), rows, words=4)
    return Section("claims", "Claims", (text,), present([table]))


def pretty(text: str) -> str:
    """Signs instead of what is typed for them.

    Example:
        >>> pretty("G^+, force <= 2 N")
        'G⁺, force ≤ 2 N'
    """
    return text.replace("G^+", "G⁺").replace("<=", "≤")


def provenance_section(run: dict[str, Any]) -> Section:
    """Machine, versions, command and times."""
    machine, versions = at(run, "machine") or {}, at(run, "versions") or {}
    rule = at(run, "step_rule") or {}
    force, barrier = number(run.get("force_weight")), number(run.get("barrier_weight"))
    told = [
        ("machine", f"{machine.get('processor', '–')}, {number(machine.get('cores'))} cores, {machine.get('system', '–')}"),
        ("versions", ", ".join([f"Python {machine.get('python', '–')}", *(f"{name} {text}" for name, text in versions.items())])),
        *((name, str(run.get(key, "–"))) for name, key in (("commit", "commit"), ("when", "time"), ("command", "command"))),
        ("objective", f"ω = {force}, λ = {barrier} N², friction {number(run.get('friction'))}" if "force_weight" in run else ""),
        ("step rule, the same for all", ", ".join(f"{name} {text}" for name, text in flat(rule))),
        ("seeds", f"{run['seed']} and following" if "seed" in run else ""),
        ("settings", ", ".join(f"{name} {text}" for name, text in flat(at(run, "config") or {}) if name != "out")),
        ("seconds", ", ".join(f"{name.replace('_', ' ')} {text}" for name, text in flat(at(run, "seconds") or {}))),
    ]  # fmt: skip
    rows = [[name, text] for name, text in told if text]
    return Section("provenance", "Machine and versions", (), [Table("How this was made", ("", "value"), rows, words=2)])
