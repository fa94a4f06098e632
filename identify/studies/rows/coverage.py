"""Coverage of the stated intervals of identified quantities, and of predicted poses."""

from collections.abc import Iterator, Sequence

import numpy as np

from identify.arrays import Array
from identify.estimation.intervals import HALF_WIDTH
from identify.estimation.result import IdentificationResult
from identify.experiment.plant import Plant
from identify.experiment.run import Experiment
from identify.experiment.truth import true_poses
from identify.studies.rows.kind import Row
from identify.studies.rows.row_sensor import rms_um
from identify.validation.pose_prediction import PosePrediction


def intervals_hold(result: IdentificationResult, plant: Plant) -> tuple[bool, ...]:
    """Return for each identified quantity whether its 95 % interval contains the truth."""
    truth = plant.parameters_of(result.layout)
    return tuple(inside for *_, identified, inside in quantities(result, truth) if identified)


def coverage(
    result: IdentificationResult,
    plant: Plant,
    unseen: Sequence[Experiment],
    predicted: Sequence[PosePrediction],
) -> Row:
    """Count how often stated intervals contain the truth.

    Parameters
    ----------
    result : IdentificationResult
        Estimates with their intervals.
    plant : Plant
        The true robot.
    unseen : sequence of Experiment
        Runs of the validation trajectories.
    predicted : sequence of PosePrediction
        Prediction of each of these runs.

    Returns
    -------
    Row
        Number of intervals of identified quantities, percentage of these intervals that contain the
        truth, percentage of true coordinates on the validation trajectories within their predicted
        interval, and rms error of the predicted positions. The first percentage is absent if
        nothing is identified.
    """
    held = intervals_hold(result, plant)
    errors = np.concatenate(
        [
            true_poses(one.truth) - prediction.poses
            for one, prediction in zip(unseen, predicted, strict=True)
        ]
    )
    variances = np.concatenate([one.covariance for one in predicted])
    free = plant.nominal.geometry.chart.basis
    within = np.abs(errors @ free) < HALF_WIDTH * np.sqrt(
        np.diagonal(free.T @ variances @ free, axis1=1, axis2=2)
    )
    row: Row = {
        "intervals": len(held),
        "poses_covered_percent": 100.0 * float(np.mean(within)),
        "predicted_position_rms_um": rms_um(errors[:, :3]),
    }
    return row | ({"covered_percent": 100.0 * float(np.mean(held))} if held else {})


def quantities(
    result: IdentificationResult, truth: Array
) -> Iterator[tuple[str, float, float, bool, bool]]:
    """Yield every parameter, and every group of several parameters, with its error.

    Each entry is the name, the error in standard deviations, the standard deviation relative to the
    truth (infinite if the truth is zero), whether the quantity counts as identified, and whether
    its 95 % interval contains the truth. `truth` holds the true parameters (p,).
    """
    groups = result.groups
    parameters = (result.names, truth, result.intervals, np.ones(len(truth), dtype=bool))
    combined = (
        groups.expressions,
        groups.combinations @ truth[result.layout.dynamic],
        result.group_intervals,
        groups.several,  # a group of one parameter would count this parameter twice
    )
    for stated, (names, true, intervals, counted) in ((result, parameters), (groups, combined)):
        for k in np.flatnonzero(counted):
            error = stated.estimate[k] - true[k]
            std = stated.std[k]
            low, high = intervals[k]
            inside = bool(low <= true[k] <= high)
            # a product of inertia can be zero
            relative = std / abs(true[k]) if true[k] else np.inf
            yield names[k], error / std, relative, bool(stated.identifiable[k]), inside
