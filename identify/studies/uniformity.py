"""Uniformity of the probabilities that rows give to values below the truth.

A figure whose name begins with `PROBABILITY` is the probability that a distribution stated by a row
gives to values below the truth. If the distribution is right, the figure is uniform between 0 and 1
over the rows. Each figure has a Kolmogorov-Smirnov test, with a correction for the number of
figures. The plot shows the cumulative distribution of each figure minus the uniform one. If the
estimates are too large, the curve is a single hill. If the intervals are too narrow, it has a hill
in the left half and a valley in the right half. The band contains the whole curve of a right
distribution with a probability of 95 % (Säilynoja, Bürkner and Vehtari 2022, "Graphical test for
discrete uniformity and its applications in goodness-of-fit evaluation and multiple sample
comparison").
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import binom, kstest

from identify.arrays import Array
from identify.studies.rows.kind import PROBABILITY

FEWEST = 20  # smallest number of rows with a figure for which it is tested
LEVEL = 0.01  # corrected p value below which a figure counts as not uniform
BAND = 0.95  # probability that the whole curve of a right distribution is in the band
POINTS = 200  # the band is computed at the multiples of 1 / POINTS between 0 and 1
# Number of simulated curves. The standard error of the probability of the band is 0.3 %.
SIMULATED = 4000


@dataclass(frozen=True)
class Uniformity:
    """Test of one figure.

    name         Name of the figure without `PROBABILITY`.
    point        Values of the factors, as text.
    values (n,)  The figure in the rows of the point that have it, ascending.
    p_value      p value of the Kolmogorov-Smirnov test.
    corrected    p value multiplied by the number of tests (Bonferroni), at most 1.
    """

    name: str
    point: tuple[str, ...]
    values: Array
    p_value: float
    corrected: float

    @property
    def rows(self) -> int:
        """Number of rows with the figure."""
        return len(self.values)

    @property
    def mean(self) -> float:
        """Mean of the figure, about 0.5 if the stated distributions are right."""
        return float(self.values.mean())

    @property
    def fails(self) -> bool:
        """True if the corrected p value is below LEVEL, so that the figure is not uniform."""
        return self.corrected < LEVEL

    @property
    def label(self) -> str:
        """Values of the factors, followed by the name of the figure."""
        return " ".join((*self.point, self.name))

    @property
    def entry(self) -> dict[str, Any]:
        """Test for JSON, without the values."""
        names = ("name", "point", "rows", "mean", "p_value", "corrected", "fails")
        return {name: getattr(self, name) for name in names}


def judge_uniformity(done: pd.DataFrame, factors: Sequence[str]) -> list[Uniformity]:
    """Return the tests of all probabilities in a table of rows, the smallest p value first.

    Each figure is tested at each point of the factors where enough rows have it.
    """
    figures = probabilities_at_points(done, factors)
    tests = []
    for (point, name), values in figures.items():
        p_value = float(kstest(values, "uniform").pvalue)
        corrected = min(1.0, p_value * len(figures))
        tests.append(Uniformity(name, point, np.sort(values), p_value, corrected))
    return sorted(tests, key=lambda one: one.p_value)


def probabilities_at_points(
    done: pd.DataFrame, factors: Sequence[str]
) -> dict[tuple[tuple[str, ...], str], Array]:
    """Return the probabilities by point and name, where at least FEWEST rows have the figure."""
    points = (
        [(tuple(map(str, key)), rows) for key, rows in done.groupby(list(factors))]
        if factors
        else [((), done)]
    )
    return {
        (point, name.removeprefix(PROBABILITY)): values
        for point, rows in points
        for name in done.columns
        if name.startswith(PROBABILITY)
        and len(values := rows[name].dropna().to_numpy(dtype=float)) >= FEWEST
    }


@lru_cache(maxsize=4)
def simultaneous_band(rows: int) -> tuple[Array, Array, Array]:
    """Return the band of the cumulative distribution of uniform numbers, minus its mean.

    The results are the points (k,) and the lower and upper ends (k,) of the band for a number of
    rows. At each point the ends are quantiles of the binomial distribution. All points have the
    same level of these quantiles, at which the band contains the whole curve with probability BAND.
    The level is found by simulation with a fixed seed.
    """
    points = np.arange(1, POINTS) / POINTS
    drawn = np.random.default_rng(0).random((SIMULATED, rows))
    counts = np.array([(drawn <= point).sum(axis=1) for point in points]).T
    lower_tail = binom.cdf(counts, rows, points)
    upper_tail = binom.sf(counts - 1, rows, points)
    level = np.quantile(2 * np.minimum(lower_tail, upper_tail).min(axis=1), 1 - BAND)
    low, high = binom.ppf([[level / 2], [1 - level / 2]], rows, points)
    return points, low / rows - points, high / rows - points


def uniformity_figure(found: list[Uniformity]) -> Figure:
    """Plot the curve of each tested figure, times the root of its number of rows, and the band.

    The band is that of the median number of rows. Figures that fail have a name and a colour.
    """
    rows = int(np.median([one.rows for one in found]))
    points, low, high = simultaneous_band(rows)
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    axes = figure.subplots()
    # The deviations of uniform numbers shrink with the root of their number.
    root = np.sqrt(rows)
    axes.fill_between(
        points, root * low, root * high, color="0.85", label=f"{BAND:.0%} band if uniform"
    )
    for one in reversed(found):
        curve = np.searchsorted(one.values, points, side="right") / one.rows - points
        style: dict[str, Any] = (
            {"label": one.label, "lw": 1.2} if one.fails else {"color": "0.4", "lw": 0.5}
        )
        axes.plot(points, np.sqrt(one.rows) * curve, **style)
    axes.set_xlabel("stated probability of values below the truth")
    axes.set_ylabel("(fraction of rows − probability) · √rows")
    axes.set_title(f"{len(found)} quantities, {sum(one.fails for one in found)} not uniform")
    axes.legend(fontsize="x-small", loc="upper right")
    return figure


def table(found: list[Uniformity]) -> list[str]:
    """Return the lines of a Markdown table of the tests."""
    lines = [
        "| quantity | rows | mean | p value | corrected | verdict |",
        "|---|---|---|---|---|---|",
    ]
    return lines + [
        f"| {one.label} | {one.rows} | {one.mean:.3f} | {one.p_value:.2g} | {one.corrected:.2g} | "
        f"{'not uniform' if one.fails else 'uniform'} |"
        for one in found
    ]
