"""Result file, goals, tables, figures and report of a run: worked out by hand; the report opens
offline.
"""

import io
import json
import math
import re
import warnings
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import xarray as xr
from matplotlib.image import imread

import identify
from dynamics.kinematics.platform import Chart
from identify import pipeline
from identify.errors import OutputFolderError, RecordError
from identify.files.atomic import figure_bytes
from identify.files.run_folder import RunFolder, load_result, rms_figures, rms_row, save_result
from identify.progress import SilentProgress
from identify.record.frame_times import missing_rows
from identify.record.model_runs import build_model_run
from identify.record.recording import read, write
from identify.record.stored_common_errors import CommonErrors, store_common_errors
from identify.reporting import paper, parameter_tables, report_sections, tables
from identify.reporting.figures import estimates, fit, paths, style
from identify.reporting.figures.fit import Fit
from identify.reporting.goals import check_goals, within_tolerance
from identify.reporting.number_format import (
    interval,
    number,
    rounded,
    significant,
    typographic,
    with_deviation,
)
from identify.reporting.pictures import pictures
from identify.reporting.report import render, write_report
from identify.reporting.report_sections import SECTIONS, row_counts
from identify.reporting.run_data import read_run
from identify.reporting.verdict import cameras_consistent, key_numbers, verdict
from identify.scenario import load_scenario
from identify.trajectory import TrajectorySet, random_trajectory
from tests.identify.run_files import write_model_runs
from tests.identify.synthetic import short_run, truth_of

FIGURES = {
    "scene",
    "errors",
    "stereo_frame",
    "ellipses",
    "excitation",
    "path",
    "fit_excitation",
    "fit_validation",
}
FIGURES |= {"validation_errors", "parameters", "correlation"}
TIME, ZERO = np.arange(50) / 60, np.zeros((50, 6))
NOISE = np.random.default_rng(0).normal(size=(50, 6))


def page_of(data):
    """The page without its pictures."""
    shown = pictures(data)
    return render(data, shown, dict.fromkeys(shown, "<svg></svg>"))


@pytest.fixture
def no_images(monkeypatch):
    """The images of the cameras are not drawn, which takes a second."""
    monkeypatch.setattr("identify.reporting.run_data.stereo_view", lambda *_, **__: None)


def without_truth(run_folder):
    """The folder as that of a record of a real robot: nothing but record, result and covariance,
    and no truth.
    """
    write(run_folder.experiment, read(run_folder.experiment))
    for path in (run_folder.validation, run_folder.trajectories):
        path.unlink()
    result = load_result(run_folder.result)
    for name in ("sensor", "validation"):
        del result[name]
    for entry in result["identification"]["parameters"].values():
        entry["true"] = None
    save_result(run_folder.result, result)
    return run_folder


