"""Stability of the sampled loop near rest, from the linear map of its state from frame to frame.

Small deviations of the robot under its joint PID (eq. 31) obey a linear differential equation. As
long as one command acts, the matrix exponential solves this equation exactly. The servo (eq. 30),
with the latency of its commands, closes the loop once per frame. The loop is stable if all
eigenvalues of the map are inside the unit circle. Limits of the drives, and dry friction and
elasticity of the joints, are neglected. Near rest, dry friction only makes the loop more stable.

The servo's error e is the desired minus the measured pose. The map uses the negative of e, the
deviation of the measured from the desired coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import floor
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from dynamics.closed_loop.drives import Drives, JointLaw
from dynamics.closed_loop.loop_settings import FrameTiming, LoopSettings, ServoGains
from dynamics.closed_loop.start_state import check_start_pose, checked_loop_parameters
from dynamics.robot import Robot

SLOWEST_HZ = 0.5  # lowest frame rate, Hz, in the search for the limit of stability
MOST_GAIN = 100.0  # largest factor of the gains in the search; the smallest is 1 / MOST_GAIN
MOST_LATE = 50  # largest number of frames in the latency, up to which higher rates are tried
SEARCH_RATIO = 1.1  # ratio of consecutive values in a search, before bisection finds the limit


def frame_map(
    robot: Robot, parameters: np.ndarray, settings: LoopSettings, pose: np.ndarray
) -> np.ndarray:
    """Map (s, s) of small deviations from rest at a pose (6,), from frame to frame.

    The state consists of the coordinates, their rates, the joint integrals, the filtered rates if
    the drives have them, the coordinates measured at the previous frame, the servo integrals, and
    the past commands that can still act, the newest first. The integrals have the signs of
    `drive_kernels` and `visual_servo_kernels`. Raises the same errors as `closed_loop.equilibrium`.
    """
    return _state_map(_near_rest(robot, parameters, pose, settings.drives), settings)


def fastest_rate(robot: Robot, parameters: np.ndarray, drives: Drives, pose: np.ndarray) -> float:
    """Largest magnitude, 1/s, of the eigenvalues of the robot under its drives at a pose (6,).

    The commands are constant. Raises the same errors as `closed_loop.equilibrium`.
    """
    near = _near_rest(robot, parameters, pose, drives)
    return float(np.abs(np.linalg.eigvals(near.motion)).max())


def pose_response(
    robot: Robot, parameters: np.ndarray, settings: LoopSettings, pose: np.ndarray
) -> Callable[[float], np.ndarray]:
    """Frequency response from the desired to the true coordinates, near rest at a pose (6,).

    Returns a function of the angular frequency, rad/s. Its result is a complex matrix (m, m), for
    coordinates at frames. The desired rate is the difference of the desired coordinates of two
    consecutive frames, divided by the period. Raises the same errors as `closed_loop.equilibrium`.
    """
    near = _near_rest(robot, parameters, pose, settings.drives)
    size = near.jacobian.shape[1]
    state_map, by_desired = np.split(_with_desired(near, settings), [-size], axis=1)
    identity = np.eye(len(state_map))
    period = 1 / settings.timing.frame_rate_hz

    def response(frequency: float) -> np.ndarray:
        shift = np.exp(1j * frequency * period)
        return np.linalg.solve(shift * identity - state_map, by_desired)[:size]

    return response


def _state_map(robot: _NearRest, settings: LoopSettings) -> np.ndarray:
    """Map (s, s) of `frame_map`."""
    return _with_desired(robot, settings)[:, : -robot.jacobian.shape[1]]


def _with_desired(robot: _NearRest, settings: LoopSettings) -> np.ndarray:
    """Matrix (s, s + m): the map of `frame_map`, then the effect of the desired coordinates.

    In this function, a quantity such as `state` or `commands` is the matrix that maps the state and
    the desired coordinates at the beginning of the frame to this quantity.
    """
    joints, size = robot.jacobian.shape
    timing = settings.timing
    period = 1 / timing.frame_rate_hz
    servo = _servo(robot, settings)
    # the small number keeps rounding errors from shortening a latency by one frame
    late_frames = floor(timing.latency_s / period + 1e-9)
    late_s = max(0.0, timing.latency_s - late_frames * period)
    inner = len(robot.motion) - 3 * joints
    held_count = late_frames + 2
    states = inner + 2 * size + held_count * joints
    start = np.eye(states, states + size)
    desired = np.eye(size, states + size, states)
    deviation = start[:size] - desired
    integral = start[inner + size : inner + 2 * size]
    servo_inputs = np.vstack([deviation, start[inner : inner + size], integral])
    # without an integral, the servo demands nothing at rest, and turning the Jacobian has no effect
    turning = robot.turning if settings.servo.ki else 0 * robot.turning
    by_turning = turning @ start[:size]
    commands = [servo @ servo_inputs + by_turning, *np.split(start[inner + 2 * size :], held_count)]
    state = start[:inner]
    # within a frame, the older command acts for `late_s`, until the newer one arrives
    for age, begin, end in ((late_frames + 1, 0.0, late_s), (late_frames, late_s, period)):
        newer = commands[age]
        older = commands[age + 1] if age + 1 <= held_count else commands[age]
        ramp = (
            (begin + (period - late_s if age > late_frames else -late_s)) / period
            if timing.hold == "linear"
            else 1.0
        )
        slope = (newer - older) / period
        at_begin = older + ramp * (newer - older)
        acting_slope = slope if timing.hold == "linear" else 0 * slope
        scale = settings.drives.command_scale
        state = expm(robot.motion * (end - begin))[:inner] @ np.vstack(
            [state, scale * at_begin, scale * acting_slope, scale * slope]
        )
    return np.vstack([state, deviation, integral - period * deviation, *commands[:held_count]])


def spectral_radius(
    robot: Robot, parameters: np.ndarray, settings: LoopSettings, pose: np.ndarray
) -> float:
    """Largest magnitude of the eigenvalues of `frame_map`. The loop is stable if it is below 1."""
    return _radius(_near_rest(robot, parameters, pose, settings.drives), settings)


def gain_margin(
    robot: Robot, parameters: np.ndarray, settings: LoopSettings, pose: np.ndarray
) -> float:
    """Factor of the servo gains at the limit of stability.

    For a stable loop, it is above 1, and MOST_GAIN if no factor up to that is unstable. For an
    unstable loop, it is below 1, and NaN if no factor down to 1 / MOST_GAIN is stable.
    """
    near = _near_rest(robot, parameters, pose, settings.drives)

    def radius(factor: float) -> float:
        gains = settings.servo
        servo = ServoGains(factor * gains.kp, factor * gains.kd, factor * gains.ki)
        return _radius(near, replace(settings, servo=servo))

    return last_stable(radius, 1.0, MOST_GAIN, 1 / MOST_GAIN)


def lowest_frame_rate(
    robot: Robot, parameters: np.ndarray, settings: LoopSettings, pose: np.ndarray
) -> float:
    """Lowest frame rate, Hz, down to which the loop is stable. The latency in s is not changed.

    The search begins at the rate of the settings. If the loop is stable there, the result is lower,
    and SLOWEST_HZ if all rates down to that are stable. If it is unstable there, the result is the
    next higher rate at which the loop becomes stable, or NaN if none is found. It can be unstable
    again farther away, because the search ends at the first limit. It also ends at 100 times the
    rate of the settings, and where a higher rate makes the latency longer than MOST_LATE frames.
    """
    rate = settings.timing.frame_rate_hz
    near = _near_rest(robot, parameters, pose, settings.drives)

    def radius(hz: float) -> float:
        timing = FrameTiming(hz, settings.timing.latency_s, settings.timing.hold)
        return _radius(near, replace(settings, timing=timing))

    # the size of the map grows with the number of frames in the latency
    latency = settings.timing.latency_s
    fastest = min(100 * rate, MOST_LATE / latency if latency else np.inf)
    return last_stable(radius, rate, SLOWEST_HZ, max(fastest, rate))


def verdict(robot: Robot, parameters: np.ndarray, settings: LoopSettings, pose: np.ndarray) -> str:
    """Text on the stability of a run that ended early, with its largest eigenvalue."""
    arguments = robot, parameters, settings, pose
    radius = spectral_radius(*arguments)
    hz = settings.timing.frame_rate_hz
    eigenvalue_text = (
        f"its largest eigenvalue from frame to frame near the start is {radius:.4g}, must be "
        "below 1"
    )
    if radius < 1:
        return f"{eigenvalue_text}: the loop is stable near the start"
    rate = lowest_frame_rate(*arguments)
    elsewhere = (
        f"becomes stable at {rate:.3g} Hz" if rate > 0 else "no higher frame rate makes it stable"
    )
    return f"{eigenvalue_text}: the loop is unstable at {hz:g} Hz, and {elsewhere}"


class _NearRest(NamedTuple):
    """Robot near rest, without the gains and the timing of the servo.

    `motion` is the matrix of `_joint_loop`. `jacobian` (n, m) is the Jacobian of the joints with
    respect to the coordinates. `turning` (n, m) is the derivative, with respect to the coordinates,
    of the Jacobian times the servo's demand that holds the joints.
    """

    motion: np.ndarray
    jacobian: np.ndarray
    turning: np.ndarray


def _near_rest(robot: Robot, parameters: np.ndarray, pose: np.ndarray, drives: Drives) -> _NearRest:
    """Robot near rest at a pose (6,). Raises the same errors as `closed_loop.equilibrium`."""
    parameters = checked_loop_parameters(robot, parameters, drives.law)
    check_start_pose(robot, parameters, pose)
    jacobian = robot.coordinate_jacobian(pose)
    law = drives.joint_law(robot.layout.split(parameters)[3])
    holding = robot.static_torque(pose, parameters[robot.layout.dynamic])
    command = law.held(holding, robot.inverse_kinematics(pose))[0]
    demand = np.linalg.solve(jacobian, drives.sent(command))
    (turning,) = _values(robot, "rate_map_derivative", robot.coordinates(pose), demand)
    return _NearRest(_joint_loop(robot, parameters, pose, law), jacobian, turning)


def _radius(robot: _NearRest, settings: LoopSettings) -> float:
    """Spectral radius of the map from frame to frame."""
    return float(np.abs(np.linalg.eigvals(_state_map(robot, settings))).max())


def _joint_loop(
    robot: Robot, parameters: np.ndarray, pose: np.ndarray, law: JointLaw
) -> np.ndarray:
    """Matrix of the linear differential equation of the joints under their drives.

    The state consists of q, q_dot, joint integrals, filtered rates if there are any, the command,
    its slope, and U_dot in the law of the drive. The slope is the true rate of the command, which
    is zero under the zero hold, unlike U_dot. Slope and U_dot are constant. An integral that the
    law does not use is made to decay. Otherwise its eigenvalue would be at the limit of stability.
    """
    q = robot.coordinates(pose)
    joints = robot.layout.joints
    rigid, _, viscous, _ = robot.layout.split(parameters)
    lp = law.lp
    li = law.li
    ld = law.ld
    filtering = law.filter_time > 0
    zero_rate = np.zeros(len(q))
    size = len(q)
    holding = robot.static_torque(pose, parameters[robot.layout.dynamic])
    mass, _, jacobian, *_ = _values(robot, "equation_of_motion", q, zero_rate, rigid)
    by_pose, by_rate, *_ = _values(
        robot, "motion_derivatives", q, zero_rate, zero_rate, holding, rigid
    )
    push = np.linalg.solve(mass, jacobian.T)
    inner = 2 * size + joints * (1 + filtering)
    system = np.zeros((inner + 3 * joints, inner + 3 * joints))
    coordinates = slice(0, size)
    rates = slice(size, 2 * size)
    integrals = slice(2 * size, 2 * size + joints)
    filtered = slice(2 * size + joints, inner)
    command, slope, command_rate = (
        slice(inner + k * joints, inner + (k + 1) * joints) for k in range(3)
    )
    system[coordinates, rates] = np.eye(size)
    system[rates, coordinates] = -np.linalg.solve(mass, by_pose) - (lp + law.lx) * push @ jacobian
    system[rates, rates] = -np.linalg.solve(mass, by_rate) - push @ (
        (ld * (not filtering) + viscous)[:, None] * jacobian
    )
    system[rates, integrals] = li * push
    system[rates, command] = lp * push
    if filtering:
        system[rates, filtered] = ld * push
        system[filtered, rates] = -jacobian / law.filter_time
        system[filtered, command_rate] = np.eye(joints) / law.filter_time
        system[filtered, filtered] = -np.eye(joints) / law.filter_time
    else:
        system[rates, command_rate] = law.rate_weight * ld * push
    system[integrals, coordinates] = -jacobian
    system[integrals, command] = np.eye(joints)
    system[integrals, integrals] = 0.0 if law.integrates else -np.eye(joints)
    system[command, slope] = np.eye(joints)
    return system


def _servo(robot: _NearRest, settings: LoopSettings) -> np.ndarray:
    """Matrix from the inputs of the servo to the command of a frame.

    The inputs are the measured minus the desired coordinates at this frame and at the previous one,
    and the servo integral before this frame. This sign of the deviations makes `by_now` negative.
    """
    gains = settings.servo
    period = 1 / settings.timing.frame_rate_hz
    jacobian = robot.jacobian
    by_now = -(gains.kp + gains.kd / period + gains.ki * period) * jacobian
    return np.hstack([by_now, gains.kd / period * jacobian, gains.ki * jacobian])


def torque_motion(
    robot: Robot, parameters: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Linear motion near rest at a pose (6,), for drives that take torques.

    Returns the matrix (2 m, 2 m) of the differential equation of coordinates and rates, and the
    acceleration (m, n) per torque added to those that hold the robot.
    """
    q = robot.coordinates(pose)
    rest = np.zeros(len(robot.coordinate_names))
    rigid, _, viscous, _ = robot.layout.split(parameters)
    mass, _, jacobian, *_ = _values(robot, "equation_of_motion", q, rest, rigid)
    holding = robot.static_torque(pose, parameters[robot.layout.dynamic])
    by_pose, by_rate, *_ = _values(robot, "motion_derivatives", q, rest, rest, holding, rigid)
    damped = by_rate + jacobian.T @ (viscous[:, None] * jacobian)
    push = np.linalg.solve(mass, jacobian.T)
    accelerations = -np.linalg.solve(mass, np.hstack([by_pose, damped]))
    return np.vstack([np.eye(len(q), 2 * len(q), len(q)), accelerations]), push


