"""What a study costs beside its rows, and what a second core brings.

Starting the cluster and the first rows of each process, which load the libraries, are not in the
figures: they are some seconds a study, however many rows it has.
"""

import time
from contextlib import nullcontext
from itertools import count

import numpy as np
import psutil
import pytest

from identify.progress import SilentProgress
from identify.studies.processes import local_processes
from identify.studies.runner import run_study
from identify.studies.study_file import Range, Study, load_study
from tests.benchmarks.timing import (
    WHOLE_SECOND_CORE,
    OtherLoad,
    fastest,
    judge,
    plain_work,
    second_core_gain,
    seconds,
)
from tests.identify.study_rows import at

pytestmark = pytest.mark.thorough

SECOND_CORE = 1.8
OVERHEAD = 0.4  # of the time of `plain_work`
SENSOR_ROWS = 10_000
IDENTIFICATIONS = 30

# Of sensor rows fewer will do: one that kept its pictures, or its sensor, would keep a megabyte or
# more.
FLAT_EMPTY_ROWS, FLAT_SENSOR_ROWS, FLAT_MB = 10_000, 600, 20.0


@pytest.fixture(scope="module")
def one_core():
    with local_processes(1) as execute:
        yield execute


@pytest.fixture(scope="module")
def two_cores():
    with local_processes(2) as execute:
        yield execute


@pytest.fixture
def run(tmp_path):
    """(executor, study, progress) -> its outcome, in a folder of its own."""
    numbers = count()

    def run(execute, study, progress=None):
        folder = tmp_path / f"{next(numbers)}"
        outcome = run_study(
            study, folder, progress or SilentProgress(), lambda: nullcontext(execute)
        )
        assert not outcome.failures
        return outcome

    return run


def empty(scenario, seed, options):
    """A row that does almost nothing, and says in s how long it took over it."""
    start = time.perf_counter()
    draws = np.random.default_rng(seed).normal(size=1000)
    return {"mean_um": float(draws.mean()), "row_s": time.perf_counter() - start}


