"""Collection, comparison, saving and display of the figures of a test session.

The figures are user properties in the reports of the tests. pytest-xdist transfers these reports
from its workers, so the same figures arrive here with and without pytest-xdist. Figures are sorted
by the name of their test, so that table and file do not depend on the order of the tests.
"""

from collections.abc import Mapping, Sequence
from itertools import groupby
from math import inf
from pathlib import Path
from typing import Any

import pytest

from identify.accuracy import saved
from identify.accuracy.figure import (
    CONFIDENCE,
    PROPERTY,
    AccuracyError,
    Figure,
    percent,
    with_unit,
)

Row = tuple[str, ...]
UNDECIDED = "undecided"
# Largest number of values, as a multiple of the present one, that a remedy asks for.
MOST_TIMES = 100
FOLDER = ".accuracy"  # folder of the saved figures
HEADER: Row = ("figure", "value", f"{CONFIDENCE:.0%} interval", "n", "unit", "limit", "margin")
UNIT = HEADER.index("unit")


def terminal_table(
    figures: Sequence[Figure],
    comparisons: Mapping[saved.Key, saved.Comparison],
    compared_with: str | None,
) -> list[str]:
    """Return the aligned lines of the table, with the figures of each test below its name.

    With `compared_with`, the name of a saved session, two columns show its values and the change.
    """
    header: Row = ("", *HEADER[1:], *((compared_with, "change") if compared_with else ()))
    tests = [(test, list(group)) for test, group in groupby(figures, lambda figure: figure.test)]
    rows = [
        [
            (
                "  " + figure.name,
                *_cells(figure),
                *(_compared(comparisons.get(figure.key)) if compared_with else ()),
            )
            for figure in group
        ]
        for _, group in tests
    ]
    widths = [
        max(map(len, column))
        for column in zip(header, *(row for group in rows for row in group), strict=True)
    ]
    lines = [_aligned(header, widths)]
    for (test, _), group_rows in zip(tests, rows, strict=True):
        lines += [test, *(_aligned(row, widths) for row in group_rows)]
    return lines + [_open_question(figure) for figure in figures if figure.undecided]


def _open_question(figure: Figure) -> str:
    """Return a line on an undecided figure, with how many values would decide it."""
    assert figure.interval is not None
    assert figure.limit is not None
    low, high = figure.interval
    distance = abs(figure.limit - figure.value)
    # The width of an interval falls with the square root of the number of values.
    needed = figure.count * ((high - low) / 2 / distance) ** 2 if distance else inf
    remedy = "so near to the mean, no number of values decides it: state another limit"
    if needed < MOST_TIMES * figure.count:
        remedy = (
            f"about {float(f'{needed:.1e}'):.0f} values or fewer decide it if the mean stays: "
            "accuracy.sample_until draws them, up to its argument most"
        )
    interval = with_unit(f"{low:.4g} .. {high:.4g}", figure.unit)
    return (
        f"{UNDECIDED}: {figure.name}: the test passed, because the interval {interval} of "
        f"{figure.count} values contains the limit {with_unit(f'{figure.limit:.4g}', figure.unit)}"
        f"; {remedy}"
    )


