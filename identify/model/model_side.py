"""Model's side of a scenario: robot and loop as the estimator knows them."""

from dataclasses import dataclass, replace

import xarray as xr

from dynamics import Robot
from dynamics.closed_loop import LoopSettings
from identify.loop_parameters import carrying, drives_of, in_form, loop_settings
from identify.record.checks import fewest_frames
from identify.record.provenance import recorded_scenario
from identify.scenario import Filter, Model, Scenario, Timing
from identify.scenario.plant_sections import DriveName


@dataclass(frozen=True)
class ModelSide:
    """Robot and loop as the estimator knows them, and its settings for reading a record.

    robot          Robot with its known geometry.
    settings       Settings of the loop around the model. Its mean latency is used if a record does
                   not state when commands acted.
    model          Parameter set of the initial guess, standard deviations of errors, and the law of
                   the drives, which can be left open.
    timing         Timing of the frames. In addition to the timing in `settings`, it has the
                   standard deviations of the latency and of the clock.
    low_pass       Filter of the measured poses in all linear fits.
    nuisances      Kinds of errors that all poses have in common. They are estimated with the
                   parameters.
    fewest_frames  Smallest number of frames of a record for an identification.
    """

    robot: Robot
    settings: LoopSettings
    model: Model
    timing: Timing
    low_pass: Filter
    nuisances: tuple[str, ...]
    fewest_frames: int

    def with_drive(self, law: DriveName) -> "ModelSide":
        """Return a copy with an identified law of the drives, if the model leaves the law open."""
        model = self.model.with_drive(law)
        drives = drives_of(model, self.settings.drives.torque_limit)
        return replace(self, model=model, settings=replace(self.settings, drives=drives))


def model_side(robot: Robot, scenario: Scenario) -> ModelSide:
    """Return the model's side of a scenario.

    Raises the ScenarioErrors of `in_form` and `loop_settings`.
    """
    model = scenario.model
    anchor = scenario.identification.scale_anchor
    robot = carrying(in_form(robot, model), scenario.payload, anchor)
    timing = scenario.timing
    return ModelSide(
        robot=robot,
        settings=loop_settings(robot, scenario.servo, timing, scenario.control, model),
        model=model,
        timing=timing,
        low_pass=scenario.filter,
        nuisances=tuple(scenario.identification.nuisances),
        fewest_frames=fewest_frames(timing, scenario.filter, scenario.excitation),
    )


def side_of_record(side: ModelSide, record: xr.Dataset) -> ModelSide:
    """Return a model's side with the timing, the servo and the torque limit of another record.

    Raises RecordError if the record does not state its scenario.
    """
    own = recorded_scenario(record)
    settings = loop_settings(side.robot, own.servo, own.timing, own.control, side.model)
    return replace(side, timing=own.timing, settings=settings)
