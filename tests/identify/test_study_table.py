"""The table of a study, its view by factors, and their files."""

import json

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import xarray as xr

from identify.errors import StudyError
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.studies.design import Finished
from identify.studies.runner import run_study
from identify.studies.store import STUDY, TABLE, VIEW
from identify.studies.study_file import Study
from identify.studies.table import read_table, tidy_table, to_xarray, write_view
from tests.identify.study_rows import KIND, row

DARK, METHOD = "sensor.camera.dark_noise", "scenario.pose_method"
FACTORS = {DARK: [13.0, 26.0, 52.0], METHOD: ["registration", "planes"]}


def made(figures=("position_rms_um",), **entries):
    """A table and its study; row n has n in each figure."""
    settings = {"name": "mine", "title": "Mine", "kind": "static_pose", "repeats": 2, "factors": FACTORS}
    study = Study(**settings | entries)
    done = [Finished(number, dict.fromkeys(figures, float(number)), 0.5) for number in range(study.rows)]
    return tidy_table(study, done), study


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A study, its folder and its table."""
    study = Study(name="mine", kind=KIND, factors=FACTORS, repeats=3, seed=4)
    folder = tmp_path_factory.mktemp("study")
    return study, folder, run_study(study, folder, SilentProgress()).frame


def test_table_has_a_row_each_with_factors_seed_and_figures(run):
    """Each row can be computed again from what the table says of it."""
    frame, paper = run[2], load_scenario("paper")
    before, figures = ["row", "repeat", "seed_entropy", "seed_spawn_key"], ["error_um", "spread_um", "rate_hz"]
    assert list(frame.columns) == [*before, DARK, METHOD, *figures, "seconds", "error"]
    assert frame["row"].tolist() == list(range(18))
    for entry in frame.to_dict("records"):
        seed = np.random.SeedSequence(int(entry["seed_entropy"]), spawn_key=(entry["seed_spawn_key"],))
        scenario = paper.with_overrides({"sensor_changes.camera.dark_noise": entry[DARK]})
        assert row(scenario, seed, {}) == {name: entry[name] for name in figures}


def test_parquet_holds_the_table_and_the_study(run):
    study, folder, table = run
    frame, found = read_table(str(folder / TABLE))
    pd.testing.assert_frame_equal(frame, table)
    assert found == study
    versions = json.loads(pq.read_schema(folder / TABLE).metadata[b"cmmsim.versions"])
    assert {"python", "cmmsim", "numpy"} <= set(versions)
    assert json.loads((folder / STUDY).read_text())["sensor"]["name"] == "ctrack780"


def test_view_has_the_figures_by_factor_and_repeat_as_xarray_reads_them(run):
    study, folder, frame = run
    with xr.open_dataset(folder / VIEW) as view:
        xr.testing.assert_identical(view.load(), to_xarray(frame, study))
    assert dict(view.sizes) == {DARK: 3, METHOD: 2, "repeat": 3}
    for entry in frame.to_dict("records"):
        place = {DARK: entry[DARK], METHOD: entry[METHOD], "repeat": entry["repeat"]}
        assert float(view["error_um"].sel(place)) == entry["error_um"]


def test_view_of_a_sample_has_points_with_the_factors_as_coordinates_and_all_carry_their_units():
    factors = {DARK: {"low": 1.0, "high": 50.0}, "options.pair": [[1, 2], [3, 4]]}
    frame, study = made(kind="my:row", factors=factors, sample=5, repeats=2)
    view = to_xarray(frame, study)
    assert dict(view.sizes) == {"point": 5, "repeat": 2}
    assert view[DARK].values.tolist() == frame[DARK][:5].tolist()
    assert set(frame["options.pair"]) <= {"[1, 2]", "[3, 4]"}
    assert view["position_rms_um"].values.T.ravel().tolist() == list(range(10))
    view = to_xarray(*made(figures=("position_rms_um", "stickers")))
    units = {"position_rms_um": "um", "stickers": None, "seconds": "s", DARK: "electrons", METHOD: None, "repeat": None}
    assert {name: view[name].attrs.get("units") for name in view.variables} == units


@pytest.mark.parametrize("factors", [{}, {"options.fast": [True, False]}, {"options.pair": [[1, 2], [3]]}])
def test_any_factor_and_any_name_of_a_figure_can_be_written(tmp_path, factors):
    frame, study = made(figures=("rate_1/s", "größe m"), kind="my:row", factors=factors)
    write_view(tmp_path / VIEW, frame, study)
    with xr.open_dataset(tmp_path / VIEW) as found:
        assert {*found.data_vars} == {"rate_1_per_s", "größe m", "seconds"}
        assert sorted(found["rate_1_per_s"].values.ravel().tolist()) == list(range(study.rows))


def test_full_disk_leaves_the_old_file_and_one_line(tmp_path, monkeypatch):
    path = tmp_path / VIEW
    path.write_text("old")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", full)
    with pytest.raises(StudyError, match=r"study\.nc cannot be written: No space left on device"):
        write_view(path, *made())
    assert path.read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == [VIEW]
