"""`cmmsim geometry` from scenario to files: choose poses, measure them, calibrate, judge on unseen ones."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmmsim.visibility import expected_covariance, sight_lines
from dynamics import Robot, load_robot
from dynamics.robot_file import RobotDescription
from dynamics.robot_text import robot_text
from identify.arrays import Array
from identify.experiment.run import taught_sensor
from identify.experiment.sensor_in_loop import with_renderer
from identify.files.run_folder import rms_figures
from identify.files.versions import versions
from identify.geometry.calibration import Calibration, PoseModel, Tolerance, calibrate, frame_columns, seen_between
from identify.geometry.encoders import check_encoders
from identify.geometry.experiment import encoders_of, stand_at, true_deviations, true_poses
from identify.geometry.observability import check_enough, combinations
from identify.geometry.selection import Candidates, Designer, Limits
from identify.geometry.static_poses import FrameKnowledge, StaticPoses
from identify.loop_parameters import of_actuators
from identify.progress import Progress
from identify.random_streams import STATIC_POSES, UNSEEN_POSES, child
from identify.scenario import Scenario

NOISY = 4.0
"""Standard deviations of the noise ratio from one at which the model or the stated noise is said to be wrong."""


@dataclass(frozen=True)
class GeometryOutcome:
    """A calibration, the poses behind it, true deviations (g,) where they are known, and the entry of geometry.json."""

    calibration: Calibration
    data: StaticPoses
    true: Array | None
    entry: dict[str, Any]

    @property
    def files(self) -> dict[str, Any]:
        """Names and contents of what is written."""
        robot = self.calibration.robot
        description = RobotDescription(robot.name, robot.geometry, robot.parameter_sets)
        said = f"{robot.name} with the geometry of {len(self.data)} static poses; see geometry.json beside this file"
        return {
            "geometry.json": self.entry,
            "poses.json": self.data.entry(robot),
            "robot.toml": robot_text(description, [said]),
            "geometry.md": geometry_markdown(self.entry),
        }


def run_geometry(
    scenario: Scenario, seed: int, progress: Progress, measurements: StaticPoses | None = None
) -> GeometryOutcome:
    """Calibrate the geometry of a scenario's robot, simulated, or from measurements of one's own.

    Raises EstimationError: too few poses, with how many are needed and for what; loops that do not close. RecordError:
    encoders that read something else than the joints. UnreachablePoseError: a measured pose out of reach.
    """
    scenario = with_renderer(scenario)
    robot, settings = load_robot(scenario.robot), scenario.geometry
    lost, chosen, true = 0, None, None
    if measurements is not None:
        check_encoders(robot, measurements)
        designer = _designer(robot, scenario, measurements.frames, measurements.covariances.mean(axis=0))
        among = designer.candidates(settings.candidates, np.random.default_rng(child(seed, STATIC_POSES)))
        _require_enough(designer, among, len(measurements))
        data = measurements
    else:
        covariance = expected_covariance(
            scenario.sensor, robot.home_pose, scenario.pose_method, scenario.sensor_changes
        )
        nothing = np.zeros((6, 6))
        frames = FrameKnowledge(nothing, nothing) if settings.frames == "taught" else FrameKnowledge.none()
        designer = _designer(robot, scenario, frames, covariance / settings.frames_per_pose)
        chosen, among = _choose(designer, scenario, seed, progress)
        true = true_deviations(robot, scenario, seed)
        true_poses(robot, true, chosen.joints, chosen.poses)
        sensor = taught_sensor(scenario, robot, seed, progress)
        data, lost = stand_at(robot, scenario, sensor, true, chosen.joints, chosen.poses, seed, progress)
        _require_enough(designer, among, len(data))
        check_encoders(robot, data)
    with progress.stage("calibrate", 1) as advance:
        found = calibrate(robot, data, Tolerance(settings.tolerance_m, settings.tolerance_rad))
        advance()
    unseen = designer.candidates(settings.unseen, np.random.default_rng(child(seed, UNSEEN_POSES)))
    entry = _entry(scenario, seed, found, data, true, lost)
    entry |= _judged(designer, found, unseen, true)
    if chosen is not None:
        entry["selection"] = _compared(designer, chosen, among, unseen)
    return GeometryOutcome(found, data, true, entry)


def _designer(robot: Robot, scenario: Scenario, frames: FrameKnowledge, covariance: Array) -> Designer:
    settings, excitation = scenario.geometry, scenario.excitation
    model = PoseModel(robot, Tolerance(settings.tolerance_m, settings.tolerance_rad).of(robot), frames)
    travel = robot.travel_limit - of_actuators(robot, excitation, "travel_margin")
    sight = sight_lines(scenario.sensor, scenario.sensor_changes)
    limits = Limits(robot, travel, excitation.least_leverage, excitation.most_condition, sight)
    std = np.full(robot.layout.joints, encoders_of(robot, settings).mean_std(settings.frames_per_pose))
    return Designer(model, limits, covariance, std, settings.criterion)


def _choose(designer: Designer, scenario: Scenario, seed: int, progress: Progress) -> tuple[Candidates, Candidates]:
    """The poses, and the candidates that they were chosen from."""
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


def _entry(
    scenario: Scenario, seed: int, found: Calibration, data: StaticPoses, true: Array | None, lost: int
) -> dict[str, Any]:
    geometry, names = found.nominal.geometry, found.nominal.geometry.number_names
    columns = {
        "unit": geometry.number_units,
        "nominal": geometry.numbers.tolist(),
        "true": (geometry.numbers + true).tolist() if true is not None else [None] * len(names),
        "estimate": (geometry.numbers + found.deviations).tolist(),
        "std": found.std.tolist(),
        "observable": found.observable.tolist(),
    }
    rows = zip(*columns.values(), strict=True)
    return {
        "scenario": scenario.name,
        "seed": seed,
        "versions": versions(),
        "robot": found.nominal.name,
        "poses": len(data),
        "frames_per_pose": scenario.geometry.frames_per_pose,
        "lost_frames": lost,
        "frames": "taught" if found.frames_known else "unknown",
        "frame_errors": {"base": found.frames[:6], "platform": found.frames[6:]},
        "parameters": {name: dict(zip(columns, row, strict=True)) for name, row in zip(names, rows, strict=True)},
        "cannot_be_told": list(combinations(names, found.covariance, found.prior_std)),
        "noise_ratio": found.noise_ratio,
        "noise_ratio_std": found.noise_ratio_std,
        "warnings": _warnings(found),
    }


def _warnings(found: Calibration) -> list[str]:
    off = (found.noise_ratio - 1) / found.noise_ratio_std
    if off < NOISY:
        return []
    return [
        f"the poses miss the calibrated robot by {np.sqrt(found.noise_ratio):.2f} times what is stated of sensor and "
        f"encoders ({off:.0f} standard deviations more than chance): intervals are too short, or the robot is not what "
        f"{found.nominal.name} says, such as its legs bend or its joints have play"
    ]


def _judged(designer: Designer, found: Calibration, unseen: Candidates, true: Array | None) -> dict[str, Any]:
    """By how much poses that were not measured are missed, as expected, and in truth where that is known."""
    model, joints, poses = designer.model, unseen.joints, unseen.poses
    free, robot = list(robot_freedoms(found.nominal)), found.nominal
    columns, covariance = model.closure.derivatives(poses, joints, found.deviations)[0], found.covariance
    if not found.frames_known:  # what the geometry lacks is then in the frames, and both together are known
        columns = np.concatenate([columns, frame_columns(robot, poses)[:, free]], axis=2)
        covariance = found.joint_covariance
    spread = np.zeros((len(poses), 6))
    spread[:, free] = np.sqrt(np.einsum("nmg,gh,nmh->nm", columns, covariance, columns))
    judged: dict[str, Any] = {"expected": rms_figures(spread)}
    if true is None:
        return judged | {"unseen": rms_figures(np.full((1, 6), np.nan))}
    stands = true_poses(robot, true, joints, poses)
    predicted = seen_between(model.closure.poses(joints, found.deviations, poses), found.frames)
    return judged | {"unseen": rms_figures(predicted - stands), "uncalibrated": rms_figures(poses - stands)}


def robot_freedoms(robot: Robot) -> tuple[int, ...]:
    """Entries of the pose that the robot's platform can change."""
    return robot.geometry.chart.freedoms


