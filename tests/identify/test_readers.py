"""Logs of other programs: what is in them is read to the last digits, and what is wrong is named.

The same poses and commands are written as each program writes them, by `log_files`.
"""

import re
import sys

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from dynamics import load_robot
from identify.commands.help import NOT_DONE
from identify.errors import RecordError
from identify.record.from_telemetry import reading_notes
from identify.record.own_record import (
    description_file,
    read_description,
    read_own_records,
    read_telemetry,
)
from identify.record.readers.bags import Bag
from identify.record.readers.mapped import read_otherwise
from identify.record.recording import poses, write
from identify.verification.logged_run import read_logged_run
from tests.identify.commands import command, one_line
from tests.identify.log_files import (
    FIRST_FRAME,
    write_bag,
    write_commands,
    write_motive,
    write_transforms,
    write_vicon,
)
from tests.identify.synthetic import short_run
from tests.identify.test_own_record import DESCRIPTION, table_of

TOLERANCE = 1e-9
SIGNS = np.array([1, -1, 1, -1, 1, -1])
ZEROS = np.array([10.0, 0, -20, 0, 0, 370])
ANCHOR = (
    DESCRIPTION.format(std=0.005, value=20.0)
    + "position_std_m = 5e-6\norientation_std_rad = 3e-5\n"
)

COMMANDS = f"""
[columns.command]
file = "commands.csv"
time = "t_ms"
time_unit = "ms"
names = ["q0", "q1", "q2", "q3", "q4", "q5"]
unit = "deg"
signs = {SIGNS.tolist()}
zeros = {ZEROS.tolist()}
"""

MOTIVE = """
[columns.measured]
time = "Time (Seconds)"
position = ["Plate Position X", "Plate Position Y", "Plate Position Z"]
position_unit = "mm"
orientation = ["Plate Rotation X", "Plate Rotation Y", "Plate Rotation Z", "Plate Rotation W"]
convention = "quaternion_xyzw"
axes = ["x", "-z", "y"]
"""

VICON = """
[columns.measured]
topic = "Segments"
time = "Frame"
time_unit = "frames"
position = ["Plate:Plate TX", "Plate:Plate TY", "Plate:Plate TZ"]
position_unit = "mm"
orientation = ["Plate:Plate RX", "Plate:Plate RY", "Plate:Plate RZ"]
convention = "rotation_vector"
angle_unit = "deg"
base_from_frame = [0.5, -0.25, 1.5, 0.1, 0.2, -2.5]
body_from_platform = [0.01, 0.02, -0.125, 0.3, 0.0, 1.0]
"""

BAG = """
[columns.measured]
topic = "/plate/pose"
time = "header.stamp"
position = ["pose.position.x", "pose.position.y", "pose.position.z"]
position_unit = "m"
orientation = ["pose.orientation.w", "pose.orientation.x", "pose.orientation.y", "pose.orientation.z"]
convention = "quaternion_wxyz"
[columns.command]
topic = "/joint_commands"
time = "header.stamp"
names = ["position[crank1]", "position[crank2]", "position[crank3]", "position[crank4]", "position[crank5]", "position[crank6]"]
unit = "rad"
"""

ONE_TABLE = """
[columns.measured]
time = "time_s"
position = ["measured_x_m", "measured_y_m", "measured_z_m"]
position_unit = "m"
orientation = ["measured_alpha_rad", "measured_beta_rad", "measured_gamma_rad"]
convention = "euler_XYZ"
[columns.reference]
position = ["reference_x_m", "reference_y_m", "reference_z_m"]
position_unit = "m"
orientation = ["reference_alpha_rad", "reference_beta_rad", "reference_gamma_rad"]
convention = "euler_XYZ"
[columns.command]
names = ["command_1_rad", "command_2_rad", "command_3_rad", "command_4_rad", "command_5_rad", "command_6_rad"]
unit = "rad"
written = "command_time_s"
"""


def transform(pose):
    found = np.eye(4)
    found[:3, :3] = Rotation.from_euler("XYZ", pose[3:]).as_matrix()
    found[:3, 3] = pose[:3]
    return found


