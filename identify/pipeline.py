"""Stages of a run. Each stage reads files that earlier stages wrote into the run folder."""

import time
from collections.abc import Mapping
from pathlib import Path

import cmmsim
from identify.experiment.run import excitation_run
from identify.experiment.sensor_in_loop import teach
from identify.files.atomic import write_files
from identify.files.run_folder import RunFolder, load_result, result_json
from identify.progress import Progress
from identify.record import recording
from identify.record.files_of_record import SENSOR_FILE
from identify.setup import Setup
from identify.stages.estimate import identify, identify_own
from identify.stages.plan import begin, excite, is_begun, is_planned, open_run, record_files
from identify.stages.validate import validate

__all__ = [
    "excite",
    "identify",
    "identify_own",
    "is_begun",
    "is_planned",
    "record",
    "report",
    "run",
    "validate",
]


def run(planned: Setup, folder: Path, progress: Progress, workers: int | None = None) -> None:
    """Run all stages that are not finished: excite, record, identify, validate, report.

    Settings that cannot work are refused before any file is written. If the folder holds the
    beginning of the same run, the run is continued. Its results equal those of an uninterrupted
    run.
    """
    began = time.perf_counter()
    run_folder = RunFolder(folder)
    seconds: dict[str, float] = {}
    setup = None
    taught = None
    if not is_begun(planned, folder):
        setup, seconds = begin(planned, folder, progress)
    names = record_files(planned.scenario.identification)
    if not all((folder / name).is_file() for name in names):
        taught = record(folder, progress, setup)
    if not run_folder.result.is_file():
        identify(folder, progress)
    if "validation" not in load_result(run_folder.result):
        validate(folder, progress, workers, taught)
    report(folder, progress, began, seconds)


def record(folder: Path, progress: Progress, setup: Setup | None = None) -> cmmsim.Taught:
    """Run the plant on the exciting trajectory, and return the taught frames of the sensor.

    Writes experiment.nc, and payload.nc if the scale anchor is a payload. `setup` is the setup of
    the run, with a sensor that has been taught. Without it, the sensor is taught here.
    """
    run_folder, opened, trajectories = open_run(folder, progress)
    began = time.perf_counter()
    if setup is None:
        setup = opened
        teach(setup.sensor, progress)
    scenario = setup.scenario
    names = record_files(scenario.identification)
    with progress.stage("record", setup.sensor_plan.frames * len(names)) as advance:
        for name in names:
            experiment = excitation_run(
                setup.plant,
                setup.sensor,
                trajectories.excitation,
                scenario.excitation,
                setup.seed,
                advance,
                scenario.payload if name == run_folder.payload.name else None,
            )
            stored = experiment.record.assign_attrs(record_seconds=time.perf_counter() - began)
            stored.attrs[SENSOR_FILE] = setup.sensor_plan.file.model_dump_json()
            recording.write(run_folder.path / name, stored, experiment.truth)
    return setup.sensor.taught


def report(
    folder: Path,
    progress: Progress,
    run_began: float | None = None,
    seconds: Mapping[str, float] | None = None,
) -> None:
    """Draw the figures, and write them with report.html and with the durations in result.json.

    run_began: time at which a whole run began, from `time.perf_counter`. seconds: durations of
    earlier stages that are added to result.json.
    """
    # Imported late, because it loads Matplotlib, which the other stages do not need.
    from identify.reporting.report import write_report

    began = time.perf_counter()
    path = RunFolder(folder).result
    if seconds:
        # The report shows the durations of all stages before it, in their order.
        result = load_result(path)
        result["seconds"] = {**seconds, **result["seconds"]}
        write_files({path: result_json(result)})

    # A report marks a finished run, so result.json must not be written after the report.
    def timed_result() -> dict[Path, bytes]:
        result = load_result(path)
        now = time.perf_counter()
        result["seconds"]["report"] = now - began
        if run_began is not None:
            result["seconds"]["total"] = now - run_began
        return {path: result_json(result)}

    write_report(folder, progress, timed_result)
