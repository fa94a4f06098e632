"""Model of a robot for control laws: joint coordinates and torques along a motion."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.joints import FrictionLaw
from dynamics.robot import Robot

# Nodes and weights of Gauss-Legendre quadrature over a span. The time at which friction reverses is
# resolved to about an eighth of the span.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
GUESSED_DOUBT = 0.2  # value of `Model.doubt` for a guessed model, 1/s

# Value of `Model.doubt` for a model that fits measured data, 1/s. The covariances of identified
# parameters give 3.3e-4 to 5.4e-4 for three robots, at 29 and 60 Hz, along validation motions
# without reversals.
FITTED_DOUBT = 4e-4


class Motion(Protocol):
    """Desired motion of the platform, in the form that a law requires.

    Any object with these three methods is a motion. The methods take times (N,), s, and return
    arrays (N, 6).

    Examples
    --------
    >>> from dynamics.control import Motion
    >>> class Rest:
    ...     def pose(self, t):
    ...         return np.tile(robot.home_pose, (len(t), 1))
    ...     def pose_rate(self, t):
    ...         return np.zeros((len(t), 6))
    ...     def pose_acceleration(self, t):
    ...         return np.zeros((len(t), 6))
    >>> motion: Motion = Rest()
    >>> motion.pose(np.zeros(2)).shape
    (2, 6)
    """

    def pose(self, t: np.ndarray) -> np.ndarray:
        """Poses (N, 6), m and rad."""

    def pose_rate(self, t: np.ndarray) -> np.ndarray:
        """Pose rates (N, 6)."""

    def pose_acceleration(self, t: np.ndarray) -> np.ndarray:
        """Pose accelerations (N, 6)."""


@dataclass(frozen=True)
class Model:
    """Model of a robot that a law uses.

    Parameters
    ----------
    robot : Robot
        Kinematics and dynamics.
    parameters : ndarray, shape (p,)
        Dynamic parameters, then the gains of the drives.
    friction : FrictionLaw
        Law of joint friction.
    doubt : float
        Expected rate of change of the model's torque errors, relative to the torque at rest, 1/s.

    Examples
    --------
    >>> from dynamics.control import Model
    >>> parameters = robot.parameter_sets["truth"].vector
    >>> model = Model(robot, parameters, closed_loop.FrictionLaw())
    >>> model.dynamic.shape
    (64,)
    """

    robot: Robot
    parameters: np.ndarray
    friction: FrictionLaw
    doubt: float = GUESSED_DOUBT

    @property
    def dynamic(self) -> np.ndarray:
        """Dynamic parameters, without the gains of the joint PID."""
        return self.parameters[self.robot.layout.dynamic]

    @property
    def gains(self) -> np.ndarray:
        """Gains lp, li, ld of each joint (n, 3)."""
        return self.robot.layout.split(self.parameters)[3]

    def held(self, pose: np.ndarray, drives: Drives) -> tuple[np.ndarray, np.ndarray]:
        """Received commands (n,) and integrals (n,) of drives that hold the robot at a pose (6,).

        Friction torques are zero.
        """
        law = drives.joint_law(self.gains)
        rest = np.zeros((1, 6))
        return law.held(self.torque(pose[None], rest, rest)[0], self.robot.inverse_kinematics(pose))

    def torque(
        self,
        pose: np.ndarray,
        rate: np.ndarray,
        acceleration: np.ndarray,
        dry_along: np.ndarray | None = None,
    ) -> np.ndarray:
        """Actuator torques (N, n), N m or N, for pose rates and accelerations (N, 6) (eq. 17, 23).

        The signs of dry friction are those of the joint velocities `dry_along` (N, n), by default
        those of the motion. Raises the same errors as `Robot.inverse_dynamics`.
        """
        robot = self.robot
        parameters = self.dynamic.copy()
        coulomb = self.parameters[robot.layout.coulomb]
        parameters[robot.layout.coulomb] = 0.0
        twist = robot.twist(pose, rate)
        twist_dot = robot.twist_dot(pose, rate, acceleration)
        joint_rates = (
            np.einsum("nij,nj->ni", robot.pose_jacobian(pose), rate)
            if dry_along is None
            else dry_along
        )
        frictionless = robot.inverse_dynamics(pose, twist, twist_dot, parameters)
        return np.asarray(frictionless + coulomb * self.friction.level(joint_rates))


@dataclass(frozen=True)
class Spans:
    """Joint coordinates and torques of a motion over spans of time of equal length.

    `begin` and `end` (N, n) are joint coordinates at the ends of a span, and `mean` (N, n) is their
    mean over the span. `mean_integral` (N, n), rad s or m s, is the mean over the span of their
    integral since its beginning. `torque` (N, n) is the mean torque, N m or N.
    """

    begin: np.ndarray
    end: np.ndarray
    mean: np.ndarray
    mean_integral: np.ndarray
    torque: np.ndarray


def spans(
    model: Model, motion: Motion, begins: np.ndarray, length: float, dry: Motion | None = None
) -> Spans:
    """Joint coordinates and torques of a motion over the spans that begin at times (N,), s.

    The signs of dry friction are those of the joint velocities of the motion `dry`, if given.
    Raises the same errors as `Robot.inverse_dynamics`.
    """
    fraction = (NODES + 1) / 2
    weight = WEIGHTS / 2
    times = (begins[:, None] + fraction * length).ravel()
    poses = motion.pose(times)
    joints = model.robot.inverse_kinematics(poses).reshape(len(begins), len(fraction), -1)
    dry_rates = None
    if dry is not None:
        dry_rates = np.einsum(
            "nij,nj->ni", model.robot.pose_jacobian(dry.pose(times)), dry.pose_rate(times)
        )
    torque = model.torque(
        poses, motion.pose_rate(times), motion.pose_acceleration(times), dry_rates
    )
    begin, end = (
        model.robot.inverse_kinematics(motion.pose(begins + shift)) for shift in (0.0, length)
    )
    return Spans(
        begin,
        end,
        mean=np.einsum("s,nsj->nj", weight, joints),
        mean_integral=length * np.einsum("s,nsj->nj", weight * (1 - fraction), joints),
        torque=np.einsum("s,nsj->nj", weight, torque.reshape(joints.shape)),
    )
