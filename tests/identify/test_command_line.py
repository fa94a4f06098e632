import subprocess
import sys
from types import SimpleNamespace

import pytest

from identify.commands import app as command_line
from identify.errors import OutputFolderError, ScenarioError
from identify.files.run_folder import RunFolder, load_result, new_run_folder, save_result
from tests.identify.commands import command, one_line
from tests.identify.conftest import make_result


@pytest.fixture
def calls(monkeypatch):
    """The stages, replaced by notes of their calls; a run leaves a result, as the real one does."""
    made = []

    def stage(name):
        return lambda *arguments: made.append((name, *arguments))

    def run(scenario, seed, folder, *more):
        made.append(("run", scenario, seed, folder, *more))
        save_result(RunFolder(folder).result, warned(make_result()))

    names = ("excite", "record", "identify", "validate", "report")
    monkeypatch.setattr(command_line, "_pipeline", lambda: SimpleNamespace(run=run, **{n: stage(n) for n in names}))
    return made


def warned(result):
    """The result of a plant that the model cannot be."""
    result["identification"] |= {
        "noise_ratio": 1.356,
        "whiteness": {"p_value": 0.0},
        "warnings": ["not white", "a\nb"],
        "groups": {"platform.mass": {"identifiable": True}},
    }
    return result


@pytest.mark.parametrize("quiet", [True, False])
def test_identify_warns_on_standard_error_even_where_it_is_quiet(calls, run_folder, capfd, quiet):
    run_folder.trajectories.write_text("{}")
    save_result(run_folder.result, warned(load_result(run_folder.result)))
    assert command("identify", "--out", run_folder.path, *["--quiet"] * quiet) == 0
    out, err = capfd.readouterr()
    assert err == "warning: not white\nwarning: a b\n"
    if quiet:
        assert out == ""
    else:
        assert "identified: 4 of 5 parameters and 1 of 1 groups" in out
        assert "1.356 times the noise variance, noise alone gives 1.100 ± 0.040" in out
        assert "the model does NOT explain the record" in out
        assert str(run_folder.result) in out


def test_identify_says_that_the_model_explains_the_record(calls, run_folder, capfd):
    run_folder.trajectories.write_text("{}")
    assert command("identify", "--out", run_folder.path) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert "the model explains the record" in out


def test_a_run_of_a_wrong_plant_warns_and_misses_its_goals(calls, tmp_path, capfd):
    assert command("run", "quick", "--out", tmp_path / "new") == 0
    out, err = capfd.readouterr()
    assert err == "warning: not white\nwarning: a b\n"
    assert "missed: misfit of the record: residuals 1.356 times the noise variance" in out
    assert "missed: white residuals: " in out


def test_run_passes_scenario_seed_folder_and_workers(calls, tmp_path):
    out = tmp_path / "mine"
    assert (
        command(
            "run",
            "quick",
            "--out",
            out,
            "--seed",
            7,
            "--workers",
            2,
            "--quiet",
            "--set",
            "timing.latency_s=0.01",
            "--set",
            "pose_method=planes",
        )
        == 0
    )
    ((name, scenario, seed, folder, _, workers),) = calls
    assert (name, seed, folder, workers) == ("run", 7, out, 2)
    assert (scenario.name, scenario.timing.latency_s, scenario.pose_method) == ("quick", 0.01, "planes")


