"""The README is true: its figures are those of the run it quotes, its commands and files exist."""

import re
from pathlib import Path

import pytest

from identify.command_line import app
from identify.goals import check_goals
from identify.result_file import load_result
from identify.tables import excitation_error_table, goals_table

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def result():
    return load_result(ROOT / ".readme" / "result.json")


def test_the_tables_are_those_of_the_quoted_run(result):
    assert goals_table(result).markdown().strip() in README
    assert excitation_error_table(result).markdown().strip() in README


def test_the_quoted_run_is_the_paper_scenario_and_meets_every_goal(result):
    assert result["scenario"] == "paper"
    assert len(result["validation"]) == 10
    assert [goal for goal in check_goals(result) if not goal.passed] == []


def test_every_linked_file_exists():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target


def test_every_command_it_names_exists():
    commands = {command.name or command.callback.__name__ for command in app.registered_commands}
    groups = {group.name for group in app.registered_groups}
    for name in set(re.findall(r"cmmsim ([a-z][a-z-]+)", README)):
        assert name in commands | groups, name


def test_ci_calls_the_test_command_of_the_readme():
    command = 'sh .ci/setup && .venv/bin/pytest -m "slow or not slow"'
    assert command in README
    assert command in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
