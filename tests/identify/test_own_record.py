"""Records of one's own as CSV: read as documented, the same estimates as from netCDF, and each
broken rule by name.

The tables are written here from the documented names of their columns, by pandas.
"""

import re

import numpy as np
import pandas as pd
import pytest

from identify.commands.help import NOT_DONE
from identify.errors import EstimationError
from identify.files.run_folder import load_result
from identify.model.from_record import identified_model
from identify.record.conditions import OPTIONAL
from identify.record.load import recorded_payload
from identify.record.own_record import read_own_records
from identify.record.recording import VARIABLES, poses, read
from tests.identify.commands import command, one_line
from tests.identify.synthetic import (
    LAYOUT,
    index_of,
    quick,
    short_run,
    side_of,
)
from tests.identify.test_recording import with_values

POSE = ("x", "y", "z", "alpha", "beta", "gamma")
UNIT = dict.fromkeys(POSE[:3], "m") | dict.fromkeys(POSE[3:], "rad")
DESCRIPTION = """
robot = "rss6"
[timing]
frame_rate_hz = 60.0
[identification]
scale_anchor = "platform_mass"
anchor_std = {std!r}
max_iterations = 1
[record]
anchor_value = {value!r}
"""


def table_of(record):
    """The columns of a record by their documented names."""
    rates = np.hstack([record["reference_velocity"], record["reference_orientation_rate"]])
    columns = {"time_s": record["time"].values}
    columns |= {
        f"reference_{a}_{UNIT[a]}": poses(record, "reference")[:, k] for k, a in enumerate(POSE)
    }
    columns |= {f"rate_{a}_{UNIT[a]}_s": rates[:, k] for k, a in enumerate(POSE)}
    columns |= {
        f"measured_{a}_{UNIT[a]}": poses(record, "measured")[:, k] for k, a in enumerate(POSE)
    }
    columns |= {f"command_{k + 1}_rad": record["command"].values[:, k] for k in range(6)}
    columns["command_time_s"] = record["command_time"].values
    covariance = record["measured_covariance"].values
    for i, a in enumerate(POSE):
        columns |= {
            f"covariance_{a}_{b}": covariance[:, i, j] for j, b in enumerate(POSE) if j >= i
        }
    return pd.DataFrame(columns)


@pytest.fixture(scope="module")
def record():
    """With a log of when commands acted, which is empty where the frame was lost."""
    found = short_run()[0]
    acted = np.where(found["measured_ok"] == 1, found["time"] + 0.004, np.nan)
    return found.assign(command_time=("time", acted))


@pytest.fixture
def mine(tmp_path, record):
    """The path of a table, with what goes with it."""
    table_of(record).to_csv(tmp_path / "mine.csv", index=False)
    anchor = {
        "std": record.attrs["scale_anchor_std"],
        "value": float(record.attrs["scale_anchor_value"]),
    }
    (tmp_path / "mine.toml").write_text(DESCRIPTION.format(**anchor))
    return tmp_path / "mine.csv"


def change(path, old, new):
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))


def test_a_table_is_read_as_the_record_that_it_was_written_from_with_its_lost_frame(mine, record):
    (found,), scenario = read_own_records([mine])
    for name in ("time", *VARIABLES, *OPTIONAL):
        np.testing.assert_allclose(
            found[name], record[name], rtol=1e-12, atol=1e-15, equal_nan=True
        )
    assert found["measured_ok"].values[5] == 0
    kept = ("robot", "frame_rate_hz", "scale_anchor", "scale_anchor_value", "scale_anchor_std")
    assert {name: found.attrs[name] for name in kept} == {name: record.attrs[name] for name in kept}
    assert scenario.name == "mine"
    assert "seed" not in found.attrs


def test_optional_columns_may_be_left_out(mine, record):
    """Rates come from a spline, within 1e-3 of their range but for the ends; covariances from
    stated deviations.
    """
    table = pd.read_csv(mine)
    optional = ("rate_", "covariance_", "command_time")
    table.drop(columns=[name for name in table if name.startswith(optional)]).to_csv(
        mine, index=False
    )
    with mine.with_suffix(".toml").open("a") as file:
        file.write("position_std_m = 5e-6\norientation_std_rad = 3e-5\n")
    (found,), _ = read_own_records([mine])
    assert "command_time" not in found
    rates, known = found["reference_velocity"].values, record["reference_velocity"].values
    assert np.abs(rates - known)[3:-3].max() < 1e-3 * np.abs(known).max()
    assert np.abs(rates - known).max() < 0.01 * np.abs(known).max()
    std = np.repeat([5e-6, 3e-5], 3)
    np.testing.assert_allclose(
        found["measured_covariance"], np.tile(np.diag(std**2), (len(table), 1, 1))
    )


def test_commands_are_empty_where_the_last_one_was_held(mine):
    """Of a controller with half the rate of the camera: the held ones are not logged again."""
    table = pd.read_csv(mine)
    table.loc[1::2, [name for name in table if name.startswith("command_")]] = np.nan
    table.to_csv(mine, index=False)
    (found,), _ = read_own_records([mine])
    assert np.array_equal(found["command"], table.filter(regex=r"command_\d")[::2])
    assert np.array_equal(found["acting"], table["command_time_s"][::2])


