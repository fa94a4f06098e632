"""Stage that estimates the parameters and their covariance from the records in a run folder."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dynamics import load_robot
from dynamics.closed_loop import LoopFailure
from identify.diagnosis.diagnose import diagnosed
from identify.errors import RecordError
from identify.estimation.common_scale import ENTRY as SCALE
from identify.estimation.common_scale import common_scale
from identify.estimation.explanation import needs_cause
from identify.estimation.identification import Asked, asked_of, identified
from identify.files.atomic import write_figure, write_files
from identify.files.dataset import covariance_netcdf, netcdf, parameter_units
from identify.files.run_folder import (
    RunFolder,
    result_json,
    rms_figures,
)
from identify.files.versions import versions
from identify.progress import Progress
from identify.record import recording
from identify.record.conditions import DRIFT, read_finding
from identify.record.files_of_record import warn_of_changed_robot
from identify.record.from_telemetry import GrossErrors
from identify.record.known_geometry import COVARIANCE as GEOMETRY_COVARIANCE
from identify.record.known_geometry import known_geometry, store_geometry_covariance
from identify.record.model_runs import build_model_run, model_groups
from identify.record.own_record import read_own_records
from identify.record.provenance import ENTRY, RunFiles, digest
from identify.reporting.figures.logs import motion_figure
from identify.scenario import load_scenario
from identify.stages.explain import ENTRY as DIAGNOSIS
from identify.stages.explain import with_diagnosis
from identify.stages.plan import (
    check_planned,
    identified_files,
    open_run,
    own_record_files,
    scenario_file,
)
from identify.validation.unseen import model_on_record


def identify(folder: Path, progress: Progress, settings: Mapping[str, Any] | None = None) -> None:
    """Estimate the parameters from the records of a run, and write result.json and covariance.nc.

    For a user's own record, model.nc is written as well. The result does not contain the truth.

    ``settings`` of the estimator, by dotted path, replace settings of the scenario. After a
    successful identification, scenario.toml holds them for the later stages.

    Raises the errors of `identify.identify` and `RunFolder.require`, and ScenarioError for settings
    that do not belong to the estimator.
    """
    run_folder = RunFolder(folder)
    if run_folder.holds_own_record:
        planned = load_scenario(run_folder.whole_scenario)
        seed = None
    else:
        _, setup, trajectories = open_run(folder)
        planned = setup.scenario
        seed = setup.seed
    scenario = planned.with_estimator_settings(settings or {})
    files = RunFiles(run_folder)
    names = identified_files(run_folder, scenario.identification)
    run_folder.require(*names)
    records = {name: files.content(name) for name in names}
    if seed is not None:
        for name, one in records.items():
            check_planned(run_folder.path / name, one, setup, trajectories)
    known = known_geometry(load_robot(scenario.robot), scenario.geometry, run_folder.path)
    asked = asked_of(list(records.values()), known.robot, scenario)
    warn_of_changed_robot(asked.records[0], asked.side.robot, scenario.robot)
    heading = {
        "scenario": scenario.name,
        "seed": seed,
        "settings": scenario.estimator_settings(),
    }
    results = _identified_files(run_folder, names, asked, heading, progress)
    changed = {} if scenario == planned else scenario_file(run_folder, scenario.to_toml())
    write_files(changed | results)


def identify_own(
    paths: Sequence[Path], folder: Path, progress: Progress, settings: Mapping[str, Any]
) -> None:
    """Estimate the parameters from a user's own records, and write a run folder without the truth.

    Nothing is written if the records are not suitable for an identification. The only exception is
    a picture of a log with too many gross errors.

    Raises the errors of `identify` and of `read_own_records`.
    """
    run_folder = RunFolder(folder)
    try:
        contents, stated = read_own_records(list(paths))
    except GrossErrors as error:
        picture = Path(f"{folder.name}-gross-errors.png")
        good = error.log.ok
        times, measured = error.log.time, error.log.pose
        jumps = times[error.wrong]
        figure = motion_figure(times[good], measured[good], np.zeros((0, 2)), jumps)
        write_figure(picture, figure)
        raise RecordError(f"{error}; {picture} shows them") from None
    scenario = stated.with_estimator_settings(settings)
    names = own_record_files(len(contents), scenario.identification)
    records = dict(zip(names, contents, strict=True))
    known = known_geometry(load_robot(scenario.robot), scenario.geometry)
    for one in contents:
        if known.covariance is not None and GEOMETRY_COVARIANCE not in one:
            store_geometry_covariance(one, known.robot, known.covariance)
    asked = asked_of(contents, known.robot, scenario)
    heading = {
        "scenario": scenario.name,
        "seed": None,
        "settings": scenario.estimator_settings(),
    }
    try:
        results = _identified_files(run_folder, names, asked, heading, progress)
    except LoopFailure as error:
        raise LoopFailure(
            f"{error}; the model does not run as the record does: axes, signs or the order of its "
            f"columns can be wrong, see cmmsim check {paths[0]}",
            error.frame,
            error.saturated,
        ) from None
    files = scenario_file(run_folder, scenario.to_toml())
    for name, one in records.items():
        files[folder / name] = netcdf(recording.record_groups(one))
    write_files(files | results, parents=True)


def _identified_files(
    run_folder: RunFolder,
    names: Sequence[str],
    asked: Asked,
    heading: Mapping[str, Any],
    progress: Progress,
) -> dict[Path, bytes]:
    """Identify from records, and return the contents of covariance.nc and result.json.

    names: file names of the records. heading: first entries of result.json, with the seed.

    For a user's own record, which has no seed, model.nc is returned as well, because `validate`
    cannot write it without the truth.
    """
    began = time.perf_counter()
    result = identified(asked, progress)
    first = asked.records[0]
    diagnosis = None
    finding = read_finding(first)
    misses = needs_cause(result.misfit, result.driven_misfit, result.whiteness.suspicious)
    # The diagnosis needs joint commands, and knows no cause in the sensor, such as its drift.
    if result.drive.in_loop and misses and not (finding or {}).get("warning"):
        with progress.stage("diagnosis", 1) as advance:
            diagnosis = diagnosed(asked, result)
            advance()
    # The models run with the identified drive law.
    side = asked.side.with_drive(result.drive.law)
    before, after = (
        model_on_record(side, values, first) for values in (result.initial, result.estimate)
    )
    ended = time.perf_counter()
    measured = recording.poses(first, "measured")
    ok = first["measured_ok"].values.astype(bool)
    covariance = result.whole_covariance
    # Later stages check by these digests whether the result belongs to its files.
    digests = {name: digest(one) for name, one in zip(names, asked.records, strict=True)}
    digests["covariance.nc"] = digest(covariance)
    files = {}
    if heading["seed"] is None:
        runs = model_groups(build_model_run(first["time"].values, before, after))
        files[run_folder.model] = netcdf(runs)
        digests["model.nc"] = digest(runs)
    seconds = {f"identify.{stage}": value for stage, value in result.seconds.items()}
    units = parameter_units(result.layout, result.common_errors.names)
    files[run_folder.covariance] = covariance_netcdf(units, covariance, result.sources)
    entries: dict[str, Any] = {
        **heading,
        "date": str(first.attrs.get("created", ""))[:10] or None,
        "versions": versions(),
        ENTRY: digests,
        "seconds": {
            "record": first.attrs.get("record_seconds"),
            "identify": ended - began,
            **seconds,
        },
        DRIFT: finding,
        "identification": result.to_dict() | {SCALE: common_scale(result)},
        "before": rms_figures(before - measured, ok),
        "after": rms_figures(after - measured, ok),
        DIAGNOSIS: None,
    }
    if diagnosis is not None:
        entries = with_diagnosis(entries, diagnosis)
    files[run_folder.result] = result_json(entries)
    return files
