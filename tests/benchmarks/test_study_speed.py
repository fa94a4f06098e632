"""What a study costs beside its rows, and what a second core brings.

Starting the cluster and the first rows of each process, which load the libraries, are not in the figures: they are some
seconds a study, however many rows it has.
"""

import time
from contextlib import contextmanager, nullcontext

import numpy as np
import psutil
import pytest

from identify.progress import SilentProgress
from identify.studies.dask_cluster import DaskExecutor, local_cluster
from identify.studies.runner import Outcome, run_study
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

pytestmark = pytest.mark.thorough

SECOND_CORE = 1.8
OVERHEAD = 0.4  # of the time of `plain_work`
SENSOR_ROWS = 10_000

FLAT_EMPTY_ROWS, FLAT_SENSOR_ROWS, FLAT_MB = 10_000, 600, 20.0
"""Of sensor rows fewer will do: one that kept its pictures, or its sensor, would keep a megabyte or more."""


@pytest.fixture(scope="module")
def one_core():
    with local_cluster(1) as execute:
        yield execute


@pytest.fixture(scope="module")
def two_cores():
    with local_cluster(2) as execute:
        yield execute


class Runs:
    """Studies on one executor, each in a folder of its own."""

    def __init__(self, folder, execute: DaskExecutor) -> None:
        self._folder, self._execute, self._count = folder, execute, 0

    def __call__(self, study: Study, progress=None) -> Outcome:
        self._count += 1
        folder = self._folder / str(self._count)
        outcome = run_study(study, folder, progress or SilentProgress(), lambda: nullcontext(self._execute))
        assert not outcome.failures
        return outcome


def empty(scenario, seed, options) -> dict[str, float]:
    """A row that does almost nothing, and says in s how long it took over it."""
    start = time.perf_counter()
    draws = np.random.default_rng(seed).normal(size=1000)
    return {"mean_um": float(draws.mean()), "row_s": time.perf_counter() - start}


def empty_rows(count: int) -> Study:
    factors = {"sensor.camera.dark_noise": [13.0, 26.0], "scenario.pose_method": ["registration", "planes"]}
    return Study(name="empty", kind=f"{__name__}:empty", factors=factors, repeats=count // 4)


def sensor_rows(count: int) -> Study:
    """The built-in study of pixel noise with so many rows: four pictures of a pose each, drawn without OpenGL."""
    study = load_study("pixel_noise")
    return study.model_copy(update={"repeats": max(1, count // study.points)})


def rows_of_many_sensors(count: int) -> Study:
    """The same rows, each of a sensor of its own: more sensors than a process keeps."""
    factors = {"sensor.camera.dark_noise": Range(low=800.0, high=6400.0)}
    return load_study("pixel_noise").model_copy(update={"factors": factors, "sample": count, "repeats": 1})


def rows_of_five_poses(count: int) -> Study:
    """The same rows with five poses each. Rows of one pose are so short that the process which hands them out, with
    2 ms a row, does a tenth of their work: it has a core of its own only where there is one worker."""
    study = sensor_rows(count)
    return study.model_copy(update={"options": {**study.options, "poses": 5}})


def test_second_core(one_core, two_cores, tmp_path, record_property):
    """The fastest of up to three rounds, which end where the goal is reached or the second core is not whole."""
    one, two = Runs(tmp_path / "one", one_core), Runs(tmp_path / "two", two_cores)
    study = rows_of_five_poses(100)
    for runs in (one, two):
        runs(sensor_rows(40))
    loops = [second_core_gain()]
    ones, twos = [], []
    with OtherLoad() as load:
        for _ in range(3):
            ones.append(seconds(lambda: one(study)))
            twos.append(seconds(lambda: two(study)))
            loops.append(second_core_gain())
            gain, cores = min(ones) / min(twos), min(loops)
            if gain >= SECOND_CORE or cores < WHOLE_SECOND_CORE:
                break
    figure = f"two cores {gain:.2f} x one (goal {SECOND_CORE} x), {study.rows} sensor rows, a loop {cores:.2f} x"
    record_property("figure", figure)
    disturbed = "" if cores > WHOLE_SECOND_CORE else f"the second core brings a loop {cores:.2f} x"
    judge(gain >= SECOND_CORE, figure, load, disturbed)


def test_overhead_of_a_row(one_core, tmp_path, record_property):
    """Wall time of a row on one core beyond what its function says it took: scenario, sending, journal, table."""
    runs, study = Runs(tmp_path, one_core), empty_rows(1000)
    runs(empty_rows(40))
    spent, outcomes = [], []
    for _ in range(3):
        spent.append(seconds(lambda: outcomes.append(runs(study))))
    overhead = min(
        1e3 * (wall / study.rows - outcome.frame["row_s"].mean()) for wall, outcome in zip(spent, outcomes, strict=True)
    )
    unit = 1e3 * fastest({"work": plain_work}, 15)["work"]
    figure = f"{overhead:.2f} ms a row, {overhead / unit:.2f} of a piece of plain work, goal {OVERHEAD:g}"
    record_property("figure", figure)
    assert overhead <= OVERHEAD * unit, figure


def test_rate_of_sensor_rows(two_cores, tmp_path, record_property):
    runs, study = Runs(tmp_path, two_cores), sensor_rows(SENSOR_ROWS)
    runs(sensor_rows(40))
    record_property("rows_per_second", study.rows / seconds(lambda: runs(study)))


@pytest.mark.parametrize(
    ("study", "warm"),
    [(empty_rows(FLAT_EMPTY_ROWS), empty_rows(40)), (rows_of_many_sensors(FLAT_SENSOR_ROWS), rows_of_many_sensors(80))],
    ids=["empty", "sensors"],
)
def test_memory_is_flat(two_cores, tmp_path, record_property, study, warm):
    """From the first fifth of the rows to the last: of this process, and of the largest worker."""
    found: dict[int, list[float]] = {}

    class Watch(SilentProgress):
        @contextmanager
        def stage(self, name, total):
            done = 0

            def advance(n=1):
                nonlocal done
                for mark in (total // 5, total):
                    if done < mark <= done + n:
                        found[mark] = memory_mb()
                done += n

            yield advance

    runs = Runs(tmp_path, two_cores)
    runs(warm)
    runs(study, Watch())
    early, late = found[study.rows // 5], found[study.rows]
    growth = [b - a for a, b in zip(early, late, strict=True)]
    figure = f"{growth[0]:+.1f} MB here, {growth[1]:+.1f} MB in the largest worker, over {study.rows * 4 // 5} rows"
    record_property("figure", figure)
    assert max(growth) < FLAT_MB, figure


def memory_mb() -> list[float]:
    """Memory of this process and of the largest of its children."""
    here = psutil.Process()
    children = [child.memory_info().rss for child in here.children(recursive=True)]
    return [here.memory_info().rss / 1e6, max(children) / 1e6]
