"""Drives: the law by which each joint turns its command into a torque, and the largest torque.

Let U be the command of a joint, theta its coordinate, and lp, li, ld the gains. The torque or force
is, up to the limit,

    torque = lp (U - theta) + li z - lx theta + ld (c U_dot - theta_dot),    z_dot = U - theta

`drive_kernels.drive` computes the torque. At the limit, li z - lx theta is kept constant while it
would otherwise change in the direction of the torque (conditional integration). The laws differ in
the gains that they use, in c, and in lx:

    pid            c = 1, lx = 0                  law of the paper (eq. 31)
    pd             c = 1, lx = 0                  no li
    pi             c = 1, lx = 0                  no ld
    cascade        c = 0, lx = li ld / lp         P-PI of industrial drives
    pid_filtered   as pid                         U_dot - theta_dot goes through a low-pass filter

The cascade is a proportional controller of the position around a PI controller of the velocity,

    torque = kv (w - theta_dot) + ki integral(w - theta_dot),    w = kp (U - theta)

The integral of theta_dot is theta except for a constant, which is a part of z. Hence kp = lp / ld,
kv = ld and ki = lx. In every law, the torque is proportional to a common factor of lp, li and ld.

A law without an integral balances a load by an error: at rest, its command is the coordinate of the
joint plus the torque divided by lp.

The command U that a drive receives can differ from the one that was sent. Causes are a wrong scale
s, a zero error z0 of the joint, steps q of a digital interface, and a limited range of commands:

    U = s clip(q round(sent / q), lowest, highest) + z0
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from dynamics.checks import check_choice, check_type, flag, real
from dynamics.errors import SimulationError
from dynamics.parameters import JOINT_PID

DriveName = Literal["pid", "pd", "pi", "cascade", "pid_filtered"]

DRIVES: tuple[DriveName, ...] = get_args(DriveName)
FILTERED: DriveName = "pid_filtered"

READS: Mapping[str, tuple[str, ...]] = {
    "pid": JOINT_PID,
    "pd": ("lp", "ld"),
    "pi": ("lp", "li"),
    "cascade": JOINT_PID,
    "pid_filtered": JOINT_PID,
}
"""Gains that each law uses."""

ABOVE_ZERO: Mapping[str, tuple[str, ...]] = {
    "pid": ("li",),
    "pd": ("lp",),
    "pi": ("li",),
    "cascade": JOINT_PID,
    "pid_filtered": ("li",),
}
"""Gains that must be > 0 in each law.

