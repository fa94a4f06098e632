"""Summaries of studies against numpy and scipy, and laws against figures drawn with a known
exponent or ratio.
"""

import json
from itertools import pairwise, product

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread
from scipy import stats

from identify.errors import StudyError
from identify.studies import figures as figures_of_studies
from identify.studies import summary
from identify.studies.figures import FORMATS, factor_figure, laws_figure
from identify.studies.study_design import Design, Finished, prepare
from identify.studies.study_file import Law, Range, Study
from identify.studies.table import tidy_table
from identify.studies.theory import CONFIDENCE, check_laws, point_statistics, scale_regression

DARK, BASELINE, METHOD = "sensor.camera.dark_noise", "sensor.rig.baseline", "scenario.pose_method"
POSITION, ORIENTATION = "position_rms_um", "orientation_rms_urad"
LEVELS = np.array([0.5, 1.0, 2.0, 4.0])


def made_study(**changes):
    settings = {
        "name": "made",
        "title": "Made up",
        "kind": "static_pose",
        "repeats": 8,
        "seed": 3,
        "factors": {DARK: [10.0, 20.0, 40.0], BASELINE: [0.5, 1.0]},
        "theory": [Law(figure=POSITION, factor=DARK, exponent=1.0)],
    }
    return Study(**settings | changes)


