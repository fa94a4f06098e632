"""Rows of kind `estimators`: errors of several estimators on the same record.

The record is made as for the kind `identification`. Joint instruments are simulated from its truth,
for the estimators that need them. All estimators of a row use the same record, so that their errors
can be compared pairwise.
"""

import math

import numpy as np
from pydantic import Field, field_validator

from identify.estimators.estimator import find_estimators
from identify.experiment.joint_instruments import instruments_of
from identify.model.model_side import model_side
from identify.own_parts import ESTIMATORS
from identify.progress import SilentProgress
from identify.random_streams import stream_seed
from identify.scenario import Scenario
from identify.studies.rows.identified import (
    EXPERIMENT,
    READS,
    RecordOptions,
    memory,
    recorded,
    row_setup,
)
from identify.studies.rows.kind import Column, Kind, Row
from identify.validation.estimator_comparison import START, Score, compare_on_record, instrumented

# Unit, meaning, factor and field of the score for each figure, by the end of the figure's name. If
# the field is None, the end of the figure's name is the name of the field.
FIGURES = {
    "groups_percent": (
        "%",
        "error of the base parameters that the record shows, median",
        100.0,
        "group_median",
    ),
    "gains_percent": (
        "%",
        "error of the gains of the joint controller, rms",
        100.0,
        "gain_distance",
    ),
    "position_um": (
        "um",
        "position error of the model on validation trajectories, rms of the worst axis and run",
        1.0,
        None,
    ),
    "orientation_urad": (
        "urad",
        "orientation error of the model on validation trajectories, rms of the worst axis and run",
        1.0,
        None,
    ),
    "seconds": ("s", "time of the estimate", 1.0, None),
}

STARTING = START.replace(" ", "_")


class EstimatorOptions(RecordOptions):
    """Options of rows of kind `estimators`."""

    estimators: list[str] = Field(
        [],
        description="names of estimators, or module:function of your own; empty: all built-in "
        "estimators",
    )

    @field_validator("estimators")
    @classmethod
    def _known(cls, names: list[str]) -> list[str]:
        find_estimators(names)
        return names


COLUMNS = {
    f"{name}_{end}": Column(unit, f"{name.replace('_', ' ')}: {what}", main=end == "position_um")
    for name in (STARTING, *ESTIMATORS)
    for end, (unit, what, *_) in FIGURES.items()
}


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: EstimatorOptions) -> Row:
    """Compute one row. A figure that is NaN or infinite for an estimator is absent from the row.

    Raises EstimationError, and the exceptions of experiment and sensor.
    """
    runs = recorded(row_setup(scenario, stream_seed(seed, EXPERIMENT)), options)
    robot = runs.plant.nominal
    run = runs.excitation
    channels = instrumented(
        run.record, run.truth, scenario.timing, instruments_of(robot), runs.number
    )
    unseen = [(one.record, one.truth) for one in runs.unseen]
    chosen = find_estimators(options.estimators or None)
    scores = compare_on_record(
        (run.record, run.truth),
        channels,
        model_side(robot, scenario),
        scenario.identification,
        unseen,
        chosen,
        SilentProgress(),
    )
    return {
        name: value
        for score in scores
        for name, value in _figures(score).items()
        if math.isfinite(value)
    }


def _figures(score: Score) -> Row:
    # The name of a user's own estimator is module:function.
    name = score.name.replace(" ", "_").replace(":", ".")
    return {
        f"{name}_{end}": factor * getattr(score, field or end)
        for end, (*_, factor, field) in FIGURES.items()
    }


ESTIMATION = Kind(
    "estimators",
    compute,
    "a record of the exciting trajectory, and the errors of several estimators on it",
    COLUMNS,
    EstimatorOptions,
    READS,
    memory=memory,
)
