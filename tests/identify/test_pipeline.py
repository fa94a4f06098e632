"""Whole runs, from rendered images to the report: every figure of the project's goals, and what
users meet on the way.

What the command line passes on, says and refuses is proved in test_command_line.py, with the stages
replaced. What figures look like is proved in test_report.py.
"""

import io
import os
import pickle
import shutil
import subprocess
import sys
from contextlib import contextmanager

import matplotlib as mpl
import pytest
from PIL import Image

from identify import pipeline
from identify.files.run_folder import RunFolder, load_result
from identify.progress import SilentProgress
from identify.record.recording import read, read_runs
from identify.reporting.figures.style import STYLE
from identify.reporting.goals import check_goals
from identify.scenario import load_scenario
from identify.setup import Setup
from tests.identify.commands import command, one_line
from tests.identify.synthetic import quick, recorded_run_folder, run_plant

pytestmark = [pytest.mark.slow, pytest.mark.rendering]

RMS = ("position_rms_um", "orientation_rms_urad")


def cmmsim(*arguments, **environment):
    command = [sys.executable, "-m", "identify", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **environment}, check=False
    )


@contextmanager
def mapped_here(workers, function, *tasks, start):
    """Stand for worker processes, which take seconds to start: what they are given and give is
    pickled.
    """
    counter, *given = start.args
    start.func(counter, *pickle.loads(pickle.dumps(given)))
    yield (pickle.loads(pickle.dumps(function(*task))) for task in zip(*tasks, strict=True))


def drawn_bare(draw):
    """Stand for `drawn`: the figure is made, but not laid out."""
    with mpl.rc_context(STYLE):
        return draw()


def one_pixel(*_):
    """Stand for the file of a figure."""
    stream = io.BytesIO()
    Image.new("RGB", (1, 1)).save(stream, "png")
    return stream.getvalue()


