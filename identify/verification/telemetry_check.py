"""Check of the telemetry of a run before anything is identified from it.

The findings concern the times, gaps and noise of the poses, the size and the frequencies of the
motion, the commands, the units and frames, the clocks, and the parameters that the motion can show.
The last finding needs the guessed model, which runs under the logged commands.
"""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from dynamics.errors import DynamicsError
from identify.arrays import Array
from identify.estimation.base_parameters import structure
from identify.files.dataset import POSE
from identify.progress import Progress, SilentProgress
from identify.record.checks import LONG_GAP_S, MINIMUM_GOOD_SHARE
from identify.record.delays import ServoDelay
from identify.record.frame_times import mean_rate
from identify.record.from_telemetry import MOST_GROSS
from identify.record.lost_pose_marks import REPEATED_REMEDY
from identify.record.suspicions import joint_motion
from identify.scenario import Timing
from identify.verification.finding import Finding
from identify.verification.logged_run import LoggedRun

RATE = 0.01  # largest relative difference of a frame rate from the stated one
NOISE = 2.0  # largest factor between the noise of the poses and the stated noise, either way
FROZEN = 0.01  # largest fraction of poses that equal the previous pose in all digits
FRAMES_A_PERIOD = 6.0  # smallest number of frames in a period of the highest frequency of a motion
# Largest fraction of commands that stay at an end of their range while commands change.
SATURATED = 0.01
STUCK = 3  # smallest number of equal commands in a row that count as staying
FOLLOWS = 0.8  # smallest mean correlation of the joints with their commands
BEFORE_S = 0.1  # largest time, s, by which the motion can seem to precede its commands
CLOCK = 0.05  # largest offset of the clocks, in frames, in addition to that of STDS
STDS = 3.0  # largest offset and drift of the clocks in stated standard deviations
SHOWN_GROUPS = 0.5  # smallest fraction of the groups of parameters that the motion must show
# Decimals of times, s, in rounded logs, by the name of their step, the coarsest first.
ROUNDED = {"milliseconds": 3, "0.1 ms": 4, "0.01 ms": 5, "microseconds": 6}
LISTED = 5  # largest number of names or times in a finding


def check_telemetry(logged: LoggedRun, progress: Progress | None = None) -> list[Finding]:
    """Return all findings about the telemetry of a run."""
    questions: list[Callable[[LoggedRun], Iterator[Finding]]] = [
        _rates,
        _gaps,
        _noise,
        _frozen,
        _motion,
        _saturation,
        _plausible,
        _clocks,
        _parameters,
    ]
    found = []
    with (progress or SilentProgress()).stage("check", len(questions)) as advance:
        for question in questions:
            found += list(question(logged))
            advance()
    return found


def _rates(logged: LoggedRun) -> Iterator[Finding]:
    wanted = logged.side.timing.frame_rate_hz
    time = logged.telemetry.poses.time
    steps = np.diff(time)
    rate = mean_rate(time)
    yield Finding(
        "pose rate",
        abs(rate / wanted - 1) <= RATE,
        rate,
        f"{len(time)} rows of poses in {np.ptp(time):.4g} s, {rate:.6g} a second without gaps; "
        f"timing.frame_rate_hz is {wanted:g}",
        limit=wanted,
        unit="Hz",
        relation="about",
    )
    # Lost rows do not count as jitter.
    even = np.round(steps * rate)
    off = np.abs(steps - even / rate)
    text = (
        f"times between rows differ from whole frames by {1e3 * float(off.max()):.3g} ms at "
        f"most, {1e3 * _rms(off):.3g} ms RMS"
    )
    for name, digits in ROUNDED.items():
        if np.allclose(time, np.round(time, digits), rtol=0, atol=1e-9):
            text += f"; times are rounded to {name}"
            break
    yield Finding("pose jitter", True, float(off.max()), text, unit="s")
    commands = logged.telemetry.commands.time
    yield Finding(
        "command rate",
        True,
        mean_rate(commands),
        f"{len(commands)} rows of commands in {np.ptp(commands):.4g} s",
        unit="Hz",
    )