@pytest.mark.slow
def test_report_is_one_page_that_people_can_read_on_any_screen_and_figures_for_print(
    run_folder, browser
):
    """Without a console message and without a request; text differs from what is behind it by 4.5
    to 1 at least.
    """
    path, page = write_report(run_folder.path), browser()
    assert path.stat().st_size < 3e6
    for size, dark in (((1280, 900), False), ((390, 844), True)):
        page.open(path, size=size, dark=dark)
        page.run("document.querySelectorAll('details').forEach(one => { one.open = true })")
        assert (page.console(), page.requests()) == ([], [])
        assert page.run("return document.documentElement.scrollWidth") <= size[0], (
            "the page scrolls sideways"
        )
        drawn = page.run(SIZES)
        assert len(drawn) == len(FIGURES)
        assert min(min(one) for one in drawn) > 100
        worst, text = page.run(CONTRAST)
        assert worst >= 4.5, f"{text!r} has a contrast of {worst:.2f}, dark: {dark}"
    page.open(path, size=(690, 970), dark=True, media="print")
    assert (
        page.run("return getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    )
    assert page.run(
        "return [...document.querySelectorAll('details.printed')].map(one => one.offsetHeight < 40)"
    ) == [False for _ in page.run("return [...document.querySelectorAll('details.printed')]")]
    text = path.read_text(encoding="utf-8")
    assert len(re.findall(r"<section id", text)) == len(SECTIONS)
    assert "<script" not in text
    drawn = {path.stem: imread(path) for path in run_folder.figures.glob("*.png")}
    assert set(drawn) == FIGURES == {path.stem for path in run_folder.figures.glob("*.pdf")}
    assert min(min(image.shape[:2]) for image in drawn.values()) > 300
    assert min(image[..., :3].std() for image in drawn.values()) > 0.02
    # The camera images of the scene reach its lower edge.
    cut = {name: edges_with_ink(image) for name, image in drawn.items() if name != "scene"}
    assert not any(cut.values()), cut


def edges_with_ink(image):
    """Names of the edges of an image (rows, columns, 3 or 4) at which something dark is cut off."""
    edges = {"left": image[:, 0], "right": image[:, -1], "top": image[0], "bottom": image[-1]}
    return [name for name, pixels in edges.items() if pixels[..., :3].min() < 0.8]


@pytest.mark.slow
def test_words_of_the_figures_of_a_run_stand_within_their_files(result):
    estimated = dict(list(result["identification"]["parameters"].items())[:14])
    figures = {
        "parameters": lambda: estimates.parameter_figure(estimated),
        "validation_errors": lambda: fit.validation_figure(result),
        "correlation": lambda: estimates.correlation_figure(np.eye(2), list(estimated)[:2]),
    }
    for name, draw in figures.items():
        image = imread(io.BytesIO(figure_bytes(style.drawn(draw), ".png")))
        assert not edges_with_ink(image), name


def test_rows_that_a_log_lacks_are_counted_and_the_counts_of_its_rows_add_up():
    """600 frames of 60 Hz, of which the log has 593, and whose clock is slightly slow."""
    time = np.delete(np.arange(600) / 60.001, [50, 51, 180, 333, 334, 335, 480])
    assert missing_rows(time, 60.0) == 7
    assert missing_rows(np.arange(600) / 66.0, 60.0) == 0
    ok = np.ones(590, dtype=bool)
    ok[[3, 9]] = False
    record = xr.Dataset(coords={"time": time[3:]})
    record.attrs = {"logged_rows": 593, "missing_rows": 7}
    said = row_counts(record, ok, 60.0)
    rows, used, lost, left, missing, _ = (int(one) for one in re.findall(r"\d+", said))
    assert (rows, used, lost, left, missing) == (593, 588, 2, 3, 7)
    assert rows == used + lost + left


@pytest.mark.slow
def test_words_stand_within_their_file_where_a_layout_changes_the_ticks(result):
    """Ticks of 10 become ticks of 12.5 in the second layout, and move the words to the left."""
    errors = zip(([11.5, 10.9, 11.1], [12.0, 14.2, 11.7]), result["validation"], strict=False)
    runs = [
        run
        | {
            "true": run["true"] | {"orientation_rms_urad": [3.6, 6.4, 3.0]},
            "measured": run["measured"] | {"orientation_rms_urad": measured},
        }
        for measured, run in errors
    ]
    figure = style.drawn(lambda: fit.validation_figure(result | {"validation": runs}))
    for axes in figure.axes:
        assert axes.yaxis.label.get_window_extent().x0 >= 0


SIZES = """
return [...document.querySelectorAll('figure')].map(one => {
  const box = one.querySelector('svg, img').getBoundingClientRect();
  return [box.width, box.height];
})
"""

CONTRAST = """
const colour = text => text.match(/[\\d.]+/g).map(Number);
const light = c => c.slice(0, 3).map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055)
  / 1.055) ** 2.4) .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
const behind = node => {
  for (; node; node = node.parentElement) {
    const c = colour(getComputedStyle(node).backgroundColor);
    if (c.length < 4 || c[3] > 0) return c;
  }
  return [255, 255, 255];
};
let worst = [Infinity, ''];
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const node = walker.currentNode.parentElement, text = walker.currentNode.textContent.trim();
  if (!text || !node.getClientRects().length || ['STYLE', 'style'].includes(node.tagName)) continue;
  const style = getComputedStyle(node);
  const a = light(colour(node.closest('svg') ? style.fill : style.color)), b = light(behind(node));
  const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  if (contrast < worst[0]) worst = [contrast, text];
}
return worst;
"""


@pytest.mark.slow
@pytest.mark.usefixtures("no_images")
def test_report_shows_goals_parameters_the_index_and_names_what_is_missed(finished_run, result):
    data = read_run(finished_run)
    path = random_trajectory(
        np.random.default_rng(0), Chart("free", (0.0,) * 6), 0.1, 5, 0.01, 0.04
    )
    text = page_of(
        replace(data, trajectories=TrajectorySet(0, path, (path,), 0.5293, 0.4606, 0.4603))
    )
    chosen = (
        "0.461 for the first random candidate, 0.460 for the median, and 0.529 for the "
        "trajectory that was used"
    )
    shown = (
        "joint1.coulomb, joint_pid.lp",
        "+0.9877",
        "determines 36 of them better",
        "platform_mass",
        "diverged",
        paper.DOI,
    )
    said = (
        "8 of 8 goals are met",
        "time of excite, record",
        "Not identified, 1 of 5: no motion",
        "it ended because tolerance",
    )
    assert [one for one in (chosen, *shown, *said) if one not in text] == []
    result["sensor"]["lost_frames"] = 2
    result["identification"]["stop_reason"] = "<b>cost & step</b>"
    text = page_of(replace(data, result=result))
    assert "Not met: lost frames 2, required at most 0" in text
    assert "7 of 8 goals are met" in text
    assert "&lt;b&gt;cost &amp; step&lt;/b&gt;" in text


@pytest.mark.slow
@pytest.mark.usefixtures("no_images")
def test_the_papers_figures_stand_only_beside_its_own_robot_and_settings(finished_run):
    data = read_run(finished_run)
    assert "1411" not in page_of(data)
    own = load_scenario("paper")
    for overrides, shown in (
        ({}, True),
        ({"renderer": "analytic"}, True),
        ({"robot": "ups6"}, False),
    ):
        scenario = own.with_overrides(overrides).to_toml()
        text = page_of(replace(data, experiment=data.experiment.assign_attrs(scenario=scenario)))
        assert [one in text for one in ("1411", "2520", "1.345")] == 3 * [shown], overrides


def test_every_axis_has_a_unit_and_every_panel_its_letter(result):
    drawn = fit.fit_figure(Fit(TIME, NOISE, NOISE, NOISE))
    poses, covariances = 1e-3 * np.cumsum(NOISE, axis=0), np.tile(1e-10 * np.eye(6), (50, 1, 1))
    others = (
        paths.excitation_figure(TIME, NOISE),
        paths.ellipse_figure(poses, covariances, list(range(6)), 1e-6 * NOISE),
        fit.validation_figure(result),
        fit.error_figure(Fit(TIME, NOISE, ZERO + NOISE, NOISE, truth=ZERO)),
    )
    for figure in (drawn, *others):
        for axes in figure.axes:
            assert re.search(r"\[(mm|mrad|µm|µrad)\]", axes.get_ylabel()), axes.get_ylabel()
    assert [axes.get_title(loc="left")[:3] or axes.get_title()[:3] for axes in drawn.axes[:3]] == [
        "(a)",
        "(b)",
        "(c)",
    ]
    for axes in paths.path_figure(TIME, poses).axes:
        assert [getattr(axes, f"get_{axis}label")()[-5:].strip(" [") for axis in "xyz"] in (
            3 * ["mm]"],
            3 * ["mrad]"],
        )


def test_no_two_curves_of_a_panel_differ_by_their_colour_alone(result):
    """In print, and for who sees no colours: style of line, width or marker differ too."""
    figures = (
        fit.fit_figure(Fit(TIME, NOISE, NOISE, NOISE, truth=ZERO, predicted=ZERO, std=ZERO + 1)),
        fit.error_figure(Fit(TIME, NOISE, NOISE, NOISE + 1, truth=ZERO)),
        paths.excitation_figure(TIME, NOISE),
    )
    for axes in (axes for figure in figures for axes in figure.axes):
        named = [line for line in axes.lines if not line.get_label().startswith("_")]
        looks = [(line.get_linestyle(), line.get_linewidth(), line.get_marker()) for line in named]
        assert len(named) > 1
        assert len(set(looks)) == len(looks), [line.get_label() for line in named]
    bars = fit.validation_figure(result).axes[0].containers
    assert len({(bar.patches[0].get_hatch(), bar.patches[0].get_facecolor()) for bar in bars}) == 3
    assert len(set(style.PALETTE.values())) == len(style.PALETTE), (
        "the page tells them apart by their code"
    )


@pytest.mark.slow
def test_what_does_not_move_is_not_drawn():
    """Three coordinates, as of delta3; of rrr3 x, y and gamma."""
    for moves, panels, ellipses in (([0, 1, 2], 6, 3), ([0, 1, 5], 6, 1)):
        poses = np.zeros((50, 6))
        poses[:, moves] = 1e-3 * np.cumsum(NOISE, axis=0)[:, moves]
        assert style.moving(poses) == moves
        assert (
            sum(axes.get_visible() for axes in fit.fit_figure(Fit(TIME, poses, poses)).axes)
            == panels
        )
        covariances = np.tile(1e-10 * np.eye(6), (50, 1, 1))
        seen = [
            axes
            for axes in paths.ellipse_figure(poses, covariances, moves).axes
            if axes.get_visible()
        ]
        assert len(seen) == ellipses
    assert len(paths.path_figure(TIME, poses).axes) == 2


@pytest.mark.slow
def test_times_along_a_path_do_not_touch_even_where_it_crosses_itself():
    turns = np.linspace(0, 2 * np.pi, 200)
    poses = np.zeros((200, 6))
    for column, (times, shift) in enumerate(((1, 0.1), (2, 0), (3, 0.3), (2, 0), (3, 1), (1, 2))):
        poses[:, column] = 1e-2 * np.sin(times * turns + shift)
    poses[100:, :3] *= 0.05  # the second half is a knot at the start
    for moves in (range(6), (0, 1, 5)):
        only = np.zeros_like(poses)
        only[:, moves] = poses[:, moves]
        figure = paths.path_figure(np.linspace(0, 10, 200), only)
        figure.draw_without_rendering()
        for axes in figure.axes:
            boxes = [text.get_window_extent() for text in axes.texts]
            assert len(boxes) >= 4
            assert [pair for pair in combinations(boxes, 2) if pair[0].overlaps(pair[1])] == []
    figure = paths.path_figure(
        np.linspace(0, 10, 200), np.sin(turns)[:, None] * np.eye(6)[0] * 1e-2
    )
    figure.draw_without_rendering()
    (axes,) = figure.axes
    shown = axes.transData.transform(axes.lines[0].get_xydata())
    assert len(axes.texts) == 10
    assert not any(text.get_window_extent().contains(*one) for text in axes.texts for one in shown)


def test_ellipses_hold_95_percent_of_drawn_errors():
    """Of 4000 draws of a covariance, by the outline that is drawn."""
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    outline = paths.ellipse_outline(covariance)
    reach = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance), outline)
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(2), covariance, 4000)
    inside = np.einsum("ni,ij,nj->n", draws, np.linalg.inv(covariance), draws) < reach.mean()
    assert np.ptp(reach) < 1e-9
    assert abs(inside.mean() - 0.95) < 4 * math.sqrt(0.95 * 0.05 / 4000)


