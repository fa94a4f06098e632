"""Studies in one process: what is written, what an end in the middle leaves, and what is refused."""

import errno
import fcntl
import json
import os

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from identify.errors import StudyError, StudyInterrupted
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.studies import runner
from identify.studies.design import Case, Finished
from identify.studies.runner import BATCH_SECONDS, LARGEST_BATCH, Batches, compute, run_study
from identify.studies.store import JOURNAL, LOCK, STUDY, TABLE
from identify.studies.study_file import Study
from identify.studies.table import figure_names, read_table, to_xarray
from tests.identify.study_rows import KIND, row

DARK, METHOD = "sensor.camera.dark_noise", "scenario.pose_method"
FACTORS = {DARK: [13.0, 26.0, 52.0], METHOD: ["registration", "planes"]}


def study(**entries):
    return Study(**{"name": "mine", "kind": KIND, "factors": FACTORS, "repeats": 3, "seed": 4} | entries)


def run(folder, chosen=None):
    return run_study(chosen or study(), folder, SilentProgress())


def same_numbers(one, other):
    pd.testing.assert_frame_equal(one.drop(columns="seconds"), other.drop(columns="seconds"), check_exact=True)


def journal_rows(folder):
    return [json.loads(line)["number"] for line in (folder / JOURNAL).read_text().splitlines()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A study that ran without a break."""
    folder = tmp_path_factory.mktemp("whole") / "study"
    return folder, run(folder)


def stopping_after(rows, error):
    """Workers that compute so many rows, one a batch, and then fail."""

    def execute(setup, batches):
        for _ in range(rows):
            yield compute(setup, [next(batches._cases)])
        raise error

    class Workers:
        def __enter__(self):
            return execute

        def __exit__(self, *_):
            pass

    return Workers


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


def test_table_has_a_row_each_with_factors_seed_and_figures(whole):
    """Each row can be computed again from what the table says of it."""
    frame, paper = whole[1].frame, load_scenario("paper")
    assert list(frame.columns) == [
        "row",
        "repeat",
        "seed_entropy",
        "seed_spawn_key",
        DARK,
        METHOD,
        "error_um",
        "spread_um",
        "rate_hz",
        "seconds",
        "error",
    ]
    assert frame["row"].tolist() == list(range(18))
    for entry in frame.to_dict("records"):
        seed = np.random.SeedSequence(int(entry["seed_entropy"]), spawn_key=(entry["seed_spawn_key"],))
        scenario = paper.with_overrides({"sensor_changes.camera.dark_noise": entry[DARK]})
        assert row(scenario, seed, {}) == {name: entry[name] for name in ("error_um", "spread_um", "rate_hz")}


def test_parquet_holds_the_table_and_the_study(whole):
    folder, outcome = whole
    frame, found = read_table(folder / TABLE)
    pd.testing.assert_frame_equal(frame, outcome.frame)
    assert found == study()
    versions = json.loads(pq.read_schema(folder / TABLE).metadata[b"cmmsim.versions"])
    assert {"python", "cmmsim", "numpy"} <= set(versions)
    assert json.loads((folder / STUDY).read_text())["sensor"]["name"] == "ctrack780"


def test_view_has_the_figures_by_factor_and_repeat(whole):
    frame = whole[1].frame
    view = to_xarray(frame, study())
    assert dict(view.sizes) == {DARK: 3, METHOD: 2, "repeat": 3}
    assert list(view[METHOD].values) == FACTORS[METHOD]
    for entry in frame.to_dict("records"):
        place = {DARK: entry[DARK], METHOD: entry[METHOD], "repeat": entry["repeat"]}
        assert float(view["error_um"].sel(place)) == entry["error_um"]


def test_view_of_a_sample_has_points_with_the_factors_as_coordinates(tmp_path):
    chosen = study(factors={DARK: {"low": 1.0, "high": 50.0}, "options.pair": [[1, 2], [3, 4]]}, sample=5, repeats=2)
    frame = run(tmp_path / "a", chosen).frame
    view = to_xarray(frame, chosen)
    assert dict(view.sizes) == {"point": 5, "repeat": 2}
    assert view[DARK].values.tolist() == frame[DARK][:5].tolist()
    assert set(frame["options.pair"]) <= {"[1, 2]", "[3, 4]"}
    assert view["error_um"].values.T.ravel().tolist() == frame["error_um"].tolist()


def test_a_study_that_is_done_computes_nothing_again(whole, monkeypatch):
    folder, outcome = whole
    monkeypatch.setattr(runner, "compute", None)
    again = run(folder)
    assert (again.found, again.rows) == (18, 18)
    pd.testing.assert_frame_equal(again.frame, outcome.frame)


@pytest.mark.parametrize(("error", "raised"), [(KeyboardInterrupt(), StudyInterrupted), (SystemError(), SystemError)])
def test_a_study_that_was_stopped_goes_on_where_it_was(whole, tmp_path, error, raised):
    log = tmp_path / "log"
    chosen = study(options={"log": str(log)})
    with pytest.raises(raised) as caught:
        run_study(chosen, tmp_path / "a", SilentProgress(), stopping_after(7, error))
    if raised is StudyInterrupted:
        assert "7 of 18 rows are done" in str(caught.value)
    outcome = run(tmp_path / "a", chosen)
    assert outcome.found == 7
    same_numbers(outcome.frame, whole[1].frame)
    assert sorted(map(int, log.read_text().split())) == list(range(18))


@pytest.mark.parametrize("torn", [b'{"number": 3, "figu', b'{"number": 3, "figures": {}, "seconds": 1.0, "error": ""}'])
def test_a_torn_last_line_does_not_count(whole, tmp_path, torn):
    with pytest.raises(StudyInterrupted):
        run_study(study(), tmp_path, SilentProgress(), stopping_after(3, KeyboardInterrupt()))
    with (tmp_path / JOURNAL).open("ab") as file:
        file.write(torn)
    outcome = run(tmp_path)
    assert outcome.found == 3
    assert sorted(journal_rows(tmp_path)) == list(range(18))
    same_numbers(outcome.frame, whole[1].frame)


def test_a_damaged_line_in_the_middle_is_named(tmp_path):
    run(tmp_path)
    lines = (tmp_path / JOURNAL).read_bytes().splitlines(keepends=True)
    (tmp_path / JOURNAL).write_bytes(b"".join([*lines[:4], b"\x00" * 30 + b"\n", *lines[5:]]))
    with pytest.raises(StudyError, match=r"line 5 of .*rows.jsonl is damaged"):
        run(tmp_path)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ({"figures": {"error_um": "four"}}, "figures.error_um is 'four': Input should be a valid number"),
        ({"figures": {"error_um": float("nan")}}, "figures.error_um is nan: Input should be a finite number"),
        ({"figures": {"error_um": 10**400}}, "error_um is 10000"),
        ({"figures": {"error_um": True}}, "error_um is True"),
        ({"figures": [1.0]}, "figures is [1.0]"),
        ({"seconds": None}, "seconds is None"),
        ({"number": "3"}, "number is '3'"),
        ({"number": -1}, "number is -1"),
        ({"error": None}, "error is None"),
        ({"figure": {}}, "figure is {}: Unexpected keyword argument"),
    ],
)
def test_a_line_with_what_no_study_writes_is_named_and_not_taken_as_done(tmp_path, entry, says):
    run(tmp_path)
    lines = (tmp_path / JOURNAL).read_text().splitlines()
    lines[4] = json.dumps(json.loads(lines[4]) | entry)
    (tmp_path / JOURNAL).write_text("\n".join(lines) + "\n")
    with pytest.raises(StudyError) as caught:
        run(tmp_path)
    assert str(caught.value).startswith(f"line 5 of {tmp_path / JOURNAL} is damaged: ")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250


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
    assert journal_rows(tmp_path) == [0, 1]
    outcome = run(tmp_path)
    assert outcome.found == 2
    same_numbers(outcome.frame, whole[1].frame)


def test_a_failing_row_says_why_and_the_others_go_on(whole, tmp_path):
    outcome = run(tmp_path, study(options={"fails": [2, 11], "odd": 5}))
    frame = outcome.frame
    assert len(outcome.failures) == 3
    assert outcome.failures[0] == "row 2: ValueError: row 2 has no answer"
    assert frame["error"][5] == "ArithmeticError: error_um is nan"
    failed = frame["row"].isin([2, 5, 11])
    assert frame.loc[failed, figure_names(frame, study())].isna().all(axis=None)
    same_numbers(frame[~failed], whole[1].frame[~failed])


def test_a_row_that_exits_the_program_is_an_error_of_this_row(whole, tmp_path):
    frame = run(tmp_path, study(options={"exits": [2]})).frame
    assert frame["error"][2] == "SystemExit: bye"
    same_numbers(frame.drop(index=2), whole[1].frame.drop(index=2))


def test_ctrl_c_in_a_row_stops_the_study_and_is_no_error_of_the_row(whole, tmp_path):
    with pytest.raises(StudyInterrupted, match=r"stopped: \d+ of 18 rows are done"):
        run(tmp_path, study(options={"interrupt": 7}))
    assert set(journal_rows(tmp_path)) <= set(range(7))


@pytest.mark.parametrize("name", ["row", "seconds", DARK])
def test_a_figure_that_would_hide_a_column_is_an_error_of_the_row(tmp_path, name):
    frame = run(tmp_path, study(options={"also": name}, repeats=1)).frame
    words = f"ValueError: a figure must not be called {name!r}: the table has a column of this name"
    assert set(frame["error"]) == {words}
    assert frame["row"].tolist() == list(range(6))


def test_factors_that_contradict_each_other_in_one_row_are_an_error_of_this_row(tmp_path):
    chosen = study(factors={"scenario.filter.cutoff_hz": [10.0, 40.0], "scenario.timing.frame_rate_hz": [60.0, 100.0]})
    frame = run(tmp_path, chosen).frame
    assert ["Nyquist" in error for error in frame["error"]] == [False, False, True, False] * 3


@pytest.mark.parametrize(
    ("other", "differs"),
    [
        ({"seed": 5}, "study.seed"),
        ({"seed": 5, "repeats": 4}, "study.seed; name"),
        ({"factors": {DARK: [1.0]}}, "study.factors."),
        ({"factors": FACTORS | {DARK: [13.0, 26.0, 52.0, 99.0]}, "repeats": 4}, f"study.factors.{DARK}; name"),
    ],
)
def test_the_folder_of_another_study_is_refused(tmp_path, other, differs):
    run(tmp_path)
    before = (tmp_path / JOURNAL).read_bytes()
    with pytest.raises(StudyError, match=rf"study.json is of another study, which differs in {differs}"):
        run(tmp_path, study(**other))
    assert (tmp_path / JOURNAL).read_bytes() == before
    run(tmp_path, study(title="another title"))


def test_more_repeats_are_added_to_those_that_are_there(whole, tmp_path):
    """The same table as that of a study that had them from the start, and no row is computed twice."""
    log, more = tmp_path / "log", {"repeats": 5}
    chosen = study(options={"log": str(log)})
    few = run(tmp_path / "a", chosen)
    same_numbers(few.frame, whole[1].frame)
    many = run(tmp_path / "a", chosen.model_copy(update=more))
    assert (few.rows, many.found, many.rows) == (18, 18, 30)
    same_numbers(many.frame[:18], few.frame)
    assert sorted(map(int, log.read_text().split())) == list(range(30))
    same_numbers(many.frame, run(tmp_path / "b", study(**more)).frame)
    assert read_table(tmp_path / "a" / TABLE)[1].repeats == 5


def test_more_repeats_of_a_sample_look_at_the_same_points(tmp_path):
    chosen = study(factors={DARK: {"low": 1.0, "high": 50.0}}, sample=4, repeats=1)
    one = run(tmp_path, chosen).frame
    three = run(tmp_path, chosen.model_copy(update={"repeats": 3})).frame
    same_numbers(three[:4], one)
    assert three[DARK].tolist() == 3 * one[DARK].tolist()
    assert len(set(three["seed_spawn_key"])) == 12


def test_fewer_repeats_leave_the_others_out_of_the_table_but_lose_none(whole, tmp_path):
    """Also of a study that was stopped, which so ends with the repeats that it has."""
    log = tmp_path / "log"
    chosen = study(options={"log": str(log)})
    with pytest.raises(StudyInterrupted):
        run_study(chosen, tmp_path / "a", SilentProgress(), stopping_after(13, KeyboardInterrupt()))
    two = run(tmp_path / "a", chosen.model_copy(update={"repeats": 2}))
    assert (two.found, two.rows, two.beyond) == (12, 12, 1)
    same_numbers(two.frame, whole[1].frame[:12])
    three = run(tmp_path / "a", chosen)
    assert (three.found, three.beyond) == (13, 0)
    same_numbers(three.frame, whole[1].frame)
    assert sorted(map(int, log.read_text().split())) == list(range(18))


def test_a_study_stopped_while_repeats_were_added_says_how_many_rows_of_these_are_done(tmp_path):
    run(tmp_path)
    with pytest.raises(StudyInterrupted, match="20 of 24 rows are done"):
        run_study(study(repeats=4), tmp_path, SilentProgress(), stopping_after(2, KeyboardInterrupt()))
    assert run(tmp_path, study(repeats=4)).found == 20


def test_a_changed_sensor_file_makes_another_study(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('name = "mine"\nbased_on = "ctrack780"\n')
    chosen = study(changes={"scenario.sensor": str(mine)})
    run(tmp_path / "a", chosen)
    mine.write_text('name = "mine"\nbased_on = "ctrack780"\n[lens]\npsf_px = 0.5\n')
    with pytest.raises(StudyError, match=r"differs in sensor\.lens\.psf_px"):
        run(tmp_path / "a", chosen)


def test_a_table_of_another_study_is_refused(whole, tmp_path):
    (tmp_path / TABLE).write_bytes((whole[0] / TABLE).read_bytes())
    with pytest.raises(StudyError, match=r"study.parquet is of another study, which differs in study.seed"):
        run(tmp_path, study(seed=5))
    pd.DataFrame({"x": [1.0]}).to_parquet(tmp_path / TABLE)
    with pytest.raises(StudyError, match=r"study.parquet is no table of a study"):
        run(tmp_path)
    (tmp_path / TABLE).write_text("no table")
    with pytest.raises(StudyError, match=r"study.parquet is no table of a study"):
        run(tmp_path)


def test_two_at_once_on_one_folder_are_refused(tmp_path):
    run(tmp_path)
    with (tmp_path / LOCK).open("a+") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(StudyError, match="in use by another process"):
            run(tmp_path)
    assert run(tmp_path).found == 18


def test_folders_of_other_things_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(StudyError, match=r"holds thesis.tex and no study.json"):
        run(tmp_path)
    with pytest.raises(StudyError, match="is a file"):
        run(tmp_path / "thesis.tex")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
