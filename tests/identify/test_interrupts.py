"""Ctrl-C at a bad moment: held, noted, not heard by the processes of workers, and one line for the user."""

import os
import signal
import subprocess
import sys
import threading

import pytest
import typer

from identify.errors import StudyInterrupted
from identify.progress import SilentProgress
from identify.runtime import deaf_offspring, held, honoured, noted, raise_noted, stoppable
from identify.studies import study_file
from identify.studies.runner import run_study
from identify.studies.study_file import Study
from tests.identify.commands import command
from tests.identify.study_rows import KIND, journal

LINE = "stopped: what is done is kept; the same command goes on from there\n"


def ctrl_c():
    os.kill(os.getpid(), signal.SIGINT)


def swallowed():
    """Ctrl-C during something that catches everything, as some imports do."""
    try:
        ctrl_c()
    except BaseException:
        return
    raise AssertionError("no KeyboardInterrupt")


def broken_import():
    """Ctrl-C during an import that makes another error of it."""
    try:
        ctrl_c()
    except BaseException as error:
        raise ImportError("half of a library") from error


def blocked(status):
    """Whether a process does not hear Ctrl-C, from its /proc/PID/status."""
    mask = next(line for line in status.splitlines() if line.startswith("SigBlk:")).split()[1]
    return bool(int(mask, 16) >> (signal.SIGINT - 1) & 1)


def test_held_ctrl_c_waits_for_the_end_of_the_block():
    done = []

    @held()
    def block():
        ctrl_c()
        done.append("the rest of the block")

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["the rest of the block"]
    with pytest.raises(KeyboardInterrupt):
        ctrl_c()


def test_noted_ctrl_c_is_raised_again_where_it_was_swallowed_and_an_inner_blocks_is_noted_in_the_outer_one():
    with noted():
        raise_noted()
        swallowed()
        with pytest.raises(KeyboardInterrupt):
            raise_noted()
    raise_noted()
    with noted() as outer:
        with pytest.raises(KeyboardInterrupt), honoured():
            broken_import()
        assert outer.came


@pytest.mark.parametrize("happens", [ctrl_c, broken_import, swallowed])
def test_ctrl_c_leaves_the_block_whatever_became_of_it(happens):
    with pytest.raises(KeyboardInterrupt), honoured():
        happens()
    with pytest.raises(ImportError, match="no library"), honoured():
        raise ImportError("no library")


def test_ctrl_c_in_a_row_is_no_error_of_it_whatever_became_of_it_and_one_that_was_swallowed_begins_no_row(tmp_path):
    def workers():
        raise AssertionError("workers are started")

    for disguise in (False, True):
        options = {"interrupt": 1, "disguise": disguise}
        chosen = Study(name="mine", kind=KIND, repeats=3, factors={"sensor.camera.dark_noise": [13.0]}, options=options)
        with pytest.raises(StudyInterrupted, match="1 of 3 rows are done"):
            run_study(chosen, tmp_path / str(disguise), SilentProgress())
        assert journal(tmp_path / str(disguise)) == [0]
    with noted():
        swallowed()
        with pytest.raises(StudyInterrupted, match="0 of 3 rows are done"):
            run_study(chosen, tmp_path / "b", SilentProgress(), workers)


def test_ctrl_c_in_a_command_is_one_line_and_other_errors_stay_what_they_are(monkeypatch, capsys):
    def fails():
        raise ImportError("no library")

    for happens in (ctrl_c, broken_import):
        with pytest.raises(typer.Exit) as caught:
            stoppable(happens)()
        assert (caught.value.exit_code, capsys.readouterr().err) == (130, LINE)
    with pytest.raises(ImportError, match="no library"):
        stoppable(fails)()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(study_file, "load_study", lambda _: broken_import())
    assert command("study", "pixel_noise") == 130
    assert capsys.readouterr().err == LINE


def test_ctrl_c_that_became_another_error_in_any_command_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr("identify.scenario.scenario.load_scenario", lambda _: broken_import())
    monkeypatch.setattr("identify.commands.app.load_scenario", lambda _: broken_import())
    assert command("excite", "quick") == 130
    assert capsys.readouterr().err == "aborted\n"


def test_ctrl_c_while_the_libraries_are_loaded_is_one_line(monkeypatch, capsys):
    class Slow:
        @staticmethod
        def find_spec(name, path, target=None):
            if name == "identify.commands.app":
                broken_import()

    monkeypatch.delattr("identify.commands.app")
    monkeypatch.delitem(sys.modules, "identify.commands.app")
    monkeypatch.setattr(sys, "meta_path", [Slow, *sys.meta_path])
    assert command("--help") == 130
    assert capsys.readouterr() == ("", "aborted\n")


def test_processes_of_threads_that_are_started_deaf_do_not_hear_ctrl_c():
    seen = []

    def start():
        shown = "print(open('/proc/self/status').read())"
        seen.append(subprocess.run([sys.executable, "-c", shown], capture_output=True, text=True, check=True).stdout)

    with deaf_offspring():
        thread = threading.Thread(target=start)
        thread.start()
    thread.join()
    start()
    assert [blocked(status) for status in seen] == [True, False]
