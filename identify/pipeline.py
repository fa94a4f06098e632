"""The stages of a run, each reading what the one before wrote into the run folder."""

import time
from collections.abc import Mapping
from pathlib import Path

import cmmsim
from identify.experiment.run import excitation_run
from identify.experiment.sensor_in_loop import teach
from identify.files.run_folder import RunFolder, load_result, result_json
from identify.progress import Progress
from identify.record import recording
from identify.scenario import Scenario
from identify.setup import Setup, with_renderer
from identify.stages.estimate import identify, identify_own
from identify.stages.plan import begin, excite, is_begun, open_run, record_files
from identify.stages.validate import validate

__all__ = ["excite", "identify", "identify_own", "is_begun", "record", "report", "run", "validate"]


def run(
    scenario: Scenario, seed: int, folder: Path, progress: Progress, workers: int | None = None
) -> None:
    """All stages: excite, record, identify, validate, report; those that are done are left out.

    What cannot work is refused before any file. A folder in which the same run was begun keeps what
    is there, and the run goes on; the numbers are those of a run at once.
    """
    began = time.perf_counter()
    run_folder = RunFolder(folder)
    planned = Setup(with_renderer(scenario), seed)
    seconds: dict[str, float] = {}
    setup = None
    taught = None
    if not is_begun(planned, folder):
        setup, seconds = begin(planned, folder, progress)
    names = record_files(scenario.identification)
    if not all((folder / name).is_file() for name in names):
        taught = record(folder, progress, workers, setup)
    if not run_folder.result.is_file():
        identify(folder, progress)
    if "validation" not in load_result(run_folder.result):
        validate(folder, progress, workers, taught)
    report(folder, progress, began, seconds)


def record(
    folder: Path,
    progress: Progress,
    workers: int | None = None,
    setup: Setup | None = None,
) -> cmmsim.Taught:
    """Run the plant on the exciting trajectory; writes experiment.nc, and payload.nc where the
    scale anchor is a payload. Returns what the sensor was taught.

    setup: that of the run where it is at hand, its sensor taught.
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
            recording.write(run_folder.path / name, stored, experiment.truth)
    return setup.sensor.taught


def report(
    folder: Path,
    progress: Progress,
    run_began: float | None = None,
    seconds: Mapping[str, float] | None = None,
) -> None:
    """Draw the figures, and write report.html with them, and result.json with the seconds.

    run_began: when a whole run began. seconds: further ones of it.
    """
    from identify.reporting.report import (
        write_report,
    )  # imports Matplotlib, for which no other stage waits

    began = time.perf_counter()
    path = RunFolder(folder).result

    # A run with a report is finished, so that its last result must not come after the report.
    def timed_result() -> dict[Path, bytes]:
        result = load_result(path)
        now = time.perf_counter()
        result["seconds"] |= {**(seconds or {}), "report": now - began}
        if run_began is not None:
            result["seconds"]["total"] = now - run_began
        return {path: result_json(result)}

    write_report(folder, progress, timed_result)
