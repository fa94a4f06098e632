"""Figures that are held to less than they were, or to nothing, are named: missing ones, other limits, wide samples."""

import json

import pytest

pytest_plugins = "pytester"

BEFORE = """
def test_sensor(accuracy):
    accuracy.record("bias", 0.002, unit="px", limit=0.003)
    accuracy.record("seen", 0.98, limit=0.95, better="higher")

@pytest.mark.parametrize("method", ["planes", "registration"])
def test_pose(accuracy, method):
    accuracy.record("pose", 10.0, unit="um")
"""
FEWER = BEFORE.replace('    accuracy.record("seen", 0.98', '    dict(name="seen", value=0.98')
SKIPPED = BEFORE.replace("accuracy, method):", "accuracy, method):\n    if method == 'planes': pytest.skip('none')")
MODULE = "pytest.skip('no library', allow_module_level=True)\n" + BEFORE
RENAMED = BEFORE.replace("test_sensor", "test_other")
SAVE, COMPARE = ("--accuracy-save", "before"), ("--accuracy-compare", "before")


@pytest.mark.parametrize("workers", [(), pytest.param(("-n", "1", "--dist", "loadgroup"), marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("body", "options", "missing", "guarded"),
    [
        (SKIPPED, (), ["test_pose[planes]: pose (the test was skipped)"], 1),
        (FEWER, (), ["test_sensor: seen (the test passed without)"], 1),
        (RENAMED, (), ["test_sensor: bias, seen (the test did not run)"], 0),
        (BEFORE, ("-k", "planes or sensor"), ["test_pose[registration]: pose (the test did not run)"], 0),
        (
            MODULE,
            (),
            [
                "test_pose[planes]: pose (the test was skipped)",
                "test_pose[registration]: pose (the test was skipped)",
                "test_sensor: bias, seen (the test was skipped)",
            ],
            1,
        ),
    ],
    ids=["skipped", "fewer", "renamed", "selected", "module"],
)
def test_figures_that_are_missing_are_named(project, pytester, body, options, missing, guarded, workers):
    """With --accuracy-fail a test that is there has to bring all its figures."""
    pytester.makepyfile(test_other="def test_it(): pass")
    grouped = "\npytestmark = pytest.mark.xdist_group('one')\n"
    project(grouped + BEFORE, *SAVE)
    for guard in ((), ("--accuracy-fail", "0.1")):
        done = project(grouped + body, *COMPARE, *guard, *options, *workers)
        lines = [line.removeprefix("  test_mine.py::") for line in done.outlines if line.startswith("  test_mine.py::")]
        assert lines == missing
        assert (done.ret == 1) == bool(guard and guarded)
        done.stdout.fnmatch_lines(["* of 4 figures saved as before were not measured now:"])


def test_saving_never_loses_the_figures_of_another_session(project, pytester):
    project(BEFORE, *SAVE)
    path = pytester.path / ".accuracy" / "before.json"
    whole = path.read_bytes()
    done = project(BEFORE, *SAVE, "-k", "planes")
    assert done.ret == 1
    done.stdout.fnmatch_lines(
        [
            "not saved as before: *before.json holds figures that were not measured now (*::test_pose[[]registration]: "
            "pose; *::test_sensor: bias, seen); take another name, or remove that file"
        ]
    )
    assert path.read_bytes() == whole
    more = BEFORE.replace("0.002", "0.001") + "    accuracy.record('new', 1.0)\n"
    assert project(more, *SAVE).ret == 0
    assert {(f["name"], f["value"]) for f in json.loads(path.read_text())["figures"]} == {
        ("pose", 10.0), ("bias", 0.001), ("seen", 0.98), ("new", 1.0)
    }  # fmt: skip


def test_another_limit_is_told(project):
    project(BEFORE, *SAVE)
    for old, new, says in (
        ("limit=0.003", "limit=3", "the limit of bias is ≤ 3 px, was ≤ 0.003 px"),
        ("limit=0.95, ", "", "the limit of seen is none, was ≥ 0.95"),
        ('"pose", 10.0', '"pose", 10.0, limit=20', "the limit of pose is ≤ 20 um, was none"),
    ):
        done = project(BEFORE.replace(old, new), *COMPARE)
        assert done.ret == 0
        told = [line.partition(": ")[2] for line in done.outlines if line.startswith("test_mine.py::")]
        assert [line for line in told if line] == [says] * (2 if "pose" in old else 1)
    assert "the limit of" not in project(BEFORE, *COMPARE).stdout.str()


NUMBER, SIX = 'accuracy.record("r", 10, limit=20)', 'accuracy.sample("s", [1, 2, 3, 4, 5, 6])'
WIDE, TWO, SEVEN = (
    'accuracy.sample("r", [1, 50, 2, 60], limit=20)',
    'accuracy.sample("s", [1, 300])',
    'accuracy.sample("s", [1, 2, 3, 4, 5, 6, 3.5])',
)


@pytest.mark.parametrize(
    ("before", "now", "says"),
    [
        (NUMBER, WIDE, "r is a sample of 4 values, was one number"),
        (WIDE, NUMBER, "r is one number, was a sample of 4 values"),
        (SIX, TWO, "s is a sample of 2 values, was a sample of 6 values"),
        (SIX, SEVEN, ""),
        (NUMBER, NUMBER, ""),
    ],
)
def test_a_figure_that_rests_on_something_else_or_on_less_is_told_and_fails_where_asked_to(project, before, now, says):
    """A wide interval overlaps any other, so nothing else would ever say that it got worse."""
    body = "def test_it(accuracy): {}"
    project(body.format(before), *SAVE)
    for guard in ((), ("--accuracy-fail", "0.1")):
        done = project(body.format(now), *COMPARE, *guard)
        done.assert_outcomes(passed=1)
        told = [line for line in done.outlines if ", was " in line]
        assert told == ([f"test_mine.py::test_it: {says}"] if says else [])
        assert done.ret == int(bool(says and guard))


@pytest.mark.parametrize("strict", [False, True])
def test_a_figure_beyond_its_limit_is_not_saved_though_its_test_may_fail(project, pytester, strict):
    bad = """
    @pytest.mark.xfail(strict={})
    def test_bad(accuracy): accuracy.record("r", 10, limit=2)

    def test_good(accuracy): accuracy.record("s", 1, limit=2)
    """
    done = project(bad.format(strict), *SAVE)
    done.assert_outcomes(passed=1, xfailed=1)
    done.stdout.fnmatch_lines(["not saved as before: beyond their limits are test_mine.py::test_bad: r"])
    assert done.ret == 1
    assert not (pytester.path / ".accuracy").exists()
    assert project(bad.replace("10,", "1,").format(False), *SAVE).ret == 0
    assert (pytester.path / ".accuracy" / "before.json").exists()


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
    ends = {line[2:10].strip(): line.rpartition("  ")[2] for line in done.outlines if line.startswith("  ")}
    assert ends["wide"] == "-9900% undecided"
    assert ends["few seen"] == "-11% undecided"
    assert not [name for name in ("good", "seen", "open", "value") if "undecided" in ends[name]]
    done.stdout.fnmatch_lines(["undecided: passed, as the interval holds the limit; more values would tell"])


def test_huge_numbers_are_short_in_the_table_and_saved(project, pytester):
    body = """
    def test_it(accuracy):
        accuracy.sample("mid", {scale} * np.array([1.0, 1.01, 1.02]), limit={limit}, better="higher")
    """
    assert project(body.format(scale="1.0", limit=2e-300), *SAVE).ret == 0
    done = project(body.format(scale="1e160", limit=2.0), *COMPARE, "--accuracy-save", "huge")
    assert done.ret == 0
    line = next(line for line in done.outlines if line.startswith("  mid"))
    assert [cell for cell in line.split() if len(cell) > 10] == []
    assert line.endswith(" 5e+161%    1.01  +1.0e+162%")
    figure = json.loads((pytester.path / ".accuracy" / "huge.json").read_text())["figures"][0]
    assert 0.9e160 < figure["interval"][0] < figure["value"] < figure["interval"][1] < 1.1e160
