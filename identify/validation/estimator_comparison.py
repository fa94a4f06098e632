"""Comparison of estimators on one record, by their errors against the truth.

The figures of merit follow Leboutet et al., "Inertial parameter identification in robotics: a
survey" (Applied Sciences 11(9), 2021; their toolbox is BIRDy): distance of the parameters, distance
of the output, time, iterations and model evaluations.

Single parameters cannot be compared, because no motion separates all of them. The parameter
distance is the RMS relative error of the base parameters that the record identifies. These are
selected by the information at the true parameters, so that the selection does not depend on an
estimator. A few barely identified base parameters dominate this RMS, and can favour a fit close to
the initial guess. Therefore the median of the relative errors is also listed. The gains of the
joint PID have their own column.

The pose distance is the RMS pose difference between the closed-loop model and the true plant on
validation trajectories, for the worst axis and run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics import DynamicsError, load_robot
from dynamics.errors import ParameterError, SimulationError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.base_parameters import structure
from identify.estimation.covariance import estimate_uncertainty
from identify.estimation.identifiability import IDENTIFIABLE_SHARE, group_estimates, identifiability
from identify.estimation.identification import output_error_problem
from identify.estimators.estimator import Estimate, Estimator, Evidence, joint_channels
from identify.experiment.joint_instruments import JointInstruments, measure_joints
from identify.experiment.truth import (
    read_truth,
    read_truth_runs,
    true_parameters,
    true_poses,
    true_values,
)
from identify.files.run_folder import load_result, rms_figures, rms_row
from identify.loop_parameters import settled_drive
from identify.model.model_side import ModelSide, model_side
from identify.progress import Progress
from identify.random_streams import INSTRUMENTS, mixed_generator
from identify.record.conditions import logged_latencies, takes_torques
from identify.record.known_geometry import known_geometry
from identify.record.provenance import RunFiles
from identify.scenario import Timing, load_scenario
from identify.scenario.plant_sections import AUTO
from identify.scenario.sections import Identification
from identify.validation.unseen import model_on_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

START = "starting guess"  # key of the initial guess in the results


@dataclass(frozen=True)
class ComparisonTruth:
    """Truth against which estimators are compared.

    side                 Robot and loop that the estimator assumes.
    true (p,)            True parameters.
    combinations (k, p)  Combinations of the dynamic parameters that the record identifies.
    validation           Validation runs of the plant.
    """

    side: ModelSide
    true: Array
    combinations: Array
    validation: tuple[tuple[xr.Dataset, xr.Dataset], ...]

    def group_errors(self, parameters: Array) -> Array:
        """Return the relative errors (k,) of the base parameters that the record identifies."""
        dynamic = self.side.robot.layout.dynamic
        true = self.combinations @ self.true[dynamic]
        return np.asarray(
            (self.combinations @ parameters[dynamic] - true) / np.abs(true), dtype=float
        )

    def pose_distance(self, parameters: Array) -> tuple[float, float]:
        """Return the RMS errors of position, um, and angles, urad, of the worst axis and run.

        Both are NaN if the model's loop is unstable, or if no model can have the parameters, for
        example a gain of zero.
        """
        errors = []
        for record, truth in self.validation:
            try:
                poses = model_on_record(self.side, parameters, record)
            except (ParameterError, SimulationError):
                return float("nan"), float("nan")
            errors.append(rms_row(rms_figures(poses - true_poses(truth))))
        worst = np.max(np.array(errors), axis=0)
        return float(worst[:3].max()), float(worst[3:].max())


@dataclass(frozen=True)
class Score:
    """Row of the table of estimators.

    name, title, uses              Name and title of the estimator, and the data that it uses.
    group_distance, group_median   RMS and median of the relative errors of the base parameters.
    gain_distance                  RMS of the relative errors of the gains.
    position_um, orientation_urad  RMS pose errors of the worst axis and run on validation
                                   trajectories.
    seconds                        Duration of the estimation.
    iterations, evaluations        Iterations and model evaluations.
    note                           Remark, such as the reason of a failure. After a failure,
                                   distances, errors and duration are NaN.
    parameters, std (p,)           Estimates and their standard deviations.
    names                          Names of the parameters.
    """

    name: str
    title: str
    uses: str
    group_distance: float
    group_median: float
    gain_distance: float
    position_um: float
    orientation_urad: float
    seconds: float
    iterations: int
    evaluations: int
    note: str
    parameters: Array | None = None
    std: Array | None = None
    names: tuple[str, ...] = ()


def compare_on_run(
    files: RunFiles,
    instruments: JointInstruments,
    estimators: Mapping[str, Estimator],
    seed: int,
    progress: Progress,
) -> tuple[list[Score], xr.Dataset]:
    """Score estimators on the record of a run.

    Joint instruments are simulated from its truth, and their readings are returned with the scores.
    Estimators that need the joint PID get its true gains.

    Raises RecordError for damaged files. Raises EstimationError for a record with torque commands,
    and as `examination` does.
    """
    folder = files.folder
    record = files.experiment
    scenario = load_scenario(folder.whole_scenario)
    truth = read_truth(folder.experiment)
    if takes_torques(record):
        raise EstimationError(
            "the commands of this record are torques, but the compared estimators need joint "
            "commands: record the excitation under excitation.law = pid or feedforward"
        )
    robot = known_geometry(load_robot(scenario.robot), scenario.geometry, folder.path).robot
    side = model_side(robot, scenario)
    if scenario.model.drive == AUTO:
        result = load_result(folder.result)
        side = side.with_drive(settled_drive(result.get("identification")))
    channels = instrumented(record, truth, scenario.timing, instruments, seed)
    validation = zip(files.validation, read_truth_runs(folder.validation), strict=True)
    scores = compare_on_record(
        (record, truth),
        channels,
        side,
        scenario.identification,
        list(validation),
        estimators,
        progress,
    )
    return scores, channels


def instrumented(
    record: xr.Dataset,
    truth: xr.Dataset,
    timing: Timing,
    instruments: JointInstruments,
    seed: int,
) -> xr.Dataset:
    """Return the readings of instruments at the joints during a run, with the noise of a seed."""
    latencies = logged_latencies(record, timing)
    return measure_joints(
        record, truth, timing, instruments, mixed_generator(INSTRUMENTS, seed), latencies
    )


def compare_on_record(
    experiment: tuple[xr.Dataset, xr.Dataset],
    channels: xr.Dataset,
    side: ModelSide,
    settings: Identification,
    validation: Sequence[tuple[xr.Dataset, xr.Dataset]],
    estimators: Mapping[str, Estimator],
    progress: Progress,
) -> list[Score]:
    """Score estimators on a record with its truth and the channels of its joints.

    `validation`: (record, truth) pairs of validation runs, which determine the pose distance.
    """
    record, truth = experiment
    known = true_parameters(truth)
    layout = side.robot.layout
    true = np.array(true_values(known, layout.names))
    problem = output_error_problem([record], side, settings)
    evidence = Evidence(problem, joint_channels(channels, record), true[layout.joint_pid])
    return compare(evidence, examination(evidence, side, true, validation), estimators, progress)


def examination(
    evidence: Evidence,
    side: ModelSide,
    true: Array,
    validation: Sequence[tuple[xr.Dataset, xr.Dataset]],
) -> ComparisonTruth:
    """Return the truth of a comparison from true parameters (p,) and (record, truth) pairs.

    Raises EstimationError if the record identifies no base parameter, or if there is no validation
    run.
    """
    if not validation:
        raise EstimationError("there is no validation run by which to judge the estimators")
    robot = side.robot
    base = structure(robot)
    driven = evidence.problem.driven_by_commands()
    # With a fixed seed, the choice of the compared parameters is always the same.
    uncertainty = estimate_uncertainty(driven, true, np.random.default_rng(0))
    guess = evidence.problem.guess
    groups = group_estimates(base, guess, identifiability(guess, robot), true, uncertainty)
    # The relative error of a base parameter near zero is meaningless.
    shown: NDArray[np.bool_] = groups.identifiable & (
        groups.std < IDENTIFIABLE_SHARE * np.abs(groups.estimate)
    )
    if not shown.any():
        raise EstimationError(
            "the record identifies no base parameter: there is nothing to compare"
        )
    return ComparisonTruth(side, true, base.combinations[shown], tuple(validation))


def compare(
    evidence: Evidence,
    asked: ComparisonTruth,
    estimators: Mapping[str, Estimator],
    progress: Progress,
) -> list[Score]:
    """Score the initial guess and each estimator.

    The note of a failed estimator states the reason.
    """
    guess = evidence.problem.guess
    start = Estimator("initial guess", "", lambda given: Estimate(guess.values, guess.std))
    scores = [_score(START, start, evidence, asked)]
    with progress.stage("estimators", len(estimators)) as advance:
        for name, estimator in estimators.items():
            scores.append(_score(name, estimator, evidence, asked))
            advance()
    return scores


def _score(name: str, estimator: Estimator, evidence: Evidence, asked: ComparisonTruth) -> Score:
    try:
        estimate = estimator(evidence)
    except (EstimationError, DynamicsError) as error:
        nothing = (np.nan,) * 6
        return Score(name, estimator.title, estimator.uses, *nothing, 0, 0, f"failed: {error}")
    layout = asked.side.robot.layout
    pid = layout.joint_pid
    groups = asked.group_errors(estimate.parameters)
    # Gains that the drive law does not use are zero, and are omitted.
    used = np.flatnonzero(asked.true[pid]) + pid.start
    gains = estimate.parameters[used] / asked.true[used] - 1
    distances = (
        _rms(groups),
        float(np.median(np.abs(groups))),
        _rms(gains),
        *asked.pose_distance(estimate.parameters),
    )
    return Score(
        name,
        estimator.title,
        estimator.uses,
        *distances,
        **vars(estimate),
        names=layout.names,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


PANELS = (
    ("base parameters", "median error [%]", "group_median", 100.0),
    ("validation position", "worst RMS [um]", "position_um", 1.0),
    ("validation orientation", "worst RMS [urad]", "orientation_urad", 1.0),
    ("time", "seconds", "seconds", 1.0),
)


def estimators_figure(scores: Sequence[Score]) -> "Figure":
    """Draw the scores on logarithmic axes, one panel per figure of merit.

    A value that is missing, for example of an unstable model, or zero has no point.
    """
    from matplotlib.figure import Figure  # late, because rows of studies draw nothing

    figure = Figure(figsize=(14, 1.2 + 0.42 * len(scores)), layout="constrained")
    heights = np.arange(len(scores))[::-1]
    for axes, (title, label, field, factor) in zip(
        figure.subplots(1, len(PANELS), sharey=True), PANELS, strict=True
    ):
        values = np.array([factor * getattr(score, field) for score in scores], dtype=float)
        # Logarithmic axes cannot show zero.
        axes.plot(np.where(values > 0, values, np.nan), heights, "o", color="tab:blue")
        axes.set(title=title, xlabel=label, xscale="log")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].set_yticks(heights, [score.title for score in scores])
    figure.suptitle("Estimators on one record, against one truth")
    return figure
