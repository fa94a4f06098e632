"""Plots of a study as PNG, PDF and SVG.

A figure of a row is a number that the row computes, such as an rms error. The plots show figures
with bands against each factor, figures as a map over two factors, and the laws.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from identify.arrays import Array
from identify.files.atomic import figure_bytes, write_files
from identify.reporting.figures import panel_grid
from identify.studies.labels import axis_label, setting, short_number
from identify.studies.study_file import Law, Study
from identify.studies.theory import BAND_CONFIDENCE as BANDS
from identify.studies.theory import CONFIDENCE as LAWS
from identify.studies.theory import Verdict, law_data, point_statistics, rows_with_figures
from identify.studies.uniformity import Uniformity, uniformity_figure

PANEL = (3.4, 2.8)  # width and height of a panel, inches. The width fits a column of a journal.
STYLE: Any = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.framealpha": 0.8,
    "legend.edgecolor": "none",
    "pdf.fonttype": 42,  # text stays text
    "svg.fonttype": "none",
}
MARKERS = "osD^vPX<>*hpd"
LINES = ("-", "--", "-.", ":")
FORMATS = ("png", "pdf", "svg")
# Smallest ratio of the ends of a logarithmic axis. With it, small differences look small.
LEAST_SPAN = 2.0
# Largest factor by which bands extend a logarithmic axis beyond the curves. Wider bands are cut.
WIDEST_BAND = 3.0
LINE_IN = 0.16  # height of a line of the title or legend, by which a figure grows, inches
LETTERS_PER_INCH = 14.0  # letters of a title per inch, a little fewer than fit
BESIDE = 1.02  # ratio between the abscissae of two neighbouring curves with the same levels
# Largest number of separate curves. If the factors beside the abscissa have more settings, all rows
# form one curve.
MOST_CURVES = 6
NEAREST_TICKS = 0.09  # smallest distance of two ticks of a vertical axis, as a fraction of the axis
LETTER = 0.034  # width of a letter of a tick label, as a fraction of the axis
# Choices of ticks within a decade of a logarithmic axis. The first choice that fits is used.
TICKS: list[list[float]] = [
    [1 + k / 10 for k in range(90)],
    [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8],
    [1, 2, 3, 5],
    [1, 2, 5],
    [1, 3],
    [1],
]
MOST_TICKS = 7  # largest number of ticks of an axis

Others = Sequence[tuple[str, pd.DataFrame]]  # names and finished rows of other studies


def draw(
    folder: Path,
    study: Study,
    done: pd.DataFrame,
    shown: list[str],
    verdicts: list[Verdict],
    tests: list[Uniformity],
) -> None:
    """Write the plots of a study's finished rows. `shown` names the figures to plot."""
    if not len(done) or not shown:
        return
    _write(folder, _figures(study, done, shown, verdicts, tests))


def draw_side_by_side(
    folder: Path, study: Study, done: pd.DataFrame, shown: list[str], others: Others
) -> None:
    """Write plots that show the finished rows of a study and of other studies side by side.

    A plot is drawn against each factor, or against the name of the study if there are no factors.
    """
    names, tables = zip((study.name, done), *others, strict=True)
    together = pd.concat(
        [table.assign(study=name) for name, table in zip(names, tables, strict=True)]
    )
    named = study.model_copy(update={"factors": study.factors | {"study": list(names)}})
    paths = list(study.factors) or ["study"]
    _write(
        folder,
        ((f"side_by_side_{path}", factor_figure(named, together, path, shown)) for path in paths),
    )


def _write(folder: Path, figures: Iterable[tuple[str, Figure]]) -> None:
    contents: dict[Path, bytes] = {}
    with mpl.rc_context(STYLE):
        for name, figure in figures:
            for kind in FORMATS:
                path = folder / f"{name}.{kind}"
                contents[path] = figure_bytes(figure, path.suffix)
    write_files(contents, parents=True)