@pytest.fixture(scope="module")
def record():
    found = short_run()[0]
    return found.assign(command_time=("time", found["time"].values + 0.004))


def described(path, columns):
    """A path whose description names its columns."""
    path.with_suffix(".toml").write_text(ANCHOR + columns)
    return path


def telemetry_of(path):
    about = read_description(description_file(path), path)
    return read_telemetry(path, about, load_robot(about.scenario.robot))


def as_motive(folder, record):
    write_commands(folder / "commands.csv", record, SIGNS, ZEROS)
    write_motive(folder / "take.csv", record)
    return described(folder / "take.csv", MOTIVE + COMMANDS)


def as_newer_motive(folder, record):
    write_commands(folder / "commands.csv", record, SIGNS, ZEROS)
    write_motive(folder / "take.csv", record, "1.25")
    return described(folder / "take.csv", MOTIVE + COMMANDS)


def as_vicon(folder, record):
    """Its commands are on a clock that shows zero a tenth of a second before frame 0."""
    write_commands(folder / "commands.csv", record, SIGNS, ZEROS, offset_s=-0.1 - FIRST_FRAME / 60)
    base_from_frame = transform([0.5, -0.25, 1.5, 0.1, 0.2, -2.5])
    body_from_platform = transform([0.01, 0.02, -0.125, 0.3, 0.0, 1.0])
    write_vicon(
        folder / "trial.csv",
        record,
        np.linalg.inv(base_from_frame),
        np.linalg.inv(body_from_platform),
    )
    return described(folder / "trial.csv", VICON + COMMANDS + "time_offset_s = -0.1\n")


def as_mcap(folder, record):
    write_bag(folder / "bag", record)
    (folder / "bag" / "bag.mcap").rename(folder / "run.mcap")
    return described(folder / "run.mcap", BAG)


def as_bag(folder, record):
    write_bag(folder / "run", record, mcap=False)
    return described(folder / "run", BAG)


def as_table(folder, record):
    table_of(record).to_csv(folder / "mine.csv", index=False)
    return described(folder / "mine.csv", ONE_TABLE)


def as_our_table(folder, record):
    table_of(record).to_csv(folder / "mine.csv", index=False)
    return described(folder / "mine.csv", "")


@pytest.mark.parametrize(
    "write_log", [as_motive, as_newer_motive, as_vicon, as_mcap, as_bag, as_table, as_our_table]
)
def test_every_kind_of_log_holds_the_poses_and_commands_of_the_record_to_1e_9(
    write_log, record, tmp_path, read_here
):
    found = telemetry_of(write_log(tmp_path, record))
    ok = record["measured_ok"].values == 1
    # A bag has no message where the pose was lost.
    rows = ok if len(found.poses.time) == ok.sum() else np.full(len(ok), True)
    np.testing.assert_array_equal(found.poses.ok, ok[rows])
    for ours, theirs in (
        (found.poses.time, record["time"].values[rows]),
        (found.poses.pose, poses(record, "measured")[rows]),
        (found.commands.time, record["time"].values),
        (found.commands.command, record["command"].values),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=TOLERANCE)


@pytest.mark.slow
def test_records_of_all_logs_and_of_netcdf_are_the_same_to_1e_9(record, tmp_path):
    """Logs without a reference become records with times of their own."""
    write(tmp_path / "mine.nc", record)
    (kept,), _ = read_own_records([tmp_path / "mine.nc"])
    ok = kept["measured_ok"].values == 1
    for place, write_log in enumerate((as_motive, as_vicon, as_mcap)):
        folder = tmp_path / str(place)
        folder.mkdir()
        (found,), _ = read_own_records([write_log(folder, record)])
        seen = found["measured_ok"].values == 1
        # Before its second command the model does not run, and a command that stays is no event.
        begun = ok & (kept["time"].values >= found["time"].values[0] - TOLERANCE)
        for ours, theirs in (
            (poses(found, "measured")[seen], poses(kept, "measured")[begun]),
            (found["time"].values[seen], kept["time"].values[begun]),
        ):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=TOLERANCE)
        rows = np.searchsorted(kept["time"].values - TOLERANCE, found["acting"].values) - 1
        np.testing.assert_allclose(
            found["command"].values, kept["command"].values[rows], rtol=0, atol=TOLERANCE
        )


