"""Drives: the law by which every joint makes a torque of its command, and the largest torque that it gives.

With U the command of a joint, theta its coordinate and the gains lp, li, ld, the torque or force is

    lp (U - theta) + li z - lx theta + ld (c U_dot - theta_dot),    z_dot = U - theta,

cut at the limit. There what z and theta hold, li z - lx theta, does not grow beyond: the integrator waits until the
error turns (conditional integration). The laws differ in which gains they read, in c, and in lx:

    pid       c = 1, lx = 0                   the paper's (eq. 31)
    pd, pi    c = 1, lx = 0, without li; without ld
    cascade   c = 0, lx = li ld / lp          P-PI of industrial drives
    pid_filtered   as pid, with the rate U_dot - theta_dot through a low-pass filter of first order

The cascade is a proportional controller of the position around a PI controller of the velocity,

    torque = kv (w - theta_dot) + ki integral(w - theta_dot),    w = kp (U - theta),

and the integral of theta_dot is theta but for a constant, which z takes: kp = lp / ld, kv = ld, ki = lx. In every law a
factor common to lp, li and ld, and so to lx, is one of the torque.

A law without an integral holds a load by an error: at rest its command is where the joint is plus the torque over lp.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from dynamics.checks import check_choice, flag, real
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
"""Gains that each law reads."""

ABOVE_ZERO: Mapping[str, tuple[str, ...]] = {
    "pid": ("li",),
    "pd": ("lp",),
    "pi": ("li",),
    "cascade": JOINT_PID,
    "pid_filtered": ("li",),
}
"""Gains without which it holds no load, or is another law."""


class JointLaw(NamedTuple):
    """A law with its gains: lp, li, ld as far as it reads them, lx, and c, rate_weight; lx_by (3,): derivative of lx by
    lp, li, ld; reads (3,): which of these it reads, 1 or 0; filter_time: of the rate, s, 0 without."""

    lp: float
    li: float
    ld: float
    lx: float
    rate_weight: float
    lx_by: np.ndarray
    reads: np.ndarray
    filter_time: float = 0.0

    def held(self, torque: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Command (n,) and integral z (n,) with which joints at rest at an angle (n,) give a torque (n,)."""
        if self.li:
            return angle, (torque + self.lx * angle) / self.li
        return angle + torque / self.lp, np.zeros_like(torque)

    def held_by_parameters(
        self, torque: np.ndarray, angle: np.ndarray, by_dynamic: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (n, p) of both by the dynamic parameters, then lp, li, ld; by_dynamic: those of the torque."""
        command, integral = self.held(torque, angle)
        none = np.zeros((len(torque), len(JOINT_PID)))
        still = np.hstack([np.zeros_like(by_dynamic), none])
        if self.li:
            by_gains = np.outer(angle, self.lx_by) / self.li
            by_gains[:, 1] -= integral / self.li
            return still, np.hstack([by_dynamic / self.li, by_gains])
        none[:, 0] = (angle - command) / self.lp
        return np.hstack([by_dynamic / self.lp, none]), still


@dataclass(frozen=True)
class Drives:
    """What the actuators take and give: joint commands, which a law follows, or torques themselves; the largest torque,
    N m or N (None: no limit); the law, which does not act where they take torques; the time constant, s, of a filter.

    Raises SimulationError: a limit or a time constant that is not > 0, a law that is none, one without its filter, or a
    filter that belongs to another law.
    """

    torques: bool = False
    torque_limit: float | None = None
    law: DriveName = "pid"
    filter_time: float | None = None

    def __post_init__(self) -> None:
        flag("torques", self.torques, SimulationError)
        check_choice("law of the drives", self.law, DRIVES, SimulationError)
        if self.torque_limit is not None:
            real("torque limit", self.torque_limit, SimulationError, above=0, unit=" N m or N")
        if self.law == FILTERED:
            real(f"filter_time of the law `{FILTERED}`", self.filter_time, SimulationError, above=0, unit=" s")
        elif self.filter_time is not None:
            raise SimulationError(
                f"filter_time = {self.filter_time!r} belongs to the law `{FILTERED}`, not to `{self.law}`"
            )

    def joint_law(self, gains: np.ndarray) -> JointLaw:
        """The law with the gains lp, li, ld (3,)."""
        return joint_law(self.law, gains, self.filter_time)


PID = Drives()
"""The paper's, without a limit."""


def joint_law(name: DriveName, gains: np.ndarray, filter_time: float | None = None) -> JointLaw:
    """A law of this name with the gains lp, li, ld (3,), and the time constant of its filter, s."""
    reads = np.array([float(gain in READS[name]) for gain in JOINT_PID])
    lp, li, ld = (float(gain) if read else 0.0 for gain, read in zip(gains, reads, strict=True))
    if name != "cascade":
        return JointLaw(lp, li, ld, 0.0, 1.0, np.zeros(3), reads, filter_time or 0.0)
    lx = li * ld / lp
    return JointLaw(lp, li, ld, lx, 0.0, np.array([-lx / lp, ld / lp, li / lp]), reads)


class CascadeGains(NamedTuple):
    """Gains of the cascade as drives name them: kp of the position (1/s), kv and ki of the velocity (N m s/rad and
    N m/rad, or N s/m and N/m)."""

    kp: float
    kv: float
    ki: float


def cascade_gains(gains: np.ndarray) -> tuple[CascadeGains, np.ndarray]:
    """The cascade's own gains from lp, li, ld (3,), and their derivatives (3, 3) by these."""
    lp, li, ld = gains
    by_gains = np.array(
        [[1 / ld, 0.0, -lp / ld**2], [0.0, 0.0, 1.0], [-li * ld / lp**2, ld / lp, li / lp]],
    )
    return CascadeGains(lp / ld, ld, li * ld / lp), by_gains
