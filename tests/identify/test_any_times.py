"""Records as laboratories log them: nine forms of one experiment, identified alike.

The experiment is simulated with known parameters. Poses at times that are not frames come from the
plant itself, moved by the logged commands.
"""

from dataclasses import replace

import numpy as np
import pytest

from identify.diagnosis.diagnose import diagnose
from identify.errors import EstimationError, RecordError
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.model.from_record import _likely_delay, _stretches, identified_model
from identify.record.frame_times import likelier_times
from identify.record.from_telemetry import reading_notes
from identify.record.recording import is_timed, poses
from identify.record.smoothness import gross_errors
from identify.validation.unseen import model_on_record
from tests.identify.record_forms import (
    COVARIANCE,
    DRIFT,
    FORMS,
    OFFSET_S,
    at_times,
    exact,
    held,
    logged,
    record_from,
    record_in,
    scenario_of,
    true_parameters,
    with_rows,
)
from tests.identify.synthetic import SIGMA, quick, run_plant, side_of, truth

CHANCE = 4.0  # standard deviations that a figure may be off by chance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "says"),
    [
        ("exact", None),
        ("rounded to ms", "poses are smoother at frames of 60.0000 Hz"),
        ("jitter of 0.2 ms", "the record holds no reference"),
        ("commands at 250 Hz", "the record holds no reference"),
        ("begun in motion", "the record begins in motion"),
        ("two clocks", "poses and commands have different clocks"),
        ("gaps of the servo", None),
        ("gaps of the log", "the rows are not one frame period apart"),
        ("gross errors", "5 single poses were left out as gross errors: t = 1.667, 5.833, 5.850, "),
    ],
)
def test_a_form_is_recognised_and_said(form, says):
    record = record_in(form, seed=0)
    notes = reading_notes([record])
    assert is_timed(record) is (says is not None)
    assert (says is None and not notes) or any(says in note for note in notes)


def test_commands_that_change_while_no_pose_is_logged_drive_the_model():
    """Rows without a pose are there, so that nothing else tells of them."""
    telemetry, _ = exact(0)
    telemetry.poses.ok[300:330] = False
    telemetry.poses.pose[300:330] = np.nan
    record = record_from(telemetry)
    assert is_timed(record)
    assert "the servo saw poses that were not logged" in reading_notes([record])[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "form",
    [
        pytest.param("begun in motion", marks=pytest.mark.thorough),
        pytest.param("two clocks", marks=pytest.mark.thorough),
        pytest.param("gaps of the log", marks=pytest.mark.thorough),
    ],
)
def test_a_form_is_identified_as_the_record_on_the_grid_is(form):
    known = identify(record_in("rounded to ms", 3))
    record = record_in(form, 3)
    found = identify(record)
    chosen = found.identifiable & known.identifiable
    assert np.count_nonzero(chosen) >= 24
    shift = (found.estimate - known.estimate)[chosen] / known.std[chosen]
    assert np.sqrt(np.mean(shift**2)) < 0.7
    assert found.explained
    off = np.abs(found.estimate - true_parameters())[chosen] / found.std[chosen]
    assert np.count_nonzero(off > 2) <= 4
    if form == "two clocks":
        clock = found.common_errors
        offset, drift = (
            (clock.learned[name], clock.std[clock.names.index(name)])
            for name in ("clock.offset_s", "clock.drift_s/s")
        )
        assert abs(offset[0] - OFFSET_S) < min(2e-4, CHANCE * offset[1])
        assert abs(drift[0] - DRIFT) < CHANCE * drift[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seconds", "most"), [(5.0, 1.5e-4), pytest.param(10.0, 1e-4, marks=pytest.mark.thorough)]
)
def test_a_cause_is_named_in_a_record_at_any_times(seconds, most):
    """The zero of joint 2 is off in a plant whose record begins in motion, after 1.5 s."""
    true = 5e-4
    scenario = scenario_of(**{"plant.joint_zero_error_rad": [0, true, 0, 0, 0, 0]})
    telemetry = logged(*run_plant(scenario, 0, duration_s=seconds))
    telemetry = with_rows(telemetry, slice(90, None))
    telemetry = at_times(telemetry, telemetry.poses.time - telemetry.poses.time[0])
    record = record_from(telemetry)
    store_anchor(record, ScaleAnchor("platform_mass", true_parameters()[0], 0.005))
    found = diagnose(record)
    (first,) = found.findings
    assert first.name == "zero of joint 2"
    assert abs(first.sizes[0].value - true) < CHANCE * first.sizes[0].std < most
    assert not found.left.significant