def test_fit_figure_draws_what_it_is_given_and_a_band_of_two_about_the_predicted_poses():
    """Error panel of z: measured minus identified is 3 µm everywhere, true minus identified
    1 µm."""
    path = 1e-3 * NOISE
    figure = fit.fit_figure(Fit(TIME, path + 3e-6, path, initial=path + 1e-3, truth=path + 1e-6))
    panel = figure.axes[5]
    np.testing.assert_allclose([line.get_ydata()[0] for line in panel.lines], [3.0, 1.0])
    assert "997 → 3.00 µm" in panel.get_title()
    assert [line.get_color() for line in figure.axes[2].lines] == [
        style.INK,
        style.GREEN,
        style.BLUE,
    ]
    expected = {"predicted": path + 1e-6, "std": ZERO + 2e-6}
    panel = fit.fit_figure(Fit(TIME, path, path, truth=path, **expected)).axes[5]
    assert [line.get_ydata()[0] for line in panel.lines[2:]] == pytest.approx([-3.0, 5.0])
    position, orientation = fit.error_figure(Fit(TIME, path, path + 3e-6, truth=path)).axes
    assert position.lines[-1].get_ydata() == pytest.approx(3 * math.sqrt(3))
    assert orientation.lines[0].get_ydata() == pytest.approx(0.0)


