"""Studies on clusters: the numbers of one process, whoever dies in the middle; no row is blamed for one death."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import dask
import numpy as np
import psutil
import pytest
from distributed import KilledWorker

from identify.errors import StudyError
from identify.files.versions import OtherVersionsWarning, versions
from identify.progress import SilentProgress
from identify.studies import dask_cluster
from identify.studies.dask_cluster import DaskExecutor, local_cluster, running_cluster
from identify.studies.design import Case, Finished
from identify.studies.runner import Batches, run_study
from identify.studies.store import JOURNAL
from tests.identify.study_rows import DARK, KIND, at, journal, same_numbers, small_study

LOST = TimeoutError("its worker died with the result")
DIED = KilledWorker("task", SimpleNamespace(address="tcp://a:1"), 0)
ROOT, LEVELS = Path(__file__).parents[2], [13.0, 26.0, 52.0]
PATIENCE = 120
"""Seconds for what takes a few on a free machine."""


def found(numbers):
    return [Finished(number, {}, 0.0) for number in numbers]


def computed(steps, rows, **changes):
    """Errors of rows by number, and the batches as sent, on a cluster of one worker that does a batch at once.

    steps(numbers, time): results of a batch sent the so many-th time, one after the other: an error, or what is found.
    """

    def submit(_, version, setup, cases, pure):
        sent.append([case.number for case in cases])
        result = Mock(side_effect=steps(sent[-1], sent.count(sent[-1])))
        future = SimpleNamespace(key=len(sent), result=lambda timeout: timeout and result())  # waits with a limit
        future.add_done_callback = lambda action: action(future)
        return future

    sent, cases = [], (Case(number, 0, {}) for number in range(rows))
    client = {"status": "running", "submit": submit, "nthreads": lambda callback_timeout: {"tcp://a:1": 1}}
    batches = DaskExecutor(SimpleNamespace(**client | changes))(None, Batches(cases, rows))
    return {row.number: row.error for batch in batches for row in batch}, sent


def test_result_that_died_with_its_worker_is_waited_for_and_noted_once():
    assert computed(lambda numbers, _: [LOST, LOST, found(numbers)], 3) == ({0: "", 1: "", 2: ""}, [[0], [1], [2]])


def test_last_worker_or_a_scheduler_that_does_not_answer_ends_the_study_in_one_line(monkeypatch):
    monkeypatch.setattr(dask_cluster, "WORKERLESS_SECONDS", 0.05)
    with pytest.raises(StudyError, match=r"^no Dask worker for 0.05 s; the same command goes on from here$"):
        computed(lambda *_: iter(lambda: LOST, None), 1, nthreads=lambda callback_timeout: {})
    with pytest.raises(StudyError, match=r"^the Dask scheduler is gone; .* timed out$"):
        computed(lambda numbers, _: [found(numbers)], 1, nthreads=Mock(side_effect=TimeoutError("timed out")))


def test_row_is_blamed_for_the_second_death_of_its_worker_and_not_for_the_first():
    for rows, deaths, expected in ((3, {0: 1, 1: 9}, [[0], [1], [2], [1], [0]]), (1, {0: 1}, [[0], [0]])):
        errors, sent = computed(
            lambda sent, time, deaths=deaths: [DIED if time <= deaths.get(sent[0], 0) else found(sent)], rows
        )
        assert sent == expected
        assert [number for number, error in errors.items() if error] == [1] * (rows > 1)
        assert all(error.startswith("KilledWorker: ") for error in errors.values() if error)


def study(**options):
    return small_study(factors={DARK: LEVELS}, repeats=40, options={"seconds": 0.02} | options)


def process(*arguments, before=ROOT):
    """A process of this Python, in a group of its own; what is in the folder `before` it finds first."""
    command, environment = [sys.executable, "-m", *map(str, arguments)], os.environ | {"PYTHONPATH": f"{before}:{ROOT}"}
    shown = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=before, env=environment, start_new_session=True, **shown)


def worker(address, folder, before=ROOT):
    options = ("--no-nanny", "--nthreads", 1, "--no-dashboard", "--local-directory", folder)
    return process("distributed.cli.dask_worker", address, *options, before=before)


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
    options = ("--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--scheduler-file", file)
    scheduler, there = process("distributed.cli.dask_scheduler", *options), []
    try:
        wait_for(lambda: file.exists() and file.read_text().endswith("}"), "scheduler")
        address = json.loads(file.read_text())["address"]
        there += [worker(address, folder, before) for _ in range(workers)]
        yield address, scheduler, there
    finally:
        for one in [scheduler, *there]:
            one.kill()
            one.communicate()


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """The table of the study, computed in this process."""
    return run_study(study(seconds=0.0), tmp_path_factory.mktemp("serial") / "a", SilentProgress()).frame


@pytest.mark.slow
def test_worker_killed_in_the_middle_changes_no_number_and_other_packages_are_one_warning(tmp_path, serial):
    log, there = tmp_path / "log", other_versions(tmp_path / "there", numpy="1.2.3", casadi="0.1")
    place = r"\(worker tcp://\S+( and 1 more)?\), here"
    said = rf"numpy 1.2.3 {place} {np.__version__}; casadi 0.1 {place}"
    with cluster(tmp_path, 2, there) as (address, _, workers):
        progress, workers_there = at(workers[0].kill, 40), partial(running_cluster, address)
        with pytest.warns(OtherVersionsWarning, match=said) as caught:
            outcome = run_study(study(log=str(log)), tmp_path / "a", progress, workers_there)
        assert workers[0].wait(10) == -signal.SIGKILL
        assert workers[1].poll() is None
    same_numbers(outcome.frame, serial)
    assert sorted(journal(tmp_path / "a")) == list(range(120))
    again = [number for number, times in Counter(log.read_text().split()).items() if times > 1]
    assert len(again) <= 3 * 15, "more than the batches that the dead worker had"
    assert len(caught) == 1


@pytest.mark.slow
def test_lost_scheduler_is_one_line_and_the_study_goes_on_with_another(tmp_path, serial):
    with cluster(tmp_path, workers=1) as (address, scheduler, _), pytest.raises(StudyError) as caught:
        run_study(study(), tmp_path / "a", at(scheduler.kill, 30), partial(running_cluster, address))
    assert "\n" not in str(caught.value)
    assert "scheduler is gone" in str(caught.value)
    kept = len(journal(tmp_path / "a"))
    assert 30 <= kept < 120
    outcome = run_study(study(), tmp_path / "a", SilentProgress())
    assert outcome.found == kept
    same_numbers(outcome.frame, serial)


@pytest.mark.slow
def test_rows_that_end_their_worker_are_errors_and_no_other_row_is(tmp_path, serial):
    """Also where there is no other worker, and it needs longer to start again than Dask is told elsewhere to wait for
    it, as on a busy machine."""
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "50 ms"}):
        outcome = run_study(study(kills=[7], exits=[3]), tmp_path, SilentProgress(), partial(local_cluster, 1))
    frame = outcome.frame
    assert frame["error"][7].startswith("KilledWorker")
    assert frame["error"][3] == "SystemExit: bye"
    same_numbers(frame.drop(index=[3, 7]), serial.drop(index=[3, 7]))


@pytest.mark.slow
def test_worker_with_another_version_of_the_product_is_refused_at_the_start_and_later(tmp_path):
    there, here = other_versions(tmp_path / "there", cmmsim="9.8.7"), versions()["cmmsim"]
    refusal = rf"^worker tcp://\S+ has cmmsim 9\.8\.7, here is {here}; install \S[^\n]*$"
    with cluster(tmp_path, 1) as (address, _, workers):
        workers_there = partial(running_cluster, address)
        come = at(lambda: workers.append(worker(address, tmp_path, there)), 1)
        with pytest.raises(StudyError, match=refusal):
            run_study(study(seconds=0.5), tmp_path / "a", come, workers_there)
        assert 1 <= len(journal(tmp_path / "a")) < 120
        with pytest.raises(StudyError, match=refusal):
            run_study(study(), tmp_path / "b", SilentProgress(), workers_there)
    assert not (tmp_path / "b").exists()


@pytest.mark.slow
def test_worker_that_lacks_the_product_is_named(tmp_path):
    (tmp_path / "there" / "identify").mkdir(parents=True)
    (tmp_path / "there" / "identify" / "__init__.py").write_text("raise ImportError('none here')\n")
    message = r"worker tcp://\S+ cannot run cmmsim \S+: ImportError\('none here'\)$"
    with cluster(tmp_path, 1, tmp_path / "there") as (address, _, _), pytest.raises(StudyError, match=message):
        run_study(study(), tmp_path / "a", SilentProgress(), partial(running_cluster, address))


@pytest.fixture
def command(tmp_path):
    """A function that starts the command on so many workers and waits until 30 rows are done, or for the condition
    given, of the process: process, folder, log."""
    folder, log, started = tmp_path / "a", tmp_path / "log", []
    (tmp_path / "mine.toml").write_text(
        f'name = "mine"\nkind = "{KIND}"\nrepeats = 40\nseed = 4\n[factors]\n'
        f'{DARK} = {LEVELS}\n[options]\nseconds = 0.02\nlog = "{log}"\n'
    )

    def rows_done(_):
        return (folder / JOURNAL).exists() and len(journal(folder)) >= 30

    def start(workers, until=rows_done):
        arguments = ("study", tmp_path / "mine.toml", "--workers", workers, "--out", folder)
        started.append(process("identify", *arguments))
        wait_for(lambda: until(started[-1]), until.__name__)
        return started[-1], folder, log

    yield start
    for one in started:
        one.kill()
        one.communicate()


def in_session(leader):
    """Command lines of the living processes of a session, by the leader's number."""
    found = []
    for one in psutil.process_iter():
        with suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getsid(one.pid) == leader and one.status() != psutil.STATUS_ZOMBIE:
                found.append(" ".join(one.cmdline()))
    return found


