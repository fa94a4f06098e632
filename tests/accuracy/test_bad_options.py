"""What could not work at the end is refused before any test, in one line: options, folders and files of figures."""

import pytest

from tests.accuracy.test_session import START

pytest_plugins = "pytester"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--accuracy-compare", "befor"], "no accuracy figures are saved as 'befor' in *.accuracy; saved are: before"),
        (["--accuracy-save", "../x"], "'../x' is no name for saved figures: up to 100 letters, digits, *"),
        (["--accuracy-save", "x" * 300], "'xxx*' is no name for saved figures: up to 100 letters, digits, *"),
        (["--accuracy-save", "full.json"], "'full.json' is no name for saved figures: 'full' makes that file"),
        (["--accuracy-save", "x", "--accuracy-dir", "test_mine.py"], "/*/x.json cannot be written: Not a directory"),
        (["--accuracy-save", "x", "--accuracy-dir", "/proc/none"], "/proc/none/x.json cannot be written: *"),
        (["--accuracy-save", "x", "--accuracy-dir", "y" * 300], "/*/x.json cannot be written: File name too long"),
        (["--accuracy-fail", "0.1"], "--accuracy-fail needs --accuracy-compare NAME: worse than what?"),
        (["--accuracy-fail", "-1"], "*argument --accuracy-fail: RATIO is -1, must be 0 or more, such as 0.1 for 10 %"),
        (["--accuracy-fail", "ten"], "*argument --accuracy-fail: invalid ratio value: 'ten'"),
        (["--accuracy-seed", "-1"], "*argument --accuracy-seed: the seed is -1, must be 0 or more"),
    ],
)
def test_wrong_options_are_refused_before_any_test(project, options, says):
    project(START, "--accuracy-save", "before")
    done = project(START, *options)
    assert done.ret == pytest.ExitCode.USAGE_ERROR
    done.stderr.fnmatch_lines([says if says.startswith("*") else f"ERROR: {says}"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "cannot be read as JSON: *"),
        ("[1]", "holds no accuracy figures (no entry format = 'cmmsim accuracy')"),
        ('{"benchmarks": []}', "holds no accuracy figures (no entry format = 'cmmsim accuracy')"),
        ('{"format": "cmmsim accuracy", "schema": 2}', "has schema 2, this version reads 1"),
        ('{"format": "cmmsim accuracy", "schema": 1, "name": "x", "seed": 0}', "figures: Field required *"),
        (
            '{"format": "cmmsim accuracy", "schema": 1, "name": "x", "seed": 0, "figures": [{"test": "t", "name": "n", '
            '"value": NaN, "unit": "", "better": "lower"}]}',
            "figures.0.value: Input should be a finite number (got nan)",
        ),
    ],
)
def test_a_file_that_is_none_is_one_line_and_is_not_replaced(project, pytester, text, says):
    path = pytester.path / ".accuracy" / "before.json"
    path.parent.mkdir()
    path.write_text(text)
    for option in ("--accuracy-compare", "--accuracy-save"):
        done = project(START, option, "before")
        assert done.ret == pytest.ExitCode.USAGE_ERROR
        done.stderr.fnmatch_lines([f"ERROR: *before.json*{says.replace('[', '[[]')}"])
    assert path.read_text() == text


def test_a_folder_that_is_lost_meanwhile_fails_the_session_in_one_line(project, pytester):
    done = project(START + "\ndef test_z(): open('.accuracy', 'w').close()", "--accuracy-save", "before")
    assert done.ret == 1
    done.stdout.fnmatch_lines(["*.accuracy/before.json cannot be written: *"])