def run_here(folder, *settings):
    """Run `quick` in this process with some settings; figures are made and not drawn."""
    words = [word for setting in settings for word in ("--set", setting)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("identify.validation.unseen.mapped", mapped_here)
        patch.setattr("identify.reporting.report.drawn", drawn_bare)
        patch.setattr("identify.reporting.report.figure_bytes", one_pixel)
        patch.setattr("identify.reporting.report.svg_text", lambda *_: "<svg></svg>")
        assert command("run", "quick", "--out", folder, "--workers", 2, "--quiet", *words) == 0
    return RunFolder(folder)


@pytest.fixture(scope="module")
def quick_run(tmp_path_factory):
    """The folder of `cmmsim run quick` with short unseen motions, not to be changed."""
    folder = tmp_path_factory.mktemp("quick") / "run"
    return run_here(folder, "renderer=analytic", "validation.duration_s=2.0")


@pytest.fixture(scope="module")
def result(quick_run):
    return load_result(quick_run.result)


def missed(result):
    return [goal.name for goal in check_goals(result) if not goal.passed]


def worst(result, key):
    """Largest position [um] and orientation [urad] error of any axis and unseen run."""
    runs = [run[key] for run in result["validation"]]
    return [max(max(run[figure]) for run in runs) for figure in RMS]


@pytest.mark.thorough
def test_the_command_that_the_readme_begins_with_meets_every_goal(tmp_path):
    """In processes of its own, with the images and figures of every user."""
    done = cmmsim("run", "quick", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert missed(load_result(tmp_path / "run" / "result.json")) == []


def test_images_of_pyrender_are_measured_in_each_stage(tmp_path):
    """Two seconds of excitation, which tell few parameters."""
    short = {
        "renderer": "pyrender",
        "excitation.duration_s": 2.0,
        "excitation.candidates": 2,
        "identification.max_iterations": 1,
        "validation.duration_s": 1.0,
        "validation.count": 1,
    }
    pipeline.excite(Setup(quick(**short)), tmp_path, SilentProgress())
    taught = pipeline.record(tmp_path, SilentProgress())
    pipeline.identify(tmp_path, SilentProgress())
    pipeline.validate(tmp_path, SilentProgress(), taught=taught)
    goals = {goal.name: goal for goal in check_goals(load_result(tmp_path / "result.json"))}
    for name in ("cameras, position", "cameras, orientation", "lost frames"):
        assert goals[name].passed, goals[name]


def test_a_quick_run_meets_every_goal_and_the_model_is_twenty_times_closer_than_before(result):
    assert len(check_goals(result)) >= 6
    assert missed(result) == []
    for run in result["validation"]:
        for figure in RMS:
            pairs = zip(run["initial_true"][figure], run["true"][figure], strict=True)
            assert all(before > 20 * after for before, after in pairs)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("unseen", "position_um", "orientation_urad", "sensor_um", "sensor_urad"),
    [
        (1, 1.139, 4.23, 3.188, 11.37),
        pytest.param(10, 1.164, 5.00, 3.183, 11.65, marks=pytest.mark.thorough),
    ],
)
def test_the_papers_experiment_gives_the_figures_that_are_quoted(
    tmp_path, unseen, position_um, orientation_urad, sensor_um, sensor_urad
):
    """To the last digit that the README quotes, which are those of all ten validation runs; the
    report, which changes none, is the quick run's."""
    scenario = load_scenario("paper").with_overrides({"validation.count": unseen})
    setup = Setup(scenario).on_this_machine()
    pipeline.excite(setup, tmp_path, SilentProgress())
    taught = pipeline.record(tmp_path, SilentProgress())
    pipeline.identify(tmp_path, SilentProgress())
    pipeline.validate(tmp_path, SilentProgress(), taught=taught)
    result = load_result(tmp_path / "result.json")
    position, orientation = worst(result, "true")
    assert position == pytest.approx(position_um, abs=1e-3)
    assert orientation == pytest.approx(orientation_urad, abs=1e-2)
    assert max(result["sensor"]["position_rms_um"]) == pytest.approx(sensor_um, abs=1e-3)
    assert max(result["sensor"]["orientation_rms_urad"]) == pytest.approx(sensor_urad, abs=1e-2)
    assert len(result["validation"]) == unseen
    assert read(tmp_path / "experiment.nc").sizes["time"] == 1200
    assert missed(result) == []


def test_the_result_has_every_entry_of_the_contract(quick_run, result):
    made = {
        "scenario.toml",
        "trajectories.json",
        "experiment.nc",
        "validation.nc",
        "figures",
        "report.html",
    }
    assert {path.name for path in quick_run.path.iterdir()} == made | {
        "covariance.nc",
        "model.nc",
        "result.json",
    }
    assert (result["scenario"], result["seed"]) == ("quick", 0)
    assert {"excite", "record", "identify", "validate", "report", "total"} <= set(result["seconds"])
    assert set(result["sensor"]) >= {*RMS, "frames", "lost_frames", "stereo_frames_per_second"}
    identification = result["identification"]
    assert identification["scale_anchor"] == "platform_mass"
    assert identification["base_rank"] > 30
    assert "eq. 35" in identification["stop_reason"]
    for entry in identification["parameters"].values():
        assert set(entry) >= {"initial", "true", "estimate", "std", "identifiable"}
        assert all(entry[key] is not None for key in ("initial", "true", "estimate", "std"))
    assert all(len(result[key]["position_rms_um"]) == 3 for key in ("before", "after"))
    assert len(result["validation"]) == len(read_runs(quick_run.validation)) == 2
    assert all(
        set(run[of]) >= set(RMS) for run in result["validation"] for of in ("measured", "true")
    )
    assert read(quick_run.experiment).sizes["time"] == 600


def test_a_stage_can_be_repeated_with_the_same_numbers_and_not_from_half_a_record(
    quick_run, result, tmp_path, capfd
):
    again = RunFolder(shutil.copytree(quick_run.path, tmp_path / "run"))
    pipeline.identify(again.path, SilentProgress())
    repeated, first = load_result(again.result)["identification"], result["identification"]
    assert len(first["parameters"]) == 67
    for name, entry in first["parameters"].items():
        assert repeated["parameters"][name]["estimate"] == entry["estimate"]
    written = again.result.read_bytes()
    os.truncate(again.experiment, again.experiment.stat().st_size // 2)
    assert command("identify", "--out", again.path) == 1
    assert "experiment.nc is truncated" in one_line(capfd.readouterr().err)
    assert again.result.read_bytes() == written


@pytest.mark.thorough
def test_planes_and_commands_identify_too(tmp_path, capfd):
    """Plane intersection in every frame is noisier, so that the goals of the default method are not
    asked of it; the command-driven search starts on a bound here."""
    choices = {
        "pose_method": "planes",
        "identification.method": "command_driven",
        "timing.hold": "linear",
    }
    choices |= {"validation.count": 1, "validation.duration_s": 2, "renderer": "analytic"}
    settings = [word for choice in choices.items() for word in ("--set", "{}={}".format(*choice))]
    assert command("run", "quick", "--out", tmp_path / "run", "--quiet", *settings) == 0, (
        capfd.readouterr().err
    )
    result = load_result(tmp_path / "run" / "result.json")
    position, orientation = worst(result, "true")
    assert position <= 5
    assert orientation <= 25
    assert [name for name in missed(result) if not name.startswith("validation")] == []
    assert result["identification"]["iterations"] > 0
    assert result["identification"]["noise_ratio"] == pytest.approx(1.0, abs=0.15)


@pytest.mark.thorough
def test_a_plant_that_the_model_cannot_be_is_said_and_judged(tmp_path, capfd):
    wrong = {
        "plant.friction": "stribeck",
        "plant.static_ratio": 1.3,
        "plant.stribeck_velocity_rad_s": 0.05,
    }
    scenario = quick(**wrong, **{"identification.method": "command_driven"})
    run = recorded_run_folder(tmp_path, scenario, run_plant(scenario, seed=0))
    assert command("identify", "--out", run.path, "--quiet") == 0
    out, err = capfd.readouterr()
    assert out == ""
    assert all(line.startswith("warning: ") for line in err.splitlines())
    assert "are correlated from frame to frame" in err
    result = load_result(run.result)
    assert "p value of the residuals" in missed(result)
    assert result["identification"]["noise_ratio"] > 1.05


@pytest.mark.thorough
def test_without_opengl_the_analytic_renderer_draws_or_pyrender_stops_with_one_line_each(tmp_path):
    broken, out = tmp_path / "without" / "OpenGL", tmp_path / "out"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise ImportError('no EGL here')\n")
    path = os.pathsep.join([str(broken.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = cmmsim("run", "quick", "--set", "renderer=pyrender", "--out", out, PYTHONPATH=path)
    assert done.returncode != 0
    assert "libegl1" in one_line(done.stderr)
    assert not out.exists()
    done = cmmsim("excite", "quick", "--out", out, "--quiet", PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("warning")]
    assert lines == [
        "warning: images are drawn by the analytic renderer, because pyrender found no OpenGL: "
        "no EGL here"
    ]
    assert load_scenario(str(out / "scenario.toml")).renderer == "analytic"


def test_what_cannot_be_run_is_one_line_before_any_file(tmp_path, capfd):
    """The first line of what a stage finds on its way; what a scenario cannot be is proved in
    test_scenario.py.
    """
    for setting, words in (
        ("robot=rss7", ["rss7", "rss6"]),
        ("excitation.position_amplitude_m=0.2", ["leg"]),
        ("plant.parameters=nobody", ["nobody", "guess", "truth"]),
        ("model.start_parameters=nobody", ["nobody", "guess", "truth"]),
    ):
        assert command("run", "quick", "--quiet", "--set", setting, "--out", tmp_path / "out") == 1
        error = one_line(capfd.readouterr().err)
        assert all(word in error for word in words), error
        assert not (tmp_path / "out").exists()


@pytest.mark.thorough
def test_after_warm_up_a_run_compiles_nothing_and_finds_no_other_program(tmp_path):
    """With empty caches, nothing on the path and the analytic renderer: no compiler and no OpenGL
    can be found.
    """
    caches = {name: str(tmp_path / name) for name in ("CMMSIM_CACHE", "NUMBA_CACHE_DIR", "HOME")}
    environment = {**caches, "PATH": "", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}

    def called(*arguments):
        command = [
            sys.executable,
            "-m",
            "cmmsim",
            *arguments,
            "--set",
            "renderer=analytic",
            "--quiet",
        ]
        subprocess.run(command, env=environment, cwd=tmp_path, check=True)
        files = [
            *(tmp_path / "CMMSIM_CACHE").rglob("*.*"),
            *(tmp_path / "NUMBA_CACHE_DIR").rglob("*.nb?"),
        ]
        return {file: file.stat().st_mtime_ns for file in files}

    compiled = called("warm-up", "quick")
    assert {file.suffix for file in compiled} == {".robot", ".kernel", ".nbi", ".nbc"}
    assert called("run", "quick", "--out", "run") == compiled