@pytest.mark.thorough
def test_a_clock_that_is_not_stated_is_named_where_it_explains_the_record():
    telemetry, _ = FORMS["two clocks"](0)
    record = record_from(replace(telemetry, reference=None))
    store_anchor(record, ScaleAnchor("platform_mass", true_parameters()[0], 0.005))
    found = identify(record)
    assert not found.explained
    (said,) = (text for text in found.warnings if "timing.clock_offset_std_s" in text)
    assert said.startswith("the commands seem to act 12.")


@pytest.mark.thorough
def test_records_of_several_days_share_the_robot_and_have_clocks_of_their_own():
    """Two records say more than each of them, and only one of them has another clock."""
    one, other = record_in("rounded to ms", 4), record_in("two clocks", 5)
    both = identify([one, other])
    assert both.explained
    for alone in (identify(one), identify(other)):
        chosen = both.identifiable & alone.identifiable
        assert (both.std[chosen] < alone.std[chosen]).mean() > 0.9
    (said,) = both.notes[-1:]
    assert said.startswith("the commands of record 2 act 12.0")


def test_the_model_holds_its_command_where_the_plant_lost_a_frame():
    """Then the true parameters miss nothing on a motion with lost frames."""
    scenario = quick(**{"timing.dropout": 0.0, "plant.steps_per_frame": 4})
    lost = (40, 41, 90, 150)
    record, run = run_plant(scenario, 0, 1e-12 * np.ones(6), lost, duration_s=3.0)
    found = model_on_record(side_of(scenario), truth(), record)
    assert np.abs(found - run.pose).max() < 1e-9
    whole = record.assign(measured_ok=("time", np.ones(len(run.pose), dtype=np.int8)))
    blind = model_on_record(side_of(scenario), truth(), whole)
    assert np.abs(blind - run.pose).max() > 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("form", ["gaps of the log", "two clocks"])
def test_the_model_is_compared_with_a_record_from_starts_and_clock_that_fit_it(form):
    """The true parameters miss the measured poses by noise alone, also after gaps."""
    _, more = FORMS[form](1)
    record = record_in(form, 1)
    side = side_of(scenario_of(**more))
    moved = model_on_record(side, true_parameters(), record)
    off = (moved - poses(record, "measured"))[record["measured_ok"].values.astype(bool)]
    assert np.sqrt(np.mean((off / SIGMA) ** 2)) == pytest.approx(1.0, abs=0.06)


@pytest.mark.thorough
@pytest.mark.parametrize("form", FORMS)
def test_intervals_hold_in_every_form(form, record_property):
    inside, total, shifts = np.transpose([held(form, seed) for seed in range(50)])
    share = inside.sum() / total.sum()
    record_property("coverage", share)
    record_property("mean_shift", float(np.mean(shifts)))
    assert 0.93 <= share <= 0.99
    assert abs(np.mean(shifts)) < 0.3


def smooth(count=200):
    times = np.arange(count) / 60
    poses = np.column_stack([0.01 * np.sin(4 * times + k) for k in range(6)])
    noise = np.random.default_rng(5).standard_normal(poses.shape)
    return times, poses + noise @ np.sqrt(COVARIANCE)


