"""Whether stated intervals hold: of what a record identifies, and of the poses that its model
predicts.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from identify.arrays import Array
from identify.estimation.bounds import HALF_WIDTH
from identify.estimation.result import IdentificationResult
from identify.experiment.plant import Plant
from identify.experiment.run import Experiment
from identify.experiment.truth import true_poses
from identify.progress import SilentProgress
from identify.studies.rows.kind import Row
from identify.studies.rows.sensor import rms_um
from identify.validation.unseen import PosePrediction, predicted_runs


def coverage(
    result: IdentificationResult,
    plant: Plant,
    unseen: Sequence[Experiment],
    predicted: Sequence[PosePrediction],
) -> Row:
    """How many intervals of what is identified hold the truth, how many true coordinates on unseen
    trajectories are where they are predicted, and how far from the true positions the predicted
    ones are."""
    held = [inside for *_, identified, inside in quantities(result, plant.parameters) if identified]
    errors = np.concatenate(
        [true_poses(one.truth) - of.poses for one, of in zip(unseen, predicted, strict=True)]
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


def predictions(
    result: IdentificationResult, plant: Plant, unseen: Sequence[Experiment], seed: int
) -> list[PosePrediction]:
    """What the identified model predicts on all unseen trajectories."""
    records = [one.record for one in unseen]
    estimated = result.estimate, result.whole_covariance
    return predicted_runs(
        plant.nominal,
        plant.scenario,
        records,
        *estimated,
        seed,
        SilentProgress(),
        result.common_errors.learned,
    )


def quantities(
    result: IdentificationResult, truth: Array
) -> Iterator[tuple[str, float, float, bool, bool]]:
    """Every parameter and every group of several, given the true parameters (p,): name, error in
    standard deviations, relative standard deviation, whether it counts as identified, and whether
    its 95 % interval holds the truth."""
    groups = result.groups
    several = np.count_nonzero(groups.combinations, axis=1) > 1
    parameters = (result.names, truth, result.intervals, np.ones(len(truth), dtype=bool))
    combined = (
        groups.expressions,
        groups.combinations @ truth[result.layout.dynamic],
        result.group_intervals,
        several,
    )
    for found, (names, true, intervals, counted) in ((result, parameters), (groups, combined)):
        for k in np.flatnonzero(counted):
            error, std, (low, high) = found.estimate[k] - true[k], found.std[k], intervals[k]
            inside = bool(low <= true[k] <= high)
            yield names[k], error / std, std / abs(true[k]), bool(found.identifiable[k]), inside
