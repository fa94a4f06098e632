"""An experiment that `mujoco.sysid` can evaluate too: rss6 behind joint servos of known gains, 14
unknowns.

Unknown are the platform's mass, one scale of its three moments of inertia, and Coulomb and viscous
friction of the six joints: the rigid bodies of Table 1 (of its impossible moments only those are
changed for MuJoCo that no motion feels) with the friction of Table 2. The joints follow logged
commands by a proportional-derivative servo with the gains lp and ld of Table 2, so torque, and with
it the scale, is known. Measured is the pose of the platform alone, 5 s at 1 kHz, positions with 30
um and the four components of the quaternion with 6e-5 of noise. The robot starts at rest at home,
which is known, and its commands carry the platform's nominal weight.

This package identifies by output error: `identify`'s bounded Gauss-Newton on exact sensitivities,
after a linear start. That is the least-squares solution of the torque balance of the joints that
slip: with a known servo the torque follows from commands and poses, and is linear in the unknowns.
"""

import time
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

import dynamics
from dynamics.closed_loop import (
    FrameTiming,
    LoopSettings,
    Reference,
    ServoGains,
    StartState,
    differentiate_commands,
    simulate_commands,
)
from identify.estimation.bounded_least_squares import StopCriteria, minimise
from identify.estimation.warm_start import SLIPPING_SHARE
from identify.filtering import filtered_derivatives, zero_phase_filter
from identify.scenario import load_scenario
from identify.setup import Setup

RATE_HZ, SECONDS = 1000.0, 5.0
TIMES = np.arange(round(RATE_HZ * SECONDS) + 1) / RATE_HZ
POSITION_STD, QUATERNION_STD = 30e-6, 6e-5

# Mass of the platform, scale of its inertia, Coulomb friction (6) and viscous friction (6) of the
# joints.
UNKNOWNS = 14
# Integral gain of the joint PID, which must not be zero: 1e-9 N m in the whole run.
NO_INTEGRAL = 1e-9

# Half the angle of a small turn is the vector part of its quaternion.
POSE_STD = np.repeat([POSITION_STD, 2 * QUATERNION_STD], 3)
CUTOFF_HZ, EVERY, EDGE = 10.0, 10, 100
CRITERIA = StopCriteria(cost_tolerance=1e-4, parameter_tolerance=1e-3, max_iterations=30)
SMALLEST_SHARE = 1e-3

SINE_HZ = np.array([0.5, 0.7, 0.4, 0.9, 0.6, 0.8])
SINE_PHASE = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
SINE_RAD = 0.1


@cache
def robot():
    """The reference robot."""
    return dynamics.load_robot("rss6")


@cache
def table():
    """All parameters (67,) of the true robot with its servo."""
    values = robot().parameter_sets["guess"].vector.copy()
    found = robot().parameter_sets["truth"].vector
    values[52:64] = found[52:64]
    values[64:] = found[64], NO_INTEGRAL, found[66]
    return values


@cache
def truth():
    """The 14 unknowns, in their order."""
    return np.concatenate([[table()[0], 1.0], table()[52:64]])


@cache
def span():
    """Derivative (67, 14) of all parameters by the unknowns."""
    columns = np.zeros((67, UNKNOWNS))
    columns[0, 0] = 1.0
    columns[1:4, 1] = table()[1:4]
    columns[52:64, 2:] = np.eye(12)
    return columns


def parameters(free):
    """All parameters (67,) of 14 unknowns."""
    return table() + span() @ (free - truth())


def servo_gains():
    """lp, N m/rad, and ld, N m s/rad."""
    return table()[64], table()[66]


def home_commands():
    """Commands (6,) that hold the robot at home against its nominal weight."""
    home = robot().home_pose
    return (
        robot().inverse_kinematics(home)
        + robot().static_torque(home, table()[:64]) / servo_gains()[0]
    )


def sine_commands():
    """One sine a joint, frequencies and phases as in the tests of `mujoco.sysid` on an arm of five
    joints, of a tenth of the travel: (frames, 6), rad."""
    angle = 2 * np.pi * SINE_HZ * TIMES[:, None] + SINE_PHASE
    return home_commands() + SINE_RAD * (np.sin(angle) - np.sin(SINE_PHASE))


def designed_commands():
    """Two periods of five harmonics, as in the paper, the best of 64 random ones by its index:
    (frames, 6), rad.

    The searches that this package has besides take longer than the identifications here.
    """
    design = {"method": "random", "criterion": "observability", "candidates": 64}
    period = {"fundamental_hz": 2 / SECONDS, "harmonics": 5, "duration_s": SECONDS}
    asked = {f"excitation.{key}": value for key, value in (design | period).items()}
    scenario = load_scenario("paper").with_overrides(asked)
    trajectory = Setup(scenario, loaded=robot()).trajectories.excitation
    home = robot().inverse_kinematics(robot().home_pose)
    return home_commands() - home + robot().inverse_kinematics(trajectory.pose(TIMES))


def felt_commands(commands):
    """Commands (frames, 6) to which lp (felt - angle) - ld rate is the torque of the servo, whose
    derivative part damps the rate of the error: the commands' own rate moved into them."""
    lp, ld = servo_gains()
    return commands + ld / lp * RATE_HZ * np.diff(commands, axis=0, prepend=commands[:1])


