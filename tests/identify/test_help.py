"""What a stranger reads first: the help of every command, what a shell completes, and figures for
scripts.
"""

import json
import os
import re
import subprocess
import sys

import pytest

from cmmsim.errors import CmmError
from dynamics import built_in_robots
from dynamics.errors import DynamicsError
from identify.commands.help import BEYOND_LIMIT, NOT_DONE, STATUSES
from identify.commands.options import BUILT_IN, built_in_names, completion
from identify.errors import IdentifyError
from identify.scenario import scenario_names
from identify.scenario.timing import sensor_names
from identify.studies.study_file import STUDIES
from identify.verification.finding import Finding
from tests.identify.commands import command, leaves, one_line

COMMANDS = sorted(leaves())


def help_of(words, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    assert command(*words, "--help") == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    return shown


def test_the_first_help_lists_every_command_in_a_group_before_anything_else_in_whole_sentences(
    monkeypatch, capsys
):
    shown = help_of((), monkeypatch, capsys)
    assert "..." not in shown.replace("[ARGS]...", "")
    listed, _, rest = shown.partition("\nExamples:\n")
    assert "\nOptions:\n" in rest
    assert "Further commands" not in shown
    entries = re.findall(r"^  (\w[\w-]*)  +(\S.*(?:\n {8,}.*)*)", listed, re.MULTILINE)
    assert {name for name, _ in entries} == {words[0] for words in COMMANDS}
    for name, sentence in entries:
        assert sentence.strip().endswith("."), name
        assert sentence[0].isupper(), name


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_each_help_says_what_is_read_and_written_shows_an_example_and_names_the_exit_statuses(
    words, monkeypatch, capsys
):
    shown = help_of(words, monkeypatch, capsys)
    assert "..." not in re.sub(r"[\[{][\w|]+[\]}]\.\.\.|: \.\.\.}", "", shown)
    assert re.search(r"\bReads\b", shown)
    assert re.search(r"\b[wW]rites\b", shown)
    examples = shown.partition("Example")[2]
    assert f"  cmmsim {' '.join(words)}" in examples
    assert re.findall(r"^  (\d+)  ", examples.partition("Exit status:")[2], re.MULTILINE)[:3] == [
        "0",
        "1",
        "2",
    ]


def test_a_limit_that_is_missed_and_a_command_that_cannot_be_done_have_statuses_of_their_own(
    tmp_path, capfd, monkeypatch
):
    assert len(STATUSES) == 6
    far = Finding("reach", False, None, "too far")
    monkeypatch.setattr("identify.verification.robot_check.check_robot", lambda *_: [far])
    assert command("check", "rss6", "--quiet") == BEYOND_LIMIT
    assert "1 of 1 findings about rss6 fail: reach: too far" in one_line(capfd.readouterr().err)
    assert command("check", "rss6") == BEYOND_LIMIT
    out, err = capfd.readouterr()
    assert "too far" in out
    assert err == "error: 1 of 1 findings about rss6 fail: reach\n"
    assert command("check", "none.toml") == NOT_DONE
    one_line(capfd.readouterr().err)


@pytest.mark.parametrize("quiet", [False, True])
@pytest.mark.slow
def test_json_goes_to_a_file_beside_the_table_or_to_standard_output_in_its_place(
    quiet, tmp_path, capfd
):
    more = ["--quiet"] * quiet
    assert command("base-parameters", "rrr3", "--json", tmp_path / "a.json", *more) == 0
    assert ("base parameters" in capfd.readouterr().out) != quiet
    assert command("base-parameters", "rrr3", "--json", "-", *more) == 0
    entry = json.loads(capfd.readouterr().out)
    assert entry == json.loads((tmp_path / "a.json").read_text())
    assert entry["rank"] == len(entry["groups"])
    assert command("base-parameters", "rrr3", "--json", tmp_path, "--quiet") == NOT_DONE
    assert "Is a directory; name another place" in one_line(capfd.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_completion_knows_the_names_that_the_readers_know_and_the_files_beside_them(
    tmp_path, monkeypatch
):
    known = {"robot": built_in_robots(), "sensor": sensor_names(), "scenario": scenario_names()}
    known["study"] = STUDIES.names()
    assert {kind: built_in_names(kind) for kind in BUILT_IN} == known
    monkeypatch.chdir(tmp_path)
    for name in ("mine.toml", "mine.txt", "minor/own.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert completion("robot")("r") == ["rrr3", "rss6", "rss6_coplanar", "rus6"]
    assert completion("robot")("mi") == ["mine.toml", "minor/"]
    assert completion("robot")("minor/") == ["minor/own.toml"]
    assert completion("robot")("none/x") == []


@pytest.mark.parametrize(
    ("words", "offered"),
    [("check ups", ["ups6"]), ("run qu", ["quick"]), ("acceptance ctrack780_", ["ctrack780_29hz"])],
)
@pytest.mark.slow
def test_a_shell_is_offered_names(words, offered):
    given = {
        "_CMMSIM_COMPLETE": "complete_bash",
        "COMP_WORDS": f"cmmsim {words}",
        "COMP_CWORD": "2",
    }
    start = [
        sys.executable,
        "-c",
        "from cmmsim.__main__ import main; import sys; sys.argv = ['cmmsim']; main()",
    ]
    made = subprocess.run(
        start, env=os.environ | given, capture_output=True, text=True, check=False
    )
    assert made.stdout.split() == offered, made.stderr


@pytest.mark.parametrize("kind", [IdentifyError, DynamicsError, CmmError])
def test_an_error_that_quotes_much_keeps_its_remedy(kind):
    said = str(kind(f"begins {'x' * 9000}; set plant.steps_per_frame = 9"))
    assert said.startswith("begins ")
    assert said.endswith("; set plant.steps_per_frame = 9")
    assert len(said) < 5000


def test_a_failed_check_is_told_with_its_remedy_and_without_its_lists(tmp_path, capfd, monkeypatch):
    text = f"the loop is unstable {'a' * 300}: set kp = 3"
    found = Finding("loop", False, None, text, listed="evidence")
    monkeypatch.setattr("identify.verification.robot_check.check_robot", lambda *_: [found])
    assert command("check", "rss6", "--quiet", "--json", tmp_path / "found.json") == BEYOND_LIMIT
    assert one_line(capfd.readouterr().err).rstrip().endswith(": set kp = 3")
    (entry,) = json.loads((tmp_path / "found.json").read_text())["findings"]
    assert entry["text"] == f"{text}: evidence"


ROW_TIME = "set sensor_changes.timing.row_time"


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("identify runs/x", "cmmsim identify --out runs/x"),
        ("record runs/x", "cmmsim record --out runs/x"),
        ("report", "cmmsim report --out FOLDER"),
        ("budget --out runs/x", "cmmsim budget FOLDER"),
        ("run quick --sensor x", "--set sensor=VALUE"),
        ("replay runs/x", "cmmsim run quick --out runs/x"),
        ("record --out runs/x", "cmmsim excite --out runs/x"),
        ("excite quick --set timing.row_time=1e-5", ROW_TIME),
        ("excite quick --set sensor.timing.row_time=1e-5", ROW_TIME),
    ],
)
def test_a_line_that_nearly_fits_is_refused_with_the_one_that_does(
    typed, said, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    assert command(*typed.split()) in (1, 2)
    assert capfd.readouterr().err.strip().endswith(said)
