"""Setup of an experiment from a scenario and a seed: robot, plant, sensor, and their runs.

A setup is made once. It can run the experiment repeatedly, and validate the identified model.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import platformdirs
import xarray as xr
from numpy.typing import ArrayLike

import cmmsim
from cmmsim.imaging.renderer import choose_renderer
from dynamics import Robot, load_robot
from dynamics.checks import shown
from identify.arrays import Array
from identify.errors import EstimationError, ScenarioError, WriteError
from identify.estimation.result import IdentificationResult
from identify.excitation.constraints import MotionConstraints
from identify.excitation.criteria import criterion_of
from identify.excitation.design import DesignTask, design_trajectories
from identify.experiment.plant import (
    KnownLoop,
    Plant,
    RunSettings,
    with_command_errors,
    with_springs,
    with_uneven_friction,
)
from identify.experiment.rig_as_known import warn_of_ignored_covariance
from identify.experiment.run import excitation_run
from identify.experiment.sensor_in_loop import SensorPlan, teach
from identify.experiment.true_robot import true_parameters, true_robot, with_true_bodies
from identify.files.atomic import write_bytes
from identify.files.dataset import POSE, netcdf
from identify.loop_parameters import carrying, in_form, loop_settings
from identify.model.model_side import ModelSide, model_side
from identify.progress import Progress, SilentProgress
from identify.random_streams import integer_seed
from identify.record import recording
from identify.record.known_geometry import KnownGeometry, known_geometry
from identify.scenario import Scenario
from identify.trajectory import TrajectorySet
from identify.validation.unseen import errors_of_model

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class UnseenErrors:
    """Errors of a model on the validation trajectories.

    poses (runs, N, 6): pose of the model minus pose of the plant, m and rad. A run is NaN if the
    loop of the model is unstable.
    """

    poses: Array

    def rms(self) -> pd.Series:
        """Return the root mean square of each coordinate over all runs and frames, um and urad."""
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
    """Parts of the experiment that a scenario describes. `set_up` makes a setup.

    Each part is made at its first use. Functions that run, design, measure or track get the parts
    that they read, and not the scenario.

    Attributes
    ----------
    scenario : Scenario
        Scenario with the renderer of this machine in place of "auto".
    seed : int
        Seed of all random numbers.
    loaded : Robot, optional
        Robot of the scenario, if it is loaded already.
    calibrated : KnownGeometry, optional
        Known geometry that replaces the known geometry of the scenario.
    progress : Progress, optional
        Display of the progress of a camera calibration.
    """

    scenario: Scenario
    seed: int = 0
    loaded: Robot | None = None
    calibrated: KnownGeometry | None = None
    progress: Progress | None = None

    def on_this_machine(self) -> Setup:
        """Return a copy with the renderer of this machine in place of "auto".

        Warns if OpenGL is missing and "auto" therefore means the analytic renderer.
        """
        renderer = choose_renderer(self.scenario.renderer).name
        return replace(self, scenario=self.scenario.with_overrides({"renderer": renderer}))

    @cached_property
    def in_file(self) -> Robot:
        """The robot as its file describes it, with a full body as platform if the load needs it."""
        scenario = self.scenario
        robot = self.loaded or load_robot(scenario.robot)
        return carrying(robot, scenario.payload, scenario.identification.scale_anchor)

    @cached_property
    def nominal(self) -> Robot:
        """The robot of the file, with bodies, passive friction and gains as the model states."""
        return in_form(self.in_file, self.scenario.model)

    @cached_property
    def known(self) -> KnownGeometry:
        """The robot as servo and estimator know it, with the covariance of its geometry."""
        return self.calibrated or known_geometry(self.nominal, self.scenario.geometry)

    @property
    def robot(self) -> Robot:
        """The robot as servo and estimator know it."""
        return self.known.robot

    @cached_property
    def side(self) -> ModelSide:
        """The robot and its loop as the estimator knows them."""
        return model_side(self.robot, self.scenario)

    @cached_property
    def plant(self) -> Plant:
        """The true robot in its loop, which no estimator sees."""
        scenario = self.scenario
        switches = scenario.plant
        timing = scenario.timing
        control = scenario.control
        identification = scenario.identification
        robot = true_robot(self.nominal, switches, scenario.geometry, self.known, self.seed)
        robot = with_true_bodies(robot, self.in_file, switches)
        settings = loop_settings(self.nominal, scenario.servo, timing, control, switches)
        settings = with_uneven_friction(settings, robot, switches)
        return Plant(
            nominal=self.robot,
            settings=with_command_errors(
                with_springs(settings, self.nominal, switches),
                self.nominal,
                switches,
                zeros=scenario.geometry.exact,
            ),
            robot=robot,
            parameters=true_parameters(robot, switches),
            switches=switches,
            loop=KnownLoop(
                side=self.side,
                prior=identification.prior,
                # Model and plant have the same drives, so either of them can state the filter.
                filter_time=scenario.model.derivative_filter_s or switches.derivative_filter_s,
                control=control,
            ),
            runs=RunSettings(
                timing=timing,
                limits=scenario.excitation.singularity_limits,
                rig=scenario.rig,
                anchor=identification.scale_anchor,
                anchor_std=identification.anchor_std,
                scenario_toml=scenario.to_toml(),
            ),
            geometry_covariance=self.known.covariance,
        )

    @cached_property
    def sensor_plan(self) -> SensorPlan:
        """Description of the sensor to be made."""
        scenario = self.scenario
        file = scenario.sensor_file()
        warn_of_ignored_covariance(scenario.rig, file, scenario.sensor)
        return SensorPlan(
            name=scenario.sensor,
            file=file,
            renderer=scenario.renderer,
            method=scenario.pose_method,
            rig=scenario.rig,
            frames=scenario.timing.frames(scenario.excitation.duration_s),
        )

    @cached_property
    def sensor(self) -> cmmsim.Sensor:
        """The stereo sensor. A run teaches it, unless it has been taught before."""
        return self.sensor_plan.untaught(self.robot, self.seed, self.progress)

    @cached_property
    def design(self) -> DesignTask:
        """The task of choosing trajectories."""
        scenario = self.scenario
        return DesignTask(
            robot=self.robot,
            settings=scenario.excitation,
            validation=scenario.validation,
            limits=MotionConstraints(self.robot, scenario.excitation, self.sensor_plan.sight),
            criterion=partial(criterion_of, self.robot, scenario),
        )

    @cached_property
    def trajectories(self) -> TrajectorySet:
        """The exciting and the validation trajectories, designed at first use."""
        return design_trajectories(self.design, self.seed)

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
            File to which record and truth are written. The default is a file in the user's cache
            folder, named after scenario and seed. The next run with the same names replaces it.
        progress : Progress, optional
            Display of the progress.
        payload : bool
            True if the platform carries the scenario's known load. A record with the load and a
            record without it determine the scale. The record holds the stated load. The truth holds
            the actual load, which is drawn with the load's standard deviations.

        Returns
        -------
        xarray.Dataset
            Record of the run. Its attribute ``path`` names the file, and ``record.truth`` reads the
            truth from this file.

        Raises
        ------
        ScenarioError, TrajectoryError, WriteError, cmmsim.CmmError, dynamics.DynamicsError
            The experiment cannot be run, or its file cannot be written.

        Warns
        -----
        UserWarning
            The cache folder cannot be written. The record then has no file and no truth.
        """
        progress = progress or SilentProgress()
        trajectory = self.trajectories.excitation
        teach(self.sensor, progress)
        settings = self.scenario.excitation
        load = self.scenario.payload if payload else None
        with progress.stage("record", self.sensor_plan.frames) as advance:
            done = excitation_run(
                self.plant, self.sensor, trajectory, settings, self.seed, advance, load
            )
        content = netcdf(recording.record_groups(done.record, done.truth))
        if path is not None:
            write_bytes(path, content, parents=True)
            return done.record.assign_attrs(path=str(path))
        # `record.truth` reads the truth from a file, so every record needs a file.
        kept = Path(platformdirs.user_cache_dir("cmmsim")) / "records"
        suffix = "-payload" if payload else ""
        target = kept / f"{self.scenario.name}-{self.seed}{suffix}.nc"
        try:
            write_bytes(target, content, parents=True)
        except WriteError as error:
            warnings.warn(f"the record is not stored: {error}", stacklevel=2)
            return done.record
        return done.record.assign_attrs(path=str(target))

    def unseen_errors(self, result: IdentificationResult) -> UnseenErrors:
        """Run plant and identified model on the validation trajectories, with an ideal sensor.

        Raises
        ------
        EstimationError
            The argument is not an IdentificationResult.
        dynamics.DynamicsError
            The result is of another robot, or its parameters are outside their range.
        """
        if not isinstance(result, IdentificationResult):
            raise EstimationError(
                "unseen_errors needs a result, as identify.identify(record) returns it, got "
                f"{type(result).__name__}"
            )
        scenario = self.scenario.with_drive(result.drive.law)
        return UnseenErrors(unseen_errors(result.estimate, self.in_file, scenario, self.seed))


