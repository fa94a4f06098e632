import re
import warnings
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.image import imread

from identify.errors import OutputFolderError, RecordError
from identify.files.run_folder import load_result, save_result
from identify.record.recording import build_model_run, write_model_runs
from identify.reporting import figures
from identify.reporting.report import SECTIONS, read_report_data, render, write_report
from identify.trajectory import TrajectorySet, random_trajectory, save_trajectories

FIGURES = {"excitation", "fit_excitation", "fit_validation", "validation_errors", "parameters", "correlation"}


class Structure(HTMLParser):
    """Tags that must be balanced, and whatever an open file would fetch."""

    def __init__(self, text):
        super().__init__()
        self.open, self.fetched = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag in ("section", "table", "tr", "td", "script", "div"):
            self.open.append(tag)
        self.fetched += [v for k, v in attrs if k == "src" or (tag == "link" and k == "href")]

    def handle_endtag(self, tag):
        if self.open and self.open[-1] == tag:
            self.open.pop()


def test_report_is_one_file_that_opens_offline_beside_its_figures(run_folder):
    path = write_report(run_folder.path)
    text = path.read_text(encoding="utf-8")
    structure = Structure(text)
    assert structure.open == []
    assert all(source.startswith("data:") for source in structure.fetched)
    assert len(re.findall(r"<h2>", text)) == len(SECTIONS)
    assert text.count("Copyright 2012") <= 2, "plotly's JavaScript stands in it once"
    assert 4e6 < path.stat().st_size < 9e6
    assert text.count("Plotly.newPlot(") >= 5
    check_figures(run_folder.figures)


def check_figures(folder):
    """Readable images with something on them."""
    paths = {p.stem: p for p in folder.iterdir()}
    assert set(paths) == FIGURES
    for path in paths.values():
        image = imread(path)
        assert min(image.shape[:2]) > 500
        assert image[..., :3].std() > 0.02


def test_report_shows_goals_parameters_and_the_papers_numbers(run_folder):
    text = render(read_report_data(run_folder))
    for shown in (
        "All 8 goals are met.",
        "joint1.coulomb",
        "not identifiable",
        "1260",
        "1411",
        "platform_mass",
        "timing.frame_rate_hz",
        "diverged",
        "stopped by: tolerance",
        "joint1.coulomb, joint_pid.lp",
        "+0.9877",
        "2.0e+11 of the poses alone",
        "1 predicted std",
    ):
        assert shown in text, shown


def test_report_states_the_observability_index(run_folder):
    path = random_trajectory(np.random.default_rng(0), np.zeros(6), 0.1, 5, 0.01, 0.04)
    save_trajectories(run_folder.trajectories, TrajectorySet(0, path, (path,), 0.5293, 0.4606, 0.4603))
    text = render(read_report_data(run_folder))
    assert "0.461 of the first random candidate, 0.46 of the middle one, 0.529 of the trajectory that is used" in text
    assert "from 0.38 to 1.345" in text


def test_report_names_what_is_missed_and_escapes_text(run_folder):
    result = load_result(run_folder.result)
    result["sensor"]["lost_frames"] = 2
    result["identification"]["stop_reason"] = "<b>cost & step</b>"
    save_result(run_folder.result, result)
    text = render(read_report_data(run_folder))
    assert "Missed: lost frames." in text
    assert "&lt;b&gt;cost &amp; step&lt;/b&gt;" in text


def test_every_axis_has_a_unit_and_every_panel_its_letter(run_folder, result):
    time, pose = np.arange(120) / 60, np.random.default_rng(0).normal(size=(120, 6))
    for figure in (
        figures.excitation_figure(time, pose),
        figures.fit_figure(time, pose, pose, pose, "t"),
        figures.validation_figure(result["validation"]),
    ):
        for axes in figure.axes:
            assert re.search(r"\[(mm|mrad|um|urad)\]", axes.get_ylabel()), axes.get_ylabel()
        assert "trajectory" in figure.axes[-1].get_xlabel() or figure.axes[-1].get_xlabel() == "time [s]"
    titles = [axes.get_title() for axes in figures.fit_figure(time, pose, pose, pose, "t").axes]
    assert [t[:3] for t in titles[:6]] == ["(a)", "(b)", "(c)", "(d)", "(e)", "(f)"]