If one of them were zero, the law could not balance a load, or would be another law.
"""


class JointLaw(NamedTuple):
    """Law of all joints with the gains of each.

    The gains lp, li and ld (n,) are 0 if the law does not use them. `lx` (n,) and `rate_weight` (c)
    are as in the formula of this module. `lx_by` (n, 3) has the derivatives of lx with respect to
    lp, li, ld of the same joint. `reads` (3,) is 1 for each gain that the law uses, else 0.
    `filter_time` is the time constant of the filter of the rate, s, or 0.
    """

    lp: np.ndarray
    li: np.ndarray
    ld: np.ndarray
    lx: np.ndarray
    rate_weight: float
    lx_by: np.ndarray
    reads: np.ndarray
    filter_time: float = 0.0

    @property
    def integrates(self) -> bool:
        """True if the law has an integral, which balances a load at rest."""
        return bool(self.reads[JOINT_PID.index("li")])

    def held(self, torque: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Received command (n,) and integral z (n,) that hold joints at rest.

        The joints are at an `angle` (n,) and need a `torque` (n,).
        """
        if self.integrates:
            return angle, (torque + self.lx * angle) / self.li
        return angle + torque / self.lp, np.zeros_like(torque)

    def held_by_parameters(
        self, torque: np.ndarray, angle: np.ndarray, by_dynamic: np.ndarray, own_gains: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (n, p) of both results of `held` with respect to all parameters.

        The gains come last. `by_dynamic` has the derivatives of the torque with respect to the
        dynamic parameters. `own_gains` is True if each joint has its own gains.
        """
        command, integral = self.held(torque, angle)
        by_gains = np.zeros((len(torque), len(JOINT_PID)))
        no_gains = gain_columns(by_gains, own_gains)
        zeros = np.hstack([np.zeros_like(by_dynamic), no_gains])
        if self.integrates:
            li = self.li[:, None]
            by_gains = angle[:, None] * self.lx_by / li
            by_gains[:, 1] -= integral / self.li
            return zeros, np.hstack([by_dynamic / li, gain_columns(by_gains, own_gains)])
        by_gains[:, 0] = (angle - command) / self.lp
        by_dynamic = by_dynamic / self.lp[:, None]
        return np.hstack([by_dynamic, gain_columns(by_gains, own_gains)]), zeros


def gain_columns(by_gains: np.ndarray, own_gains: bool) -> np.ndarray:
    """Columns of all gains, from derivatives (..., n, 3) with respect to a joint's own gains.

    The columns are (..., n, 3) if all joints share their gains. Otherwise, they are (..., n, 3 n),
    with zeros for the gains of other joints.
    """
    if not own_gains:
        return by_gains
    *rows, joints, kinds = by_gains.shape
    columns = np.zeros((*rows, joints, joints, kinds))
    each = np.arange(joints)
    columns[..., each, each, :] = by_gains
    return columns.reshape(*rows, joints, joints * kinds)


@dataclass(frozen=True)
class Drives:
    """Actuators of a robot.

    Parameters
    ----------
    torques : bool
        True for drives that take torques. The default is drives that take joint commands.
    torque_limit : float, optional
        Largest magnitude of a torque or force, N m or N. The default is no limit.
    law : {"pid", "pd", "pi", "cascade", "pid_filtered"}
        Law by which drives follow joint commands.
    filter_time : float, optional
        Time constant of the filter of the law `pid_filtered`, s. Only this law has one.
    command_scale : float
        Ratio s of received to sent commands, > 0.
    joint_zeros : tuple of float
        Zero error z0 of each joint, rad or m: its true coordinate minus its reading. The default is
        no error.
    command_step : float, optional
        Step q of the received commands, rad or m. The default is no steps.
    command_limits : tuple of float, optional
        Lowest and highest command that the drives take, rad or m. Commands are rounded to steps,
        and then cut at these limits. The default is no limits.
    friction_offset : tuple of float
        Half of the difference of each joint's Coulomb friction, positive minus negative direction,
        N m or N. It acts as a constant torque in the negative direction, which the integral of the
        drive balances. The torques that a run records are those of the motors minus this offset.
        The default is no offset.

    Raises
    ------
    SimulationError
        If a limit of torques, a time constant, a scale or a step is not > 0, if a zero, an offset
        or a limit of commands is not finite, if the lowest command is not below the highest, if the
        law is unknown, if a filter is missing or belongs to another law, or if a law without an
        integral has an offset of friction.

    Examples
    --------
    >>> closed_loop.Drives(torque_limit=8.0).law
    'pid'
    """

    torques: bool = False
    torque_limit: float | None = None
    law: DriveName = "pid"
    filter_time: float | None = None
    command_scale: float = 1.0
    joint_zeros: tuple[float, ...] = ()
    command_step: float | None = None
    command_limits: tuple[float, float] | None = None
    friction_offset: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        flag("torques", self.torques, SimulationError)
        check_choice("law of the drives", self.law, DRIVES, SimulationError)
        if self.torque_limit is not None:
            real("torque limit", self.torque_limit, SimulationError, above=0, unit=" N m or N")
        if self.law == FILTERED:
            real(
                f"filter_time of the law `{FILTERED}`",
                self.filter_time,
                SimulationError,
                above=0,
                unit=" s",
            )
        elif self.filter_time is not None:
            raise SimulationError(
                f"filter_time = {self.filter_time!r} belongs to the law `{FILTERED}`, not to "
                f"`{self.law}`"
            )
        real("scale of the commands", self.command_scale, SimulationError, above=0)
        check_type("joint_zeros", self.joint_zeros, tuple, SimulationError)
        for joint, zero in enumerate(self.joint_zeros, 1):
            real(f"zero of joint {joint}", zero, SimulationError, unit=" rad or m")
        if self.command_step is not None:
            real("step of the commands", self.command_step, SimulationError, above=0)
        if self.command_limits is not None:
            check_type("command_limits", self.command_limits, tuple, SimulationError)
            low, high = self.command_limits
            real("lowest command", low, SimulationError, unit=" rad or m")
            real("highest command", high, SimulationError, above=low, unit=" rad or m")
        check_type("friction_offset", self.friction_offset, tuple, SimulationError)
        for joint, offset in enumerate(self.friction_offset, 1):
            real(f"friction_offset of joint {joint}", offset, SimulationError, unit=" N m or N")
        if any(self.friction_offset) and (self.torques or "li" not in READS[self.law]):
            raise SimulationError(
                "friction_offset needs drives with an integral, which balances it: under the law "
                "pd it is an error of the joint's zero, and drives that take torques have no law"
            )

    def zeros(self, joints: int) -> np.ndarray:
        """Zero error of each joint (n,), rad or m.

        Raises SimulationError if the drives have zeros of another number of joints.
        """
        return _of_joints("zeros", self.joint_zeros, joints)

    def offsets(self, joints: int) -> np.ndarray:
        """Offset of the friction of each joint (n,), N m or N.

        Raises SimulationError if the drives have offsets of another number of joints.
        """
        return _of_joints("friction offsets", self.friction_offset, joints)

    def interface(self, joints: int) -> dict[str, float | np.ndarray]:
        """Scale, step (0: none), limits (infinite: none) and zeros (n,) of commands, for kernels.

        Drives that take torques receive their commands unchanged.
        """
        received = PID if self.torques else self
        low, high = received.command_limits or (-np.inf, np.inf)
        return {
            "command_scale": received.command_scale,
            "command_step": received.command_step or 0.0,
            "command_low": low,
            "command_high": high,
            "joint_zero": received.zeros(joints),
        }

    def sent(self, received: np.ndarray) -> np.ndarray:
        """Commands (n,) that must be sent so that the drives receive the given commands (n,).

        The steps and the limits of commands are ignored.
        """
        return (received - self.zeros(len(received))) / self.command_scale

    def check_limits(self, sent: np.ndarray) -> None:
        """Raise SimulationError if a sent command (n,) at rest is beyond the limits."""
        if self.command_limits is None or self.torques:
            return
        low, high = self.command_limits
        beyond = np.maximum(low - sent, sent - high)
        joint = int(np.argmax(beyond))
        if beyond[joint] > 0:
            raise SimulationError(
                f"joint {joint + 1} needs the command {sent[joint]:.6g} to stand still at the "
                f"start, but the drives take commands from {low:g} to {high:g} rad or m"
            )

    def joint_law(self, gains: np.ndarray) -> JointLaw:
        """Law with the gains lp, li, ld of each joint (n, 3), or of all joints (3,)."""
        return joint_law(self.law, gains, self.filter_time)


def _of_joints(what: str, values: tuple[float, ...], joints: int) -> np.ndarray:
    """Values (n,) of all joints, or zeros if none are given.

    Raises SimulationError for values of another number of joints.
    """
    if values and len(values) != joints:
        raise SimulationError(
            f"there are {what} of {len(values)} joints, but the robot has {joints}"
        )
    return np.array(values) if values else np.zeros(joints)


PID = Drives()
"""Drives of the paper, without a torque limit."""


def joint_law(name: DriveName, gains: np.ndarray, filter_time: float | None = None) -> JointLaw:
    """Law `name` with the gains lp, li, ld of each joint (n, 3), or of all joints (3,).

    Shared gains give a law whose arrays have no axis of joints. `filter_time` is the time constant
    of the filter of `pid_filtered`, s.
    """
    reads = np.array([float(gain in READS[name]) for gain in JOINT_PID])
    lp, li, ld = np.moveaxis(np.where(reads, gains, 0.0), -1, 0)
    if name != "cascade":
        zero = np.zeros_like(lp)
        return JointLaw(lp, li, ld, zero, 1.0, np.zeros_like(gains), reads, filter_time or 0.0)
    lx = li * ld / lp
    return JointLaw(lp, li, ld, lx, 0.0, np.stack([-lx / lp, ld / lp, li / lp], axis=-1), reads)


class CascadeGains(NamedTuple):
    """Gains of the cascade in the form usual for drives.

    The units are 1/s for kp, N m s/rad or N s/m for kv, and N m/rad or N/m for ki.
    """

    kp: float
    kv: float
    ki: float


def cascade_gains(gains: np.ndarray) -> tuple[CascadeGains, np.ndarray]:
    """Gains kp, kv, ki of the cascade for lp, li, ld (3,), and their derivatives (3, 3).

    Each row of the derivatives belongs to kp, kv or ki.
    """
    lp, li, ld = gains
    by_gains = np.array(
        [[1 / ld, 0.0, -lp / ld**2], [0.0, 0.0, 1.0], [-li * ld / lp**2, ld / lp, li / lp]],
    )
    return CascadeGains(lp / ld, ld, li * ld / lp), by_gains
