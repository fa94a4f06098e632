"""``cmmsim calibrate``: pictures rendered by the command are read back by it; what cannot be done is one line."""

import json
import tomllib
from importlib import resources

import cv2
import numpy as np
import pytest

import cmmsim
from tests.identify.commands import command, one_line

SENSOR = resources.files("cmmsim").joinpath("files", "sensors", "ctrack780.toml").read_text(encoding="utf-8")
SMALLER = {"2048": "640", "1536": "480", "2300.0": "720.0", '"ctrack780"': '"small"'}
SLOW = 'name = "slow"\nbased_on = "small.toml"\n[timing]\nframe_rate = 29.0\n[rig]\nbaseline = 1.0\n'
BOARD = 'kind = "dots"\ncolumns = 7\nrows = 6\nspacing = 0.07\nradius = 0.0175\n'


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrate")
    small = 'renderer = "analytic"\n' + SENSOR
    for old, new in SMALLER.items():
        small = small.replace(f" = {old}", f" = {new}")
    (folder / "small.toml").write_text(small)
    (folder / "slow.toml").write_text(SLOW)
    (folder / "board.toml").write_text(BOARD)
    assert command("calibrate", *rendering(folder, 8), "--out", folder / "pictures", "--quiet") == 0
    return folder


def arguments(folder):
    made = folder / "pictures"
    return made / "left", made / "right", "--board", made / "board.toml"


def rendering(folder, pairs=1):
    return "--render", pairs, "--sensor", folder / "small.toml", "--board", folder / "board.toml"


