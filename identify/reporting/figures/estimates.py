"""Figures of the parameters of a result.

They show the errors of the parameters, the parts of the base parameters, and the correlations of
the estimates.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.arrays import Array
from identify.estimation.budget import Budget
from identify.reporting.figures.style import BLUE, GREY, LINE, PALETTE, PAPER, WIDTH
from identify.reporting.goals import PARAMETER_FRACTION, is_friction_or_pid


class RelativeErrors(NamedTuple):
    """Relative errors (n,) of parameters with their names, in per cent of the truth.

    ``below`` and ``above`` are the distances from the estimate to the ends of the 95 % interval.
    """

    names: list[str]
    error: Array
    below: Array
    above: Array


def relative_errors(parameters: dict[str, dict[str, Any]]) -> RelativeErrors:
    """Return the relative errors of the identified parameters of a result.

    Without an interval, the distances to its ends are zero. If the truth is not known, values are
    in per cent of the estimate, and the error is zero. Parameters that are zero are left out.
    """
    shown = {
        n: p
        for n, p in parameters.items()
        if p["identifiable"] and _size(p) and p["estimate"] is not None
    }
    rows = [
        (_size(p), p["estimate"], *(p.get("interval") or 2 * [p["estimate"]]))
        for p in shown.values()
    ]
    reference, estimate, low, high = np.array(rows, dtype=float).reshape(-1, 4).T
    percent = 100 / np.abs(reference)
    return RelativeErrors(
        list(shown),
        percent * (estimate - reference),
        percent * (estimate - low),
        percent * (high - estimate),
    )


def _size(parameter: dict[str, Any]) -> float | None:
    """Return the truth or, if it is not known, the estimate."""
    true: float | None = parameter["true"]
    return parameter["estimate"] if true is None else true


def parameter_figure(parameters: dict[str, dict[str, Any]]) -> Figure:
    """Draw the relative error of every identified parameter with its 95 % interval.

    Friction and gains have a panel of their own.
    """
    judged = {name: p for name, p in parameters.items() if is_friction_or_pid(name)}
    others = {name: p for name, p in parameters.items() if name not in judged}
    groups = {"friction and joint controller": judged, "masses and inertias": others}
    shown = {title: relative_errors(group) for title, group in groups.items()}
    # Height in inches: margins, and a row for each parameter of the larger panel.
    height = max(2.2, 0.9 + 0.19 * max(len(found.names) for found in shown.values()))
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    label = "estimate − truth [% of the truth]"
    if all(p["true"] is None for p in parameters.values()):
        label = "95 % interval [% of the estimate]"
    for axes, (title, found) in zip(figure.subplots(1, 2), shown.items(), strict=True):
        rows = np.arange(len(found.names))
        reach = 100 * PARAMETER_FRACTION
        axes.axvspan(-reach, reach, color=LINE, alpha=0.5, linewidth=0)
        axes.axvline(0, color=GREY, linewidth=0.8)
        axes.errorbar(
            found.error,
            rows,
            xerr=(found.below, found.above),
            fmt="o",
            color=BLUE,
            capsize=2.5,
            elinewidth=1,
        )
        axes.set_yticks(rows, found.names)
        axes.invert_yaxis()
        axes.set_xlabel(label)
        axes.set_title(title)
        axes.grid(visible=False, axis="y")
        if not found.names:
            axes.text(
                0.5, 0.5, "none is identified", transform=axes.transAxes, ha="center", color=GREY
            )
            axes.set_yticks([])
    return figure


def group_figure(
    groups: Mapping[str, dict[str, Any]], parameters: Mapping[str, dict[str, Any]]
) -> Figure:
    """Draw which parameters each base parameter combines.

    A row is a base parameter that combines several parameters, and a column is a parameter. A dot
    is a term: coefficient times initial guess. Its area is the fraction of the sum of all absolute
    terms, and it is open if the term is negative. A star marks an identified base parameter.
    """
    sums = {name: group for name, group in groups.items() if len(group["coefficients"]) > 1}
    columns = [
        name for name in parameters if any(name in group["coefficients"] for group in sums.values())
    ]
    shares = np.zeros((len(sums), len(columns)))
    for row, group in enumerate(sums.values()):
        parts = {
            n: weight * (parameters[n]["initial"] or 0.0)
            for n, weight in group["coefficients"].items()
        }
        total = sum(abs(part) for part in parts.values()) or 1.0
        # The sign of the fraction decides whether the dot is filled or open.
        for name, part in parts.items():
            shares[row, columns.index(name)] = part / total
    # Parameters with an initial guess of zero would have no dot.
    used = [k for k in range(len(columns)) if shares[:, k].any()]
    labels = [
        f"{name.removesuffix(' +')} …{' *' if group['identifiable'] else ''}"
        for name, group in sums.items()
    ]
    figure = Figure(figsize=(WIDTH, 1.3 + 0.185 * len(labels)), layout="constrained")
    axes = figure.subplots()
    if not labels:
        axes.set_axis_off()
        axes.set_title("The motion shows every parameter separately: there are no sums")
        return figure
    dot_matrix(axes, shares[:, used], labels, [columns[k] for k in used])
    _key(axes, (1.0, 0.25, 0.05), "share of the sum of sizes", "subtracted")
    return figure


def correlation_figure(correlations: Array, names: Sequence[str]) -> Figure:
    """Draw the correlations (n, n) of the estimates.

    The area of a dot is the size of a correlation. The dot is open if the correlation is negative.
    Without parameters, the figure has a line of text instead.
    """
    side = min(WIDTH, max(4.0, 1.4 + 0.2 * len(names)))
    figure = Figure(figsize=(side + 0.3, side), layout="constrained")
    axes = figure.subplots()
    if not len(names):
        axes.set_axis_off()
        axes.set_title("No parameter is identified: no correlations")
        return figure
    # The matrix is symmetric with ones on the diagonal, so that its lower triangle is sufficient.
    dot_matrix(axes, np.tril(correlations, -1), names, names)
    _key(axes, (1.0, 0.5, 0.1), "correlation", "negative")
    return figure


def dot_matrix(axes: Axes, values: Array, rows: Sequence[str], columns: Sequence[str]) -> None:
    """Draw values (rows, columns) from -1 to 1 as dots.

    The area of a dot is the size of its value. The dot is open if the value is negative.
    """
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=6.5)
    axes.set_yticks(range(len(rows)), rows, fontsize=6.5)
    axes.set_xlim(-0.7, len(columns) - 0.3)
    axes.set_ylim(len(rows) - 0.3, -0.7)
    axes.tick_params(length=0)
    for seen, sign in ((values > SMALLEST, 1.0), (values < -SMALLEST, -1.0)):
        cells = np.argwhere(seen)
        axes.scatter(cells[:, 1], cells[:, 0], **_dots(sign * values[seen], sign), zorder=3)


SMALLEST = 0.004  # size of a value below which its dot would not be visible
LARGEST = 58.0  # area of the dot for a value of one, in square points


def _dots(sizes: Array | float, sign: float) -> dict[str, Any]:
    face = BLUE if sign > 0 else PAPER
    return {
        "s": LARGEST * np.asarray(sizes),
        "facecolor": face,
        "edgecolor": BLUE,
        "linewidth": 0.8,
    }


def _key(axes: Axes, sizes: Sequence[float], meaning: str, negative: str) -> None:
    """Draw a legend of the dots above the panel."""
    # Empty plots put entries into the legend without drawing anything.
    for size in sizes:
        axes.scatter([], [], label=f"{size:g}", **_dots(size, 1.0))
    axes.scatter([], [], label=negative, **_dots(sizes[1], -1.0))
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=len(sizes) + 1,
        title=f"{meaning}:",
        alignment="left",
    )


# Hatches of the sources of a budget. Source after source has the next colour and the next hatch,
# and one hatch is skipped after each round of colours, so that other pairs follow.
HATCHES = ("", "////", "....", "xxxx", "----", "\\\\\\\\")


def budget_figure(budget: Budget, identified: Mapping[str, bool]) -> Figure:
    """Draw the share of each source in the variance of poses, predictions and parameters.

    The rows are poses and predictions, and then the ``identified`` parameters, sorted by the share
    of the source with the largest mean share. The number beside a row is the combined standard
    uncertainty. Shares that are negative, because of correlations, are left out.
    """
    names = budget.quantities
    shown = [k for k, name in enumerate(names) if budget.std[k] > 0 and identified.get(name, True)]
    shares = 100 * np.maximum(budget.shares[shown], 0)
    order = np.argsort(-shares.mean(axis=0), kind="stable")
    # Poses and predictions keep their order.
    main = [
        shares[row, order[0]] if names[k] in identified else np.inf for row, k in enumerate(shown)
    ]
    rank = np.argsort(-np.array(main), kind="stable")
    shown = [shown[row] for row in rank]
    shares = shares[rank]
    colours = list(PALETTE.values())[4:]
    figure = Figure(figsize=(WIDTH, 1.1 + 0.15 * len(shown)), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(len(shown))
    left = np.zeros(len(shown))
    for number, source in enumerate(order):
        if not shares[:, source].any():
            continue
        axes.barh(
            rows,
            shares[:, source],
            left=left,
            height=0.8,
            color=colours[number % len(colours)],
            edgecolor=PAPER,
            linewidth=0.3,
            hatch=HATCHES[(number + number // len(colours)) % len(HATCHES)],
            label=budget.words[source],
        )
        left += shares[:, source]
    units = [one.replace("urad", "µrad").replace("um", "µm") for one in budget.units]
    labels = [f"{budget.quantities[k]}: {budget.std[k]:.2g} {units[k]}" for k in shown]
    axes.set_yticks(rows, labels, fontsize=6)
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.set_xlim(0, 100)
    axes.set_xlabel("share of the variance [%]")
    axes.grid(visible=False, axis="y")
    handles, words = axes.get_legend_handles_labels()
    figure.legend(handles, words, loc="outside upper left", ncols=2)
    return figure
