"""Variation of the estimates from trajectory to trajectory (table 5 of the paper).

The robot is identified from each of several runs separately. The paper gives no formula for its
"variation measure". Here it is the standard deviation of a parameter's estimates, divided by the
magnitude of their mean. It is compared with the value that is expected from the standard deviations
of the runs. Only parameters that every run identifies count. As in the paper, all runs share one
weighing of the platform and one teaching of the sensor. The errors of weighing and teaching
therefore do not contribute.

The masses of the links of `rss6` vary most, because they act only through accelerations. The
information of designed runs at the true parameters, without noise in the servo, shows how well the
worst mass can be known. Its standard deviation is 4.6, 3.5 and 3.1 % after 20, 40 and 60 s at the
paper's fundamental of 0.1 Hz. It is 2.4 % after 20 s at 0.3 Hz, with the whole velocity limit of 2
rad/s. A faster motion is thus better than a longer motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.result import IdentificationResult
from identify.progress import Progress

if TYPE_CHECKING:
    import pandas as pd

FEWEST_RUNS = 3  # smallest number of runs for a meaningful standard deviation


@dataclass(frozen=True)
class Variation:
    """Variation of the parameters (p,).

    layout           Names and units of the parameters.
    mean (p,)        Means of the estimates, SI.
    variation (p,)   Standard deviations of the estimates over the magnitude of their means, NaN for
                     a mean of zero.
    expected (p,)    Expected variation according to the standard deviations of the runs.
    identified (p,)  True for parameters that every run identifies.
    runs             Number of runs.
    """

    layout: ParameterLayout
    mean: Array
    variation: Array
    expected: Array
    identified: NDArray[np.bool_]
    runs: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.layout.names

    def __repr__(self) -> str:
        return (
            f"<Variation: {np.sum(self.identified)} of {len(self.names)} parameters identified "
            f"in all {self.runs} runs>"
        )

    def to_dataframe(self) -> "pd.DataFrame":
        """Return a table with one row per parameter: mean, variation, expected, identified."""
        import pandas as pd

        columns = {
            name: getattr(self, name) for name in ("mean", "variation", "expected", "identified")
        }
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    @property
    def worst(self) -> tuple[str, float]:
        """Name and variation of the identified parameter that varies most.

        Raises EstimationError if no parameter is identified in every run.
        """
        if not self.identified.any():
            raise EstimationError(
                f"no parameter is identified in each of the {self.runs} runs: nothing to compare"
            )
        index = int(np.argmax(np.where(self.identified, self.variation, -np.inf)))
        return self.names[index], float(self.variation[index])


def variation(results: Sequence[IdentificationResult]) -> Variation:
    """Return the variation of estimates from several identifications of one robot.

    Raises EstimationError for fewer than three identifications.
    """
    check_count(len(results))
    estimates = np.array([r.estimate for r in results])
    stds = np.array([r.std for r in results])
    mean = estimates.mean(axis=0)
    # A mean of zero has no relative variation.
    size = np.where(mean == 0, np.nan, np.abs(mean))
    return Variation(
        layout=results[0].layout,
        mean=mean,
        variation=estimates.std(axis=0, ddof=1) / size,
        expected=np.sqrt(np.mean(stds**2, axis=0)) / size,
        identified=np.all([r.identifiable for r in results], axis=0),
        runs=len(results),
    )


def check_count(runs: int) -> None:
    """Raise EstimationError if there are too few runs to show variation."""
    if runs < FEWEST_RUNS:
        raise EstimationError(f"{runs} runs show no variation; at least {FEWEST_RUNS} are needed")


def identify_each(
    records: Sequence[xr.Dataset],
    identify: Callable[[xr.Dataset], IdentificationResult],
    progress: Progress,
) -> list[IdentificationResult]:
    """Identify from each record separately.

    Raises the errors of `identify`, and EstimationError for fewer than three records.
    """
    check_count(len(records))
    results = []
    with progress.stage("identify each run", len(records)) as advance:
        for record in records:
            results.append(identify(record))
            advance()
    return results
