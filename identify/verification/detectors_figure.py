"""Figure of the detectors: error over noise beside the Cramer-Rao bound, one panel for each way a disc is seen."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from cmmsim.detector_leaderboard import Score
from cmmsim.drawn_discs import Condition
from identify.files.figure import blank_figure

COLUMNS = 3


def detectors_figure(scores: Sequence[Score], at_work: Condition) -> Figure:
    """Rms error over noise, logarithmic; one panel for each radius, tilt and point spread, the working point first."""
    views = list(dict.fromkeys(_view(score.condition) for score in scores))
    columns = min(COLUMNS, len(views))
    rows = -(-len(views) // columns)
    figure = blank_figure(4.5 * columns, 0.8 + 3.2 * rows)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flat
    for view, axes in zip(views, panels, strict=False):
        _panel(axes, [score for score in scores if _view(score.condition) == view])
        radius, tilt, psf = view
        work = "working point: " if view == _view(at_work) else ""
        seen = f"radius {radius:.3g} px, tilt {np.degrees(tilt):.0f}°, σ_psf {psf:.2g} px"
        axes.set_title(work + seen, fontsize="small")
    for axes in list(panels):
        axes.set_visible(False)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle("Error of a sticker's centre in the image")
    return figure


def _view(condition: Condition) -> tuple[float, float, float]:
    return condition.radius_px, condition.tilt, condition.psf_px


def _panel(axes: Axes, scores: Sequence[Score]) -> None:
    noise = sorted({score.condition.noise for score in scores})
    bound = {score.condition.noise: score.bound_px for score in scores}
    axes.plot(100.0 * np.array(noise), [bound[n] for n in noise], "k--", marker="_", label="Cramer-Rao bound")
    for name in dict.fromkeys(score.detector for score in scores):
        mine = sorted((s for s in scores if s.detector == name), key=lambda s: s.condition.noise)
        error = np.array([s.rms_px for s in mine])  # infinite where all was lost: not drawn
        at = [100.0 * s.condition.noise for s in mine]
        axes.plot(at, np.where(np.isfinite(error), error, np.nan), "o-", markersize=3, label=name.replace("_", " "))
    axes.set(xscale="log", yscale="log", xlabel="noise [% of contrast]", ylabel="rms error [px]")
    axes.set_xticks(100.0 * np.array(noise), [f"{100.0 * n:.2g}" for n in noise])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.3, which="both")