def _gaps(logged: LoggedRun) -> Iterator[Finding]:
    poses = logged.telemetry.poses
    due = round(np.ptp(poses.time) * mean_rate(poses.time)) + 1
    lost = max(due - int(poses.ok.sum()), 0)
    yield Finding(
        "lost poses",
        lost <= (1 - MINIMUM_GOOD_SHARE) * due,
        lost / due,
        f"{lost} of {due} poses are empty or missing, in {len(logged.gaps)} gaps",
        limit=1 - MINIMUM_GOOD_SHARE,
    )
    if not len(logged.gaps):
        return
    widths = np.diff(logged.gaps, axis=1)[:, 0]
    longest = int(np.argmax(widths))
    begin, end = logged.gaps[longest]
    changed = sum(logged.commands_change(*gap) for gap in logged.gaps)
    missing = sum(logged.commands_are_missing(*gap) for gap in logged.gaps)
    yield Finding(
        "longest gap",
        bool(widths[longest] <= LONG_GAP_S),
        float(widths[longest]),
        f"no pose from {begin:.4f} to {end:.4f} s; commands changed in {changed} of "
        f"{len(widths)} gaps"
        + (", in which the servo had poses that the log lacks" if changed else "")
        + (f"; rows of commands are missing in {missing}" if missing else ""),
        limit=LONG_GAP_S,
        unit="s",
    )


def _noise(logged: LoggedRun) -> Iterator[Finding]:
    for kind, unit, scale, word in (
        (slice(0, 3), "m", 1e6, "um"),
        (slice(3, 6), "rad", 1e6, "urad"),
    ):
        name = "position noise" if unit == "m" else "orientation noise"
        own = logged.noise[kind]
        value = _rms(own)
        listed = ", ".join(
            f"{axis} {scale * one:.3g}" for axis, one in zip(POSE[kind], own, strict=True)
        )
        text = f"standard deviations of the poses from their neighbours: {listed} {word}"
        if not np.isfinite(value):
            text = "no poses are near enough in time to tell their noise"
            yield Finding(name, False, None, text, unit=unit)
            continue
        stated = (
            None if logged.stated is None else float(np.sqrt(np.mean(logged.stated[kind] ** 2)))
        )
        ok = stated is None or 1 / NOISE <= value / stated <= NOISE
        if stated is not None:
            text += f"; {value / stated:.2g} times the stated {scale * stated:.3g} {word}"
        yield Finding(name, ok, value, text, limit=stated, unit=unit, relation="about")
    jumps = logged.jumps
    listed = ", ".join(f"{one:.4f}" for one in jumps[:LISTED])
    more = f" and {len(jumps) - LISTED} more" if len(jumps) > LISTED else ""
    yield Finding(
        "jumps",
        len(jumps) <= MOST_GROSS * len(logged.time),
        len(jumps) / len(logged.time),
        f"{len(jumps)} poses are far from the motion of their neighbours"
        + (f", at {listed} s{more}" if len(jumps) else ""),
        limit=MOST_GROSS,
    )


def _frozen(logged: LoggedRun) -> Iterator[Finding]:
    same = (np.diff(logged.poses, axis=0) == 0).all(axis=1)
    first = f", the first at {logged.time[1:][same][0]:.4f} s" if same.any() else ""
    remedy = f": {REPEATED_REMEDY}" if same.mean() > FROZEN else ""
    yield Finding(
        "frozen poses",
        bool(same.mean() <= FROZEN),
        float(same.mean()),
        f"{same.sum()} poses equal the previous pose in all digits{first}{remedy}",
        limit=FROZEN,
    )


