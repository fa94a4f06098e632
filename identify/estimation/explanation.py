"""Whether the model explains its records: by the size of what it leaves, and by whether that is white."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.estimation.misfit import Misfit, misfit_of_white
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.whiteness import LAGS, Whiteness, whiteness


@dataclass(frozen=True)
class Explanation:
    """misfit: of the estimate's own residuals; driven_misfit, whiteness: of those of the model that the logged commands
    drive, which feels what the sensor's noise did to the plant."""

    misfit: Misfit
    driven_misfit: Misfit
    whiteness: Whiteness

    @property
    def hidden(self) -> bool:
        """Whether the closed loop hides an error of the model that shows where the logged commands drive it."""
        return self.driven_misfit.decides and not self.misfit.decides

    @property
    def model_holds(self) -> bool:
        """Whether noise, and not an error of the model, makes most of either residual."""
        return not (self.misfit.decides or self.driven_misfit.decides)

    def warnings(self) -> tuple[str, ...]:
        """What the command-driven residuals say beyond the misfit of the estimate's own."""
        driven = self.driven_misfit.warnings("driven by the logged commands, the model") if self.hidden else ()
        return (*driven, *self.whiteness.warnings())


def explanation(driven: OutputErrorProblem, parameters: Array, misfit: Misfit) -> Explanation:
    """Judge the model from the command-driven problem at its own optimum (67,), and the misfit of the estimate.

    Raises EstimationError with too few good frames.
    """
    residuals, ok = _residuals(driven, parameters)
    return Explanation(misfit, misfit_of_white(residuals[ok]), whiteness(residuals, ok))


def _residuals(driven: OutputErrorProblem, parameters: Array) -> tuple[Array, NDArray[np.bool_]]:
    """All whitened residuals (N, 6), NaN where lost, and the good frames (N,): one record after the other, with a gap
    of all lags of the whiteness test between them."""
    gap, residuals, ok = np.full((LAGS, 6), np.nan), [], []
    for run in driven.runs:
        rows = np.full(run.measured.shape, np.nan)
        rows[run.ok] = run.whiten(run.model_poses(parameters) - run.measured)
        residuals += [rows, gap]
        ok += [run.ok, np.zeros(LAGS, dtype=bool)]
    return np.concatenate(residuals), np.concatenate(ok)