def test_an_unstable_model_and_lost_frames_do_not_hide_the_rest():
    """The measurement covers 10 mm; half as much on either side is the most that models get."""
    measured = ZERO + np.linspace(0, 0.01, 50)[:, None]
    measured[5] = np.nan
    shown = Fit(TIME, measured, ZERO + 0.005, initial=1e3 * NOISE)
    assert shown.pose_range(0) == pytest.approx((-6.0, 16.0))
    assert replace(shown, initial=None).pose_range(0) == pytest.approx((-0.5, 10.5))
    diverged = replace(shown, identified=measured, initial=np.full((50, 6), np.nan))
    assert "diverged" in fit.fit_figure(diverged).axes[3].get_title()


def test_correlation_figure_names_every_parameter_or_says_that_none_is_identified():
    correlations = np.array([[1.0, -0.5], [-0.5, 1.0]])
    axes = estimates.correlation_figure(correlations, ["a", "b"]).axes[0]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["a", "b"]
    negative = axes.collections[1]
    assert (tuple(negative.get_offsets()[0]), negative.get_sizes()[0]) == (
        (0.0, 1.0),
        0.5 * estimates.LARGEST,
    )
    with warnings.catch_warnings(action="error"):
        axes = estimates.correlation_figure(np.zeros((0, 0)), []).axes[0]
    assert axes.get_title() == "No parameter is identified: no correlations"
    assert not axes.collections