def _motion(logged: LoggedRun) -> Iterator[Finding]:
    robot = logged.side.robot
    _, joints = joint_motion(logged.telemetry, robot)
    unit = robot.layout.joint_unit
    if len(joints):
        largest = np.abs(joints).max(axis=0)
        joint = int(np.argmax(largest))
        yield Finding(
            "travel",
            bool(largest[joint] <= robot.travel_limit),
            float(largest[joint]),
            f"joint coordinates of the poses reach {largest[joint]:.4g} {unit} of "
            f"{robot.travel_limit:.4g}; the poses move by "
            + ", ".join(
                f"{name} {value:.3g}"
                for name, value in zip(POSE, np.ptp(logged.poses, axis=0), strict=True)
            )
            + " m and rad",
            limit=robot.travel_limit,
            unit=unit,
            leg=joint + 1,
        )
    highest = logged.spectrum.highest_hz
    rate = mean_rate(logged.time)
    yield Finding(
        "spectrum",
        highest * FRAMES_A_PERIOD <= rate,
        highest,
        f"99 % of the power of the motion lies below {highest:.3g} Hz, "
        f"{rate / max(highest, 1e-9):.3g} frames a period",
        limit=rate / FRAMES_A_PERIOD,
        unit="Hz",
    )


def _saturation(logged: LoggedRun) -> Iterator[Finding]:
    commands = logged.telemetry.commands.command
    shares = [float(_at_ends(one).mean()) for one in commands.T]
    joint = int(np.argmax(shares))
    most = np.abs(commands).max(axis=0)
    yield Finding(
        "saturation",
        shares[joint] <= SATURATED,
        shares[joint],
        f"the largest command is {most.max():.4g} {logged.side.robot.layout.joint_unit}, of joint "
        f"{int(np.argmax(most)) + 1}; "
        + (
            f"commands of joint {joint + 1} stay at the end of their range in {shares[joint]:.1%} "
            "of the rows from the first to the last change"
            if shares[joint] > 0
            else "no command stays at the end of its range"
        ),
        limit=SATURATED,
        leg=joint + 1 if shares[joint] > 0 else None,
    )


def _plausible(logged: LoggedRun) -> Iterator[Finding]:
    if not logged.suspicions:
        text = "nothing contradicts the units, axes, directions and zeros of the robot file"
        if logged.equal_orders:
            text += (
                "; the motion is too small to tell the stated order of the Euler angles from "
                f"{', '.join(logged.equal_orders)}"
            )
        yield Finding("units and frames", True, 0, text, limit=0)
    for one in logged.suspicions:
        count = len(logged.suspicions)
        yield Finding("units and frames", False, count, one, limit=0)


def _clocks(logged: LoggedRun) -> Iterator[Finding]:
    lag = logged.lag
    yield Finding(
        "motion behind commands",
        lag.correlation >= FOLLOWS and lag.seconds >= -BEFORE_S,
        lag.seconds,
        f"the motion follows the commands by {1e3 * lag.seconds:.1f} ms, with a correlation of "
        f"{lag.correlation:.3f}, due to drives, friction, latency and the clocks; a lag below "
        f"{-BEFORE_S:g} s (a motion before its commands) or a correlation below {FOLLOWS:g} fails",
        limit=-BEFORE_S,
        unit="s",
        relation=">=",
    )
    delay = logged.delay
    timing = logged.side.timing
    if delay is None:
        text = (
            "the commands show no noise of the poses: no servo was on these poses, or the clocks "
            "differ by more than half a second"
        )
        yield Finding("clock offset", True, None, text, unit="s")
        return
    step = CLOCK * timing.frame_period_s + delay.resolution * logged.repeats_commands
    allowed = step + STDS * (timing.clock_offset_std_s + timing.latency_std_s)
    if logged.telemetry.commands.written is None and abs(delay.seconds) <= allowed:
        yield _without_times(delay, timing)
        return
    yield _offset(delay, timing, logged.telemetry.commands.written is not None, allowed)
    duration = float(np.ptp(logged.time))
    grown = delay.drift * duration
    yield Finding(
        "clock drift",
        abs(grown) <= step + STDS * timing.clock_drift_std * duration,
        delay.drift,
        f"this delay grows by {1e6 * delay.drift:.1f} us in a second, {1e3 * grown:.3f} ms over "
        "the run",
        limit=step / duration + STDS * timing.clock_drift_std,
    )