def test_wrong_poses_are_found_beside_each_other_and_not_at_a_kink():
    times, poses = smooth()
    poses[:, 2] += 0.5 * np.maximum(times - 1.5, 0.0) ** 2
    assert not len(gross_errors(times, poses, COVARIANCE))
    wrong = [3, 60, 62, 140, 198]
    poses[wrong] += np.random.default_rng(6).choice([-1, 1], (5, 6)) * ([2e-4] * 3 + [1e-3] * 3)
    np.testing.assert_array_equal(gross_errors(times, poses, COVARIANCE), wrong)


def test_times_are_those_at_which_poses_are_smooth():
    """Stamps of a camera that jitters are right, and late stamps of a steady one are not."""
    times, poses = smooth()
    late = times + 5e-4 * np.random.default_rng(7).random(len(times))
    found = likelier_times(late, poses, COVARIANCE, 60.0)
    assert np.ptp(np.diff(found)) < 1e-9
    jitter = times + 5e-4 * np.random.default_rng(8).standard_normal(len(times))
    moved = np.column_stack([0.01 * np.sin(4 * jitter + k) for k in range(6)])
    moved += poses - np.column_stack([0.01 * np.sin(4 * times + k) for k in range(6)])
    np.testing.assert_array_equal(likelier_times(jitter, moved, COVARIANCE, 60.0), jitter)


def test_more_than_a_tenth_of_wrong_poses_are_refused():
    telemetry, _ = exact(0)
    rows = np.random.default_rng(9).choice(len(telemetry.poses.ok), 160, replace=False)
    telemetry.poses.pose[rows] += 5e-3
    with pytest.raises(RecordError, match=r"mine.csv: \d+ of 1200 poses are far from the motion"):
        record_from(telemetry)


def test_rows_missing_in_which_a_command_was_held_are_told_from_others():
    """The command after the first missing rows is the one before them, and not after the second."""
    telemetry, _ = exact(0)
    telemetry.commands.command[301:331] = telemetry.commands.command[300]
    kept = np.setdiff1d(np.arange(1200), np.r_[301:330, 801:830])
    record = record_from(with_rows(telemetry, kept))
    held = [note for note in reading_notes([record]) if "it was held" in note]
    assert held == [
        "rows are missing from t = 5.00 s to 5.50 s, and the command after them is the one before: "
        "it was held"
    ]
    (gap,) = identified_model(record, side_of(scenario_of())).warnings()
    assert gap.startswith("commands are missing from t = 13.33 s to 13.8")


def test_clocks_that_do_not_overlap_are_refused():
    telemetry, _ = exact(0)
    other = replace(telemetry.commands, time=telemetry.commands.time + 1e6)
    with pytest.raises(RecordError, match=r"line 2: its command acts 1000000 s after .* overlap"):
        record_from(replace(telemetry, commands=other))


def test_torque_commands_need_the_grid():
    telemetry = logged(*run_plant(scenario_of(), 0, duration_s=3.0))
    record = record_from(replace(telemetry, reference=None))
    torques = record.assign_attrs(law="computed_torque", torque_commands=1)
    with pytest.raises(EstimationError, match=r"torques, under .* on one frame grid"):
        identified_model(torques, side_of(scenario_of()))


def test_the_delay_of_a_record_shorter_than_its_clock_is_uncertain_is_found():
    """The farthest delay to try is twice the duration."""
    times = np.linspace(0, 2, 121)
    model, measured = (np.tile(np.sin(6 * (times - by))[:, None], 6) for by in (0, 0.05))
    assert abs(_likely_delay(times, model, measured, 4.0) - 0.05) < 1e-3


def test_a_stretch_with_one_measured_pose_is_refused():
    telemetry = logged(*run_plant(scenario_of(), 0, duration_s=3.0))
    record = record_from(replace(telemetry, reference=None))
    ok = np.zeros(record.sizes["time"], dtype=np.int8)
    ok[5] = 1
    lost = record.assign(measured_ok=("time", ok))
    side = side_of(scenario_of())
    with pytest.raises(RecordError, match=r"stretch 1 .* has 1 measured poses, .* needs 2"):
        _stretches(lost, side, side.settings, np.eye(6))
