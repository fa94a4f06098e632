"""Pictures of a run by the names of their files, each with a caption that explains it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from identify.experiment.truth import true_poses
from identify.files.run_folder import RunFolder
from identify.record.recording import intended_motion, poses
from identify.reporting.figures import diagnosis, estimates, fit, overview, paths
from identify.reporting.figures.style import drawn, moving
from identify.reporting.goals import unseen
from identify.reporting.run_data import RunData, read_run
from identify.reporting.run_result import common_modes


@dataclass(frozen=True)
class Picture:
    """Function that draws a figure, and its caption.

    ``as_image`` is true if a page includes the figure as an image, because it has many strokes or
    grey values.
    """

    draw: Callable[[], Figure]
    caption: str
    as_image: bool = False


def run_figures(folder: Path | str) -> dict[str, Callable[[], Figure]]:
    """Return the figures of a finished run by the names of their files.

    Each figure is given as a function that draws it for print.

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
            lambda: fit.fit_figure(data.excitation_fit),
            FIT.format("exciting trajectory") + ("" if data.truth is None else f"{THICK}."),
        ),
        **_of_the_diagnosis(data.result),
        "parameters": Picture(
            lambda: estimates.parameter_figure(names), _parameters_caption(found)
        ),
        **(sums if several else {}),
        "correlation": Picture(
            lambda: estimates.correlation_figure(*data.correlations), CORRELATION
        ),
        **_of_the_validation(data),
    }


FIT = (
    "The {}: measured poses (circles), initial model (dashed) and identified model (line); below "
    "each component, the measured pose minus the identified model in every frame, with the RMS for "
    "the initial and for the identified model."
)

THICK = " Thick: the truth minus the identified model"

GROUPS = (
    "Parameters in each sum on which the motion depends: one row per sum, one column per "
    "parameter. The area of a dot is the size of coefficient times initial guess, as a share of "
    "the sum of all these sizes in the row; an open dot is subtracted. A star marks a sum that is "
    "identified."
)

CORRELATION = (
    "Correlations of the errors of identified parameters: the area of a dot is the size of the "
    "correlation, and an open dot is negative."
)


def _of_the_diagnosis(result: dict[str, Any]) -> dict[str, Picture]:
    """Show the share of the misfit that causes explain, or nothing without a diagnosis."""
    entry = result.get("diagnosis")
    if entry is None:
        return {}
    text = (
        "Possible causes of the misfit: the share that each alone explains in addition to the "
        "parameters (left), and the misfit that remains as the causes found are fitted (right)."
    )
    return {"diagnosis": Picture(lambda: diagnosis.diagnosis_figure(entry), text)}


def _errors(data: RunData) -> Picture:
    """Show the errors of both models on the first validation run or, without one, on the record."""
    shown = data.validation_fit
    if shown is None:
        text = (
            "Distance of both models from the measured poses of the record; dotted: the noise "
            "that the cameras state."
        )
        return Picture(lambda: fit.error_figure(data.excitation_fit), text)
    text = (
        "Distance of both models, and of the single measured poses, from the true robot on the "
        "first validation trajectory, with all three axes in one number."
    )
    if estimated := unseen(data.result).estimated:
        text += f" The identified model is drawn without {estimated}."
    return Picture(lambda: fit.error_figure(shown), text)


def _of_the_scene(data: RunData) -> dict[str, Picture]:
    """Show robot, cameras and camera images, as far as they can be drawn."""
    cell = data.scene
    view = data.stereo_view
    if isinstance(cell, str):
        return {}
    if view is None:
        text = f"The robot {data.robot} half way along its path."
        return {
            "scene": Picture(
                lambda: overview.overview_figure(cell, data.middle), text, as_image=True
            )
        }
    text = (
        f"The robot {data.robot} and both cameras, with their rays to the stickers of the "
        "platform, half way along the exciting trajectory; below, the images of both cameras at "
        "that time, with the stickers that were found."
    )
    residuals = (
        "The images of both cameras in the first picture of this page, half way along the exciting "
        "trajectory: detected ellipses, and arrows that show the error of each detected centre, "
        "enlarged as stated. A run keeps no images, so that these are rendered again from "
        "scenario, seed and true pose."
    )
    return {
        "scene": Picture(
            lambda: overview.overview_figure(cell, data.middle, view), text, as_image=True
        ),
        "stereo_frame": Picture(lambda: overview.residual_figure(view), residuals, as_image=True),
    }


