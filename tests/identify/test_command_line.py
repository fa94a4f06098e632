"""The command `cmmsim`: what its stages, replaced by notes, pass on and say; what a terminal shows;
what all refuse.
"""

import io
import re
import shlex
import subprocess
import sys
from contextlib import suppress
from types import SimpleNamespace

import pytest
from rich.console import Console

from cmmsim.errors import OpenGLMissingError
from dynamics.errors import RobotFileError
from identify.commands import run_stages as command_line
from identify.commands.help import BEYOND_LIMIT, MISUSED
from identify.commands.options import parse_settings
from identify.errors import RecordError, ScenarioError
from identify.files.run_folder import RunFolder, load_result, save_result
from identify.progress import RichProgress, print_table
from tests.identify.commands import command, one_line
from tests.identify.conftest import make_result

STAGES = ("record", "identify", "validate", "report")


@pytest.fixture
def calls(monkeypatch):
    """The stages, replaced by notes of their calls; a run leaves a result, as the real one does."""
    made = []

    def run(setup, folder, *more):
        made.append(("run", setup, folder, *more))
        save_result(RunFolder(folder).result, warned(make_result()))

    noted = {name: lambda *arguments, name=name: made.append((name, *arguments)) for name in STAGES}
    monkeypatch.setattr(
        command_line,
        "_pipeline",
        lambda: SimpleNamespace(run=run, is_begun=lambda *_: False, **noted),
    )
    return made


NOTED = "note: the servo used wrong poses\nwarning: not white\nwarning: a b\n"


def warned(result):
    """The result of a plant that the model cannot be."""
    result["identification"] |= {
        "noise_ratio": 1.356,
        "whiteness": {"p_value": 0.0},
        "notes": ["the servo\nused wrong poses"],
        "warnings": ["not white", "a\nb"],
        "groups": {
            "platform.mass": {"identifiable": True, "coefficients": {"platform.mass": 1.0}},
            "sum": {"identifiable": True, "coefficients": {"a": 1.0, "b": 0.2}},
        },
    }
    return result


def test_identify_says_whether_the_model_explains_the_record_and_warns_even_where_it_is_quiet(
    calls, run_folder, capfd
):
    assert command("identify", "--out", run_folder.path) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert "the model explains the record" in out
    save_result(run_folder.result, warned(load_result(run_folder.result)))
    said = (
        "identified: 4 of 5 parameters, and 1 of 1 sums of parameters, in ",
        "residual variance / noise variance: 1.356: mean square of",
        "noise alone gives 1.100 ± 0.040",
        "the model does NOT explain the record: the model is wrong, or the errors of the cameras "
        "exceed their stated noise",
        str(run_folder.result),
    )
    for quiet in (True, False):
        assert command("identify", "--out", run_folder.path, *["--quiet"] * quiet) == 0
        out, err = capfd.readouterr()
        assert err == NOTED
        assert [text in out for text in said] == 5 * [not quiet]


