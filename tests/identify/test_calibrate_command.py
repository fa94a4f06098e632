"""``cmmsim calibrate``: pictures rendered by the command are read back by it; what cannot be done is one line."""

import json
import tomllib
from importlib import resources

import cv2
import numpy as np
import pytest

import cmmsim
from tests.identify.commands import command

SENSOR = (resources.files("cmmsim").joinpath("sensors", "ctrack780.toml").read_text(encoding="utf-8")
          .replace("width = 2048", "width = 640").replace("height = 1536", "height = 480")
          .replace("focal_px = 2300.0", "focal_px = 720.0").replace('name = "ctrack780"', 'name = "small"')
          .replace('renderer = "auto"', ""))
BOARD = 'kind = "dots"\ncolumns = 7\nrows = 6\nspacing = 0.07\nradius = 0.0175\n'


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrate")
    (folder / "small.toml").write_text("renderer = \"analytic\"\n" + SENSOR)
    (folder / "board.toml").write_text(BOARD)
    options = ("--sensor", folder / "small.toml", "--board", folder / "board.toml", "--out", folder / "pictures")
    assert command("calibrate", "--render", 8, *options, "--quiet") == 0
    return folder


def arguments(folder):
    made = folder / "pictures"
    return made / "left", made / "right", "--board", made / "board.toml"


def test_command_calibrates_what_it_rendered(pictures, tmp_path, capfd):
    out = tmp_path / "new"
    assert command("calibrate", *arguments(pictures), "--sensor", pictures / "small.toml", "--out", out) == 0
    said = capfd.readouterr()
    assert "8 pairs" in said.out
    assert "right_from_left.tx_m" in said.out
    assert "find the board: 8 of 8" in said.err
    result = json.loads((out / "calibration.json").read_text())
    assert result["opencv"] == cv2.__version__
    assert [view["name"] for view in result["used"]] == [f"{k:03d}.png" for k in range(8)]
    truth = cmmsim.load_sensor(pictures / "small.toml").rig
    found = result["parameters"]
    for name, value in (("left.fx_px", 720.0), ("right.fy_px", 720.0), ("left.cx_px", 319.5), ("right.k1", 0.0),
                        ("right_from_left.tx_m", truth.right_from_left[0, 3])):
        assert abs(found[name]["estimate"] - value) < 4.0 * found[name]["std"], name
    covariance = np.array(result["covariance"]["matrix"])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [p["std"] for p in found.values()])
    rig = tomllib.loads((out / "rig.toml").read_text())["rig"]
    assert rig["left"]["focal_px"] == [found["left.fx_px"]["estimate"], found["left.fy_px"]["estimate"]]
    calibrated = cmmsim.load_sensor(out / "sensor.toml").rig
    np.testing.assert_allclose(calibrated.right_from_left, truth.right_from_left, atol=1e-3)
    for name in ("residuals", "coverage", "distortion"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_options_reach_the_calibration(pictures, tmp_path):
    options = ("--distortion", "none", "--fix-aspect", "--out", tmp_path / "new", "--quiet")
    assert command("calibrate", *arguments(pictures), *options) == 0
    result = json.loads((tmp_path / "new" / "calibration.json").read_text())
    assert result["options"] == {"distortion": "none", "fix_aspect": True}
    assert [n for n, p in result["parameters"].items() if not p["free"] and n.startswith("left")] == [
        "left.k1", "left.k2", "left.p1", "left.p2", "left.k3"]
    assert not (tmp_path / "new" / "sensor.toml").exists()


def test_rendering_again_gives_the_same_pictures(pictures, tmp_path):
    options = ("--sensor", pictures / "small.toml", "--board", pictures / "board.toml", "--quiet")
    assert command("calibrate", "--render", 1, *options, "--seed", 5, "--out", tmp_path / "a") == 0
    assert command("calibrate", "--render", 1, *options, "--seed", 5, "--out", tmp_path / "b") == 0
    for side in ("left", "right"):
        first, second = ((tmp_path / k / side / "000.png").read_bytes() for k in "ab")
        assert first == second


@pytest.mark.parametrize(("change", "evidence"), [
    (lambda a: [a[0]], "missing RIGHT, --board FILE; cmmsim calibrate --help shows examples"),
    (lambda a: ["nowhere", *a[1:]], "no folder nowhere"),
    (lambda a: [*a[:3], "none.toml"], "cannot read board file none.toml"),
    (lambda a: [*a, "--distortion", "fisheye"], "unknown distortion 'fisheye': valid are brown5, none, radial2"),
    (lambda a: [*a, "--sensor", "ctrack"], "unknown sensor 'ctrack'"),
    (lambda a: [*a, "--min-images", "9"], "8 of 8 pairs show the board to both cameras, 9 needed"),
    (lambda a: [*a, "--sensor", "ctrack780"], "images are 640 x 480 px, those of the sensor file 2048 x 1536"),
    (lambda a: [*a, "--render", "3"], "leave out LEFT and RIGHT"),
    (lambda a: ["--render", "3", "--board", "none.toml"], "cannot read board file none.toml"),
])
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(pictures, monkeypatch, capfd, tmp_path, change, evidence):
    monkeypatch.chdir(tmp_path)
    assert command("calibrate", *change(list(arguments(pictures))), "--out", "new", "--quiet") == 1
    said = capfd.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert evidence in said
    assert list(tmp_path.iterdir()) == []


def test_help_teaches_the_board_file(capfd):
    assert command("calibrate", "--help") == 0
    said = capfd.readouterr().out
    assert "asymmetric_dots" in said
    assert "--render 20" in said