def _of_the_sensor(data: RunData) -> dict[str, Picture]:
    measured = poses(data.experiment, "measured")
    shared = common_modes(data.experiment)
    covariances = data.experiment["measured_covariance"].values
    covariances = covariances + shared @ np.swapaxes(shared, 1, 2)
    errors = None if data.truth is None else true_poses(data.truth) - measured
    # The reference, if there is one, shows without noise which components move.
    shown = moving(intended_motion(data.experiment))
    text = (
        "Uncertainty of single measured poses: ellipses that contain 95 % of true poses according "
        "to the cameras, along the path, enlarged as stated above each row. Errors of the cameras "
        "that all frames share are in them."
    )
    if errors is not None:
        text += " Dots: the true poses, whose distance from the measured poses is enlarged equally."
    return {
        "ellipses": Picture(
            lambda: paths.ellipse_figure(measured, covariances, shown, errors), text
        )
    }


def _of_the_motion(data: RunData) -> dict[str, Picture]:
    time = data.experiment["time"].values
    reference = intended_motion(data.experiment)
    path = (
        "The exciting trajectory as a path in space, and the orientation along it; the same times "
        "are marked in both."
    )
    over_time = "The desired exciting trajectory over time."
    if "reference_position" not in data.experiment:
        path = path.replace("The exciting trajectory", "The measured motion")
        over_time = "The measured poses over time. The record has no desired trajectory."
    return {
        "path": Picture(lambda: paths.path_figure(time, reference), path),
        "excitation": Picture(
            lambda: paths.excitation_figure(time, reference),
            over_time,
        ),
    }


def _parameters_caption(identification: dict[str, Any]) -> str:
    entries = identification["parameters"]
    if any(entry["true"] is not None for entry in entries.values()):
        said = "Nineteen of twenty intervals should reach zero."
        if scale := identification.get("common_scale"):
            known = sum(bool(entry["identifiable"]) for entry in entries.values())
            said = (
                f"{len(scale['shared']) + 1} of the {known} intervals share the error of one "
                "common factor, so that these reach zero or miss it together: over many "
                "experiments, nineteen of twenty intervals should reach it."
            )
        return (
            "Error of each identified parameter with its 95 % interval, in per cent of the truth. "
            f"Grey: 5 %. {said}"
        )
    return "95 % interval of each identified parameter, in per cent of the estimate. Grey: 5 %."


def _of_the_validation(data: RunData) -> dict[str, Picture]:
    shown = data.validation_fit
    if shown is None:
        return {}
    errors = ""
    alone = ""
    if data.result["identification"].get("nuisance_prior_std"):
        errors = " and the estimated errors that all frames share"
        # The goals judge the model alone, unless the sensor states errors of its cameras.
        if not unseen(data.result).estimated:
            alone = (
                " The goals judge the model without these errors, whose distance is in the rows "
                "“identified, true” of the table below."
            )
    bars = (
        "Distance of the true robot from the predicted poses on each validation trajectory, RMS: "
        "bars as it is, diamonds as expected from the stated uncertainty. Poses are predicted by "
        f"the identified model{errors}.{alone} Dashes: the measured poses minus the identified "
        "model, with their noise."
    )
    text = (
        FIT.format("first validation trajectory")
        + f"{THICK}; dotted: the range in which the truth is expected."
    )
    return {
        "validation_errors": Picture(lambda: fit.validation_figure(data.result), bars),
        "fit_validation": Picture(lambda: fit.fit_figure(shown), text),
    }
