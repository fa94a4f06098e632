"""Interactive plots of the report, as HTML fragments that share one copy of plotly's JavaScript."""

from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from identify.arrays import Array
from identify.files.run_folder import rms_row
from identify.reporting.figures import (
    BAND,
    BAND_NAME,
    BLUE,
    COMPONENTS,
    GREEN,
    LETTERS,
    RED,
    Curve,
    Fit,
    relative_errors,
)
from identify.reporting.goals import VALIDATION_UM, VALIDATION_URAD

AXIS_COLOURS = (BLUE, "#ff7f0e", GREEN)


def trajectory_plot(time: Array, poses: Array) -> str:
    """Position and orientation of a trajectory (N, 6) [m, rad], like figure 11."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, subplot_titles=("(a) position", "(b) orientation"))
    for i in range(6):
        values = 1e3 * (poses[:, i] - poses[0, i])
        trace = _trace(time, Curve(COMPONENTS[i], values, AXIS_COLOURS[i % 3]))
        figure.add_trace(trace, row=1 + i // 3, col=1)
    figure.update_yaxes(title_text="from start [mm]", row=1)
    figure.update_yaxes(title_text="from start [mrad]", row=2)
    figure.update_xaxes(title_text="time [s]", row=2)
    return _html(figure, 550)


def fit_plot(fit: Fit) -> str:
    """Six panels of poses and six of errors, like figures 12 and 13."""
    titles = [f"{letter} {name}" for letter, name in zip(LETTERS, COMPONENTS, strict=True)]
    errors = [f"error of {name}" for name in COMPONENTS]
    figure = make_subplots(rows=4, cols=3, shared_xaxes=True, subplot_titles=titles + errors, vertical_spacing=0.05)
    for i in range(6):
        row, column = 1 + i // 3, 1 + i % 3
        above = [_trace(fit.time, curve) for curve in fit.pose_curves(i)]
        below = [_trace(fit.time, curve) for curve in fit.error_curves(i)]
        if fit.std is not None:
            below += _band(fit.time, BAND * 1e6 * fit.std[:, i])
        for traces, place in ((above, row), (below, row + 2)):
            for trace in traces:
                figure.add_trace(
                    trace.update(showlegend=i == 0 and trace.showlegend is not False), row=place, col=column
                )
        figure.update_yaxes(title_text="[mm]" if i < 3 else "[mrad]", range=fit.pose_range(i), row=row, col=column)
        figure.update_yaxes(title_text="[um]" if i < 3 else "[urad]", row=row + 2, col=column)
    figure.update_xaxes(title_text="time [s]", row=4)
    return _html(figure, 1000)


def validation_plot(validation: list[dict[str, Any]]) -> str:
    """RMS of the identified model against the truth on each unseen trajectory, with the goals."""
    figure = make_subplots(rows=1, cols=2, subplot_titles=("position", "orientation"))
    runs = [str(n) for n in range(1, len(validation) + 1)]
    for i in range(6):
        values = [rms_row(run["true"])[i] for run in validation]
        bar = go.Bar(x=runs, y=values, name=COMPONENTS[i], marker_color=AXIS_COLOURS[i % 3])
        figure.add_trace(bar, row=1, col=1 + i // 3)
    for column, limit, unit in ((1, VALIDATION_UM, "um"), (2, VALIDATION_URAD, "urad")):
        figure.add_hline(y=limit, line_dash="dash", annotation_text=f"goal {limit:g} {unit}", row=1, col=column)
        figure.update_yaxes(title_text=f"RMS against truth [{unit}]", row=1, col=column)
    figure.update_xaxes(title_text="unseen trajectory")
    return _html(figure, 420)


def parameter_plot(parameters: dict[str, dict[str, Any]]) -> str:
    """Relative error of every identifiable parameter with its 95 % interval."""
    names, error, below, above = relative_errors(parameters)
    bars = {"type": "data", "array": above, "arrayminus": below}
    figure = go.Figure(go.Scatter(x=names, y=error, error_y=bars, mode="markers", marker_color=BLUE, showlegend=False))
    figure.add_hrect(y0=-5, y1=5, fillcolor=GREEN, opacity=0.1, line_width=0)
    figure.update_yaxes(title_text="estimate − truth, bars: 95 % interval [%]")
    return _html(figure, 450)


def correlation_plot(correlations: Array, names: Sequence[str]) -> str:
    """Correlations (n, n) of estimates as a coloured matrix."""
    labels, scale = list(names), {"zmin": -1, "zmax": 1, "colorscale": "RdBu", "reversescale": True}
    figure = go.Figure(go.Heatmap(x=labels, y=labels, z=correlations, colorbar={"title": "correlation"}, **scale))
    figure.update_yaxes(autorange="reversed")
    return _html(figure, 200 + 20 * len(labels))


def _trace(time: Array, curve: Curve) -> Any:
    style = {"marker": {"size": 3}, "mode": "markers"} if curve.dots else {"line": {"width": 1.3}, "mode": "lines"}
    trace = go.Scatter(x=time, y=curve.values, name=curve.name, legendgroup=curve.name, **style)
    return trace.update(marker_color=curve.colour, line_color=curve.colour)


def _band(time: Array, half: Array) -> list[Any]:
    """Lower and upper edge of the predicted band, the space between them filled."""
    edge = {"color": RED, "width": 0.3}
    shared = {"x": time, "mode": "lines", "line": edge, "legendgroup": BAND_NAME, "hoverinfo": "skip"}
    return [
        go.Scatter(y=-half, showlegend=False, name=f"−{BAND_NAME}", **shared),
        go.Scatter(y=half, name=BAND_NAME, fill="tonexty", fillcolor="rgba(214, 39, 40, 0.15)", **shared),
    ]


def _html(figure: Any, height: int) -> str:
    figure.update_layout(height=height, margin={"l": 60, "r": 20, "t": 40, "b": 50}, template="plotly_white")
    return str(figure.to_html(full_html=False, include_plotlyjs=False, config={"displaylogo": False}))