def test_a_second_table_may_be_of_the_robot_under_a_known_load(mine, record):
    """Nothing is measured by a platform's balance then; the load stands with the second record
    alone.
    """
    for path in (mine, mine.with_name("loaded.csv")):
        table_of(record).to_csv(path, index=False)
        text = DESCRIPTION.replace("[record]\nanchor_value = {value!r}\n", "").replace(
            "anchor_std = {std!r}\n", ""
        )
        text = (
            text.replace("platform_mass", "payload")
            + "[payload]\nmass_kg = 5.0\nmass_std_kg = 0.01\n"
        )
        path.with_suffix(".toml").write_text(
            text + "[record]\nunder_payload = true\n" * (path != mine)
        )
    (free, loaded), scenario = read_own_records([mine, mine.with_name("loaded.csv")])
    assert not recorded_payload(free, LAYOUT)[0].any()
    load, errors = recorded_payload(loaded, LAYOUT)
    assert (load[index_of("platform.mass")], errors[index_of("platform.mass"), 0]) == (5.0, 0.01)
    assert load[index_of("platform.Izz")] == scenario.payload.Izz_kg_m2
    assert free.attrs["scale_anchor"] == "payload"


@pytest.mark.thorough
def test_csv_and_netcdf_of_a_run_give_the_same_estimates_in_folders_without_its_truth(
    mine, record, tmp_path, capfd
):
    record.drop_attrs(deep=False).assign_attrs(
        {k: v for k, v in record.attrs.items() if k != "seed"}
    ).to_netcdf(tmp_path / "theirs.nc", engine="h5netcdf")
    settings = ("--set", "identification.max_iterations=1", "--quiet")
    for file, folder in (("mine.csv", "a"), ("theirs.nc", "b")):
        assert (
            command("identify", "--record", tmp_path / file, "--out", tmp_path / folder, *settings)
            == 0
        )
    one, other = (
        load_result(tmp_path / folder / "result.json")["identification"] for folder in "ab"
    )
    for figure in ("estimate", "std", "initial"):
        values = [
            [entry[figure] for entry in found["parameters"].values()] for found in (one, other)
        ]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-6)
    assert all(entry["true"] is None for entry in one["parameters"].values())
    made = {path.name for path in (tmp_path / "a").iterdir()}
    assert made == {"scenario.toml", "experiment.nc", "covariance.nc", "model.nc", "result.json"}
    np.testing.assert_allclose(
        poses(read(tmp_path / "a" / "experiment.nc"), "measured"), poses(record, "measured")
    )
    capfd.readouterr()
    assert command("validate", "--out", tmp_path / "a") == NOT_DONE
    assert "holds a record of your own" in one_line(capfd.readouterr().err)
    assert (
        command(
            "identify",
            "--out",
            tmp_path / "a",
            "--set",
            "identification.method=command_driven",
            *settings,
        )
        == 0
    )
    assert (
        load_result(tmp_path / "a" / "result.json")["settings"]["identification.method"]
        == "command_driven"
    )


def moved(column, factor=1.0, shift=0.0):
    """A table with all columns of a prefix scaled and shifted."""

    def change(table):
        names = [name for name in table if name.startswith(column) and name != "command_time_s"]
        return table.assign(**{name: factor * table[name] + shift for name in names})

    return change


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (
            lambda t: t.rename(columns={"measured_alpha_rad": "measured_alpha_deg"}),
            "use measured_alpha_rad, in ra",
        ),
        (
            lambda t: t.rename(columns={"time_s": "t"}),
            "line 1: unknown column 't'; the columns are time_s, reference_x",
        ),
        (
            lambda t: t.drop(columns="command_3_rad"),
            r"line 1: there is no column command_3_rad .joint command",
        ),
        (lambda t: t.drop(columns="rate_z_m_s"), "line 1: there is no column rate_z_m_s"),
        (
            lambda t: t.assign(time_s=2 * t["time_s"]),
            "line 3: time_s is 0.0333333 after 0 .* 2 frames of 60 Hz",
        ),
        (lambda t: t.iloc[:0], "has no rows below its header"),
        (
            lambda t: t.assign(reference_z_m="a"),
            "line 2: reference_z_m is 'a', which is not a number",
        ),
        (
            lambda t: t.assign(command_1_rad=np.inf),
            "line 2: command_1_rad is inf, must be a finite",
        ),
        (moved("command_", np.nan), "line 2: the command is empty, and no command before it was"),
        (moved("command_1", np.nan), "line 2: the command of joint 1 is empty, and others are not"),
        (
            lambda t: t.assign(measured_x_m=np.inf),
            "line 2: measured_x_m is inf, must be a finite",
        ),
        (
            lambda t: t.rename(columns={"command_time_s": "command_time_ms"}),
            "use command_time_s, in s",
        ),
        (
            lambda t: t.assign(command_time_s=0.0),
            "command_time of frame 1 .* is 0 s; it is before the frame itself",
        ),
        (
            lambda t: t.assign(measured_ok=1),
            "line 7: measured_ok is 1, but a measured column is empty",
        ),
        (lambda t: t.assign(measured_ok=2), "line 2: measured_ok must be 1 or 0"),
        (moved("covariance_z_z", np.nan), "measured_covariance is not finite in 119 frames"),
        (lambda t: t.iloc[:20], "20 frames .0.333 s., at least 120 are needed"),
        (
            moved("measured_alpha", shift=0.02),
            "at t = 0 s after the first pose the measured alpha is 0.0.* does not begin at rest",
        ),
        (
            moved("measured_z", shift=0.1),
            "at t = 0 s after the first pose the measured z is 0.3.* does not begin at rest, or the two poses are in",
        ),
        (
            moved("command_", 180 / np.pi),
            "command of joint . at t = .* s after the first pose is .* in degrees it would fit, and records are in rad",
        ),
        (
            moved("command_1", shift=2.0),
            "command of joint 1 at t = .* zero, direction or unit of the joints differ",
        ),
    ],
)
def test_a_broken_rule_is_one_line_that_names_it_and_leaves_nothing(
    mine, spoil, says, capfd, tmp_path
):
    spoil(pd.read_csv(mine)).to_csv(mine, index=False)
    assert command("identify", "--record", mine, "--out", tmp_path / "new", "--quiet") == NOT_DONE
    assert re.search(says, one_line(capfd.readouterr().err))
    assert not (tmp_path / "new").exists()


