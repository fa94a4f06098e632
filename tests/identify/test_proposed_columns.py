"""Proposals of `cmmsim new record --from`: what a header says stands in them, and the rest is asked.

The oracle is the record from which the logs were written.
"""

import re
import tomllib

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.photographs.measuring import COLUMNS, MeasuredPair
from identify.commands.help import DONE, NOT_DONE
from identify.errors import RecordError, ScenarioError
from identify.record.own_record import log_suspicions, read_description, read_own_records
from identify.record.recording import poses
from tests.identify.commands import command, one_line
from tests.identify.synthetic import rss6
from tests.identify.test_readers import (
    SIGNS,
    TOLERANCE,
    ZEROS,
    as_mcap,
    as_motive,
    as_table,
    as_vicon,
    change,
    described,
    record,  # noqa: F401
    telemetry_of,
)


def proposed(path, *logs, more=()):
    """Propose the description of a record from logs, and return its [columns]."""
    path.with_suffix(".toml").unlink(missing_ok=True)
    options = [part for log in logs for part in ("--from", log)]
    assert command("new", "record", path, "rss6", *options, *more, "--quiet") == DONE
    return tomllib.loads(path.with_suffix(".toml").read_text())["columns"]


def answer(path, key, value, after=""):
    """Replace a key that is asked by a value."""
    text = path.with_suffix(".toml").read_text()
    place = text.index(after)
    assert re.search(rf'^{key} = "\?"', text[place:], re.MULTILINE)
    found = re.sub(
        rf'^{key} = "\?".*$', lambda _: f"{key} = {value}", text[place:], count=1, flags=re.M
    )
    path.with_suffix(".toml").write_text(text[:place] + found)


def uncomment(path, entry, value, after):
    text = path.with_suffix(".toml").read_text()
    place = text.index(after)
    found = re.sub(
        rf"^# {entry} = .*$", lambda _: f"{entry} = {value}", text[place:], count=1, flags=re.M
    )
    path.with_suffix(".toml").write_text(text[:place] + found)


