"""The end of a session: the table and saved figures; and what is refused before it begins."""

import contextlib
import json
import re
import textwrap

import numpy as np
import pytest

from identify.accuracy.__main__ import main
from identify.accuracy.figure import Accuracy
from tests.accuracy.conftest import COMPARE, FIGURES, QUICK, SAVE


def table(result):
    """Lines of the table of figures."""
    lines = result.outlines
    start = next(i for i, line in enumerate(lines) if line.strip("=") == " accuracy ")
    ends = ("=", "saved", "not saved", "worse", "[")
    return [
        line
        for line in lines[start + 1 :]
        if line and not line.startswith(ends) and " passed" not in line
    ]


def test_the_table_shows_value_interval_unit_limit_and_margin(project):
    lines = [line.split() for line in table(project(FIGURES))]
    values = 10 + np.random.default_rng(len("planes")).normal(0, 1, 50)
    mean, reach = (
        values.mean(),
        2.00958 * values.std(ddof=1) / np.sqrt(50),
    )  # Student, 49 degrees of freedom
    assert lines[0] == ["value", "95%", "interval", "n", "unit", "limit", "margin"]
    assert lines[1] == ["test_mine.py::test_pose[planes]"]
    assert lines[2] == [
        "pose",
        f"{mean:.4g}",
        f"{mean - reach:.4g}",
        "..",
        f"{mean + reach:.4g}",
        "50",
        "um",
    ]
    assert lines[3] == ["test_mine.py::test_pose[registration]"]
    assert lines[5] == ["test_mine.py::test_sensor"]
    assert lines[6] == ["bias", "0.002", "px", "≤", "0.003", "33%"]
    assert lines[7] == ["seen", "0.98", "≥", "0.95", "3%"]


def test_figures_of_setup_and_of_failed_tests_are_shown_and_without_figures_there_is_no_table(
    project,
):
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
    assert [line.split()[:2] for line in table(done)][2:5] == [
        ["in", "setup"],
        ["in", "the"],
        ["in", "teardown"],
    ]
    assert [line for line in table(done) if "FAILED" in line and "in the test" in line]
    plain = project("def test_it(record_property): record_property('accuracy', 0.93)")
    plain.assert_outcomes(passed=1)
    assert "accuracy" not in plain.stdout.str(), "a user's own property of that name is left alone"


def test_a_sample_whose_interval_holds_the_limit_is_undecided(project):
    done = project(
        """
        def test_it(accuracy):
            accuracy.sample("wide", [100, 300], limit=2)
            accuracy.sample("good", [1.0, 1.1], limit=3)
            accuracy.sample("few seen", [0.8, 0.9], limit=0.95, better="higher")
            accuracy.sample("seen", [0.98, 0.98], limit=0.95, better="higher")
            accuracy.sample("open", [1, 9])
            accuracy.record("value", 1, limit=2)
        """
    )
    done.assert_outcomes(passed=1)
    ends = {
        line[2:10].strip(): line.rpartition("  ")[2]
        for line in done.outlines
        if line.startswith("  ")
    }
    assert ends["wide"] == "-9900% undecided"
    assert ends["few seen"] == "-11% undecided"
    assert not [name for name in ("good", "seen", "open", "value") if "undecided" in ends[name]]
    # By Student's 12.706: 2 (12.706 100 / 198)^2 and 2 (12.706 0.05 / 0.1)^2 values.
    done.stdout.fnmatch_lines(
        [
            "undecided: wide: *-1071 .. 1471 of 2 values contains the limit 2; about 82 values or fewer*",
            "undecided: few seen: *; about 81 values or fewer decide it*sample_until*",
        ]
    )


def test_values_are_drawn_until_the_limit_is_decided_or_there_are_enough(project):
    done = project(
        """
        def values(mean):
            drawn = []
            def draw(n):
                drawn.append(n)
                return mean + 0.1 * RNG.standard_normal(n)
            return drawn, draw

        def test_it(accuracy):
            for name, mean, most in (("far", 0, 640), ("near", 0.95, 640), ("at", 1, 100)):
                drawn, draw = values(mean)
                accuracy.sample_until(name, draw, limit=1.0, most=most)
                print(name, drawn)

        def test_beyond(accuracy):
            accuracy.sample_until("over", values(1.03)[1], limit=1.0)

        def test_few(accuracy):
            accuracy.sample_until("few", lambda n: [1.0, 2.0], limit=1.0)
        """,
        "-s",
    )
    done.assert_outcomes(passed=1, failed=2)
    text = done.stdout.str()
    counts = {
        name: [int(one) for one in found.split(", ")]
        for name, found in re.findall(r"(far|near|at) \[([\d, ]+)\]", text)
    }
    assert counts["far"] == [20]
    assert sum(counts["near"]) < 640
    assert counts["at"] == [20, 20, 40, 20]
    assert re.search(r"^  at .* undecided$", text, re.MULTILINE)
    assert re.search("over: mean .* lies wholly above the limit", text)
    assert "few: draw(20) returned 2 values" in text


