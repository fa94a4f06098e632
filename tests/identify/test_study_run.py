"""Studies in one process: what an end in the middle leaves, how rows are added to a folder, and what it refuses.

One study, one version: workers of a cluster are asked here as they answer; real ones are in `test_study_cluster`.
"""

import errno
import fcntl
import json
import os
import warnings
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest

from identify.errors import StudyError, StudyInterrupted
from identify.files.versions import OtherVersionsWarning, versions
from identify.progress import SilentProgress
from identify.studies import runner
from identify.studies.dask_cluster import check_workers
from identify.studies.design import Case, Finished
from identify.studies.runner import BATCH_SECONDS, LARGEST_BATCH, Batches, compute, run_study
from identify.studies.store import JOURNAL, LOCK, STUDY, TABLE
from identify.studies.study_file import Study
from identify.studies.table import figure_names, read_table
from tests.identify.commands import refusal
from tests.identify.study_rows import KIND, journal, same_numbers

DARK, METHOD = "sensor.camera.dark_noise", "scenario.pose_method"
FACTORS = {DARK: [13.0, 26.0, 52.0], METHOD: ["registration", "planes"]}


def study(**entries):
    return Study(**{"name": "mine", "kind": KIND, "factors": FACTORS, "repeats": 3, "seed": 4} | entries)


