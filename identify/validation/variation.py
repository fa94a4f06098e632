"""Variation of the estimates from one trajectory to the next (the paper's table 5).

The robot is identified from each of several runs alone. The paper gives its "variation measure" no
formula; here it is the standard deviation of a parameter's estimates in per cent of their mean.
Judged are the parameters that every run identifies. Beside it stands what each run's own interval
makes one expect. All runs share one weighing of the platform and one teaching of the sensor, as in
the paper: what is wrong with these does not vary.

What varies most are the masses of the links of `rss6`, which accelerations show. By the information
of designed runs at the true parameters (noise in the servo left out), the worst is known to 4.6,
3.5 and 3.1 % from 20, 40 and 60 s at the paper's fundamental of 0.1 Hz, and to 2.4 % from 20 s at
0.3 Hz, which uses the whole velocity limit of 2 rad/s: faster is worth more than longer.
"""

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics import Robot, load_robot
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.identification import identify
from identify.estimation.result import IdentificationResult
from identify.excitation.design import design_trajectories
from identify.experiment.run import Experiment, taught_sensor
from identify.progress import Progress, SilentProgress
from identify.random_streams import DESIGN, stream_seed
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory
from identify.validation.unseen import run_unseen

if TYPE_CHECKING:
    import pandas as pd

FEWEST_RUNS = 3
"""Of fewer runs a standard deviation says nothing."""


@dataclass(frozen=True)
class Variation:
    """Of each parameter (p,), SI: mean of the estimates, their standard deviation relative to it,
    the same as expected from the runs' own intervals, and whether every run identifies it; runs:
    their number."""

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
        """One row a parameter: mean, variation, expected, identified."""
        import pandas as pd

        columns = {
            name: getattr(self, name) for name in ("mean", "variation", "expected", "identified")
        }
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    @property
    def worst(self) -> tuple[str, float]:
        """The identified parameter that varies most, and its variation.

        Raises EstimationError where no parameter is identified in every run.
        """
        if not self.identified.any():
            raise EstimationError(
                f"no parameter is identified in each of the {self.runs} runs: nothing to compare"
            )
        index = int(np.argmax(np.where(self.identified, self.variation, -np.inf)))
        return self.names[index], float(self.variation[index])


def variation(results: Sequence[IdentificationResult]) -> Variation:
    """Variation of estimates from several identifications of one robot.

    Raises EstimationError with fewer than three.
    """
    check_count(len(results))
    estimates = np.array([r.estimate for r in results])
    stds = np.array([r.std for r in results])
    mean = estimates.mean(axis=0)
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
    """Raise EstimationError where so few runs show no variation."""
    if runs < FEWEST_RUNS:
        raise EstimationError(f"{runs} runs show no variation, at least {FEWEST_RUNS} are needed")


def identify_each(
    records: Sequence[xr.Dataset], robot: Robot, scenario: Scenario, progress: Progress
) -> list[IdentificationResult]:
    """Identify from each record alone. Raises as `identify` does, and EstimationError with too few
    records.
    """
    check_count(len(records))
    results = []
    with progress.stage("identify each run", len(records)) as advance:
        for record in records:
            results.append(identify(record, robot, scenario))
            advance()
    return results


def designed_runs(
    scenario: Scenario, robot: Robot, seed: int, count: int, workers: int | None, progress: Progress
) -> list[Experiment]:
    """Run the plant with images in the loop on `count` exciting trajectories, each designed from
    its own random ones.

    As long as the exciting run, by the scenario's method; workers as in `run_unseen`. Raises as the
    stages `excite` and `record` do.
    """
    own = stream_seed(seed, DESIGN)
    seeds = [stream_seed(own, number) for number in range(count)]
    trajectories = []
    with (
        progress.stage("design the runs", count) as advance,
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool,
    ):
        for trajectory in pool.map(partial(_designed, scenario), seeds):
            trajectories.append(trajectory)
            advance()
    lasting = scenario.with_overrides({"validation.duration_s": scenario.excitation.duration_s})
    taught = taught_sensor(lasting, robot, own, progress).taught
    return run_unseen(lasting, tuple(trajectories), own, taught, workers, progress)


def _designed(scenario: Scenario, seed: int) -> FourierTrajectory:
    return design_trajectories(
        load_robot(scenario.robot), scenario, seed, SilentProgress()
    ).excitation
