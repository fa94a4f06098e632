"""Figures beside saved ones: what got worse, what is held to less than it was or to nothing, and
what is gone.
"""

import json
import re

import numpy as np
import pytest

from tests.accuracy.conftest import COMPARE, FIGURES, SAVE, recording

GUARDS = ((), ("--accuracy-fail", "0.1"))


def test_the_table_compares_with_saved_figures_and_tells_of_new_ones_and_of_another_seed(project):
    project(FIGURES, *SAVE)
    now = (
        FIGURES.replace("0.002", "0.0025")
        + "\ndef test_new(accuracy): accuracy.record('new', 1.0)\n"
    )
    again = project(now, *COMPARE, "--accuracy-seed", "7")
    again.assert_outcomes(passed=4)
    cells = {line.split()[0]: line.split()[-2:] for line in again.outlines if line.startswith("  ")}
    assert cells["value"] == ["before", "change"]
    assert cells["bias"] == ["0.002", "+25.0%"]
    assert cells["seen"] == ["0.98", "+0.0%"]
    assert cells["new"] == ["1", "new"]
    again.stdout.fnmatch_lines(
        ["before was saved with --accuracy-seed 0, this session has the seed 7"]
    )


SAMPLE = f"np.array({list(np.random.default_rng(0).normal(10, 1, 50).round(3))})"
CHANGES = [
    ("record('x', 2.0)", "record('x', 2.0)", ""),
    ("record('x', 2.0)", "record('x', 2.15)", "0"),
    ("record('x', 2.0)", "record('x', 2.25)", "0, 0.1"),
    ("record('x', 2.0)", "record('x', 1.0)", ""),
    ("record('x', 1.0, better='higher')", "record('x', 0.8, better='higher')", "0, 0.1"),
    ("record('x', 1.0, better='higher')", "record('x', 1.2, better='higher')", ""),
    ("record('x', 0.0)", "record('x', 1e-9)", "0, 0.1"),  # the ratio of nothing is nothing
    (f"sample('x', {SAMPLE})", f"sample('x', {SAMPLE} - 5)", ""),
    # a shift of two standard errors of the difference is noise: the intervals overlap
    (f"sample('x', {SAMPLE})", f"sample('x', {SAMPLE} + 0.3)", ""),
    (f"sample('x', {SAMPLE})", f"sample('x', {SAMPLE} + 1.5)", "0"),
    (f"sample('x', {SAMPLE})", f"sample('x', {SAMPLE} + 1.7)", "0, 0.1"),
    ("record('x', 1.0, unit='mm')", "record('x', 1.0, unit='um')", "0, 0.1"),
]


def test_the_session_fails_when_a_figure_got_worse_by_more_than_the_ratio(project):
    before, now, worse = zip(*CHANGES, strict=True)
    project(recording(before), *SAVE)
    assert project(recording(now), *COMPARE).ret == 0
    for ratio in ("0", "0.1"):
        assert project(recording(before), *COMPARE, "--accuracy-fail", ratio).ret == 0
        done = project(recording(now), *COMPARE, "--accuracy-fail", ratio)
        done.assert_outcomes(passed=len(CHANGES))
        assert done.ret == 1
        done.stdout.fnmatch_lines(["*::test_11: x cannot be compared: unit is 'um', was 'mm'"])
        told = re.findall(
            r"^(?:worse by more than .*)?test_mine.py::test_(\d+): x ",
            str(done.stdout),
            re.MULTILINE,
        )
        assert sorted(map(int, told)) == [
            n for n, ratios in enumerate(worse) if ratio in ratios.split(", ")
        ]


FEWER = FIGURES.replace('    accuracy.record("seen", 0.98', '    dict(name="seen", value=0.98')
SKIPPED = FIGURES.replace(
    "accuracy, method):", "accuracy, method):\n    if method == 'planes': pytest.skip('none')"
)
MODULE = "pytest.skip('no library', allow_module_level=True)\n" + FIGURES
RENAMED = FIGURES.replace("test_sensor", "test_other")
TESTS = ("test_pose[planes]: pose", "test_pose[registration]: pose", "test_sensor: bias, seen")
ALL_SKIPPED = [f"{test} (the test was skipped)" for test in TESTS]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "options", "missing", "guarded"),
    [
        (SKIPPED, (), ALL_SKIPPED[:1], 1),
        (FEWER, (), ["test_sensor: seen (the test passed without)"], 1),
        (RENAMED, (), ["test_sensor: bias, seen (the test did not run)"], 0),
        (
            FIGURES,
            ("-k", "planes or sensor"),
            ["test_pose[registration]: pose (the test did not run)"],
            0,
        ),
        (MODULE, (), ALL_SKIPPED, 1),
        ("def test_it(): pass", (), [f"{test} (the test did not run)" for test in TESTS], 1),
        pytest.param(
            SKIPPED, ("-n", "1", "--dist", "loadgroup"), ALL_SKIPPED[:1], 1, marks=pytest.mark.slow
        ),
    ],
    ids=["skipped", "fewer", "renamed", "selected", "module", "none", "in a group of a worker"],
)
def test_figures_that_are_missing_are_named(project, pytester, body, options, missing, guarded):
    """With --accuracy-fail a test that is there has to bring all its figures."""
    pytester.makepyfile(test_other="def test_it(): pass")
    grouped = "\npytestmark = pytest.mark.xdist_group('one')\n"
    project(grouped + FIGURES, *SAVE)
    nothing = "nothing is compared: no figure saved as before was measured now"
    for guard in GUARDS:
        done = project(grouped + body, *COMPARE, *guard, *options)
        assert (nothing in done.outlines) == bool(guard and len(missing) == len(TESTS))
        lines = [
            line.removeprefix("  test_mine.py::")
            for line in done.outlines
            if line.startswith("  test_mine.py::")
        ]
        assert lines == missing
        assert (done.ret == 1) == bool(guard and guarded)
        done.stdout.fnmatch_lines(["* of 4 figures saved as before were not measured now:"])