def test_fit_figure_draws_what_it_is_given():
    """Error panel of z: measured minus identified is 3 um everywhere, true minus identified 1 um."""
    time, identified = np.arange(50) / 60, np.zeros((50, 6))
    figure = figures.fit_figure(time, identified + 3e-6, identified + 1e-3, identified, "t", truth=identified + 1e-6)
    panel = figure.axes[8]
    np.testing.assert_allclose([line.get_ydata()[0] for line in panel.lines], [3.0, 1.0])
    assert not panel.collections, "no band where nothing was predicted"
    assert "997 um → 3 um" in panel.get_title()
    colours = [line.get_color() for line in figure.axes[2].lines]
    assert colours == ["black", "tab:green", "tab:blue"]


def test_predicted_deviations_are_a_band_of_two_about_zero():
    time, identified = np.arange(50) / 60, np.zeros((50, 6))
    std = np.full((50, 6), 2e-6)
    figure = figures.fit_figure(time, identified, None, identified, "t", truth=identified, std=std)
    edges = figure.axes[8].collections[0].get_paths()[0].vertices[:, 1]
    assert (edges.min(), edges.max()) == pytest.approx((-4.0, 4.0))


def test_correlation_figure_names_every_parameter():
    correlations = np.array([[1.0, -0.5], [-0.5, 1.0]])
    axes = figures.correlation_figure(correlations, ["a", "b"]).axes[0]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["a", "b"]
    np.testing.assert_array_equal(axes.images[0].get_array(), correlations)


def test_without_identified_parameters_a_correlation_figure_says_so_and_warns_of_nothing():
    with warnings.catch_warnings(action="error"):
        axes = figures.correlation_figure(np.zeros((0, 0)), []).axes[0]
    assert axes.get_title() == "No parameter is identified: no correlations"
    assert not axes.images


def test_figures_survive_lost_frames_and_a_model_that_diverged_at_once():
    time, pose = np.arange(50) / 60, np.random.default_rng(0).normal(size=(50, 6))
    measured = pose.copy()
    measured[5] = np.nan
    figure = figures.fit_figure(time, measured, np.full((50, 6), np.nan), pose, "t")
    assert "diverged" in figure.axes[6].get_title()
    figures.fit_figure(time, measured, None, pose, "t")


def test_parameter_figure_leaves_out_what_is_not_identifiable(result):
    figure = figures.parameter_figure(result["identification"]["parameters"])
    labels = [text.get_text() for axes in figure.axes for text in axes.get_yticklabels()]
    assert labels == ["joint1.coulomb", "joint1.viscous", "joint_pid.lp", "platform.mass"]


def test_bars_of_a_parameter_span_its_interval():
    """One that a bound cuts off reaches less far down than up."""
    entry = {"true": 2.0, "estimate": 1.0, "std": 3.0, "interval": [0.5, 6.0], "identifiable": True}
    figure = figures.parameter_figure({"link1.mass": entry})
    segments = [line.get_segments()[0] for line in figure.axes[1].collections]
    np.testing.assert_allclose([segment[:, 0] for segment in segments], [[100 * -1.5 / 2, 100 * 4.0 / 2]])
    assert figures.interval_bars({"estimate": 1.0}) == (0.0, 0.0)


def test_missing_stage_is_named_with_the_command_that_does_it(run_folder):
    run_folder.validation.unlink()
    with pytest.raises(OutputFolderError, match=r"no validation\.nc; write it with: cmmsim validate --out"):
        write_report(run_folder.path)
    assert not run_folder.report.exists()


def test_model_of_another_run_is_refused(run_folder):
    short = build_model_run(np.arange(5) / 60, np.zeros((5, 6)), np.zeros((5, 6)))
    write_model_runs(run_folder.model, short, [short, short])
    with pytest.raises(RecordError, match="excitation differs"):
        write_report(run_folder.path)


def test_incomplete_result_is_named(run_folder):
    save_result(run_folder.result, {"scenario": "quick"})
    with pytest.raises(RecordError, match=r"lacks .*before, after, seconds, sensor, .*; write .*cmmsim identify"):
        write_report(run_folder.path)
