"""From a scenario and a seed to the robot, its plant and its sensor, and to what they do together.

The set-up is made once. It runs the experiment as often as one likes, and judges what was
identified from the record.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import platformdirs
import xarray as xr

import cmmsim
from dynamics import Robot
from identify.arrays import Array
from identify.errors import EstimationError, ScenarioError, WriteError
from identify.estimation.result import IdentificationResult
from identify.excitation.design import design_trajectories
from identify.experiment.plant import Plant, build_plant
from identify.experiment.run import excitation_run, teach, untaught_sensor
from identify.experiment.sensor_in_loop import with_renderer
from identify.files.atomic import write_bytes
from identify.files.dataset import POSE, netcdf
from identify.progress import Progress, SilentProgress
from identify.random_streams import integer_seed
from identify.record import recording
from identify.scenario import Scenario
from identify.trajectory import TrajectorySet
from identify.validation.unseen import unseen_errors

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class UnseenErrors:
    """Errors of a model on trajectories that it never saw.

    poses (runs, N, 6): pose of the model less that of the plant, m and rad; NaN where the loop of
    the model is unstable.
    """

    poses: Array

    def rms(self) -> pd.Series:
        """Root mean square over all runs and frames of each coordinate, um and urad."""
        import pandas as pd

        names = [
            f"{name}_{unit}" for name, unit in zip(POSE, 3 * ["um"] + 3 * ["urad"], strict=True)
        ]
        return pd.Series(
            1e6 * np.sqrt(np.mean(self.poses**2, axis=(0, 1))), index=names, name="rms"
        )

    def __repr__(self) -> str:
        runs, frames, _ = self.poses.shape
        worst = self.rms()
        return (
            f"UnseenErrors({runs} runs of {frames} frames, rms at most {worst[:3].max():.3g} um "
            f"and {worst[3:].max():.3g} urad)"
        )


@dataclass(frozen=True, eq=False)
class Setup:
    """Robot, plant and sensor of a scenario; `set_up` makes it.

    scenario: with the renderer chosen. seed: of all that is random. plant: the true robot in its
    loop, which no estimator sees. sensor: the stereo sensor, taught when it is first needed.
    """

    scenario: Scenario
    seed: int
    plant: Plant
    sensor: cmmsim.Sensor

    @property
    def robot(self) -> Robot:
        """The robot as servo and estimator know it."""
        return self.plant.nominal

    @cached_property
    def trajectories(self) -> TrajectorySet:
        """The exciting trajectory and the unseen ones, searched when they are first asked for."""
        return design_trajectories(self.robot, self.scenario, self.seed)

    def run(
        self,
        path: Path | str | None = None,
        progress: Progress | None = None,
        payload: bool = False,
    ) -> xr.Dataset:
        """Run the exciting trajectory with images in the loop, and return the record.

        Parameters
        ----------
        path : str or Path, optional
            File to which record and truth are written. The default is one in the user's cache
            folder, named after scenario and seed, which the next such run replaces.
        progress : Progress, optional
            Where the progress is shown.
        payload : bool
            True carries the scenario's known load on the platform. Such a record beside one
            without it shows the scale. The record holds the load as stated, the truth as drawn
            from its standard deviations.

        Returns
        -------
        xarray.Dataset
            What the experimenter sees. Its attribute ``path`` names the file, and ``record.truth``
            reads the truth from there.

        Raises
        ------
        ScenarioError, TrajectoryError, WriteError, cmmsim.CmmError, dynamics.DynamicsError
            The experiment cannot be done, or its file cannot be written.

        Warns
        -----
        UserWarning
            The cache folder cannot be written, so that the record has no file and no truth.
        """
        progress = progress or SilentProgress()
        trajectory = self.trajectories.excitation
        teach(self.sensor, progress)
        frames = self.scenario.timing.frames(self.scenario.excitation.duration_s)
        with progress.stage("record", frames) as advance:
            done = excitation_run(self.plant, self.sensor, trajectory, self.seed, advance, payload)
        content = netcdf(recording.record_groups(done.record, done.truth))
        if path is not None:
            write_bytes(path, content, parents=True)
            return done.record.assign_attrs(path=str(path))
        kept = Path(platformdirs.user_cache_dir("cmmsim")) / "records"
        suffix = "-payload" if payload else ""
        target = kept / f"{self.scenario.name}-{self.seed}{suffix}.nc"
        try:
            write_bytes(target, content, parents=True)
        except WriteError as error:
            warnings.warn(f"the record is not kept: {error}", stacklevel=2)
            return done.record
        return done.record.assign_attrs(path=str(target))

    def unseen_errors(self, result: IdentificationResult) -> UnseenErrors:
        """Run plant and identified model on the unseen trajectories, both with an ideal sensor.

        Raises
        ------
        EstimationError
            The argument is no result of an identification.
        dynamics.DynamicsError
            The result is of another robot, or no loop can have its parameters.
        """
        if not isinstance(result, IdentificationResult):
            raise EstimationError(f"{result!r} is no result: identify.identify(record) gives one")
        scenario = self.scenario.with_drive(result.drive.law)
        return UnseenErrors(unseen_errors(result.estimate, self.robot, scenario, self.seed))


def set_up(
    scenario: Scenario, seed: int | np.random.SeedSequence = 0, progress: Progress | None = None
) -> Setup:
    """Make the robot, the plant and the sensor of a scenario.

    Parameters
    ----------
    scenario : Scenario
        What `load_scenario` returns.
    seed : int or numpy.random.SeedSequence
        Seed of all that is random, such as what a row of a study is given.
    progress : Progress, optional
        Where a calibration of the cameras shows its progress.

    Returns
    -------
    Setup
        Its `run` makes a record, its `unseen_errors` judge a result.

    Raises
    ------
    ScenarioError
        The argument is no scenario, or its plant or sensor cannot be made.
    cmmsim.CmmError, dynamics.DynamicsError
        The files of sensor or robot are not valid.

    Examples
    --------
    >>> import identify
    >>> setup = identify.set_up(identify.load_scenario("quick", renderer="analytic"), seed=0)
    >>> setup.robot.name
    'rss6'
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"{scenario!r} is no scenario: identify.load_scenario(name) gives one")
    number = integer_seed(seed)
    chosen = with_renderer(scenario)
    plant = build_plant(chosen, seed=number)
    sensor = untaught_sensor(chosen, plant.nominal, number, progress)
    return Setup(chosen, number, plant, sensor)


def run_experiment(
    scenario: Scenario,
    seed: int | np.random.SeedSequence = 0,
    path: Path | str | None = None,
    progress: Progress | None = None,
    payload: bool = False,
) -> xr.Dataset:
    """Do the experiment of a scenario once, and return its record.

    The parameters are those of `set_up` and `Setup.run`, and so are the errors.

    Examples
    --------
    >>> import identify
    >>> scenario = identify.load_scenario("quick", renderer="statistical")
    >>> identify.run_experiment(scenario, seed=0).sizes["time"]
    600
    """
    return set_up(scenario, seed, progress).run(path, progress, payload)
