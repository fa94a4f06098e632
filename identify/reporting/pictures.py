"""Pictures of a run by the names of their files, each with a caption that says how to read it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from identify.experiment.truth import true_poses
from identify.files.run_folder import RunFolder
from identify.record.recording import poses
from identify.reporting.figures import diagnosis, estimates, fit, overview, paths
from identify.reporting.figures.style import drawn, moving
from identify.reporting.run_data import RunData, read_run


@dataclass(frozen=True)
class Picture:
    """Function that draws a figure, and its caption.

    ``painted`` is true if a page takes the figure as an image, because it has too many strokes or
    grey values.
    """

    draw: Callable[[], Figure]
    caption: str
    painted: bool = False


def run_figures(folder: Path | str) -> dict[str, Callable[[], Figure]]:
    """Return the figures of a finished run by the names of their files.

    Each is a function that draws the figure for print.

    Raises
    ------
    OutputFolderError
        An earlier stage has not been run.
    RecordError
        A file of the run is damaged.
    """
    return {
        name: partial(drawn, picture.draw)
        for name, picture in pictures(read_run(RunFolder(Path(folder)))).items()
    }


def pictures(data: RunData) -> dict[str, Picture]:
    """Return the pictures that the files of a run allow, in the order of the report."""
    found = data.result["identification"]
    names = found["parameters"]
    groups = found.get("groups", {})
    several = any(len(group["coefficients"]) > 1 for group in groups.values())
    sums = {"groups": Picture(lambda: estimates.group_figure(groups, names), GROUPS)}
    # The order of the keys is that of the report.
    return {
        **_of_the_scene(data),
        "errors": _errors(data),
        **_of_the_sensor(data),
        **_of_the_motion(data),
        "fit_excitation": Picture(
            lambda: fit.fit_figure(data.excitation_fit), FIT.format("exciting trajectory")
        ),
        **_of_the_diagnosis(data.result),
        "parameters": Picture(
            lambda: estimates.parameter_figure(names), _parameters_caption(names)
        ),
        **(sums if several else {}),
        "correlation": Picture(
            lambda: estimates.correlation_figure(*data.correlations), CORRELATION
        ),
        **_of_the_validation(data),
    }


FIT = (
    "The {}: measured poses (circles), starting model (dashed) and identified model (line); "
    "beneath each component what the identified model leaves of every measured pose, with its RMS "
    "for the starting and for the identified model."
)

GROUPS = (
    "Which parameters enter which sum that motion shows: one row a sum, one column a parameter. "
    "The area of a dot is the share of coefficient times starting value; an open one is "
    "subtracted. A star marks a sum that is identified."
)

CORRELATION = (
    "How the errors of identified parameters go together: the area of a dot is the size of their "
    "correlation, an open one is negative."
)


def _of_the_diagnosis(result: dict[str, Any]) -> dict[str, Picture]:
    """Show what the causes explain; nothing where noise explains the record."""
    entry = result.get("diagnosis")
    if entry is None:
        return {}
    text = (
        "Causes for which the model may miss the record: what of the misfit each alone explains "
        "beside the parameters (left), and what is left of it as those that were found are fitted "
        "(right)."
    )
    return {"diagnosis": Picture(lambda: diagnosis.diagnosis_figure(entry), text)}


def _errors(data: RunData) -> Picture:
    """Show the errors of both models against the truth or, without one, the measurement."""
    shown = data.validation_fit
    if shown is None:
        text = (
            "How far both models are from the measured poses of the record; dotted: the noise "
            "that the cameras state."
        )
        return Picture(lambda: fit.error_figure(data.excitation_fit), text)
    text = (
        "How far both models, and the single poses that the cameras measure, are from the true "
        "robot, on the first trajectory that no model was fitted to."
    )
    return Picture(lambda: fit.error_figure(shown), text)


def _of_the_scene(data: RunData) -> dict[str, Picture]:
    """Show robot, cameras and camera images; nothing where the robot's file is gone."""
    cell = data.scene
    view = data.stereo_view
    if isinstance(cell, str):
        return {}
    if view is None:
        text = f"The robot {data.robot} half way along its path."
        return {
            "scene": Picture(
                lambda: overview.overview_figure(cell, data.middle), text, painted=True
            )
        }
    text = (
        f"The robot {data.robot} and both cameras, with their rays to the stickers of the "
        "platform, half way along the exciting trajectory; beneath it what both cameras see at "
        "that time, with the stickers that were found."
    )
    residuals = (
        "The same images, drawn anew from scenario, seed and true pose: detected ellipses, and "
        "arrows from each detected centre that show by how much it misses the true one, enlarged "
        "as written."
    )
    return {
        "scene": Picture(
            lambda: overview.overview_figure(cell, data.middle, view), text, painted=True
        ),
        "stereo_frame": Picture(lambda: overview.residual_figure(view), residuals, painted=True),
    }


def _of_the_sensor(data: RunData) -> dict[str, Picture]:
    measured = poses(data.experiment, "measured")
    covariances = data.experiment["measured_covariance"].values
    errors = None if data.truth is None else true_poses(data.truth) - measured
    # The reference has no noise, so that it tells which components move.
    shown = moving(poses(data.experiment, "reference"))
    text = (
        "How well single poses are measured: ellipses that hold 95 % of true poses by what the "
        "cameras state, enlarged along the path as written above each row."
    )
    if errors is not None:
        text += " Dots: the true poses, their distance from the measured ones enlarged alike."
    return {
        "ellipses": Picture(
            lambda: paths.ellipse_figure(measured, covariances, shown, errors), text
        )
    }


def _of_the_motion(data: RunData) -> dict[str, Picture]:
    time = data.experiment["time"].values
    reference = poses(data.experiment, "reference")
    path = (
        "The exciting trajectory as a path in space, and the orientation on its way; the same "
        "times are marked."
    )
    return {
        "path": Picture(lambda: paths.path_figure(time, reference), path),
        "excitation": Picture(
            lambda: paths.excitation_figure(time, reference),
            "The exciting trajectory over time, as it is asked for.",
        ),
    }


def _parameters_caption(entries: dict[str, Any]) -> str:
    if any(entry["true"] is not None for entry in entries.values()):
        return (
            "Error of each identified parameter with its 95 % interval, in per cent of the truth. "
            "Grey: 5 %. Nineteen of twenty intervals should reach zero."
        )
    return "95 % interval of each identified parameter, in per cent of the estimate. Grey: 5 %."


def _of_the_validation(data: RunData) -> dict[str, Picture]:
    shown = data.validation_fit
    if shown is None:
        return {}
    bars = (
        "The identified model on each unseen trajectory: bars against the truth, diamonds what the "
        "uncertainty of the parameters lets expect, dashes against the measurement, whose noise "
        "they hold."
    )
    text = (
        FIT.format("first unseen trajectory")
        + " Thick: what it misses of the truth; dotted: predicted."
    )
    return {
        "validation_errors": Picture(
            lambda: fit.validation_figure(data.result["validation"]), bars
        ),
        "fit_validation": Picture(lambda: fit.fit_figure(shown), text),
    }
