"""Variation of the estimates over several runs, compared with table 5 of the paper.

The functions return a table, a figure and the content of `variation.json`.
"""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from identify.reporting.tables import Table, number
from identify.validation.variation import Variation

GOAL_PERCENT = 5.0  # goal for the largest variation of an identified parameter
PAPER_WORST_PERCENT = 24.9  # largest variation in table 5 of the paper
# Left end of the figure's axis. The platform is weighed once for all runs, and its mass therefore
# hardly varies.
SMALLEST_PERCENT = 0.1

# Variation of the parameters of the paper's robot (table 5). Only parameters that can be identified
# are included. Rows that cannot be assigned are omitted, because our copy lacks a cell in the left
# column.
PAPER_PERCENT = {
    "platform.mass": 0.48,
    "platform.Ixx": 5.0,
    "platform.Iyy": 24.9,
    "platform.Izz": 8.6,
    "link4.mass": 19.1,
    "link5.mass": 10.1,
    "link6.mass": 12.9,
    **{
        f"joint{leg}.coulomb": value
        for leg, value in enumerate((15.9, 21.4, 9.0, 17.8, 15.1, 23.4), start=1)
    },
    **{
        f"joint{leg}.viscous": value
        for leg, value in enumerate((11.7, 13.9, 16.4, 15.2, 21.8, 13.0), start=1)
    },
    **dict(zip(("joint_pid.lp", "joint_pid.li", "joint_pid.ld"), (2.82, 0.44, 3.7), strict=True)),
}


def variation_entry(found: Variation, trajectories: str) -> dict[str, Any]:
    """Return the content of `variation.json`. ``trajectories`` names the kind of the runs."""
    name, worst = found.worst
    return {
        "trajectories": trajectories,
        "runs": found.runs,
        "worst": {"parameter": name, "variation_percent": 100 * worst},
        "goal_percent": GOAL_PERCENT,
        "paper_worst_percent": PAPER_WORST_PERCENT,
        "parameters": {
            # The table omits parameters that are not identified in every run; this entry does not.
            parameter: {
                "unit": found.layout.unit(parameter),
                "mean": found.mean[k],
                "variation_percent": 100 * found.variation[k],
                "expected_percent": 100 * found.expected[k],
                "identified_in_every_run": bool(found.identified[k]),
                "paper_percent": PAPER_PERCENT.get(parameter),
            }
            for k, parameter in enumerate(found.names)
        },
    }


def variation_table(found: Variation) -> Table:
    """Return the table of the parameters that every run identifies.

    The columns are the unit, the mean, the variation, the variation expected from the standard
    deviations that the runs state, and the variation in the paper.
    """
    rows = tuple(
        (
            found.names[k],
            found.layout.unit(found.names[k]),
            number(found.mean[k]),
            number(100 * found.variation[k]),
            number(100 * found.expected[k]),
            number(PAPER_PERCENT.get(found.names[k])),
        )
        for k in np.flatnonzero(found.identified)
    )
    return Table(
        f"Variation of {found.runs} identifications (like the paper's table 5)",
        ("parameter", "unit", "mean", "variation [%]", "expected [%]", "paper [%]"),
        rows,
        "Variation: standard deviation over mean. Expected: from the standard deviations that the "
        "runs state. Only parameters that are identified in every run are listed. The platform is "
        "weighed once for all runs.",
    )


def variation_figure(found: Variation) -> Figure:
    """Draw the variation of each identified parameter.

    Markers show the expected variation and the variation in the paper. A line shows the goal.
    """
    shown = np.flatnonzero(found.identified)
    figure = Figure(figsize=(9, 2.0 + 0.28 * len(shown)), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(len(shown))
    axes.barh(rows, 100 * found.variation[shown], color="tab:blue", label="variation")
    axes.plot(
        100 * found.expected[shown],
        rows,
        "kd",
        markersize=5,
        markerfacecolor="none",
        label="expected",
    )
    paper = [PAPER_PERCENT.get(found.names[k], np.nan) for k in shown]
    axes.plot(paper, rows, "x", color="tab:red", label="robot of the paper")
    axes.axvline(
        GOAL_PERCENT, color="black", linestyle="--", linewidth=1, label=f"goal {GOAL_PERCENT:g} %"
    )
    axes.set_yticks(rows, [found.names[k] for k in shown], fontsize="small")
    axes.invert_yaxis()
    # Variations range from less than a tenth of a per cent to some ten per cent.
    axes.set_xscale("log")
    axes.set_xlim(left=SMALLEST_PERCENT)
    axes.set_xlabel(f"variation of {found.runs} identifications [%]")
    axes.grid(alpha=0.3, axis="x")
    axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