def made_table(study, failed=(), figures=None):
    """A study's table: position error 0.1 um an electron, with scatter, or other figures of factors
    and generator.
    """

    def drawn(factors, rng):
        position, orientation = np.sqrt(rng.chisquare(12, 2) / 12)
        return {
            POSITION: 0.1 * factors[DARK] * position,
            ORIENTATION: orientation / factors.get(BASELINE, 1.0),
            "lost_frames": 0.0,
        }

    rng, design = np.random.default_rng(0), Design(study)
    cases = [design.case(number) for number in range(len(design))]
    rows = [Finished(case.number, (figures or drawn)(case.factors, rng), 0.02) for case in cases]
    for row in failed:
        rows[row] = Finished(row, {}, 0.02, f"LostError: only {row % 2} stickers")
    return tidy_table(study, rows)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Table of a study with three failed rows, and others without a position; what its summary
    returned; the folder.
    """
    study, folder = made_study(repeats=16), tmp_path_factory.mktemp("study")
    frame = made_table(study, failed=(4, 7, 9))
    frame.loc[
        (frame["repeat"] == 15) | ((frame[DARK] == 40.0) & (frame[BASELINE] == 1.0)), POSITION
    ] = np.nan
    return frame, summary.write(folder, study, frame), folder


def test_statistics_of_a_point_are_numpys_its_bands_students_and_a_bootstraps():
    values = np.random.default_rng(0).gamma(2.0, size=12)
    found = point_statistics(values)
    assert (found.mean, found.std) == (
        pytest.approx(np.mean(values)),
        pytest.approx(np.std(values, ddof=1)),
    )
    assert found.rms == pytest.approx(np.sqrt(np.mean(values**2)))
    assert found.mean_band == pytest.approx(
        tuple(stats.ttest_1samp(values, 0.0).confidence_interval(0.95))
    )
    many = np.sqrt(np.random.default_rng(2).chisquare(12, 300) / 12)
    oracle = stats.bootstrap(
        (many,), lambda v, axis: np.sqrt(np.mean(v**2, axis=axis)), rng=0
    ).confidence_interval
    np.testing.assert_allclose(point_statistics(many).rms_band, oracle, rtol=0.005)
    alone, zeros = point_statistics(np.array([3.0])), point_statistics(np.zeros(5))
    assert (alone.std, alone.mean_band, alone.rms_band) == (None, None, None)
    assert zeros.mean_band == zeros.rms_band == (0.0, 0.0)


@pytest.mark.parametrize(
    ("count", "freedom", "least", "most"),
    [(2, 3, 0.95, 0.97), (3, 60, 0.95, 0.97), (5, 12, 0.95, 0.97), (20, 3, 0.95, 0.95), (50, 60, 0.95, 0.95),
     (8, 1, 0.92, 0.95)],
)  # fmt: skip
def test_band_of_the_rms_covers_it_as_often_as_it_says(count, freedom, least, most):
    """Rms errors of so many normal numbers a row; few rows may be covered a little oftener, but by
    no idle band, and those of single normal numbers, the worst case, a little more seldom."""
    rng, trials = np.random.default_rng(1), 2000
    figures = np.sqrt(rng.chisquare(freedom, (trials, count)) / freedom)
    covered = sum(
        low <= 1.0 <= high for low, high in (point_statistics(row).rms_band for row in figures)
    )
    assert stats.binom.ppf(0.001, trials, least) <= covered <= stats.binom.ppf(0.999, trials, most)


def test_points_and_laws_are_those_of_the_rows_that_have_the_figure_and_the_failed_are_counted_and_named(
    written,
):
    frame, entry, folder = written
    assert len(entry["points"]) == 6
    for point, name in product(entry["points"], (POSITION, ORIENTATION)):
        here = np.logical_and.reduce(
            [frame[path] == value for path, value in point["factors"].items()]
        )
        values, figure = (
            frame[name][here & (frame["error"] == "")].dropna(),
            point["figures"].get(name),
        )
        assert (figure["rows"] if figure else 0) == len(values)
        if figure:
            assert figure["mean"] == pytest.approx(values.mean())
            assert figure["rms"] == pytest.approx(np.sqrt((values**2).mean()))
            assert figure["rms_band"][0] < figure["rms"] < figure["rms_band"][1]
    assert entry["rows"] == {"planned": 96, "done": 93, "failed": 3, "missing": 0}
    assert entry["failures"]["reasons"] == {
        "LostError: only 1 stickers": 2,
        "LostError: only 0 stickers": 1,
    }
    assert [one["row"] for one in entry["failures"]["first"]] == [4, 7, 9]
    stored, text = (
        json.loads((folder / "summary.json").read_text()),
        (folder / "summary.md").read_text(),
    )
    assert "nan" not in f"{json.dumps(stored)} {text}".lower()
    law = stored["theory"][0]
    assert (law["verdict"], law["rows"]) == ("passed", 72)
    assert law["low"] < 1.0 < law["high"]
    assert (stored["units"][DARK], stored["units"][POSITION]) == ("electrons", "um")
    assert stored["confidence"] == {"bands": 0.95, "laws": 0.99}
    for words in (
        "93 rows done, 3 failed, 0 missing",
        "2 x LostError: only 1 stickers",
        "Rows 4, 7 and 9.",
    ):
        assert words in text
    assert "| position_rms_um ~ sensor.camera.dark_noise ^ 1 | 1 |" in text


def test_figures_show_each_factor_two_as_a_map_and_the_laws(written):
    folder = written[2] / "figures"
    names = {f"by_{DARK}", f"by_{BASELINE}", "map", "laws"}
    assert {path.name for path in folder.iterdir()} == {
        f"{name}.{kind}" for name in names for kind in FORMATS
    }
    for name in names:
        assert np.ptp(imread(folder / f"{name}.png")[..., :3]) > 0.5
        assert (folder / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert "dark noise" in (folder / f"{name}.svg").read_text().lower()


@pytest.mark.parametrize("levels", [[1.0, 1.05, 1.1, 9.0], [0.001, 5e4], np.geomspace(1, 7, 7)])
@pytest.mark.parametrize("spread", [1.0001, 5.0, 1e7])
def test_numbers_on_axes_never_touch_and_labels_are_words_with_units(levels, spread):
    """Of rows whose rms spans a little or seven decades, with bands as wide as few repeats leave
    them.
    """
    study = made_study(factors={DARK: list(levels), BASELINE: [0.5, 1.0]}, repeats=2, theory=[])
    share = {level: place / (len(levels) - 1) for place, level in enumerate(levels)}

    def figures(case, rng):
        return {POSITION: spread ** share[case[DARK]] * np.sqrt(rng.chisquare(1)), ORIENTATION: 1.0}

    figure = factor_figure(study, made_table(study, figures=figures), DARK, [POSITION])
    figure.draw_without_rendering()
    (axes,) = figure.axes
    assert axes.get_xlabel() == "Dark noise, rms [electrons]"
    assert (
        axes.get_ylabel().replace("\n", " ")
        == "Error of the measured position, rms over pictures and axes [µm]"
    )
    for labels in (axes.get_xticklabels(), axes.get_yticklabels()):
        boxes = [label.get_window_extent() for label in labels if label.get_text()]
        assert len(boxes) >= 2
        assert not any(one.overlaps(other) for one, other in pairwise(boxes))
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 2
    assert not legend.get_window_extent().overlaps(axes.get_tightbbox())
    assert figure.bbox.padded(1).containsx(legend.get_window_extent().x1)


def test_figures_chosen_in_the_file_are_drawn_and_tabulated_and_others_are_refused(
    tmp_path, monkeypatch
):
    drawn = []
    monkeypatch.setattr(summary, "draw", lambda *arguments: drawn.append(arguments[3]))
    chosen = made_study(figures=[ORIENTATION], theory=[])
    summary.write(tmp_path, chosen, made_table(chosen))
    assert "| orientation_rms_urad [urad] |" in (tmp_path / "summary.md").read_text()
    assert "position_rms_um" not in (tmp_path / "summary.md").read_text()
    assert drawn == [[ORIENTATION]]
    with pytest.raises(
        StudyError,
        match="figures has 'speed', which is not a figure of static_pose; the nearest are",
    ):
        prepare(made_study(figures=["speed"]))
    own = made_study(kind="my_rows:count", figures=["speed"], theory=[])
    with pytest.raises(StudyError, match=f"figures has 'speed', but the rows have only {POSITION}"):
        summary.write(tmp_path, own, made_table(own))


def test_the_map_shows_all_figures_and_the_title_says_if_bands_are_cut(tmp_path, monkeypatch):
    """With bands of 2 rows that differ by a factor of 1.01 or 20."""
    maps, study = [], made_study(repeats=2, theory=[])
    monkeypatch.setattr(
        figures_of_studies, "map_figure", lambda *arguments: maps.append(arguments[3])
    )
    shown = [POSITION, ORIENTATION, "lost_frames"]
    list(figures_of_studies._figures(study, made_table(study), shown, [], []))
    assert maps == [shown]
    for ratio, cut in ((1.01, False), (20.0, True)):
        frame = made_table(study, figures=lambda *_: {POSITION: 1.0})
        frame.loc[frame["repeat"] == 1, POSITION] = ratio
        title = factor_figure(study, frame, DARK, [POSITION]).texts[0].get_text()
        assert ("beyond the frame is cut" in " ".join(title.split())) == cut


def test_a_law_against_a_figure_is_refused_before_any_row_if_two_factors_are_varied():
    law = Law(figure=POSITION, factor="pixel_noise_grey", exponent=1.0)
    prepare(made_study(theory=[law], factors={DARK: [10.0, 20.0]}))
    ratio = f'state a constant ratio instead: per = "pixel_noise_grey", factor = "{DARK}", exponent'
    with pytest.raises(StudyError, match=f"needs a study of one factor, but {DARK}, .*; {ratio}"):
        prepare(made_study(theory=[law]))


def test_long_title_stays_within_the_figure_of_a_single_law():
    study = made_study(
        title="How far the measured position is from the true one against the noise of the pixels"
    )
    frame = made_table(study)
    figure = laws_figure(study, frame, [(study.theory[0], check_laws(study, frame)[0])])
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "theory" in said
    assert figure.axes[0].get_title().endswith(f"theory: {study.theory[0].exponent:g}")
    figure.draw_without_rendering()
    title = figure.texts[0].get_window_extent()
    assert title.x0 > 0.0
    assert title.x1 < figure.bbox.width
    assert title.y0 > figure.axes[0].title.get_window_extent().y1


@pytest.mark.parametrize("title", ["Short", "Long enough for a second line of the figure " * 2])
@pytest.mark.parametrize("count", [1, 2])
def test_labels_of_axes_touch_neither_title_nor_legend_of_studies_side_by_side(title, count):
    """With six curves, each with a long name, and the longest labels that kinds of rows have."""
    shown = ["group_std_percent", "unseen_orientation_rms_urad"][:count]
    factors = {DARK: [10.0, 20.0, 40.0], BASELINE: [0.5, 1.0]}
    study = made_study(kind="identification", title=title, factors=factors, repeats=2, theory=[])
    frame = made_table(study, figures=lambda *_: dict.fromkeys(shown, 1.0))
    names = [f"{place} study of a slower servo" for place in ("first", "second", "third")]
    together = pd.concat([frame.assign(study=name) for name in names])
    named = study.model_copy(update={"factors": factors | {"study": names}})
    figure = factor_figure(named, together, DARK, shown)
    figure.draw_without_rendering()
    title_box, legend = (one.get_window_extent() for one in (figure.texts[0], figure.legends[0]))
    assert len(figure.legends[0].get_texts()) == 6
    for axes in figure.axes:
        label = axes.yaxis.label.get_window_extent()
        assert label.y1 < title_box.y0
        assert label.y0 > legend.y1


def test_laws_over_two_factors_give_each_value_its_own_look_in_their_one_legend():
    laws = [
        Law(figure=POSITION, factor=DARK, exponent=1.0),
        Law(figure=ORIENTATION, factor=BASELINE, exponent=-1.0),
    ]
    study = made_study(theory=laws)
    frame = made_table(study)
    figure = laws_figure(study, frame, list(zip(laws, check_laws(study, frame), strict=True)))
    curves = [curve for axes in figure.axes for curve in axes.containers]
    assert len(curves) == 5, "two baselines and three noises"
    assert len({curve.lines[0].get_marker() for curve in curves}) == 5
    assert len({curve.lines[0].get_color() for curve in curves}) == 5
    figure.draw_without_rendering()
    title = figure.texts[0].get_window_extent()
    for axes in figure.axes:
        assert axes.yaxis.label.get_window_extent().y1 < title.y0


def test_what_a_study_lacks_is_said(tmp_path, monkeypatch):
    """Bands of a single repeat; rows that worked; rows at all; units of a kind of one's own."""
    monkeypatch.setattr(summary, "draw", lambda *_: None)
    single, whole = made_study(repeats=1), made_study(kind="my_rows:count")
    entry = summary.write(tmp_path, single, made_table(single))
    assert entry["points"][0]["figures"][POSITION]["rms_band"] is None
    assert "With a single repeat there is no band" in (tmp_path / "summary.md").read_text()
    entry = summary.write(tmp_path, single, made_table(single, failed=range(single.rows)))
    assert (entry["points"], entry["theory"][0]["verdict"]) == ([], "undecided")
    assert "0 rows done, 6 failed" in (tmp_path / "summary.md").read_text()
    entry = summary.write(tmp_path, whole, made_table(whole).head(20))
    assert entry["rows"]["missing"] == 28
    assert set(entry["units"]) == {DARK, BASELINE}
    assert entry["points"][0]["figures"][ORIENTATION]["rows"] == 4


