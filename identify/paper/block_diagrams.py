"""Block diagrams of the paper (figures 3, 4, 7 and 9), with our names of their parts.

A diagram is a list of blocks and a list of arrows between them. Its CSV file lists the arrows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from identify.paper.exhibit import Exhibit
from identify.reporting.figures.style import BLUE, GREY, INK, PAPER, WIDTH

# Half width and half height of a block. Blocks stand on a grid of unit distance.
HALF_WIDTH = 0.35
HALF_HEIGHT = 0.3


class Block(NamedTuple):
    """Block at a column and row of the grid. ``ours`` names what does its work here."""

    name: str
    column: float
    row: float
    ours: str = ""


class Arrow(NamedTuple):
    """Signal from one block to another, by their names."""

    start: str
    end: str
    signal: str = ""


@dataclass(frozen=True)
class Diagram:
    """Blocks and arrows."""

    blocks: Sequence[Block]
    arrows: Sequence[Arrow]

    def draw(self) -> Figure:
        """Draw the diagram. Rows count downwards, and an arrow runs from edge to edge of blocks."""
        columns = max(block.column for block in self.blocks) + 1
        rows = max(block.row for block in self.blocks) + 1
        figure = Figure(figsize=(WIDTH, 0.25 + 0.95 * rows))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
        axes.set_axis_off()
        centres = {block.name: (block.column, block.row) for block in self.blocks}
        for block in self.blocks:
            x, y = centres[block.name]
            corner = (x - HALF_WIDTH + 0.03, y - HALF_HEIGHT + 0.03)
            size = (2 * HALF_WIDTH - 0.06, 2 * HALF_HEIGHT - 0.06)
            axes.add_patch(
                FancyBboxPatch(
                    corner, *size, boxstyle="round,pad=0.03", facecolor=PAPER, edgecolor=INK
                )
            )
            centre: dict[str, Any] = {"ha": "center", "va": "center"}
            shift = 0.09 if block.ours else 0.0
            axes.text(x, y - shift, block.name, fontsize=6.5, **centre)
            axes.text(x, y + 0.16, block.ours, fontsize=5, color=BLUE, **centre)
        for arrow in self.arrows:
            start, end = _edges(centres[arrow.start], centres[arrow.end])
            axes.annotate(
                "", end, start, arrowprops={"arrowstyle": "-|>", "color": GREY, "lw": 0.9}
            )
            middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
            upright = abs(end[0] - start[0]) < abs(end[1] - start[1])
            offset = (3, 0) if upright else (0, 2)
            axes.annotate(
                arrow.signal,
                middle,
                offset,
                textcoords="offset points",
                fontsize=5.5,
                ha="left" if upright else "center",
                va="center" if upright else "bottom",
            )
        return figure


def _edges(
    start: tuple[float, float], end: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of an arrow on the edges of two blocks with these centres."""
    dx = end[0] - start[0]
    dy = end[1] - start[1]
    # The line between the centres leaves a block through the edge that it reaches first.
    reach = min(
        HALF_WIDTH / abs(dx) if dx else float("inf"), HALF_HEIGHT / abs(dy) if dy else float("inf")
    )
    away = (reach * dx, reach * dy)
    return (start[0] + away[0], start[1] + away[1]), (end[0] - away[0], end[1] - away[1])


def _exhibit(name: str, title: str, paper: str, ours: str, diagram: Diagram) -> Exhibit:
    columns = {
        "from": [arrow.start for arrow in diagram.arrows],
        "to": [arrow.end for arrow in diagram.arrows],
        "signal": [arrow.signal for arrow in diagram.arrows],
    }
    return Exhibit(name, title, paper, ours, columns, partial(Diagram.draw, diagram))


LOOP = Diagram(
    (
        Block("exciting trajectory", 0, 1, "excitation"),
        Block("visual servo\n(plant)", 1, 0, "eq. 30"),
        Block("joint controllers\n(true gains)", 2, 0, "eq. 31"),
        Block("true robot", 3, 0, "experiment/plant"),
        Block("stereo sensor", 4, 0, "cmmsim"),
        Block("output error", 4, 1, "eq. 32"),
        Block("search", 3, 1, "eq. 33, 35"),
        Block("visual servo\n(model)", 1, 2, "eq. 30"),
        Block("joint controllers\n(estimated gains)", 2, 2, "eq. 31"),
        Block("model of the robot", 3, 2, "dynamics"),
        Block("ideal sensor", 4, 2, "closed_loop"),
    ),
    (
        Arrow("exciting trajectory", "visual servo\n(plant)", "χd"),
        Arrow("exciting trajectory", "visual servo\n(model)", "χd"),
        Arrow("visual servo\n(plant)", "joint controllers\n(true gains)", "U"),
        Arrow("joint controllers\n(true gains)", "true robot", "τ"),
        Arrow("true robot", "stereo sensor", "χ"),
        Arrow("stereo sensor", "output error", "measured χ"),
        Arrow("visual servo\n(model)", "joint controllers\n(estimated gains)", "U"),
        Arrow("joint controllers\n(estimated gains)", "model of the robot", "τ"),
        Arrow("model of the robot", "ideal sensor", "χ"),
        Arrow("ideal sensor", "output error", "model χ"),
        Arrow("output error", "search", "residuals"),
        Arrow("search", "joint controllers\n(estimated gains)", "lp, li, ld"),
        Arrow("search", "model of the robot", "Ξ"),
    ),
)