def test_group_figure_shows_the_share_of_each_member_and_what_is_subtracted():
    """Of 3 m1 - 1 m2 with m1 = m2 = 2 the shares are 3/4 and 1/4; a sum of one parameter is
    none."""
    sums = {
        "m1 +": {"coefficients": {"m1": 3.0, "m2": -1.0}, "identifiable": True},
        "m3": {"coefficients": {"m3": 1.0}, "identifiable": True},
    }
    axes = estimates.group_figure(
        sums, {name: {"initial": 2.0} for name in ("m1", "m2", "m3")}
    ).axes[0]
    added, subtracted = axes.collections[:2]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["m1", "m2"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["m1 … *"]
    np.testing.assert_allclose(added.get_sizes(), [0.75 * estimates.LARGEST])
    np.testing.assert_allclose(subtracted.get_sizes(), [0.25 * estimates.LARGEST])
    assert subtracted.get_facecolor()[0][:3] == pytest.approx((1.0, 1.0, 1.0))


def test_parameter_figure_shows_what_is_identifiable_with_its_interval(result):
    """One that a bound cuts off reaches less far down than up."""
    figure = estimates.parameter_figure(result["identification"]["parameters"])
    labels = [text.get_text() for axes in figure.axes for text in axes.get_yticklabels()]
    assert labels == ["joint1.coulomb", "joint1.viscous", "joint_pid.lp", "platform.mass"]
    entry = {"true": 2.0, "estimate": 1.0, "std": 3.0, "interval": [0.5, 6.0], "identifiable": True}
    figure = estimates.parameter_figure({"link1.mass": entry})
    segments = [line.get_segments()[0] for line in figure.axes[1].collections]
    np.testing.assert_allclose(
        [segment[:, 0] for segment in segments], [[100 * -1.5 / 2, 100 * 4.0 / 2]]
    )
    assert estimates.relative_errors({"a": entry | {"interval": None}})[1:] == (-50.0, 0.0, 0.0)
    assert estimates.relative_errors({"a": entry | {"true": None}})[1:] == (0.0, 50.0, 500.0), (
        "of the estimate"
    )


@pytest.mark.slow
def test_model_of_another_run_an_incomplete_result_and_a_missing_stage_are_refused(run_folder):
    """With the command that does what is missing."""
    short = build_model_run(np.arange(5) / 60, np.zeros((5, 6)), np.zeros((5, 6)))
    write_model_runs(run_folder.model, short, [short, short])
    with pytest.raises(RecordError, match="excitation differs"):
        write_report(run_folder.path)
    save_result(run_folder.result, {"scenario": "quick"})
    with pytest.raises(
        RecordError, match=r"lacks .*before, after, seconds, sensor, .*; write .*cmmsim identify"
    ):
        write_report(run_folder.path)
    run_folder.validation.unlink()
    with pytest.raises(
        OutputFolderError, match=r"no validation\.nc; write it with: cmmsim validate --out"
    ):
        write_report(run_folder.path)
    assert not run_folder.report.exists()


@pytest.mark.slow
def test_a_record_without_truth_has_a_report_that_says_what_nobody_can_tell(run_folder):
    """Beside the models' errors against the measurement; no column and no figure of a truth."""
    data = read_run(without_truth(run_folder))
    text = page_of(data)
    assert "The truth is not known for this record" in text
    assert "2 of 2 goals are met" in text
    assert "<th" in text
    assert ">truth<" not in text
    shown = pictures(data)
    assert {"fit_validation", "validation_errors", "stereo_frame"} & shown.keys() == set()
    assert [
        len(figure.axes) > 0 for figure in (shown["errors"].draw(), shown["ellipses"].draw())
    ] == [True, True]
    assert data.excitation_fit.noise == pytest.approx(
        np.sqrt(np.diag(data.experiment["measured_covariance"][0]))
    )
    assert list(identify.run_figures(run_folder.path)) == list(shown)
    assert "excitation.duration_s" not in text, "nothing is compared with a built-in scenario"
    wanted = ("reference_position", "reference_orientation")
    undirected = replace(data, experiment=data.experiment.drop_vars(wanted))
    assert "measured poses" in pictures(undirected)["excitation"].caption
    assert "desired" in shown["excitation"].caption
    scenario = load_scenario("quick", **{"excitation.harmonics": 3}).to_toml()
    keys = [
        {row[0] for row in tables.settings_table(data.result, scenario, designed).rows}
        for designed in (True, False)
    ]
    assert keys[0] - keys[1] == {"excitation.harmonics"}


def test_a_scene_whose_robot_is_gone_is_not_drawn_and_the_page_says_why(finished_run):
    data = read_run(finished_run)
    gone = data.scenario_toml.replace('robot = "rss6"', 'robot = "/gone/mine.toml"')
    data = replace(data, experiment=data.experiment.assign_attrs(scenario=gone))
    assert {"scene", "stereo_frame"} & pictures(data).keys() == set()
    assert "Robot and cameras are not drawn: " in page_of(data)


def test_a_model_is_called_wrong_only_where_the_cameras_cannot_be_the_cause(result):
    assert verdict(result, True).headline == "The identified model moves as the true robot does."
    result["identification"]["whiteness"]["p_value"] = 1e-9
    assert verdict(result, True).headline == "The model does not describe the robot."
    for unknown in (None, False):
        assert verdict(result, unknown).headline == (
            "Model and measurement disagree, because of an error of the model or of the cameras."
        )
    assert "less than 10⁻⁶ %" in verdict(result, None).sentences[0]
    for name in ("sensor", "validation"):
        del result[name]
    said = verdict(result, None)
    assert not said.good
    assert "the record alone cannot tell" in said.sentences[0]


def test_cameras_are_acquitted_when_they_err_by_white_noise_of_the_size_that_they_state():
    record, plant = short_run()
    truth = truth_of(plant)
    assert cameras_consistent(record, truth) is True
    assert cameras_consistent(record, None) is None
    bold = record.assign(measured_covariance=record["measured_covariance"] / 4)
    assert cameras_consistent(bold, truth) is False, "they state half of their noise"
    lasting = record["measured_position"] + 5e-6 * np.sin(6 * record["time"])
    assert cameras_consistent(record.assign(measured_position=lasting), truth) is False, (
        "an error that lasts"
    )
    shifted = record.assign(measured_position=record["measured_position"] + 1e-4)
    assert cameras_consistent(shifted, truth) is False, "an error that is not stated"
    changes = np.zeros((record.sizes["time"], 6, 1))
    changes[:, :3] = 1e-4
    store_common_errors(shifted, CommonErrors(("left.cx_px",), changes, np.eye(1)))
    assert cameras_consistent(shifted, truth) is True, "stated, and the same in all frames"
    assert cameras_consistent(record.isel(time=slice(20)), truth.isel(time=slice(20))) is None, (
        "too short to say"
    )


def test_the_first_look_has_three_numbers_with_and_without_truth(result):
    assert [one.value for one in key_numbers(result)] == ["1.8", "7", "4"]
    assert all("RMS of the worst axis" in one.meaning for one in key_numbers(result)[:2])
    for name in ("sensor", "validation"):
        del result[name]
    assert [one.value for one in key_numbers(result)] == ["22", "–", "4"]


def test_numbers_have_the_digits_that_they_deserve_and_what_is_rounding_is_zero():
    assert [number(value) for value in (12345.6, 0.00052349, -2.0e-9, None, math.inf)] == [
        "12350", "0.0005235", "−2 × 10⁻⁹", "-", "-",
    ]  # fmt: skip
    assert [significant(value) for value in (0.4603, 11.04, 1132.4, 9.996, -0.0305, 2e-9, None)] == [
        "0.460", "11.0", "1130", "10.0", "−0.0305", "2 × 10⁻⁹", "-",
    ]  # fmt: skip
    assert with_deviation(0.104632, 0.00112) == "0.1046 ± 0.0011"
    assert with_deviation(-5.231e-6, 3.3e-7) == "(−5.23 ± 0.33) × 10⁻⁶"
    assert with_deviation(2.0, None) == "2"
    assert interval(0.10271, 0.10629) == "0.1027 to 0.1063"
    assert interval(-0.0131, 0.344) == "−0.01 to 0.34"
    assert rounded(-6.688e-15, 1.3) == 0.0
    assert rounded(-6.688e-15, 1e-14) == -6.688e-15
    assert (
        typographic("cost changed by 3.35e-07 <= tol1 = 1e-06")
        == "cost changed by 3.35 × 10⁻⁷ ≤ tol1 = 1 × 10⁻⁶"
    )


def test_the_report_says_what_fixes_the_scale_or_that_its_anchor_does_not(result):
    found = result["identification"]
    fixed = (
        "The overall scale, which poses do not show, is fixed by the weighed mass of the platform"
    )
    assert parameter_tables.scale_sentence(found) == f"{fixed}."
    assert not any(row[-1] == "input" for row in parameter_tables.parameter_table(result).rows)
    found |= {"scale_anchor_value": 23.51, "scale_anchor_std": 0.005}
    weighed = {"unit": "kg", "initial": 24.0, "true": 23.5, "identifiable": True}
    found["parameters"]["platform.mass"] = weighed | {"estimate": 23.51, "std": 0.005}
    said = parameter_tables.scale_sentence(found)
    assert said.startswith(f"{fixed}: 23.5100 ± 0.0050 kg. platform.mass is therefore an input")
    table = parameter_tables.parameter_table(result)
    assert [row[0] for row in table.rows if row[-1] == "input"] == ["platform.mass"]
    assert table.note.endswith("measured beforehand: platform.mass as 23.5100 ± 0.0050 kg. ")
    found["parameters"]["joint_pid.lp"]["prior_share"] = 0.61
    assert "but is not: 61 % of the variance" in parameter_tables.scale_sentence(found)
    found["scale_anchor"] = "prior"
    assert "off by one common factor" in parameter_tables.scale_sentence(found)


def test_what_is_not_identified_has_its_reason():
    """One that is shown only in a sum, one that this record shows too badly, and one that moves
    nothing.
    """
    entries = {
        name: {"identifiable": name == "known"}
        for name in ("known", "summed", "weak", "unseen", "joint_pid.li")
    }
    groups = {
        "known +": {"coefficients": {"known": 1.0, "summed": 2.0}},
        "weak": {"coefficients": {"weak": 1.0}},
    }
    reasons = parameter_tables.unidentified({"parameters": entries, "groups": groups})
    assert [names for _, names in reasons] == [["summed"], ["weak", "joint_pid.li"], ["unseen"]]
    for entry in entries.values():
        entry["identifiable"] = False
    found = {"parameters": entries, "groups": groups}
    found |= {"noise_ratio": 3.3, "expected_noise_ratio": 1.1, "noise_ratio_std": 0.1}
    assert len(parameter_tables.unidentified(found)) > 1, "a short record is no wrong model"
    ((reason, names),) = parameter_tables.unidentified(found | {"noise_ratio": 3.4})
    assert reason.startswith("the model does not explain the record")
    assert len(names) == 5


def parameters_of(result):
    return result["identification"]["parameters"]


def goals(result):
    return {goal.name: goal for goal in check_goals(result)}


def test_rms_figures_are_in_um_and_urad_and_a_model_that_diverged_has_none_however_well_it_began():
    errors = np.array([[3e-6, 0, 0, 1e-3, 0, 0], [np.nan] * 6, [-4e-6, 0, 0, 1e-3, 0, 0]])
    assert rms_row(rms_figures(errors, [True, False, True])) == pytest.approx(
        [math.sqrt(12.5), 0, 0, 1000, 0, 0]
    )
    errors = np.zeros((10, 6))
    errors[9] = np.inf
    assert all(math.isnan(v) for v in rms_row(rms_figures(errors)))
    assert all(math.isnan(v) for v in rms_row(rms_figures(errors, np.zeros(10, dtype=bool))))


def test_result_file_is_standard_json_with_null_for_what_is_not_finite_and_a_damaged_one_is_named(
    tmp_path,
):
    path = tmp_path / "result.json"
    save_result(
        path,
        {
            "a": np.float64(1.5),
            "b": [math.inf, np.nan],
            "c": np.arange(2),
            "d": {"e": np.bool_(True)},
        },
    )
    plain = {"a": 1.5, "b": [None, None], "c": [0, 1], "d": {"e": True}}
    held = json.loads(
        path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is no standard JSON")
    )
    assert held | plain == held
    assert load_result(path) == plain
    for text in ('{"a": ', "[1]", ""):
        path.write_text(text)
        with pytest.raises(RecordError, match=r"result\.json"):
            load_result(path)


def test_good_result_meets_every_goal_and_one_without_validation_those_that_can_be_judged(result):
    assert len(goals(result)) == 8
    assert all(goal.passed for goal in goals(result).values())
    assert goals(result)["validation motion, position"].value == pytest.approx(1.8)
    assert goals(result)["cameras, orientation"].value == 50.0
    assert goals(result)["residual variance / noise variance"].limit == pytest.approx(
        1.1 + 3.0902 * 0.04, abs=1e-5
    )
    assert check_goals({"scenario": "quick"}) == []


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        (
            lambda r: r["validation"][1]["true"].update(position_rms_um=[1, 2.1, 1]),
            "validation motion, position",
        ),
        (
            lambda r: r["validation"][1]["true"].update(orientation_rms_urad=[1, 1, 10.1]),
            "validation motion, orientation",
        ),
        (
            lambda r: r["validation"][0]["true"].update(position_rms_um=[None, 1, 1]),
            "validation motion, position",
        ),
        (lambda r: r["sensor"].update(position_rms_um=[20.1, 1, 1]), "cameras, position"),
        (lambda r: r["sensor"].update(orientation_rms_urad=[1, 100.1, 1]), "cameras, orientation"),
        (lambda r: r["sensor"].update(lost_frames=1), "lost frames"),
        (
            lambda r: r["identification"]["parameters"]["joint_pid.lp"].update(estimate=11.6),
            "friction and gains far off",
        ),
        (
            lambda r: r["identification"].update(noise_ratio=1.31),
            "residual variance / noise variance",
        ),
        (
            lambda r: r["identification"].update(noise_ratio=1.1 + 3.1 * 0.04),
            "residual variance / noise variance",
        ),
        (
            lambda r: r["identification"].update(noise_ratio=None),
            "residual variance / noise variance",
        ),
        (
            lambda r: r["identification"]["whiteness"].update(p_value=9e-5),
            "p value of the residuals",
        ),
        (
            lambda r: r["identification"]["whiteness"].update(p_value=None),
            "p value of the residuals",
        ),
    ],
)
def test_each_goal_is_missed_alone(result, change, missed):
    change(result)
    assert [name for name, goal in goals(result).items() if not goal.passed] == [missed]


