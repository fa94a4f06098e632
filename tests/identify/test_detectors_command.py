"""The command ``cmmsim detectors``: its files hold what the leaderboard gives, and bad input is one line."""

import csv
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from cmmsim.detector_leaderboard import Condition, compete, scene_of, working_point
from cmmsim.errors import CmmError
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.plugins import DEFAULT_DETECTOR
from identify.commands.app import app, is_known

OPTIONS = ["--radius", "3", "--noise", "1", "--noise", "5", "--tilt", "30", "--psf", "0", "--draws", "30"]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("out") / "detectors"
    arguments = ["detectors", *OPTIONS, "--seed", "2", "--out", str(folder)]
    return CliRunner().invoke(app, arguments, catch_exceptions=False), folder


def test_files_hold_the_scores_of_the_leaderboard(done):
    result, folder = done
    assert result.exit_code == 0, result.output
    file = read_sensor_file("ctrack780")
    conditions = [working_point(file), *(Condition(3.0, np.radians(30.0), noise) for noise in (0.01, 0.05))]
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
        assert float(row["noise_percent"]) == pytest.approx(100.0 * score.condition.noise, rel=1e-12)
        assert float(row["tilt_deg"]) == pytest.approx(np.degrees(score.condition.tilt), rel=1e-12)
    assert written["working_point"]["radius_px"] == conditions[0].radius_px


def test_table_shows_bound_and_errors_and_a_figure_is_drawn(done):
    result, folder = done
    scores = json.loads((folder / "detectors.json").read_text())["scores"]
    for figure in (scores[0]["bound_px"], *(score["rms_px"] for score in scores)):
        assert f"{figure:.5f}" in result.output
    assert f"{DEFAULT_DETECTOR}: {scores[0]['ratio']:.3f} times the bound at the working point" in result.output
    assert (folder / "detectors.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(f.name for f in folder.iterdir()) == ["detectors.csv", "detectors.json", "detectors.png"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--radius", "0.2"], r"radius 0\.2 px, tilt 0 degrees, noise 0\.2 % of the contrast"),
        (["--radius", "500"], "radius 500 px is more than 50 px"),
        (["--tilt", "85"], "80 degrees"),
        (["--noise", "0.1"], "less than that of rounding"),
        (["--psf", "0.05"], r"psf 0\.05 px .* at least 0\.1 px"),
    ],
)
def test_bad_conditions_are_refused_before_anything_is_written(options, message, tmp_path):
    result = CliRunner().invoke(app, ["detectors", *options, "--draws", "2", "--quiet", "--out", str(tmp_path / "out")])
    with pytest.raises(CmmError, match=message):
        raise result.exception
    assert is_known(result.exception)
    assert not (tmp_path / "out").exists()
