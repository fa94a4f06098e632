"""Studies in one process: what an end in the middle leaves, how rows are added, what is refused,
and their table.
"""

import errno
import io
import json
import os
import warnings
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import xarray as xr
from filelock import FileLock
from rich.console import Console

from identify.errors import StudyError, StudyInterrupted
from identify.files.versions import OtherVersionsWarning, versions
from identify.progress import RichProgress, SilentProgress
from identify.scenario import load_scenario
from identify.studies import runner
from identify.studies.dask_cluster import check_workers
from identify.studies.processes import ProcessExecutor
from identify.studies.runner import BATCH_SECONDS, LARGEST_BATCH, Batches, compute, run_study
from identify.studies.store import JOURNAL, LOCK, STUDY, TABLE, VIEW
from identify.studies.study_design import Case, Finished
from identify.studies.table import figure_names, read_table, tidy_table, to_xarray, write_view
from tests.identify.commands import refusal
from tests.identify.study_rows import DARK, KIND, METHOD, journal, row, same_numbers, small_study


def run(folder, **entries):
    return run_study(small_study(**entries), folder, SilentProgress())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a study that ran without a break, and its table."""
    folder = tmp_path_factory.mktemp("whole") / "study"
    return folder, run(folder).frame


def stop(folder, rows, error=KeyboardInterrupt, **entries):
    """Run a study in a folder, one row a batch, until so many are done and Ctrl-C, or an error,
    comes; what is said.
    """

    def execute(setup, batches):
        for _ in range(rows):
            yield compute(setup, batches.next_batch(1))
        raise error

    with pytest.raises((StudyError, SystemError)) as caught:
        run_study(small_study(**entries), folder, SilentProgress(), lambda: nullcontext(execute))
    return str(caught.value)


def test_a_study_says_where_it_is_before_its_first_row_ends(tmp_path, monkeypatch):
    """Workers report now and then that nothing has finished."""
    monkeypatch.setattr("identify.progress.LINE_S", 0.0)
    executor, said = ProcessExecutor(1), io.StringIO()
    for name, answer in (("start_missing", None), ("assign_batches", True), ("wait", [])):
        monkeypatch.setattr(executor, f"_{name}", lambda *_, answer=answer: answer)

    def execute(setup, batches):
        yield next(executor(setup, batches))
        raise KeyboardInterrupt

    progress = RichProgress(Console(file=said, width=100))
    with pytest.raises(StudyError, match="0 of 18 rows"):
        run_study(small_study(), tmp_path / "a", progress, lambda: nullcontext(execute))
    assert said.getvalue().startswith("rows of mine: 0 of 18 in 0.0 s")


@pytest.mark.parametrize(("row_seconds", "workers"), [(1e-5, 1), (0.004, 2), (0.1, 8), (30.0, 3)])
def test_batches_hold_every_row_once_and_a_quarter_second_of_work(row_seconds, workers):
    batches, sizes, numbers = Batches((Case(number, 0, {}) for number in range(5000)), 5000), [], []
    while cases := batches.next_batch(workers):
        batches.update_row_time([Finished(case.number, {}, row_seconds) for case in cases])
        sizes.append(len(cases))
        numbers += [case.number for case in cases]
    assert numbers == list(range(5000))
    settled = sizes[20 : len(sizes) // 2]
    assert max(sizes) <= max(1, BATCH_SECONDS / row_seconds)
    assert max(sizes) <= LARGEST_BATCH
    assert all(
        size >= min(0.9 * BATCH_SECONDS / row_seconds - 1, 50) or size == 1 for size in settled
    )
    assert sizes[-1] <= max(1, 5000 // workers // 100)


def test_what_is_done_is_shown_while_a_study_runs_but_not_all_the_time(
    whole, tmp_path, monkeypatch
):
    """As it is in the table at the end; with no time between, after every batch, which is a row
    here.
    """
    for every, most in ((0.0, 18), (1e3, 0)):
        monkeypatch.setattr(runner, "SO_FAR_S", every)
        monkeypatch.setattr(runner, "SO_FAR_SHARE", np.inf)
        seen = []
        run_study(small_study(), tmp_path / str(every), SilentProgress(), so_far=seen.append)
        assert min(most, 2) <= len(seen) <= most
        for frame in seen:
            same_numbers(frame, whole[1].iloc[: len(frame)])


def test_after_ctrl_c_all_finished_rows_are_shown(whole, tmp_path):
    """Though the last time between two tables has not passed."""

    def execute(shared, batches):
        yield compute(shared, batches.next_batch(1))
        yield compute(shared, batches.next_batch(1))
        raise KeyboardInterrupt

    seen = []
    workers = lambda: nullcontext(execute)  # noqa: E731
    with pytest.raises(StudyInterrupted, match="2 of 18 rows"):
        run_study(small_study(), tmp_path / "a", SilentProgress(), workers, seen.append)
    assert len(seen) == 1
    same_numbers(seen[0], whole[1].iloc[:2])


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (KeyboardInterrupt, "stopped: 7 of 18 rows are done and stored"),
        (SystemError("crash"), "crash"),
    ],
)
def test_a_study_that_was_stopped_goes_on_where_it_was_and_one_that_is_done_computes_nothing(
    whole, tmp_path, monkeypatch, error, said
):
    options = {"log": str(tmp_path / "log")}
    assert stop(tmp_path / "a", 7, error, options=options) == said
    outcome = run(tmp_path / "a", options=options)
    assert outcome.found == 7
    same_numbers(outcome.frame, whole[1])
    assert sorted(map(int, (tmp_path / "log").read_text().split())) == list(range(18))
    monkeypatch.setattr(runner, "compute", None)
    again = run(tmp_path / "a", options=options)
    assert (again.found, again.rows) == (18, 18)
    pd.testing.assert_frame_equal(again.frame, outcome.frame)


@pytest.mark.parametrize(
    "torn", [b'{"number": 3, "figu', b'{"number": 3, "figures": {}, "seconds": 1.0, "error": ""}']
)
def test_a_torn_last_line_does_not_count(whole, tmp_path, torn):
    stop(tmp_path, 3)
    with (tmp_path / JOURNAL).open("ab") as file:
        file.write(torn)
    outcome = run(tmp_path)
    assert outcome.found == 3
    assert sorted(journal(tmp_path)) == list(range(18))
    same_numbers(outcome.frame, whole[1])


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        (b"\x00" * 30, "it is "),
        (
            {"figures": {"error_um": float("nan")}},
            "figures.error_um is nan: Input should be a finite number",
        ),
        ({"figures": {"error_um": 10**400}}, "figures.error_um is 10000"),
        ({"number": -1}, "number is -1"),
        ({"figure": {}}, "figure is {}: Unexpected keyword argument"),
    ],
)
def test_a_line_that_no_study_writes_is_named_and_not_taken_as_done(tmp_path, entry, says):
    run(tmp_path)
    lines = (tmp_path / JOURNAL).read_bytes().splitlines()
    lines[4] = (
        entry if isinstance(entry, bytes) else json.dumps(json.loads(lines[4]) | entry).encode()
    )
    (tmp_path / JOURNAL).write_bytes(b"\n".join(lines) + b"\n")
    message = refusal(StudyError, run, tmp_path)
    assert message.startswith(f"line 5 of {tmp_path / JOURNAL} is damaged: {says}")
    assert len(message) < 250


@pytest.mark.parametrize("part", [0, 40])
def test_full_disk_leaves_whole_lines_and_the_study_goes_on_later(
    whole, tmp_path, monkeypatch, part
):
    """The disk takes `part` bytes of the third batch and no more, as a real one may."""
    real, calls = os.write, []

    def full(file, data):
        calls.append(data)
        if len(calls) > 2 + (part > 0):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(file, data if len(calls) < 3 else data[:part])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        said = stop(tmp_path, 18)
    assert "rows.jsonl: No space left on device; name another place; 2 rows are safe" in said
    assert journal(tmp_path) == [0, 1]
    outcome = run(tmp_path)
    assert outcome.found == 2
    same_numbers(outcome.frame, whole[1])


def test_a_row_that_fails_exits_or_contradicts_itself_says_why_and_the_others_go_on(
    whole, tmp_path
):
    """Nor may a figure hide a column of the table."""
    outcome = run(tmp_path / "a", options={"fails": [2, 11], "odd": 5, "exits": [7]})
    raised = f"StudyError: kind '{KIND}' raised"
    assert outcome.failures == [
        f"row 2: {raised} ValueError: row 2 has no answer (study_rows.py, line 51)",
        "row 5: ArithmeticError: error_um is nan",
        f"row 7: {raised} SystemExit: bye (study_rows.py, line 53)",
        f"row 11: {raised} ValueError: row 11 has no answer (study_rows.py, line 51)",
    ]
    failed = outcome.frame["error"] != ""
    assert (
        outcome.frame.loc[failed, figure_names(outcome.frame, small_study())].isna().all(axis=None)
    )
    same_numbers(outcome.frame[~failed], whole[1][~failed])
    together = {
        "scenario.filter.cutoff_hz": [10.0, 40.0],
        "scenario.timing.frame_rate_hz": [60.0, 100.0],
    }
    frame = run(tmp_path / "b", factors=together).frame
    assert ["Nyquist" in error for error in frame["error"]] == [False, False, True, False] * 3
    for name in ("row", "seconds", DARK):
        errors = run(tmp_path / name, options={"also": name}, repeats=1).frame["error"]
        assert {*errors} == {
            f"ValueError: a figure must not be called {name!r}: the table has a column of this name"
        }


def test_more_repeats_are_added_to_those_that_are_there(whole, tmp_path):
    """The same table as that of a study that had them from the start, and no row is computed twice;
    also in two steps, and of a sample, whose points stay."""
    log = tmp_path / "log"
    options = {"log": str(log)}
    few = run(tmp_path / "a", options=options)
    same_numbers(few.frame, whole[1])
    assert (
        stop(tmp_path / "a", 2, options=options, repeats=5)
        == "stopped: 20 of 30 rows are done and stored"
    )
    many = run(tmp_path / "a", options=options, repeats=5)
    assert (few.rows, many.found, many.rows) == (18, 20, 30)
    assert sorted(map(int, log.read_text().split())) == list(range(30))
    same_numbers(many.frame, run(tmp_path / "b", repeats=5).frame)
    assert read_table(tmp_path / "a" / TABLE)[1].repeats == 5
    sampled = {"factors": {DARK: {"low": 1.0, "high": 50.0}}, "sample": 4}
    one, three = (run(tmp_path / "c", **sampled, repeats=repeats).frame for repeats in (1, 3))
    same_numbers(three[:4], one)
    assert three[DARK].tolist() == 3 * one[DARK].tolist()
    assert len(set(three["seed_spawn_key"])) == 12


def test_fewer_repeats_leave_the_others_out_of_the_table_but_lose_none(whole, tmp_path):
    """Also of a study that was stopped, which so ends with the repeats that it has."""
    log = tmp_path / "log"
    options = {"log": str(log)}
    stop(tmp_path / "a", 13, options=options)
    two, three = (run(tmp_path / "a", options=options, repeats=repeats) for repeats in (2, 3))
    assert (two.found, two.rows, two.surplus) == (12, 12, 1)
    same_numbers(two.frame, whole[1][:12])
    assert (three.found, three.surplus) == (13, 0)
    same_numbers(three.frame, whole[1])
    assert sorted(map(int, log.read_text().split())) == list(range(18))


def test_a_folder_or_a_table_of_another_study_or_of_another_sensor_file_is_refused(whole, tmp_path):
    mine, folder, table = tmp_path / "mine.toml", tmp_path / "a", tmp_path / "b" / TABLE
    mine.write_text('name = "mine"\nbased_on = "ctrack780"\n')
    base = {"changes": {"scenario.sensor": str(mine)}}

    def refused(**entries):
        return refusal(StudyError, lambda: run(folder, **base | entries))

    run(folder, **base)
    before, another = (
        (folder / JOURNAL).read_bytes(),
        "study.json belongs to another study, which differs in study.",
    )
    assert f"{another}seed; name" in refused(seed=5, repeats=4)
    assert f"{another}factors." in refused(factors={DARK: [1.0]})
    more = small_study().factors | {DARK: [13.0, 26.0, 52.0, 99.0]}
    assert f"{another}factors.{DARK}; name" in refused(factors=more, repeats=4)
    run(folder, title="another title", **base)
    mine.write_text('name = "mine"\nbased_on = "ctrack780"\n[lens]\npsf_px = 0.5\n')
    assert "differs in sensor.lens.psf_px" in refused()
    assert (folder / JOURNAL).read_bytes() == before
    folder = table.parent
    folder.mkdir()
    table.write_bytes((whole[0] / TABLE).read_bytes())
    assert "study.parquet belongs to another study, which differs in study.seed" in refused(
        seed=5, changes={}
    )
    pd.DataFrame({"x": [1.0]}).to_parquet(table)
    assert "study.parquet is not a table of a study" in refused()
    table.write_text("no table")
    assert "study.parquet is not a table of a study" in refused()


def test_folders_of_other_things_in_use_or_that_cannot_be_made_are_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    assert "holds thesis.tex and no study.json" in refusal(StudyError, run, tmp_path)
    assert "is a file" in refusal(StudyError, run, tmp_path / "thesis.tex")
    assert "/proc/none/here cannot be made" in refusal(StudyError, run, Path("/proc/none/here"))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    (tmp_path / "thesis.tex").unlink()
    run(tmp_path)
    with FileLock(tmp_path / LOCK):
        assert "in use by another process" in refusal(StudyError, run, tmp_path)
    assert run(tmp_path).found == 18


def test_one_warning_names_each_other_version_once_with_how_many_workers_have_it():
    here = versions()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_workers({"tcp://a:1": here, "tcp://b:1": here, "tcp://c:1": OSError("closed")})
    there = {f"tcp://{name}:1": here | {"numpy": "1.2.3"} for name in "abc"} | {
        "tcp://d:1": here | {"casadi": "3.0"}
    }
    with pytest.warns(OtherVersionsWarning) as caught:
        check_workers(there)
    assert [str(one.message) for one in caught] == [
        "figures may differ slightly between versions of packages: numpy 1.2.3 (worker tcp://a:1 and 2 "
        "more), here "
        f"{here['numpy']}; casadi 3.0 (worker tcp://d:1), here {here['casadi']}"
    ]


def test_no_rows_are_added_to_those_of_another_version_and_with_a_warning_where_only_other_packages_changed(
    tmp_path,
):
    def begun_by(**others):
        entry = json.loads((tmp_path / STUDY).read_text())
        (tmp_path / STUDY).write_text(json.dumps(entry | {"versions": entry["versions"] | others}))

    run(tmp_path, repeats=1)
    begun_by(cmmsim="9.8.7")
    kept = (tmp_path / JOURNAL).read_bytes()
    with pytest.raises(
        StudyError,
        match=r"has cmmsim 9\.8\.7, but this process has \S+; continue with that version",
    ):
        run(tmp_path, repeats=2)
    assert (tmp_path / JOURNAL).read_bytes() == kept
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run(tmp_path, repeats=1).found == 6
        (tmp_path / JOURNAL).write_bytes(b"")
        assert run(tmp_path, repeats=1).found == 0, "without rows it goes on whatever made it"
    begun_by(scipy="0.1")
    with pytest.warns(OtherVersionsWarning, match=r"scipy 0\.1 \(.*\), here"):
        run(tmp_path, repeats=2)
    entry = json.loads((tmp_path / STUDY).read_text())
    assert entry.pop("versions") == versions() | {"scipy": "0.1"}
    (tmp_path / STUDY).write_text(json.dumps(entry))
    assert run(tmp_path).found == 12, "nor need it say what made it"


def test_table_has_a_row_each_with_factors_seed_and_figures(whole):
    """Each row can be computed again from what the table says of it."""
    frame, paper = whole[1], load_scenario("paper")
    before, figures = (
        ["row", "repeat", "seed_entropy", "seed_spawn_key"],
        ["error_um", "spread_um", "rate_hz"],
    )
    assert list(frame.columns) == [*before, DARK, METHOD, *figures, "seconds", "error"]
    assert frame["row"].tolist() == list(range(18))
    for entry in frame.to_dict("records"):
        seed = np.random.SeedSequence(
            int(entry["seed_entropy"]), spawn_key=(entry["seed_spawn_key"],)
        )
        scenario = paper.with_overrides({"sensor_changes.camera.dark_noise": entry[DARK]})
        assert row(scenario, seed, {}) == {name: entry[name] for name in figures}


def test_files_hold_the_study_and_its_table_and_the_figures_by_factor_and_repeat_as_xarray_reads_them(
    whole,
):
    folder, table = whole
    frame, found = read_table(str(folder / TABLE))
    pd.testing.assert_frame_equal(frame, table)
    assert found == small_study()
    assert {"python", "cmmsim", "numpy"} <= {
        *json.loads(pq.read_schema(folder / TABLE).metadata[b"cmmsim.versions"])
    }
    assert json.loads((folder / STUDY).read_text())["sensor"]["name"] == "ctrack780"
    with xr.open_dataset(folder / VIEW) as view:
        xr.testing.assert_identical(view.load(), to_xarray(frame, found))
    assert dict(view.sizes) == {DARK: 3, METHOD: 2, "repeat": 3}
    for entry in frame.to_dict("records"):
        place = {DARK: entry[DARK], METHOD: entry[METHOD], "repeat": entry["repeat"]}
        assert float(view["error_um"].sel(place)) == entry["error_um"]


def made(figures=("position_rms_um",), **entries):
    """A table and its study of two repeats; row n has n in each figure."""
    study = small_study(**{"kind": "static_pose", "repeats": 2} | entries)
    done = [
        Finished(number, dict.fromkeys(figures, float(number)), 0.5) for number in range(study.rows)
    ]
    return tidy_table(study, done), study


def test_view_of_a_sample_has_points_with_the_factors_as_coordinates_and_all_carry_their_units():
    factors = {DARK: {"low": 1.0, "high": 50.0}, "options.pair": [[1, 2], [3, 4]]}
    frame, study = made(kind="my:row", factors=factors, sample=5, repeats=2)
    view = to_xarray(frame, study)
    assert dict(view.sizes) == {"point": 5, "repeat": 2}
    assert view[DARK].values.tolist() == frame[DARK][:5].tolist()
    assert set(frame["options.pair"]) <= {"[1, 2]", "[3, 4]"}
    assert view["position_rms_um"].values.T.ravel().tolist() == list(range(10))
    view = to_xarray(*made(figures=("position_rms_um", "stickers")))
    units = {
        "position_rms_um": "um",
        "stickers": None,
        "seconds": "s",
        DARK: "electrons",
        METHOD: None,
        "repeat": None,
    }
    assert {name: view[name].attrs.get("units") for name in view.variables} == units


@pytest.mark.parametrize(
    "factors", [{}, {"options.fast": [True, False]}, {"options.pair": [[1, 2], [3]]}]
)
def test_any_factor_and_any_name_of_a_figure_can_be_written(tmp_path, factors):
    frame, study = made(figures=("rate_1/s", "größe m"), kind="my:row", factors=factors)
    write_view(tmp_path / VIEW, frame, study)
    with xr.open_dataset(tmp_path / VIEW) as found:
        assert {*found.data_vars} == {"rate_1_per_s", "größe m", "seconds"}
        assert sorted(found["rate_1_per_s"].values.ravel().tolist()) == list(range(study.rows))


def test_full_disk_leaves_the_old_view_and_one_line(tmp_path, monkeypatch):
    path = tmp_path / VIEW
    path.write_text("old")
    monkeypatch.setattr(
        xr.Dataset, "to_netcdf", Mock(side_effect=OSError(28, "No space left on device"))
    )
    with pytest.raises(StudyError, match=r"study\.nc: No space left on device"):
        write_view(path, *made())
    assert path.read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == [VIEW]