def test_default_folder_is_named_after_scenario_and_seed(calls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command("run", "--seed", 3, "--quiet") == 0
    assert calls[0][3].as_posix() == "runs/paper-3"


def test_stages_read_the_folder(calls, run_folder):
    run_folder.trajectories.write_text("{}")
    for stage in ("record", "identify", "validate", "report"):
        assert command(stage, "--out", run_folder.path, "--quiet") == 0
    assert [(c[0], c[1]) for c in calls] == [(s, run_folder.path) for s in ("record", "identify", "validate", "report")]


def test_identify_passes_settings_of_the_estimator(calls, run_folder):
    run_folder.trajectories.write_text("{}")
    settings = ("identification.method=command_driven", 'identification.prior={"link1.mass"={value=1, std=0.1}}')
    words = [word for setting in settings for word in ("--set", setting)]
    assert command("identify", "--out", run_folder.path, "--quiet", *words) == 0
    assert calls[0][3] == {
        "identification.method": "command_driven",
        "identification.prior": {"link1.mass": {"value": 1, "std": 0.1}},
    }


def test_summary_after_a_report_shows_goals_and_where_the_report_is(calls, run_folder, capsys):
    assert command("report", "--out", run_folder.path) == 0
    shown = capsys.readouterr().out
    assert "unseen position" in shown
    assert "urad" in shown
    assert str(run_folder.report) in shown


def test_summary_explains_what_was_missed(calls, run_folder, capsys):
    result = load_result(run_folder.result)
    result["identification"]["parameters"]["joint1.viscous"]["estimate"] = 0.3
    save_result(run_folder.result, result)
    command("report", "--out", run_folder.path)
    assert "missed: friction and PID outside: of 3 within 5 % of truth or 3 std; outside: joint1.viscous" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("arguments", "evidence"),
    [
        (("run", "nope"), "neither built in (paper, quick)"),
        (("run", "quick", "--set", "filter.cutoff_hz=60"), "Nyquist frequency 30 Hz"),
        (("run", "quick", "--set", "filter.cutof_hz=60"), "valid names in [filter]: order, cutoff_hz"),
        (("run", "quick", "--set", "filter"), "KEY=VALUE"),
        (("record", "--out", "nowhere"), "no run folder nowhere"),
    ],
)
def test_bad_input_is_one_line_and_status_one(calls, capfd, tmp_path, monkeypatch, arguments, evidence):
    monkeypatch.chdir(tmp_path)
    assert command(*arguments) == 1
    assert evidence in one_line(capfd.readouterr().err)
    assert calls == []
    assert list(tmp_path.iterdir()) == []


def test_existing_output_folder_is_refused_and_left_alone(calls, capfd, tmp_path):
    (tmp_path / "something").write_text("mine")
    assert command("run", "quick", "--out", tmp_path) == 1
    assert "is not empty" in one_line(capfd.readouterr().err)
    assert calls == []
    assert [p.name for p in tmp_path.iterdir()] == ["something"]


def test_stage_without_the_one_before_names_it(calls, capfd, run_folder):
    run_folder.trajectories.write_text("{}")
    run_folder.experiment.unlink()
    assert command("identify", "--out", run_folder.path) == 1
    assert "cmmsim record --out" in one_line(capfd.readouterr().err)


@pytest.mark.parametrize("module", ["identify", "dynamics", "cmmsim"])
def test_known_errors_of_every_package_are_one_line(calls, capfd, monkeypatch, tmp_path, module):
    from cmmsim.errors import OpenGLMissingError
    from dynamics.errors import RobotFileError
    from identify.errors import RecordError

    error = {
        "identify": RecordError("a\nb"),
        "dynamics": RobotFileError("a\nb"),
        "cmmsim": OpenGLMissingError(ImportError("a\nb")),
    }[module]

    def fail(*_):
        raise error

    monkeypatch.setattr(command_line, "_pipeline", lambda: SimpleNamespace(run=fail))
    assert command("run", "quick", "--out", tmp_path / "new", "--quiet") == 1
    assert "a b" in one_line(capfd.readouterr().err)


def test_unexpected_error_keeps_its_traceback(monkeypatch, tmp_path):
    def fail(*_):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(command_line, "_pipeline", lambda: SimpleNamespace(run=fail))
    with pytest.raises(ZeroDivisionError, match="a defect"):
        command("run", "quick", "--out", tmp_path / "new", "--quiet")


@pytest.mark.parametrize(
    ("text", "value"),
    [("30", 30), ("0.5", 0.5), ("true", True), ("planes", "planes"), ('"30"', "30"), ("a=b", "a=b"), ("", "")],
)
def test_settings_are_toml_or_text(text, value):
    assert command_line.parse_settings([f"timing.x={text}"]) == {"timing.x": value}


def test_settings_need_a_key():
    with pytest.raises(ScenarioError, match="KEY=VALUE"):
        command_line.parse_settings(["=3"])


def test_new_folder_may_be_absent_or_empty_but_no_file(tmp_path):
    assert not new_run_folder(tmp_path / "absent").path.exists()
    assert new_run_folder(tmp_path) == RunFolder(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(OutputFolderError, match="is a file"):
        new_run_folder(tmp_path / "file")


def test_command_starts_in_a_process_of_its_own():
    made = subprocess.run([sys.executable, "-m", "identify", "--version"], capture_output=True, text=True, check=True)
    assert made.stdout.startswith("cmmsim 0.")


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        (["--help"], "Examples:"),
        (["--help"], "identify --out mine --set identification.method=command_driven"),
        (["run", "--help"], "paper, quick"),
        (["identify", "--help"], "stays in scenario.toml"),
    ],
)
def test_help_teaches(capsys, arguments, shown):
    assert command(*arguments) == 0
    assert shown in capsys.readouterr().out
