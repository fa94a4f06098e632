"""Ctrl-C at a bad moment: held, record_interrupts, and one line for the user."""

import signal
import sys
from importlib import import_module
from types import SimpleNamespace

import pytest

from identify.errors import StudyInterrupted
from identify.progress import SilentProgress
from identify.runtime import (
    delay_interrupts,
    interruptible,
    interruptible_imports,
    raise_interrupt,
    record_interrupts,
)
from identify.studies.runner import run_study
from tests.identify.commands import command
from tests.identify.study_rows import DARK, PATIENCE, journal, process, small_study


def ctrl_c():
    signal.raise_signal(signal.SIGINT)


def swallowed():
    """Ctrl-C during something that catches everything, as some imports do."""
    with pytest.raises(KeyboardInterrupt):
        ctrl_c()


def broken_import():
    """Ctrl-C during an import that makes another error of it."""
    swallowed()
    raise ImportError("half of a library")


def test_held_ctrl_c_waits_for_the_end_of_the_block():
    done = []

    @delay_interrupts()
    def block():
        ctrl_c()
        done.append("the rest of the block")

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["the rest of the block"]
    with pytest.raises(KeyboardInterrupt):
        ctrl_c()


def test_noted_ctrl_c_is_raised_again_where_it_was_swallowed_and_an_inner_blocks_is_noted_in_the_outer_one():
    with record_interrupts():
        raise_interrupt()
        swallowed()
        with pytest.raises(KeyboardInterrupt):
            raise_interrupt()
    raise_interrupt()
    for happens in (ctrl_c, broken_import, swallowed):
        with record_interrupts() as outer:
            with pytest.raises(KeyboardInterrupt), interruptible():
                happens()
            assert outer.came
    with pytest.raises(ImportError, match="no library"), interruptible():
        raise ImportError("no library")


def test_ctrl_c_that_an_import_swallowed_is_raised_at_the_next_one():
    before = list(sys.meta_path)
    with record_interrupts(), interruptible_imports():
        with pytest.raises(ModuleNotFoundError):
            import_module("no_such_library")
        swallowed()
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                import_module("no_such_library")
    assert sys.meta_path == before
    with pytest.raises(ModuleNotFoundError):
        import_module("no_such_library")


def test_ctrl_c_in_code_from_a_string_does_not_change_the_exit_status(tmp_path):
    """Python remembers such a Ctrl-C, and ends itself by the signal where it would exit."""
    (tmp_path / "interrupted.py").write_text(
        "from identify.commands import app\n"
        "from identify.__main__ import main\n"
        "app.main = lambda: exec('raise KeyboardInterrupt')\n"
        "main()\n"
    )
    running = process("interrupted", before=tmp_path)
    _, error = running.communicate(timeout=PATIENCE)
    assert (running.returncode, error) == (130, "aborted\n")


def test_ctrl_c_in_a_row_is_no_error_of_it_whatever_became_of_it_and_one_that_was_swallowed_begins_no_row(
    tmp_path,
):
    def workers():
        raise AssertionError("workers are started")

    for disguise in (False, True):
        chosen = small_study(factors={DARK: [13.0]}, options={"interrupt": 1, "disguise": disguise})
        with pytest.raises(StudyInterrupted, match="1 of 3 rows are done"):
            run_study(chosen, tmp_path / str(disguise), SilentProgress())
        assert journal(tmp_path / str(disguise)) == [0]
    with record_interrupts():
        swallowed()
        with pytest.raises(StudyInterrupted, match="0 of 3 rows are done"):
            run_study(chosen, tmp_path / "b", SilentProgress(), workers)


def test_ctrl_c_in_a_command_is_one_line_whatever_became_of_it_and_other_errors_stay_what_they_are(
    monkeypatch, capsys
):
    study = "studies.study_file.load_study"
    scenario = ("scenario.scenario.load_scenario", "commands.options.load_scenario")
    for happens in (ctrl_c, broken_import):
        for name in (study, *scenario):
            monkeypatch.setattr(f"identify.{name}", lambda _, happens=happens: happens())
        for words, line in (
            (
                ("study", "pixel_noise"),
                "stopped: finished work is stored; the same command continues from there\n",
            ),
            (("excite", "quick"), "aborted\n"),
        ):
            assert command(*words) == 130
            assert capsys.readouterr() == ("", line)
    monkeypatch.setattr(f"identify.{study}", lambda _: int("no number"))
    with pytest.raises(ValueError, match="no number"):
        command("study", "pixel_noise")
    assert capsys.readouterr().err == ""


def test_ctrl_c_while_the_libraries_are_loaded_is_one_line(monkeypatch, capsys):
    def find_spec(name, path, target=None):
        if name == "identify.commands.app":
            broken_import()

    monkeypatch.delattr("identify.commands.app")
    monkeypatch.delitem(sys.modules, "identify.commands.app")
    monkeypatch.setattr(sys, "meta_path", [SimpleNamespace(find_spec=find_spec), *sys.meta_path])
    assert command("--help") == 130
    assert capsys.readouterr() == ("", "aborted\n")
