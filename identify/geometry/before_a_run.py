"""Run of `cmmsim geometry`: choose poses, measure, calibrate, and validate on other poses."""

import numpy as np

from cmmsim.visibility import SightLines
from dynamics import Robot
from identify.arrays import Array
from identify.experiment.true_robot import true_deviations
from identify.geometry.calibration import PoseModel, Tolerance, calibrate
from identify.geometry.observability import check_enough
from identify.geometry.outcome import GeometryOutcome
from identify.geometry.pose_selection import Candidates, Designer, Limits
from identify.geometry.static_experiment import encoders_of, measure_static_poses, true_poses
from identify.geometry.static_poses import FrameKnowledge, StaticPoses, check_encoders
from identify.loop_parameters import of_actuators
from identify.progress import Progress
from identify.random_streams import STATIC_POSES, UNSEEN_POSES, child
from identify.scenario import Excitation
from identify.scenario.sections import Geometry
from identify.setup import Setup


def run_geometry(
    setup: Setup, progress: Progress, measurements: StaticPoses | None = None
) -> GeometryOutcome:
    """Calibrate the geometry of a robot, simulated or from a user's own measurements.

    Raises EstimationError if the loops do not close, the search does not converge, or there are too
    few poses. For too few measured poses, the message states how many are needed and for which
    numbers. Raises RecordError if the encoder readings do not fit the poses. Raises
    UnreachablePoseError if a measured pose is out of reach.
    """
    robot = setup.nominal
    seed = setup.seed
    settings = setup.scenario.geometry
    limits = setup.scenario.excitation
    lost = 0
    chosen = None
    true = None
    if measurements is not None:
        data = measurements
        check_encoders(robot, data)
        covariance = data.covariances.mean(axis=0)
        designer = _designer(robot, settings, limits, data.frames, covariance, None)
        rng = np.random.default_rng(child(seed, STATIC_POSES))
        among = designer.candidates(settings.candidates, rng)
    else:
        plan = setup.sensor_plan
        zero = np.zeros((6, 6))
        # The errors of teaching are unknown before teaching, so taught frames count as exact.
        taught = settings.frames == "taught"
        frames = FrameKnowledge(zero, zero) if taught else FrameKnowledge.none()
        covariance = plan.covariance(robot.home_pose) / settings.frames_per_pose
        designer = _designer(robot, settings, limits, frames, covariance, plan.sight)
        chosen, among = _choose(designer, settings, seed, progress)
        true = true_deviations(robot, setup.scenario.plant, settings, seed)
        # Poses out of reach raise an error here, before the slow teaching of the sensor.
        true_poses(robot, true, chosen.joints, chosen.poses)
        sensor = plan.taught(robot, seed, progress)
        data, lost = measure_static_poses(
            robot, settings, sensor, plan.sight, true, chosen.joints, chosen.poses, seed, progress
        )
        check_encoders(robot, data)
    _require_enough(designer, among, data.different)
    with progress.stage("calibrate", 1) as advance:
        found = calibrate(robot, data, Tolerance(settings.tolerance_m, settings.tolerance_rad))
        advance()
    unseen = designer.candidates(settings.unseen, np.random.default_rng(child(seed, UNSEEN_POSES)))
    return GeometryOutcome(
        setup.scenario, seed, designer.model, found, data, lost, true, unseen, chosen, among
    )


def _designer(
    robot: Robot,
    settings: Geometry,
    excitation: Excitation,
    frames: FrameKnowledge,
    covariance: Array,
    sight: SightLines | None,
) -> Designer:
    """Return the designer of pose sets. covariance: covariance of the mean of a pose's frames."""
    model = PoseModel(
        robot, Tolerance(settings.tolerance_m, settings.tolerance_rad).of(robot), frames
    )
    travel = robot.travel_limit - of_actuators(robot, excitation, "travel_margin")
    limits = Limits(robot, travel, excitation.least_leverage, excitation.most_condition, sight)
    std = np.full(
        robot.layout.joints, encoders_of(robot, settings).mean_std(settings.frames_per_pose)
    )
    return Designer(model, limits, covariance, std, settings.criterion)


def _choose(
    designer: Designer, settings: Geometry, seed: int, progress: Progress
) -> tuple[Candidates, Candidates]:
    """Return the poses to measure, and the candidates from which they were chosen."""
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