def run(folder, chosen=None):
    return run_study(chosen or study(), folder, SilentProgress())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a study that ran without a break, and its table."""
    folder = tmp_path_factory.mktemp("whole") / "study"
    return folder, run(folder).frame


def stopping_after(rows, error):
    """Workers that compute so many rows, one a batch, and then fail."""

    def execute(setup, batches):
        for _ in range(rows):
            yield compute(setup, batches.take(1))
        raise error

    @contextmanager
    def workers():
        yield execute

    return workers


def stop(folder, rows, chosen=None, error=None):
    """Run a study in a folder until so many rows are done and Ctrl-C, or an error, comes; what is then raised."""
    workers = stopping_after(rows, error or KeyboardInterrupt())
    with pytest.raises(type(error) if error else StudyInterrupted) as caught:
        run_study(chosen or study(), folder, SilentProgress(), workers)
    return str(caught.value)


@pytest.mark.parametrize(("row_seconds", "workers"), [(1e-5, 1), (0.004, 2), (0.1, 8), (30.0, 3)])
def test_batches_hold_every_row_once_and_a_quarter_second_of_work(row_seconds, workers):
    batches, sizes, numbers = Batches((Case(number, 0, {}) for number in range(5000)), 5000), [], []
    while cases := batches.take(workers):
        batches.learn([Finished(case.number, {}, row_seconds) for case in cases])
        sizes.append(len(cases))
        numbers += [case.number for case in cases]
    assert numbers == list(range(5000))
    settled = sizes[20 : len(sizes) // 2]
    assert max(sizes) <= max(1, BATCH_SECONDS / row_seconds)
    assert max(sizes) <= LARGEST_BATCH
    assert all(size >= min(0.9 * BATCH_SECONDS / row_seconds - 1, 50) or size == 1 for size in settled)
    assert sizes[-1] <= max(1, 5000 // workers // 100)


@pytest.mark.parametrize("error", [None, SystemError("crash")])
def test_a_study_that_was_stopped_goes_on_where_it_was_and_one_that_is_done_computes_nothing(
    whole, tmp_path, monkeypatch, error
):
    chosen = study(options={"log": str(tmp_path / "log")})
    assert stop(tmp_path / "a", 7, chosen, error) in ("stopped: 7 of 18 rows are done and kept", "crash")
    outcome = run(tmp_path / "a", chosen)
    assert outcome.found == 7
    same_numbers(outcome.frame, whole[1])
    assert sorted(map(int, (tmp_path / "log").read_text().split())) == list(range(18))
    monkeypatch.setattr(runner, "compute", None)
    again = run(tmp_path / "a", chosen)
    assert (again.found, again.rows) == (18, 18)
    pd.testing.assert_frame_equal(again.frame, outcome.frame)


@pytest.mark.parametrize("torn", [b'{"number": 3, "figu', b'{"number": 3, "figures": {}, "seconds": 1.0, "error": ""}'])
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
        ({"figures": {"error_um": float("nan")}}, "figures.error_um is nan: Input should be a finite number"),
        ({"figures": {"error_um": 10**400}}, "figures.error_um is 10000"),
        ({"number": -1}, "number is -1"),
        ({"figure": {}}, "figure is {}: Unexpected keyword argument"),
    ],
)
def test_a_line_that_no_study_writes_is_named_and_not_taken_as_done(tmp_path, entry, says):
    run(tmp_path)
    lines = (tmp_path / JOURNAL).read_bytes().splitlines()
    lines[4] = entry if isinstance(entry, bytes) else json.dumps(json.loads(lines[4]) | entry).encode()
    (tmp_path / JOURNAL).write_bytes(b"\n".join(lines) + b"\n")
    message = refusal(StudyError, run, tmp_path)
    assert message.startswith(f"line 5 of {tmp_path / JOURNAL} is damaged: {says}")
    assert len(message) < 250


@pytest.mark.parametrize("part", [0, 40])
def test_full_disk_leaves_whole_lines_and_the_study_goes_on_later(whole, tmp_path, monkeypatch, part):
    """The disk takes `part` bytes of the third batch and no more, as a real one may."""
    real, calls = os.pwrite, []

    def full(file, data, offset):
        calls.append(len(data))
        if len(calls) < 3:
            return real(file, data, offset)
        if len(calls) == 3 and part:
            return real(file, data[:part], offset)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        with pytest.raises(StudyError, match=r"rows.jsonl cannot be written: No space left on device; 2 rows are safe"):
            run_study(study(), tmp_path, SilentProgress(), stopping_after(18, AssertionError()))
    assert journal(tmp_path) == [0, 1]
    outcome = run(tmp_path)
    assert outcome.found == 2
    same_numbers(outcome.frame, whole[1])


def test_a_row_that_fails_exits_or_contradicts_itself_says_why_and_the_others_go_on(whole, tmp_path):
    outcome = run(tmp_path / "a", study(options={"fails": [2, 11], "odd": 5, "exits": [7]}))
    assert outcome.failures == [
        "row 2: ValueError: row 2 has no answer",
        "row 5: ArithmeticError: error_um is nan",
        "row 7: SystemExit: bye",
        "row 11: ValueError: row 11 has no answer",
    ]
    failed = outcome.frame["error"] != ""
    assert outcome.frame.loc[failed, figure_names(outcome.frame, study())].isna().all(axis=None)
    same_numbers(outcome.frame[~failed], whole[1][~failed])
    together = {"scenario.filter.cutoff_hz": [10.0, 40.0], "scenario.timing.frame_rate_hz": [60.0, 100.0]}
    frame = run(tmp_path / "b", study(factors=together)).frame
    assert ["Nyquist" in error for error in frame["error"]] == [False, False, True, False] * 3


@pytest.mark.parametrize("name", ["row", "seconds", DARK])
def test_a_figure_that_would_hide_a_column_is_an_error_of_the_row(tmp_path, name):
    frame = run(tmp_path, study(options={"also": name}, repeats=1)).frame
    assert set(frame["error"]) == {
        f"ValueError: a figure must not be called {name!r}: the table has a column of this name"
    }


def test_more_repeats_are_added_to_those_that_are_there(whole, tmp_path):
    """The same table as that of a study that had them from the start, and no row is computed twice; also in two
    steps, and of a sample, whose points stay."""
    log, more = tmp_path / "log", {"repeats": 5}
    chosen = study(options={"log": str(log)})
    few = run(tmp_path / "a", chosen)
    same_numbers(few.frame, whole[1])
    assert stop(tmp_path / "a", 2, chosen.model_copy(update=more)) == "stopped: 20 of 30 rows are done and kept"
    many = run(tmp_path / "a", chosen.model_copy(update=more))
    assert (few.rows, many.found, many.rows) == (18, 20, 30)
    assert sorted(map(int, log.read_text().split())) == list(range(30))
    same_numbers(many.frame, run(tmp_path / "b", study(**more)).frame)
    assert read_table(tmp_path / "a" / TABLE)[1].repeats == 5
    sampled = study(factors={DARK: {"low": 1.0, "high": 50.0}}, sample=4, repeats=1)
    one = run(tmp_path / "c", sampled).frame
    three = run(tmp_path / "c", sampled.model_copy(update={"repeats": 3})).frame
    same_numbers(three[:4], one)
    assert three[DARK].tolist() == 3 * one[DARK].tolist()
    assert len(set(three["seed_spawn_key"])) == 12


def test_fewer_repeats_leave_the_others_out_of_the_table_but_lose_none(whole, tmp_path):
    """Also of a study that was stopped, which so ends with the repeats that it has."""
    log = tmp_path / "log"
    chosen = study(options={"log": str(log)})
    stop(tmp_path / "a", 13, chosen)
    two = run(tmp_path / "a", chosen.model_copy(update={"repeats": 2}))
    assert (two.found, two.rows, two.beyond) == (12, 12, 1)
    same_numbers(two.frame, whole[1][:12])
    three = run(tmp_path / "a", chosen)
    assert (three.found, three.beyond) == (13, 0)
    same_numbers(three.frame, whole[1])
    assert sorted(map(int, log.read_text().split())) == list(range(18))


def test_the_folder_of_another_study_or_of_another_sensor_file_is_refused(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('name = "mine"\nbased_on = "ctrack780"\n')
    base = {"changes": {"scenario.sensor": str(mine)}}
    folder = tmp_path / "a"
    run(folder, study(**base))
    before = (folder / JOURNAL).read_bytes()
    for other, differs in (
        ({"seed": 5, "repeats": 4}, "study.seed; name"),
        ({"factors": {DARK: [1.0]}}, "study.factors."),
        ({"factors": FACTORS | {DARK: [13.0, 26.0, 52.0, 99.0]}, "repeats": 4}, f"study.factors.{DARK}; name"),
    ):
        message = refusal(StudyError, run, folder, study(**base | other))
        assert f"study.json is of another study, which differs in {differs}" in message
    run(folder, study(title="another title", **base))
    mine.write_text('name = "mine"\nbased_on = "ctrack780"\n[lens]\npsf_px = 0.5\n')
    assert "differs in sensor.lens.psf_px" in refusal(StudyError, run, folder, study(**base))
    assert (folder / JOURNAL).read_bytes() == before


def test_a_table_of_another_study_is_refused(whole, tmp_path):
    (tmp_path / TABLE).write_bytes((whole[0] / TABLE).read_bytes())
    message = refusal(StudyError, run, tmp_path, study(seed=5))
    assert "study.parquet is of another study, which differs in study.seed" in message
    pd.DataFrame({"x": [1.0]}).to_parquet(tmp_path / TABLE)
    assert "study.parquet is no table of a study" in refusal(StudyError, run, tmp_path)
    (tmp_path / TABLE).write_text("no table")
    assert "study.parquet is no table of a study" in refusal(StudyError, run, tmp_path)


def test_folders_of_other_things_in_use_or_that_cannot_be_made_are_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    assert "holds thesis.tex and no study.json" in refusal(StudyError, run, tmp_path)
    assert "is a file" in refusal(StudyError, run, tmp_path / "thesis.tex")
    assert "/proc/none/here cannot be made" in refusal(StudyError, run, Path("/proc/none/here"))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    (tmp_path / "thesis.tex").unlink()
    run(tmp_path)
    with (tmp_path / LOCK).open("a+") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert "in use by another process" in refusal(StudyError, run, tmp_path)
    assert run(tmp_path).found == 18


def begun_by(folder, **changes):
    """Say in the folder that other versions began it."""
    entry = json.loads((folder / STUDY).read_text())
    (folder / STUDY).write_text(json.dumps(entry | {"versions": entry["versions"] | changes}))


def test_one_warning_names_each_other_version_once_with_how_many_workers_have_it():
    here = versions()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_workers({"tcp://a:1": here, "tcp://b:1": here, "tcp://c:1": OSError("closed")})
    there = {f"tcp://{name}:1": here | {"numpy": "1.2.3"} for name in "abc"} | {"tcp://d:1": here | {"casadi": "3.0"}}
    with pytest.warns(OtherVersionsWarning) as caught:
        check_workers(there)
    assert [str(one.message) for one in caught] == [
        "figures may differ a little where versions do: numpy 1.2.3 (worker tcp://a:1 and 2 more), here "
        f"{here['numpy']}; casadi 3.0 (worker tcp://d:1), here {here['casadi']}"
    ]


def test_no_rows_are_added_to_those_of_another_version_and_with_a_warning_where_only_other_packages_changed(tmp_path):
    few, more = study(repeats=1), study(repeats=2)
    run(tmp_path, few)
    begun_by(tmp_path, cmmsim="9.8.7")
    kept = (tmp_path / JOURNAL).read_bytes()
    with pytest.raises(StudyError, match=r"has cmmsim 9\.8\.7, here is \S+; go on with that version"):
        run(tmp_path, more)
    assert (tmp_path / JOURNAL).read_bytes() == kept
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run(tmp_path, few).found == 6
        (tmp_path / JOURNAL).write_bytes(b"")
        assert run(tmp_path, few).found == 0, "without rows it goes on whatever made it"
    begun_by(tmp_path, scipy="0.1")
    with pytest.warns(OtherVersionsWarning, match=r"scipy 0\.1 \(.*\), here"):
        run(tmp_path, more)
    entry = json.loads((tmp_path / STUDY).read_text())
    assert entry.pop("versions") == versions() | {"scipy": "0.1"}
    (tmp_path / STUDY).write_text(json.dumps(entry))
    assert run(tmp_path, study(repeats=3)).found == 12, "nor need it say what made it"
