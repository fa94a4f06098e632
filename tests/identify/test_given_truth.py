"""Truths that a user compares with a result."""

import numpy as np
import pytest
import xarray as xr

from identify.errors import EstimationError, RecordError
from identify.estimation.conditioning import Conditioning
from identify.estimation.given_truth import given_truth
from identify.files.dataset import read_group

NAMES = ("platform.mass", "rod1.mass", "joint1.coulomb")
TRUE = dict(zip(NAMES, (20.0, 1.0, 0.3), strict=True))


def stored(values):
    """The truth of a record."""
    return xr.Dataset(
        {"parameter_value": ("parameter", list(values.values()))}, {"parameter": list(values)}
    )


@pytest.mark.parametrize("truth", [TRUE, stored(TRUE)])
def test_a_truth_is_given_by_name_or_by_a_record(truth):
    np.testing.assert_array_equal(given_truth(truth, NAMES[::-1]), [0.3, 1.0, 20.0])


@pytest.mark.parametrize(
    ("truth", "says"),
    [
        (np.ones(3), "must be record.truth .* got ndarray"),
        (xr.Dataset({"position": ("time", [1.0])}), "must be record.truth .* as a record"),
        (TRUE | {"crank1.mass": 1.0}, "of another robot: it has crank1.mass"),
        (stored({"platform.mass": 1.0, "rod1.mass": 1.0}), "no joint1.coulomb"),
    ],
)
def test_any_other_truth_is_refused_in_one_line(truth, says):
    with pytest.raises(EstimationError, match=says):
        given_truth(truth, NAMES)


def test_a_poorly_conditioned_record_says_what_may_still_be_used():
    (said,) = Conditioning(1e6, float("inf"), 48, 17).warnings()
    assert "17 are known from the initial guess" in said
    assert "predictions of motions do not suffer if they meet the goals" in said
    assert "do not use the values of single bodies" in said


def test_a_folder_in_place_of_a_record_is_called_one_and_its_record_is_named(tmp_path):
    with pytest.raises(RecordError, match=r"is a folder$"):
        read_group(tmp_path, "")
    (tmp_path / "experiment.nc").touch()
    with pytest.raises(RecordError, match=r"is a folder; its record is .*experiment\.nc$"):
        read_group(tmp_path, "")
