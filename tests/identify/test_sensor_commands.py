"""``cmmsim calibrate`` reads back the pictures that it rendered; ``detectors`` writes what the
leaderboard gives.
"""

import csv
import json
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import cmmsim
from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.detection.tags import REFINEMENTS
from cmmsim.detector_leaderboard import Condition, compete, scene_of, working_point
from cmmsim.files.sensor_file import read_sensor_file
from tests.identify.commands import command, one_line

SENSOR = (Path(cmmsim.__file__).parent / "files" / "sensors" / "ctrack780.toml").read_text(
    encoding="utf-8"
)
SMALLER = SENSOR.replace("2048", "640").replace("1536", "480").replace("2300.0", "720.0")
FILES = {
    "small": 'renderer = "analytic"\n' + SMALLER.replace('name = "ctrack780"\n', ""),
    "slow": 'based_on = "small.toml"\n[timing]\nframe_rate = 29.0\n[rig]\nbaseline = 1.0\n',
    "narrow": 'based_on = "small.toml"\n[rig]\nbaseline = 0.4\n',
    "board": 'kind = "dots"\ncolumns = 7\nrows = 6\nspacing = 0.07\nradius = 0.0175\n',
}


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrate")
    for name, text in FILES.items():
        (folder / f"{name}.toml").write_text(
            text if name == "board" else f'name = "{name}"\n{text}'
        )
    assert command("calibrate", *rendering(folder, 8), "--out", folder / "pictures", "--quiet") == 0
    return folder


def arguments(folder):
    made = folder / "pictures"
    return made / "left", made / "right", "--board", made / "board.toml"


def rendering(folder, pairs=1):
    return "--render", pairs, "--sensor", folder / "small.toml", "--board", folder / "board.toml"


