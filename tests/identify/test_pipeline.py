"""Whole runs through the command line: every figure of the project's goals, from rendered images to the report."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from identify.files.run_folder import load_result
from identify.record.recording import read, read_runs
from identify.reporting.goals import check_goals
from identify.scenario import load_scenario

pytestmark = [pytest.mark.slow, pytest.mark.rendering]

FILES = {
    "scenario.toml",
    "trajectories.json",
    "experiment.nc",
    "covariance.nc",
    "result.json",
    "validation.nc",
    "model.nc",
    "report.html",
    "figures",
}


def cmmsim(*arguments, **environment):
    """Run the command line in a process of its own."""
    command = [sys.executable, "-m", "identify", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment}, check=False)


@pytest.fixture(scope="module", params=["quick", "paper"])
def run(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param) / "run"
    done = cmmsim("run", request.param, "--out", folder)
    assert done.returncode == 0, done.stderr
    return request.param, folder, load_result(folder / "result.json")


def test_every_goal_is_met(run):
    _, _, result = run
    missed = [goal for goal in check_goals(result) if not goal.passed]
    assert len(check_goals(result)) >= 6
    assert missed == []


def test_the_identified_model_is_at_least_twenty_times_closer_than_the_starting_one(run):
    _, _, result = run
    for unseen in result["validation"]:
        before = unseen["initial_true"]["position_rms_um"] + unseen["initial_true"]["orientation_rms_urad"]
        after = unseen["true"]["position_rms_um"] + unseen["true"]["orientation_rms_urad"]
        assert all(b > 20 * a for a, b in zip(after, before, strict=True)), (before, after)


def test_the_result_has_every_entry_of_the_contract(run):
    name, folder, result = run
    assert {path.name for path in folder.iterdir()} == FILES
    assert result["scenario"] == name
    assert result["seed"] == 0
    assert {"excite", "record", "identify", "validate", "report", "total"} <= set(result["seconds"])
    assert set(result["sensor"]) >= {
        "frames",
        "lost_frames",
        "stereo_frames_per_second",
        "position_rms_um",
        "orientation_rms_urad",
    }
    identification = result["identification"]
    assert identification["scale_anchor"] == "platform_mass"
    assert len(identification["parameters"]) == 67
    assert identification["base_rank"] > 30
    assert "eq. 35" in identification["stop_reason"]
    for entry in identification["parameters"].values():
        assert set(entry) >= {"initial", "true", "estimate", "std", "identifiable"}
        assert all(entry[key] is not None for key in ("initial", "true", "estimate", "std"))
    for key in ("before", "after"):
        assert len(result[key]["position_rms_um"]) == 3
    count = {"quick": 2, "paper": 10}[name]
    assert len(result["validation"]) == count
    assert len(read_runs(folder / "validation.nc")) == count
    assert read(folder / "experiment.nc").sizes["time"] == {"quick": 600, "paper": 1200}[name]


def test_a_stage_can_be_repeated_and_gives_the_same_numbers(run):
    name, folder, result = run
    if name == "paper":
        pytest.skip("shown on the scenario quick")
    done = cmmsim("identify", "--out", folder, "--quiet")
    assert done.returncode == 0, done.stderr
    again = load_result(folder / "result.json")
    for parameter, entry in result["identification"]["parameters"].items():
        assert again["identification"]["parameters"][parameter]["estimate"] == entry["estimate"]


@pytest.fixture
def no_opengl(tmp_path):
    """A folder for PYTHONPATH where OpenGL cannot be loaded."""
    broken = tmp_path / "without" / "OpenGL"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise ImportError('no EGL here')\n")
    return str(broken.parent)


def test_without_opengl_the_analytic_renderer_draws_and_one_line_says_so(no_opengl, tmp_path):
    done = cmmsim("excite", "quick", "--out", tmp_path / "out", "--quiet", PYTHONPATH=no_opengl)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("warning")]
    assert lines == ["warning: images are drawn by the analytic renderer, pyrender found no OpenGL: no EGL here"]
    assert load_scenario(str(tmp_path / "out" / "scenario.toml")).renderer == "analytic"


def test_pyrender_without_opengl_stops_with_one_line_and_leaves_nothing(no_opengl, tmp_path):
    arguments = ("run", "quick", "--set", "renderer=pyrender", "--out", tmp_path / "out")
    done = cmmsim(*arguments, PYTHONPATH=no_opengl)
    assert done.returncode != 0
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    assert "libegl1" in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "papper"], ["papper", "paper", "quick"]),
        (["run", "quick", "--set", "robot=rss7"], ["rss7", "rss6"]),
        (["run", "quick", "--set", "sensor=ctrack79"], ["ctrack79", "ctrack780"]),
        (["run", "quick", "--set", "timing.frame_rate=60"], ["frame_rate", "frame_rate_hz"]),
        (["run", "quick", "--set", "filter.cutoff_hz=30"], ["30 Hz", "60 Hz"]),
        (["run", "quick", "--set", "timing.frame_rate_hz='60 Hz'"], ["frame_rate_hz", "Hz"]),
        (["run", "quick", "--set", "excitation.position_amplitude_m=0.2"], ["leg"]),
        (["run", "quick", "--set", "excitation.travel_margin_rad=0.8"], ["crank", "0.1948", "0.9948"]),
        (["run", "quick", "--set", "plant.parameters=nobody"], ["nobody", "identified", "initial"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(arguments, words, tmp_path):
    done = cmmsim(*arguments, "--out", tmp_path / "out")
    assert done.returncode != 0
    lines = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith("compile")]
    assert len(lines) == 1, done.stderr
    assert all(word in lines[0] for word in words), lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("pose_method=plane", ["plane", "planes", "registration"]),
        ("timing.hold=first", ["first", "zero", "linear"]),
        ("plant.friction=coulomb", ["coulomb", "coulomb_viscous", "smoothed"]),
        ("identification.scale_anchor=nothing", ["nothing", "platform_mass"]),
        ("excitation.duration_s=0.333", ["0.333", "frames"]),
    ],
)
def test_wrong_choices_name_the_valid_ones(setting, words, tmp_path):
    done = cmmsim("excite", "quick", "--set", setting, "--out", tmp_path / "out")
    assert done.returncode != 0
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert all(word in done.stderr for word in words), done.stderr


def test_a_plant_that_the_model_cannot_be_is_said_and_judged(tmp_path):
    """Joints off by 0.1 mm: the run does its work, warns even where it is quiet, and misses the goal of white
    residuals."""
    choices = ("renderer=analytic", "plant.geometry_error_m=1e-4", "validation.count=1", "validation.duration_s=2")
    settings = [word for choice in choices for word in ("--set", choice)]
    done = cmmsim("run", "quick", "--out", tmp_path / "run", "--quiet", *settings)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    warnings = done.stderr.splitlines()
    assert all(line.startswith("warning: ") for line in warnings), done.stderr
    assert any("are not white" in line for line in warnings), done.stderr
    result = load_result(tmp_path / "run" / "result.json")
    assert "white residuals" in [goal.name for goal in check_goals(result) if not goal.passed]
    told = cmmsim("report", "--out", tmp_path / "run")
    assert "missed: white residuals" in told.stdout


def test_an_existing_folder_is_refused_and_untouched(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    done = cmmsim("run", "quick", "--out", tmp_path)
    assert done.returncode != 0
    assert str(tmp_path) in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_planes_and_commands_identify_too(tmp_path):
    """Plane intersection in every frame is noisier, so that the goals of the default method are not asked of it; the
    command-driven search starts on a bound here."""
    choices = ("pose_method=planes", "identification.method=command_driven", "timing.hold=linear", "validation.count=1")
    settings = [word for choice in choices for word in ("--set", choice)]
    done = cmmsim("run", "quick", "--out", tmp_path / "run", "--quiet", *settings)
    assert done.returncode == 0, done.stderr
    result = load_result(tmp_path / "run" / "result.json")
    (unseen,) = (run["true"] for run in result["validation"])
    assert max(unseen["position_rms_um"]) <= 5
    assert max(unseen["orientation_rms_urad"]) <= 25
    assert [g for g in check_goals(result) if not g.passed and not g.name.startswith("unseen")] == []
    assert result["identification"]["iterations"] > 0
    assert result["identification"]["noise_ratio"] == pytest.approx(1.0, abs=0.15)


def test_an_output_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    done = cmmsim("run", "quick", "--out", tmp_path / "file" / "out")
    assert done.returncode != 0
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert "cannot be made" in done.stderr


def test_a_truncated_record_is_one_line(run, tmp_path):
    _, folder, _ = run
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("scenario.toml", "trajectories.json"):
        (copy / name).write_bytes((folder / name).read_bytes())
    whole = (folder / "experiment.nc").read_bytes()
    (copy / "experiment.nc").write_bytes(whole[: len(whole) // 2])
    done = cmmsim("identify", "--out", copy)
    assert done.returncode != 0
    assert "experiment.nc is truncated" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (copy / "result.json").exists()


def test_the_records_are_plain_json_and_netcdf(run):
    _, folder, _ = run
    json.loads(Path(folder / "result.json").read_text(encoding="utf-8"))
    assert Path(folder / "experiment.nc").read_bytes()[:4] == b"\x89HDF"
