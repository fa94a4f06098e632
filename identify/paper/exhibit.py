"""Exhibit: one figure or table of the paper, and our own runs from which all are made."""

import csv
import io
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from dynamics import Robot
from identify.arrays import Array
from identify.reporting.figures.style import COMPONENTS, INK, LINE, WIDTH
from identify.reporting.number_format import number
from identify.reporting.run_data import RunData
from identify.reporting.tables import Table
from identify.validation.variation import Variation
from identify.verification.against_mujoco import EngineRuns


@dataclass(frozen=True)
class PaperRuns:
    """Results from which all exhibits are made.

    robot           Robot of both runs.
    ours, settings  Run of the scenario `paper`, and run of the scenario `paper_settings`.
    variation       Scatter of the estimates from the validation runs of `ours`.
    engines         Motion of the model and of MuJoCo.
    """

    robot: Robot
    ours: RunData
    settings: RunData
    variation: Variation
    engines: EngineRuns

    @property
    def both(self) -> Mapping[str, RunData]:
        """Both runs, by their names in the tables."""
        return {"ours": self.ours, "paper's settings": self.settings}


# Columns of text and numbers by their headings. All have the same number of rows.
Columns = Mapping[str, Collection[Any]]


@dataclass(frozen=True)
class Exhibit:
    """Figure or table of the paper, and its counterpart from our own runs.

    name         Name in the paper, such as "Figure 8".
    title        Subject of the figure or table.
    paper, ours  Sentences on what the paper shows, and on what our counterpart shows and why it
                 differs.
    columns      Texts and numbers of the exhibit, which become its CSV file.
    draw         Function that draws the figure. It is None for a table, whose columns are drawn.
    """

    name: str
    title: str
    paper: str
    ours: str
    columns: Columns
    draw: Callable[[], Figure] | None = None

    @property
    def stem(self) -> str:
        """Name of the files without suffix, such as "figure_08"."""
        kind, _, digits = self.name.lower().partition(" ")
        return f"{kind}_{int(digits):02d}"

    @property
    def table(self) -> Table:
        """Columns as a table of text, with numbers formatted for reading."""
        rows = zip(
            *([_shown(cell) for cell in cells] for cells in self.columns.values()), strict=True
        )
        return Table(self.title, tuple(self.columns), tuple(rows))

    def figure(self) -> Figure:
        """Draw the figure, or the columns of a table."""
        return table_figure(self.table) if self.draw is None else self.draw()

    def csv(self) -> str:
        """Return the columns as CSV, with all digits and without typographic signs."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(zip(*self.columns.values(), strict=True))
        return stream.getvalue()


def _shown(cell: Any) -> str:
    return cell if isinstance(cell, str) else number(cell)


def table_figure(table: Table) -> Figure:
    """Draw a table for print."""
    height = 0.17 * (len(table.rows) + 2)
    figure = Figure(figsize=(WIDTH, height))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    drawn = axes.table(
        cellText=[list(row) for row in table.rows],
        colLabels=list(table.header),
        bbox=Bbox.unit(),
        edges="horizontal",
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(6.5)
    drawn.auto_set_column_width(list(range(len(table.header))))
    for (row, column), cell in drawn.get_celld().items():
        cell.set_edgecolor(LINE if row else INK)
        cell.set_text_props(ha="left" if table.words[column] else "right")
    return figure


def pose_columns(poses: Array, whose: str = "") -> dict[str, Array]:
    """Return poses (N, 6) [m, rad] as columns in mm and mrad, with ``whose`` in the headings."""
    before = f"{whose} " if whose else ""
    return {
        f"{before}{name} [{'mm' if i < 3 else 'mrad'}]": 1e3 * poses[:, i]
        for i, name in enumerate(COMPONENTS)
    }