def run(free, commands, *, sensitivities=False, steps=1):
    """The exact simulation: stick and slip located, Runge-Kutta steps of 1 ms / `steps`."""
    home, rest = robot().home_pose, np.zeros(6)
    still = Reference(np.tile(home, (len(commands), 1)), np.zeros_like(commands))
    settings = LoopSettings(ServoGains(0.0, 0.0, 0.0), FrameTiming(RATE_HZ), steps_per_frame=steps)
    start = StartState(home, rest, rest, rest, commands[:1], home)
    simulate = differentiate_commands if sensitivities else simulate_commands
    return simulate(robot(), parameters(free), still, settings, commands, start=start)


@dataclass(frozen=True)
class Measured:
    """Positions (frames, 3), m, and unit quaternions (frames, 4), scalar first, with noise."""

    position: np.ndarray
    quaternion: np.ndarray

    @property
    def pose(self):
        """Poses (frames, 6)."""
        turned = Rotation.from_quat(self.quaternion, scalar_first=True)
        return np.hstack([self.position, turned.as_euler("XYZ")])


def measure(pose, rng):
    """Poses (frames, 6) as the sensor sees them."""
    exact = Rotation.from_euler("XYZ", pose[:, 3:]).as_quat(scalar_first=True, canonical=True)
    return Measured(
        pose[:, :3] + POSITION_STD * rng.standard_normal((len(pose), 3)),
        exact + QUATERNION_STD * rng.standard_normal((len(pose), 4)),
    )


@dataclass(frozen=True)
class Estimate:
    """Values (14,), half-widths (14,) of their 95 % intervals, and wall time of both, s."""

    values: np.ndarray
    half_widths: np.ndarray
    seconds: float


@dataclass(frozen=True)
class ServoProblem:
    """Whitened pose residuals of the model under the logged commands; see
    `bounded_least_squares.Problem`.
    """

    commands: np.ndarray
    measured: np.ndarray

    def cost(self, free):
        try:
            return float(np.sum(((run(free, self.commands).pose - self.measured) / POSE_STD) ** 2))
        except dynamics.DynamicsError:
            return np.inf

    def linearise(self, free):
        model = run(free, self.commands, sensitivities=True)
        residual = ((model.pose - self.measured) / POSE_STD).ravel()
        jacobian = (model.pose_sensitivity @ span() / POSE_STD[:, None]).reshape(-1, UNKNOWNS)
        triangle = np.linalg.qr(np.column_stack([jacobian, residual]), mode="r")
        return (
            float(residual @ residual),
            triangle[:UNKNOWNS, :UNKNOWNS],
            triangle[:UNKNOWNS, UNKNOWNS],
        )


def estimate(commands, measured, guess):
    """The 14 unknowns of one run: commands and measured poses (frames, 6), a first guess (14,)."""
    began = time.perf_counter()
    lower = SMALLEST_SHARE * guess
    start = np.maximum(linear_start(commands, measured), lower)
    problem = ServoProblem(commands, measured)
    solution = minimise(problem, start, lower, guess, CRITERIA)
    _, factor, _ = problem.linearise(solution.parameters)
    half_widths = 1.96 * standard_deviations(factor)
    return Estimate(solution.parameters, half_widths, time.perf_counter() - began)


def standard_deviations(factor):
    """Those (14,) of a fit with the triangular factor R (14, 14) of its whitened Jacobian."""
    inverse = np.linalg.inv(factor)
    return np.sqrt(np.sum(inverse**2, axis=1))


def linear_start(commands, measured):
    """The 14 unknowns by least squares on the joints' torque balance, at every tenth filtered
    pose."""
    filtered = filtered_derivatives(measured, RATE_HZ, CUTOFF_HZ)
    pose, rate, acceleration = (values[EDGE:-EDGE:EVERY] for values in filtered)
    twist, twist_dot = robot().twist(pose, rate), robot().twist_dot(pose, rate, acceleration)
    jacobian = robot().joint_jacobian(pose)
    torque_map = np.linalg.solve(
        jacobian.transpose(0, 2, 1), robot().regressor(pose, twist, twist_dot)
    )
    velocity = np.einsum("nij,nj->ni", jacobian, twist)
    torque = servo_torque(commands, robot().inverse_kinematics(pose), velocity)
    slipping = np.abs(velocity) > SLIPPING_SHARE * velocity.std(axis=0)
    known = parameters(np.zeros(UNKNOWNS))[:64]
    matrix, right = (torque_map @ span()[:64])[slipping], (torque - torque_map @ known)[slipping]
    return np.linalg.lstsq(matrix, right, rcond=None)[0]


def servo_torque(commands, angle, velocity):
    """Torque (n, 6) of the servo at the instants of the start; a held command counts as the mean
    before and after.
    """
    lp, ld = servo_gains()
    smooth = zero_phase_filter(felt_commands(commands), RATE_HZ, CUTOFF_HZ)
    held = (smooth + np.roll(smooth, 1, axis=0)) / 2
    return lp * (held[EDGE:-EDGE:EVERY] - angle) - ld * velocity
