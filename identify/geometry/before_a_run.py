"""Run of `cmmsim geometry`: choose poses, measure them, calibrate, and judge on unseen poses."""

import numpy as np

from cmmsim.visibility import SightLines, expected_covariance, sight_lines
from dynamics import Robot, load_robot
from identify.arrays import Array
from identify.experiment.plant import true_deviations
from identify.experiment.run import taught_sensor
from identify.experiment.sensor_in_loop import with_renderer
from identify.geometry.calibration import PoseModel, Tolerance, calibrate
from identify.geometry.encoders import check_encoders
from identify.geometry.observability import check_enough
from identify.geometry.outcome import GeometryOutcome
from identify.geometry.selection import Candidates, Designer, Limits
from identify.geometry.static_experiment import encoders_of, stand_at, true_poses
from identify.geometry.static_poses import FrameKnowledge, StaticPoses
from identify.loop_parameters import of_actuators
from identify.progress import Progress
from identify.random_streams import STATIC_POSES, UNSEEN_POSES, child
from identify.record.known_geometry import KnownGeometry
from identify.scenario import Scenario


def run_geometry(
    scenario: Scenario, seed: int, progress: Progress, measurements: StaticPoses | None = None
) -> GeometryOutcome:
    """Calibrate the geometry of a scenario's robot, simulated or from a user's own measurements.

    Raises
    ------
    EstimationError
        If the loops do not close, or if there are too few poses. The message then says how many
        are needed and for which numbers.
    RecordError
        If the encoders read something else than the joints.
    UnreachablePoseError
        If a measured pose is out of reach.
    """
    scenario = with_renderer(scenario)
    robot = load_robot(scenario.robot)
    settings = scenario.geometry
    tolerance = Tolerance(settings.tolerance_m, settings.tolerance_rad)
    lost = 0
    chosen = None
    true = None
    if measurements is not None:
        data = measurements
        check_encoders(robot, data)
        designer = _designer(robot, scenario, data.frames, data.covariances.mean(axis=0), None)
        rng = np.random.default_rng(child(seed, STATIC_POSES))
        among = designer.candidates(settings.candidates, rng)
    else:
        sight = sight_lines(scenario.sensor, scenario.sensor_changes)
        designer = _designer(robot, scenario, *_expected(robot, scenario), sight)
        chosen, among = _choose(designer, scenario, seed, progress)
        true = true_deviations(robot, scenario, seed)
        # Refuses poses out of reach before the sensor is taught, which takes time.
        true_poses(robot, true, chosen.joints, chosen.poses)
        sensor = taught_sensor(scenario, robot, seed, progress)
        data, lost = stand_at(
            robot, scenario, sensor, true, chosen.joints, chosen.poses, seed, progress
        )
        check_encoders(robot, data)
    _require_enough(designer, among, data.different)
    with progress.stage("calibrate", 1) as advance:
        found = calibrate(robot, data, tolerance)
        advance()
    unseen = designer.candidates(settings.unseen, np.random.default_rng(child(seed, UNSEEN_POSES)))
    return GeometryOutcome(
        scenario, seed, designer.model, found, data, lost, true, unseen, chosen, among
    )


def calibrated_for_a_run(
    scenario: Scenario, seed: int, progress: Progress
) -> tuple[GeometryOutcome, KnownGeometry]:
    """Calibrate the geometry before a run that needs it.

    Returns the outcome, and the geometry that is known after it. Raises the errors of
    `run_geometry`.
    """
    outcome = run_geometry(scenario, seed, progress)
    nominal = outcome.calibration.nominal
    found = outcome.calibration.robot.geometry
    robot = nominal.moved(found.deviations_from(nominal.geometry))
    return outcome, KnownGeometry(robot, outcome.calibration.covariance)


def _designer(
    robot: Robot,
    scenario: Scenario,
    frames: FrameKnowledge,
    covariance: Array,
    sight: SightLines | None,
) -> Designer:
    settings = scenario.geometry
    excitation = scenario.excitation
    model = PoseModel(
        robot, Tolerance(settings.tolerance_m, settings.tolerance_rad).of(robot), frames
    )
    travel = robot.travel_limit - of_actuators(robot, excitation, "travel_margin")
    limits = Limits(robot, travel, excitation.least_leverage, excitation.most_condition, sight)
    std = np.full(
        robot.layout.joints, encoders_of(robot, settings).mean_std(settings.frames_per_pose)
    )
    return Designer(model, limits, covariance, std, settings.criterion)


def _expected(robot: Robot, scenario: Scenario) -> tuple[FrameKnowledge, Array]:
    """Knowledge of the frames before teaching, and the expected covariance (6, 6) of a pose's mean.

    The covariance is that at home.
    """
    changes = scenario.sensor_changes
    nothing = np.zeros((6, 6))
    one = expected_covariance(scenario.sensor, robot.home_pose, scenario.pose_method, changes)
    taught = scenario.geometry.frames == "taught"
    frames = FrameKnowledge(nothing, nothing) if taught else FrameKnowledge.none()
    return frames, one / scenario.geometry.frames_per_pose


def _choose(
    designer: Designer, scenario: Scenario, seed: int, progress: Progress
) -> tuple[Candidates, Candidates]:
    """Poses to measure, and the candidates from which they were chosen."""
    settings = scenario.geometry
    rng = np.random.default_rng(child(seed, STATIC_POSES))
    with progress.stage("choose poses", settings.poses + 1) as advance:
        among = designer.candidates(max(settings.candidates, settings.poses), rng)
        _require_enough(designer, among, settings.poses)
        chosen = among.of(list(range(settings.poses)))
        if settings.selection != "random":
            chosen = designer.greedy(among, settings.poses, advance)
        if settings.selection == "gradient":
            chosen = designer.moved(chosen, among)
        advance()
    return chosen, among


def _require_enough(designer: Designer, among: Candidates, poses: int) -> None:
    model = designer.model
    check_enough(model.robot, poses, among.information, model.scale, model.tolerance)