def test_a_latency_does_not_move_commands_that_have_times_of_their_own(record, tmp_path):
    path = as_motive(tmp_path, record)
    (own,), _ = read_own_records([path])
    change(
        path.with_suffix(".toml"), "frame_rate_hz = 60.0", "frame_rate_hz = 60.0\nlatency_s = 0.1"
    )
    (late,), _ = read_own_records([path])
    np.testing.assert_array_equal(late["acting"], own["acting"])
    note = "timing.latency_s = 0.1 does not move the commands, which have times of their own"
    assert set(reading_notes([late])) - set(reading_notes([own])) == {note}


def test_netcdf_holds_the_same(record, tmp_path):
    write(tmp_path / "mine.nc", record)
    (found,), _ = read_own_records([tmp_path / "mine.nc"])
    np.testing.assert_array_equal(poses(found, "measured"), poses(record, "measured"))
    np.testing.assert_array_equal(found["command"], record["command"])


@pytest.mark.parametrize(
    ("convention", "names", "values"),
    [
        ("matrix", 9, lambda turned: turned.as_matrix().reshape(-1, 9)),
        ("rotation_vector", 3, lambda turned: turned.as_rotvec()),
        ("quaternion_wxyz", 4, lambda turned: turned.as_quat(scalar_first=True)),
        ("euler_xyz", 3, lambda turned: turned.as_euler("xyz")),
        ("euler_ZXZ", 3, lambda turned: turned.as_euler("ZXZ")),
    ],
)
def test_every_convention_of_rotations_is_read(convention, names, values, record, tmp_path):
    path = as_table(tmp_path, record)
    ok = record["measured_ok"].values == 1
    turned = Rotation.from_euler("XYZ", poses(record, "measured")[ok, 3:])
    columns = [f"o{k}" for k in range(names)]
    found = pd.DataFrame(np.full((len(ok), names), np.nan), columns=columns)
    found.loc[ok, columns] = values(turned)
    pd.concat([pd.read_csv(path), found], axis=1).to_csv(path, index=False)
    listed = ", ".join(f'"{name}"' for name in columns)
    change(
        path.with_suffix(".toml"),
        'orientation = ["measured_alpha_rad", "measured_beta_rad", "measured_gamma_rad"]\n'
        'convention = "euler_XYZ"',
        f'orientation = [{listed}]\nconvention = "{convention}"',
    )
    read = telemetry_of(path).poses
    np.testing.assert_allclose(
        read.pose, poses(record, "measured"), rtol=0, atol=TOLERANCE, equal_nan=True
    )


def test_a_left_handed_log_with_y_up_is_the_same_record_with_its_axes_named(record, tmp_path):
    """The oracle reflects points: a left-handed system has y and z of ours exchanged."""
    path = as_table(tmp_path, record)
    ours = poses(record, "measured")
    ok = record["measured_ok"].values == 1
    mirror = np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]])
    turned = Rotation.from_euler("XYZ", ours[ok, 3:]).as_matrix()
    table = pd.read_csv(path)
    names = table.columns[table.columns.str.startswith("measured_")]
    table.loc[ok, names[:3]] = ours[ok, :3] @ mirror
    table.loc[ok, names[3:]] = Rotation.from_matrix(mirror @ turned @ mirror).as_euler("XYZ")
    table.to_csv(path, index=False)
    right = 'axes = ["x", "z", "y"]'
    said = f"{re.escape(right)} in .columns.measured. it would fit .the frame is left"
    with pytest.raises(RecordError, match=said):
        read_own_records([path])
    # The proposal replaces what the file states, also where that moves the poses.
    described = path.with_suffix(".toml")
    stated = 'axes = ["-x", "z", "-y"]\nbase_from_frame = [0.001, 0, 0, 0, 0, 0.01]\n'
    change(described, "[columns.reference]", f"{stated}[columns.reference]")
    with pytest.raises(RecordError, match=said):
        read_own_records([path])
    change(described, stated, f"{right}\n")
    np.testing.assert_allclose(
        telemetry_of(path).poses.pose, ours, rtol=0, atol=TOLERANCE, equal_nan=True
    )