def set_up(
    scenario: Scenario, seed: int | np.random.SeedSequence = 0, progress: Progress | None = None
) -> Setup:
    """Make the robot, the plant and the sensor of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Scenario, for example from `load_scenario`.
    seed : int or numpy.random.SeedSequence
        Seed of all random numbers. A row of a study gets a SeedSequence.
    progress : Progress, optional
        Display of the progress of a camera calibration.

    Returns
    -------
    Setup
        The setup. Its method `run` makes a record, and `unseen_errors` validates a result.

    Raises
    ------
    ScenarioError
        The argument is not a Scenario, or the plant or sensor of the scenario cannot be made.
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
        raise ScenarioError(
            f"{shown(scenario)} is not a scenario: identify.load_scenario(name) returns one"
        )
    setup = Setup(scenario, integer_seed(seed), progress=progress).on_this_machine()
    # Errors of the plant or the sensor are raised here, and not at their first use.
    _ = setup.plant, setup.sensor
    return setup


def run_experiment(
    scenario: Scenario,
    seed: int | np.random.SeedSequence = 0,
    path: Path | str | None = None,
    progress: Progress | None = None,
    payload: bool = False,
) -> xr.Dataset:
    """Run the experiment of a scenario once, and return its record.

    For parameters and errors see `set_up` and `Setup.run`.

    Examples
    --------
    >>> import identify
    >>> scenario = identify.load_scenario("quick", renderer="statistical")
    >>> identify.run_experiment(scenario, seed=0).sizes["time"]
    600
    """
    return set_up(scenario, seed, progress).run(path, progress, payload)


def unseen_errors(parameters: ArrayLike, robot: Robot, scenario: Scenario, seed: int = 0) -> Array:
    """Return the pose errors (runs, N, 6) [m, rad] of a model against the plant.

    Both run on the scenario's validation trajectories for this seed, each with its own friction law
    and integration steps. An ideal sensor closes both loops, so the errors are caused only by the
    parameters (p,) and by effects that the model lacks. The errors of a run are NaN if, and only
    if, the model's loop is unstable.

    Raises dynamics.DynamicsError for parameters of another shape, not finite, or outside their
    range. Raises TrajectoryError if no validation trajectory is within the robot's limits.
    """
    setup = Setup(scenario, seed, loaded=robot)
    return errors_of_model(parameters, setup.plant, setup.design, seed)
