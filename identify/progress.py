"""Output at the terminal: progress of the stages of a run, tables, and warnings."""

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

import typer
from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as RichBars
from rich.table import Table as RichTable
from rich.text import Text

# Function ``advance(n=1)`` that reports n more steps of the stage as done.
Advance = Callable[..., None]
# Modules that the option --plugin of the running command has named.
TYPED_PLUGINS: list[str] = []
# Commands that are advised and have no option --plugin, because they import no part of a user.
WITHOUT_PLUGINS = ("budget", "export", "workspace")


class Progress(Protocol):
    """Interface by which a stage reports its progress."""

    def stage(self, name: str, total: int) -> AbstractContextManager[Advance]:
        """Open a stage of ``total`` steps. The context yields ``advance(n=1)``."""
        ...


class SilentProgress:
    """Progress that shows nothing."""

    @contextmanager
    def stage(self, name: str, total: int) -> Iterator[Advance]:
        """Open a stage whose progress is not shown."""
        yield lambda n=1: None


LINE_S = 60.0  # least time, s, between two lines of a stage if the output is not a terminal


class RichProgress:
    """Progress as bars with elapsed and remaining time.

    If the output is not a terminal, a stage prints a plain line at most once per minute, and one at
    its end.
    """

    def __init__(self, console: Console | None = None, rate: str = "") -> None:
        """Choose the console and the unit of the steps' rate, such as "rows/s".

        An empty ``rate`` shows no rate.
        """
        self._console = console or Console(stderr=True)
        self._rate = rate

    def stage(self, name: str, total: int) -> AbstractContextManager[Advance]:
        """Open a stage of ``total`` steps."""
        return self._bar(name, total) if self._console.is_terminal else self._line(name, total)

    @contextmanager
    def _bar(self, name: str, total: int) -> Iterator[Advance]:
        columns = (
            TextColumn("{task.description:<28}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            *([_RateColumn(self._rate)] if self._rate else []),
        )
        with RichBars(*columns, console=self._console) as bars:
            task = bars.add_task(name, total=total)
            yield lambda n=1: bars.advance(task, n)

    @contextmanager
    def _line(self, name: str, total: int) -> Iterator[Advance]:
        done = 0
        start = time.perf_counter()
        said = start

        def say() -> None:
            seconds = time.perf_counter() - start
            rate = f", {done / seconds:.3g} {self._rate}" if self._rate else ""
            self._console.print(
                f"{name}: {done} of {total} in {seconds:.1f} s{rate}",
                highlight=False,
                soft_wrap=True,
            )

        def advance(n: int = 1) -> None:
            nonlocal done, said
            done += n
            if done < total and time.perf_counter() > said + LINE_S:
                said = time.perf_counter()
                say()

        yield advance
        say()


def terminal_progress(quiet: bool, rate: str = "") -> Progress:
    """Return the progress of a command: bars with a rate in the unit `rate`, silent if quiet."""
    return SilentProgress() if quiet else RichProgress(rate=rate)


class _RateColumn(ProgressColumn):
    """Column with the number of steps per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Show the recent rate, or the mean rate of a stage that has ended."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.3g} {self._unit}")


def print_warnings(warnings: Iterable[str], word: str = "warning") -> None:
    """Print each warning as one line on standard error, even if the command is quiet."""
    for warning in warnings:
        typer.echo(f"{word}: {' '.join(warning.split())}", err=True)


def print_advice(cause: str, command: str, of: str = "") -> None:
    """Print the likeliest cause of missed goals, and the command to type next.

    ``of`` names the goals, if they are not clear from the lines above.
    """
    typer.echo(f"likeliest cause{f' ({of})' if of else ''}: {cause}")
    typer.echo(f"next: {with_plugins(command)}")


def with_plugins(command: str) -> str:
    """Return a command of cmmsim with the options --plugin that were typed for this command."""
    takes_none = command.split()[1] in WITHOUT_PLUGINS
    return command if takes_none else " ".join([command, *(f"--plugin {m}" for m in TYPED_PLUGINS)])


def print_table(
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    words: Collection[str],
    title: str | None = None,
    note: str | None = None,
) -> None:
    """Print rows of text under a header to standard output.

    header       Names of the columns.
    rows         Cells. Square brackets, for example of a unit, are printed and not read as markup.
    words        Names of the columns that hold words and are aligned left. Other columns are
                 aligned right.
    title, note  Lines above and below the table.

    On a narrow terminal, columns of words are folded, and the first column only if the others do
    not suffice. Numbers and single words are never cut. A table that is then still wider than the
    terminal is printed in full.
    """
    console = Console(markup=False, emoji=False)
    cells = [list(row) for row in rows]
    widths = _column_widths([header, *cells], [name in words for name in header], console.width)
    table = RichTable(title=title, caption=note, box=SIMPLE_HEAD, show_edge=False, padding=0)
    for name, width in zip(header, widths, strict=True):
        table.add_column(
            name, justify="left" if name in words else "right", width=width, overflow="fold"
        )
    for row in cells:
        table.add_row(*row)
    console.width = max(console.width, sum(widths) + len(widths) - 1)
    console.print(table)


def _column_widths(
    lines: Sequence[Sequence[str]], words: Sequence[bool], available: int
) -> list[int]:
    """Return the width of each column, in cells of the terminal.

    Columns of words are narrowed until the table has the available width, but not below their
    longest word. The first column is narrowed if the others do not suffice.
    """
    columns = list(zip(*lines, strict=True))
    widths = [max(cell_len(part) for cell in one for part in cell.split("\n")) for one in columns]
    longest = [
        max(cell_len(word) for cell in one for word in cell.split() or [""]) for one in columns
    ]
    # There is an empty cell between two columns.
    excess = sum(widths) + len(widths) - 1 - available
    for candidates in ([k for k in range(1, len(columns)) if words[k]], [0]):
        while excess > 0 and (wide := [k for k in candidates if widths[k] > longest[k]]):
            widths[max(wide, key=widths.__getitem__)] -= 1
            excess -= 1
    return widths
