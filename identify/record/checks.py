"""Checks that a record is suitable for an identification.

A record must come from this robot and loop, be long enough, and contain motion. It must begin at
rest and be in m and rad. Each check raises EstimationError with its finding. A message names a row
of the record by its time, because rows of a log can have been left out before.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from dynamics import Robot
from dynamics.closed_loop import Reference, ServoGains
from dynamics.errors import UnreachablePoseError
from dynamics.kinematics.platform import Chart
from identify.arrays import Array
from identify.errors import EstimationError
from identify.files.dataset import POSE, as_number, shown
from identify.filtering import SPLINE_DEGREE, padding_samples
from identify.record.provenance import check_robot, recorded_scenario
from identify.record.recording import check_record, is_timed, poses
from identify.scenario import Excitation, Filter, Timing
from identify.trajectory import FourierTrajectory

MINIMUM_GOOD_SHARE = 0.5  # smallest allowed fraction of measured frames
# Largest difference of a reference from the integral of its rate, as a fraction of its travel.
REFERENCE_GAP = 0.05
# Largest difference, m or rad (relative for frame rates), that counts as rounding.
ROUNDING = 1e-9
# Largest difference of two mirrored entries of a covariance that counts as rounding, as a fraction
# of the product of the two standard deviations.
ASYMMETRY = 1e-6


class TooFewFramesError(EstimationError):
    """Error for a record in which most frames were lost."""


def check_origin(record: xr.Dataset, robot: Robot, timing: Timing, servo: ServoGains) -> None:
    """Check that a record is complete, of this robot, and made with the model's timing and servo.

    Raises RecordError if the record is not complete, or does not state its scenario. Raises
    EstimationError if robot, joints, timing, servo or frame rate differ, or frames are missing.
    """
    check_record(record, "the record")
    check_robot(record, robot)
    if record.sizes["joint"] != robot.layout.joints:
        raise EstimationError(
            f"the record has commands of {record.sizes['joint']} joints, but robot {robot.name!r} "
            f"has {robot.layout.joints}"
        )
    recorded = recorded_scenario(record)
    for section, ours in (("timing", timing.model_dump()), ("servo", asdict(servo))):
        for key, value in getattr(recorded, section).model_dump().items():
            if value != ours[key]:
                raise EstimationError(
                    f"the record was made with {section}.{key} = {value!r}, but the scenario has "
                    f"{ours[key]!r}"
                )
    rate_hz = timing.frame_rate_hz
    stated = record.attrs.get("frame_rate_hz", rate_hz)
    if not abs(as_number(stated) - rate_hz) <= ROUNDING * rate_hz:
        raise EstimationError(
            f"the record contradicts itself: its attribute frame_rate_hz is {shown(stated)}, and "
            f"timing.frame_rate_hz of its attribute scenario is {rate_hz:g}"
        )
    if is_timed(record):
        return
    steps = np.diff(np.asarray(record["time"].values, dtype=float)) * rate_hz
    # `not ... <=` also refuses NaN times, which `>` would accept.
    if len(steps) and not np.abs(steps - 1).max() <= 1e-3:
        worst = int(np.abs(steps - 1).argmax())
        raise EstimationError(
            f"the frame at {moment(record['time'].values, worst)} is {steps[worst]:.3f} periods of "
            f"{rate_hz:g} Hz before the next: frames are missing in the record; store lost frames "
            "with measured_ok = 0"
        )


def check_trajectory(
    record: xr.Dataset, trajectory: FourierTrajectory, timing: Timing, duration_s: float
) -> None:
    """Check that a record's reference is the exciting trajectory (eq. 37) in all frames.

    duration_s: duration of the excitation, s.
    """
    times = timing.frame_times(duration_s)
    if record.sizes["time"] != len(times):
        raise EstimationError(
            f"the record has {record.sizes['time']} frames, and the scenario asks for {len(times)} "
            f"(excitation.duration_s = {duration_s:g} s): the record is of another experiment"
        )
    error = np.abs(poses(record, "reference") - trajectory.pose(times))
    if not error.max() <= ROUNDING:
        frame, worst = np.unravel_index(int(np.argmax(error)), error.shape)
        raise EstimationError(
            f"the record's reference is not the exciting trajectory: its {POSE[worst]} differs by "
            f"{error[frame, worst]:.3g} {'m' if worst < 3 else 'rad'} at t = {times[frame]:.2f} s: "
            "the record is of another experiment"
        )


def check_reference(reference: Reference, rate_hz: float) -> None:
    """Check that the reference moves, and that its poses are the integral of its rates.

    A motion with frequencies above half the frame rate looks like a slow motion in the poses. The
    rates reveal such a motion.
    """
    poses = reference.poses
    rates = reference.rates
    travel = np.ptp(poses, axis=0)
    if not travel.any():
        raise EstimationError(
            "the reference is the same pose in every frame: no motion was requested"
        )
    if len(poses) <= SPLINE_DEGREE:  # too few poses for a spline
        return
    times = np.arange(len(poses)) * (1.0 / rate_hz)
    integral = make_interp_spline(times, rates, k=SPLINE_DEGREE).antiderivative()
    # the range of the difference does not depend on the constant of integration
    error = np.ptp(integral(times) - poses, axis=0)
    worst = int(np.argmax(error - REFERENCE_GAP * travel))
    if error[worst] > REFERENCE_GAP * travel[worst] + ROUNDING:
        raise EstimationError(
            f"the reference's {POSE[worst]} travels {travel[worst]:.3g}, and differs from the "
            f"integral of its rate by up to {error[worst]:.3g}: it has harmonics above half of "
            f"{rate_hz:g} Hz, or the rate is not its derivative"
        )


def fewest_frames(timing: Timing, low_pass: Filter, excitation: Excitation) -> int:
    """Return the smallest allowed number of frames of a record.

    A record must contain one period of the highest harmonic, and be longer than the padding that
    the filter needs.
    """
    return max(
        padding_samples(timing.frame_rate_hz, low_pass.cutoff_hz, low_pass.order) + 1,
        timing.frames(1 / (excitation.fundamental_hz * excitation.harmonics)),
    )


def check_length(frames: int, fewest: int, rate_hz: float, what: str = "the record has") -> None:
    """Check that a record has at least the `fewest_frames`. The message begins with `what`."""
    if frames < fewest:
        raise EstimationError(
            f"{what} {frames} frames ({frames / rate_hz:.3g} s), at least {fewest} are needed, for "
            "one period of the highest harmonic and for the padding of the filter"
        )


def check_good_share(ok: NDArray[np.bool_], seen: Sequence[str] = ()) -> None:
    """Check that enough frames were measured. ok (N,): True for measured frames.

    The message of the TooFewFramesError ends with `seen`, the warnings of the drift watch.
    """
    if ok.mean() < MINIMUM_GOOD_SHARE:
        why = "".join(f": {warning}" for warning in seen)
        raise TooFewFramesError(
            f"only {ok.sum()} of {len(ok)} frames were measured; at least {MINIMUM_GOOD_SHARE:.0%} "
            f"are needed{why}"
        )


def check_channels(chart: Chart, measured: Array, logged: Array, ok: NDArray[np.bool_]) -> None:
    """Check that every coordinate and every command changes.

    Coordinates are computed from the measured poses (N, 6) in the good frames, `ok` (N,). Commands
    (N, n) are checked in all frames. Components that the chart fixes are not checked.
    """
    channels = list(zip(chart.coordinate_names, chart.coordinates(measured[ok]).T, strict=True))
    channels += [
        (f"command of joint {joint}", column) for joint, column in enumerate(logged.T, start=1)
    ]
    for name, values in channels:
        if np.ptp(values) == 0:
            raise EstimationError(
                f"{name} is {values[0]:g} in every frame: nothing moved, or the channel does not "
                "work"
            )


def checked_covariance(covariances: Array, ok: NDArray[np.bool_], times: Array) -> Array:
    """Return the mean (6, 6) of the covariances (N, 6, 6) of the good frames, `ok` (N,).

    times (N,): times of the frames, s, which messages name. Raises EstimationError unless the
    covariances are symmetric and their mean is positive definite.
    """
    _check_symmetry(covariances[ok], times[ok])
    mean = covariances[ok].mean(axis=0)
    if np.linalg.eigvalsh(mean)[0] <= 0:
        raise EstimationError("the record's mean measured_covariance is not positive definite")
    return np.asarray(mean, dtype=float)


def _check_symmetry(covariances: Array, times: Array) -> None:
    """Check that the covariances (n, 6, 6) of frames at times (n,) are symmetric.

    Later computations read only one triangle of each matrix.
    """
    asymmetry = np.abs(covariances - covariances.transpose(0, 2, 1))
    std = np.sqrt(np.abs(np.diagonal(covariances, axis1=1, axis2=2)))
    excess = asymmetry - ASYMMETRY * std[:, :, None] * std[:, None, :]
    if excess.max() <= 0:
        return
    worst, row, column = np.unravel_index(int(np.argmax(excess > 0)), excess.shape)
    raise EstimationError(
        f"measured_covariance is not symmetric in {np.sum((excess > 0).any(axis=(1, 2)))} frames: "
        f"at {moment(times, worst)} its entry ({POSE[row]}, {POSE[column]}) is "
        f"{covariances[worst, row, column]:.6g} and ({POSE[column]}, {POSE[row]}) is "
        f"{covariances[worst, column, row]:.6g}"
    )


REST_RATE = 0.05  # largest initial rate of a reference at rest, as a fraction of its largest rate
# Largest distance of the first measured pose from the reference, as a fraction of the largest
# travel of the reference's positions, or of its angles.
REST_POSE = 0.1
# Largest distance of every other measured pose from the reference, as a multiple of that travel. It
# is also the largest distance of commands from the joint coordinates of the reference, or of the
# measured motion of a timed record, as a multiple of the largest travel of these coordinates.
TRAVELS = 2.0
# Distance of commands from these joint coordinates that is always allowed, as a fraction of the
# joints' travel limit, because the real geometry differs from the robot file.
BUILT = 0.05

# Factors that convert positions to m, and angles to rad, from units that records have by mistake.
OTHER_UNITS = {
    "mm": (1e-3, 1.0),
    "degrees": (1.0, np.pi / 180),
    "mm and degrees": (1e-3, np.pi / 180),
}


def check_plausible(
    robot: Robot,
    reference: Reference,
    measured: Array,
    ok: NDArray[np.bool_],
    logged: Array | None,
    times: Array,
) -> None:
    """Refuse a record that does not begin at rest, or is in other units or frames than the robot.

    measured (N, 6): poses, NaN where lost. ok (N,): true for measured frames. logged (N, n): joint
    commands, or None. times (N,): times of the frames, s. Raises EstimationError with the time, the
    finding, and the units in which the record would fit, if there are any.
    """
    _check_reach(robot, reference.poses, times, "the reference")
    _check_rest(reference)
    _check_measured(reference, measured, ok, times)
    if logged is not None:
        _check_commands(robot, reference.poses, logged, times, "the reference")


def check_timed_units(
    robot: Robot, measured: Array, times: Array, followed: Array, logged: Array, acting: Array
) -> None:
    """Refuse a record in other units or frames than the robot. The record has no reference.

    measured (k, 6): measured poses at times (k,), s, without lost ones. followed (M, 6): measured
    poses at the times acting (M,), s, of the commands logged (M, n). Raises EstimationError as
    `check_plausible` does.
    """
    _check_reach(robot, measured, times, "the measured motion")
    _check_commands(robot, followed, logged, acting, "the measured motion")


def moment(times: Array, row: int | np.intp) -> str:
    """Return the name of a row of a record by its time, s, which counts from the first pose."""
    return f"t = {times[row]:.7g} s after the first pose"


def _check_reach(robot: Robot, poses: Array, times: Array, what: str) -> None:
    def reached(one: Array) -> bool:
        return bool((robot.reach_margin(one) > 0).all())

    if not reached(poses):
        # `~(...)` also finds margins of NaN.
        row = int(np.argmax(~(robot.reach_margin(poses) > 0).all(axis=1)))
        try:
            robot.check_reach(poses[row], f"{what} at {moment(times, row)},")
        except UnreachablePoseError as error:
            raise EstimationError(f"{error}{_hint(poses, row, reached)}") from None


def begins_at_rest(rates: Array) -> bool:
    """Return whether the rates (N, 6) of a reference begin near zero, by REST_RATE."""
    return bool((np.abs(rates[0]) <= REST_RATE * np.abs(rates).max(axis=0)).all())


def _check_rest(reference: Reference) -> None:
    first = np.abs(reference.rates[0])
    largest = np.abs(reference.rates).max(axis=0)
    worst = int(np.argmax(first - REST_RATE * largest))
    if first[worst] > REST_RATE * largest[worst]:
        unit = "m/s" if worst < 3 else "rad/s"
        raise EstimationError(
            f"the record does not begin at rest: the rate of {POSE[worst]} in its first frame is "
            f"{first[worst]:.3g} {unit}, {100 * first[worst] / largest[worst]:.0f} % of its "
            "largest; begin the record where the robot stood still, or build it with "
            "identify.build_timed_record, whose start is estimated"
        )


def _check_measured(
    reference: Reference, measured: Array, ok: NDArray[np.bool_], times: Array
) -> None:
    """Check that the measured poses begin at the reference, and stay near it."""
    travel = np.repeat(np.ptp(reference.poses, axis=0).reshape(2, 3).max(axis=1), 3)
    # Without travel of the reference there is no scale to compare with.
    usual = np.where(travel > 0, travel, np.inf)
    # Only in the first frame, at rest, must the robot be at the reference.
    limits = np.full(len(ok), TRAVELS)
    limits[0] = REST_POSE

    def distances(poses: Array) -> Array:
        return np.asarray(np.where(ok[:, None], np.abs(poses - reference.poses), 0.0) / usual)

    def near(poses: Array) -> bool:
        return bool((distances(poses) <= limits[:, None]).all())

    if not near(measured):
        found = distances(measured)
        frame = int(np.argmax(found.max(axis=1) > limits))
        worst = int(np.argmax(found[frame]))
        rest = "the record does not begin at rest, or " if frame == 0 else ""
        raise EstimationError(
            f"at {moment(times, frame)} the measured {POSE[worst]} is "
            f"{measured[frame, worst]:.6g} and the reference "
            f"{reference.poses[frame, worst]:.6g}, {100 * found[frame, worst]:.0f} % of "
            f"its travel apart: {rest}the two poses are in different coordinate frames or units"
            f"{_hint(measured, frame, near)}"
        )


def _check_commands(robot: Robot, poses: Array, logged: Array, times: Array, what: str) -> None:
    wanted = robot.inverse_kinematics(poses)
    travel = float(np.ptp(wanted, axis=0).max())
    allowed = max(TRAVELS * travel, BUILT * robot.geometry.travel_limit)

    def follows(commands: Array) -> bool:
        return bool(np.abs(commands - wanted).max() <= allowed)

    if not follows(logged):
        frame, joint = np.unravel_index(int(np.argmax(np.abs(logged - wanted))), logged.shape)
        prismatic = robot.layout.prismatic
        unit = "m" if prismatic else "rad"
        other = "mm" if prismatic else "degrees"
        factor = 1e-3 if prismatic else np.pi / 180
        hint = ""
        if follows(factor * logged):
            hint = f"; in {other} it would fit, and records are in {unit}"
        raise EstimationError(
            f"the command of joint {joint + 1} at {moment(times, frame)} is "
            f"{logged[frame, joint]:.6g}, and {what} needs {wanted[frame, joint]:.6g} {unit}, "
            f"more than {allowed:.3g} {unit} away: zero, direction or unit of the joints differ "
            f"from the robot file{hint}"
        )


def _hint(poses: Array, row: int, fits: Callable[[Array], bool]) -> str:
    """Return a hint about a row of poses (N, 6): a lost frame, or the units in which all fit."""
    if not poses[row].any():
        return "; zeros are likely a lost frame, which needs measured_ok = 0"
    for units, (position, angle) in OTHER_UNITS.items():
        if fits(poses * np.repeat([position, angle], 3)):
            return f"; in {units} it would fit, and records are in m and rad"
    return ""


# Longest time, s, of consecutive lost frames without a warning. The model runs through these frames
# without measurements.
LONG_GAP_S = 0.5


def long_gap_warnings(ok: NDArray[np.bool_], rate_hz: float) -> tuple[str, ...]:
    """Return a warning if the longest gap in `ok` (N,) exceeds LONG_GAP_S, and so weakens a fit."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ~ok, [0]])))
    if not len(edges):
        return ()
    gaps = edges[1::2] - edges[::2]
    longest = int(gaps.argmax())
    if gaps[longest] <= LONG_GAP_S * rate_hz:
        return ()
    return (
        f"{gaps[longest]} frames in a row were lost from t = "
        f"{edges[2 * longest] / rate_hz:.2f} s on: the model runs through "
        f"{gaps[longest] / rate_hz:.2f} s without measurements",
    )
