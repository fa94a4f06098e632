"""Tables at the terminal, all in one look: 80 columns must do, since that is what a pipe gets. And warnings."""

from collections.abc import Collection, Iterable, Sequence

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable


def print_warnings(warnings: Iterable[str]) -> None:
    """One line each on standard error, `warning: ...`; they are no summary, and a quiet command gives them too."""
    for warning in warnings:
        typer.echo(f"warning: {' '.join(warning.split())}", err=True)


def print_table(
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    words: Collection[str],
    title: str | None = None,
    note: str | None = None,
) -> None:
    """Print rows of text under a header to standard output, the title above and the note below.

    words: headers of the columns that hold words, which stand to the left; numbers stand to the right. The first column
    is never broken. All text is shown as it is: what stands in brackets, such as a unit, is no markup.
    """
    table = RichTable(title=title, caption=note, box=SIMPLE_HEAD, show_edge=False, padding=0)
    for place, name in enumerate(header):
        table.add_column(name, justify="left" if name in words else "right", no_wrap=not place)
    for row in rows:
        table.add_row(*row)
    Console(markup=False, emoji=False).print(table)
