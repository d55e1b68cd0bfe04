"""Progress bars."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text


class Bars(Progress):
    """Bars as wide as the terminal, with each task's field `note` below; no line is wrapped."""

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the lines, from the top."""
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            if task.fields.get("note"):
                yield Text(task.fields["note"], style="dim", no_wrap=True, overflow="ellipsis")


def progress(console: Console | None = None) -> Bars:
    """Return a progress bar on stderr, or on `console`; it draws on terminals only."""
    console = console or Console(stderr=True)
    # the bar fills the rest of the line; long names are cut, numbers and times never
    name = Column(no_wrap=True, overflow="ellipsis", max_width=max(8, console.width - 48))
    columns = (
        TextColumn("{task.description}", table_column=name),
        BarColumn(bar_width=None),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
    )
    return Bars(
        *columns, console=console, transient=False, disable=not console.is_terminal, expand=True
    )