def in_units(position, angle):
    """A record whose poses and rates are in other units."""

    def scaled(record):
        factors = {"reference_velocity": position, "reference_orientation_rate": angle}
        factors |= {f"{kind}_position": position for kind in ("reference", "measured")}
        factors |= {f"{kind}_orientation": angle for kind in ("reference", "measured")}
        return with_values(
            record, **{name: factor * record[name].values for name, factor in factors.items()}
        )

    return scaled


def late(record):
    """A record of a robot that already moves."""
    begun = record.isel(time=slice(12, None))
    return begun.assign_coords(time=begun["time"] - begun["time"][0])


def zeros(record):
    """A record with a lost frame that is stored as zeros, which counts as measured."""
    kinds = ("measured_position", "measured_orientation")
    changed = {name: record[name].values.copy() for name in kinds}
    for values in changed.values():
        values[40] = 0.0
    return with_values(record, **changed)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (
            in_units(1e3, 1.0),
            r"leg 1 cannot reach the reference .* in mm it would fit, and records are in m and rad",
        ),
        (in_units(1.0, 180 / np.pi), r"cannot reach the reference .* in degrees it would fit"),
        (
            in_units(1e3, 180 / np.pi),
            r"cannot reach the reference .* in mm and degrees it would fit",
        ),
        (
            zeros,
            r"at t = 0.6666667 s after the first pose the measured z is 0 .* which needs measured_ok = 0",
        ),
        (
            late,
            r"does not begin at rest: the rate of \w+ in its first frame is .* % of its largest; begin the record",
        ),
    ],
)
def test_units_and_a_start_in_motion_are_told_of_any_record(record, spoil, says):
    with pytest.raises(EstimationError, match=says):
        identified_model(spoil(record), side_of(quick(**{"excitation.fundamental_hz": 0.4})))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('robot = "rss6"', 'robot = "none"', "unknown robot `none`"),
        (
            "anchor_value",
            "anchor_values",
            r"\[record\] unknown key 'anchor_values'; valid names: anchor_value, ",
        ),
        (
            "frame_rate_hz = 60.0",
            "frame_rate = 60.0",
            "unknown key 'timing.frame_rate'; valid names in ",
        ),
        ("frame_rate_hz = 60.0", "frame_rate_hz = 50.0", "1.2|0.8333 frames of 50 Hz"),
        (
            "anchor_std",
            "start_std",
            "needs the measured value, anchor_value in .record., and its standard deviation, anchor_std",
        ),
        ("[timing]", "[timing", "is not valid TOML"),
    ],
)
def test_what_goes_with_a_table_is_checked_and_named(mine, old, new, says, capfd):
    change(mine.with_suffix(".toml"), old, new)
    assert command("identify", "--record", mine, "--out", "never", "--quiet") == NOT_DONE
    assert re.search(says, one_line(capfd.readouterr().err))
    mine.with_suffix(".toml").unlink()
    assert command("identify", "--record", mine, "--out", "never", "--quiet") == NOT_DONE
    assert "cmmsim new record writes both" in one_line(capfd.readouterr().err)


def test_a_log_with_too_many_gross_errors_is_refused_with_a_picture(
    mine, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    table = pd.read_csv(mine)
    table.loc[7::9, "measured_x_m"] += 5e-3
    table.to_csv(mine, index=False)
    assert command("identify", "--record", mine, "--out", "out", "--quiet") == NOT_DONE
    said = one_line(capfd.readouterr().err)
    assert "of 119 poses are far from the motion of their neighbours, at t = 0.117, " in said
    assert "; out-gross-errors.png shows them" in said
    assert (tmp_path / "out-gross-errors.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "out").exists()
