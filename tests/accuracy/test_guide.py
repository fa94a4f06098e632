"""The text of the guide is true: its options, files and fixtures exist, and its example runs."""

import re
from pathlib import Path

import pytest

pytest_plugins = "pytester"

GUIDE = Path(__file__).parent / "guide"
TEXT = (GUIDE / "README.md").read_text(encoding="utf-8")


def test_it_names_every_option_and_no_other(pytestconfig):
    named = set(re.findall(r"--accuracy-[a-z]+", TEXT))
    known = {name for name in dir(pytestconfig.option) if name.startswith("accuracy_")}
    assert {name[2:].replace("-", "_") for name in named} | {"accuracy_robot", "accuracy_scenario"} == known
    assert "likewise for `robot` and `scenario`" in TEXT


def test_it_names_every_file_of_the_guide():
    assert set(re.findall(r"\]\(([^)]+)\)", TEXT)) == {path.name for path in GUIDE.glob("test_*.py")}


@pytest.mark.slow
@pytest.mark.rendering
def test_its_example_runs(pytester):
    pytester.makepyfile(test_mine=re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)[0])
    done = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    done.assert_outcomes(passed=1)
    done.stdout.fnmatch_lines(["*position error * um *20*", "*largest position error *um*"])
