"""Estimators judged on one record against one truth; nothing but this module shows them the truth.

Figures of merit of Leboutet et al., "Inertial parameter identification in robotics: a survey"
(Applied Sciences 11(9), 2021; their toolbox BIRDy): distance of the parameters, distance of the
output, time, iterations, model evaluations. Single parameters cannot be compared, because no motion
separates them. The parameter distance is the RMS relative error of those base parameters that the
record shows: which these are follows from the information at the true parameters, so that no
estimator chooses its own examination. The few that are only just shown decide this RMS, and there a
fit that leans on the starting guess may look best; so the median, which is that of an ordinary one,
stands beside it. The gains of the joint PID have their own column. The pose distance is that of the
closed-loop model from the true plant on unseen trajectories, RMS of the worst axis and run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dynamics import DynamicsError, Robot
from dynamics.errors import ParameterError, SimulationError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.base_parameters import structure
from identify.estimation.covariance import estimate_uncertainty
from identify.estimation.identifiability import IDENTIFIABLE_SHARE, group_estimates, identifiability
from identify.estimation.identification import output_error_problem
from identify.estimators.estimator import Estimate, Estimator, Evidence, joint_channels
from identify.experiment.joint_instruments import JointInstruments, measure_joints, read_channels
from identify.experiment.truth import read_truth, read_truth_runs, true_parameters, true_poses
from identify.files.dataset import write_groups
from identify.files.run_folder import load_result, rms_figures, rms_row
from identify.loop_parameters import settled_drive, with_drive
from identify.progress import Progress
from identify.random_streams import INSTRUMENTS, mixed_generator
from identify.record.command_times import logged_latencies
from identify.record.known_geometry import known_geometry
from identify.record.law import takes_torques
from identify.record.provenance import RunFiles
from identify.scenario import Scenario, load_scenario
from identify.scenario.plant_sections import AUTO
from identify.validation.unseen import model_on_record

START = "starting guess"


@dataclass(frozen=True)
class Examination:
    """The truth: parameters (p,), combinations (k, p) of the dynamic ones that the record shows,
    unseen runs of the plant."""

    robot: Robot
    scenario: Scenario
    true: Array
    combinations: Array
    unseen: tuple[tuple[xr.Dataset, xr.Dataset], ...]

    def group_errors(self, parameters: Array) -> Array:
        """Relative errors (k,) of the base parameters that the record shows."""
        dynamic = self.robot.layout.dynamic
        true = self.combinations @ self.true[dynamic]
        return np.asarray(
            (self.combinations @ parameters[dynamic] - true) / np.abs(true), dtype=float
        )

    def pose_distance(self, parameters: Array) -> tuple[float, float]:
        """RMS of the worst axis and run, um and urad; NaN where the model's loop is unstable, or an
        estimator gives parameters with which no model runs, such as a gain of zero."""
        rows = []
        for record, truth in self.unseen:
            try:
                poses = model_on_record(self.robot, self.scenario, parameters, record)
            except (ParameterError, SimulationError):
                return float("nan"), float("nan")
            rows.append(rms_row(rms_figures(poses - true_poses(truth))))
        worst = np.max(np.array(rows), axis=0)
        return float(worst[:3].max()), float(worst[3:].max())


@dataclass(frozen=True)
class Score:
    """One row of the table. Distances: RMS and median relative errors of groups, RMS of gains, um
    and urad on unseen trajectories; NaN with a reason in the note where an estimator gave nothing.
    parameters, std (p,): what it gave, of the parameters with these names."""

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
) -> list[Score]:
    """Scores on the record of a run, with joint instruments simulated from its truth, which are
    kept as instruments.nc.

    Where the PID is known it has the true gains. Raises RecordError for files that are damaged.
    """
    folder = files.folder
    record = files.experiment
    scenario = load_scenario(folder.whole_scenario)
    truth = read_truth(folder.experiment)
    if takes_torques(record):
        raise EstimationError(
            "the commands of this record are torques, and the estimators compared need joint "
            "commands: record the "
            "excitation under excitation.law = pid or feedforward"
        )
    if scenario.model.drive == AUTO:
        scenario = with_drive(
            scenario, settled_drive(load_result(folder.result).get("identification"))
        )
    robot = known_geometry(scenario, folder.path).robot
    channels = folder.path / "instruments.nc"
    write_groups(channels, {"": instrumented(record, truth, scenario, instruments, seed)})
    unseen = zip(files.validation, read_truth_runs(folder.validation), strict=True)
    return compare_on_record(
        (record, truth),
        read_channels(channels),
        robot,
        scenario,
        list(unseen),
        estimators,
        progress,
    )


def instrumented(
    record: xr.Dataset,
    truth: xr.Dataset,
    scenario: Scenario,
    instruments: JointInstruments,
    seed: int,
) -> xr.Dataset:
    """What instruments at the joints, whose noise is of a seed, read during a run."""
    latencies = logged_latencies(record, scenario.timing)
    return measure_joints(
        record, truth, scenario.timing, instruments, mixed_generator(INSTRUMENTS, seed), latencies
    )


def compare_on_record(
    experiment: tuple[xr.Dataset, xr.Dataset],
    channels: xr.Dataset,
    robot: Robot,
    scenario: Scenario,
    unseen: Sequence[tuple[xr.Dataset, xr.Dataset]],
    estimators: Mapping[str, Estimator],
    progress: Progress,
) -> list[Score]:
    """Scores on a record, with its truth and channels of its joints, judged also by unseen (record,
    truth) pairs.
    """
    record, truth = experiment
    known = true_parameters(truth)
    true = np.array([known[name] for name in robot.layout.names])
    problem = output_error_problem([record], robot, scenario)
    gains = true[robot.layout.joint_pid]
    evidence = Evidence(problem, scenario, joint_channels(channels, record), gains)
    return compare(evidence, examination(evidence, true, unseen), estimators, progress)


def examination(
    evidence: Evidence, true: Array, unseen: Sequence[tuple[xr.Dataset, xr.Dataset]]
) -> Examination:
    """What is asked of the estimators, from the true parameters (p,) and unseen (record, truth)
    pairs.

    Raises EstimationError where the record shows no base parameter, or no unseen run is given.
    """
    if not unseen:
        raise EstimationError("no unseen trajectory to judge the estimators on")
    robot = evidence.run.robot
    base = structure(robot)
    driven = evidence.problem.driven_by_commands()
    uncertainty = estimate_uncertainty(driven, true, np.random.default_rng(0))
    guess = evidence.problem.guess
    groups = group_estimates(base, guess, identifiability(guess, robot), true, uncertainty)
    # A relative error says nothing of a difference that almost vanishes.
    shown: NDArray[np.bool_] = groups.identifiable & (
        groups.std < IDENTIFIABLE_SHARE * np.abs(groups.estimate)
    )
    if not shown.any():
        raise EstimationError("the record shows no base parameter: there is nothing to compare")
    return Examination(robot, evidence.scenario, true, base.combinations[shown], tuple(unseen))


def compare(
    evidence: Evidence, asked: Examination, estimators: Mapping[str, Estimator], progress: Progress
) -> list[Score]:
    """One score for the starting guess and each estimator; one that fails has its reason in the
    note.
    """
    guess = evidence.problem.guess
    scores = [
        _score(
            START,
            Estimator(START, "", lambda given: Estimate(guess.values, guess.std)),
            evidence,
            asked,
        )
    ]
    with progress.stage("estimators", len(estimators)) as advance:
        for name, estimator in estimators.items():
            scores.append(_score(name, estimator, evidence, asked))
            advance()
    return scores


def _score(name: str, estimator: Estimator, evidence: Evidence, asked: Examination) -> Score:
    try:
        found = estimator(evidence)
    except (EstimationError, DynamicsError) as error:
        nothing = (np.nan, np.nan, np.nan, np.nan, np.nan, np.nan)
        return Score(name, estimator.title, estimator.uses, *nothing, 0, 0, f"failed: {error}")
    pid = asked.robot.layout.joint_pid
    groups = asked.group_errors(found.parameters)
    read = np.flatnonzero(asked.true[pid]) + pid.start
    gains = found.parameters[read] / asked.true[read] - 1
    distances = (
        _rms(groups),
        float(np.median(np.abs(groups))),
        _rms(gains),
        *asked.pose_distance(found.parameters),
    )
    return Score(
        name,
        estimator.title,
        estimator.uses,
        *distances,
        **vars(found),
        names=asked.robot.layout.names,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


PANELS = (
    ("base parameters", "median error [%]", "group_median", 100.0),
    ("unseen position", "worst RMS [um]", "position_um", 1.0),
    ("unseen orientation", "worst RMS [urad]", "orientation_urad", 1.0),
    ("time", "seconds", "seconds", 1.0),
)


def estimators_figure(scores: Sequence[Score]) -> Figure:
    """Points on logarithmic axes, one panel a figure of merit; what does not exist (an unstable
    model) has none.
    """
    figure = Figure(figsize=(14, 1.2 + 0.42 * len(scores)), layout="constrained")
    places = np.arange(len(scores))[::-1]
    for axes, (title, label, field, factor) in zip(
        figure.subplots(1, len(PANELS), sharey=True), PANELS, strict=True
    ):
        values = np.array([factor * getattr(score, field) for score in scores], dtype=float)
        axes.plot(np.where(values > 0, values, np.nan), places, "o", color="tab:blue")
        axes.set(title=title, xlabel=label, xscale="log")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].set_yticks(places, [score.title for score in scores])
    figure.suptitle("Estimators on one record, against one truth")
    return figure