def test_rows_of_events_and_columns_of_two_lengths_are_two_logs(record, tmp_path):
    """Commands are logged in rows of their own, between those of the poses or beside them."""
    whole = telemetry_of(as_our_table(tmp_path, record))
    table = pd.read_csv(tmp_path / "mine.csv")
    commands = [name for name in table if name.startswith("command_") and "time" not in name]
    measured = [name for name in table if name.startswith("measured_")]
    seen = table[measured].notna().all(axis=1)
    poses_ = table.loc[seen, ["time_s", *measured]]
    written = table[["time_s", *commands]].assign(time_s=table["time_s"] + 0.005)
    listed = ", ".join(f'"{name}"' for name in commands)
    head = ONE_TABLE.split("[columns.reference]")[0]
    events = pd.concat([poses_, written]).sort_values("time_s")
    beside = pd.concat(
        [poses_.reset_index(drop=True), written.rename(columns={"time_s": "t"})], axis=1
    )
    for rows, time in ((events, "time_s"), (beside, "t")):
        path = tmp_path / "other.csv"
        rows.to_csv(path, index=False)
        told = f'[columns.command]\ntime = "{time}"\nnames = [{listed}]\nunit = "rad"\n'
        found = telemetry_of(described(path, head + told))
        np.testing.assert_allclose(found.poses.pose, whole.poses.pose[seen], rtol=0, atol=1e-14)
        np.testing.assert_array_equal(found.commands.command, whole.commands.command)
        np.testing.assert_allclose(
            found.commands.time, whole.commands.time + 0.005, rtol=0, atol=1e-12
        )
        assert found.poses.ok.all()


def test_a_quaternion_of_the_other_order_is_named(record, tmp_path):
    """All poses are then turned by half a turn, out of reach."""
    path = as_table(tmp_path, record)
    ok = record["measured_ok"].values == 1
    table = pd.read_csv(path)
    turned = Rotation.from_euler("XYZ", poses(record, "measured")[ok, 3:])
    table.loc[ok, ["qw", "qx", "qy", "qz"]] = turned.as_quat(scalar_first=True)
    table.to_csv(path, index=False)
    change(
        path.with_suffix(".toml"),
        'orientation = ["measured_alpha_rad", "measured_beta_rad", "measured_gamma_rad"]\n'
        'convention = "euler_XYZ"',
        'orientation = ["qw", "qx", "qy", "qz"]\nconvention = "quaternion_xyzw"',
    )
    said = "cannot reach .* with convention = 'quaternion_wxyz' of the poses it would fit"
    with pytest.raises(RecordError, match=said):
        read_own_records([path])


def test_degrees_taken_for_rad_are_named_where_angles_wrap(record, tmp_path):
    """A pitch beyond a quarter turn of rad is another rotation, so scaled angles cannot fit."""
    path = as_table(tmp_path, record)
    table = pd.read_csv(path)
    names = [name for name in table if name.startswith("measured_")][:6]
    ok = record["measured_ok"].values == 1
    tilted = Rotation.from_euler("Y", 0.05)  # rad, almost three degrees
    ours = poses(record, "measured")[ok]
    table.loc[ok, names[:3]] = tilted.apply(ours[:, :3])
    turned = tilted * Rotation.from_euler("XYZ", ours[:, 3:])
    table.loc[ok, names[3:]] = turned.as_euler("XYZ", degrees=True)
    table.to_csv(path, index=False)
    change(
        path.with_suffix(".toml"),
        "[columns.reference]",
        "base_from_frame = [0, 0, 0, 0, -0.05, 0]\n[columns.reference]",
    )
    with pytest.raises(RecordError, match="; with angle_unit = 'deg' of the poses it would fit"):
        read_own_records([path])


