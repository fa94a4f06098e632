"""Studies on real clusters of processes: the same numbers as in one process, whoever dies in the middle."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import dask
import numpy as np
import pandas as pd
import pytest

from identify.errors import StudyError
from identify.files.versions import OtherVersionsWarning, versions
from identify.progress import SilentProgress
from identify.studies.dask_cluster import local_cluster, running_cluster
from identify.studies.runner import run_study
from identify.studies.store import JOURNAL
from identify.studies.study_file import Study
from tests.identify.study_rows import KIND

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
DARK = "sensor.camera.dark_noise"
PATIENCE = 120
"""Seconds for what takes a few on a free machine."""


def study(**options):
    factors, options = {DARK: [13.0, 26.0, 52.0]}, {"seconds": 0.02} | options
    return Study(name="mine", kind=KIND, factors=factors, repeats=40, seed=4, options=options)


def process(*arguments, before=ROOT):
    """A process of this Python, in a group of its own; what is in the folder `before` it finds first."""
    environment = os.environ | {"PYTHONPATH": f"{before}:{ROOT}"}
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        cwd=before,
        env=environment,
        start_new_session=True,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def worker(address, folder, before=ROOT):
    return process(
        "-m",
        "distributed.cli.dask_worker",
        address,
        "--no-nanny",
        "--nthreads",
        1,
        "--no-dashboard",
        "--local-directory",
        folder,
        before=before,
    )


def other_versions(folder, **packages):
    """A folder that makes a process believe that it has these versions of packages."""
    for name, version in packages.items():
        metadata = folder / f"{name}-{version}.dist-info" / "METADATA"
        metadata.parent.mkdir(parents=True)
        metadata.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return folder


def wait_for(condition, what):
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < PATIENCE, what
        time.sleep(0.02)


@contextmanager
def cluster(folder, workers, before=ROOT):
    """A scheduler and workers, each a process of its own: address, scheduler, workers; `before`: see `process`."""
    file = folder / "scheduler.json"
    scheduler = process(
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        0,
        "--no-dashboard",
        "--scheduler-file",
        file,
    )
    there = []
    try:
        wait_for(lambda: file.exists() and file.read_text().endswith("}"), "scheduler")
        address = json.loads(file.read_text())["address"]
        for _ in range(workers):
            there.append(worker(address, folder, before))
        yield address, scheduler, there
    finally:
        for one in [scheduler, *there]:
            one.kill()
            one.communicate()


class At(SilentProgress):
    """Does something when so many rows are done."""

    def __init__(self, rows, action):
        self._rows, self._action = rows, action

    @contextmanager
    def stage(self, name, total):
        done = 0

        def advance(n=1):
            nonlocal done
            if done < self._rows <= done + n:
                self._action()
            done += n

        yield advance


def journal(folder):
    """Numbers of the rows that are kept."""
    path = folder / JOURNAL
    return [json.loads(line)["number"] for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]


def same_numbers(one, other):
    pd.testing.assert_frame_equal(one.drop(columns="seconds"), other.drop(columns="seconds"), check_exact=True)


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """The table of the study, computed in this process."""
    return run_study(study(seconds=0.0), tmp_path_factory.mktemp("serial") / "a", SilentProgress()).frame


def test_worker_killed_in_the_middle_changes_no_number(tmp_path, serial):
    log = tmp_path / "log"
    with cluster(tmp_path, workers=2) as (address, _, workers):
        workers_there = partial(running_cluster, address)
        outcome = run_study(study(log=str(log)), tmp_path / "a", At(40, workers[0].kill), workers_there)
        assert workers[0].wait(10) == -signal.SIGKILL
        assert workers[1].poll() is None
    same_numbers(outcome.frame, serial)
    assert sorted(journal(tmp_path / "a")) == list(range(120))
    again = [number for number, times in Counter(log.read_text().split()).items() if times > 1]
    assert len(again) <= 3 * 15, "more than the batches that the dead worker had"


def test_lost_scheduler_is_one_line_and_the_study_goes_on_with_another(tmp_path, serial):
    with cluster(tmp_path, workers=1) as (address, scheduler, _), pytest.raises(StudyError) as caught:
        run_study(study(), tmp_path / "a", At(30, scheduler.kill), partial(running_cluster, address))
    assert "\n" not in str(caught.value)
    assert "scheduler is gone" in str(caught.value)
    kept = len(journal(tmp_path / "a"))
    assert 30 <= kept < 120
    outcome = run_study(study(), tmp_path / "a", SilentProgress())
    assert outcome.found == kept
    same_numbers(outcome.frame, serial)


def test_rows_that_end_their_worker_are_errors_and_no_other_row_is(tmp_path, serial):
    """Also where there is no other worker, and it needs longer to start again than Dask is told elsewhere to wait for
    it, as on a busy machine."""
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "50 ms"}):
        outcome = run_study(study(kills=[7], exits=[3]), tmp_path, SilentProgress(), partial(local_cluster, 1))
    frame = outcome.frame
    assert frame["error"][7].startswith("KilledWorker")
    assert frame["error"][3] == "SystemExit: bye"
    same_numbers(frame.drop(index=[3, 7]), serial.drop(index=[3, 7]))


def test_workers_with_another_version_of_the_product_are_refused_at_the_start(tmp_path):
    there = other_versions(tmp_path / "there", cmmsim="9.8.7")
    with cluster(tmp_path, 1, there) as (address, _, _), pytest.raises(StudyError) as caught:
        run_study(study(), tmp_path / "a", SilentProgress(), partial(running_cluster, address))
    here = versions()["cmmsim"]
    assert re.fullmatch(rf"worker tcp://\S+ has cmmsim 9.8.7, here is {here}; install .*", str(caught.value))
    assert not (tmp_path / "a").exists()


def test_worker_that_comes_later_with_another_version_computes_no_row(tmp_path):
    there, late = other_versions(tmp_path / "there", cmmsim="9.8.7"), []
    with cluster(tmp_path, 1) as (address, _, workers):
        come = At(1, lambda: late.append(worker(address, tmp_path, there)))
        with pytest.raises(StudyError, match=r"worker tcp://\S+ has cmmsim 9\.8\.7, here is \S+; install"):
            run_study(study(seconds=0.5), tmp_path / "a", come, partial(running_cluster, address))
        workers += late
    assert 1 <= len(journal(tmp_path / "a")) < 120


def test_worker_that_lacks_the_product_is_named(tmp_path):
    (tmp_path / "there" / "identify").mkdir(parents=True)
    (tmp_path / "there" / "identify" / "__init__.py").write_text("raise ImportError('none here')\n")
    message = r"worker tcp://\S+ cannot run cmmsim \S+: ImportError\('none here'\)$"
    with cluster(tmp_path, 1, tmp_path / "there") as (address, _, _), pytest.raises(StudyError, match=message):
        run_study(study(), tmp_path / "a", SilentProgress(), partial(running_cluster, address))


def test_other_versions_of_other_packages_are_one_warning(tmp_path, serial):
    there = other_versions(tmp_path / "there", numpy="1.2.3", casadi="0.1")
    with cluster(tmp_path, 2, there) as (address, _, _), pytest.warns(OtherVersionsWarning) as caught:
        outcome = run_study(study(), tmp_path / "a", SilentProgress(), partial(running_cluster, address))
    assert len(caught) == 1
    text = str(caught[0].message)
    assert re.search(
        rf"numpy 1.2.3 \(worker tcp://\S+( and 1 more)?\), here {np.__version__}; casadi 0.1 \(worker tcp://", text
    )
    assert "scipy" not in text
    same_numbers(outcome.frame, serial)


@pytest.fixture
def command(tmp_path):
    """A function that starts the command on so many workers and waits until 30 rows are done, or for the condition
    given, of the process: process, folder, log."""
    folder, log, started = tmp_path / "a", tmp_path / "log", []
    text = study(log=str(log))
    (tmp_path / "mine.toml").write_text(
        f'name = "mine"\nkind = "{KIND}"\nrepeats = {text.repeats}\nseed = 4\n[factors]\n'
        f'{DARK} = {text.factors[DARK]}\n[options]\nseconds = 0.02\nlog = "{log}"\n'
    )

    def rows_done(_):
        return (folder / JOURNAL).exists() and len(journal(folder)) >= 30

    def start(workers, until=rows_done):
        arguments = ("study", tmp_path / "mine.toml", "--workers", workers, "--out", folder)
        started.append(process("-m", "identify", *arguments))
        wait_for(lambda: until(started[-1]), until.__name__)
        return started[-1], folder, log

    yield start
    for one in started:
        one.kill()
        one.communicate()


def in_group(leader):
    """Processes of a session that live, by the leader's number."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            found.append(stat.parent.name)
    return found