def _without_times(delay: ServoDelay, timing: Timing) -> Finding:
    """Return the finding about the latency of commands that have the times of their poses."""
    return Finding(
        "clock offset",
        True,
        None,
        f"the noise of a pose appears in the command of its row (correlation "
        f"{delay.correlation:.2f}), so that a servo used these poses; without times of the "
        f"commands, timing.latency_s = {timing.latency_s:g} cannot be checked here, and "
        "timing.latency_std_s has it estimated",
        unit="s",
    )


def _offset(delay: ServoDelay, timing: Timing, timed: bool, allowed: float) -> Finding:
    """Return the finding about the delay of the servo. timed: whether commands have own times."""
    # Without a time of their own, commands have the times of their poses.
    expected = timing.latency_s if timed else 0.0
    offset = delay.seconds - expected
    remedy = "; set timing.clock_offset_std_s to have the offset estimated"
    if timed and delay.seconds >= 0:
        remedy += (
            f", or, if the clocks agree, timing.latency_s = {delay.seconds:.6f}, which does not "
            "move commands that have times of their own"
        )
    said = "timing.latency_s" if timed else "the time of its row"
    return Finding(
        "clock offset",
        abs(offset) <= allowed,
        offset,
        f"the noise of a pose appears in the command {1e3 * delay.seconds:.3f} ms later "
        f"(correlation {delay.correlation:.2f}, spread {1e3 * delay.spread:.3f} ms); stated are "
        f"{1e3 * expected:.3f} ms by {said}: the clock of the commands is {1e3 * abs(offset):.3f} "
        f"ms {'ahead' if offset >= 0 else 'behind'}, or the stated delay is wrong"
        + (remedy if abs(offset) > allowed else ""),
        limit=allowed,
        unit="s",
    )


def _parameters(logged: LoggedRun) -> Iterator[Finding]:
    run = logged.model_run
    robot = logged.side.robot
    base = structure(robot)
    names = base.group_names()
    limit = SHOWN_GROUPS * len(names)
    if isinstance(run, DynamicsError):
        text = f"the guessed model does not run under the commands: {run}"
        yield Finding("parameters", False, None, text, limit=limit, relation=">=")
        return
    shown = logged.can_show(run)
    weak = [name for name, seen in zip(names, shown, strict=True) if not seen]
    more = f" and {len(weak) - LISTED} more" if len(weak) > LISTED else ""
    yield Finding(
        "parameters",
        bool(shown.sum() >= limit),
        int(shown.sum()),
        f"the motion can show {shown.sum()} of {len(names)} groups of parameters, by the guessed "
        "model" + (f"; not {', '.join(weak[:LISTED])}{more}" if weak else ""),
        limit=limit,
        relation=">=",
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _at_ends(values: Array) -> NDArray[np.bool_]:
    """Return for the rows between first and last change whether a command stays at an end.

    It does so if at least STUCK successive rows have its largest value, or its smallest value.
    """
    changes = np.flatnonzero(np.diff(values))
    if not len(changes):
        return np.zeros(1, dtype=bool)
    moving = values[changes[0] + 1 : changes[-1] + 1]
    if not len(moving):
        return np.zeros(1, dtype=bool)
    at_end = (moving == values.max()) | (moving == values.min())
    # Index of the run of equal commands to which each row belongs.
    starts = np.concatenate([[True], np.diff(moving) != 0])
    run = np.cumsum(starts) - 1
    return np.asarray(at_end & (np.bincount(run)[run] >= STUCK))