def test_orders_of_angles_that_a_small_motion_cannot_tell_are_named(record, tmp_path):
    """In a frame that is turned by a radian the order changes the motion, and none is equal."""
    path = as_table(tmp_path, record)
    change(path.with_suffix(".toml"), 'convention = "euler_XYZ"', 'convention = "euler_xyz"')
    assert "euler_XYZ" in read_logged_run(path).equal_orders
    table = pd.read_csv(path)
    names = [name for name in table if name.startswith("measured_")][:6]
    ok = record["measured_ok"].values == 1
    frame = [0.5, 0.6, -0.7]  # alpha, beta, gamma, rad
    turned = Rotation.from_euler("XYZ", frame).inv()
    ours = poses(record, "measured")[ok]
    table.loc[ok, names[:3]] = turned.apply(ours[:, :3])
    seen = turned * Rotation.from_euler("XYZ", ours[:, 3:])
    table.loc[ok, names[3:]] = seen.as_euler("xyz")
    table.to_csv(path, index=False)
    change(
        path.with_suffix(".toml"),
        "[columns.reference]",
        f"base_from_frame = [0, 0, 0, {', '.join(map(str, frame))}]\n[columns.reference]",
    )
    assert read_logged_run(path).equal_orders == ()


def test_poses_with_other_conventions_are_those_of_a_file_that_states_them(record, tmp_path):
    path = as_table(tmp_path, record)
    seen = telemetry_of(path).poses
    columns = read_description(description_file(path), path).columns
    names = ["euler_zyx", "rotation_vector"]
    others = [columns.measured.model_copy(update={"convention": name}) for name in names]
    found = [
        log for _, log in read_otherwise(columns, path, load_robot("rss6"), 60.0, seen, others)
    ]
    text = path.with_suffix(".toml").read_text()
    for other, log in zip(others, found, strict=True):
        stated = text.replace('convention = "euler_XYZ"', f'convention = "{other.convention}"', 1)
        path.with_suffix(".toml").write_text(stated)
        np.testing.assert_array_equal(log.pose, telemetry_of(path).poses.pose)
        assert not np.array_equal(log.pose, seen.pose, equal_nan=True)


def test_commands_in_a_wrong_unit_do_not_put_the_convention_in_doubt(record, tmp_path):
    path = as_table(tmp_path, record)
    change(path.with_suffix(".toml"), 'unit = "rad"', 'unit = "deg"')
    with pytest.raises(
        RecordError, match=r'with unit = "rad" in .columns.command. they would fit$'
    ):
        read_own_records([path])


def test_a_description_alone_names_its_log(record, tmp_path, capfd):
    """Bags are folders with dots in their names, and one description can name several files."""
    path = as_motive(tmp_path, record)
    text = path.with_suffix(".toml").read_text()
    (tmp_path / "whole.toml").write_text(
        text.replace("[columns.measured]", '[columns.measured]\nfile = "take.csv"')
    )
    found = telemetry_of(tmp_path / "whole.toml")
    np.testing.assert_array_equal(found.poses.pose, telemetry_of(path).poses.pose)
    # The check takes this file, too, and reads its log.
    change(tmp_path / "whole.toml", 'file = "take.csv"', 'file = "none.csv"')
    assert command("check", tmp_path / "whole.toml") == NOT_DONE
    assert "none.csv" in one_line(capfd.readouterr().err)


def test_a_mapped_table_is_the_record_that_our_own_table_is(record, tmp_path):
    (mapped,), scenario = read_own_records([as_table(tmp_path, record)])
    (ours,), _ = read_own_records([as_our_table(tmp_path, record)])
    for name in ("measured_position", "measured_orientation", "command", "command_time", "time"):
        np.testing.assert_allclose(mapped[name], ours[name], rtol=0, atol=1e-14)
    assert scenario.timing.frame_rate_hz == 60.0


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def cell(name, row, value):
    """A table with one other cell."""

    def spoil(path):
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
        table.loc[row, name] = value
        table.to_csv(path, index=False)

    return spoil