def test_speed_stands_beside_the_goals_and_no_machine_misses_one(result):
    result["sensor"]["stereo_frames_per_second"] = 0.5
    result["seconds"] = {
        "record": 3000.0,
        "identify": 20.0,
        "identify.search": 15.0,
        "validate": None,
    }
    frames, whole = tables.goals_table(result).rows[-2:]
    assert frames[:4] == ("processed stereo frames", "0.5 1/s", "", "")
    assert whole == ("time of record, identify", "3020 s", "", "", "compiling included")
    assert all(goal.passed for goal in check_goals(result))
    result["seconds"]["total"] = 3500.0
    assert tables.goals_table(result).rows[-1][:2] == ("whole run", "3500 s")


def test_the_report_lists_the_times_of_all_stages_before_it(run_folder, monkeypatch):
    shown = []

    def written(folder, *_):
        shown.extend(tables.seconds_table(load_result(RunFolder(folder).result)).rows)

    monkeypatch.setattr("identify.reporting.report.write_report", written)
    pipeline.report(run_folder.path, SilentProgress(), 0.0, {"excite": 2.5, "teach": 1.5})
    assert shown == [("excite", "1"), ("teach", "1.5"), ("record", "30")]


def test_parameter_is_inside_by_five_percent_or_three_deviations():
    for estimate, std in ((1.049, 0.0), (1.06, 0.021), (1.0, None)):
        assert within_tolerance({"true": 1.0, "estimate": estimate, "std": std}) is True
    for estimate, std in ((1.06, 0.0), (0.94, 0.019), (None, 0.1)):
        assert within_tolerance({"true": 1.0, "estimate": estimate, "std": std}) is False