def starts_workers(command):
    """Whether processes of workers are there; they need seconds until they compute."""
    return any("spawn_main" in line for line in in_session(command.pid))


def interrupted(running, folder):
    """End the command and all its processes as Ctrl-C in a terminal does; the rows that it has kept."""
    os.killpg(running.pid, signal.SIGINT)
    _, error = running.communicate(timeout=PATIENCE)
    kept = journal(folder)
    assert error == f"stopped: {len(kept)} of 120 rows are done and kept; the same command goes on from there\n"
    assert running.returncode == 130
    wait_for(lambda: not in_session(running.pid), "workers outlive the interrupted command")
    return kept


@pytest.mark.slow
def test_killed_command_loses_nothing_finished_and_computes_nothing_twice(command, serial):
    running, folder, log = command(workers=2)
    running.kill()
    running.wait()
    wait_for(lambda: not in_session(running.pid), "workers outlive the killed command")
    kept = journal(folder)
    assert 30 <= len(kept) < 120
    outcome = run_study(study(log=str(log)), folder, SilentProgress())
    assert outcome.found == len(kept)
    same_numbers(outcome.frame, serial)
    times = Counter(map(int, log.read_text().split()))
    assert {times[number] for number in kept} == {1}
    assert sorted(times) == list(range(120))


@pytest.mark.thorough
def test_interrupted_command_ends_with_one_line_and_goes_on(command, serial):
    running, folder, log = command(workers=1)
    kept = interrupted(running, folder)
    outcome = run_study(study(log=str(log)), folder, SilentProgress())
    assert outcome.found == len(kept)
    same_numbers(outcome.frame, serial)


@pytest.mark.slow
def test_command_interrupted_while_its_workers_start_ends_with_one_line(command):
    """Also the processes that start get the signal, as from a terminal; none of them says anything, or stays."""
    running, folder, _ = command(workers=1, until=starts_workers)
    assert interrupted(running, folder) == []
