"""The command ``cmmsim study`` in this process."""

import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from identify.commands import study as study_command
from identify.commands.help import BEYOND_LIMIT, ROWS_FAILED
from identify.studies import dask_cluster, summary
from identify.studies.rows import KINDS
from identify.studies.study_file import STUDIES, load_study
from identify.studies.table import read_table
from tests.identify.commands import command, one_line
from tests.identify.study_rows import KIND


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """The file of a small study in a folder of its own, whose figures are not drawn: they take
    longer than the rows.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(summary, "draw", lambda *_: None)
    path, factors = tmp_path / "mine.toml", "[factors]\nsensor.camera.dark_noise = [13.0, 26.0]"
    path.write_text(f'name = "mine"\nkind = "{KIND}"\nrepeats = 2\n{factors}\n[options]\n')
    return path


def test_study_leaves_its_files_adds_repeats_in_the_same_folder_and_says_nothing_where_it_is_quiet(
    mine, capsys
):
    """Brackets in the name of the folder are shown as they are."""
    for more, progress, says in (
        ([], "rows of mine: 4 of 4", "4 rows; "),
        (["--repeats", 3], "rows of mine: 2 of 2", "6 rows, 4 of them from before; "),
        ([], "", "4 rows, 4 of them from before (2 rows of further repeats stay stored); "),
    ):
        assert command("study", mine, "--workers", 0, "--out", "a[bold]", *more) == 0
        shown = capsys.readouterr()
        assert says in shown.out
        assert "study.parquet: a[bold]\n" in shown.out
        assert progress in shown.err
        assert ("rows/s" in shown.err) == bool(progress)
        frame, study = read_table("a[bold]/study.parquet")
        assert len(frame) == 2 * study.repeats
    assert command("study", mine, "--workers", 0, "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    files = {"study.json", "rows.jsonl", "study.parquet", "study.nc", "summary.json", "summary.md"}
    assert files <= {path.name for path in Path("runs/study-mine").iterdir()}


@pytest.mark.parametrize(
    ("fails", "figure", "exponents", "status", "says"),
    [
        ([], "spread_um", [0.0], 0, ""),
        ([], "spread_um", [3.0, 0.0, 4.0], BEYOND_LIMIT, "2 of 3 laws failed; failed: spread_um ~"),
        ([], "error_um", [1.0], 0, ""),
        ([1], "spread_um", [0.0], ROWS_FAILED, "8 rows failed; row 1: StudyError: kind 'tests."),
        ([1], "spread_um", [9.0], ROWS_FAILED, "1 of 1 laws failed"),
    ],
)
def test_rows_or_laws_that_fail_make_an_exit_status_of_their_own(
    mine, capsys, fails, figure, exponents, status, says
):
    """One figure is the standard deviation of 1,000 normal numbers whatever the factor, the other
    hardly known.
    """
    theory = "".join(
        f'[[theory]]\nfigure = "{figure}"\nfactor = "sensor.camera.dark_noise"\nexponent = '
        f"{exponent}\n"
        for exponent in exponents
    )
    mine.write_text(
        mine.read_text().replace("repeats = 2", "repeats = 4") + f"fails = {fails}\n" + theory
    )
    assert command("study", mine, "--workers", 0, "--out", "a") == status
    shown = capsys.readouterr()
    assert shown.out.startswith(
        "undecided: error_um" if figure == "error_um" else ("passed: ", "failed: ")
    )
    assert says in shown.err
    assert shown.err.count("expected") == sum(exponent > 1.0 for exponent in exponents)
    frame, _ = read_table("a/study.parquet")
    assert frame.index[frame["error"] != ""].tolist() == fails


def test_studies_are_listed_with_their_rows_and_kinds_with_options_figures_and_what_they_read(
    capsys,
):
    assert command("study", "--list") == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line]
    assert {(name, f"{load_study(name).rows:,}") for name in STUDIES.names()} <= {
        tuple(line[:2]) for line in lines
    }
    assert command("study", "--kinds") == 0
    shown = capsys.readouterr().out
    lines = [line.split() for line in shown.splitlines() if line]
    for kind in KINDS.values():
        assert f"{kind.name}: {kind.what}\n" in shown
        assert f"\nIt reads {kind.reads}, and its options" in shown
        for name, column in kind.columns.items():
            start = [name, *column.unit.removeprefix("1").split()]
            assert any(line[: len(start)] == start for line in lines), name
        assert {f"options.{name}" for name in kind.options.model_fields} <= {
            one[0] for one in lines
        }
    assert ["options.stretch_s", "0.5", "s"] in [line[:3] for line in lines]


def test_a_file_is_shown_and_single_entries_are_replaced(mine, capsys):
    assert command("study", "--show", "pixel_noise") == 0
    Path("theirs.toml").write_text(capsys.readouterr().out)
    assert load_study("theirs.toml") == load_study("pixel_noise")
    changes = (
        "--set",
        "sensor.camera.dark_noise=[1.0,2.0,3.0]",
        "--set",
        "sensor.rig.baseline=0.9",
        "--seed",
        5,
    )
    assert (
        command(
            "study", mine, "--workers", 0, "--out", "a", "--quiet", "--set", "repeats=1", *changes
        )
        == 0
    )
    frame, study = read_table("a/study.parquet")
    assert frame["sensor.camera.dark_noise"].tolist() == [1.0, 2.0, 3.0]
    assert (study.seed, study.changes, study.repeats) == (5, {"sensor.rig.baseline": 0.9}, 1)
    for setting, says in (
        (
            "reapeats=2",
            "unknown key 'reapeats' of study 'mine'; valid names: name, title, kind, scenario, "
            "sample, ",
        ),
        (
            "sensor.camera.darkness=2",
            "unknown key 'sensor.camera.darkness'; the nearest are sensor.camera.dark_noise",
        ),
        (
            "renderer=statistical",
            "unknown key 'renderer' of study 'mine'; did you mean scenario.rend",
        ),
        ("lens.psf_px=0.5", "did you mean sensor.lens.psf_px? Other valid names: name, title"),
        ("repeats=many", "repeats = 'many': input should be a valid integer"),
        (
            "scenario.timing.latency_s=late",
            "scenario.timing.latency_s = 'late': input should be a valid number",
        ),
        ("repeats", "is not of the form KEY=VALUE"),
    ):
        assert command("study", mine, "--workers", 0, "--out", "b", "--set", setting) == 1
        assert says in one_line(capsys.readouterr().err)
    assert command("study", "--show", "none") == 1
    assert "neither built in (baseline, " in one_line(capsys.readouterr().err)
    assert not Path("b").exists()


def test_ten_million_rows_are_refused_at_once_and_many_are_run_where_confirmed(
    mine, capsys, monkeypatch
):
    keys = ("dsnu", "dark_noise", "black_level", "gain", "full_well", "electrons_at_white")
    factors = "\n".join(f"sensor.camera.{name} = {[*range(1, 11)]}" for name in keys)
    Path("many.toml").write_text(
        f'name = "many"\nkind = "{KIND}"\nrepeats = 10\n[factors]\n{factors}\n'
    )
    assert command("study", "many.toml", "--out", "a") == 1
    assert "10,000,000 rows; confirm more than 100,000 rows by --yes" in one_line(
        capsys.readouterr().err
    )
    assert not Path("a").exists()
    monkeypatch.setattr(study_command, "MANY_ROWS", 3)
    assert command("study", mine, "--workers", 0, "--quiet") == 1
    assert command("study", mine, "--workers", 0, "--quiet", "--yes") == 0


@pytest.fixture(params=[b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\xff" * 30, b""])
def another_program(request):
    """The address of a program that says these words, or nothing, to whoever comes; and what is
    said of it.
    """

    def answer():
        with suppress(OSError):
            while request.param:
                connection, _ = server.accept()
                connection.sendall(10 * request.param)

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=answer, daemon=True).start()
        yield (
            f"tcp://127.0.0.1:{server.getsockname()[1]}",
            "another protocol" if request.param else "does not answer",
        )


def test_a_cluster_without_dask_is_one_line_and_rows_here_need_none(mine, monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "identify.studies.dask_cluster")
    for name in ("dask", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    assert command("study", mine, "--workers", 0, "--quiet") == 0
    assert command("study", mine, "--scheduler", "tcp://127.0.0.1:1") == 1
    assert "pip install '.[cluster]'" in one_line(capsys.readouterr().err)
    assert command("study", mine, "--insecure") == 2


@pytest.mark.slow
def test_where_no_scheduler_answers_there_is_one_line_and_nothing_left_or_what_was_there(
    mine, another_program, monkeypatch, capsys
):
    def unchanged(folder, *arguments):
        before = sorted(Path(folder).rglob("*"))
        assert command("study", mine, *arguments) == 1
        assert sorted(Path(folder).rglob("*")) == before
        return one_line(capsys.readouterr().err)

    monkeypatch.setattr(dask_cluster, "CONNECT_SECONDS", 0.5)
    for address, why in (another_program, ("tcp://127.0.0.1:1", ""), ("nonsense", "")):
        error = unchanged(".", "--scheduler", address)
        assert f"no Dask scheduler answers at {address}" in error
        assert why in error
    Path("empty").mkdir()
    unchanged(".", "--scheduler", "nonsense", "--out", "empty")
    assert command("study", mine, "--workers", 0, "--quiet") == 0
    unchanged("runs", "--repeats", 3, "--scheduler", "nonsense")


@pytest.mark.slow
def test_another_study_is_drawn_beside_one_and_refused_where_it_has_other_factors(mine, capsys):
    assert (
        command("study", mine, "--workers", 0, "--quiet", "--set", "repeats=3", "--out", "other")
        == 0
    )
    assert command("study", mine, "--workers", 0, "--quiet", "--beside", "other") == 0
    drawn = Path("runs/study-mine/figures/side_by_side_sensor.camera.dark_noise.svg").read_text()
    assert "study mine" in drawn
    assert "study other" in drawn
    plain = ("--set", "sensor.camera.dark_noise=8.0", "--workers", 0, "--quiet", "--out")
    for folder, beside in (
        ("mine", ()),
        ("one", ()),
        ("two", ("--beside", "one", "--beside", "mine")),
    ):
        assert command("study", mine, *plain, folder, *beside) == 0
    drawn = Path(
        "two/figures/side_by_side_study.svg"
    ).read_text()  # against the studies: they vary nothing
    assert all(name in drawn for name in (">mine<", ">one<", "/mine<"))  # three studies of one name
    capsys.readouterr()
    levels = "sensor.rig.baseline=[0.5,1.0]"
    assert (
        command("study", mine, "--workers", 0, "--set", levels, "--out", "new", "--beside", "other")
        == 1
    )
    assert "other has rows of kind" in capsys.readouterr().err
    assert not Path("new").exists()


def test_rows_that_need_more_memory_than_there_is_are_refused_with_the_workers_that_would_fit(
    tmp_path, capsys, monkeypatch
):
    """216,000 frames of an hour take some 4 GB."""
    for there, evidence in ((9e9, "--workers 2 fits"), (3e9, "shorten")):
        monkeypatch.setattr(
            psutil, "virtual_memory", lambda there=there: SimpleNamespace(total=there)
        )
        words = (
            "--set",
            "scenario.excitation.duration_s=[10.0,3600.0]",
            "--workers",
            3,
            "--out",
            tmp_path / "a",
        )
        assert command("study", "parameter_groups", *words) == 1
        assert evidence in capsys.readouterr().err
    words = ("--set", "options.stretch_s=[1.0,3600.0]", "--workers", 3, "--out", tmp_path / "a")
    assert command("study", "frame_rate", *words) == 1  # of a path: 216,000 frames take some 1.4 GB
    assert "--workers 2 fits" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_a_text_among_lengths_of_records_is_refused_before_memory_is_looked_at(tmp_path, capsys):
    mixed = 'scenario.excitation.duration_s=[10.0, "b"]'
    assert command("study", "parameter_groups", "--set", mixed, "--out", tmp_path / "a") == 1
    assert "scenario.excitation.duration_s = 'b'" in one_line(capsys.readouterr().err)


def test_wrong_calls_are_refused_in_the_words_of_the_options(mine, capsys):
    for words, evidence in (
        ((), "--list"),
        ((mine, "--scheduler", "tcp://a:1", "--workers", 2), "--workers"),
        ((mine, "--repeats", 0), "--repeats"),
    ):
        assert command("study", *words) == 2
        assert evidence in capsys.readouterr().err