def test_intervals_of_values_that_are_drawn_until_decided_contain_the_mean():
    """With a limit at the mean itself, every look could decide wrongly: 5 % of 1000 may."""
    rng, missed = np.random.default_rng(5), 0
    for _ in range(1000):
        kept = []
        recorder = Accuracy("test", kept)
        with contextlib.suppress(pytest.fail.Exception):
            recorder.sample_until("x", lambda n: rng.standard_normal(n), limit=0.0, most=160)
        low, high = kept[0][1]["interval"]
        missed += not low <= 0.0 <= high
    assert missed <= 66  # 50 + 2.3 standard deviations


def test_figures_are_kept_by_test_and_not_by_folder(pytester):
    body = """
    def test_it(accuracy, cmmsim_seed):
        accuracy.record("seed", cmmsim_seed)
    """
    kept = ("--accuracy-dir", str(pytester.path / "kept"))
    for name in ("one", "two"):
        pytester.mkdir(name)
        (pytester.path / name / "test_same.py").write_text(textwrap.dedent(body))
    whole = pytester.runpytest_inprocess(*QUICK, "one", *SAVE, *kept)
    whole.assert_outcomes(passed=1)
    pytester.chdir()
    for folder in ("one", "two"):
        done = pytester.runpytest_inprocess(
            *QUICK, f"--rootdir={folder}", folder, *COMPARE, "--accuracy-fail", "0", *kept
        )
        assert done.ret == 0
        assert [line.split()[-1] for line in table(done)][2:] == ["+0.0%"]
    both = pytester.runpytest_inprocess(*QUICK, "--import-mode=importlib", "one", "two", *kept)
    assert both.ret == 1
    both.stdout.fnmatch_lines(["*have the same name test_same.py::test_it, and only one of them*"])


