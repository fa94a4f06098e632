"""The trajectories of all methods: paths of the pose and crank angles with their limits."""

import numpy as np
from matplotlib.figure import Figure

from dynamics import Robot
from identify.excitation.comparison import Comparison
from identify.files.figure import blank_figure
from identify.scenario import Scenario

COMPONENTS = ("x", "y", "z", "α", "β", "γ")
POINTS = 1000


def comparison_figure(robot: Robot, scenario: Scenario, comparison: Comparison) -> Figure:
    """One column a method: position, orientation and crank angles over one period, limits dashed."""
    settings = scenario.excitation
    figure = blank_figure(5 * len(comparison.entries), 9)
    panels = figure.subplots(3, len(comparison.entries), sharex=True, sharey="row", squeeze=False)
    time = np.linspace(0.0, 1.0 / settings.fundamental_hz, POINTS)
    travel = robot.travel_limit - settings.travel_margin_rad
    boxes = (1e3 * settings.position_amplitude_m, 1e3 * settings.orientation_amplitude_rad)
    for column, entry in enumerate(comparison.entries):
        poses = entry.trajectory.pose(time)
        away = 1e3 * (poses - robot.home_pose)
        angles = robot.inverse_kinematics(poses)
        rows = [
            (away[:, :3], COMPONENTS[:3], boxes[0]),
            (away[:, 3:], COMPONENTS[3:], boxes[1]),
            (angles, [f"crank {k}" for k in range(1, 7)], travel),
        ]
        for axes, (values, names, limit) in zip(panels[:, column], rows, strict=True):
            for name, line in zip(names, values.T, strict=True):
                axes.plot(time, line, label=name, linewidth=1.0)
            for sign in (-1, 1):
                axes.axhline(sign * limit, color="black", linestyle="--", linewidth=0.8)
            axes.grid(alpha=0.3)
        panels[0, column].set_title(f"{entry.method}: index {entry.observability:.3f}, {entry.seconds:.1f} s")
        panels[2, column].set_xlabel("time [s]")
    for axes, label in zip(
        panels[:, 0], ("position from home [mm]", "orientation from home [mrad]", "crank angle [rad]"), strict=True
    ):
        axes.set_ylabel(label)
        axes.legend(loc="upper right", fontsize="small", ncols=2)
    figure.suptitle(f"Exciting trajectories, criterion {comparison.criterion}, seed {comparison.seed}; dashed: limits")
    return figure
