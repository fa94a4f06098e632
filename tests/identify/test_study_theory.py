"""Laws of studies against figures drawn with a known exponent or ratio; coverage is counted, not assumed."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom

from identify.errors import StudyError
from identify.studies.study_file import Law, Study
from identify.studies.theory import CONFIDENCE, check_laws, scale_regression

LEVELS = np.array([0.5, 1.0, 2.0, 4.0])


def drawn(rng, exponent, rows=30, freedom=12, others=(1.0,)):
    """Rms errors of `freedom` normal numbers whose sigma is other * x ** exponent."""
    x, other = (a.ravel() for a in np.meshgrid(np.repeat(LEVELS, rows), others))
    squares = rng.chisquare(freedom, len(x)) / freedom
    return pd.DataFrame(
        {"row": range(len(x)), "x": x, "other": other, "error": "", "figure_um": other * x**exponent * np.sqrt(squares)}
    )


def study(*laws, factors=("x",), **settings):
    values = {"x": LEVELS.tolist(), "other": [1.0, 5.0], "method": ["good", "bad"]}
    return Study(
        name="made",
        kind="module:function",
        factors={name: values[name] for name in factors},
        theory=list(laws),
        **settings,
    )


def verdict(law, frame, **settings):
    return check_laws(study(law, **settings), frame)[0]


def power(exponent, **more):
    return Law(figure="figure_um", factor="x", exponent=exponent, **more)


@pytest.mark.parametrize(("freedom", "rows"), [(12, 30), (3, 40)])
def test_interval_of_an_exponent_covers_it_as_often_as_it_says(freedom, rows):
    rng, trials = np.random.default_rng(0), 600
    covered = 0
    for _ in range(trials):
        frame = drawn(rng, -0.5, rows, freedom)
        design = np.column_stack([np.ones(len(frame)), 2.0 * np.log(frame["x"])])
        low, high = scale_regression(frame["figure_um"].to_numpy() ** 2, design).interval(1, 0.95)
        covered += low <= -0.5 <= high
    assert binom.ppf(0.001, trials, 0.95) <= covered <= binom.ppf(0.999, trials, 0.95)


def test_verdict_holds_for_true_laws_but_for_one_in_a_hundred():
    rng, trials = np.random.default_rng(1), 400
    passed = sum(verdict(power(1.0), drawn(rng, 1.0)).verdict == "passed" for _ in range(trials))
    assert binom.ppf(0.001, trials, CONFIDENCE) <= passed


def test_a_wrong_exponent_fails_but_within_its_tolerance_and_few_rows_can_only_refute():
    some, many = (drawn(np.random.default_rng(2), 1.0, rows=rows) for rows in (200, 2000))
    for wrong, frame in ((0.8, some), (1.2, some), (0.0, some), (1.05, many)):
        found = verdict(power(wrong), frame)
        assert found.verdict == "failed"
        assert found.measured == pytest.approx(1.0, abs=0.05)
    assert verdict(power(1.05, tolerance=0.06), many).verdict == "passed"
    few = drawn(np.random.default_rng(4), 1.0, rows=2, freedom=3)
    assert verdict(power(1.0), few).verdict == "undecided"
    assert verdict(power(-3.0), few).verdict == "failed"


def test_mean_square_scales_right_though_the_figures_distribution_changes_with_the_factor():
    rng = np.random.default_rng(5)
    parts = [
        drawn(rng, -1.0, rows=400, freedom=freedom).query(f"x == {level}")
        for level, freedom in zip(LEVELS, (1, 2, 6, 30), strict=True)
    ]
    frame = pd.concat(parts)
    straight_line = np.polyfit(np.log(frame["x"]), np.log(frame["figure_um"]), 1)[0]
    assert straight_line > -0.8
    assert verdict(power(-1.0), frame).verdict == "passed"


def test_other_factors_do_not_disturb_an_exponent():
    """Of an unbalanced grid, and of a random sample."""
    grid = drawn(np.random.default_rng(6), 0.5, rows=60, others=(1.0, 5.0))
    grid = grid.drop(grid.query("x > 1 and other == 5 and row % 3 > 0").index)
    rng = np.random.default_rng(7)
    x, other = np.exp(rng.uniform(-1, 1, (2, 800)))
    figure = x**1.5 / other**2 * np.sqrt(rng.chisquare(12, 800) / 12)
    sample = pd.DataFrame({"x": x, "other": other, "figure_um": figure, "error": ""})
    for exponent, frame, size in ((0.5, grid, None), (1.5, sample, 800)):
        found = verdict(power(exponent), frame, factors=("x", "other"), sample=size)
        assert found.verdict == "passed"
        assert found.high - found.low < 0.2


def test_figures_that_must_be_equal():
    rng = np.random.default_rng(8)
    frame = drawn(rng, 1.0).assign(stated_um=lambda f: f["x"], small_um=lambda f: 0.7 * f["x"])
    found = [verdict(Law(figure="figure_um", equals=name), frame) for name in ("stated_um", "small_um")]
    assert [one.verdict for one in found] == ["passed", "failed"]
    assert found[1].measured == pytest.approx(1 / 0.7, rel=0.05)


@pytest.mark.parametrize(
    ("good", "bad", "expected"), [(1.0, 2.0, "passed"), (2.0, 1.0, "failed"), (1.0, 1.01, "undecided")]
)
def test_order_of_a_factors_values(good, bad, expected):
    rng, scales = np.random.default_rng(9), {"good": good, "bad": bad}
    frame = pd.concat([drawn(rng, 0.0).assign(method=name) for name in scales])
    frame["figure_um"] *= frame["method"].map(scales)
    law = Law(figure="figure_um", factor="method", order=["good", "bad"])
    found = verdict(law, frame, factors=("x", "method"))
    assert found.verdict == expected
    assert found.low <= bad / good <= found.high


@pytest.mark.parametrize(
    ("law", "changes", "reason"),
    [
        (Law(figure="figur_um", factor="x", exponent=1.0), {}, "no figure 'figur_um'; they have row, x"),
        (Law(figure="figure_um", factor="y", exponent=1.0), {}, "no factor or figure 'y'"),
        (power(1.0, per="some"), {}, "some is zero in 30 of 120 rows, and nothing can be divided by it"),
        (Law(figure="figure_um", equals="some"), {}, "some is zero in 30 of 120 rows, and nothing can be divided"),
        (power(1.0), {"figure_um": 0.0}, "zero in every row"),
        (power(1.0), {"x": 2.0}, "do not vary"),
    ],
)
def test_law_of_what_the_rows_do_not_show_is_undecided_with_the_reason(law, changes, reason):
    frame = drawn(np.random.default_rng(11), 1.0).assign(some=lambda rows: rows["row"] % 4.0, **changes)
    found = verdict(law, frame)
    assert found.verdict == "undecided"
    assert reason in found.reason
    with pytest.raises(StudyError, match="2 rows do not determine 2 coefficients"):
        scale_regression(np.ones(2), np.array([[1.0, 0.0], [1.0, 1.0]]))
