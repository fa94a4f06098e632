"""Figures as text: the table at the end of a session, and the same as Markdown."""

from collections.abc import Mapping, Sequence
from itertools import groupby

from identify.accuracy.comparison import Comparison, Key
from identify.accuracy.figure import CONFIDENCE, Figure, percent

Row = tuple[str, ...]
UNDECIDED = "undecided"
HEADER: Row = ("figure", "value", f"{CONFIDENCE:.0%} interval", "unit", "limit", "margin")


def terminal_table(
    figures: Sequence[Figure], comparisons: Mapping[Key, Comparison], compared_with: str | None
) -> list[str]:
    """Lines of the table, the figures of a test under its node id; aligned, with the saved values where compared."""
    header: Row = ("", *HEADER[1:], *((compared_with, "change") if compared_with else ()))
    tests = [(test, list(group)) for test, group in groupby(figures, lambda figure: figure.test)]
    rows = [
        [
            ("  " + figure.name, *_cells(figure), *(_compared(comparisons.get(figure.key)) if compared_with else ()))
            for figure in group
        ]
        for _, group in tests
    ]
    widths = [max(map(len, column)) for column in zip(header, *(row for group in rows for row in group), strict=True)]
    lines = [_aligned(header, widths)]
    for (test, _), group_rows in zip(tests, rows, strict=True):
        lines += [test, *(_aligned(row, widths) for row in group_rows)]
    if any(figure.undecided for figure in figures):
        lines.append(f"{UNDECIDED}: passed, as the interval holds the limit; more values would tell")
    return lines


def markdown_table(figures: Sequence[Figure]) -> str:
    """The figures as a Markdown table; a parametrised test's parameters stand behind the name."""
    rows = [(_full_name(figure), *_cells(figure)) for figure in figures]
    lines: list[Row] = [HEADER, ("---", "--:", "--:", "---", "--:", "--:"), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _cells(figure: Figure) -> Row:
    interval = "" if figure.interval is None else f"{figure.interval[0]:.4g} .. {figure.interval[1]:.4g}"
    margin = "" if figure.margin is None else percent(figure.margin, ".0")
    mark = "FAILED" if figure.beyond_limit else UNDECIDED if figure.undecided else ""
    return f"{figure.value:.4g}", interval, figure.unit, figure.limit_text, f"{margin} {mark}".strip()


def _compared(comparison: Comparison | None) -> Row:
    if comparison is None:
        return "", "new"
    if comparison.mismatch:
        return "", comparison.mismatch
    return f"{comparison.saved.value:.4g}", percent(comparison.change, "+.1")


def _aligned(row: Row, widths: Sequence[int]) -> str:
    """Names and units to the left, all else to the right."""
    left = (0, 3)
    cells = (c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
    return "  ".join(cells).rstrip()


def _full_name(figure: Figure) -> str:
    name, bracket, parameters = figure.test.rpartition("::")[2].partition("[")
    return f"{figure.name} [{parameters}" if name and bracket else figure.name
