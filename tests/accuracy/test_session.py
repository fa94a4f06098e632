"""The end of a session: the table, saved figures, and what got worse than they were."""

import json

import numpy as np
import pytest

from identify.accuracy.__main__ import main

pytest_plugins = "pytester"

FIGURES = """
def test_sensor(accuracy):
    accuracy.record("bias", {bias}, unit="px", limit=0.003)
    accuracy.record("seen", 0.98, limit=0.95, better="higher")

@pytest.mark.parametrize("method", ["planes", "registration"])
def test_pose(accuracy, method):
    accuracy.sample("pose", {mean} + RNG.normal(0, 1, 50), unit="um")
"""
START = FIGURES.format(bias=0.002, mean=10)


def table(result):
    """Lines of the table of figures."""
    lines = result.outlines
    start = next(i for i, line in enumerate(lines) if line.strip("=") == " accuracy ")
    ends = ("=", "saved", "not saved", "worse", "[")
    return [line for line in lines[start + 1 :] if line and not line.startswith(ends) and " passed" not in line]


def test_the_table_shows_value_interval_unit_limit_and_margin(project):
    done = project(START)
    values = 10 + np.random.default_rng(0).normal(0, 1, 100)
    mean, reach = values[:50].mean(), 2.00958 * values[:50].std(ddof=1) / np.sqrt(50)  # Student, 49 degrees of freedom
    lines = [line.split() for line in table(done)]
    assert lines[0] == ["value", "95%", "interval", "unit", "limit", "margin"]
    assert lines[1] == ["test_mine.py::test_pose[planes]"]
    assert lines[2] == ["pose", f"{mean:.4g}", f"{mean - reach:.4g}", "..", f"{mean + reach:.4g}", "um"]
    assert lines[3] == ["test_mine.py::test_pose[registration]"]
    assert lines[5] == ["test_mine.py::test_sensor"]
    assert lines[6] == ["bias", "0.002", "px", "≤", "0.003", "33%"]
    assert lines[7] == ["seen", "0.98", "≥", "0.95", "3%"]


def test_a_session_without_figures_has_no_table(project):
    done = project("def test_nothing(): pass")
    done.assert_outcomes(passed=1)
    assert "accuracy" not in done.stdout.str()


def test_figures_of_setup_and_of_failed_tests_are_shown(project):
    done = project(
        """
        @pytest.fixture
        def prepared(accuracy):
            accuracy.record("in setup", 1.0, limit=2.0)
            yield
            accuracy.record("in teardown", 1.0)

        def test_it(prepared, accuracy):
            accuracy.record("in the test", 3.0, limit=2.0)
        """
    )
    assert [line.split()[:2] for line in table(done)][2:5] == [["in", "setup"], ["in", "the"], ["in", "teardown"]]
    assert [line for line in table(done) if "FAILED" in line and "in the test" in line]


def test_saved_figures_are_json_that_says_where_they_come_from(project, pytester):
    project(START, "--accuracy-save", "before", "--accuracy-seed", "3").assert_outcomes(passed=3)
    saved = json.loads((pytester.path / ".accuracy" / "before.json").read_text())
    assert (saved["format"], saved["schema"], saved["name"], saved["seed"]) == ("cmmsim accuracy", 1, "before", 3)
    assert {"cmmsim", "numpy", "python"} <= set(saved["versions"])
    assert set(saved["machine"]) == {"system", "processor", "cores"}
    first, _, bias, _ = saved["figures"]
    assert bias == {
        "test": "test_mine.py::test_sensor", "name": "bias", "value": 0.002, "unit": "px", "better": "lower",
        "limit": 0.003, "interval": None, "count": 1,
    }  # fmt: skip
    assert first["count"] == 50
    assert first["interval"][0] < first["value"] < first["interval"][1]


def test_the_table_compares_with_saved_figures(project):
    project(START, "--accuracy-save", "before")
    again = project(FIGURES.format(bias=0.0025, mean=10), "--accuracy-compare", "before")
    again.assert_outcomes(passed=3)
    lines = [line.split() for line in table(again)]
    assert lines[0][-2:] == ["before", "change"]
    assert lines[6][-2:] == ["0.002", "+25.0%"]
    assert lines[7][-2:] == ["0.98", "+0.0%"]


def test_new_and_missing_figures_are_told(project):
    project(START, "--accuracy-save", "before")
    again = project("def test_new(accuracy): accuracy.record('new', 1.0)", "--accuracy-compare", "before")
    assert [line for line in again.outlines if line.startswith("  new") and line.endswith("  new")]
    again.stdout.fnmatch_lines(["4 of 4 figures saved as before were not measured now:"])


def test_another_seed_is_told(project):
    project(START, "--accuracy-save", "before")
    again = project(START, "--accuracy-compare", "before", "--accuracy-seed", "7")
    again.stdout.fnmatch_lines(["before was saved with --accuracy-seed 0, this is 7"])


@pytest.mark.parametrize(
    ("bias", "mean", "ratio", "exit_status"),
    [
        (0.002, 10, "0", 0),
        (0.00215, 10, "0.1", 0),
        (0.00225, 10, "0.1", 1),
        (0.001, 5, "0", 0),  # better
        (0.002, 10.3, "0", 0),  # a shift of two standard errors of the difference is noise: the intervals overlap
        (0.002, 11.5, "0", 1),
        (0.002, 11.5, "0.2", 0),
    ],
)
def test_the_session_fails_when_a_figure_got_worse_by_more_than_the_ratio(project, bias, mean, ratio, exit_status):
    project(START, "--accuracy-save", "before")
    again = project(FIGURES.format(bias=bias, mean=mean), "--accuracy-compare", "before", "--accuracy-fail", ratio)
    again.assert_outcomes(passed=3)
    assert again.ret == exit_status
    assert bool([line for line in again.outlines if line.startswith("worse by more than")]) == bool(exit_status)


