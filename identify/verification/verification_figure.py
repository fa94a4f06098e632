"""The paper's figure 8: position and angle differences of two engines over time, with MuJoCo's own closure error."""

from matplotlib.figure import Figure

from identify.files.figure import blank_figure
from identify.verification.figure7_loop import EngineRuns
from identify.verification.model_verification import GOAL_UM, GOAL_URAD, STEADY_FROM_S, judge

COMPONENTS = ("x", "y", "z", "α", "β", "γ")


def figure_8(runs: EngineRuns) -> Figure:
    """Differences of MuJoCo and this model, and how far MuJoCo's loops are open, over time."""
    figure = blank_figure(9, 9)
    position, angle, closure = figure.subplots(3, 1, sharex=True)
    verdict, difference = judge(runs), 1e6 * runs.difference
    for i in range(3):
        position.plot(runs.time, difference[:, i], linewidth=1, label=COMPONENTS[i])
        angle.plot(runs.time, difference[:, 3 + i], linewidth=1, label=COMPONENTS[3 + i])
    closure.plot(runs.time, 1e6 * runs.closure, linewidth=1, color="black")
    position.set_title(
        f"(a) position: largest {verdict.position_max_um:.2g} um, steady {verdict.position_steady_um:.2g} um "
        f"(goal {GOAL_UM:g} um; paper 1250 and 100 um)"
    )
    angle.set_title(
        f"(b) angle: largest {verdict.angle_max_urad:.2g} urad, steady {verdict.angle_steady_urad:.2g} urad "
        f"(goal {GOAL_URAD:g} urad; paper 3250 and 250 urad)"
    )
    closure.set_title(f"(c) MuJoCo's loop closure error: largest {verdict.closure_max_um:.2g} um")
    for axes, label in ((position, "position error [um]"), (angle, "angle error [urad]"), (closure, "gap [um]")):
        axes.set_ylabel(label)
        axes.axvline(STEADY_FROM_S, color="grey", linewidth=1, linestyle="--")
        axes.grid(alpha=0.3)
    for axes in (position, angle):
        axes.legend(loc="upper right", fontsize="small")
    closure.set_xlabel("time [s] (dashes: steady from here)")
    figure.suptitle(f"MuJoCo {runs.mujoco_version} − this model, same PID and exciting trajectory")
    return figure
