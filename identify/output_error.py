"""Output error: measured poses against those of the model under the same excitation (eq. 32, figure 3).

Two ways to drive the model. Closed loop, as in the paper: the model has the servo around it and follows the reference
with an ideal sensor of the same sampling, delay and hold, which loses the frames that the real one lost. Command
driven: the joints get the logged commands, so the model feels what the sensor's noise did to the plant.

The residuals are the pose differences whitened by the sensor's covariance, and one row for each thing known beside the
poses: the starting guess, with its standard deviations, and the scale anchor.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynamics import DynamicsError, Robot
from dynamics.closed_loop import ClosedLoopRun, LoopSettings, Reference, simulate
from identify.arrays import Array
from identify.loop_parameters import StartingGuess, index_of
from identify.scale_anchor import ScaleAnchor


@dataclass(frozen=True)
class OutputErrorProblem:
    """Least-squares problem in the 67 parameters, for `bounded_least_squares.minimise`.

    measured: poses (N, 6), NaN where lost; ok (N,) bool; covariance: of one measured pose (6, 6); commands: the logged
    joint commands (N, 6), or None where the model closes its own loop.
    """

    robot: Robot
    settings: LoopSettings
    reference: Reference
    measured: Array
    ok: NDArray[np.bool_]
    covariance: Array
    guess: StartingGuess
    anchor: ScaleAnchor
    commands: Array | None = None

    def driven_by(self, commands: Array | None) -> "OutputErrorProblem":
        """The same problem with the joints driven by commands (N, 6), or by the model's own servo (None)."""
        return replace(self, commands=commands)

    def model_poses(self, parameters: Array) -> Array:
        """Poses (N, 6) of the model. Raises LoopFailure where it is unstable."""
        return self._run(parameters, sensitivities=False).pose

    def cost(self, parameters: Array) -> float:
        """Sum of squared whitened residuals; infinite where the model cannot run."""
        try:
            poses = self.model_poses(parameters)
        except DynamicsError:
            return np.inf
        known, _ = self._known(parameters)
        return float(np.sum(self.whiten(poses - self.measured) ** 2) + known @ known)

    def linearise(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost and the triangular form of its linearisation, see `bounded_least_squares.Problem`."""
        residual, jacobian = self.residuals(parameters)
        known, known_jacobian = self._known(parameters)
        stacked = np.vstack([jacobian.reshape(-1, len(parameters)), known_jacobian])
        right = np.concatenate([residual.ravel(), known])
        factor: Array = np.linalg.qr(np.column_stack([stacked, right]), mode="r")  # type: ignore[assignment]
        size = len(parameters)
        return float(right @ right), factor[:size, :size], factor[:size, size]

    def residuals(self, parameters: Array) -> tuple[Array, Array]:
        """Whitened pose residuals model - measurement (n, 6) of the good frames, and their Jacobian (n, 6, 67)."""
        run = self._run(parameters, sensitivities=True)
        assert run.pose_sensitivity is not None
        jacobian = np.asarray(self._whitener @ run.pose_sensitivity[self.ok], dtype=float)
        return self.whiten(run.pose - self.measured), jacobian

    def whiten(self, differences: Array) -> Array:
        """Pose differences (N, 6) at the good frames in standard deviations of the sensor, (n, 6)."""
        return np.asarray(differences[self.ok] @ self._whitener.T, dtype=float)

    def known_information(self) -> Array:
        """Information (67, 67) of what is known beside the poses."""
        _, rows = self._known(self.guess.values)
        return np.asarray(rows.T @ rows, dtype=float)

    @property
    def _whitener(self) -> Array:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)), dtype=float)

    def _run(self, parameters: Array, sensitivities: bool) -> ClosedLoopRun:
        return simulate(
            self.robot,
            parameters,
            self.reference,
            self.settings,
            sensitivities=sensitivities,
            commands=self.commands,
            lost=~self.ok,
        )

    def _known(self, parameters: Array) -> tuple[Array, Array]:
        """Rows of the starting guess and of the scale anchor, in their standard deviations."""
        place = np.zeros((1, len(parameters)))
        place[0, index_of(self.anchor.parameter)] = 1 / self.anchor.std
        rows = np.vstack([np.diag(1 / self.guess.std), place])
        values = np.append(self.guess.values / self.guess.std, self.anchor.value / self.anchor.std)
        return rows @ parameters - values, rows