@pytest.mark.parametrize(
    ("better", "value", "worse"), [("higher", 0.8, True), ("higher", 1.2, False), ("lower", 1e-9, True)]
)
def test_worse_is_what_the_figure_says(project, better, value, worse):
    """A value of 0 that was exact gets worse by any step: the ratio of nothing is nothing."""
    body = "def test_it(accuracy): accuracy.record('x', {}, better={!r})"
    project(body.format(1.0 if better == "higher" else 0.0, better), "--accuracy-save", "before")
    again = project(body.format(value, better), "--accuracy-compare", "before", "--accuracy-fail", "0.1")
    assert again.ret == int(worse)


def test_figures_in_another_unit_are_not_compared(project):
    project("def test_it(accuracy): accuracy.record('x', 1.0, unit='mm')", "--accuracy-save", "before")
    other = "def test_it(accuracy): accuracy.record('x', 1000.0, unit='um')"
    assert project(other, "--accuracy-compare", "before").ret == 0
    guarded = project(other, "--accuracy-compare", "before", "--accuracy-fail", "0.1")
    assert guarded.ret == 1
    guarded.stdout.fnmatch_lines(["*::test_it: x cannot be compared: unit is 'um', was 'mm'"])


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("def test_bad(): assert False", "no figures were recorded"),
        ("def test_it(accuracy): accuracy.record('x', 3, limit=2)", "the session did not pass"),
    ],
)
def test_a_session_that_fails_saves_nothing(project, pytester, body, why):
    project(START, "--accuracy-save", "before")
    whole = (pytester.path / ".accuracy" / "before.json").read_bytes()
    done = project(body, "--accuracy-save", "before")
    done.stdout.fnmatch_lines([f"not saved as before: {why}"])
    assert (pytester.path / ".accuracy" / "before.json").read_bytes() == whole


def test_an_interrupted_session_saves_nothing(project, pytester):
    done = project(START + "\ndef test_z(): pytest.exit('enough')", "--accuracy-save", "before")
    done.stdout.fnmatch_lines(["not saved as before: the session did not pass"])
    assert not (pytester.path / ".accuracy").exists()


def test_the_folder_can_be_chosen(project, pytester):
    project(START, "--accuracy-save", "before", "--accuracy-dir", "kept/figures").assert_outcomes(passed=3)
    assert [path.name for path in (pytester.path / "kept" / "figures").iterdir()] == ["before.json"]
    assert project(START, "--accuracy-compare", "before", "--accuracy-dir", "kept/figures").ret == 0


def test_saved_figures_become_a_markdown_table(project, pytester, capsys):
    project(START, "--accuracy-save", "before")
    capsys.readouterr()
    assert main([str(pytester.path / ".accuracy" / "before.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [
        "| figure | value | 95% interval | unit | limit | margin |",
        "| --- | --: | --: | --- | --: | --: |",
    ]
    assert lines[2].startswith("| pose [planes] | ")
    assert lines[4] == "| bias | 0.002 |  | px | ≤ 0.003 | 33% |"
    assert main(["no.json"]) == "no.json cannot be read: No such file or directory"
    assert main([str(pytester.path)]).endswith(" cannot be read: Is a directory")
    assert main([]).startswith("usage: ")


def test_junit_reports_carry_the_figures(project, pytester):
    project(START, "--junit-xml", "report.xml")
    assert (pytester.path / "report.xml").read_text().count('name="cmmsim_accuracy"') == 4


def test_a_users_own_property_of_that_name_is_left_alone(project):
    done = project("def test_it(record_property): record_property('accuracy', 0.93)")
    done.assert_outcomes(passed=1)
    assert done.ret == 0


def test_it_lives_beside_pytest_benchmark(project, pytester):
    done = project(
        """
        def test_both(accuracy, benchmark):
            accuracy.record("sum", benchmark(sum, [1.0, 2.0]), limit=3.0)
        """,
        "--benchmark-min-rounds=1",
        "--benchmark-max-time=0.01",
        "--accuracy-save=now",
    )
    done.assert_outcomes(passed=1)
    done.stdout.fnmatch_lines(["  sum *3*≤ 3*", "*benchmark: 1 tests*"])
    assert (pytester.path / ".accuracy" / "now.json").exists()


@pytest.mark.slow
def test_with_xdist_the_table_and_the_file_are_the_same(project, pytester):
    body = FIGURES.format(bias=0.002, mean=10).replace("RNG", "np.random.default_rng(5)") + (
        "\n@pytest.mark.xdist_group('one')\n"
        "@pytest.mark.parametrize('number', range(20))\n"
        "def test_many(accuracy, cmmsim_seed, number): accuracy.record('seed', cmmsim_seed)\n"
    )
    plain = project(body, "--accuracy-save", "plain")
    for distribution in ("load", "loadgroup"):
        spread = project(body, "-n", "2", "--dist", distribution, "--accuracy-save", distribution)
        spread.assert_outcomes(passed=23)
        assert table(spread)[: len(table(plain))] == table(plain)
        files = [pytester.path / ".accuracy" / f"{name}.json" for name in ("plain", distribution)]
        one, two = (json.loads(file.read_text()) for file in files)
        assert len(one["figures"]) == 24
        assert one["figures"] == two["figures"]
    worse = body.replace("0.002", "0.0029")
    assert project(worse, "-n", "2", "--accuracy-compare", "plain", "--accuracy-fail", "0.1").ret == 1
