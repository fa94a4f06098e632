"""The command `cmmsim run` and its stages: what they pass on, say and refuse. The stages are replaced by notes."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from cmmsim.errors import OpenGLMissingError
from dynamics.errors import RobotFileError
from identify.commands import app as command_line
from identify.errors import RecordError, ScenarioError
from identify.files.run_folder import RunFolder, load_result, new_run_folder, save_result
from tests.identify.commands import command, one_line
from tests.identify.conftest import make_result

STAGES = ("record", "identify", "validate", "report")


@pytest.fixture
def calls(monkeypatch):
    """The stages, replaced by notes of their calls; a run leaves a result, as the real one does."""
    made = []

    def stage(name):
        return lambda *arguments: made.append((name, *arguments))

    def run(scenario, seed, folder, *more):
        made.append(("run", scenario, seed, folder, *more))
        save_result(RunFolder(folder).result, warned(make_result()))

    replaced = SimpleNamespace(run=run, excite=stage("excite"), **{name: stage(name) for name in STAGES})
    monkeypatch.setattr(command_line, "_pipeline", lambda: replaced)
    return made


@pytest.fixture
def run_folder(run_folder):
    run_folder.trajectories.write_text("{}")
    return run_folder


def warned(result):
    """The result of a plant that the model cannot be."""
    result["identification"] |= {
        "noise_ratio": 1.356,
        "whiteness": {"p_value": 0.0},
        "warnings": ["not white", "a\nb"],
        "groups": {"platform.mass": {"identifiable": True}},
    }
    return result


def test_identify_says_whether_the_model_explains_the_record_and_warns_even_where_it_is_quiet(calls, run_folder, capfd):
    assert command("identify", "--out", run_folder.path) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert "the model explains the record" in out
    save_result(run_folder.result, warned(load_result(run_folder.result)))
    said = (
        "identified: 4 of 5 parameters and 1 of 1 groups",
        "1.356 times the noise variance, noise alone gives 1.100 ± 0.040",
        "the model does NOT explain the record",
        str(run_folder.result),
    )
    for quiet in (True, False):
        assert command("identify", "--out", run_folder.path, *["--quiet"] * quiet) == 0
        out, err = capfd.readouterr()
        assert err == "warning: not white\nwarning: a b\n"
        assert [text in out for text in said] == 4 * [not quiet]


def test_a_run_of_a_wrong_plant_warns_and_names_the_goals_it_misses(calls, tmp_path, capfd):
    assert command("run", "quick", "--out", tmp_path / "new") == 0
    out, err = capfd.readouterr()
    assert err == "warning: not white\nwarning: a b\n"
    assert [line.split(":")[1] for line in out.splitlines() if line.startswith("missed: ")] == [
        " misfit of the record",
        " white residuals",
    ]
    assert "missed: misfit of the record: residuals 1.356 times the noise variance" in out


def test_run_passes_scenario_seed_folder_and_workers(calls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = ("--set", "timing.latency_s=0.01", "--set", "pose_method=planes")
    assert command("run", "quick", "--out", "mine", "--seed", 7, "--workers", 2, "--quiet", *settings) == 0
    assert command("run", "--seed", 3, "--quiet") == 0
    (name, scenario, seed, folder, _, workers), default = calls
    assert (name, seed, folder.as_posix(), workers) == ("run", 7, "mine", 2)
    assert (scenario.name, scenario.timing.latency_s, scenario.pose_method) == ("quick", 0.01, "planes")
    assert default[3].as_posix() == "runs/paper-3"


def test_stages_read_the_folder_that_the_one_before_wrote_and_identify_takes_settings(calls, run_folder, capfd):
    for stage in STAGES:
        assert command(stage, "--out", run_folder.path, "--quiet") == 0
    assert [call[:2] for call in calls] == [(stage, run_folder.path) for stage in STAGES]
    settings = ("identification.method=command_driven", 'identification.prior={"link1.mass"={value=1, std=0.1}}')
    words = [word for setting in settings for word in ("--set", setting)]
    assert command("identify", "--out", run_folder.path, "--quiet", *words) == 0
    assert calls[-1][3] == {
        "identification.method": "command_driven",
        "identification.prior": {"link1.mass": {"value": 1, "std": 0.1}},
    }
    run_folder.experiment.unlink()
    assert command("identify", "--out", run_folder.path) == 1
    assert "cmmsim record --out" in one_line(capfd.readouterr().err)


def test_summary_after_a_report_shows_goals_speed_what_was_missed_and_where_the_report_is(calls, run_folder, capsys):
    result = load_result(run_folder.result)
    result["identification"]["parameters"]["joint1.viscous"]["estimate"] = 0.3
    save_result(run_folder.result, result)
    assert command("report", "--out", run_folder.path) == 0
    shown = capsys.readouterr().out
    assert "missed: friction and PID outside: of 3 within 5 % of truth or 3 std; outside: joint1.viscous\n" in shown
    assert all(text in shown for text in ("unseen position", "urad", "stereo frames", str(run_folder.report)))


@pytest.mark.parametrize(
    ("arguments", "evidence"),
    [
        (("run", "nope"), "neither built in (paper, quick)"),
        (("run", "quick", "--set", "filter.cutoff_hz=60"), "Nyquist frequency 30 Hz"),
        (("run", "quick", "--set", "filter.cutof_hz=60"), "valid names in [filter]: order, cutoff_hz"),
        (("run", "quick", "--set", "filter"), "KEY=VALUE"),
        (("record", "--out", "nowhere"), "no run folder nowhere"),
        (("run", "quick", "--out", "mine"), "mine is not empty"),
        (("run", "quick", "--out", "mine/text"), "mine/text is a file"),
        (("run", "quick", "--out", "/proc/none/here"), "/proc/none/here cannot be made: /proc is not a folder"),
    ],
)
def test_bad_input_is_one_line_and_status_one(calls, capfd, tmp_path, monkeypatch, arguments, evidence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "text").touch()
    assert command(*arguments) == 1
    assert evidence in one_line(capfd.readouterr().err)
    assert calls == []
    assert [path.name for path in tmp_path.rglob("*")] == ["mine", "text"]


def test_new_folder_may_be_absent_or_empty(tmp_path):
    assert not new_run_folder(tmp_path / "absent").path.exists()
    assert new_run_folder(tmp_path).path == tmp_path


@pytest.mark.parametrize(
    "error", [RecordError("a\nb"), RobotFileError("a\nb"), OpenGLMissingError(ImportError("a\nb"))], ids=type
)
def test_known_errors_of_every_package_are_one_line_and_others_keep_their_traceback(
    capfd, monkeypatch, tmp_path, error
):
    def fail(*_):
        raise errors.pop(0)

    errors = [error, ZeroDivisionError("a defect")]
    monkeypatch.setattr(command_line, "_pipeline", lambda: SimpleNamespace(run=fail))
    assert command("run", "quick", "--out", tmp_path / "new", "--quiet") == 1
    assert "a b" in one_line(capfd.readouterr().err)
    with pytest.raises(ZeroDivisionError, match="a defect"):
        command("run", "quick", "--out", tmp_path / "new", "--quiet")


def test_settings_are_toml_or_text_behind_a_key():
    texts = ["30", "0.5", "true", "planes", '"30"', "a=b", ""]
    parsed = command_line.parse_settings([f"x{number}={text}" for number, text in enumerate(texts)])
    assert [*parsed.values()] == [30, 0.5, True, "planes", "30", "a=b", ""]
    assert [*parsed] == [f"x{number}" for number in range(len(texts))]
    with pytest.raises(ScenarioError, match="KEY=VALUE"):
        command_line.parse_settings(["=30"])


def test_help_teaches_and_the_command_starts_in_a_process_of_its_own_and_waits_for_nothing_heavy(capsys):
    heavy = "casadi", "cv2", "matplotlib", "numba", "pandas", "scipy.optimize"
    loaded = f"import identify.commands.app, sys; print(sorted(set({heavy}) & sys.modules.keys()))"
    for words, shown in ((["-m", "identify", "--version"], "cmmsim 0."), (["-c", loaded], "[]\n")):
        made = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True)
        assert made.stdout.startswith(shown)
    for words, shown in (
        (["--help"], "identify --out mine --set identification.method=command_driven"),
        (["run", "--help"], "paper, quick"),
        (["identify", "--help"], "stays in scenario.toml"),
        (["acceptance", "--help"], "cmmsim acceptance mine.toml"),
        (["calibrate", "--help"], "asymmetric_dots"),
    ):
        assert command(*words) == 0
        assert shown in capsys.readouterr().out