def test_run_passes_its_arguments_on_warns_of_a_wrong_plant_and_names_the_goals_missed(
    calls, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    settings = ("--set", "timing.latency_s=0.01", "--set", "pose_method=planes")
    assert (
        command("run", "quick", "--out", "mine", "--seed", 7, "--workers", 2, "--quiet", *settings)
        == 0
    )
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith(f"{NOTED}missed: residual variance / noise variance 1.356, required at ")
    assert err.count("\nmissed: ") == 2
    assert command("run", "--seed", 3) == 0
    (name, setup, folder, _, workers), default = calls
    assert (name, setup.seed, folder.as_posix(), workers) == ("run", 7, "mine", 2)
    scenario = setup.scenario
    assert (scenario.name, scenario.timing.latency_s, scenario.pose_method) == (
        "quick",
        0.01,
        "planes",
    )
    assert default[2].as_posix() == "runs/paper-3"
    out, err = capfd.readouterr()
    assert err == NOTED
    missed = [line.split(":")[1] for line in out.splitlines() if line.startswith("missed: ")]
    assert missed == [" residual variance / noise variance", " p value of the residuals"]
    assert (
        "missed: residual variance / noise variance: mean square of measured minus identified pose"
        in out
    )


def test_stages_read_the_folder_that_the_one_before_wrote_and_identify_takes_settings(
    calls, run_folder, capfd
):
    for stage in STAGES:
        assert command(stage, "--out", run_folder.path, "--quiet") == 0
    assert [call[:2] for call in calls] == [(stage, run_folder.path) for stage in STAGES]
    method, prior = (
        "identification.method=command_driven",
        'identification.prior={"link1.mass"={value=1, std=0.1}}',
    )
    assert (
        command("identify", "--out", run_folder.path, "--quiet", "--set", method, "--set", prior)
        == 0
    )
    assert calls[-1][3] == {
        "identification.method": "command_driven",
        "identification.prior": {"link1.mass": {"value": 1, "std": 0.1}},
    }
    run_folder.experiment.unlink()
    assert command("identify", "--out", run_folder.path) == 1
    assert "cmmsim record --out" in one_line(capfd.readouterr().err)


def test_a_file_of_a_run_in_place_of_its_folder_is_answered_with_the_folder(run_folder, capfd):
    assert command("report", run_folder.result) == MISUSED
    said = " ".join(capfd.readouterr().err.split())
    assert said.endswith(f"cmmsim report --out {run_folder.path}")
    assert command("report", "--out", run_folder.result) == 1
    assert one_line(capfd.readouterr().err).endswith(f"--out {run_folder.path}\n")


def test_summary_after_a_report_shows_goals_speed_what_was_missed_and_where_the_report_is(
    calls, run_folder, capsys
):
    result = load_result(run_folder.result)
    result["identification"]["parameters"]["joint1.viscous"]["estimate"] = 0.3
    save_result(run_folder.result, result)
    assert command("report", "--out", run_folder.path) == 0
    shown = capsys.readouterr().out
    missed = (
        "missed: friction and gains far off: of 3: estimates off the truth by more than 5 % "
        "and more than 3 standard"
    )
    assert f"{missed} deviations, joint1.viscous\n" in shown
    measured = "of the identified model in the worst run, and of measured poses over all frames."
    assert f"Errors against the truth are the RMS of the worst axis: {measured}" in shown
    assert all(
        text in shown
        for text in ("validation motion, position", "µrad", "stereo frames", str(run_folder.report))
    )
    assert command("report", "--out", run_folder.path, "--strict", "--quiet") == BEYOND_LIMIT
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("missed: friction and gains far off 1, required at most 0 (of 3: ")
    assert second == "error: 1 of 8 goals is missed: friction and gains far off"


@pytest.mark.parametrize(
    ("words", "evidence"),
    [
        ("run nope", "neither built in (geometry, paper, paper_settings, quick)"),
        ("study mine", ") nor a file, but a folder"),
        ("run quick --set filter.cutof_hz=60", "valid names in [filter]: order, cutoff_hz"),
        ("record --out nowhere", "no run folder nowhere"),
        ("run quick --out mine", "mine is not empty"),
        ("run quick --out mine/text", "mine/text is a file"),
        (
            "run quick --out /proc/none/here",
            "cannot write /proc/none/here: No such file or directory",
        ),
        ("acceptance ctrak", "unknown sensor 'ctrak'"),
        ("acceptance --renderer oil", "unknown renderer 'oil': valid are analytic"),
        ("acceptance --standard iso", "unknown standard 'iso': valid are all, e3064, e3124, vdi"),
        ("acceptance --limit-um nan", "positive number of um, got nan"),
        ("acceptance --volume 1x2", "volume '1x2' is neither"),
        ("acceptance --volume nan", "volume 'nan' is neither"),
        (
            "acceptance --volume 3",
            "measuring volume 3000 x 3000 x 3000 mm is not wholly visible to both cameras",
        ),
        ("acceptance --volume 0.3 --standard e3124", "the body on its circle needs"),
        ("acceptance --renderer analytic --out mine", "mine is not empty"),
        ("detectors --tilt 85", "tilt 85 degrees"),
        ("detectors --tags 9X9", "unknown dictionary '9X9': valid are 4X4_100"),
        (
            "calibrate mine --out new",
            "missing RIGHT, --board FILE; cmmsim calibrate --help shows examples",
        ),
        ("calibrate none mine --board mine/board.toml", "no folder none"),
        (
            "calibrate mine mine --board b --distortion fisheye",
            "'fisheye': valid are brown5, none, radial2",
        ),
        ("calibrate mine mine --board b --sensor ctrack", "unknown sensor 'ctrack'"),
        (
            "calibrate mine mine --board b --seed 0",
            "no random numbers without --render or --halves: leave out --seed",
        ),
        ("calibrate mine mine --render 3", "leave out LEFT and RIGHT"),
        (
            "calibrate --render 1 --min-images 7 --fix-aspect",
            "nothing: leave out --fix-aspect and --min-images",
        ),
        ("workspace --out mine", "mine is not empty"),
        ("workspace --out mine/text/here", "cannot write mine/text/here: Not a directory"),
        ("verify-model --out /proc/impossible", "cannot write /proc/impossible"),
        ("verify-model --out new", "pip install '.[mujoco]'"),
        ("verify-model nope", "unknown robot `nope`"),
        (
            "export mjcf rss6",
            "crank1, crank2, crank3, crank4, crank5, crank6: Izz 0.000605 > Ixx 0.000229 + ",
        ),
        (
            "export mjcf rss6 --parameters ''",
            "'' is neither a parameter set of robot rss6 (guess, truth",
        ),
        ("export mjcf rss6 --allow-unphysical-inertia --out .", "cannot write ."),
        ("study no_such_study", "pixel_noise"),
    ],
)
def test_bad_input_is_one_line_before_any_work_and_leaves_nothing(
    calls, capfd, tmp_path, monkeypatch, words, evidence
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    work = (
        "identify.verification.acceptance.run_tests",
        "identify.verification.workspace_map.map_workspace",
    )
    for name in (
        *work,
        "cmmsim.detector_leaderboard.compete",
        "cmmsim.calibration.sightings.find_board",
    ):
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("has begun"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "text").touch()
    (tmp_path / "mine" / "board.toml").write_text(
        'kind = "chessboard"\ncolumns = 7\nrows = 6\nspacing = 0.07\n'
    )
    assert command(*shlex.split(words), "--quiet") == 1
    assert evidence in one_line(capfd.readouterr().err)
    assert calls == []
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["board.toml", "mine", "text"]


def test_known_errors_of_every_package_are_one_line_and_others_keep_their_traceback(
    capfd, monkeypatch, tmp_path
):
    def fail(*_):
        raise errors.pop(0)

    errors = [
        RecordError("a\nb"),
        RobotFileError("a\nb"),
        OpenGLMissingError(ImportError("a\nb")),
        ZeroDivisionError(),
    ]
    monkeypatch.setattr(
        command_line, "_pipeline", lambda: SimpleNamespace(run=fail, is_begun=lambda *_: False)
    )
    words = ("run", "quick", "--out", tmp_path / "new", "--quiet")
    for _ in errors[:3]:
        assert command(*words) == 1
        assert "a b" in one_line(capfd.readouterr().err)
    with pytest.raises(ZeroDivisionError):
        command(*words)


def test_settings_are_toml_or_text_behind_a_key():
    texts = ["30", "0.5", "true", "planes", '"30"', "a=b", ""]
    parsed = parse_settings([f"x{number}={text}" for number, text in enumerate(texts)])
    assert [*parsed.values()] == [30, 0.5, True, "planes", "30", "a=b", ""]
    assert [*parsed] == [f"x{number}" for number in range(len(texts))]
    with pytest.raises(ScenarioError, match="KEY=VALUE"):
        parse_settings(["=30"])
    for text, remedy in (
        ("[26,", "a list needs its closing bracket ]"),
        ("{low = 1", "a table needs its closing bracket }"),
        ("[planes]", "put texts within it in double quotes"),
    ):
        with pytest.raises(ScenarioError, match=re.escape(remedy)):
            parse_settings([f"x={text}"])


@pytest.mark.slow
def test_the_command_starts_in_a_process_of_its_own_and_waits_for_nothing_heavy():
    heavy = "casadi", "cv2", "matplotlib", "numba", "pandas", "scipy.optimize"
    loaded = f"import identify.commands.app, sys; print(sorted(set({heavy}) & sys.modules.keys()))"
    for words, shown in ((["-m", "identify", "--version"], "cmmsim 0."), (["-c", loaded], "[]\n")):
        made = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True)
        assert made.stdout.startswith(shown)


def shown(terminal, fail=False, rate=""):
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, width=100)
    with suppress(RuntimeError), RichProgress(console, rate).stage("record", 4) as advance:
        advance()
        advance(n=2)
        if fail:
            raise RuntimeError("camera unplugged")
    return stream.getvalue()


