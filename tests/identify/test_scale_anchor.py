"""The scale anchor of a record: read back as stored, and refused by name where it measures nothing that can be."""

import numpy as np
import pytest

from identify.errors import EstimationError, RecordError
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ANCHORS, ScaleAnchor, read_anchor, store_anchor
from identify.loop_parameters import index_of
from tests.identify.synthetic import quick, rss6, run_plant


@pytest.fixture(scope="module")
def record():
    return run_plant(quick(), seed=1, duration_s=3.0)[0]


@pytest.mark.parametrize("anchor", [ScaleAnchor("joint_gain", 10.5, 0.01), ScaleAnchor("payload")])
def test_what_is_stored_is_read(record, anchor):
    bare = record.copy()
    bare.attrs = {}
    store_anchor(bare, anchor)
    assert read_anchor(bare) == anchor


def test_a_weighing_is_one_equation_in_standard_deviations():
    row, right = ScaleAnchor("platform_mass", 23.5, 0.005).row()
    assert np.flatnonzero(row) == [index_of("platform.mass")]
    assert row[0, index_of("platform.mass")] == pytest.approx(200)
    assert right[0] == pytest.approx(4700)
    assert ScaleAnchor("payload").row()[0].shape == (0, 67)


@pytest.mark.parametrize(
    ("attributes", "says"),
    [
        ({"scale_anchor_value": -23.0}, r"_value is -23.0, must be a finite number > 0 in kg.*platform.mass"),
        ({"scale_anchor_value": np.float64(-3.0)}, r"scale_anchor_value is -3.0, must be"),
        ({"scale_anchor_value": 0.0}, r"scale_anchor_value is 0.0, must be a finite number > 0 in kg"),
        ({"scale_anchor_value": np.nan}, r"scale_anchor_value is nan, must be"),
        ({"scale_anchor_value": np.inf}, r"scale_anchor_value is inf, must be"),
        ({"scale_anchor_value": "23.5"}, r"scale_anchor_value is '23.5', must be"),
        ({"scale_anchor_std": 0.0}, r"scale_anchor_std is 0.0, must be a finite number > 0 in kg"),
        ({"scale_anchor_std": -0.005}, r"scale_anchor_std is -0.005, must be"),
        (
            {"scale_anchor": "joint_gain", "scale_anchor_std": np.nan},
            r"scale_anchor_std is nan, must be a finite number > 0 in N m/rad.*joint_gain measures joint_pid.lp",
        ),
        ({"scale_anchor": "guess"}, r"no scale anchor .*found 'guess'; valid anchors: platform_mass"),
    ],
    ids=["negative", "of numpy", "zero", "NaN", "infinite", "text", "std zero", "std negative", "std NaN", "unknown"],
)
def test_an_impossible_anchor_is_refused_with_its_value_and_limit(record, attributes, says):
    with pytest.raises(RecordError, match=says):
        identify(record.assign_attrs(attributes), rss6(), quick())


def test_a_measured_value_that_is_missing_is_said(record):
    half = record.copy()
    half.attrs = {name: value for name, value in record.attrs.items() if name != "scale_anchor_value"}
    with pytest.raises(RecordError, match="scale_anchor_value is None"):
        read_anchor(half)
    assert record.attrs["scale_anchor"] in ANCHORS


@pytest.mark.parametrize(
    ("robot", "scenario", "says"),
    [(None, quick(), "None is no Robot: dynamics.load_robot"), (rss6(), "quick", "'quick' is no Scenario: identify")],
)
def test_what_is_no_robot_or_no_scenario_is_refused_in_one_line(record, robot, scenario, says):
    with pytest.raises(EstimationError, match=says):
        identify(record, robot, scenario)
