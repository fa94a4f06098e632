"""Equations of a run with measured joint torques: linear in the dynamic parameters, and in the joint PID's.

With tau the filtered torque of a slipping joint, at every instant (eq. 17 and 25; eq. 31)

    (J_ad^-T Gamma(chi, v, v_dot) Xi)_j = tau_j
    lp (U - theta)_j + li integral(U - theta)_j + ld (U_dot - theta_dot)_j + z_j = tau_j

Both stand in one system with the unknowns Xi, lp, li, ld and the starting torques z (6,). The measured torque gives
the scale: no anchor is needed. What the motion does not show is left to the starting guess with its deviations.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from identify.arrays import Array
from identify.estimation.warm_start import joint_balance
from identify.loop_parameters import NAMES, StartingGuess
from identify.record.filtering import zero_phase_filter
from identify.record.recorded_run import RecordedRun
from identify.scenario import Filter, Timing

DYNAMIC, UNKNOWNS = 64, len(NAMES) + 6

FREE_TORQUE_N_M = 1e3
"""Standard deviation of a starting torque before the experiment: nothing is known of it."""


@dataclass(frozen=True)
class TorqueEquations:
    """matrix (2 n, 73) times unknowns = right (2 n,), N m: n rows of the dynamics, then the same of the controller.

    kind (2 n,): 0 to 5 dynamics of each joint, 6 to 11 its controller; correlation: samples to one independent sample,
    because a low-pass filter of cutoff f leaves 2 f independent ones a second; slipping (N, 6): which rows stand here.
    """

    matrix: Array
    right: Array
    kind: NDArray[np.intp]
    correlation: float
    slipping: NDArray[np.bool_]

    def residual(self, unknowns: Array) -> Array:
        """Torques (2 n,) that the equations leave unexplained."""
        return np.asarray(self.matrix @ unknowns - self.right, dtype=float)

    def whitened(self, noise: Array) -> "TorqueEquations":
        """Rows divided by their standard deviations (2 n,)."""
        return replace(self, matrix=self.matrix / noise[:, None], right=self.right / noise)


def torque_equations(
    run: RecordedRun,
    poses: Array,
    torque: Array,
    timing: Timing,
    filtering: Filter,
    slipping: NDArray[np.bool_] | None = None,
) -> TorqueEquations:
    """Equations of poses (N, 6) and torques (N, 6) of a run with its logged commands; those of the joints that slip, or
    of the ones given (N, 6)."""
    balance, found = joint_balance(run.robot, poses, run.logged, timing, filtering)
    rows = found if slipping is None else slipping
    columns = balance[rows]
    smooth = zero_phase_filter(torque, timing.frame_rate_hz, filtering.cutoff_hz, filtering.order)[rows]
    matrix = np.zeros((2 * len(columns), UNKNOWNS))
    matrix[: len(columns), :DYNAMIC] = columns[:, :DYNAMIC]
    matrix[len(columns) :, DYNAMIC:] = -columns[:, DYNAMIC:]
    joint = np.nonzero(rows)[1]
    right = np.concatenate([smooth - columns[:, :DYNAMIC] @ run.payload[:DYNAMIC], smooth])
    correlation = max(1.0, timing.frame_rate_hz / (2 * filtering.cutoff_hz))
    return TorqueEquations(matrix, right, np.concatenate([joint, joint + 6]), correlation, rows)


def prior_of(guess: StartingGuess) -> tuple[Array, Array]:
    """Values (73,) and standard deviations (73,) of the unknowns before the experiment."""
    values = np.concatenate([guess.values, np.zeros(6)])
    return values, np.concatenate([guess.std, np.full(6, FREE_TORQUE_N_M)])


def lower_bounds() -> Array:
    """Lower bounds (73,): parameters and gains are not negative, starting torques are free."""
    return np.concatenate([np.zeros(len(NAMES)), np.full(6, -np.inf)])


def nearest_admissible(unknowns: Array, information: Array, scale: Array) -> Array:
    """Unknowns (73,) within their bounds that are nearest in the metric of the information matrix (73, 73)."""
    lower = lower_bounds()
    if (unknowns >= lower).all():
        return unknowns
    factor = np.linalg.cholesky(information * np.outer(scale, scale)).T
    solved = lsq_linear(factor, factor @ (unknowns / scale), bounds=(lower / scale, np.inf), method="bvls")
    return np.maximum(solved.x * scale, lower)