def _figures(
    study: Study,
    done: pd.DataFrame,
    shown: list[str],
    verdicts: list[Verdict],
    tests: list[Uniformity],
) -> Iterator[tuple[str, Figure]]:
    """Yield all plots of a study with the names of their files."""
    if tests:
        yield "uniformity", uniformity_figure(tests)
    for path in study.factors:
        yield f"by_{path}", factor_figure(study, done, path, shown)
    grid = [path for path, values in study.factors.items() if isinstance(values, list)]
    if study.sample is None and len(grid) >= 2:
        yield "map", map_figure(study, done, (grid[0], grid[1]), shown)
    laws = [
        (law, verdict)
        for law, verdict in zip(study.theory, verdicts, strict=True)
        if law.exponent is not None and verdict.measured is not None
    ]
    if laws:
        yield "laws", laws_figure(study, done, laws)


def factor_figure(study: Study, done: pd.DataFrame, path: str, shown: list[str]) -> Figure:
    """Plot the rms of each figure with its band against one factor.

    There is a curve for each setting of the other factors. For a sample, single rows are plotted. A
    power law of the study is drawn with the rows.
    """
    figure, panels = panel_grid(len(shown), *PANEL)
    others = [other for other in study.factors if other != path]
    for axes, name in zip(panels, shown, strict=True):
        have = done.dropna(subset=[name])
        if study.sample is not None:
            axes.plot(_shown(have[path]), have[name], ".", markersize=4)
        else:
            curves = _curves(have, others)
            for index, (label, rows) in enumerate(curves):
                levels = _beside(rows[path], index, len(curves))
                _curve(axes, levels, rows[name].to_numpy(dtype=float), label, index)
        drawn = (name, None, path)
        laws = [one for one in study.theory if (one.figure, one.per, one.factor) == drawn]
        if laws and laws[0].exponent is not None:
            _theory_line(axes, have[path], have[name].to_numpy(dtype=float), laws[0].exponent)
        scale(axes, have[path])
        axes.set_xlabel(axis_label(path, study))
        axes.set_ylabel(axis_label(name, study))
    _legend_below(figure, panels)
    what = f"rms over rows, {100 * BANDS:.0f} % band" if study.sample is None else "single rows"
    _title(figure, f"{study.title or study.name}: {what}")
    return figure


def map_figure(
    study: Study, done: pd.DataFrame, paths: tuple[str, str], shown: list[str]
) -> Figure:
    """Draw maps of the rms of each figure over two factors, whatever the other factors are."""
    figure, panels = panel_grid(len(shown), *PANEL)
    for axes, name in zip(panels, shown, strict=True):
        squares = done.assign(square=done[name] ** 2)
        table = np.sqrt(squares.pivot_table("square", paths[0], paths[1], "mean", sort=False))
        rms: Array = table.to_numpy(dtype=float)
        picture = axes.imshow(rms, aspect="auto", origin="lower")
        # White letters are hard to read on the bright upper part of the colour map.
        bright = 0.4 * np.nanmin(rms) + 0.6 * np.nanmax(rms)
        for (row, column), value in np.ndenumerate(rms):
            ink = "black" if value > bright else "white"
            axes.text(
                column, row, f"{value:.3g}", ha="center", va="center", color=ink, fontsize="small"
            )
        axes.set_xticks(range(table.shape[1]), [short_number(value) for value in table.columns])
        axes.set_yticks(range(table.shape[0]), [short_number(value) for value in table.index])
        axes.set_xlabel(axis_label(paths[1], study))
        axes.set_ylabel(axis_label(paths[0], study))
        axes.spines[:].set_visible(False)
        figure.colorbar(picture, ax=axes, label=axis_label(name, study))
    _title(figure, f"{study.title or study.name}: rms over rows")
    return figure


