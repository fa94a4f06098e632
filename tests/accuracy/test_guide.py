"""The guide is true: its options, files and fixtures exist, and its example and its complete files run elsewhere."""

import json
import re
import shutil
from pathlib import Path

import pytest

pytest_plugins = "pytester"

GUIDE = Path(__file__).parent / "guide"
FILES = sorted(GUIDE.glob("test_*.py"))
TEXT = (GUIDE / "README.md").read_text(encoding="utf-8")


def test_it_names_every_option_and_no_other(pytestconfig):
    named = set(re.findall(r"--accuracy-[a-z]+", TEXT))
    known = {name for name in dir(pytestconfig.option) if name.startswith("accuracy_")}
    assert {name[2:].replace("-", "_") for name in named} | {"accuracy_robot", "accuracy_scenario"} == known
    assert "likewise for `robot` and `scenario`" in TEXT


def test_it_names_every_file_of_the_guide():
    assert set(re.findall(r"\]\(([^)]+)\)", TEXT)) == {path.name for path in FILES}


@pytest.mark.slow
@pytest.mark.rendering
def test_its_example_and_its_complete_files_run(pytester):
    """In a folder and a home of their own. What the files test is held to limits that it meets and could miss."""
    pytester.makepyfile(test_example=re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)[0])
    for file in FILES:
        shutil.copy(file, pytester.path)
    done = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--strict-markers", "--accuracy-save", "mine")
    done.assert_outcomes(passed=1 + len(FILES))
    done.stdout.fnmatch_lines(["*position error * um *20*", "*largest position error *um*"])
    saved = json.loads((pytester.path / ".accuracy" / "mine.json").read_text())["figures"]
    for file in FILES:
        figures = [figure for figure in saved if figure["test"].startswith(f"{file.name}::")]
        assert len(figures) == 4
        held = [figure for figure in figures if figure["limit"] is not None]
        assert [figure["unit"] for figure in held] == ["um", "urad"]
        assert all(figure["limit"] / 10 < figure["value"] < figure["limit"] for figure in held), held
