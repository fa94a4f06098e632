"""`cmmsim check RECORD`: what is found of a sound record, and of one spoilt in many ways.

The oracle is what was done to the telemetry.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from identify.commands.help import BEYOND_LIMIT, DONE, MISUSED, NOT_DONE
from identify.record.recording import poses, write
from identify.record.suspicions import suspicions
from identify.record.telemetry import Telemetry
from identify.record.timed_record import build_timed_record
from identify.verification.logged_run import LoggedRun, recorded_telemetry
from identify.verification.telemetry_check import check_telemetry
from tests.identify.commands import command, one_line
from tests.identify.synthetic import SIGMA, quick, rss6, run_plant, side_of
from tests.identify.test_readers import as_motive, change

SCENARIO = quick(**{"timing.latency_s": 0.004})


@pytest.fixture(scope="module")
def record():
    found = run_plant(SCENARIO, 0, lost=(200, 201))[0]
    return found.assign(command_time=("time", found["time"].values + 0.004))


def findings(telemetry, stated=SIGMA, orders=()):
    found = tuple(suspicions(telemetry, rss6()))
    logged = LoggedRun(telemetry, side_of(SCENARIO), SCENARIO.identification, stated, found, orders)
    return {one.check: one for one in check_telemetry(logged)}


@pytest.mark.slow
def test_a_sound_record_passes_and_its_page_and_json_hold_the_findings(
    record, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    write("mine.nc", record)
    assert command("check", "mine.nc", "--json", "found.json", "--quiet") == DONE
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["ok"]
    by_name = {one["check"]: one for one in found["findings"]}
    assert by_name["position noise"]["value"] == pytest.approx(5e-6, rel=0.1)
    assert by_name["orientation noise"]["value"] == pytest.approx(3e-5, rel=0.1)
    assert by_name["lost poses"]["value"] == pytest.approx(2 / 600)
    assert by_name["longest gap"]["value"] == pytest.approx(3 / 60)
    assert by_name["clock offset"]["value"] == pytest.approx(0.0, abs=1e-6)
    assert by_name["pose rate"]["value"] == pytest.approx(60.0)
    page = (tmp_path / "mine-check.html").read_text()
    assert "All findings are good" in page
    assert page.count("<figure") == 4
    assert all(one["text"].split(";")[0].split("'")[0] in page for one in found["findings"])


def test_what_is_wrong_with_the_poses_is_found_with_its_size(record):
    sound = recorded_telemetry(record, "mine.nc")
    moved = sound.poses.pose.copy()
    ok = sound.poses.ok.copy()
    ok[100:140] = False  # while commands go on
    moved[300, 0] += 1e-3
    moved[400:420] = moved[400]  # a tracker that repeats its last pose
    spoilt = replace(
        sound, poses=replace(sound.poses, pose=np.where(ok[:, None], moved, np.nan), ok=ok)
    )
    found = findings(spoilt, stated=3 * SIGMA)
    failed = {name for name, one in found.items() if not one.ok}
    assert failed == {"longest gap", "position noise", "orientation noise", "frozen poses"}
    assert found["longest gap"].value == pytest.approx(41 / 60)
    assert (
        "no pose from 1.6500 to 2.3333 s; commands changed in 1 of 2 gaps, in"
        in found["longest gap"].text
    )
    assert found["frozen poses"].value == pytest.approx(19 / 557)
    assert "the first at 6.6833 s" in found["frozen poses"].text
    assert "at 5.0000" in found["jumps"].text
    assert "times the stated 15 um" in found["position noise"].text
    assert "times are rounded" not in found["pose jitter"].text
    log = replace(sound.poses, time=np.round(sound.poses.time, 4))
    found = findings(replace(sound, poses=log), orders=("euler_xyz",))
    assert found["pose jitter"].text.endswith("times are rounded to 0.1 ms")
    assert found["units and frames"].text.endswith("order of the Euler angles from euler_xyz")


def test_rows_that_are_missing_are_told_from_commands_that_changed(record):
    sound = recorded_telemetry(record, "mine.nc")
    there = np.ones(600, dtype=bool)
    there[100:140] = False

    def without(log, *names):
        values = {name: getattr(log, name) for name in names}
        return replace(log, **{k: None if v is None else v[there] for k, v in values.items()})

    found = findings(
        replace(
            sound,
            poses=without(sound.poses, "time", "pose", "ok", "covariance"),
            commands=without(sound.commands, "time", "command", "written"),
        )
    )
    assert "commands changed in 1 of 2 gaps" not in found["longest gap"].text
    assert found["longest gap"].text.endswith("rows of commands are missing in 1")
    assert found["lost poses"].text == "42 of 600 poses are empty or missing, in 2 gaps"


@pytest.mark.slow
def test_what_is_wrong_with_the_commands_is_found_with_its_size(record):
    sound = recorded_telemetry(record, "mine.nc")
    commands = sound.commands
    command_ = commands.command.copy()
    command_[:, 2] = np.clip(command_[:, 2], -0.1, None)
    command_[:, 3] += 2 * np.pi
    spoilt = replace(
        sound, commands=replace(commands, command=command_, written=commands.written + 0.012)
    )
    found = findings(spoilt)
    failed = {name for name, one in found.items() if not one.ok}
    assert {"saturation", "clock offset", "units and frames"} <= failed
    assert found["saturation"].leg == 3
    assert found["clock offset"].value == pytest.approx(0.012, abs=1e-6)
    assert "timing.latency_s = 0.016000, which does not move" in found["clock offset"].text
    assert (
        "set timing.clock_offset_std_s to have the offset estimated" in found["clock offset"].text
    )
    assert "commands of joint 4 lie 6.2" in found["units and frames"].text
    assert "off by a turn" in found["units and frames"].text


def test_a_record_with_times_of_its_own_is_checked_as_one_on_the_grid(record):
    """Its commands act 4 ms after their poses, as its timing states."""
    ok = record["measured_ok"].values == 1
    timed = build_timed_record(
        time=record["time"].values[ok],
        measured_pose=poses(record, "measured")[ok],
        measured_covariance=np.diag(SIGMA**2),
        acting=record["command_time"].values,
        command=record["command"].values,
        scenario_toml=SCENARIO.to_toml(),
        robot="rss6",
        frame_rate_hz=60.0,
    )
    found = findings(recorded_telemetry(timed, "timed.nc"))
    assert all(one.ok for one in found.values())
    assert found["clock offset"].value == pytest.approx(0.0, abs=1e-6)


def test_a_latency_is_not_verified_without_times_of_the_commands(record):
    """A command in the row of its pose says nothing about when it acted, and one row later does."""
    shared = recorded_telemetry(record.drop_vars("command_time"), "shared.nc")
    found = findings(shared)
    assert found["clock offset"].ok
    assert found["clock offset"].value is None
    assert "timing.latency_s = 0.004 cannot be checked here" in found["clock offset"].text
    assert "clock drift" not in found
    later = replace(shared.commands, command=np.roll(shared.commands.command, 1, axis=0))
    found = findings(replace(shared, commands=later))["clock offset"]
    assert not found.ok
    assert found.value == pytest.approx(1 / 60)


@pytest.mark.slow
def test_a_motion_that_is_too_small_cannot_show_the_parameters():
    """An identification from this record identifies no group; its model does not hold either."""
    small = run_plant(SCENARIO, 0, size=0.02)[0]
    found = findings(recorded_telemetry(small, "small.nc"))["parameters"]
    assert not found.ok
    assert found.value < 0.5 * found.limit
    assert "not platform.Ixx" in found.text


def test_clocks_that_differ_by_seconds_are_seen_in_the_motion(record):
    sound = recorded_telemetry(record, "mine.nc")
    commands = sound.commands
    late = Telemetry(sound.poses, replace(commands, time=commands.time + 1.5, written=None))
    found = findings(late)["motion behind commands"]
    assert not found.ok
    assert found.value == pytest.approx(-1.4, abs=0.1)


@pytest.mark.slow
def test_a_log_is_checked_by_its_description_and_a_robot_is_told_from_it(
    record, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    take = as_motive(tmp_path, record.drop_vars("command_time"))
    # Other poses than the platform's frame, here, are what the check is for.
    change(take.with_suffix(".toml"), 'axes = ["x", "-z", "y"]', "")
    status = command("check", "take.csv", "--json", "-", "--quiet")
    assert status == BEYOND_LIMIT
    out, err = capfd.readouterr()
    found = {one["check"]: one for one in json.loads(out)["findings"]}
    assert not found["units and frames"]["ok"]
    assert (
        'with axes = ["x", "-z", "y"] in [columns.measured] it would fit'
        in found["units and frames"]["text"]
    )
    assert "findings about take.csv fail: " in one_line(err)
    assert command("check", "take.csv", "--scenario", "quick") == MISUSED
    assert command("check", "rss6", "--page", "x.html") == MISUSED
    capfd.readouterr()
    table = (tmp_path / "take.toml").read_text()
    change(tmp_path / "take.toml", "[columns.measured]", '[columns.measured]\ntime_unit = "ms"')
    assert command("check", "take.csv", "--page", "x.html") == NOT_DONE
    assert "unit of the times seems wrong by a factor of 1000" in one_line(capfd.readouterr().err)
    (tmp_path / "take.toml").write_text(table)
    (tmp_path / "take.toml").unlink()
    assert command("check", "take.csv", "--page", "x.html") == NOT_DONE
    assert "there is no file take.toml, which must describe the record" in one_line(
        capfd.readouterr().err
    )
    assert not (tmp_path / "x.html").exists()


@pytest.mark.parametrize(
    ("part", "order", "signs", "said"),
    [
        (slice(0, 3), [1, 0, 2], [1, 1, 1], "with [y, x, z] in place of the position [x, y, z]"),
        (slice(0, 3), [0, 1, 2], [1, -1, 1], "with [x, -y, z] in place of the position"),
        (slice(3, 6), [1, 0, 2], [1, 1, 1], "with [beta, alpha, gamma] in place of the angles"),
    ],
)
def test_columns_of_the_pose_in_another_order_or_with_another_sign_are_named(
    record, part, order, signs, said
):
    sound = recorded_telemetry(record, "mine.nc")
    moved = sound.poses.pose.copy()
    moved[:, part] = moved[:, part][:, order] * signs
    found = suspicions(replace(sound, poses=replace(sound.poses, pose=moved)), rss6())
    assert len(found) == 1
    assert said in found[0]