def empty_rows(rows):
    factors = {
        "sensor.camera.dark_noise": [13.0, 26.0],
        "scenario.pose_method": ["registration", "planes"],
    }
    return Study(name="empty", kind=f"{__name__}:empty", factors=factors, repeats=rows // 4)


def sensor_rows(rows):
    """The built-in study of pixel noise with so many rows: four pictures of a pose each, drawn
    without OpenGL.
    """
    study = load_study("pixel_noise")
    return study.model_copy(update={"repeats": max(1, rows // study.points)})


def rows_of_many_sensors(rows):
    """The same rows, each of a sensor of its own: more sensors than a process keeps."""
    factors = {"sensor.camera.dark_noise": Range(low=800.0, high=6400.0)}
    return load_study("pixel_noise").model_copy(
        update={"factors": factors, "sample": rows, "repeats": 1}
    )


def rows_of_five_poses(rows):
    """The same rows with five poses each. Rows of one pose are so short that the process which
    hands them out, with 2 ms a row, does a tenth of their work: it has a core of its own only where
    there is one worker."""
    study = sensor_rows(rows)
    return study.model_copy(update={"options": {**study.options, "poses": 5}})


def identifications(rows):
    """Whole experiments with the scenario `quick`: teaching, record, identification with intervals,
    unseen motions.
    """
    changes, options = {"scenario.renderer": "statistical"}, {"sensor": "images"}
    return Study(
        name="identifications",
        kind="identification",
        scenario="quick",
        changes=changes,
        options=options,
        repeats=rows,
    )


def test_second_core(one_core, two_cores, run, record_property):
    """The fastest of up to three rounds, which end where the goal is reached or the second core is
    not whole.
    """
    study = rows_of_five_poses(100)
    for execute in (one_core, two_cores):
        run(execute, sensor_rows(40))
    loops, ones, twos = [second_core_gain()], [], []
    with OtherLoad() as load:
        for _ in range(3):
            ones.append(seconds(lambda: run(one_core, study)))
            twos.append(seconds(lambda: run(two_cores, study)))
            loops.append(second_core_gain())
            gain, cores = min(ones) / min(twos), min(loops)
            if gain >= SECOND_CORE or cores < WHOLE_SECOND_CORE:
                break
    figure = (
        f"two cores {gain:.2f} x one (goal {SECOND_CORE} x), {study.rows} sensor rows, a "
        f"loop {cores:.2f} x"
    )
    record_property("figure", figure)
    disturbed = "" if cores > WHOLE_SECOND_CORE else f"the second core brings a loop {cores:.2f} x"
    judge(gain >= SECOND_CORE, figure, load, disturbed)


def test_overhead_of_a_row(one_core, run, record_property):
    """Wall time of a row on one core beyond what its function says it took: scenario, sending,
    journal, table.
    """
    study, overheads = empty_rows(1000), []
    run(one_core, empty_rows(40))
    for _ in range(3):
        began = time.perf_counter()
        outcome = run(one_core, study)
        wall = time.perf_counter() - began
        overheads.append(1e3 * (wall / study.rows - outcome.frame["row_s"].mean()))
    overhead = min(overheads)
    unit = 1e3 * fastest({"work": plain_work}, 15)["work"]
    figure = (
        f"{overhead:.2f} ms a row, {overhead / unit:.2f} of a piece of plain work, goal "
        f"{OVERHEAD:g}"
    )
    record_property("figure", figure)
    assert overhead <= OVERHEAD * unit, figure


def test_rate_of_sensor_rows(two_cores, run, record_property):
    study = sensor_rows(SENSOR_ROWS)
    run(two_cores, sensor_rows(40))
    record_property("rows_per_second", study.rows / seconds(lambda: run(two_cores, study)))


@pytest.mark.parametrize(
    ("study", "rows", "minutes"),
    [
        (identifications(IDENTIFICATIONS), 1000, 10.0),
        (load_study("estimators"), 200, 15.0),
    ],
    ids=["identifications", "leaderboard"],
)
def test_a_study_of_whole_experiments_is_done_before_lunch(
    two_cores, run, record_property, study, rows, minutes
):
    """A thousand identifications, and nine estimators on two hundred records, by the rate of some
    of their rows.
    """
    run(two_cores, study.model_copy(update={"repeats": 6}))
    some = study.model_copy(update={"repeats": IDENTIFICATIONS})
    with OtherLoad() as load:
        taken = seconds(lambda: run(two_cores, some)) / some.rows * rows / 60.0
    record_property("rows_per_second", rows / (60.0 * taken))
    record_property("minutes", taken)
    judge(
        taken <= minutes,
        f"{rows} rows of {study.kind} in {taken:.1f} minutes, goal {minutes:g}",
        load,
    )


@pytest.mark.parametrize(
    ("study", "warm"),
    [
        (empty_rows(FLAT_EMPTY_ROWS), empty_rows(40)),
        (rows_of_many_sensors(FLAT_SENSOR_ROWS), rows_of_many_sensors(80)),
        (identifications(2 * IDENTIFICATIONS), identifications(10)),
    ],
    ids=["empty", "sensors", "identifications"],
)
def test_memory_is_flat(two_cores, run, record_property, study, warm):
    """From the first fifth of the rows to the last: of this process, and of the largest worker."""
    found = []
    run(two_cores, warm)
    run(two_cores, study, at(lambda: found.append(memory_mb()), study.rows // 5, study.rows))
    here, largest = np.subtract(*reversed(found))
    figure = (
        f"{here:+.1f} MB here, {largest:+.1f} MB in the largest worker, over "
        f"{study.rows * 4 // 5} rows"
    )
    record_property("figure", figure)
    assert max(here, largest) < FLAT_MB, figure


def memory_mb():
    """Memory of this process and of the largest of its children."""
    here = psutil.Process()
    children = [child.memory_info().rss for child in here.children(recursive=True)]
    return [here.memory_info().rss / 1e6, max(children) / 1e6]
