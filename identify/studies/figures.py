"""PNG figures of a study: figures against each factor with bands, two factors as a map, and the laws."""

from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from identify.arrays import Array
from identify.files.atomic import write_figure
from identify.reporting.figures import panel_grid
from identify.studies.study_file import Law, Study
from identify.studies.table import labelled
from identify.studies.theory import BAND_CONFIDENCE as BANDS
from identify.studies.theory import CONFIDENCE as LAWS
from identify.studies.theory import Verdict, law_data, point_statistics, with_data

PANEL = (5.0, 3.8)
"""Size of a panel, inches."""
LEAST_SPAN = 2.0
"""Smallest ratio of the ends of a logarithmic axis: small differences shall look small."""
LETTERS_PER_INCH = 10.0
"""Letters of a title, a little fewer than there is room for."""
MOST_CURVES = 6
"""Settings of the other factors that are drawn as curves of their own; more are drawn as one."""


def draw(folder: Path, study: Study, done: pd.DataFrame, shown: list[str], verdicts: list[Verdict]) -> None:
    """Write the figures of a study's finished rows; `shown`: the figures of the rows that are drawn."""
    if not len(done) or not shown:
        return
    for path in study.factors:
        write_figure(folder / f"by_{path}.png", factor_figure(study, done, path, shown))
    grid = [path for path, values in study.factors.items() if isinstance(values, list)]
    if study.sample is None and len(grid) >= 2:
        write_figure(folder / "map.png", map_figure(study, done, (grid[0], grid[1]), shown[:2]))
    laws = [
        (law, verdict)
        for law, verdict in zip(study.theory, verdicts, strict=True)
        if law.exponent is not None and verdict.measured is not None
    ]
    if laws:
        write_figure(folder / "laws.png", laws_figure(study, done, laws))


def factor_figure(study: Study, done: pd.DataFrame, path: str, shown: list[str]) -> Figure:
    """Rms of each figure against one factor with its band, a curve for each setting of the other factors."""
    figure, panels = panel_grid(len(shown), *PANEL)
    others = [other for other in study.factors if other != path]
    for axes, name in zip(panels, shown, strict=True):
        have = done.dropna(subset=[name])
        if study.sample is not None:
            axes.plot(_shown(have[path]), have[name], ".", markersize=4)
        else:
            for label, rows in _curves(have, others):
                _curve(axes, rows[path], rows[name].to_numpy(dtype=float), label)
        law = next((one for one in study.theory if (one.figure, one.per, one.factor) == (name, None, path)), None)
        if law is not None and law.exponent is not None:
            _theory_line(axes, have[path], have[name].to_numpy(dtype=float), law.exponent)
        _scale(axes, have[path], have[name])
        axes.set_xlabel(labelled(path, study))
        axes.set_ylabel(labelled(name, study))
        if axes.get_legend_handles_labels()[1]:
            axes.legend(fontsize="small")
    what = f"rms over rows, {BANDS:.0%} band" if study.sample is None else "single rows"
    _title(figure, f"{study.title or study.name}: {what}")
    return figure


def map_figure(study: Study, done: pd.DataFrame, paths: tuple[str, str], shown: list[str]) -> Figure:
    """Rms of each figure over two factors, over all settings of the others."""
    figure, panels = panel_grid(len(shown), *PANEL)
    for axes, name in zip(panels, shown, strict=True):
        squares = done.assign(square=done[name] ** 2)
        table = np.sqrt(squares.pivot_table("square", paths[0], paths[1], "mean", sort=False))
        rms: Array = table.to_numpy(dtype=float)
        picture = axes.imshow(rms, aspect="auto", origin="lower")
        bright = 0.4 * np.nanmin(rms) + 0.6 * np.nanmax(rms)
        for (row, column), value in np.ndenumerate(rms):
            ink = "black" if value > bright else "white"
            axes.text(column, row, f"{value:.3g}", ha="center", va="center", color=ink, fontsize="small")
        axes.set_xticks(range(table.shape[1]), [str(value) for value in table.columns])
        axes.set_yticks(range(table.shape[0]), [str(value) for value in table.index])
        axes.set_xlabel(labelled(paths[1], study))
        axes.set_ylabel(labelled(paths[0], study))
        figure.colorbar(picture, ax=axes, label=labelled(name, study))
    _title(figure, f"{study.title or study.name}: rms over rows")
    return figure


