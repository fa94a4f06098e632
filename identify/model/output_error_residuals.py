"""Residuals of the output error: whitened differences of modelled and measured poses (eq. 32).

The residuals of the good frames are whitened with the covariance of the sensor's noise, and then
with that of the errors that all measured poses have in common (`Marginal`).
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun
from dynamics.parameters import RigidGroups
from identify.arrays import Array
from identify.model.known_runs import KnownRuns
from identify.record.stored_common_errors import Marginal


class Residuals:
    """Residuals of a model of a recorded run, and their derivatives.

    `LoopModel` has these attributes, and describes them.
    """

    robot: Robot
    measured: Array
    ok: NDArray[np.bool_]
    covariance: Array
    driven: bool
    drawn: Array | None
    marginal: Marginal | None
    groups: RigidGroups | None

    def simulate(
        self,
        parameters: Array,
        sensitivities: bool = False,
        robot: Robot | None = None,
    ) -> ClosedLoopRun:
        """Simulate the model. Raises LoopFailure if the run is unstable."""
        raise NotImplementedError

    def residuals(self, parameters: Array, ahead: bool = False) -> Array:
        """Return the whitened residuals model - measurement (n, 6) of the good frames.

        With `ahead`, the run also computes the sensitivities that `linearised` will need.
        Raises LoopFailure if the model is unstable.
        """
        return self.without_common(self.noise_residuals(parameters, ahead))

    def noise_residuals(self, parameters: Array, ahead: bool = False) -> Array:
        """Return the residuals (n, 6) as `residuals`, but whitened by the noise alone."""
        return self.run_residuals(self._latest_run(parameters, sensitivities=ahead))

    def _latest_run(self, parameters: Array, sensitivities: bool) -> ClosedLoopRun:
        """Return the model's run, cached for repeated parameters. Raises LoopFailure."""
        return self.known_runs.latest(parameters, sensitivities, self.simulate)

    @cached_property
    def known_runs(self) -> KnownRuns:
        """Latest runs of the model."""
        return KnownRuns()

    def white_residuals(self, parameters: Array, rng: np.random.Generator) -> Array:
        """Return `residuals` (n, 6) of a model driven by commands, white if the model is right.

        rng: generator for a subclass that fits states to the poses. Raises LoopFailure.
        """
        return self.residuals(parameters)

    def linearised(self, parameters: Array) -> tuple[Array, Array]:
        """Return the `residuals` (n, 6), and their derivatives (n, 6, k) for `of_all`."""
        residual, jacobian = self._noise_linearised(parameters)
        return self.without_common(residual), self.without_common(jacobian)

    def of_all(self, shown: Array) -> Array:
        """Return derivatives (..., p) by all parameters from those by pivots and ungrouped ones."""
        if self.groups is None or shown.shape[-1] == len(self.robot.layout.names):
            return shown
        return self.groups.of_all(shown)

    def noise_linearised(self, parameters: Array) -> tuple[Array, Array]:
        """Return residuals (n, 6) and their Jacobian (n, 6, p), whitened by the noise alone."""
        residual, jacobian = self._noise_linearised(parameters)
        return residual, self.of_all(jacobian)

    def _noise_linearised(self, parameters: Array) -> tuple[Array, Array]:
        run = self._latest_run(parameters, sensitivities=True)
        assert run.pose_sensitivity is not None
        jacobian = np.asarray(self.whitener @ run.pose_sensitivity[self.ok], dtype=float)
        return self.run_residuals(run), jacobian

    def run_residuals(self, run: ClosedLoopRun) -> Array:
        """Return the residuals (n, 6) of a run of the model, whitened by the noise alone.

        The part due to the common errors in the model is subtracted.
        """
        modelled = run.pose if self.driven or self.drawn is None else run.measured
        residual = self.whiten(modelled - self.measured)
        if self.marginal is None:
            return residual
        return residual - self.marginal.had.reshape(residual.shape)

    def whiten(self, differences: Array) -> Array:
        """Return pose differences (N, 6) at the good frames whitened by the noise, (n, 6)."""
        return np.asarray(differences[self.ok] @ self.whitener.T, dtype=float)

    @property
    def whitened_modes(self) -> Array:
        """Modes (n, 6, k) of a run `with_common_errors`, at the good frames and whitened."""
        count = np.count_nonzero(self.ok)
        if self.marginal is None:
            return np.zeros((count, 6, 0))
        return self.marginal.modes.reshape(count, 6, -1)

    def without_common(self, rows: Array) -> Array:
        """Whiten rows (n, 6, ...) for the common errors. They are whitened by the noise already."""
        if self.marginal is None:
            return rows
        stacked = rows.reshape(len(self.marginal.modes), -1)
        return self.marginal.whiten(stacked).reshape(rows.shape)

    @cached_property
    def whitener(self) -> Array:
        """Matrix W (6, 6) that whitens pose differences: W covariance W^T is the identity."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)), dtype=float)
