"""What a user sees at the terminal: progress of the stages of a run, tables in one look, and warnings."""

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

import typer
from rich.box import SIMPLE_HEAD
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

Advance = Callable[..., None]
"""``advance(n=1)``: n more steps of the stage are done."""


class Progress(Protocol):
    """What a stage needs to tell how far it is."""

    def stage(self, name: str, total: int) -> AbstractContextManager[Advance]:
        """Open a stage of ``total`` steps; the context yields ``advance(n=1)``."""
        ...


class SilentProgress:
    """Says nothing."""

    @contextmanager
    def stage(self, name: str, total: int) -> Iterator[Advance]:
        """Open a stage whose progress nobody sees."""
        yield lambda n=1: None


LINE_S = 60.0
"""How often a stage says where it is when not on a terminal, seconds."""


class RichProgress:
    """Bars with elapsed time and time left; when not on a terminal, a plain line for each stage, once a minute while it
    lasts and at its end."""

    def __init__(self, console: Console | None = None, rate: str = "") -> None:
        """``rate``: unit of the steps' rate, such as rows/s; empty shows none."""
        self._console, self._rate = console or Console(stderr=True), rate

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
        done, start = 0, time.perf_counter()
        said = start

        def say() -> None:
            seconds = time.perf_counter() - start
            rate = f", {done / seconds:.3g} {self._rate}" if self._rate else ""
            self._console.print(f"{name}: {done} of {total} in {seconds:.1f} s{rate}", highlight=False, soft_wrap=True)

        def advance(n: int = 1) -> None:
            nonlocal done, said
            done += n
            if done < total and time.perf_counter() > said + LINE_S:
                said = time.perf_counter()
                say()

        yield advance
        say()


def terminal_progress(quiet: bool, rate: str = "") -> Progress:
    """What a command shows: bars, with `rate` as the unit of the steps' rate, or nothing where it is to be quiet."""
    return SilentProgress() if quiet else RichProgress(rate=rate)


class _RateColumn(ProgressColumn):
    """Steps a second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """The rate of late, or over all where the stage has ended."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.3g} {self._unit}")


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
    """Print rows of text under a header to standard output, the title above and the note below, as all tables look.

    words: headers of the columns that hold words, which stand to the left; numbers stand to the right. The first column
    is never broken. All text is shown as it is: what stands in brackets, such as a unit, is no markup.
    """
    table = RichTable(title=title, caption=note, box=SIMPLE_HEAD, show_edge=False, padding=0)
    for place, name in enumerate(header):
        table.add_column(name, justify="left" if name in words else "right", no_wrap=not place)
    for row in rows:
        table.add_row(*row)
    Console(markup=False, emoji=False).print(table)
