"""An experiment that `mujoco.sysid` can evaluate too: rss6 behind joint servos of known gains, 14 unknowns.

Unknown are the platform's mass, one scale of its three moments of inertia, and Coulomb and viscous friction of the six
joints: the rigid bodies of Table 1 (of its impossible moments only those are changed for MuJoCo that no motion feels)
with the friction of Table 2. The joints follow logged commands by a proportional-derivative servo with the gains lp and
ld of Table 2, so torque, and with it the scale, is known. Measured is the pose of the platform alone, 5 s at 1 kHz,
positions with 30 um and the four components of the quaternion with 6e-5 of noise. The robot starts at rest at home,
which is known, and its commands carry the platform's nominal weight.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

import dynamics
from dynamics.closed_loop import FrameTiming, LoopSettings, Reference, ServoGains, StartState, simulate
from identify.excitation.design import design_trajectories
from identify.scenario import load_scenario

RATE_HZ, SECONDS = 1000.0, 5.0
TIMES = np.arange(round(RATE_HZ * SECONDS) + 1) / RATE_HZ
POSITION_STD, QUATERNION_STD = 30e-6, 6e-5

FREE = (
    "platform.mass",
    "platform inertia scale",
    *(f"joint{leg}.coulomb" for leg in range(1, 7)),
    *(f"joint{leg}.viscous" for leg in range(1, 7)),
)

NO_INTEGRAL = 1e-9
"""Integral gain of the joint PID, which must not be zero: 1e-9 N m in the whole run."""

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
    values = robot().parameter_sets["initial"].vector.copy()
    found = robot().parameter_sets["identified"].vector
    values[52:64] = found[52:64]
    values[64:] = found[64], NO_INTEGRAL, found[66]
    return values


@cache
def truth():
    """The 14 unknowns, in the order of `FREE`."""
    return np.concatenate([[table()[0], 1.0], table()[52:64]])


@cache
def span():
    """Derivative (67, 14) of all parameters by the unknowns."""
    columns = np.zeros((67, len(FREE)))
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
    return robot().inverse_kinematics(home) + robot().static_torque(home, table()[:64]) / servo_gains()[0]


def sine_commands():
    """One sine a joint, frequencies and phases as in the tests of `mujoco.sysid` on an arm of five joints, of a tenth
    of the travel: (frames, 6), rad."""
    angle = 2 * np.pi * SINE_HZ * TIMES[:, None] + SINE_PHASE
    return home_commands() + SINE_RAD * (np.sin(angle) - np.sin(SINE_PHASE))


def designed_commands():
    """Two periods of five harmonics, as in the paper, the best of 64 random ones by its index: (frames, 6), rad.

    The searches that this package has besides take longer than the identifications here.
    """
    design = {"method": "random", "criterion": "observability", "candidates": 64}
    period = {"fundamental_hz": 2 / SECONDS, "harmonics": 5, "duration_s": SECONDS}
    asked = {f"excitation.{key}": value for key, value in (design | period).items()}
    trajectory = design_trajectories(robot(), load_scenario("paper").with_overrides(asked), seed=0).excitation
    home = robot().inverse_kinematics(robot().home_pose)
    return home_commands() - home + robot().inverse_kinematics(trajectory.pose(TIMES))


def felt_commands(commands):
    """Commands (frames, 6) to which lp (felt - angle) - ld rate is the torque of the servo, whose derivative part damps
    the rate of the error: the commands' own rate moved into them."""
    lp, ld = servo_gains()
    return commands + ld / lp * RATE_HZ * np.diff(commands, axis=0, prepend=commands[:1])


def run(free, commands, *, sensitivities=False, steps=1):
    """The exact simulation: stick and slip located, Runge-Kutta steps of 1 ms / `steps`."""
    home, rest = robot().home_pose, np.zeros(6)
    still = Reference(np.tile(home, (len(commands), 1)), np.zeros_like(commands))
    settings = LoopSettings(ServoGains(0.0, 0.0, 0.0), FrameTiming(RATE_HZ), steps_per_frame=steps)
    start = StartState(home, rest, rest, rest, commands[:1], home)
    return simulate(
        robot(), parameters(free), still, settings, start=start, commands=commands, sensitivities=sensitivities
    )


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
