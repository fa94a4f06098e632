"""The command ``cmmsim study`` in this process."""

import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from identify.commands import study as study_command
from identify.errors import StudyInterrupted
from identify.studies import dask_cluster as dask_runner
from identify.studies import runner, summary
from identify.studies.rows import KINDS
from identify.studies.study_file import study_names
from identify.studies.table import read_table
from tests.identify.commands import command, one_line
from tests.identify.study_rows import KIND

TEXT = f"""
name = "mine"
kind = "{KIND}"
repeats = 2
[factors]
sensor.camera.dark_noise = [13.0, 26.0]
[options]
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return write(tmp_path)


@pytest.fixture
def undrawn(monkeypatch):
    """No figures: they take longer than the rows."""
    monkeypatch.setattr(summary, "write", lambda *_: {"theory": []})


def write(folder, text=TEXT):
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_study_leaves_its_files_and_says_where(mine, tmp_path, capsys):
    assert command("study", mine, "--workers", 0) == 0
    folder = tmp_path / "runs" / "study-mine"
    assert {"study.json", "rows.jsonl", "study.parquet", "summary.json", "summary.md"} <= {
        path.name for path in folder.iterdir()
    }
    assert list((folder / "figures").glob("*.png"))
    shown = capsys.readouterr()
    assert "4 rows" in shown.out
    assert str(folder.relative_to(tmp_path)) in shown.out
    assert "rows of mine: 4 of 4" in shown.err
    assert "rows/s" in shown.err


def test_a_study_that_is_done_says_so(mine, undrawn, capsys):
    assert command("study", mine, "--workers", 0) == 0
    assert command("study", mine, "--workers", 0) == 0
    assert "4 rows, 4 of them from before" in capsys.readouterr().out


def test_repeats_are_added_in_the_same_folder(mine, tmp_path, undrawn, capsys):
    assert command("study", mine, "--workers", 0) == 0
    assert command("study", mine, "--workers", 0, "--repeats", 3) == 0
    assert "6 rows, 4 of them from before" in capsys.readouterr().out
    frame, study = read_table(tmp_path / "runs" / "study-mine" / "study.parquet")
    assert (len(frame), study.repeats) == (6, 3)
    assert command("study", mine, "--workers", 0) == 0
    assert "4 rows, 4 of them from before (2 more, of further repeats, are kept)" in capsys.readouterr().out
    assert command("study", mine, "--repeats", 0) == 2


def test_quiet_says_nothing(mine, undrawn, capsys):
    assert command("study", mine, "--workers", 0, "--quiet", "--out", "a") == 0
    assert capsys.readouterr() == ("", "")


def test_failed_rows_make_an_exit_status_of_their_own(tmp_path, undrawn, capsys):
    path = write(tmp_path, TEXT + "fails = [1]\n")
    assert command("study", path, "--workers", 0, "--out", tmp_path / "a") == study_command.SOME_ROWS_FAILED
    assert "1 of 4 rows failed; row 1: ValueError: row 1 has no answer" in capsys.readouterr().err
    frame, _ = read_table(tmp_path / "a" / "study.parquet")
    assert frame["error"].ne("").tolist() == [False, True, False, False]


@pytest.mark.parametrize(
    ("law", "status"),
    [
        ("exponent = 3.0", study_command.A_LAW_FAILED),
        ("exponent = 0.0", 0),
    ],
)
def test_a_law_that_fails_makes_an_exit_status_of_its_own(tmp_path, capsys, law, status):
    """The figure is the standard deviation of 1,000 normal numbers, whatever the factor."""
    theory = f'[[theory]]\nfigure = "spread_um"\nfactor = "sensor.camera.dark_noise"\n{law}\n'
    path = write(tmp_path, TEXT.replace("[options]", theory))
    assert command("study", path, "--workers", 0, "--quiet", "--repeats", 4, "--out", tmp_path / "a") == status
    shown = capsys.readouterr()
    assert shown.out == ""
    assert ("1 of 1 laws failed; failed: spread_um ~" in shown.err) == (status != 0)


def test_rows_that_failed_and_undecided_laws_have_their_own_status(tmp_path, capsys):
    theory = '[[theory]]\nfigure = "error_um"\nfactor = "sensor.camera.dark_noise"\nexponent = 1.0\n'
    path = write(tmp_path, TEXT.replace("[options]", theory))
    assert command("study", path, "--workers", 0, "--out", tmp_path / "a") == 0
    assert "undecided: error_um" in capsys.readouterr().out
    both = write(tmp_path, TEXT.replace("[options]", "[options]\nfails = [1]") + theory.replace("1.0", "9.0"))
    assert command("study", both, "--workers", 0, "--out", tmp_path / "b") == study_command.SOME_ROWS_FAILED


def test_brackets_in_names_are_shown_as_they_are(mine, undrawn, capsys):
    assert command("study", mine, "--workers", 0, "--out", "a[bold]") == 0
    assert "study.parquet: a[bold]\n" in capsys.readouterr().out


def test_interrupted_study_says_how_far_it_came_and_how_to_go_on(mine, monkeypatch, capsys):
    def stop(*_):
        raise StudyInterrupted("stopped: 2 of 4 rows are done and kept")

    monkeypatch.setattr(runner, "run_study", stop)
    assert command("study", mine, "--workers", 0) == 130
    error = capsys.readouterr().err
    assert error == "stopped: 2 of 4 rows are done and kept; the same command goes on from there\n"


def test_list_names_every_built_in_study_with_its_rows(capsys):
    assert command("study", "--list") == 0
    shown = capsys.readouterr().out
    assert study_names()
    assert all(name in shown for name in study_names())


def test_kinds_are_listed_with_their_options_and_figures(capsys):
    assert command("study", "--kinds") == 0
    shown = capsys.readouterr().out
    assert all(f"{name}: {kind.what}" in shown for name, kind in KINDS.items())
    assert "\nIt reads scenario.sensor, scenario.renderer, " in shown
    assert "\nIt reads scenario.*, sensor.rig.*, " in shown
    lines = [line.split() for line in shown.splitlines() if line]
    for kind in KINDS.values():
        assert all(
            [name, column.unit] == [line[0], line[1]]
            for name, column in kind.columns.items()
            for line in lines
            if line[0] == name and column.unit not in ("1", "grey values", "N m")
        )
        assert {*kind.columns, *(f"options.{name}" for name in kind.options.model_fields)} <= {one[0] for one in lines}
    assert ["options.stretch_s", "0.5", "s"] in [line[:3] for line in lines]


def test_ten_million_rows_are_refused_at_once(tmp_path, capsys):
    values = ", ".join(map(str, range(1, 11)))
    keys = ("dsnu", "dark_noise", "black_level", "gain", "full_well", "electrons_at_white")
    factors = "\n".join(f"sensor.camera.{name} = [{values}]" for name in keys)
    path = write(tmp_path, f'name = "mine"\nkind = "{KIND}"\nrepeats = 10\n[factors]\n{factors}\n')
    start = time.perf_counter()
    assert command("study", path, "--out", tmp_path / "a") == 1
    assert time.perf_counter() - start < 5.0
    assert "10,000,000 rows; to run more than 100,000, say --yes" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "a").exists()


def test_many_rows_are_run_where_confirmed(mine, undrawn, monkeypatch):
    monkeypatch.setattr(study_command, "MANY_ROWS", 3)
    assert command("study", mine, "--workers", 0, "--quiet") == 1
    assert command("study", mine, "--workers", 0, "--quiet", "--yes") == 0


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense", "foo://host:1"])
def test_unreachable_scheduler_is_one_line_within_seconds(mine, monkeypatch, capsys, address):
    monkeypatch.setattr(dask_runner, "CONNECT_SECONDS", 1)
    start = time.perf_counter()
    assert command("study", mine, "--scheduler", address) == 1
    assert time.perf_counter() - start < 10.0
    assert f"no Dask scheduler answers at {address}" in one_line(capsys.readouterr().err)
    assert not Path("runs").exists()


@pytest.mark.parametrize("words", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"SSH-2.0-OpenSSH_9.2\r\n", b"\xff" * 30])
def test_another_program_at_the_address_is_no_scheduler(mine, capsys, words):
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=answering, args=(server, words), daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        assert command("study", mine, "--scheduler", address) == 1
    error = one_line(capsys.readouterr().err)
    assert f"no Dask scheduler answers at {address}" in error
    assert "what listens there speaks another protocol" in error
    assert not Path("runs").exists()


def test_what_listens_and_says_nothing_is_no_scheduler(mine, monkeypatch, capsys):
    monkeypatch.setattr(dask_runner, "CONNECT_SECONDS", 1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert command("study", mine, "--scheduler", f"tcp://127.0.0.1:{server.getsockname()[1]}") == 1
    assert "what listens there says nothing" in one_line(capsys.readouterr().err)
    assert not Path("runs").exists()


def answering(server, words):
    """Say the words to whoever comes, until the server is closed."""
    with suppress(OSError):
        while True:
            connection, _ = server.accept()
            connection.sendall(10 * words)


def test_a_study_that_cannot_go_on_where_it_was_begun_keeps_its_folder(mine, undrawn, capsys):
    Path("empty").mkdir()
    assert command("study", mine, "--scheduler", "nonsense", "--out", "empty") == 1
    assert [*Path("empty").iterdir()] == []
    assert command("study", mine, "--workers", 0, "--quiet") == 0
    before = sorted(Path("runs/study-mine").iterdir())
    assert command("study", mine, "--repeats", 3, "--scheduler", "nonsense") == 1
    assert sorted(Path("runs/study-mine").iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "evidence"),
    [
        (["study", "no_such_study"], ["no_such_study", "pixel_noise"]),
        (["study"], ["STUDY", "--list"]),
        (["study", "mine.toml", "--scheduler", "tcp://a:1", "--workers", 2], ["--workers"]),
        (["study", "mine.toml", "--workers", 0, "--out", "mine.toml"], ["mine.toml is a file"]),
    ],
)
def test_wrong_calls_are_refused(mine, capsys, arguments, evidence):
    assert command(*arguments) in (1, 2)
    error = capsys.readouterr().err
    assert all(word in error for word in evidence)