def test_command_calibrates_what_it_rendered_into_a_sensor_file_found_from_where_it_is_written(
    pictures, tmp_path, capfd
):
    """The sensor file is based on another one beside it."""
    out = tmp_path / "deeper" / "new"
    assert command("calibrate", *arguments(pictures), "--sensor", pictures / "slow.toml", "--out", out) == 0
    said = capfd.readouterr()
    assert "8 pairs" in said.out
    assert "right_from_left.tx_m" in said.out
    assert "find the board: 8 of 8" in said.err
    result = json.loads((out / "calibration.json").read_text())
    assert result["opencv"] == cv2.__version__
    assert [view["name"] for view in result["used"]] == [f"{k:03d}.png" for k in range(8)]
    truth = cmmsim.load_sensor(pictures / "small.toml").rig
    found = result["parameters"]
    for name, value in (
        ("left.fx_px", 720.0),
        ("right.fy_px", 720.0),
        ("left.cx_px", 319.5),
        ("right.k1", 0.0),
        ("right_from_left.tx_m", truth.right_from_left[0, 3]),
    ):
        assert abs(found[name]["estimate"] - value) < 4.0 * found[name]["std"], name
    stated = np.sqrt(np.diag(result["covariance"]["matrix"]))
    np.testing.assert_allclose(stated, [p["std"] for p in found.values()])
    rig = tomllib.loads((out / "rig.toml").read_text())["rig"]
    assert rig["left"]["focal_px"] == [found["left.fx_px"]["estimate"], found["left.fy_px"]["estimate"]]
    assert tomllib.loads((out / "sensor.toml").read_text())["timing"] == {"frame_rate": 29.0}
    calibrated = cmmsim.load_sensor(out / "sensor.toml").rig
    assert calibrated.left.focal_px == found["left.fx_px"]["estimate"]
    assert calibrated.right_from_left[0, 3] == pytest.approx(found["right_from_left.tx_m"]["estimate"], abs=1e-12)
    np.testing.assert_allclose(calibrated.right_from_left, truth.right_from_left, atol=1e-3)
    for name in ("residuals", "coverage", "distortion"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_options_reach_a_calibration_whose_cameras_no_sensor_can_have(pictures, tmp_path, capfd):
    """The folders are given the wrong way round, and the baseline of the sensor file is another."""
    left, right, *rest = arguments(pictures)
    text = (pictures / "small.toml").read_text().replace("baseline = 1.0", "baseline = 0.4")
    (tmp_path / "other.toml").write_text(text)
    options = ("--sensor", tmp_path / "other.toml", "--distortion", "none", "--fix-aspect", "--quiet")
    assert command("calibrate", right, left, *rest, *options, "--out", tmp_path / "new") == 0
    lines = capfd.readouterr().err.splitlines()
    assert all(line.startswith("warning: ") for line in lines)
    said = "\n".join(lines)
    assert "swap the folders LEFT and RIGHT" in said
    assert "the cameras stand 1 m apart, those of the sensor file" in said
    assert "sensor.toml is not written, no sensor can have these cameras: rig.right_from_left" in said
    names = ["calibration.json", "coverage.png", "distortion.png", "residuals.png", "rig.toml"]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == names
    result = json.loads((tmp_path / "new" / "calibration.json").read_text())
    assert result["options"] == {"distortion": "none", "fix_aspect": True}
    fixed = [name for name, p in result["parameters"].items() if not p["free"] and name.startswith("left")]
    assert fixed == ["left.k1", "left.k2", "left.p1", "left.p2", "left.k3"]


def test_rendering_again_gives_the_same_complete_set(pictures, tmp_path):
    made = pictures / "pictures"
    for out in ("a", "b"):
        assert command("calibrate", *rendering(pictures), "--quiet", "--seed", 5, "--out", tmp_path / out) == 0
    assert sorted(path.name for path in made.iterdir()) == ["board.toml", "left", "right"]
    for side in ("left", "right"):
        assert sorted(path.name for path in (made / side).iterdir()) == [f"{k:03d}.png" for k in range(8)]
        assert len({(tmp_path / out / side / "000.png").read_bytes() for out in "ab"}) == 1


@pytest.mark.parametrize(
    ("change", "evidence"),
    [
        (lambda a: [a[0]], "missing RIGHT, --board FILE; cmmsim calibrate --help shows examples"),
        (lambda a: ["nowhere", *a[1:]], "no folder nowhere"),
        (lambda a: [*a, "--distortion", "fisheye"], "unknown distortion 'fisheye': valid are brown5, none, radial2"),
        (lambda a: [*a, "--sensor", "ctrack"], "unknown sensor 'ctrack'"),
        (lambda a: [*a, "--sensor", "ctrack780"], "640 x 480 px, those of the sensor file ctrack780 2048 x 1536"),
        (lambda a: [*a, "--render", "3"], "leave out LEFT and RIGHT"),
        (
            lambda _: ["--render", "1", "--distortion", "none", "--min-images", "7", "--fix-aspect"],
            "calibrates nothing: leave out --distortion and --fix-aspect and --min-images",
        ),
        (lambda a: [*a, "--seed", "0"], "no random numbers without --render: leave out --seed"),
        (lambda a: ["--render", "3", "--board", "none.toml"], "cannot read board file none.toml"),
    ],
)
def test_what_cannot_be_done_is_one_line_before_the_board_is_looked_for(
    pictures, monkeypatch, capfd, tmp_path, change, evidence
):
    monkeypatch.setattr("cmmsim.calibration.sightings.find_board", lambda *_: pytest.fail("searched"))
    monkeypatch.chdir(tmp_path)
    assert command("calibrate", *change(list(arguments(pictures))), "--out", "new", "--quiet") == 1
    assert evidence in one_line(capfd.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_too_few_pairs_are_one_line_and_leave_nothing(pictures, monkeypatch, capfd, tmp_path):
    monkeypatch.setattr("cmmsim.calibration.sightings.find_board", lambda *_: "nothing found")
    options = ("--min-images", 9, "--out", tmp_path / "new", "--quiet")
    assert command("calibrate", *arguments(pictures), *options) == 1
    said = one_line(capfd.readouterr().err)
    assert "0 of 8 pairs show the board to both cameras, 9 needed; without it: 000.png (both: nothing found)" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("there", [True, False])
def test_stopped_rendering_leaves_nothing(pictures, tmp_path, monkeypatch, capfd, there):
    written = []

    def stopped(path, image):
        written.append(path)
        if len(written) == 2:
            raise KeyboardInterrupt
        return True

    out = tmp_path / "new"
    if there:
        out.mkdir()
    monkeypatch.setattr(cv2, "imwrite", stopped)
    assert command("calibrate", *rendering(pictures), "--out", out) == 130
    assert capfd.readouterr().err.endswith("aborted\n")
    assert list(tmp_path.iterdir()) == ([out] if there else [])
    assert not there or not list(out.iterdir())
