"""Figure (PNG) of a teaching from photographs."""

import numpy as np
from matplotlib.figure import Figure

from cmmsim import PhotographedTeaching
from identify.verification.sensor_figures import ARROW_SHARE

SIDES = ("left", "right")


def teaching_residuals(found: PhotographedTeaching) -> Figure:
    """Draw the residuals, measured minus adjusted centres, as arrows at the centres."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    panels = figure.subplots(1, 2)
    seen = found.observations
    sigma = max(found.rms_px, 1e-9)
    figure.suptitle(f"residuals of stickers, rms {found.rms_px:.3g} px")
    for side, axes in enumerate(panels):
        camera = found.bundle.state.rig.cameras[side]
        for moves, colour, body in ((False, "tab:orange", "base"), (True, "tab:blue", "platform")):
            own = seen.moves == moves
            axes.quiver(
                *seen.pixels[side, own].T,
                *found.bundle.residuals[side, own].T,
                angles="xy",
                scale_units="xy",
                width=0.0015,
                color=colour,
                label=body,
                scale=3.0 * sigma / (ARROW_SHARE * camera.width),
            )
        rms = np.sqrt(np.mean(found.bundle.residuals[side] ** 2))
        axes.set(
            xlim=(0, camera.width),
            ylim=(camera.height, 0),
            xlabel="x [px]",
            ylabel="y [px]",
            aspect="equal",
        )
        axes.set_title(f"{SIDES[side]}: rms {rms:.3g} px", loc="left", fontsize="medium")
    panels[0].legend(loc="upper right", fontsize="small")
    return figure