def markdown_table(figures: Sequence[Figure]) -> str:
    """Return figures as a Markdown table, each with its test."""
    rows = [(figure.test, figure.name, *_cells(figure)) for figure in figures]
    header: Row = ("test", *HEADER)
    left = ("test", "figure", "unit")
    rule = tuple("---" if name in left else "--:" for name in header)
    lines: list[Row] = [header, rule, *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _cells(figure: Figure) -> Row:
    interval = (
        "" if figure.interval is None else f"{figure.interval[0]:.4g} .. {figure.interval[1]:.4g}"
    )
    margin = "" if figure.margin is None else percent(figure.margin, ".0")
    mark = "FAILED" if figure.beyond_limit else UNDECIDED if figure.undecided else ""
    return (
        f"{figure.value:.4g}",
        interval,
        "" if figure.interval is None else str(figure.count),
        figure.unit,
        figure.limit_text,
        f"{margin} {mark}".strip(),
    )


def _compared(comparison: saved.Comparison | None) -> Row:
    if comparison is None:
        return "", "new"
    if comparison.mismatch:
        return "", comparison.mismatch
    return f"{comparison.saved.value:.4g}", percent(comparison.change, "+.1")


def _aligned(row: Row, widths: Sequence[int]) -> str:
    """Join a row with names and units aligned left, and other cells aligned right."""
    left = (0, UNIT)
    cells = (
        c.ljust(w) if i in left else c.rjust(w)
        for i, (c, w) in enumerate(zip(row, widths, strict=True))
    )
    return "  ".join(cells).rstrip()


def test_name(file: Path, place: str) -> str:
    """Return the name of a test: its file, from its outermost package on, and `place`.

    Unlike a node id, the name depends neither on the folder from which pytest runs nor on the
    folder of the package. `place` is the part of a node id after the file, such as `test_x[1]`.
    """
    parts = [file.name]
    folder = file.parent
    while (folder / "__init__.py").is_file():
        parts.insert(0, folder.name)
        folder = folder.parent
    return "::".join(["/".join(parts), *([place] if place else [])])


def saved_folder(config: pytest.Config) -> Path:
    """Return the folder of the saved figures, also in a worker of pytest-xdist."""
    folder = config.getoption("accuracy_dir")
    if folder:
        return config.invocation_params.dir / folder
    root = config.rootpath
    above = (one / FOLDER for one in (root, *root.parents))
    return next((one for one in above if one.is_dir()), root / FOLDER)


# Words for a test that did not measure a saved figure, by its outcome.
WHY_MISSING = {
    None: "did not run",
    "passed": "passed without",
    "skipped": "was skipped",
    "failed": "failed",
}


class AccuracySession:
    """Plugin object of the main process, which workers of pytest-xdist lack."""

    def __init__(self, config: pytest.Config) -> None:
        self._figures: dict[str, list[Figure]] = {}
        self._outcomes: dict[str, str] = {}
        self._nodes: dict[str, str] = {}
        self._shared: list[str] = []
        self._root = config.rootpath
        self._lines: list[tuple[str, bool]] = []
        self._folder = saved_folder(config)
        self._seed = config.getoption("accuracy_seed")
        self._save = config.getoption("accuracy_save")
        self._compare = config.getoption("accuracy_compare")
        self._ratio: float | None = config.getoption("accuracy_fail")
        self._saved: list[Figure] = []
        self._prepare()

    def _prepare(self) -> None:
        """Check the options before the first test, because they are used after the last test."""
        if self._ratio is not None and self._compare is None:
            raise pytest.UsageError(
                "--accuracy-fail needs --accuracy-compare NAME, the saved figures to compare with"
            )
        if self._save is None and self._compare is None:
            return
        try:
            if self._save is not None:
                saved.check_writable(saved.saved_path(self._folder, self._save))
            if self._compare is not None:
                before = saved.find_saved(self._folder, self._compare)
                self._saved = before.figures
                if before.seed != self._seed:
                    self._add_line(
                        f"{self._compare} was saved with --accuracy-seed {before.seed}, this "
                        f"session has the seed {self._seed}"
                    )
        except AccuracyError as error:
            raise pytest.UsageError(str(error)) from error

    @property
    def figures(self) -> list[Figure]:
        """All figures, sorted by the names of their tests. Those of a test keep their order."""
        return [figure for test in sorted(self._figures) for figure in self._figures[test]]

    @property
    def comparisons(self) -> dict[saved.Key, saved.Comparison]:
        """Figures paired with saved figures."""
        return dict(saved.compare(self.figures, self._saved))

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Store the outcome of a module that is skipped, or fails, as a whole."""
        if report.outcome != "passed":
            self._outcomes[self._name(report.nodeid)] = report.outcome

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store the outcome from each report of a test, and the figures from its last report."""
        if report.when == "setup" or report.outcome != "passed":
            self._outcomes[self._name(report.nodeid)] = report.outcome
        if report.when == "teardown":
            properties: list[tuple[str, Any]] = report.user_properties
            found = [Figure(**value) for name, value in properties if name == PROPERTY]
            if found:
                test = found[0].test
                node = report.nodeid
                if self._nodes.setdefault(test, node) != node:
                    self._shared.append(
                        f"{self._nodes[test]} and {node} have the same name {test}, and only one "
                        "of them can keep figures: rename one, or add an __init__.py to its folder"
                    )
                self._figures[test] = found

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Judge the comparison. Save if all tests passed and no figure is beyond its limit."""
        for text in self._shared:
            self._fail(session, text)
        if self._compare is not None:
            self._judge(session)
        if self._save is not None:
            self._save_figures(session)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Show the table of the figures and the remarks."""
        if not self._figures and not self._lines:
            return
        terminalreporter.section("accuracy")
        if self._figures:
            for line in terminal_table(self.figures, self.comparisons, self._compare):
                terminalreporter.write_line(line)
        for remark, bad in self._lines:
            terminalreporter.write_line(remark, red=bad)

    def _judge(self, session: pytest.Session) -> None:
        self._report_missing(session)
        # With --collect-only, as editors use it, no test is run.
        measuring = not session.config.option.collectonly
        if self._ratio is not None and measuring and not self.comparisons:
            self._fail(
                session,
                f"nothing is compared: no figure saved as {self._compare} was measured now",
            )
        for pair in self.comparisons.values():
            if pair.limit_change:
                self._add_line(pair.limit_change)
            if pair.evidence_change:
                self._report_change(session, pair.evidence_change, guarded=True)
            if self._ratio is None:
                continue
            if pair.mismatch:
                self._fail(
                    session, f"{pair.now.test}: {pair.now.name} cannot be compared: {pair.mismatch}"
                )
            elif pair.worse_by_more_than(self._ratio):
                self._fail(session, f"worse by more than {self._ratio:.0%}: {pair.regression}")

    def _report_missing(self, session: pytest.Session) -> None:
        """Report saved figures that were not measured.

        With --accuracy-fail the session fails if their test ran or was skipped.
        """
        gone = saved.missing(self.figures, self._saved)
        if not gone:
            return
        count = sum(map(len, gone.values()))
        self._add_line(
            f"{count} of {len(self._saved)} figures saved as {self._compare} were not measured now:"
        )
        for test, names in gone.items():
            outcome = self._outcome(test)
            line = f"  {test}: {', '.join(names)} (the test {WHY_MISSING.get(outcome, outcome)})"
            self._report_change(session, line, guarded=outcome is not None)

    def _name(self, node: str) -> str:
        """Return the name of the test or module of a node id."""
        file, _, place = node.partition("::")
        return test_name(self._root / file, place)

    def _outcome(self, test: str) -> str | None:
        """Return the outcome of a test or of its module, or None if it did not run."""
        for node, outcome in self._outcomes.items():
            # With --dist loadgroup, node ids in reports end with @ and the group.
            if node == test or node.startswith(f"{test}@") or test.startswith(f"{node}::"):
                return outcome
        return None

    def _save_figures(self, session: pytest.Session) -> None:
        path = saved.saved_path(self._folder, self._save)
        if session.exitstatus != pytest.ExitCode.OK or not self._figures:
            why = "the session did not pass" if self._figures else "no figures were recorded"
            self._add_line(f"not saved as {self._save}: {why}")
            return
        beyond = [f"{figure.test}: {figure.name}" for figure in self.figures if figure.beyond_limit]
        # A test marked xfail does not fail the session, although its figures are beyond limits.
        if beyond:
            self._fail(
                session, f"not saved as {self._save}: beyond their limits are {'; '.join(beyond)}"
            )
            return
        try:
            saved.save(
                path, saved.SavedSession(name=self._save, seed=self._seed, figures=self.figures)
            )
        except AccuracyError as error:
            self._fail(session, str(error))
        else:
            here = Path.cwd()
            self._add_line(
                f"saved: {path.relative_to(here) if path.is_relative_to(here) else path}"
            )

    def _report_change(self, session: pytest.Session, text: str, guarded: bool) -> None:
        """Report a finding of the comparison.

        With --accuracy-fail the session fails if the finding is `guarded`.
        """
        if guarded and self._ratio is not None:
            self._fail(session, text)
        else:
            self._add_line(text)

    def _add_line(self, text: str, bad: bool = False) -> None:
        self._lines.append((text, bad))

    def _fail(self, session: pytest.Session, text: str) -> None:
        self._add_line(text, bad=True)
        if session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