def test_saved_figures_are_json_that_says_where_they_come_from_and_become_a_markdown_table(
    project, saved, capsys
):
    project(FIGURES, *SAVE, "--accuracy-seed", "3", "--junit-xml", "report.xml").assert_outcomes(
        passed=3
    )
    content = json.loads(saved.read_text())
    said = {"format": "cmmsim accuracy", "schema": 1, "name": "before", "seed": 3}
    assert {name: content[name] for name in said} == said
    assert {"cmmsim", "numpy", "python"} <= set(content["versions"])
    assert set(content["machine"]) == {"system", "processor", "cores"}
    first, _, bias, _ = content["figures"]
    assert bias == {
        "test": "test_mine.py::test_sensor", "name": "bias", "value": 0.002, "unit": "px", "better": "lower",
        "limit": 0.003, "interval": None, "count": 1,
    }  # fmt: skip
    assert first["count"] == 50
    assert first["interval"][0] < first["value"] < first["interval"][1]
    assert (saved.parents[1] / "report.xml").read_text().count('name="cmmsim_accuracy"') == 4
    capsys.readouterr()
    assert main([str(saved)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| test | figure | value | 95% interval | n | unit | limit | margin |"
    assert lines[1] == "| --- | --- | --: | --: | --: | --- | --: | --: |"
    assert lines[2].startswith("| test_mine.py::test_pose[planes] | pose | ")
    assert lines[4] == "| test_mine.py::test_sensor | bias | 0.002 |  |  | px | ≤ 0.003 | 33% |"
    assert main(["no.json"]) == "no.json cannot be read: No such file or directory"
    assert main([str(saved.parent)]).endswith(" cannot be read: Is a directory")
    assert main([]).startswith("usage: ")


BEYOND = """
@pytest.mark.xfail(strict={})
def test_bad(accuracy): accuracy.record("r", 10, limit=2)

def test_good(accuracy): accuracy.record("s", 1, limit=2)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("def test_bad(): assert False", "no figures were recorded"),
        ("def test_it(accuracy): accuracy.record('x', 3, limit=2)", "the session did not pass"),
        (FIGURES + "\ndef test_z(): pytest.exit('enough')", "the session did not pass"),
        (BEYOND.format(True), "beyond their limits are test_mine.py::test_bad: r"),
        (BEYOND.format(False), "beyond their limits are test_mine.py::test_bad: r"),
    ],
    ids=["none", "failed", "interrupted", "expected to fail", "allowed to fail"],
)
def test_a_session_that_fails_or_has_a_figure_beyond_its_limit_saves_nothing(
    project, saved, body, why
):
    done = project(body, *SAVE)
    assert done.ret != 0
    done.stdout.fnmatch_lines([f"not saved as before: {why}"])
    assert not saved.parent.exists()
    project(FIGURES, *SAVE)
    whole = saved.read_bytes()
    project(body, *SAVE).stdout.fnmatch_lines([f"not saved as before: {why}"])
    assert saved.read_bytes() == whole


def test_saving_never_loses_the_figures_of_another_session(project, saved):
    project(FIGURES, *SAVE)
    whole = saved.read_bytes()
    done = project(FIGURES, *SAVE, "-k", "planes")
    assert done.ret == 1
    done.stdout.fnmatch_lines(
        [
            "not saved as before: *before.json holds figures that were not measured now "
            "(*::test_pose[[]registration]: "
            "pose; *::test_sensor: bias, seen); use another name, or remove that file"
        ]
    )
    assert saved.read_bytes() == whole
    more = (
        FIGURES.replace("0.002", "0.001")
        + "\ndef test_new(accuracy): accuracy.record('new', 1.0)\n"
    )
    assert project(more, *SAVE).ret == 0
    names = [
        (figure["name"], figure["value"]) for figure in json.loads(saved.read_text())["figures"]
    ]
    assert {("bias", 0.001), ("seen", 0.98), ("new", 1.0)} < set(names)


def test_the_folder_can_be_chosen_and_one_that_is_lost_meanwhile_fails_the_session_in_one_line(
    project, pytester
):
    project(FIGURES, *SAVE, "--accuracy-dir", "kept/figures").assert_outcomes(passed=3)
    assert [path.name for path in (pytester.path / "kept" / "figures").iterdir()] == ["before.json"]
    assert project(FIGURES, *COMPARE, "--accuracy-dir", "kept/figures").ret == 0
    done = project(FIGURES + "\ndef test_z(): open('.accuracy', 'w').close()", *SAVE)
    assert done.ret == 1
    done.stdout.fnmatch_lines(["cannot write *.accuracy/before.json: *"])


def test_it_lives_beside_pytest_benchmark(project, pytester):
    body = (
        "def test_both(accuracy, benchmark): accuracy.record('sum', benchmark(sum, [1.0, "
        "2.0]), limit=3.0)"
    )
    done = project(
        body, "--benchmark-min-rounds=1", "--benchmark-max-time=0.01", "--accuracy-save=now"
    )
    done.assert_outcomes(passed=1)
    done.stdout.fnmatch_lines(["  sum *3*≤ 3*", "*benchmark: 1 tests*"])
    assert (pytester.path / ".accuracy" / "now.json").exists()


@pytest.mark.thorough
def test_with_xdist_the_table_and_the_file_are_the_same(project, pytester):
    body = FIGURES + (
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
    assert (
        project(worse, "-n", "2", "--accuracy-compare", "plain", "--accuracy-fail", "0.1").ret == 1
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            ["--accuracy-compare", "befor"],
            "no accuracy figures are saved as 'befor' in *.accuracy; saved are: before",
        ),
        (
            ["--accuracy-save", "../x"],
            "'../x' is not a valid name for saved figures: use up to 100 letters, digits, *",
        ),
        (
            ["--accuracy-save", "full.json"],
            "'full.json' is not a valid name for saved figures: use 'full', *",
        ),
        (
            ["--accuracy-save", "x", "--accuracy-dir", "/proc/none"],
            "/proc/none/x.json cannot be written: *",
        ),
        (
            ["--accuracy-fail", "0.1"],
            "--accuracy-fail needs --accuracy-compare NAME, the saved figures to compare with",
        ),
        (
            ["--accuracy-fail", "-1"],
            "*argument --accuracy-fail: RATIO is -1, must be 0 or more, such as 0.1 for 10 %",
        ),
        (["--accuracy-seed", "-1"], "*argument --accuracy-seed: the seed is -1, must be 0 or more"),
    ],
)
def test_wrong_options_are_refused_before_any_test(project, saved, options, says):
    saved.parent.mkdir()
    saved.touch()
    done = project(FIGURES, *options)
    assert done.ret == pytest.ExitCode.USAGE_ERROR
    done.stderr.fnmatch_lines([says if says.startswith("*") else f"ERROR: {says}"])


SAVED = '{"format": "cmmsim accuracy", "schema": 1, "name": "x", "seed": 0'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "cannot be read as JSON: *"),
        ("[1]", "holds no accuracy figures (no entry format = 'cmmsim accuracy')"),
        (SAVED.replace("1", "2") + "}", "has schema 2, but this version reads 1"),
        (SAVED + "}", "figures: Field required *"),
        (
            SAVED + ', "figures": [{"test": "t", "name": "n", "value": NaN, "unit": "", "better": '
            '"lower"}]}',
            "figures.0.value: Input should be a finite number (got nan)",
        ),
    ],
)
def test_a_file_that_is_none_is_one_line_and_is_not_replaced(project, saved, text, says):
    saved.parent.mkdir()
    saved.write_text(text)
    for options in (COMPARE, SAVE):
        done = project(FIGURES, *options)
        assert done.ret == pytest.ExitCode.USAGE_ERROR
        done.stderr.fnmatch_lines([f"ERROR: *before.json*{says.replace('[', '[[]')}"])
    assert saved.read_text() == text