def check(path, recorded):
    found = telemetry_of(path)
    ok = recorded["measured_ok"].values == 1
    rows = found.poses.ok
    measured = poses(recorded, "measured")[ok]
    np.testing.assert_allclose(found.poses.pose[rows], measured, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(
        found.commands.command, recorded["command"].values, rtol=0, atol=TOLERANCE
    )


def test_a_proposal_for_motive_asks_only_for_the_unit_of_the_commands(record, tmp_path):  # noqa: F811
    take = as_motive(tmp_path, record)
    path = tmp_path / "mine.csv"
    found = proposed(path, take, tmp_path / "commands.csv")
    assert found["measured"]["position_unit"] == "mm"
    assert found["command"]["time_unit"] == "ms"
    with pytest.raises(RecordError, match=r"command.unit: '\?' is not a unit: rad, deg"):
        telemetry_of(path)
    answer(path, "unit", '"deg"')
    uncomment(path, "axes", '["x", "-z", "y"]', "[columns.measured]")
    uncomment(path, "signs", SIGNS.tolist(), "[columns.command]")
    uncomment(path, "zeros", ZEROS.tolist(), "[columns.command]")
    check(path, record)


def test_a_proposal_for_vicon_asks_which_body_and_which_convention(record, tmp_path, capfd):  # noqa: F811
    trial = as_vicon(tmp_path, record)
    trial.with_suffix(".toml").unlink()
    logs = ("--from", trial, "--from", tmp_path / "commands.csv", "--quiet")
    assert command("new", "record", trial, "rss6", *logs) == NOT_DONE
    said = one_line(capfd.readouterr().err)
    assert "several poses: choose one of 'Segments Base', 'Segments Plate' with --body" in said
    found = proposed(trial, trial, tmp_path / "commands.csv", more=("--body", "Segments Plate"))
    assert (found["measured"]["time"], found["measured"]["time_unit"]) == ("Frame", "frames")
    assert found["measured"]["convention"] == "?"
    assert found["measured"]["angle_unit"] == "deg"
    with pytest.raises(RecordError, match=r"'\?' is not a convention: quaternion_xyzw"):
        telemetry_of(trial)


@pytest.mark.slow
def test_a_proposal_keeps_the_order_of_angles_and_a_wrong_order_is_found_with_what_fits(
    record,  # noqa: F811
    tmp_path,
):
    log = tmp_path / "lab.csv"
    table = pd.read_csv(as_table(tmp_path, record))
    ok = record["measured_ok"].values == 1
    pose = poses(record, "measured")
    turned = np.full((len(ok), 3), np.nan)
    turned[ok] = Rotation.from_euler("XYZ", pose[ok, 3:]).as_euler("ZYX", degrees=True)
    own = {f"tcp_{axis}_mm": 1e3 * pose[:, k] for k, axis in enumerate("xyz")}
    angles = [f"{name}_deg" for name in ("yaw", "pitch", "roll")]
    own |= dict(zip(angles, turned.T, strict=True))
    commands = [name for name in table if name.startswith("command_") and name.endswith("_rad")]
    pd.DataFrame({"time_s": table["time_s"]} | own | dict(table[commands])).to_csv(log, index=False)
    found = proposed(log, log)
    assert found["measured"]["position"] == ["tcp_x_mm", "tcp_y_mm", "tcp_z_mm"]
    assert found["measured"]["orientation"] == angles
    said = log.with_suffix(".toml").read_text()
    assert "for this order of the columns: euler_ZYX about the body's own axes" in said
    answer(log, "convention", '"euler_XYZ"')
    said = r"unexplained, and .* with convention = .*'euler_ZYX'"
    with pytest.raises(RecordError, match=said):
        read_own_records([log])
    # The natural answer for yaw, pitch and roll, but with the columns in another order.
    given = ", ".join(f'"{name}"' for name in angles)
    other = ", ".join(f'"{name}"' for name in angles[::-1])
    change(log.with_suffix(".toml"), "euler_XYZ", "euler_ZYX")
    change(log.with_suffix(".toml"), given, other)
    with pytest.raises(RecordError, match=r"with convention = .*'euler_xyz'"):
        read_own_records([log])
    change(log.with_suffix(".toml"), other, given)
    check(log, record)
    about = read_description(log.with_suffix(".toml"), log)
    assert not log_suspicions(log, about, telemetry_of(log), rss6())


def test_a_proposal_for_a_bag_needs_no_answer(record, tmp_path, read_here):  # noqa: F811
    bag = as_mcap(tmp_path, record)
    proposed(bag, bag)
    check(bag, record)


def test_a_proposal_for_a_table_finds_poses_references_and_commands(record, tmp_path):  # noqa: F811
    table = as_table(tmp_path, record)
    found = proposed(table, table)
    assert found["measured"]["time"] == "time_s"
    for section in ("measured", "reference"):
        assert found[section]["convention"] == "euler_XYZ"
    check(table, record)
    np.testing.assert_allclose(
        telemetry_of(table).reference.pose, poses(record, "reference"), rtol=0, atol=TOLERANCE
    )


def test_rounded_times_give_the_mean_rate_and_a_mark_is_a_comment(record, tmp_path):  # noqa: F811
    path = as_table(tmp_path, record)
    table = pd.read_csv(path).assign(valid=1)
    table["time_s"] = table["time_s"].round(4)  # most steps are then 16.7 ms, 59.88 a second
    table.rename(columns=lambda name: name.replace("measured_", "tcp_")).to_csv(path, index=False)
    proposed(path, path)
    text = path.with_suffix(".toml").read_text()
    assert "frame_rate_hz = 60.0" in text
    assert '# ok = "valid"  # if it is 1' in text


@pytest.mark.parametrize(("step", "rate"), [(0.01, "100.0"), (4e6, "250.0"), (1, "60.0")])
def test_a_rate_follows_from_the_only_likely_unit_of_times(step, rate, record, tmp_path):  # noqa: F811
    """Times in s and in ns; a step of one can be a count of frames, and leaves the usual rate."""
    path = as_table(tmp_path, record)
    table = pd.read_csv(path).rename(columns={"time_s": "stamp"})
    table.assign(stamp=step * np.arange(len(table))).to_csv(path, index=False)
    assert proposed(path, path)["measured"]["time_unit"] == "?"
    assert f"frame_rate_hz = {rate} " in path.with_suffix(".toml").read_text()


@pytest.mark.parametrize("form", ["{}_ref", "{}Ref", "desired_{}"])
def test_desired_poses_are_proposed_by_a_word_before_or_after_their_axis(form, record, tmp_path):  # noqa: F811
    """Beside a pose of which only the position names the body."""
    table = as_table(tmp_path, record)
    turns = {"alpha": "roll", "beta": "pitch", "gamma": "yaw"}
    axes = {name: name for name in "xyz"} | turns
    own = {"x": "tcp_x", "y": "tcp_y", "z": "tcp_z"}
    names = {}
    for name, axis in axes.items():
        unit = "m" if name in own else "rad"
        names[f"measured_{name}_{unit}"] = own.get(name, axis)
        names[f"reference_{name}_{unit}"] = form.format(axis)
    pd.read_csv(table).rename(columns=names).to_csv(table, index=False)
    found = proposed(table, table)
    assert found["measured"]["position"] == ["tcp_x", "tcp_y", "tcp_z"]
    assert found["measured"]["orientation"] == ["roll", "pitch", "yaw"]
    wanted = [form.format(axis) for axis in axes.values()]
    assert [*found["reference"]["position"], *found["reference"]["orientation"]] == wanted


def measured_pairs(recorded, rng):
    """The rows of `cmmsim measure` for the poses of a record, some of which are lost."""
    for k, pose in enumerate(poses(recorded, "measured")):
        root = 1e-6 * rng.standard_normal((6, 6))
        if k == 2 or not np.isfinite(pose).all():
            found = lost_measurement("0 bright spots, in both images")
        else:
            none = np.zeros((0, 3))
            found = Measurement(
                pose, root @ root.T, none, none[:, None], none[:, :2], none[:, :2], none, ok=True
            )
        yield MeasuredPair(f"{k:03d}.png", k / 60.0, found, None)


@pytest.mark.parametrize("beside", [False, True])
def test_a_table_of_measured_photographs_is_the_measured_part_of_a_record(record, tmp_path, beside):  # noqa: F811
    """With the commands in columns beside, or in a file of their own."""
    pairs = list(measured_pairs(record, np.random.default_rng(0)))
    found = pd.DataFrame([pair.row for pair in pairs], columns=COLUMNS)
    names = [f"command_{k}_rad" for k in range(1, 7)]
    commands = pd.DataFrame(record["command"].values, columns=names)
    path = tmp_path / "mine.csv"
    if beside:
        pd.concat([found, commands], axis=1).to_csv(path, index=False)
        described(path, "")
    else:
        found.to_csv(tmp_path / "poses.csv", index=False)
        commands.assign(time_s=found["time_s"]).to_csv(tmp_path / "commands.csv", index=False)
        proposed(path, tmp_path / "poses.csv", tmp_path / "commands.csv")
    read = telemetry_of(path)
    np.testing.assert_array_equal(read.poses.ok, [pair.measurement.ok for pair in pairs])
    assert not read.poses.ok[2]
    np.testing.assert_allclose(read.commands.command, commands.values, rtol=0, atol=TOLERANCE)
    for k in np.flatnonzero(read.poses.ok):
        measured = pairs[k].measurement
        np.testing.assert_allclose(read.poses.pose[k], measured.pose, rtol=0, atol=TOLERANCE)
        scale = np.sqrt(np.outer(*2 * [np.diag(measured.covariance)]))
        gap = (read.poses.covariance[k] - measured.covariance) / scale
        assert np.abs(gap).max() < 1e-9


def test_names_without_units_are_asked_with_the_range_of_their_numbers(record, tmp_path):  # noqa: F811
    """At 29.97 Hz, of which 20 s are no whole number of frames."""
    names = ["t", "px", "py", "pz", "qw", "qx", "qy", "qz", *(f"u{k}" for k in range(1, 7))]
    numbers = np.arange(60.0)[:, None] / 29.97 + np.zeros(len(names))
    path = tmp_path / "plain.csv"
    pd.DataFrame(numbers, columns=names).to_csv(path, index=False)
    found = proposed(path, path)
    assert found["measured"]["orientation"] == ["qx", "qy", "qz", "qw"]
    assert found["command"]["names"] == names[-6:]
    asked = {key for key, value in found["measured"].items() if value == "?"}
    assert asked == {"time_unit", "position_unit"}
    assert "from 0 to 1.96864" in path.with_suffix(".toml").read_text()
    answer(path, "time_unit", '"s"')
    answer(path, "position_unit", '"m"')
    answer(path, "unit", '"rad"')
    with pytest.raises(
        RecordError, match="line 2: the measured pose is 0 in all cells, as in 1 of 60 rows"
    ):
        telemetry_of(path)
    change(path.with_suffix(".toml"), "frame_rate_hz = 29.97", "frame_rate_hz = -1.0")
    with pytest.raises(ScenarioError, match="frame_rate_hz = -1"):
        telemetry_of(path)


def test_a_log_without_poses_or_with_several_groups_of_commands_says_so(record, tmp_path, capfd):  # noqa: F811
    table = as_table(tmp_path, record)
    table.with_suffix(".toml").unlink()
    found = pd.read_csv(table)
    again = {f"command_{k}_rad": f"command_again_{k}_rad" for k in range(1, 7)}
    found.assign(**{new: found[old] for old, new in again.items()}).to_csv(table, index=False)
    for options, says in (
        ((), "several commands of 6 joints: choose one of 'command', 'command_again'"),
        (("--body", "plate"), "no poses 'plate': choose one of 'measured' with --body"),
    ):
        assert command("new", "record", table, "rss6", "--from", table, *options) == NOT_DONE
        assert says in one_line(capfd.readouterr().err)
    assert not table.with_suffix(".toml").exists()
    proposed(table, table, more=("--commands", "command_again"))
    (tmp_path / "none.csv").write_text("a,b\n1,2\n")
    command("new", "record", tmp_path / "n.csv", "rss6", "--from", tmp_path / "none.csv")
    assert "no poses are found in the header" in one_line(capfd.readouterr().err)
