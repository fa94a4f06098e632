"""The motion of a trajectory as CasADi expressions of its unknowns."""

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.kinematics.jacobians import joint_jacobian
from dynamics.kinematics.rotation import pose_rate_to_twist, twist_bias
from dynamics.rigid_body.virtual_work import rigid_body_regressor
from identify.arrays import Array
from identify.excitation.unknowns import Unknowns

SAMPLES_PER_HARMONIC = 20
"""Poses sampled in a period of the highest harmonic when a criterion is computed."""


def sample_times(fundamental_hz: float, harmonics: int, refinement: int = 1) -> Array:
    """Instants (N,) [s] over one period of the fundamental, off its ends, where the robot rests."""
    count = refinement * SAMPLES_PER_HARMONIC * harmonics
    return np.asarray((np.arange(count) + 0.5) / (count * fundamental_hz), dtype=float)


def is_whole_periods(duration_s: float, fundamental_hz: float) -> bool:
    """Whether a run is a whole number of periods, at least one, to rounding."""
    periods = duration_s * fundamental_hz
    return round(periods) >= 1 and abs(periods - round(periods)) <= 1e-9 * periods


def played_times(fundamental_hz: float, harmonics: int, duration_s: float) -> Array:
    """Instants (N,) [s] as dense as `sample_times`, over what a run plays of a trajectory: one period where it plays
    whole ones, over which the motion repeats, else all of it."""
    if is_whole_periods(duration_s, fundamental_hz):
        return sample_times(fundamental_hz, harmonics)
    count = max(1, round(SAMPLES_PER_HARMONIC * harmonics * fundamental_hz * duration_s))
    return np.asarray((np.arange(count) + 0.5) * (duration_s / count), dtype=float)


def motion(unknowns: Unknowns, z: ca.MX, times: Array) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Poses, pose rates and pose accelerations, each (6, N), of z at `times` (N,) [s]."""
    matrix = ca.reshape(z, unknowns.columns, 6).T
    offset, rate, acceleration = (ca.diag(unknowns.box) @ matrix @ ca.DM(b.T) for b in unknowns.basis(times))
    return ca.repmat(ca.DM(unknowns.home), 1, len(times)) + offset, rate, acceleration


def tracked_motion(
    unknowns: Unknowns, z: ca.MX, times: Array, tracking: NDArray[np.complex128]
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """As `motion`, of a robot that follows harmonic k of the trajectory with `tracking` (harmonics, 6, 6), and its mean
    exactly; in the steady state."""
    speeds = 2j * np.pi * unknowns.fundamental_hz * np.arange(1, unknowns.harmonics + 1)
    period = sample_times(unknowns.fundamental_hz, unknowns.harmonics)
    basis, box = unknowns.basis(period)[0], np.diag(unknowns.box)
    maps = [np.zeros((len(times), 6, unknowns.size)) for _ in range(3)]
    maps[0] += np.kron(box, basis.mean(axis=0))
    for s, followed in zip(speeds, tracking, strict=True):
        coefficient = 2 / len(period) * np.exp(-s * period) @ basis
        amplitude = np.exp(s * times)[:, None, None] * np.kron(followed @ box, coefficient)
        for derivative, total in enumerate(maps):
            total += (s**derivative * amplitude).real
    offset, rate, acceleration = (
        ca.reshape(ca.DM(total.reshape(-1, unknowns.size)) @ z, 6, len(times)) for total in maps
    )
    return ca.repmat(ca.DM(unknowns.home), 1, len(times)) + offset, rate, acceleration


def torque_regressor(robot: Robot, smoothing_rad_s: float | None) -> ca.Function:
    """(pose, rate, acceleration) (6,) -> regressor of the actuator torques, transposed, (64, 6).

    The wrench regressor (eq. 25) is J_ad^T times it. The sign of Coulomb friction has no derivative:
    `smoothing_rad_s` replaces it by tanh(theta_dot / v_s); None keeps it.
    """
    return _regressor(robot, smoothing_rad_s, torque=True)


def wrench_regressor(robot: Robot, smoothing_rad_s: float | None) -> ca.Function:
    """(pose, rate, acceleration) (6,) -> regressor of the wrench (eq. 25), transposed, (64, 6)."""
    return _regressor(robot, smoothing_rad_s, torque=False)


def _regressor(robot: Robot, smoothing_rad_s: float | None, torque: bool) -> ca.Function:
    pose, rate, acceleration = (ca.SX.sym(name, 6) for name in ("pose", "rate", "acceleration"))
    to_twist = pose_rate_to_twist(pose)
    twist, twist_dot = to_twist @ rate, to_twist @ acceleration + twist_bias(pose, rate)
    jacobian = joint_jacobian(robot.geometry, pose)
    velocity = jacobian @ twist
    sign = ca.sign(velocity) if smoothing_rad_s is None else ca.tanh(velocity / smoothing_rad_s)
    rigid = rigid_body_regressor(robot.geometry, pose, twist, twist_dot)
    friction = ca.horzcat(ca.diag(sign), ca.diag(velocity))
    if torque:
        whole = ca.horzcat(ca.solve(jacobian.T, rigid), friction)
    else:
        whole = ca.horzcat(rigid, jacobian.T @ friction)
    return ca.Function("regressor", [pose, rate, acceleration], ca.cse([ca.densify(whole.T)]))
