"""Lost frames that a log writes as zeros, as the last pose or as NaN: named, and left out.

The oracle is the record from which the tables were written.
"""

import numpy as np
import pandas as pd
import pytest

from identify.errors import RecordError
from identify.record.from_telemetry import reading_notes
from identify.record.lost_pose_marks import repeated_note
from identify.record.own_record import read_own_records
from identify.record.recording import poses
from tests.identify.test_own_record import mine, record  # noqa: F401
from tests.identify.test_readers import ANCHOR, ONE_TABLE, change, telemetry_of

LOST = [20, 21, 22, 50, 80]
MEASURED = [f"measured_{name}" for name in ("x_m", "y_m", "z_m", "alpha_rad", "beta_rad")]
MEASURED.append("measured_gamma_rad")


@pytest.fixture
def mapped(mine):  # noqa: F811
    """A table whose columns [columns] names, without times of commands."""
    mine.with_suffix(".toml").write_text(
        ANCHOR + ONE_TABLE.replace('written = "command_time_s"', "")
    )
    return mine


def spoil(path, value):
    """Write a value, or the pose of the row before, into the rows of lost frames."""
    table = pd.read_csv(path)
    for row in LOST:
        table.loc[row, MEASURED] = table.loc[row - 1, MEASURED] if value is None else value
    table.to_csv(path, index=False, na_rep="NaN")


def test_zeros_in_place_of_lost_poses_are_named_with_the_first_row_and_the_remedy(mine):  # noqa: F811
    spoil(mine, 0.0)
    said = "mine.csv line 22: the measured pose is 0 in all cells, as in 5 of 120 rows"
    with pytest.raises(RecordError, match=f"{said}.* likely lost frames; leave their measured"):
        read_own_records([mine])


def test_a_key_takes_zeros_or_repeated_poses_of_a_mapped_log_as_lost(mapped, record):  # noqa: F811
    before = telemetry_of(mapped).poses
    spoil(mapped, 0.0)
    with pytest.raises(RecordError, match=r'lost = "zeros" in \[columns.measured\] takes them'):
        telemetry_of(mapped)
    change(
        mapped.with_suffix(".toml"), 'position_unit = "m"', 'position_unit = "m"\nlost = "zeros"'
    )
    expected = before.ok.copy()
    expected[LOST] = False
    np.testing.assert_array_equal(telemetry_of(mapped).poses.ok, expected)
    spoil(mapped, None)
    assert telemetry_of(mapped).poses.ok[LOST].all()
    (said,) = repeated_note(telemetry_of(mapped).poses)
    assert said.startswith(
        f"5 of {before.ok.sum()} poses equal the pose before in all digits, first "
    )
    assert "mine.csv line 22" in said
    change(mapped.with_suffix(".toml"), 'lost = "zeros"', 'lost = "repeated"')
    found = telemetry_of(mapped).poses
    np.testing.assert_array_equal(found.ok, expected)
    np.testing.assert_allclose(
        found.pose[expected], poses(record, "measured")[expected], rtol=0, atol=1e-12
    )


def test_nan_is_an_empty_cell_also_where_rows_are_events(mapped):
    spoil(mapped, np.nan)
    assert not telemetry_of(mapped).poses.ok[LOST].any()
    table = pd.read_csv(mapped)
    table.loc[LOST, [name for name in table if name.startswith("command_")]] = np.nan
    table.to_csv(mapped, index=False, na_rep="NaN")
    with pytest.raises(
        RecordError, match=r"line 22: the command command_1_rad .* in 5 of 120 rows"
    ):
        telemetry_of(mapped)
    change(mapped.with_suffix(".toml"), "names = [", 'time = "time_s"\nnames = [')
    assert len(telemetry_of(mapped).commands.time) == 115


def test_zeros_of_a_platform_that_stands_at_zero_are_poses(mapped):
    """Without noise, as in a simulation of one's own whose frame begins in the platform."""
    table = pd.read_csv(mapped)
    table[MEASURED] = (table[MEASURED] - table.loc[0, MEASURED]).shift(10)
    table.loc[:10, MEASURED] = 0.0
    table.to_csv(mapped, index=False)
    assert telemetry_of(mapped).poses.ok[:5].all()


def test_repeated_poses_that_are_left_out_as_gross_errors_are_noted(mine):  # noqa: F811
    spoil(mine, None)
    (found,), _ = read_own_records([mine])
    assert any('lost = "repeated" in [columns' in note for note in reading_notes([found]))
