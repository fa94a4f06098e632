"""One case of the gauntlet: a record with trouble, its diagnosis, and the model after remedies."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import xarray as xr

from dynamics import DynamicsError
from identify.diagnosis.diagnose import diagnose
from identify.diagnosis.diagnosis import Diagnosis, Finding
from identify.errors import IdentifyError, ScenarioError
from identify.estimation.identification import identify
from identify.experiment.plant import Plant
from identify.experiment.run import excitation_run
from identify.random_streams import child, integer_seed
from identify.scenario import scenario_from_toml
from identify.setup import Setup
from identify.studies.rows.coverage import intervals_hold
from identify.studies.rows.gauntlet.drawn_troubles import Wrong, drawn_troubles
from identify.studies.rows.gauntlet.trouble import Laboratory, Remedied, Trouble, typed
from identify.studies.rows.identified import designed_trajectories, row_setup
from identify.studies.rows.kind import robot_named
from identify.studies.rows.row_sensor import DrawnSensor

# Random streams of a case: its trouble, its record, and the record after something was mended.
TROUBLE = 0
RECORD = 1
AGAIN = 2
DRAWS = 10  # largest number of draws of a case until the robot can run


@dataclass(frozen=True)
class Recorded:
    """Record of a case, and the plant that made it."""

    record: xr.Dataset
    plant: Plant


@dataclass(frozen=True)
class Case:
    """Finished case.

    troubles       What was wrong.
    diagnosis      What the diagnosis of the plain model said.
    named          For each trouble, the number of the finding that names it, from 1 on, or 0 if
                   none does.
    together       For each trouble, True if that finding only names it as indistinguishable from
                   its cause.
    size_errors    Error of each trouble's size in standard deviations, NaN where it was not fitted.
    before, after  Whether each interval contains the truth, with the plain model and after the
                   remedy. Both are the same if no finding names a trouble. `after` is empty if an
                   error stops the remedy.
    explained      True if noise explains the residuals of the model to which `after` belongs.
    alone          For each of two troubles, the misfit of the plain model with this trouble only,
                   divided by the misfit due to noise. NaN if the model cannot be identified.
    seconds        Time of the first identification and of the diagnosis, s.
    """

    troubles: tuple[Trouble, ...]
    diagnosis: Diagnosis
    named: tuple[int, ...]
    together: tuple[bool, ...]
    size_errors: tuple[float, ...]
    before: tuple[bool, ...]
    after: tuple[bool, ...]
    explained: bool
    alone: tuple[float, ...]
    seconds: tuple[float, float]


@dataclass(frozen=True)
class Drawn:
    """Troubles of a case, and its record.

    number, again: seeds of this record, and of the record after something was mended.
    """

    lab: Laboratory
    troubles: tuple[Trouble, ...]
    made: Recorded
    number: int
    again: int


def drawn(lab: Laboratory, seed: np.random.SeedSequence, wrong: Wrong) -> Drawn:
    """Draw a case of a laboratory from its seed, and make its record.

    Troubles with which the robot cannot follow its trajectory are drawn again, because a laboratory
    would have no record of them. wrong: sort of case.

    Raises a DynamicsError if none of `DRAWS` draws gives a record.
    """
    rng = np.random.default_rng(child(seed, TROUBLE))
    record, again = (integer_seed(child(seed, stream)) for stream in (RECORD, AGAIN))
    for left in reversed(range(DRAWS)):
        troubles = drawn_troubles(lab, rng, wrong)
        try:
            made = recorded(lab, troubles, record)
        except DynamicsError:
            if not left:
                raise
        else:
            break
    return Drawn(lab, troubles, made, record, again)


def run_case(case: Drawn) -> Case:
    """Identify from the record of a case, diagnose, remedy what was found, and identify again.

    The remedy is left out if no finding names a trouble. Raises EstimationError, and the exceptions
    of the model. An error after the remedy is caught, and the case then has no intervals.
    """
    scenario = case.lab.scenario
    made = case.made
    plain = Setup(scenario, loaded=robot_named(scenario.robot)).robot
    began = time.perf_counter()
    result = identify(made.record, plain, scenario)
    identified = time.perf_counter()
    diagnosis = diagnose(made.record, result, plain, scenario)
    seconds = (identified - began, time.perf_counter() - identified)
    named_by = tuple(place_of(one, diagnosis) for one in case.troubles)
    remedies = [
        trouble.remedy(diagnosis.findings[number - 1]) if number else Remedied()
        for trouble, (number, _) in zip(case.troubles, named_by, strict=True)
    ]
    named = {number for number, _ in named_by}
    # a laboratory cannot know which findings are right, so it also applies the other remedies
    remedies += [
        Remedied(typed(one).settings)
        for number, one in enumerate(diagnosis.findings, start=1)
        if number not in named
    ]
    before = intervals_hold(result, made.plant)
    after = before
    explained = result.explained
    if any(number for number, _ in named_by):
        after, explained = after_remedies(case, remedies)
    return Case(
        troubles=case.troubles,
        diagnosis=diagnosis,
        named=tuple(number for number, _ in named_by),
        together=tuple(alike for _, alike in named_by),
        size_errors=tuple(size_error(one, diagnosis) for one in case.troubles),
        before=before,
        after=after,
        explained=explained,
        alone=misfits_alone(case),
        seconds=seconds,
    )


@lru_cache(maxsize=4)
def laboratory(scenario_toml: str, trajectory: int) -> Laboratory:
    """Return the laboratory of a scenario without trouble. It is made once per process.

    Its robot runs the exciting trajectory once, which gives the largest torques of motion and of
    rest. trajectory: seed of the trajectory.

    Raises ScenarioError if the scale needs a second record.
    """
    scenario = scenario_from_toml(scenario_toml)
    if scenario.identification.scale_anchor == "payload":
        raise ScenarioError(
            "identification.scale_anchor = 'payload' needs a second record, and a case of the "
            "gauntlet has one"
        )
    setup = row_setup(scenario, 0)
    motion = designed_trajectories(setup, trajectory).excitation
    times = scenario.timing.frame_times(scenario.excitation.duration_s)
    run = setup.plant.run(motion.reference(times))
    plant = setup.plant
    dynamic = plant.parameters[plant.robot.layout.dynamic]
    holding = max(float(np.abs(plant.robot.static_torque(one, dynamic)).max()) for one in run.pose)
    peak = float(np.abs(run.torque).max())
    return Laboratory(setup.robot, plant.parameters, scenario, trajectory, peak, holding)


def recorded(lab: Laboratory, troubles: Sequence[Trouble], number: int) -> Recorded:
    """Make the record of a laboratory with troubles, from the seed `number`.

    The record names the scenario without troubles, because an experimenter knows no other.
    """
    scenario = lab.scenario
    settings = {key: value for one in troubles for key, value in one.settings.items()}
    setup = row_setup(scenario.with_overrides(settings), number)
    plant = setup.plant
    for one in troubles:
        plant = one.plant(plant)
    motion = designed_trajectories(row_setup(scenario, number), lab.trajectory).excitation
    covariance = setup.sensor_plan.covariance(setup.nominal.home_pose)
    sensor = DrawnSensor(covariance, plant.runs.timing.dropout)
    record = excitation_run(plant, sensor, motion, scenario.excitation, number).record
    for one in troubles:
        record = one.record(record)
    return Recorded(record.assign_attrs(scenario=scenario.to_toml()), plant)


def after_remedies(case: Drawn, remedies: Sequence[Remedied]) -> tuple[tuple[bool, ...], bool]:
    """Return `Case.after` and `Case.explained` for remedies.

    remedies: first those of the case's troubles, in the order of the troubles, then those of other
    findings. A new record is made if a trouble is mended.
    """
    pairs = zip(case.troubles, remedies, strict=False)
    left = [one for one, remedy in pairs if not remedy.mended]
    settings = {key: value for one in remedies for key, value in one.settings.items()}
    made = case.made
    try:
        if len(left) < len(case.troubles):
            made = recorded(case.lab, left, case.again)
        scenario = case.lab.scenario.with_overrides(settings)
        record = made.record.assign_attrs(scenario=scenario.to_toml())
        for one in remedies:
            record = one.record(record)
        robot = Setup(scenario, loaded=robot_named(scenario.robot)).robot
        result = identify(record, robot, scenario)
    except (IdentifyError, DynamicsError):
        return (), False
    return intervals_hold(result, made.plant), result.explained


def misfits_alone(case: Drawn) -> tuple[float, ...]:
    """Return the misfit with each of two troubles alone, see `Case.alone`, or nothing."""
    if len(case.troubles) < 2:
        return ()
    known = case.lab.scenario.with_overrides({"identification.method": "command_driven"})
    plain = Setup(known, loaded=robot_named(known.robot)).robot
    found = []
    for one in case.troubles:
        try:
            made = recorded(replace(case.lab, scenario=known), [one], case.number)
            misfit = identify(made.record, plain, known).driven_misfit
        except (IdentifyError, DynamicsError):
            found.append(float("nan"))
        else:
            found.append(misfit.found / misfit.expected)
    return tuple(found)


def place_of(trouble: Trouble, found: Diagnosis) -> tuple[int, bool]:
    """Return the number of the finding that names a trouble, from 1 on, or 0 if none does.

    The second result is True if the finding only names it as indistinguishable from its own cause.
    """
    groups = {one.name: one.group for one in found.candidates}
    for number, finding in enumerate(found.findings, start=1):
        if finding.group in trouble.groups:
            return number, False
        if any(groups.get(name) in trouble.groups for name in finding.alike):
            return number, True
    return 0, False


def size_error(trouble: Trouble, found: Diagnosis) -> float:
    """Return the error of a fitted size in standard deviations, NaN if it was not fitted."""
    for size in (size for finding in found.findings for size in finding.sizes):
        if trouble.cause and size.name == trouble.cause and size.std > 0:
            return (size.value - trouble.size) / size.std
    return float("nan")


def first_group(findings: Sequence[Finding]) -> str:
    """Return the group of the first finding, or an empty text if there is none."""
    return findings[0].group if findings else ""