def laws_figure(study: Study, done: pd.DataFrame, laws: list[tuple[Law, Verdict]]) -> Figure:
    """Plot the quantity of each law against its factor, with the power law that is expected.

    Axes with positive values are logarithmic.
    """
    figure, panels = panel_grid(len(laws), *PANEL)
    # Panels over several factors share one legend, so each label has one look in all of them.
    looks: dict[str, int] = {}
    for axes, (law, verdict) in zip(panels, laws, strict=True):
        factor = str(law.factor)
        others = [path for path in study.factors if path != factor and factor in study.factors]
        have = rows_with_figures(law, done)
        curves = _curves(have, others)
        for index, (label, rows) in enumerate(curves):
            levels = _beside(_levels(study, rows, factor), index, len(curves))
            look = looks.setdefault(label, len(looks))
            _curve(axes, levels, law_data(law, rows), label, look)
        _theory_line(axes, have[factor], law_data(law, have), law.exponent or 0.0)
        scale(axes, _levels(study, have, factor))
        axes.set_title(
            f"{verdict.verdict}: {verdict.measured:.4g} ({verdict.low:.4g} to {verdict.high:.4g})\n"
            f"theory: {law.exponent or 0.0:g}",
            fontsize="medium",
        )
        axes.set_xlabel(axis_label(factor, study))
        axes.set_ylabel(axis_label(law.figure, study, law.per))
    _legend_below(figure, panels)
    _title(
        figure,
        f"{study.title or study.name}: measured exponent and its {100 * LAWS:.0f} % interval",
    )
    return figure


def _levels(study: Study, rows: pd.DataFrame, factor: str) -> pd.Series:
    """Return the value of a factor in each row.

    If the factor is a figure, the value is its mean over the rows of the same point.
    """
    if factor in study.factors or not study.factors:
        return rows[factor]
    return rows.groupby(list(study.factors))[factor].transform("mean")


def _title(figure: Figure, text: str) -> None:
    """Write a title above all panels, for which the figure grows, in as many lines as it needs.

    The title says if data lie beyond the frame of a panel, see WIDEST_BAND.
    """
    drawn = [(axes.get_ylim(), line.get_ydata()) for axes in figure.axes for line in axes.lines]
    if any(np.min(values) < low or np.max(values) > high for (low, high), values in drawn):
        text += "; what lies beyond the frame is cut"
    lines = wrap(text, round(LETTERS_PER_INCH * figure.get_figwidth()))
    figure.suptitle("\n".join(lines), fontsize=9)
    figure.set_figheight(figure.get_figheight() + LINE_IN * len(lines))


