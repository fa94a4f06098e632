"""Studies in processes of this machine: the numbers of one process, whoever is killed in the
middle, and no door for anybody else.
"""

import os
import signal
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from functools import partial
from types import SimpleNamespace

import psutil
import pytest

from identify.errors import StudyError
from identify.progress import SilentProgress
from identify.studies import processes
from identify.studies.processes import local_processes
from identify.studies.runner import run_study
from identify.studies.store import JOURNAL
from tests.identify.study_rows import (
    DARK,
    KIND,
    LEVELS,
    PATIENCE,
    at,
    journal,
    many_rows,
    process,
    same_numbers,
    wait_for,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """The table of the study, computed in this process."""
    folder = tmp_path_factory.mktemp("serial") / "a"
    return run_study(many_rows(seconds=0.0), folder, SilentProgress()).frame


def children():
    """Workers of this process."""
    here = psutil.Process().children()
    return [one for one in here if "spawn_main" in " ".join(one.cmdline())]


@pytest.mark.thorough
def test_rows_that_end_their_process_or_take_its_memory_are_errors_and_no_other_row_is(
    tmp_path, serial, monkeypatch
):
    """Also where there is no other process."""
    monkeypatch.setattr(processes, "MEMORY_SHARE", 0.6e9 / psutil.virtual_memory().total)
    monkeypatch.setattr(processes, "LOOK_S", 0.05)
    chosen = many_rows(kills=[7], exits=[3], takes=[5])
    frame = run_study(chosen, tmp_path, SilentProgress(), partial(local_processes, 1)).frame
    for row, fate in ((7, "died"), (5, "took more than 0.6 GB of memory")):
        again = "and again when it computed this row alone"
        assert frame["error"][row] == f"KilledWorker: its process {fate}, {again}"
    assert "raised SystemExit: bye (" in frame["error"][3]
    same_numbers(frame.drop(index=[3, 5, 7]), serial.drop(index=[3, 5, 7]))


@pytest.mark.thorough
def test_killed_processes_are_replaced_cost_their_batch_alone_and_change_no_number(
    tmp_path, serial
):
    log = tmp_path / "log"
    seen = []

    def kill():
        seen.append({one.pid for one in children()})
        children()[0].kill()

    progress = at(kill, 40, 80)
    outcome = run_study(
        many_rows(log=str(log)), tmp_path / "a", progress, partial(local_processes, 2)
    )
    same_numbers(outcome.frame, serial)
    assert not children()
    assert len(set.union(*seen)) >= 3, "nobody took the place of those that were killed"
    again = [number for number, times in Counter(log.read_text().split()).items() if times > 1]
    assert len(again) <= 2 * 15, "more than the batches that the dead had"


def test_processes_that_die_before_they_are_ready_or_cannot_be_started_end_the_study_in_one_line(
    tmp_path, monkeypatch
):
    workers = partial(local_processes, 2)
    monkeypatch.setattr(processes, "work", os.abort)
    with pytest.raises(StudyError, match=r"^3 processes died before .* --workers 0 [^\n]*$"):
        run_study(many_rows(), tmp_path / "a", SilentProgress(), workers)
    none = SimpleNamespace(Pipe=lambda: (_ for _ in ()).throw(OSError(11, "Resource unavailable")))
    monkeypatch.setattr(processes, "SPAWN", none)
    with pytest.raises(StudyError, match=r"^process 1 of 2 cannot be started: Resource [^\n]*$"):
        run_study(many_rows(), tmp_path / "b", SilentProgress(), workers)
    assert not (tmp_path / "b").exists()


@pytest.mark.thorough
def test_a_study_in_processes_has_no_port_and_no_file_but_those_of_its_folder(
    tmp_path, monkeypatch
):
    """Where the first release of its workers had a port without a key, and locks in a folder that
    all users share.
    """
    scratch = tmp_path / "tmp"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    monkeypatch.setenv("TMPDIR", str(scratch))
    found = set()

    def look():
        for one in (psutil.Process(), *psutil.Process().children(recursive=True)):
            ports = one.net_connections("inet")
            named = [one for one in one.net_connections("unix") if one.laddr]
            found.update((one.laddr, one.raddr) for one in ports + named)
        found.update(scratch.iterdir())

    look()
    others = frozenset(found)  # connections to the browser of another test, for example
    run_study(many_rows(), tmp_path / "a", at(look, 60), partial(local_processes, 2))
    assert found == others


UNGUARDED = f"""
import sys
import identify
study = identify.Study("quick", kind="{KIND}", vary={{"{DARK}": [13.0]}})
study.run(workers=2, folder=sys.argv[1])
"""


def test_a_script_without_a_guard_is_told_of_it_in_the_last_line_alone(tmp_path):
    """Its processes execute it anew, and say nothing themselves."""
    (tmp_path / "script.py").write_text(UNGUARDED)
    command = sys.executable, tmp_path / "script.py", tmp_path / "a"
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert 'below if __name__ == "__main__": or with workers=0' in done.stderr.splitlines()[-1]
    assert done.stderr.count("Traceback") == 1
    assert not (tmp_path / "a").exists()


@pytest.fixture
def command(tmp_path):
    """A function that starts the command on so many workers and waits until 30 rows are done, or
    for the condition given, of the process: process, folder, log."""
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
    """End the command and all its processes as Ctrl-C in a terminal does; the rows that it has
    kept.
    """
    os.killpg(running.pid, signal.SIGINT)
    _, error = running.communicate(timeout=PATIENCE)
    kept = journal(folder)
    assert (
        error
        == f"stopped: {len(kept)} of 120 rows are done and stored; the same command goes on from "
        "there\n"
    )
    assert running.returncode == 130
    wait_for(lambda: not in_session(running.pid), "workers outlive the interrupted command")
    return kept


@pytest.mark.thorough
def test_killed_command_loses_nothing_finished_and_computes_nothing_twice(command, serial):
    running, folder, log = command(workers=2)
    running.kill()
    running.wait()
    wait_for(lambda: not in_session(running.pid), "workers outlive the killed command")
    kept = journal(folder)
    assert 30 <= len(kept) < 120
    outcome = run_study(many_rows(log=str(log)), folder, SilentProgress())
    assert outcome.found == len(kept)
    same_numbers(outcome.frame, serial)
    times = Counter(map(int, log.read_text().split()))
    assert {times[number] for number in kept} == {1}
    assert sorted(times) == list(range(120))


@pytest.mark.thorough
def test_interrupted_command_ends_with_one_line_and_goes_on(command, serial):
    running, folder, log = command(workers=1)
    kept = interrupted(running, folder)
    outcome = run_study(many_rows(log=str(log)), folder, SilentProgress())
    assert outcome.found == len(kept)
    same_numbers(outcome.frame, serial)


@pytest.mark.thorough
def test_command_interrupted_while_its_workers_start_ends_with_one_line(command):
    """Also the processes that start get the signal, as from a terminal; none of them says anything,
    or stays.
    """
    running, folder, _ = command(workers=1, until=starts_workers)
    assert interrupted(running, folder) == []


def test_a_worker_watches_its_parent_before_it_loads_libraries():
    """That takes a minute on a busy machine, in which a killed command's pipes would stay open."""
    code = "import sys, identify.studies.worker; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
