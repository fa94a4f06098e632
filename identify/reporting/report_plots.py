"""Interactive plots of the report, as HTML fragments that share one copy of plotly's JavaScript."""

from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go
import plotly.offline
from plotly.subplots import make_subplots

from identify.arrays import Array
from identify.files.run_folder import rms_row
from identify.reporting.figures import BAND, COMPONENTS, LETTERS, interval_bars
from identify.reporting.goals import VALIDATION_UM, VALIDATION_URAD

BLACK, GREEN, BLUE, RED = "black", "#2ca02c", "#1f77b4", "#d62728"
AXIS_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c")


def plotly_javascript() -> str:
    """The whole of plotly's JavaScript, to stand once in the report so that it opens offline."""
    return str(plotly.offline.get_plotlyjs())


def trajectory_plot(time: Array, poses: Array) -> str:
    """Position and orientation of a trajectory (N, 6) [m, rad], like figure 11."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, subplot_titles=("(a) position", "(b) orientation"))
    for i in range(6):
        values = 1e3 * (poses[:, i] - poses[0, i])
        figure.add_trace(_line(time, values, COMPONENTS[i], AXIS_COLOURS[i % 3]), row=1 + i // 3, col=1)
    figure.update_yaxes(title_text="from start [mm]", row=1)
    figure.update_yaxes(title_text="from start [mrad]", row=2)
    figure.update_xaxes(title_text="time [s]", row=2)
    return _html(figure, 550)


def fit_plot(
    time: Array,
    measured: Array,
    initial: Array | None,
    identified: Array,
    truth: Array | None = None,
    std: Array | None = None,
) -> str:
    """Six panels of poses and six of errors, like figures 12 and 13; poses (N, 6) [m, rad], NaN where there is none.

    std (N, 6): predicted standard deviation of the true error, drawn as a band.
    """
    titles = [f"{letter} {name}" for letter, name in zip(LETTERS, COMPONENTS, strict=True)]
    errors = [f"error of {name}" for name in COMPONENTS]
    figure = make_subplots(rows=4, cols=3, shared_xaxes=True, subplot_titles=titles + errors, vertical_spacing=0.05)
    for i in range(6):
        row, column, first = 1 + i // 3, 1 + i % 3, i == 0
        models = [("identified model", identified, BLUE)]
        if initial is not None:
            models.insert(0, ("starting model", initial, GREEN))
        traces = [
            _dots(time, 1e3 * measured[:, i], "measured"),
            *(_line(time, 1e3 * poses[:, i], name, colour) for name, poses, colour in models),
        ]
        for trace in traces:
            figure.add_trace(trace.update(showlegend=first), row=row, col=column)
        rest = [_dots(time, 1e6 * (measured - identified)[:, i], "measured − identified")]
        if truth is not None:
            rest.append(_line(time, 1e6 * (truth - identified)[:, i], "true − identified", RED))
        if std is not None:
            rest += _band(time, BAND * 1e6 * std[:, i])
        for trace in rest:
            figure.add_trace(trace.update(showlegend=first and trace.showlegend is not False), row=row + 2, col=column)
        figure.update_yaxes(title_text="[mm]" if i < 3 else "[mrad]", row=row, col=column)
        figure.update_yaxes(title_text="[um]" if i < 3 else "[urad]", row=row + 2, col=column)
        figure.update_yaxes(range=_range(1e3 * measured[:, i]), row=row, col=column)
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
    shown = {n: p for n, p in parameters.items() if p["identifiable"] and p["true"] and p["estimate"] is not None}
    error = [100 * (p["estimate"] - p["true"]) / abs(p["true"]) for p in shown.values()]
    bars = [[100 * one / abs(p["true"]) for one in interval_bars(p)] for p in shown.values()]
    below, above = [one[0] for one in bars], [one[1] for one in bars]
    trace = go.Scatter(
        x=list(shown),
        y=error,
        error_y={"type": "data", "array": above, "arrayminus": below},
        mode="markers",
        marker_color=BLUE,
        showlegend=False,
    )
    figure = go.Figure(trace)
    figure.add_hrect(y0=-5, y1=5, fillcolor=GREEN, opacity=0.1, line_width=0)
    figure.update_yaxes(title_text="estimate − truth, bars: 95 % interval [%]")
    return _html(figure, 450)


def _line(time: Array, values: Array, name: str, colour: str) -> Any:
    return go.Scatter(x=time, y=values, name=name, mode="lines", line={"color": colour, "width": 1.3}, legendgroup=name)


def _band(time: Array, half: Array) -> list[Any]:
    """Lower and upper edge of the predicted band, the space between them filled."""
    name = f"predicted ± {BAND:g} std"
    edge = {"color": RED, "width": 0.3}
    shared = {"x": time, "mode": "lines", "line": edge, "legendgroup": name, "hoverinfo": "skip"}
    return [
        go.Scatter(y=-half, showlegend=False, name=f"−{name}", **shared),
        go.Scatter(y=half, name=name, fill="tonexty", fillcolor="rgba(214, 39, 40, 0.15)", **shared),
    ]


def correlation_plot(correlations: Array, names: Sequence[str]) -> str:
    """Correlations (n, n) of estimates as a coloured matrix."""
    labels = list(names)
    shown = go.Heatmap(
        x=labels,
        y=labels,
        z=correlations,
        zmin=-1,
        zmax=1,
        colorscale="RdBu",
        reversescale=True,
        colorbar={"title": "correlation"},
    )
    figure = go.Figure(shown)
    figure.update_yaxes(autorange="reversed")
    return _html(figure, 200 + 20 * len(labels))


def _dots(time: Array, values: Array, name: str) -> Any:
    return go.Scatter(x=time, y=values, name=name, mode="markers", marker={"color": BLACK, "size": 3}, legendgroup=name)


def _range(values: Array) -> list[float]:
    """Range of the measurement with half as much around it: an unstable starting model must not hide the rest."""
    low, high = float(min(values[values == values])), float(max(values[values == values]))
    reach = (high - low) / 2 or 1.0
    return [low - reach, high + reach]


def _html(figure: Any, height: int) -> str:
    figure.update_layout(height=height, margin={"l": 60, "r": 20, "t": 40, "b": 50}, template="plotly_white")
    return str(figure.to_html(full_html=False, include_plotlyjs=False, config={"displaylogo": False}))