def described_as(old, new):
    return lambda path: change(path.with_suffix(".toml"), old, new)


def scaled(prefix, factor):
    def spoil(path):
        table = pd.read_csv(path)
        names = [name for name in table if name.startswith(prefix) and "time" not in name]
        table[names] *= factor
        table.to_csv(path, index=False)

    return spoil


WRONG_TABLES = [
    (cell("time_s", 7, "0.05"), "line 9: its time 0.05 s is before 0.1 s of line 8"),
    (cell("time_s", 7, "0.1"), "line 9: its time 0.1 s is also that of line 8"),
    (cell("time_s", 7, "soon"), "line 9: the time time_s is 'soon', which is not a number"),
    (cell("command_2_rad", 3, ""), "line 5: the command command_2_rad is empty or not finite"),
    (cell("reference_x_m", 4, ""), "line 6: the desired pose has an empty cell"),
    (
        cell("measured_x_m", 2, "1,5"),
        "line 4: measured_x_m is '1,5', which is not a number; it has a decimal comma: export",
    ),
    (
        described_as('"measured_y_m", "measured_z_m"', '"measured_y_m", "measured_y_m"'),
        r"\[columns\] measured: column 'measured_y_m' is named twice",
    ),
    (
        described_as('names = ["command_1_rad"', 'names = ["measured_x_m"'),
        r"\[columns\] column 'measured_x_m' is named twice",
    ),
    (
        described_as('"measured_z_m"]', '"z"]'),
        r"mine.csv: there is no column 'z'; it has time_s, reference_x_m",
    ),
    (described_as('position_unit = "m"', 'position_unit = "?"'), "'m', 'mm', 'cm' or 'um'"),
    (
        described_as('convention = "euler_XYZ"', 'convention = "?"'),
        "'[?]' is not a convention: quaternion_xyzw, quaternion_wxyz, matrix",
    ),
    (
        described_as('convention = "euler_XYZ"', 'convention = "euler_xxy"'),
        "'euler_xxy' is not a convention: quaternion_xyzw, quaternion_wxyz, matrix",
    ),
    (
        described_as('convention = "euler_XYZ"', 'convention = "quaternion_xyzw"'),
        "orientation names 3 columns, but the convention quaternion_xyzw has 4",
    ),
    (described_as('unit = "rad"', 'unit = "mm"'), "unit is 'mm', and the joints of rss6 move in"),
    (described_as('unit = "rad"', 'unit = "furlong"'), "unit: 'furlong' is not a unit: rad, deg"),
    (
        described_as(', "command_6_rad"]', "]"),
        "names has 5 columns, and rss6 has 6 joints",
    ),
    (
        scaled("measured_", 1e3),
        "line 61: an angle of .* is 6.42008 rad, more than a turn; if these are degrees",
    ),
    (
        described_as('position_unit = "m"', 'position_unit = "mm"'),
        "line 2: leg . of rss6 cannot reach .* with position_unit = .m. in .columns.measured. it",
    ),
    (
        described_as('position_unit = "m"', 'position_unit = "um"'),
        "line 2: leg . of rss6 cannot reach .* with position_unit = .m. in .columns.measured. it",
    ),
    (described_as('unit = "rad"', 'unit = "deg"'), "with unit = .rad. in .columns.command. they"),
    (described_as('unit = "rad"', "unit = 0.1"), "with unit = .rad. in .columns.command. they"),
    (
        described_as('unit = "rad"', 'unit = "rad"\nsigns = [1, 1, -1, 1, 1, 1]'),
        "the commands of joint 3 count against the direction .* .signs = .1, 1, 1, 1, 1, 1. in",
    ),
    (
        described_as('unit = "rad"', 'unit = "rad"\nzeros = [0, 6.28, 0, 0, 0, 0]'),
        "the commands of joint 2 lie -6.2.* off by a turn .zeros = .0, -0.003.*, 0, 0, 0, 0. in",
    ),
    (
        described_as(
            'convention = "euler_XYZ"', 'convention = "euler_XYZ"\naxes = ["x", "y", "-z"]'
        ),
        'the poses lie at z = -0.2.* with axes = ."x", "y", "z". in .columns.measured. they',
    ),
    (
        described_as('time = "time_s"', 'time = "time_s"\ntime_unit = "ms"'),
        "line 3: time_s is 1.66667e-05 after 0 in the row before, which is 0.001 frames of 60 Hz",
    ),
]