def _legend_below(figure: Figure, panels: Sequence[Axes]) -> None:
    """Draw one legend below all panels, for which the figure grows, if any curve has a label."""
    entries: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        entries = dict(zip(labels, handles, strict=True)) | entries
    if set(entries) - {"rows"}:
        fits = int(LETTERS_PER_INCH * figure.get_figwidth() / (max(map(len, entries)) + 8))
        columns = max(1, min(fits, len(entries)))
        style: Any = {"loc": "outside lower center", "fontsize": "small", "ncols": columns}
        figure.legend(entries.values(), entries, **style)
        figure.set_figheight(figure.get_figheight() + LINE_IN * -(-len(entries) // columns))


def _curves(done: pd.DataFrame, others: list[str]) -> list[tuple[str, pd.DataFrame]]:
    """Return a label and the rows for each setting of the other factors.

    If there are too many settings, all rows are one curve.
    """
    groups = list(done.groupby(others, sort=False)) if others else []
    if len(groups) > MOST_CURVES:
        return [(f"rows of all {len(groups)} other settings", done)]
    if len(groups) < 2:
        return [("", done)]
    return [
        (", ".join(setting(path, value) for path, value in zip(others, values, strict=True)), rows)
        for values, rows in groups
    ]


def _beside(levels: pd.Series, index: int, count: int) -> pd.Series:
    """Shift the levels of one of several curves, if positive, so that bands do not overlap."""
    if count == 1 or not pd.api.types.is_numeric_dtype(levels) or not (levels > 0).all():
        return levels
    return levels * BESIDE ** (index - (count - 1) / 2)


def _curve(axes: Axes, levels: pd.Series, values: Array, label: str, look: int) -> None:
    """Draw the rms at each level with its band.

    ``look`` is a number that chooses marker, line and colour. Markers differ even without colour.
    """
    groups = pd.Series(values, index=levels.index).groupby(
        levels, sort=pd.api.types.is_numeric_dtype(levels)
    )
    drawn, points = zip(
        *[(level, point_statistics(one.to_numpy())) for level, one in groups], strict=True
    )
    abscissae = _shown(pd.Series(drawn))
    rms = np.array([point.rms for point in points])
    low, high = np.array([point.rms_band or (point.rms, point.rms) for point in points]).T
    axes.errorbar(
        abscissae,
        rms,
        yerr=(rms - low, high - rms),
        capsize=3,
        markersize=4,
        linewidth=1.2,
        label=label or "rows",
        fmt=MARKERS[look % len(MARKERS)] + LINES[look % len(LINES)],
        color=f"C{look % 10}",
    )


def _theory_line(axes: Axes, factor: pd.Series, values: Array, exponent: float) -> None:
    """Draw the power law with this exponent through the middle of the data.

    Nothing is drawn if a value of the factor is not positive, because a power law needs positive
    values.
    """
    x = pd.to_numeric(factor, errors="coerce").to_numpy(dtype=float)
    if not np.all(x > 0.0):
        return
    level = np.sqrt(np.mean((values / x**exponent) ** 2))
    ends = np.geomspace(x.min(), x.max(), 50)
    axes.plot(ends, level * ends**exponent, "--k", linewidth=1, label="theory")


def scale(axes: Axes, factor: pd.Series) -> None:
    """Make each axis logarithmic if all its values are positive, with ticks that do not touch."""
    if pd.api.types.is_numeric_dtype(factor) and (factor > 0).all() and factor.nunique() > 1:
        axes.set_xscale("log")
        levels = (
            sorted(factor.unique())
            if factor.nunique() <= MOST_TICKS
            else _log_ticks(*axes.get_xlim())
        )
        letters = max(len(short_number(float(value))) for value in levels)
        room = 0.02 + LETTER * letters  # the longest number, and a gap
        _set_ticks(axes.xaxis, _far_apart(levels, *axes.get_xlim(), room))
    drawn = np.concatenate(
        [np.asarray(line.get_ydata(), dtype=float).ravel() for line in axes.lines]
    )
    if (drawn > 0).all():
        axes.set_yscale("log")
        curves = [
            np.asarray(line.get_ydata(), dtype=float)
            for line in axes.lines
            if line.get_linestyle() != "None"
        ]
        middle = np.concatenate(curves or [drawn])
        low = max(drawn.min(), middle.min() / WIDEST_BAND)
        high = min(drawn.max(), middle.max() * WIDEST_BAND)
        # 1.08 leaves a margin around the data.
        widen = 1.08 * max(1.0, np.sqrt(LEAST_SPAN * low / high))
        axes.set_ylim(low / widen, high * widen)
        _set_ticks(axes.yaxis, _log_ticks(*axes.get_ylim()))
    else:
        axes.yaxis.set_major_locator(MaxNLocator(MOST_TICKS))
    axes.grid(alpha=0.3)


def _log_ticks(low: float, high: float) -> list[float]:
    """Return round numbers between the ends of a logarithmic axis, as many as fit."""
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    inside: list[float] = []
    for mantissas in TICKS:
        ticks = [mantissa * 10.0**decade for decade in decades for mantissa in mantissas]
        inside = [value for value in ticks if low <= value <= high]
        if len(inside) <= MOST_TICKS and _far_apart(inside, low, high) == inside:
            return inside
    # No choice fits, so every k-th tick of the last choice is used, with k rounded up.
    return inside[:: -(-len(inside) // MOST_TICKS)]


def _set_ticks(axis: Axis, values: list[float]) -> None:
    axis.set_major_locator(FixedLocator(values))
    axis.set_major_formatter(FuncFormatter(lambda value, place: short_number(float(value))))
    axis.set_minor_locator(NullLocator())


def _far_apart(
    values: list[float], low: float, high: float, distance: float = NEAREST_TICKS
) -> list[float]:
    """Return a selection of ascending values with a minimum distance.

    `distance` is a fraction of the logarithmic axis from `low` to `high`.
    """
    kept: list[float] = []
    for value in values:
        if not kept or np.log(value / kept[-1]) >= distance * np.log(high / low):
            kept.append(value)
    return kept


def _shown(values: pd.Series) -> Any:
    return (
        values.to_numpy()
        if pd.api.types.is_numeric_dtype(values)
        else values.astype(str).to_numpy()
    )