def test_a_terminal_shows_a_bar_and_a_file_one_plain_line_a_stage_that_did_not_fail():
    bar, line = shown(terminal=True), shown(terminal=False)
    assert "3/4" in bar
    assert "left" in bar
    assert line.startswith("record: 3 of 4 in ")
    assert line.count("\n") == 1
    assert "\x1b" not in line
    assert shown(terminal=False, fail=True) == ""
    assert [" rows/s" in shown(terminal, rate="rows/s") for terminal in (True, False)] == [
        True,
        True,
    ]
    assert "/s" not in bar + line


@pytest.mark.parametrize("rate", ["", "rows/s"])
def test_a_long_stage_says_now_and_then_where_it_is_also_in_a_file(monkeypatch, rate):
    monkeypatch.setattr("identify.progress.LINE_S", 0.0)
    lines = [line[:14] for line in shown(terminal=False, rate=rate).splitlines()]
    assert lines == ["record: 1 of 4", *2 * ["record: 3 of 4"]]


def test_words_stand_left_numbers_right_brackets_stay_and_the_first_column_is_never_broken(capsys):
    rows = [
        ("joint1.coulomb", "0.12", "fixed"),
        ("lp [a]", "-1234.5", "from the [red]prior[/red] :smile:"),
    ]
    print_table(
        ("parameter", "std [um]", "remark"), rows, ("parameter", "remark"), "of [x]", "std of [y]"
    )
    title, header, rule, first, second, note = [
        line.rstrip() for line in capsys.readouterr().out.splitlines()
    ]
    assert (title.strip(), note.strip(), set(rule)) == ("of [x]", "std of [y]", {"─"})
    assert header == "parameter      std [um] remark"
    assert first == "joint1.coulomb     0.12 fixed"
    assert second == "lp [a]          -1234.5 from the [red]prior[/red] :smile:"
    print_table(
        ("study", "what it asks"), [("n" * 30, "how long " * 20)], ("study", "what it asks")
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("n" * 30 + " how long")
    assert max(map(len, lines)) <= 80
    assert len(lines) > 5


def test_a_narrow_terminal_folds_words_and_cuts_neither_numbers_nor_names(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    name = "noise of the poses in the servo"
    row = (name, "1.56e-05 ± 2.1e-07", "-0.0093", "joint6.viscous")
    print_table(("source", "size", "share\n%", "most in"), [row], ("source", "size", "most in"))
    out = capsys.readouterr().out
    words = out.split()
    assert {"1.56e-05", "2.1e-07", "-0.0093", "joint6.viscous", *name.split()} <= set(words)
    assert "…" not in out
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 40
    # Twelve numbers need more letters than the terminal has.
    numbers = [f"{k}.23456e-07" for k in range(12)]
    print_table([f"column{k}" for k in range(12)], [numbers], ())
    assert set(numbers) <= set(capsys.readouterr().out.split())
