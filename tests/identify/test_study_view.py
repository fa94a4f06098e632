"""The view of a study by its factors, and its netCDF file."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from identify.errors import StudyError
from identify.studies.design import Finished
from identify.studies.study_file import Study
from identify.studies.table import read_table, tidy_table, to_xarray, write_table, write_view

DARK, METHOD = "sensor.camera.dark_noise", "scenario.pose_method"


def table(figures=("position_rms_um",), **entries):
    """A study and its table; row n has n in each figure."""
    settings = {
        "name": "mine",
        "title": "Mine",
        "kind": "static_pose",
        "repeats": 2,
        "factors": {DARK: [13.0, 26.0, 52.0], METHOD: ["registration", "planes"]},
    }
    study = Study(**settings | entries)
    done = [Finished(row, dict.fromkeys(figures, float(row)), 0.5) for row in range(study.rows)]
    return tidy_table(study, done), study


def test_figures_and_factors_carry_their_units():
    view = to_xarray(*table(figures=("position_rms_um", "stickers")))
    assert {name: view[name].attrs.get("units") for name in view.variables} == {
        "position_rms_um": "um",
        "stickers": None,
        "seconds": "s",
        DARK: "electrons",
        METHOD: None,
        "repeat": None,
    }


def test_xarray_reads_the_view_as_it_was(tmp_path):
    frame, study = table()
    write_view(tmp_path / "study.nc", frame, study)
    with xr.open_dataset(tmp_path / "study.nc") as found:
        xr.testing.assert_identical(found.load(), to_xarray(frame, study))
        assert found["position_rms_um"].sel({DARK: 52.0, METHOD: "planes", "repeat": 1}) == 11.0


@pytest.mark.parametrize("factors", [{}, {"options.fast": [True, False]}, {"options.pair": [[1, 2], [3]]}])
def test_any_factor_and_any_name_of_a_figure_can_be_written(tmp_path, factors):
    frame, study = table(figures=("rate_1/s", "größe m"), kind="my:row", factors=factors)
    write_view(tmp_path / "study.nc", frame, study)
    with xr.open_dataset(tmp_path / "study.nc") as found:
        assert {*found.data_vars} == {"rate_1_per_s", "größe m", "seconds"}
        assert sorted(found["rate_1_per_s"].values.ravel().tolist()) == list(range(study.rows))


def test_full_disk_leaves_the_old_file_and_one_line(tmp_path, monkeypatch):
    frame, study = table()
    path = tmp_path / "study.nc"
    path.write_text("old")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", full)
    with pytest.raises(StudyError, match=r"study\.nc cannot be written: No space left on device"):
        write_view(path, frame, study)
    assert path.read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == ["study.nc"]


@pytest.mark.parametrize("as_path", [str, Path])
def test_table_is_read_by_a_path_of_either_kind(tmp_path, as_path):
    frame, study = table()
    write_table(tmp_path / "study.parquet", frame, {"study": study.model_dump(mode="json")})
    found, its = read_table(as_path(tmp_path / "study.parquet"))
    pd.testing.assert_frame_equal(found, frame)
    assert its == study
    assert np.isfinite(found["position_rms_um"]).all()