NUMBER, SIX = "record('r', 10, limit=20)", "sample('s', [1, 2, 3, 4, 5, 6])"
WIDE = "sample('r', [1, 50, 2, 60], limit=20)"
LIMITS = [
    (
        "record('b', 1, 'px', 3)",
        "record('b', 1, 'px', 30)",
        "the limit of b is ≤ 30 px, was ≤ 3 px",
    ),
    ("record('b', 1, 'px', 3)", "record('b', 1, 'px')", "the limit of b is none, was ≤ 3 px"),
    ("record('b', 1)", "record('b', 1, '', 3)", "the limit of b is ≤ 3, was none"),
    (NUMBER, NUMBER, ""),
    (SIX, "sample('s', [1, 2, 3, 4, 5, 6, 3.5])", ""),
]
EVIDENCE = [
    (NUMBER, WIDE, "r is a sample of 4 values, was one number"),
    (WIDE, NUMBER, "r is one number, was a sample of 4 values"),
    (SIX, "sample('s', [1, 300])", "s is a sample of 2 values, was a sample of 6 values"),
]


@pytest.mark.parametrize(
    ("cases", "fails"), [(LIMITS, False), *(([case], True) for case in EVIDENCE)]
)
def test_a_figure_held_to_another_limit_or_resting_on_less_is_told(project, cases, fails):
    """A wide interval overlaps any other, so nothing else would ever say that it got worse."""
    before, now, says = zip(*cases, strict=True)
    project(recording(before), *SAVE)
    for guard in GUARDS:
        done = project(recording(now), *COMPARE, *guard)
        done.assert_outcomes(passed=len(cases))
        told = [line for line in done.outlines if ", was " in line]
        assert told == [f"test_mine.py::test_{n}: {one}" for n, one in enumerate(says) if one]
        assert done.ret == int(bool(fails and guard))


def test_huge_numbers_are_short_in_the_table_and_saved(project, pytester):
    body = """
    def test_it(accuracy):
        accuracy.sample("mid", {scale} * np.array([1.0, 1.01, 1.02]), limit={limit},
        better="higher")
    """
    assert project(body.format(scale="1.0", limit=2e-300), *SAVE).ret == 0
    done = project(body.format(scale="1e160", limit=2.0), *COMPARE, "--accuracy-save", "huge")
    assert done.ret == 0
    line = next(line for line in done.outlines if line.startswith("  mid"))
    assert [cell for cell in line.split() if len(cell) > 10] == []
    assert line.endswith(" 5e+161%    1.01  +1.0e+162%")
    figure = json.loads((pytester.path / ".accuracy" / "huge.json").read_text())["figures"][0]
    assert 0.9e160 < figure["interval"][0] < figure["value"] < figure["interval"][1] < 1.1e160


UNTIL = """
def test_until(accuracy):
    rng = np.random.default_rng(0)
    draw = lambda n: {mean} * (1 + 0.5 * rng.standard_normal(n))
    accuracy.sample_until("error", draw, limit=12, unit="um"{most})
"""


@pytest.mark.parametrize("workers", [(), pytest.param(("-n", "1"), marks=pytest.mark.slow)])
def test_a_better_method_draws_as_many_values_as_the_saved_one(project, saved, workers):
    """Alone it would need 20 values, too few to be held to the saved 80."""
    before, after = UNTIL.format(mean=10.6, most=""), UNTIL.format(mean=3.6, most="")
    project(before, *SAVE)
    count = json.loads(saved.read_text())["figures"][0]["count"]
    assert count > 20
    assert drawn(project(after)) == 20
    guarded = (*COMPARE, *GUARDS[1], *workers)
    same, better = project(before, *guarded), project(after, *guarded)
    assert (same.ret, drawn(same), same.stdout.str().count("+0.0%")) == (0, count, 1)
    assert (better.ret, drawn(better)) == (0, count)
    fewer = project(UNTIL.format(mean=3.6, most=f", most={count // 2}"), *guarded)
    assert fewer.ret == 1
    assert f"is a sample of {count // 2} values, was a sample of {count} values" in str(
        fewer.stdout
    )


def drawn(done):
    """Number of values of the only figure in the table."""
    return int(re.search(r"^  error .* \.\. \S+ +(\d+)  um", str(done.stdout), re.MULTILINE)[1])
