"""The command ``cmmsim detectors``: its files hold what the leaderboard gives, and bad input is one line."""

import csv
import json

import numpy as np
import pytest

from cmmsim.detector_leaderboard import Condition, compete, scene_of, working_point
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.plugins import DEFAULT_DETECTOR
from tests.identify.commands import command, one_line

OPTIONS = ["--radius", "3", "--noise", "1", "--noise", "5", "--tilt", "30", "--psf", "0", "--draws", "30"]


def test_files_and_table_hold_the_scores_of_the_leaderboard_and_a_figure_is_drawn(tmp_path, capsys):
    folder = tmp_path / "detectors"
    assert command("detectors", *OPTIONS, "--seed", 2, "--out", folder) == 0
    shown = capsys.readouterr().out
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
    for figure in (scores[0].bound_px, *(score.rms_px for score in scores)):
        assert f"{figure:.5f}" in shown
    assert f"{DEFAULT_DETECTOR}: {scores[0].ratio:.3f} times the bound at the working point" in shown
    assert (folder / "detectors.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(f.name for f in folder.iterdir()) == ["detectors.csv", "detectors.json", "detectors.png"]


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--radius", 0.2, "radius 0.2 px, tilt 0 degrees, noise 0.2 % of the contrast"),
        ("--tilt", 85, "80 degrees"),
        ("--psf", 0.05, "psf 0.05 px"),
    ],
)
def test_bad_conditions_are_refused_before_anything_is_written(option, value, message, tmp_path, capsys):
    assert command("detectors", option, value, "--draws", 2, "--quiet", "--out", tmp_path / "out") == 1
    assert message in one_line(capsys.readouterr().err)
    assert not (tmp_path / "out").exists()
