"""Result of an identification as a notebook shows it: warnings, a picture and a table."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from identify.estimation.result import IdentificationResult


def result_html(result: IdentificationResult) -> str:
    """Return HTML with the one-line summary, the warnings, a picture and the identified rows."""
    table = result.table().query("identifiable").drop(columns="identifiable")
    warnings = "".join(f"<li>{html.escape(text)}</li>" for text in result.warnings)
    picture = base64.b64encode(relative_uncertainty_png(result)).decode()
    return (
        f"<p>{html.escape(repr(result).strip('<>'))}</p>"
        f"<ul>{warnings}</ul>"
        f'<img alt="standard deviation of the identified parameters" '
        f'src="data:image/png;base64,{picture}">'
        f"{table.to_html(float_format='%.6g')}"
    )


def relative_uncertainty_png(result: IdentificationResult) -> bytes:
    """Draw the change from the starting guess and the standard deviation of identified parameters.

    Both are in percent of the estimate.
    """
    from matplotlib.figure import Figure

    shown = np.flatnonzero(result.identifiable & (result.estimate != 0.0))
    scale = 100.0 / np.abs(result.estimate[shown])
    change = scale * np.abs(result.estimate - result.initial)[shown]
    figure = Figure(figsize=(7.0, 1.0 + 0.16 * len(shown)), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(len(shown))
    axes.plot(change, rows, "o", fillstyle="none", label="change from the starting guess")
    axes.plot(scale * result.std[shown], rows, "s", label="standard deviation")
    axes.set_yticks(rows, [result.names[k] for k in shown], fontsize="x-small")
    axes.set(xscale="log", xlabel="percent of the estimate")
    axes.invert_yaxis()
    axes.grid(visible=True, axis="x", alpha=0.3)
    axes.legend(fontsize="x-small")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    return stream.getvalue()
