"""Entries of `result.json`, from the results and records of the stages."""

from typing import Any

import numpy as np
import xarray as xr

from dynamics import DynamicsError, Robot
from dynamics.closed_loop.start_state import checked_loop_parameters
from identify.arrays import Array
from identify.errors import RecordError
from identify.experiment.truth import true_poses, true_values
from identify.files.run_folder import rms_figures
from identify.loop_parameters import parameter_column, parameter_entries, settled_drive
from identify.record import recording
from identify.record.stored_common_errors import read_common_errors
from identify.validation.pose_prediction import PosePrediction

# Kinds of errors that all poses of a sensor have in common.
SENSOR_KINDS = ("rig", "exposure", "teaching")


def add_truth(identification: dict[str, Any], truth: dict[str, float]) -> None:
    """Add the true values of parameters and of their groups to an identification entry in place."""
    entries = identification["parameters"]
    known = dict(zip(entries, true_values(truth, entries), strict=True))
    for name, value in known.items():
        entries[name]["true"] = value
    # The true value of a group follows from those of its members.
    for group in identification.get("groups", {}).values():
        group["true"] = sum(weight * known[name] for name, weight in group["coefficients"].items())


def parameter_vector(robot: Robot, identification: dict[str, Any], column: str) -> Array:
    """Return one column of an identification entry as a robot's parameters (p,).

    ``column`` is "initial", "estimate" or another one. Raises RecordError if a parameter is
    missing, is not a number, or has a value that no model can have.
    """
    values = parameter_column(identification, column, robot.layout.names)
    try:
        return checked_loop_parameters(robot, values, settled_drive(identification))
    except DynamicsError as error:
        raise RecordError(f"{column}: {error}") from None


def check_intervals(identification: dict[str, Any]) -> None:
    """Refuse an estimate outside its own interval, which no identification produces.

    Raises RecordError, which names the parameter, its estimate and its interval.
    """
    for name, entry in parameter_entries(identification).items():
        estimate = entry["estimate"]
        low, high = entry.get("interval") or (-np.inf, np.inf)
        if estimate is not None and not low <= estimate <= high:
            raise RecordError(
                f"the estimate {estimate:g} of {name} is outside its interval {low:g} to {high:g}"
            )


def sensor_entry(runs: list[tuple[xr.Dataset, xr.Dataset]]) -> dict[str, Any]:
    """Compare the sensor with the truth over all pairs of record and truth.

    The entry also has the speed of rendering and measuring in one process, the noise that the
    sensor states, the standard deviation of the errors that all its poses have in common, and why
    the first lost frame was lost.
    """
    errors = np.vstack(
        [recording.poses(record, "measured") - true_poses(truth) for record, truth in runs]
    )
    # A lost frame has no pose, and is only counted as lost.
    ok = np.concatenate([record["measured_ok"].values.astype(bool) for record, _ in runs])
    seconds = sum(float(record.attrs["sensor_seconds"]) for record, _ in runs)
    covariances = np.concatenate([record["measured_covariance"].values for record, _ in runs])
    common = np.concatenate([np.sum(common_modes(record) ** 2, axis=2) for record, _ in runs])
    why = [text for record, _ in runs if (text := record.attrs.get("lost_frames"))]
    return {
        "frames": len(ok),
        "lost_frames": int(np.sum(~ok)),
        **({"lost_because": str(why[0]).split("; ")[0]} if why else {}),
        "stereo_frames_per_second": len(ok) / seconds,
        **rms_figures(errors, ok),
        **_stated("noise", np.diagonal(covariances[ok], axis1=1, axis2=2)),
        **_stated("common", common[ok]),
    }


def common_modes(record: xr.Dataset) -> Array:
    """Return the shifts (N, 6, k) of the poses [m, rad] by k errors that all of them share.

    Each shift is by one standard deviation. The k errors of the sensor are independent.
    """
    errors = read_common_errors(record, SENSOR_KINDS)
    if not errors.names:
        return np.zeros((record.sizes["time"], 6, 0))
    return errors.modes


def _stated(what: str, variances: Array) -> dict[str, list[float]]:
    """Return the root mean square of stated variances (N, 6) [m^2, rad^2], in um and urad."""
    std = 1e6 * np.sqrt(variances.mean(axis=0)) if len(variances) else np.full(6, np.nan)
    return {f"position_{what}_um": std[:3].tolist(), f"orientation_{what}_urad": std[3:].tolist()}


def validation_entry(
    record: xr.Dataset, truth: xr.Dataset, initial: Array, identified: Array
) -> dict[str, Any]:
    """Return the entry of one validation run.

    The poses of both models (N, 6) are compared with the measured and with the true poses of the
    plant.
    """
    ok = record["measured_ok"].values.astype(bool)
    measured = recording.poses(record, "measured")
    true = true_poses(truth)
    return {
        "measured": rms_figures(identified - measured, ok),
        "true": rms_figures(identified - true),
        "initial_measured": rms_figures(initial - measured, ok),
        "initial_true": rms_figures(initial - true),
    }


def prediction_entry(prediction: PosePrediction, truth: xr.Dataset) -> dict[str, Any]:
    """Compare the plant's deviation from the predicted poses with the expected deviation.

    The entry has both as RMS over the run, and the squared deviation relative to the expected one.
    """
    std = 1e6 * np.sqrt(np.mean(prediction.std**2, axis=0))
    true = true_poses(truth)
    return {
        "predicted": {
            "position_std_um": std[:3].tolist(),
            "orientation_std_urad": std[3:].tolist(),
            "normalised_squared_error": prediction.normalised_squared_error(true),
            **rms_figures(prediction.poses - true),
        }
    }