def test_papers_figures_are_those_of_its_text():
    """All ten runs below 0.8 mm, and below 1.4 mrad but for one (section 4.3)."""
    rows = np.array(paper.VALIDATION)
    assert rows.shape == (10, 6)
    assert rows[:, :3].max() < 800
    assert (rows[:, 3:] > 1400).sum() == 1
    assert np.all(np.array(paper.AFTER) < paper.BEFORE)


def test_tables_show_our_numbers_beside_the_papers_and_none_of_a_parameter_that_is_not_identifiable(
    result,
):
    table = tables.excitation_error_table(result, repeats_paper=True)
    assert table.rows[0] == ("x [µm]", "diverged", "20.0", "1260", "408")
    assert table.rows[5] == ("gamma [µrad]", "diverged", "82.0", "2800", "725")
    assert tables.excitation_error_table(result).rows[5] == ("gamma [µrad]", "diverged", "82.0")
    validation = tables.validation_table(result, repeats_paper=True)
    assert validation.header[1] == "x [µm]"
    assert validation.rows[0][:4] == ("1: identified, true", "1.00", "1.40", "1.80")
    assert len(validation.rows) == 2 * 2 + 10
    assert len(tables.validation_table(result).rows) == 2 * 2
    assert tables.sensor_table(result).rows[0][:4] == ("120", "0", "70", "5.00")
    result["validation"][0]["initial_true"] = {
        "position_rms_um": [None] * 3,
        "orientation_rms_urad": [None] * 3,
    }
    assert tables.validation_table(result).rows[2] == ("1: initial, true", *["diverged"] * 6)
    lines = tables.goals_table(result).markdown().splitlines()
    assert {line.count("|") for line in lines} == {6}, "a cell for each column"
    assert tables.goals_table(result).words == (True, False, False, True, True)
    rows = {row[0]: row for row in parameter_tables.parameter_table(result).rows}
    assert "link1.Ixx" not in rows
    assert rows["joint1.coulomb"][1:] == (
        "N m",
        "0",
        "0.104",
        "0.1050 ± 0.0010",
        "0.1030 to 0.1070",
        "+0.96",
    )
    # Its standard deviation is 14 % of the truth.
    result["identification"]["parameters"] = {
        "link4.mass": result["identification"]["parameters"]["joint1.coulomb"]
        | {"true": 1.31, "estimate": 1.73, "std": 0.19}
    }
    assert parameter_tables.parameter_table(result).rows[0][-1] == "+32"


