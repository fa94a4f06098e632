"""Figure of the estimators: distances of parameters and poses, and time, one point each."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from identify.files.figure import blank_figure
from identify.validation.estimator_comparison import Score

PANELS = (
    ("base parameters", "median error [%]", "group_median", 100.0),
    ("unseen position", "worst RMS [um]", "position_um", 1.0),
    ("unseen orientation", "worst RMS [urad]", "orientation_urad", 1.0),
    ("time", "seconds", "seconds", 1.0),
)


def estimators_figure(scores: Sequence[Score]) -> Figure:
    """Points on logarithmic axes, one panel a figure of merit; what does not exist (an unstable model) has none."""
    figure = blank_figure(14, 1.2 + 0.42 * len(scores))
    places = np.arange(len(scores))[::-1]
    for axes, (title, label, field, factor) in zip(figure.subplots(1, len(PANELS), sharey=True), PANELS, strict=True):
        values = np.array([factor * getattr(score, field) for score in scores], dtype=float)
        axes.plot(np.where(values > 0, values, np.nan), places, "o", color="tab:blue")
        axes.set(title=title, xlabel=label, xscale="log")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].set_yticks(places, [score.title for score in scores])
    figure.suptitle("Estimators on one record, against one truth")
    return figure