def starts_workers(command):
    """Whether processes of workers are there; they need seconds until they compute."""
    try:
        return any("spawn_main" in Path(f"/proc/{one}/cmdline").read_text() for one in in_group(command.pid))
    except OSError:
        return False


def test_killed_command_loses_nothing_finished_and_computes_nothing_twice(command, serial):
    running, folder, log = command(workers=2)
    running.kill()
    running.wait()
    wait_for(lambda: not in_group(running.pid), "workers outlive the killed command")
    kept = journal(folder)
    assert 30 <= len(kept) < 120
    outcome = run_study(study(log=str(log)), folder, SilentProgress())
    assert outcome.found == len(kept)
    same_numbers(outcome.frame, serial)
    times = Counter(map(int, log.read_text().split()))
    assert {times[number] for number in kept} == {1}
    assert sorted(times) == list(range(120))


def test_interrupted_command_ends_with_one_line_and_goes_on(command, serial):
    running, folder, log = command(workers=1)
    os.killpg(running.pid, signal.SIGINT)
    _, error = running.communicate(timeout=PATIENCE)
    assert running.returncode == 130
    kept = journal(folder)
    assert error == f"stopped: {len(kept)} of 120 rows are done and kept; the same command goes on from there\n"
    wait_for(lambda: not in_group(running.pid), "workers outlive the interrupted command")
    outcome = run_study(study(log=str(log)), folder, SilentProgress())
    assert outcome.found == len(kept)
    same_numbers(outcome.frame, serial)


def test_command_interrupted_while_its_workers_start_ends_with_one_line(command):
    """Also the processes that start get the signal, as from a terminal; none of them says anything, or stays."""
    running, folder, _ = command(workers=1, until=starts_workers)
    os.killpg(running.pid, signal.SIGINT)
    _, error = running.communicate(timeout=PATIENCE)
    assert error == "stopped: 0 of 120 rows are done and kept; the same command goes on from there\n"
    assert running.returncode == 130
    assert journal(folder) == []
    wait_for(lambda: not in_group(running.pid), "workers outlive the interrupted command")