def _compared(designer: Designer, chosen: Candidates, among: Candidates, unseen: Candidates) -> dict[str, Any]:
    """What unseen poses are expected to be missed by after the chosen poses, and after as many random ones, and twice
    as many."""
    count = len(chosen)
    sets = {"chosen": chosen, "random": among.of(list(range(count)))}
    if len(among) >= 2 * count:
        sets["twice as many random"] = among.of(list(range(2 * count)))
    model = designer.model
    columns = model.columns(unseen.joints, unseen.poses, np.zeros(len(model.scale)))[0]
    compared = {}
    for name, poses in sets.items():
        covariance = np.linalg.inv(poses.information + np.eye(len(model.scale)))
        spread = np.zeros((len(unseen), 6))
        spread[:, list(robot_freedoms(model.robot))] = np.sqrt(
            np.einsum("nmu,uv,nmv->nm", columns, covariance, columns)
        )
        compared[name] = {"poses": len(poses)} | rms_figures(spread)
    return compared


def geometry_markdown(entry: dict[str, Any]) -> str:
    """The result in words and a table."""
    told = [name for name, one in entry["parameters"].items() if one["observable"]]
    lines = [
        f"# Geometry of {entry['robot']}",
        "",
        f"From {entry['poses']} static poses of {entry['frames_per_pose']} frames each, with {entry['lost_frames']} "
        f"frames lost. {len(told)} of {len(entry['parameters'])} geometric numbers are told by the poses; the others "
        "stay where the robot file has them, within the stated tolerance.",
        "",
        f"Residuals are {np.sqrt(entry['noise_ratio']):.3f} times what sensor and encoders explain.",
    ]
    lines += [f"Warning: {text}." for text in entry["warnings"]]
    for key, said in (
        ("uncalibrated", "Before the calibration, unseen poses are missed by"),
        ("unseen", "After it, they are missed by"),
        ("expected", "Expected from the covariance of the geometry"),
    ):
        figures = entry.get(key)
        if figures is not None and np.isfinite(figures["position_rms_um"]).all():
            lines += ["", f"{said} (root mean square): {_figures(figures)}."]
    lines += ["", "| number | nominal | true | estimate | standard deviation | told |", "|---|---|---|---|---|---|"]
    for name, one in entry["parameters"].items():
        factor, unit = (1e3, "mm") if one["unit"] == "m" else (1e3, "mrad")
        true = "" if one["true"] is None else f"{factor * one['true']:.4f}"
        lines.append(
            f"| {name} [{unit}] | {factor * one['nominal']:.4f} | {true} | {factor * one['estimate']:.4f} "
            f"| {factor * one['std']:.4f} | {'yes' if one['observable'] else 'no'} |"
        )
    if entry["cannot_be_told"]:
        lines += ["", "Combinations that these poses cannot tell (when all move together, no pose shows it):", ""]
        lines += [f"- {text}" for text in entry["cannot_be_told"]]
    return "\n".join(lines) + "\n"


def _figures(figures: dict[str, Any]) -> str:
    position, turn = (
        ", ".join(f"{value:.2f}" for value in figures[key]) for key in ("position_rms_um", "orientation_rms_urad")
    )
    return f"{position} um in x, y, z and {turn} urad in alpha, beta, gamma"


def write_outcome(outcome: GeometryOutcome, scenario: Scenario, folder: Path) -> None:
    """Write geometry.json, poses.json, robot.toml, geometry.md and scenario.toml, all or none."""
    from identify.files.atomic import atomic_contents
    from identify.files.run_folder import save_files

    with atomic_contents(folder) as temporary:
        save_files(temporary, outcome.files | {"scenario.toml": scenario.to_toml()})