@pytest.mark.slow
def test_command_calibrates_what_it_rendered_into_a_sensor_file_found_from_where_it_is_written(
    pictures, tmp_path, capfd
):
    """The sensor file is based on another one beside it."""
    out = tmp_path / "deeper" / "new"
    assert (
        command("calibrate", *arguments(pictures), "--sensor", pictures / "slow.toml", "--out", out)
        == 0
    )
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
    assert rig["left"]["focal_px"] == [
        found["left.fx_px"]["estimate"],
        found["left.fy_px"]["estimate"],
    ]
    assert tomllib.loads((out / "sensor.toml").read_text())["timing"] == {"frame_rate": 29.0}
    calibrated = cmmsim.load_sensor(out / "sensor.toml").rig
    assert calibrated.left.focal_px == found["left.fx_px"]["estimate"]
    assert calibrated.right_from_left[0, 3] == pytest.approx(
        found["right_from_left.tx_m"]["estimate"], abs=1e-12
    )
    np.testing.assert_allclose(calibrated.right_from_left, truth.right_from_left, atol=1e-3)
    for name in ("residuals", "coverage", "distortion"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_options_reach_a_calibration_whose_cameras_no_sensor_can_have(pictures, tmp_path, capfd):
    """The folders are given the wrong way round, and the baseline of the sensor file is another."""
    left, right, *rest = arguments(pictures)
    options = (
        "--sensor",
        pictures / "narrow.toml",
        "--distortion",
        "none",
        "--fix-aspect",
        "--quiet",
    )
    assert command("calibrate", right, left, *rest, *options, "--out", tmp_path / "new") == 1
    *lines, last = capfd.readouterr().err.splitlines()
    assert all(line.startswith("warning: ") for line in lines)
    said = "\n".join(lines)
    assert "swap the folders LEFT and RIGHT" in said
    assert "the calibrated cameras stand 1 m apart, but" in said
    assert last.startswith(
        "error: sensor.toml is not written: no sensor can have these cameras: rig.right_from_left"
    )
    names = ["calibration.json", "coverage.png", "distortion.png", "residuals.png", "rig.toml"]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == names
    result = json.loads((tmp_path / "new" / "calibration.json").read_text())
    assert result["options"] == {"distortion": "none", "fix_aspect": True}
    fixed = [
        name
        for name, p in result["parameters"].items()
        if not p["free"] and name.startswith("left")
    ]
    assert fixed == ["left.k1", "left.k2", "left.p1", "left.p2", "left.k3"]


def test_rendering_again_gives_the_same_complete_set(pictures, tmp_path):
    sets = []
    for out in ("a", "b"):
        assert (
            command(
                "calibrate", *rendering(pictures), "--quiet", "--seed", 5, "--out", tmp_path / out
            )
            == 0
        )
        files = (path for path in (tmp_path / out).rglob("*") if path.is_file())
        sets.append({str(path.relative_to(tmp_path / out)): path.read_bytes() for path in files})
    assert sets[0] == sets[1]
    assert sets[0].keys() == {"board.toml", "left/000.png", "right/000.png"}


def test_pictures_of_another_size_and_too_few_of_the_board_are_one_line_and_leave_nothing(
    pictures, monkeypatch, capfd, tmp_path
):
    """The size is refused before the board is looked for, which takes minutes."""
    few = (
        "both cameras see the board in 0 of 8 pairs, but 9 are needed; pairs without it: 000.png (both: "
        "nothing found)"
    )
    for options, find, said in (
        (
            ("--sensor", "ctrack780"),
            pytest.fail,
            "640 x 480 px, but the sensor file ctrack780 states 2048 x 1536 px",
        ),
        (("--min-images", 9), lambda *_: "nothing found", few),
    ):
        monkeypatch.setattr("cmmsim.calibration.sightings.find_board", find)
        assert (
            command(
                "calibrate", *arguments(pictures), *options, "--out", tmp_path / "new", "--quiet"
            )
            == 1
        )
        assert said in one_line(capfd.readouterr().err)
        assert list(tmp_path.iterdir()) == []


def test_stopped_rendering_leaves_a_folder_empty_or_none(pictures, tmp_path, monkeypatch, capfd):
    encode = cv2.imencode
    pictures_encoded = []

    def stopped(suffix, image):
        if len(pictures_encoded) % 2:
            pictures_encoded.clear()
            raise KeyboardInterrupt
        pictures_encoded.append(suffix)
        return encode(suffix, image)

    monkeypatch.setattr(cv2, "imencode", stopped)
    (tmp_path / "there").mkdir()
    for out in ("there", "new"):
        assert command("calibrate", *rendering(pictures), "--out", tmp_path / out) == 130
        assert capfd.readouterr().err.endswith("aborted\n")
    assert list(tmp_path.rglob("*")) == [tmp_path / "there"]


def test_detectors_leaves_the_scores_of_the_leaderboard_in_files_a_table_and_a_figure(
    tmp_path, capsys
):
    folder = tmp_path / "detectors"
    options = (
        "--radius",
        3,
        "--noise",
        1,
        "--noise",
        5,
        "--tilt",
        30,
        "--psf",
        0,
        "--draws",
        30,
        "--seed",
        2,
    )
    assert command("detectors", *options, "--out", folder) == 0
    shown = capsys.readouterr().out
    file = read_sensor_file("ctrack780")
    conditions = [
        working_point(file),
        *(Condition(3.0, np.radians(30.0), noise) for noise in (0.01, 0.05)),
    ]
    scores = compete(scene_of(file), conditions, 30, np.random.default_rng(2))
    written = json.loads((folder / "detectors.json").read_text())
    with (folder / "detectors.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert (written["sensor"], written["seed"], written["draws"]) == ("ctrack780", 2, 30)
    assert len(scores) == len(rows) == len(written["scores"]) == 15
    for score, row, entry in zip(scores, rows, written["scores"], strict=True):
        assert score.detector == row["detector"] == entry["detector"]
        for name in ("bound_px", "rms_px", "ratio", "ratio_low", "ratio_high", "bias_px", "lost"):
            assert getattr(score, name) == pytest.approx(float(row[name]), rel=1e-12)
            assert getattr(score, name) == pytest.approx(entry[name], rel=1e-12)
        assert float(row["noise_percent"]) == pytest.approx(
            100.0 * score.condition.noise, rel=1e-12
        )
        assert float(row["tilt_deg"]) == pytest.approx(np.degrees(score.condition.tilt), rel=1e-12)
    assert written["working_point"]["radius_px"] == conditions[0].radius_px
    for figure in (scores[0].bound_px, *(score.rms_px for score in scores)):
        assert f"{figure:.5f}" in shown
    assert (
        f"{DEFAULT_DETECTOR}: {scores[0].ratio:.3f} times the bound at the working point" in shown
    )
    assert (folder / "detectors.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(f.name for f in folder.iterdir()) == [
        "detectors.csv",
        "detectors.json",
        "detectors.png",
    ]


@pytest.mark.slow
def test_detectors_compares_tags_in_a_table_of_their_own(pictures, tmp_path, capsys):
    folder = tmp_path / "detectors"
    options = ("--radius", 3, "--noise", 1, "--draws", 10, "--tags", "4x4_50", "--tag-poses", 2)
    assert command("detectors", pictures / "small.toml", *options, "--out", folder) == 0
    assert "stickers and tags at 2 poses" in capsys.readouterr().out
    written = json.loads((folder / "detectors.json").read_text())["tags"]
    with (folder / "tags.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    marks = [("stickers", DEFAULT_DETECTOR), *(("4x4_50", method) for method in REFINEMENTS)]
    assert [(row["marks"], row["method"]) for row in rows] == marks
    assert [(entry["marks"], entry["method"]) for entry in written] == marks
    subpix = written[2]
    assert subpix["points"] == 12.0
    assert subpix["lost"] == 0.0
    assert float(rows[2]["bias_px"]) == pytest.approx(subpix["bias_px"], rel=1e-12)