@pytest.mark.parametrize(("spoil", "says"), WRONG_TABLES)
def test_a_wrong_mapping_or_row_is_one_line_that_names_it(spoil, says, record, tmp_path, capfd):
    path = as_table(tmp_path, record)
    spoil(path)
    assert command("identify", "--record", path, "--out", tmp_path / "new", "--quiet") == NOT_DONE
    assert re.search(says, one_line(capfd.readouterr().err))
    assert not (tmp_path / "new").exists()


def motive_row(old, new, line=12):
    """A Motive export with a cell of one line replaced."""

    def spoil(path):
        lines = path.read_text().splitlines()
        cells = lines[line - 1].split(",")
        lines[line - 1] = ",".join(cells[:2] + new + cells[2 + len(new) :])
        path.write_text("\n".join(lines) + "\n")

    return spoil


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (
            motive_row(None, ["0", "0", "0", "0"]),
            "line 12: the quaternion Plate Rotation X, .* has the length 0, must be 1",
        ),
        (
            described_as('file = "commands.csv"', 'file = "none.csv"'),
            "cannot read record .*none.csv",
        ),
        (
            described_as('time_unit = "ms"', 'time_unit = "ms"\ntime_offset_s = 1e9'),
            "the clocks do not overlap; columns.command.time_offset_s is added .* -1000000000 s more",
        ),
        (
            described_as('"t_ms"\ntime_unit = "ms"', '"t_ms"\ntime_offset_s = 1e9'),
            r"last 1.983 s, and .* 1983 s: the unit .* factor of 1000; state it by time_unit",
        ),
        (described_as("[columns.command]", "[columns.commands]"), "command is missing"),
        (described_as('time = "t_ms"', 'topic = "x"'), "command.time must name the column"),
    ],
)
def test_wrong_exports_are_one_line(spoil, says, record, tmp_path):
    path = as_motive(tmp_path, record)
    spoil(path)
    with pytest.raises(RecordError, match=says):
        read_own_records([path])


def test_a_rate_that_contradicts_the_export_is_refused(record, tmp_path):
    path = as_vicon(tmp_path, record)
    change(path.with_suffix(".toml"), "frame_rate_hz = 60.0", "frame_rate_hz = 100.0")
    with pytest.raises(RecordError, match="states 60 frames per second, and"):
        telemetry_of(path)
    change(path.with_suffix(".toml"), 'topic = "Segments"', 'topic = "Objects"')
    with pytest.raises(RecordError, match=r"no topic 'Objects'; it has Segments \(Vicon\), Traj"):
        telemetry_of(path)