def laws_figure(study: Study, done: pd.DataFrame, laws: list[tuple[Law, Verdict]]) -> Figure:
    """What each law speaks of against its factor, on logarithmic axes, with the power that it states."""
    figure, panels = panel_grid(len(laws), *PANEL)
    for axes, (law, verdict) in zip(panels, laws, strict=True):
        factor = str(law.factor)
        others = [path for path in study.factors if path != factor and factor in study.factors]
        have = with_data(law, done)
        for label, rows in _curves(have, others):
            _curve(axes, _levels(study, rows, factor), law_data(law, rows), label)
        _theory_line(axes, have[factor], law_data(law, have), law.exponent or 0.0)
        _scale(axes, have[factor], pd.Series(law_data(law, have)))
        axes.set_title(
            f"{verdict.verdict}: {verdict.measured:.4g} ({verdict.low:.4g} to {verdict.high:.4g})", fontsize="small"
        )
        axes.set_xlabel(labelled(factor, study))
        axes.set_ylabel(labelled(law.quantity, study))
        axes.legend(fontsize="small")
    _title(figure, f"{study.title or study.name}: measured exponent and its {LAWS:.0%} interval")
    return figure


def _levels(study: Study, rows: pd.DataFrame, factor: str) -> pd.Series:
    """The factor's value in each row; where it is a figure, its mean over the rows of a point, if there are several."""
    if factor in study.factors or not study.factors:
        return rows[factor]
    return rows.groupby(list(study.factors))[factor].transform("mean")


def _title(figure: Figure, text: str) -> None:
    """A title above all panels, in as many lines as the width of the figure asks for."""
    figure.suptitle("\n".join(wrap(text, round(LETTERS_PER_INCH * figure.get_figwidth()))))


def _curves(done: pd.DataFrame, others: list[str]) -> list[tuple[str, pd.DataFrame]]:
    """Rows of each setting of the other factors, with a label; all together where there are too many."""
    groups = list(done.groupby(others, sort=False)) if others else []
    if len(groups) > MOST_CURVES:
        return [(f"rows of all {len(groups)} other settings", done)]
    if len(groups) < 2:
        return [("", done)]
    return [
        (", ".join(f"{path.rpartition('.')[2]} {value}" for path, value in zip(others, values, strict=True)), rows)
        for values, rows in groups
    ]


def _curve(axes: Axes, levels: pd.Series, values: Array, label: str) -> None:
    """Rms at each level with its band."""
    groups = pd.Series(values, index=levels.index).groupby(levels, sort=pd.api.types.is_numeric_dtype(levels))
    places, points = zip(*[(level, point_statistics(one.to_numpy())) for level, one in groups], strict=True)
    shown, rms = _shown(pd.Series(places)), np.array([point.rms for point in points])
    low, high = np.array([point.rms_band or (point.rms, point.rms) for point in points]).T
    axes.errorbar(shown, rms, yerr=(rms - low, high - rms), fmt="o-", capsize=3, markersize=4, label=label or "rows")


def _theory_line(axes: Axes, factor: pd.Series, values: Array, exponent: float) -> None:
    """The power law with that exponent through the middle of the data; none where the factor has no powers."""
    x = pd.to_numeric(factor, errors="coerce").to_numpy(dtype=float)
    if not np.all(x > 0.0):
        return
    level = np.sqrt(np.mean((values / x**exponent) ** 2))
    ends = np.geomspace(x.min(), x.max(), 50)
    axes.plot(ends, level * ends**exponent, "--", color="black", linewidth=1, label=f"theory, power {exponent:g}")


def _scale(axes: Axes, factor: pd.Series, values: pd.Series) -> None:
    """Logarithmic axes where everything is positive."""
    numeric = pd.api.types.is_numeric_dtype(factor)
    if numeric and (factor > 0).all() and factor.nunique() > 1:
        axes.set_xscale("log")
        if factor.nunique() <= 12:
            axes.set_xticks(sorted(factor.unique()), [f"{value:.4g}" for value in sorted(factor.unique())], minor=False)
            axes.xaxis.set_minor_locator(NullLocator())
        else:
            _plain_ticks(axes.xaxis)
    if (values > 0).all():
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        widen = max(1.0, np.sqrt(LEAST_SPAN * low / high))
        axes.set_ylim(low / widen, high * widen)
        _plain_ticks(axes.yaxis)
    axes.grid(alpha=0.3, which="both")


def _plain_ticks(axis: Axis) -> None:
    """Numbers as one writes them, where matplotlib would write powers of ten."""
    for ticks in (axis.set_major_formatter, axis.set_minor_formatter):
        ticks(FuncFormatter(lambda value, place: f"{value:.4g}"))


def _shown(values: pd.Series) -> Any:
    return values.to_numpy() if pd.api.types.is_numeric_dtype(values) else values.astype(str).to_numpy()
