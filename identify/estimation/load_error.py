"""What the error of a known load does to an estimate that takes the load at its stated figures.

Under the load L the model has the parameters p + L: an error of the load moves the residuals of its records by J dL,
with J their Jacobian by the parameters, and the scores by J^T J dL. With S the covariance of the load, the scores
spread by H S H beside the noise, where H = J^T J sums over all records made under this load. The estimate follows the
scores as it follows those of noise (`estimate_covariance`). Where the load shows the scale, a load that is a percent
heavier than stated makes all parameters about a percent too small.
"""

from collections.abc import Sequence

import numpy as np

from identify.arrays import Array
from identify.record.recorded_run import RecordedRun


def load_score_covariance(runs: Sequence[RecordedRun], information: Sequence[Array], units: Array) -> Array:
    """Covariance (p, p) of the scores T^T J^T r that the loads' standard deviations make, to first order.

    information: J^T J (p, p) of each run's residuals; units: T (p, p). Runs that state the same load, equally well
    known, share its error; different loads err independently.
    """
    size = len(units)
    shown: dict[tuple[float, ...], Array] = {}
    for run, one in zip(runs, information, strict=True):
        load = (*run.payload, *run.payload_std)
        shown[load] = shown.get(load, np.zeros((size, size))) + one
    spread = [units.T @ total * np.array(load[size:]) for load, total in shown.items()]
    return np.asarray(sum(one @ one.T for one in spread), dtype=float)