@pytest.mark.slow
def test_a_bag_without_the_topic_lists_those_that_it_has(record, tmp_path):
    path = as_mcap(tmp_path, record)
    change(path.with_suffix(".toml"), "/plate/pose", "/plate")
    listed = (
        r"no topic '/plate'; it has /joint_commands \(sensor_msgs/JointState\), "
        r"/plate/pose \(geometry_msgs/PoseStamped\), /rosout \(std_msgs/String\)"
    )
    with pytest.raises(RecordError, match=listed):
        telemetry_of(path)
    change(path.with_suffix(".toml"), '"/plate"', '"/plate/pose"')
    change(path.with_suffix(".toml"), "position[crank6]", "position[crank7]")
    with pytest.raises(
        RecordError, match=r"no column 'position\[crank7\]'; it has log_time, header.stamp"
    ):
        telemetry_of(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(RecordError, match="cannot read the bag"):
        telemetry_of(path)
    path.with_suffix(".toml").write_text(ANCHOR)
    with pytest.raises(
        RecordError, match=r"run.toml must name the columns of its log in \[columns\]"
    ):
        telemetry_of(path)


def test_a_bag_without_the_package_that_reads_it_is_one_line(record, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    path = described(tmp_path / "run.mcap", BAG)
    with pytest.raises(RecordError, match=r"not installed: pip install 'cmmsim\[bags\]'"):
        telemetry_of(path)


def test_a_transform_among_others_and_arrays_without_a_stamp_are_read_from_a_bag(
    tmp_path, read_here
):
    write_transforms(tmp_path / "bag", 20)
    bag = Bag(tmp_path / "bag")
    body = "transforms[vicon/plate.1]"
    names = [f"{body}.header.stamp", f"{body}.transform.translation.x"]
    plate = bag.read("/tf", names)
    assert plate.rows.place(0) == f"{tmp_path / 'bag'} /tf message 2"
    np.testing.assert_array_equal(plate.numbers(names[1]), 0.01 * np.arange(1, 20, 2))
    moments = plate.moments(names[0], "s", 60.0)
    assert [str(one - 1_700_000_000) for one in moments[:2]] == ["0.001000000", "0.003000000"]
    array = bag.read("/cmd", ["log_time", "data[5]"])
    np.testing.assert_array_equal(array.numbers("data[5]"), 5 + np.arange(20))
    assert str(array.moments("log_time", "s", 60.0)[1]) == "1700000000.001005000"


COVARIANCE_NAMES = [f"c{k}" for k in range(21)]

OF_A_BODY = f"""
[columns.measured]
time = "t"
position = ["x", "y", "z"]
position_unit = "mm"
orientation = ["rx", "ry", "rz"]
convention = "rotation_vector"
angle_unit = "deg"
axes = ["x", "z", "y"]
base_from_frame = [0.5, -0.25, 1.5, 0.1, 0.2, -2.5]
body_from_platform = [0.01, 0.02, -0.125, 0.3, 0.0, 1.0]
covariance = {COVARIANCE_NAMES}
[columns.command]
names = ["q0", "q1", "q2", "q3", "q4", "q5"]
unit = "deg"
"""


def test_a_covariance_of_a_log_follows_its_poses_into_the_frame_of_the_robot(tmp_path):
    """A left-handed log whose tracked body is shifted and turned a little in each of six ways."""
    rng = np.random.default_rng(1)
    step = 1e-4
    shifts = np.vstack([np.zeros((1, 6)), step * np.eye(6)])
    turned = Rotation.from_rotvec([0.3, -0.2, 0.5])
    vectors = (Rotation.from_rotvec(np.radians(shifts[:, 3:])) * turned).as_rotvec(degrees=True)
    root = rng.standard_normal((6, 6))
    covariance = root @ root.T
    cells = np.tile(covariance[np.triu_indices(6)], (7, 1))
    columns = [
        np.arange(7)[:, None] / 60,
        [100.0, 50.0, 30.0] + shifts[:, :3],
        vectors,
        cells,
        np.zeros((7, 6)),
    ]
    names = ["t", "x", "y", "z", "rx", "ry", "rz", *COVARIANCE_NAMES]
    table = pd.DataFrame(np.hstack(columns), columns=[*names, *(f"q{k}" for k in range(6))])
    table.to_csv(tmp_path / "take.csv", index=False)
    found = telemetry_of(described(tmp_path / "take.csv", OF_A_BODY)).poses
    slopes = (found.pose[1:] - found.pose[0]).T / step
    expected = slopes @ covariance @ slopes.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(found.covariance[0] - expected) < 1e-4 * scale).all()
    table.loc[3, "c7"] = np.nan
    table.to_csv(tmp_path / "take.csv", index=False)
    with pytest.raises(
        RecordError, match=r"take\.csv line 5: a covariance of a measured pose is em"
    ):
        telemetry_of(tmp_path / "take.csv")


def test_a_table_that_is_missing_is_named_and_not_its_description(tmp_path):
    with pytest.raises(RecordError, match=r"there is no record .*gone\.csv"):
        telemetry_of(tmp_path / "gone.csv")
