"""Design of gains: bandwidth and damping of a loop near rest, and gains for desired values.

The bandwidth, rad/s, is the lowest frequency of an oscillating desired pose at which the error
reaches 1/sqrt(2) of the oscillation, for one of the eigenvectors of the response. The damping is
the smallest damping ratio of the eigenvalues of the map from frame to frame. Both are computed for
the linear loop (`closed_loop.stability`), without dry friction.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq, minimize

from dynamics.closed_loop import stability
from dynamics.closed_loop.loop_settings import LoopSettings, ServoGains
from dynamics.control.computed_torque import INTEGRAL_FACTOR, error_map
from dynamics.control.inverse_dynamics import Model
from dynamics.control.law_interface import Feedback
from dynamics.errors import SimulationError
from dynamics.robot import Robot

# Ratio of the error to the desired motion at the bandwidth.
HALF_POWER = 2**-0.5
DECAYED = 1e-3  # magnitude of eigenvalues below which a motion has decayed within a frame
SLOWEST = 1e-2  # bandwidth, rad/s, at which the search for a lower, stable bandwidth ends
# Largest accepted relative deviation of the error of a designed servo from HALF_POWER, and largest
# accepted shortfall of its damping.
DESIGN_TOLERANCE = 0.02


@dataclass(frozen=True)
class LoopFigures:
    """Characteristic values of a loop near rest.

    `bandwidth` is in rad/s, or NaN if the servo is unstable. `damping` has no unit. `radius` is the
    largest magnitude of an eigenvalue. `gain_margin` is the factor of the gains at the limit of
    stability, from 0.01 to 100, or NaN (see `stability.last_stable`).
    """

    bandwidth: float
    damping: float
    radius: float
    gain_margin: float


def servo_figures(model: Model, settings: LoopSettings, pose: np.ndarray) -> LoopFigures:
    """Characteristic values of the visual servo near rest at a pose (6,).

    They apply to the laws pid and feedforward. Raises the same errors as `closed_loop.equilibrium`.
    """
    arguments = model.robot, model.parameters, settings, pose
    frame_map = stability.frame_map(*arguments)
    radius = stability.spectral_radius(*arguments)
    rate = settings.timing.frame_rate_hz
    bandwidth = (
        float("nan") if radius >= 1 else _bandwidth(stability.pose_response(*arguments), rate)
    )
    return LoopFigures(bandwidth, _damping(frame_map), radius, stability.gain_margin(*arguments))


def design_servo(
    model: Model, settings: LoopSettings, pose: np.ndarray, bandwidth: float, damping: float
) -> ServoGains:
    """Gains of the visual servo for a bandwidth, rad/s, and a minimum damping, at a pose (6,).

    Raises SimulationError, with the nearest values found, if there are no such gains.
    """

    def servo(logs: np.ndarray) -> ServoGains:
        kp, kd, ki = np.exp(logs)
        return ServoGains(float(kp), float(kd), float(ki))

    def figures(logs: np.ndarray) -> tuple[float, float]:
        arguments = model.robot, model.parameters, replace(settings, servo=servo(logs)), pose
        return _error_ratio(stability.pose_response(*arguments)(bandwidth)), _damping(
            stability.frame_map(*arguments)
        )

    def cost(logs: np.ndarray) -> float:
        error, reached_damping = figures(logs)
        # many gains meet both requirements, and the third term selects those nearest to 1
        return (
            100 * (error / HALF_POWER - 1) ** 2
            + 100 * max(damping - reached_damping, 0.0)
            + 1e-4 * float(logs @ logs)
        )

    period = 1 / settings.timing.frame_rate_hz
    # This servo is stable on most robots. The logarithms are varied, because gains are positive.
    start = np.log([0.3, 0.06 * period, bandwidth])
    best = minimize(
        cost, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-8, "maxfev": 600}
    )
    error, reached = figures(best.x)
    if abs(error / HALF_POWER - 1) > DESIGN_TOLERANCE or reached < damping - DESIGN_TOLERANCE:
        raise SimulationError(
            f"no gains of the servo give {model.robot.name} a bandwidth of {bandwidth:g} rad/s "
            f"with a damping of {damping:g} at {settings.timing.frame_rate_hz:g} Hz: the best gains"
            f" have a damping of {reached:.3g} and an error of {error:.3g} of the motion, must be "
            f"{HALF_POWER:.3g}"
        )
    return servo(best.x)


# Lowest natural frequencies, rad/s, of designed drives, in the order in which they are tried. The
# first is that of the built-in robots.
DRIVE_FREQUENCIES = 17.0 * 1.15 ** np.array([0, 1, -1, 2, -2, 3, 4, 5, -3])
# Damping ratios at the lowest natural frequency of designed drives, in the order of trial.
DRIVE_DAMPINGS = (0.35, 0.5, 0.7)
INTEGRAL_RATE = 1.1  # ratio li / lp of designed drives, 1/s, as in the paper
WANTED_MARGIN = 1.5  # smallest gain margin of the servos at which the search for drives ends


@dataclass(frozen=True)
class DesignedDrives:
    """Designed gains of the drives, and characteristic values of the joints with these gains.

    `gains` (3,) are lp, li and ld. `inertias` are the smallest and the largest eigenvalue of the
    inertia matrix at the joints, kg m^2 or kg. `frequencies` are the highest and the lowest natural
    frequency with lp, rad/s, and `damping` is the damping ratio at the lowest. `margin` is the
    smallest `gain_margin` of the servos.
    """

    gains: np.ndarray
    inertias: tuple[float, float]
    frequencies: tuple[float, float]
    damping: float
    margin: float


def design_drives(
    robot: Robot, dynamic: Sequence[np.ndarray], loops: Sequence[LoopSettings]
) -> DesignedDrives:
    """Gains of the joint PID that all joints share, for which the servo of each loop is stable.

    The first gains give the largest inertia at home the natural frequency and the damping of the
    built-in robots. Others are tried if the gain margin of a servo is below `WANTED_MARGIN`. If all
    are below, the result is the gains with the largest margin. `dynamic` are sets of dynamic
    parameters (p,). The inertia is that of the first set, and margins are computed for all. Raises
    SimulationError, with the largest margin, if no gains are stable.
    """
    pose = robot.home_pose
    zero = np.zeros(len(robot.layout.joint_pid_names))
    push = stability.torque_motion(robot, np.concatenate([dynamic[0], zero]), pose)[1]
    inertias = 1 / np.linalg.eigvalsh(robot.coordinate_jacobian(pose) @ push)[::-1]
    best = None
    for damping in DRIVE_DAMPINGS:
        for frequency in DRIVE_FREQUENCIES:
            lp = inertias[-1] * frequency**2
            exact = lp, INTEGRAL_RATE * lp, 2 * damping * frequency * inertias[-1]
            gains = np.array([float(f"{gain:.3g}") for gain in exact])
            each = np.tile(gains, len(robot.layout.joint_pid_names) // len(gains))
            margins = [
                stability.gain_margin(robot, np.concatenate([values, each]), loop, pose)
                for values in dynamic
                for loop in loops
            ]
            drives = DesignedDrives(
                gains,
                (float(inertias[0]), float(inertias[-1])),
                (float(np.sqrt(lp / inertias[0])), float(frequency)),
                damping,
                min(margins),
            )
            if drives.margin >= WANTED_MARGIN:
                return drives
            # this condition is also true for a best margin that is NaN
            if best is None or not best.margin >= drives.margin:
                best = drives
    if best is None or not best.margin > 1:
        needed = (
            f"with the best, the gains of the servo must be {best.margin:.3g} times as large"
            if best is not None and best.margin > 0
            else "the loop is unstable with any gains of the servo"
        )
        raise SimulationError(
            f"no gains of the drives of {robot.name} make the servo stable at "
            f"{', '.join(f'{loop.timing.frame_rate_hz:g} Hz' for loop in loops)}: {needed}"
        )
    return best


def torque_figures(
    model: Model, settings: LoopSettings, pose: np.ndarray, feedback: Feedback
) -> LoopFigures:
    """Characteristic values of the law computed_torque near rest at a pose (6,).

    An observer compensates the latency by prediction, and the values are then those of the loop
    without latency. The bandwidth is not computed: it is the desired one.
    """
    period, delay = _times(settings, feedback)

    def map_of(factor: float) -> np.ndarray:
        return _torque_map(model, pose, feedback, factor, period, delay)

    margin = stability.last_stable(lambda factor: _radius(map_of(factor)), 1.0, 1e2, 1e-2)
    return LoopFigures(feedback.bandwidth, _damping(map_of(1.0)), _radius(map_of(1.0)), margin)


def torque_radius(
    model: Model, settings: LoopSettings, pose: np.ndarray, feedback: Feedback
) -> float:
    """Largest magnitude of an eigenvalue of the law computed_torque. See `torque_figures`."""
    return _radius(_torque_map(model, pose, feedback, 1.0, *_times(settings, feedback)))


def largest_bandwidth(
    model: Model, settings: LoopSettings, pose: np.ndarray, feedback: Feedback
) -> float:
    """Largest bandwidth, rad/s, at which the law computed_torque is stable near rest.

    The search begins at the bandwidth of the feedback. If this is stable, the search goes up to
    half the frame rate, because one command per frame cannot follow faster motions. Otherwise, it
    goes down to SLOWEST, and the result is NaN if no bandwidth is stable.
    """

    def radius(bandwidth: float) -> float:
        return torque_radius(model, settings, pose, replace(feedback, bandwidth=bandwidth))

    nyquist = np.pi * settings.timing.frame_rate_hz
    return stability.last_stable(radius, min(feedback.bandwidth, nyquist), nyquist, SLOWEST)


def check_torque_gains(
    model: Model, settings: LoopSettings, pose: np.ndarray, feedback: Feedback
) -> None:
    """Raise SimulationError if the law computed_torque is too fast. The error states the limit.

    The law is too fast if it is unstable near rest, or if its bandwidth exceeds half the frame
    rate. With a larger bandwidth, a torque that acts for a whole frame stops the platform, but
    hardly moves it back.
    """
    rate = settings.timing.frame_rate_hz
    radius = torque_radius(model, settings, pose, feedback)
    law_text = (
        f"computed_torque with a bandwidth of {feedback.bandwidth:.3g} rad/s and a damping of "
        f"{feedback.damping:.3g}"
    )
    if radius >= 1:
        limit = largest_bandwidth(model, settings, pose, feedback)
        stable_range = f"stable up to {limit:.3g} rad/s" if limit > 0 else "stable at no bandwidth"
        raise SimulationError(
            f"{law_text} is unstable with this model at {rate:g} Hz: its largest eigenvalue from "
            f"frame to frame is {radius:.4g}, must be below 1; the law is {stable_range}"
        )
    if feedback.bandwidth > np.pi * rate:
        desired = np.exp(np.linalg.eigvals(error_map(feedback)).real.max() / rate)
        raise SimulationError(
            f"{law_text} is too fast for {rate:g} Hz: the bandwidth must be at most half the frame "
            f"rate, {np.pi * rate:.3g} rad/s; the largest eigenvalue from frame to frame is "
            f"{radius:.4g} instead of {desired:.3g}"
        )


def _times(settings: LoopSettings, feedback: Feedback) -> tuple[float, float]:
    """Time between two frames, s, and the latency that is not compensated by an observer, s."""
    return (
        1 / settings.timing.frame_rate_hz,
        0.0 if feedback.observer else settings.timing.latency_s,
    )


def _radius(map_: np.ndarray) -> float:
    """Largest magnitude of the eigenvalues of a map."""
    return float(np.abs(np.linalg.eigvals(map_)).max())


def _torque_map(
    model: Model, pose: np.ndarray, feedback: Feedback, factor: float, period: float, delay: float
) -> np.ndarray:
    """Map of the law computed_torque from frame to frame.

    The state has coordinates and rates. Without an observer, it also has the previously measured
    coordinates, the integral of the error (desired minus measured), and the torques that have not
    yet arrived, the newest first. `factor` scales the gains of the law.
    """
    motion, push = stability.torque_motion(model.robot, model.parameters, pose)
    size = len(motion) // 2
    joints = push.shape[1]
    w = feedback.bandwidth
    identity = np.eye(size)
    map_ = error_map(feedback)
    by_position = motion[size:, :size]
    by_velocity = motion[size:, size:]
    to_torque = np.linalg.pinv(push)
    # the mean acceleration along the recovery motion over a frame
    mean = np.linalg.solve(map_, expm(map_ * period) - np.eye(2)) / period
    by_coordinates, by_rate = (
        to_torque
        @ (factor * (map_[1] @ along) * identity - along[0] * by_position - along[1] * by_velocity)
        for along in mean.T
    )
    # Constant torques are part of the state, so that one exponential has their exact effect.
    inner = np.zeros((2 * size + joints, 2 * size + joints))
    inner[: 2 * size, : 2 * size] = motion
    inner[size : 2 * size, 2 * size :] = push

    def after(time: float) -> tuple[np.ndarray, np.ndarray]:
        """Effects of the state and of constant torques on the state after a time, s."""
        moved = expm(inner * time)[: 2 * size]
        return moved[:, : 2 * size], moved[:, 2 * size :]

    if feedback.observer:
        moved, pushed = after(period)
        return moved + pushed @ np.hstack([by_coordinates, by_rate])
    late_frames = int(np.floor(delay / period + 1e-9))
    late_s = max(0.0, delay - late_frames * period)
    states = 4 * size + (late_frames + 1) * joints
    start = np.eye(states)
    coordinates = start[:size]
    coordinates_before = start[2 * size : 3 * size]
    integral_before = start[3 * size : 4 * size]
    integral = integral_before - period * coordinates
    torque = (
        by_coordinates @ coordinates
        + by_rate @ (coordinates - coordinates_before) / period
        + factor * INTEGRAL_FACTOR * w**3 * to_torque @ integral
    )
    torques = [torque, *np.split(start[4 * size :], late_frames + 1)]
    state = start[: 2 * size]
    for age, time in ((late_frames + 1, late_s), (late_frames, period - late_s)):
        moved, pushed = after(time)
        state = moved @ state + pushed @ torques[age]
    return np.vstack([state, coordinates, integral, *torques[: late_frames + 1]])


def _bandwidth(response: Callable[[float], np.ndarray], rate_hz: float) -> float:
    """Lowest frequency, rad/s, at which the error passes `HALF_POWER`.

    The search begins at 0.01 rad/s and ends at the Nyquist frequency, which is the result if the
    error stays below.
    """
    # the error may not be monotonic: a grid finds the first crossing, which Brent's method refines
    frequencies = np.geomspace(1e-2, np.pi * rate_hz, 60)
    beyond = [_error_ratio(response(w)) > HALF_POWER for w in frequencies]
    first = int(np.argmax(beyond))
    if not any(beyond) or first == 0:
        return float(frequencies[0 if any(beyond) else -1])
    return float(
        brentq(
            lambda w: _error_ratio(response(w)) - HALF_POWER,
            frequencies[first - 1],
            frequencies[first],
            rtol=1e-6,
        )
    )


def _error_ratio(response: np.ndarray) -> float:
    """Largest ratio of error to desired motion among the eigenvectors of a response (m, m)."""
    return float(np.abs(np.linalg.eigvals(np.eye(len(response)) - response)).max())


def _damping(map_: np.ndarray) -> float:
    """Smallest damping ratio of the eigenvalues of a map."""
    values = np.linalg.eigvals(map_).astype(complex)
    # poles in units of the frame rate, without those of states that decay at once
    poles = np.log(values[np.abs(values) > DECAYED])
    # a pole at zero has no damping
    return float(np.min(-poles.real / np.maximum(np.abs(poles), np.finfo(float).tiny)))