PROCEDURE = Diagram(
    (
        Block("dynamic model", 0, 0, "eq. 17, 25"),
        Block("exciting trajectory", 1, 0, "cmmsim excite"),
        Block("experiment", 2, 0, "cmmsim record"),
        Block("linear start", 1, 1, "not in the paper"),
        Block("filtered poses", 2, 1, "Butterworth"),
        Block("output error", 1, 2, "eq. 32"),
        Block("identified model", 2, 2, "cmmsim identify"),
        Block("validation", 3, 2, "cmmsim validate"),
    ),
    (
        Arrow("dynamic model", "exciting trajectory", "regressor"),
        Arrow("exciting trajectory", "experiment", "χd"),
        Arrow("experiment", "filtered poses", "poses"),
        Arrow("experiment", "output error", "poses"),
        Arrow("dynamic model", "linear start"),
        Arrow("filtered poses", "linear start"),
        Arrow("linear start", "output error", "Λ"),
        Arrow("output error", "identified model", "until eq. 35"),
        Arrow("identified model", "validation", "Λ"),
    ),
)

VERIFICATION = Diagram(
    (
        Block("exciting trajectory", 0, 1, "eq. 37"),
        Block("joint controllers\n(MuJoCo)", 1, 0, "eq. 31"),
        Block("MuJoCo", 2, 0, "cmmsim export mjcf"),
        Block("joint controllers\n(model)", 1, 2, "eq. 31"),
        Block("this model", 2, 2, "dynamics"),
        Block("difference", 3, 1, "figure 8"),
    ),
    (
        Arrow("exciting trajectory", "joint controllers\n(MuJoCo)", "commands"),
        Arrow("exciting trajectory", "joint controllers\n(model)", "commands"),
        Arrow("joint controllers\n(MuJoCo)", "MuJoCo", "τ"),
        Arrow("joint controllers\n(model)", "this model", "τ"),
        Arrow("MuJoCo", "difference", "χs"),
        Arrow("this model", "difference", "χm"),
    ),
)

SYSTEM = Diagram(
    (
        Block("scenario", 0, 0, "identify/scenario"),
        Block("visual servo", 1, 0, "dynamics/closed_loop"),
        Block("joint controllers", 2, 0, "dynamics/closed_loop"),
        Block("robot", 3, 0, "identify/experiment"),
        Block("record", 0, 1, "experiment.nc"),
        Block("pose", 1, 1, "cmmsim/measuring"),
        Block("sticker centres", 2, 1, "cmmsim/detection"),
        Block("images of two cameras", 3, 1, "cmmsim/imaging"),
    ),
    (
        Arrow("scenario", "visual servo", "trajectory"),
        Arrow("visual servo", "joint controllers", "commands"),
        Arrow("joint controllers", "robot", "torques"),
        Arrow("robot", "images of two cameras", "motion"),
        Arrow("images of two cameras", "sticker centres", "grey values"),
        Arrow("sticker centres", "pose", "centres"),
        Arrow("pose", "visual servo", "measured pose"),
        Arrow("pose", "record", "poses"),
    ),
)


def diagrams() -> list[Exhibit]:
    """Return figures 3, 4, 7 and 9."""
    return [
        _exhibit(
            "Figure 3",
            "Closed loop of the identification",
            "Robot and model, each in its own visual servo, follow the same trajectory. The "
            "difference of their poses changes the parameters and gains of the model.",
            "The same. identification.method=command_driven opens the lower loop and gives the "
            "logged commands to the model, which is more accurate.",
            LOOP,
        ),
        _exhibit(
            "Figure 4",
            "Procedure of the identification",
            "Model, trajectory, experiment, and a search that repeats until it stops.",
            "The same with a linear start. Without it the search begins at a model whose loop "
            "is unstable or nearly so, and stalls.",
            PROCEDURE,
        ),
        _exhibit(
            "Figure 7",
            "Verification of the dynamic model",
            "The model and a SimMechanics model under the same joint controllers.",
            "The same with MuJoCo in place of SimMechanics (cmmsim verify-model).",
            VERIFICATION,
        ),
        _exhibit(
            "Figure 9",
            "Architecture of the experiment",
            "A robot of Servo & Simulation, two cards for data acquisition, a C-track 780 and two "
            "computers.",
            "A simulation has no computers to connect. Shown are the parts of the software that "
            "stand for them.",
            SYSTEM,
        ),
    ]
