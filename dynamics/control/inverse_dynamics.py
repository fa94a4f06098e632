"""What a model says a motion takes: joint coordinates and torques along it, and their means over spans of time."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.joints import FrictionLaw
from dynamics.robot import Robot

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Gauss-Legendre quadrature; friction that turns within a span is met to some eighth of it."""


VAGUE, FITTED = 0.2, 4e-4
"""How fast the torques of a model depart from the true ones along a motion, over the torque at rest, 1/s, before a run
has told: of a model that is a guess, and of one that fits what was measured.

The latter is what the covariances of identified parameters say along unseen motions, where no joint turns back: 3.3e-4
to 5.4e-4 of three robots, at 29 and 60 Hz."""


class Motion(Protocol):
    """A desired motion: poses, their rates and accelerations (N, 6) at times (N,), s."""

    def pose(self, t: np.ndarray) -> np.ndarray:
        """Poses, m and rad."""

    def pose_rate(self, t: np.ndarray) -> np.ndarray:
        """Their time derivatives."""

    def pose_acceleration(self, t: np.ndarray) -> np.ndarray:
        """Their second time derivatives."""


@dataclass(frozen=True)
class Model:
    """A robot as a law knows it: with all its parameters (p,), its law of friction, and a doubt: how fast
    its torques' errors change, over the torque at rest, 1/s, as an observer first takes it."""

    robot: Robot
    parameters: np.ndarray
    friction: FrictionLaw
    doubt: float = VAGUE

    @property
    def dynamic(self) -> np.ndarray:
        """Parameters without those of the joint PID."""
        return self.parameters[self.robot.layout.dynamic]

    def held(self, pose: np.ndarray, drives: Drives) -> tuple[np.ndarray, np.ndarray]:
        """Joint commands (n,) and integrals (n,) of the drives of a robot at rest at a pose (6,), friction unloaded."""
        law, rest = drives.joint_law(self.parameters[self.robot.layout.joint_pid]), np.zeros((1, 6))
        return law.held(self.torque(pose[None], rest, rest)[0], self.robot.inverse_kinematics(pose))

    def torque(
        self, pose: np.ndarray, rate: np.ndarray, acceleration: np.ndarray, dry_along: np.ndarray | None = None
    ) -> np.ndarray:
        """Actuator torques (N, n), N m or N, of pose rates and accelerations (N, 6) (eq. 17 and 23).

        dry_along (N, n): joint velocities that say which way dry friction acts, instead of the motion's own.
        Raises what `Robot.inverse_dynamics` does.
        """
        robot, parameters = self.robot, self.dynamic.copy()
        coulomb = self.parameters[robot.layout.coulomb]
        parameters[robot.layout.coulomb] = 0.0
        twist, twist_dot = robot.twist(pose, rate), robot.twist_dot(pose, rate, acceleration)
        turning = np.einsum("nij,nj->ni", robot.pose_jacobian(pose), rate) if dry_along is None else dry_along
        without = robot.inverse_dynamics(pose, twist, twist_dot, parameters)
        return np.asarray(without + coulomb * self.friction.level(turning))


@dataclass(frozen=True)
class Spans:
    """Along a motion, over spans of time of one length: joint coordinates as they begin and end (N, n), their mean and
    that of their integral since the beginning (N, n), and the mean torque (N, n)."""

    begin: np.ndarray
    end: np.ndarray
    mean: np.ndarray
    mean_integral: np.ndarray
    torque: np.ndarray


def spans(model: Model, motion: Motion, begins: np.ndarray, length: float, dry: Motion | None = None) -> Spans:
    """What a motion takes over the spans that begin at times (N,), s; dry: the motion whose joints say which way dry
    friction acts, if not its own. Raises what `Robot.inverse_dynamics` does."""
    share, weight = (NODES + 1) / 2, WEIGHTS / 2
    times = (begins[:, None] + share * length).ravel()
    poses = motion.pose(times)
    joints = model.robot.inverse_kinematics(poses).reshape(len(begins), len(share), -1)
    turning = None
    if dry is not None:
        turning = np.einsum("nij,nj->ni", model.robot.pose_jacobian(dry.pose(times)), dry.pose_rate(times))
    torque = model.torque(poses, motion.pose_rate(times), motion.pose_acceleration(times), turning)
    begin, end = (model.robot.inverse_kinematics(motion.pose(begins + shift)) for shift in (0.0, length))
    return Spans(
        begin,
        end,
        mean=np.einsum("s,nsj->nj", weight, joints),
        mean_integral=length * np.einsum("s,nsj->nj", weight * (1 - share), joints),
        torque=np.einsum("s,nsj->nj", weight, torque.reshape(joints.shape)),
    )
