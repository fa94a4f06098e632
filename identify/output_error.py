"""Closed-loop output error: measured poses against those of a model that closes its own loop (eq. 32, figure 3).

The residuals are the pose differences whitened by the sensor's covariance, and one row for each thing known beside the
poses: the starting guess, with its standard deviations, and the scale anchor. The model is deterministic; it runs with
an ideal sensor of the same sampling and delay.
"""

from dataclasses import dataclass

import numpy as np

from dynamics import DynamicsError, Robot
from dynamics.closed_loop import LoopSettings, Reference, simulate
from identify.arrays import Array
from identify.loop_parameters import StartingGuess, index_of
from identify.scale_anchor import ScaleAnchor


@dataclass(frozen=True)
class OutputErrorProblem:
    """Least-squares problem in the 67 parameters, for `bounded_least_squares.minimise`.

    measured: poses (N, 6), NaN where lost; ok (N,) bool; covariance: of one measured pose (6, 6).
    """

    robot: Robot
    settings: LoopSettings
    reference: Reference
    measured: Array
    ok: Array
    covariance: Array
    guess: StartingGuess
    anchor: ScaleAnchor

    def model_poses(self, parameters: Array) -> Array:
        """Poses (N, 6) of the model. Raises LoopFailure where it is unstable."""
        return simulate(self.robot, parameters, self.reference, self.settings).pose

    def cost(self, parameters: Array) -> float:
        """Sum of squared whitened residuals; infinite where the model cannot run."""
        try:
            poses = self.model_poses(parameters)
        except DynamicsError:
            return np.inf
        known, _ = self._known(parameters)
        return float(np.sum(self.whitened(poses) ** 2) + known @ known)

    def linearise(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost and the triangular form of its linearisation, see `bounded_least_squares.Problem`."""
        residual, jacobian = self.residuals(parameters)
        known, known_jacobian = self._known(parameters)
        stacked = np.vstack([jacobian.reshape(-1, len(parameters)), known_jacobian])
        right = np.concatenate([residual.ravel(), known])
        factor = np.linalg.qr(np.column_stack([stacked, right]), mode="r")
        size = len(parameters)
        return float(right @ right), factor[:size, :size], factor[:size, size]

    def residuals(self, parameters: Array) -> tuple[Array, Array]:
        """Whitened pose residuals model - measurement (n, 6) of the good frames, and their Jacobian (n, 6, 67)."""
        run = simulate(self.robot, parameters, self.reference, self.settings, sensitivities=True)
        assert run.pose_sensitivity is not None
        jacobian = np.einsum("ij,njp->nip", self._whitener, run.pose_sensitivity[self.ok], optimize=True)
        return self.whitened(run.pose), jacobian

    def whitened(self, poses: Array) -> Array:
        """(poses - measured) of the good frames in standard deviations of the sensor, (n, 6)."""
        return (poses[self.ok] - self.measured[self.ok]) @ self._whitener.T

    @property
    def _whitener(self) -> Array:
        return np.linalg.inv(np.linalg.cholesky(self.covariance))

    def _known(self, parameters: Array) -> tuple[Array, Array]:
        """Rows of the starting guess and of the scale anchor, in their standard deviations."""
        place = index_of(self.anchor.parameter)
        rows = np.vstack([np.diag(1 / self.guess.std), np.eye(1, len(parameters), place) / self.anchor.std])
        values = np.append(self.guess.values / self.guess.std, self.anchor.value / self.anchor.std)
        return rows @ parameters - values, rows