def _values(robot: Robot, name: str, *inputs: np.ndarray) -> list[np.ndarray]:
    """Outputs of a function of the robot for a single state."""
    return [output[0] for output in robot.functions[name](*[value[None] for value in inputs])]


def last_stable(
    radius: Callable[[float], float], start: float, stable_end: float, other_end: float
) -> float:
    """Limit of stability on the way from a start to one of two ends.

    The limit is the first value at which the radius passes 1. If the loop is stable at the start,
    the search goes to `stable_end`, and returns that end if the loop is stable all the way. If it
    is unstable at the start, the search goes to `other_end`, and returns NaN if it finds no limit.
    The search can miss a narrow range of values, because it proceeds in steps of SEARCH_RATIO, and
    does not look beyond the end.
    """
    stable = radius(start) < 1
    value = start
    end = stable_end if stable else other_end
    nearest, ratio = (min, SEARCH_RATIO) if end > start else (max, 1 / SEARCH_RATIO)
    while value != end:
        following = nearest(value * ratio, end)
        if (radius(following) < 1) != stable:
            low = value
            high = following
            for _ in range(30):
                # bisect the logarithm of the value
                middle = (low * high) ** 0.5
                low, high = (middle, high) if (radius(middle) < 1) == stable else (low, middle)
            return (low * high) ** 0.5
        value = following
    return end if stable else float("nan")