def test_bars_and_diamonds_of_a_validation_run_are_of_the_same_poses(result):
    """The actual distance from the predicted poses, and not that from the model alone."""
    for run in result["validation"]:
        run["predicted"] |= {
            "position_rms_um": [0.5, 0.6, 0.7],
            "orientation_rms_urad": [3.0, 4.0, 5.0],
        }
    panels = fit.validation_figure(result).axes
    heights = [[bar.get_height() for bar in bars] for axes in panels for bars in axes.containers]
    assert heights == [[size, size] for size in (0.5, 0.6, 0.7, 3.0, 4.0, 5.0)]
    diamonds = [list(line.get_ydata()) for line in panels[0].lines if line.get_marker() == "D"]
    assert diamonds == [[size, size] for size in (1.5, 2.5, 3.5)]
    # The limits of the goals are about other poses, and no line is drawn at them.
    assert {line.get_marker() for line in panels[0].lines} == {"D", "_"}
    assert [row[1] for row in tables.prediction_table(result).rows[:2]] == ["1.50", "0.500"]


def test_the_page_says_how_many_quantities_a_motion_shows_and_why_noise_gives_more_than_one(result):
    """Two sums and one single parameter, with 39 directions beside the common factor."""
    found = result["identification"]
    several = {"coefficients": {"link1.mass": 1.0, "link1.Ixx": 2.0}, "identifiable": True}
    single = {"coefficients": {"joint1.coulomb": 1.0}, "identifiable": True}
    found["groups"] = {"a": several, "b": several, "c": single}
    (said,) = report_sections._conditioning_text(found)
    assert "these 2 + 1 + 37 = 40 quantities up to one common factor, so that 39" in said
    details = [goal.detail for goal in check_goals(result)]
    assert any("1.100 ± 0.040, more than 1 as it also moves the robot" in text for text in details)
    sentences = " ".join(verdict(result, True).sentences)
    assert (
        "Noise alone gives up to 1.22, more than 1 because noise also moves the robot." in sentences
    )
    found["expected_noise_ratio"] = 1.0
    assert not any("more than 1" in goal.detail for goal in check_goals(result))


def test_common_errors_are_in_small_units_and_the_note_explains_only_the_kinds_that_are_there(
    result,
):
    found = result["identification"]
    for name, centres in (("taught.base.tx_m", False), ("centres.link.mx_kg m", True)):
        for key in ("nuisances", "nuisance_estimates", "nuisance_prior_std"):
            found[key] = {name: 1e-6}
        table = parameter_tables.common_error_table(result)
        assert ("Centres of mass" in table.note) == centres
        unit = () if centres else ("µm",)
        size = "1 × 10⁻⁶" if centres else "1"
        assert table.rows[0][: len(unit) + 2] == (name, *unit, size)


def test_a_sum_that_vanishes_but_for_rounding_starts_at_zero(result):
    """And its error is told in standard deviations: in per cent of almost nothing it says
    nothing."""
    link = {"initial": 1.31, "identifiable": True, "unit": "kg"}
    result["identification"]["parameters"] = {"link1.mass": link, "link2.mass": link}
    entry = {
        "initial": -6.688e-15,
        "true": 0.071,
        "estimate": 0.163,
        "std": 0.088,
        "interval": [-0.01, 0.34],
    }
    group = {
        "coefficients": {"link1.mass": 1.0, "link2.mass": -1.0},
        "expression": "link1.mass - link2.mass",
    }
    result["identification"]["groups"] = {
        "link1.mass +": entry | group | {"identifiable": True, "rests_on_prior": True}
    }
    (row,) = parameter_tables.group_table(result).rows
    assert row == (
        "link1.mass − link2.mass", "0", "0.071", "0.163 ± 0.088", "−0.01 to "
                                                                  "0.34", "+1.0",
                                                                  parameter_tables.ON_GUESS,
    )  # fmt: skip