@pytest.mark.slow
def test_law_against_a_figure_needs_no_factor_and_one_of_a_texts_power_is_undecided_and_not_drawn(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(figures_of_studies, "FORMATS", ("png",))

    def figures(_, rng):
        sight = rng.uniform(1.0, 4.0)
        return {"sight_m": sight, POSITION: sight**2 * np.sqrt(rng.chisquare(12) / 12)}

    study = made_study(
        factors={}, repeats=60, theory=[Law(figure=POSITION, factor="sight_m", exponent=2.0)]
    )
    assert (
        summary.write(tmp_path, study, made_table(study, figures=figures))["theory"][0]["verdict"]
        == "passed"
    )
    assert (tmp_path / "figures" / "laws.png").exists()
    factors = {DARK: [10.0], METHOD: ["registration", "planes"]}
    study = made_study(factors=factors, theory=[Law(figure=POSITION, factor=METHOD, exponent=1.0)])
    assert summary.write(tmp_path, study, made_table(study))["theory"][0]["verdict"] == "undecided"
    assert (tmp_path / "figures" / f"by_{METHOD}.png").exists()


def test_random_sample_is_summarised_as_a_whole_and_its_points_stand_in_order_with_digits_to_read(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(figures_of_studies, "FORMATS", ("png",))
    study = made_study(
        sample=200, repeats=1, factors={DARK: Range(low=10.0, high=40.0), BASELINE: [0.5, 1.0]}
    )
    entry = summary.write(tmp_path, study, made_table(study))
    assert [point["factors"] for point in entry["points"]] == [{}]
    assert entry["points"][0]["figures"][POSITION]["rows"] == 200
    assert entry["theory"][0]["verdict"] == "passed"
    assert (tmp_path / "figures" / f"by_{DARK}.png").exists()
    study = made_study(sample=3, repeats=2, factors={DARK: Range(low=10.0, high=40.0)}, theory=[])
    frame = made_table(study).assign(**{DARK: [31.23456789012345, 12.0, 25.5] * 2})
    summary.write(tmp_path, study, frame)
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert [line.split("|")[1].strip() for line in lines[-3:]] == ["12", "25.5", "31.2346"]


def drawn(rng, exponent, rows=30, freedom=12, others=(1.0,)):
    """Rms errors of `freedom` normal numbers whose sigma is other * x ** exponent."""
    x, other = (a.ravel() for a in np.meshgrid(np.repeat(LEVELS, rows), others))
    figure = other * x**exponent * np.sqrt(rng.chisquare(freedom, len(x)) / freedom)
    return pd.DataFrame(
        {"row": range(len(x)), "x": x, "other": other, "error": "", "figure_um": figure}
    )


def verdict(law, frame, factors=("x",), **settings):
    values = {name: frame[name].unique().tolist() for name in factors}
    return check_laws(
        made_study(kind="module:function", factors=values, theory=[law], **settings), frame
    )[0]


def power(exponent, **more):
    return Law(figure="figure_um", factor="x", exponent=exponent, **more)


@pytest.mark.slow
@pytest.mark.parametrize(("freedom", "rows"), [(12, 30), (3, 40)])
def test_interval_of_an_exponent_covers_it_as_often_as_it_says_and_a_true_law_passes(freedom, rows):
    rng, trials = np.random.default_rng(0), 300
    covered = passed = 0
    for _ in range(trials):
        frame = drawn(rng, -0.5, rows, freedom)
        design = np.column_stack([np.ones(len(frame)), 2.0 * np.log(frame["x"])])
        low, high = scale_regression(frame["figure_um"].to_numpy() ** 2, design).interval(1, 0.95)
        covered += low <= -0.5 <= high
        passed += verdict(power(-0.5), frame).verdict == "passed"
    assert stats.binom.ppf(0.001, trials, 0.95) <= covered <= stats.binom.ppf(0.999, trials, 0.95)
    assert stats.binom.ppf(0.001, trials, CONFIDENCE) <= passed


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
    rng, pairs = np.random.default_rng(5), zip(LEVELS, (1, 2, 6, 30), strict=True)
    frame = pd.concat(
        drawn(rng, -1.0, 400, freedom).query(f"x == {level}") for level, freedom in pairs
    )
    assert np.polyfit(*np.log([frame["x"], frame["figure_um"]]), 1)[0] > -0.8, (
        "the slope of a straight line"
    )
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
    found = [
        verdict(Law(figure="figure_um", equals=name), frame) for name in ("stated_um", "small_um")
    ]
    assert [one.verdict for one in found] == ["passed", "failed"]
    assert found[1].measured == pytest.approx(1 / 0.7, rel=0.05)


@pytest.mark.parametrize(
    ("good", "bad", "expected"),
    [(1.0, 2.0, "passed"), (2.0, 1.0, "failed"), (1.0, 1.01, "undecided")],
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
        (
            Law(figure="figur_um", factor="x", exponent=1.0),
            {},
            "no figure 'figur_um'; they have row, x",
        ),
        (Law(figure="figure_um", factor="y", exponent=1.0), {}, "no factor or figure 'y'"),
        (
            power(1.0, per="some"),
            {},
            "some is zero in 30 of 120 rows, but the law divides by it",
        ),
        (
            Law(figure="figure_um", equals="some"),
            {},
            "some is zero in 30 of 120 rows, but the law divides",
        ),
        (power(1.0), {"figure_um": 0.0}, "zero in every row"),
        (
            power(1.0),
            {"x": 2.0},
            "x has one value, 2.0, in all rows, but the law needs two or more",
        ),
        (
            Law(figure="figure_um", factor="x", order=[2.0, 3.0]),
            {"x": 2.0},
            "x has one value, 2.0, in all rows, but the law needs two or more",
        ),
    ],
)
def test_law_of_what_the_rows_do_not_show_is_undecided_with_the_reason(law, changes, reason):
    frame = drawn(np.random.default_rng(11), 1.0).assign(
        some=lambda rows: rows["row"] % 4.0, **changes
    )
    found = verdict(law, frame)
    assert found.verdict == "undecided"
    assert reason in found.reason
    with pytest.raises(StudyError, match="2 rows do not determine 2 coefficients"):
        scale_regression(np.ones(2), np.array([[1.0, 0.0], [1.0, 1.0]]))
