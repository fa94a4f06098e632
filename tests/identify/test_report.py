"""The figures and the report of a run: what they show, that they open offline, and what they refuse."""

import re
import warnings
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.image import imread

from identify.errors import OutputFolderError, RecordError
from identify.files.run_folder import save_result
from identify.record.recording import build_model_run, write_model_runs
from identify.reporting import figures, report_plots
from identify.reporting.figures import Fit
from identify.reporting.report import SECTIONS, read_report_data, render, write_report
from identify.trajectory import TrajectorySet, random_trajectory

FIGURES = {"excitation", "fit_excitation", "fit_validation", "validation_errors", "parameters", "correlation"}
TIME, ZERO = np.arange(50) / 60, np.zeros((50, 6))
NOISE = np.random.default_rng(0).normal(size=(50, 6))


@pytest.fixture(scope="module")
def data(finished_run):
    return read_report_data(finished_run)


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


def test_report_is_one_file_that_opens_offline_beside_readable_figures(run_folder):
    path = write_report(run_folder.path)
    text = path.read_text(encoding="utf-8")
    structure = Structure(text)
    assert structure.open == []
    assert all(source.startswith("data:") for source in structure.fetched)
    assert len(re.findall(r"<h2>", text)) == len(SECTIONS)
    assert text.count("Copyright 2012") <= 2, "plotly's JavaScript stands in it once"
    assert 4e6 < path.stat().st_size < 9e6
    assert text.count("Plotly.newPlot(") >= 5
    drawn = {path.stem: imread(path) for path in run_folder.figures.iterdir()}
    assert set(drawn) == FIGURES
    assert min(min(image.shape[:2]) for image in drawn.values()) > 500
    assert min(image[..., :3].std() for image in drawn.values()) > 0.02


def test_report_shows_goals_parameters_the_index_and_the_papers_numbers_and_names_what_is_missed(data, result):
    path = random_trajectory(np.random.default_rng(0), np.zeros(6), 0.1, 5, 0.01, 0.04)
    text = render(replace(data, trajectories=TrajectorySet(0, path, (path,), 0.5293, 0.4606, 0.4603)))
    chosen = "0.461 of the first random candidate, 0.46 of the middle one, 0.529 of the trajectory that is used"
    correlated = ("joint1.coulomb, joint_pid.lp", "+0.9877", "2.0e+11 of the poses alone")
    papers = ("1260", "1411", "from 0.38 to 1.345")
    settings = ("platform_mass", "timing.frame_rate_hz", "stopped by: tolerance")
    figures_ = ("All 8 goals are met.", "whole run", "not identifiable", "diverged", "1 predicted std")
    assert [shown for shown in (chosen, *correlated, *papers, *settings, *figures_) if shown not in text] == []
    result["sensor"]["lost_frames"] = 2
    result["identification"]["stop_reason"] = "<b>cost & step</b>"
    text = render(replace(data, result=result))
    assert "Missed: lost frames." in text
    assert "&lt;b&gt;cost &amp; step&lt;/b&gt;" in text


def test_every_axis_has_a_unit_and_every_panel_its_letter(result):
    fit = figures.fit_figure(Fit(TIME, NOISE, NOISE, NOISE), "t")
    for figure in (fit, figures.excitation_figure(TIME, NOISE), figures.validation_figure(result["validation"])):
        for axes in figure.axes:
            assert re.search(r"\[(mm|mrad|um|urad)\]", axes.get_ylabel()), axes.get_ylabel()
        assert "trajectory" in figure.axes[-1].get_xlabel() or figure.axes[-1].get_xlabel() == "time [s]"
    assert [axes.get_title()[:3] for axes in fit.axes[:6]] == ["(a)", "(b)", "(c)", "(d)", "(e)", "(f)"]


def test_fit_figure_draws_what_it_is_given_and_predicted_deviations_as_a_band_of_two_about_zero():
    """Error panel of z: measured minus identified is 3 um everywhere, true minus identified 1 um."""
    figure = figures.fit_figure(Fit(TIME, ZERO + 3e-6, ZERO, initial=ZERO + 1e-3, truth=ZERO + 1e-6), "t")
    panel = figure.axes[8]
    np.testing.assert_allclose([line.get_ydata()[0] for line in panel.lines], [3.0, 1.0])
    assert not panel.collections, "no band where nothing was predicted"
    assert "997 um → 3 um" in panel.get_title()
    assert [line.get_color() for line in figure.axes[2].lines] == [figures.BLACK, figures.GREEN, figures.BLUE]
    figure = figures.fit_figure(Fit(TIME, ZERO, ZERO, truth=ZERO, std=ZERO + 2e-6), "t")
    edges = figure.axes[8].collections[0].get_paths()[0].vertices[:, 1]
    assert (edges.min(), edges.max()) == pytest.approx((-4.0, 4.0))


def test_an_unstable_model_and_lost_frames_do_not_hide_the_rest():
    """The measurement covers 10 mm; half as much on either side is the most that models get."""
    measured = ZERO + np.linspace(0, 0.01, 50)[:, None]
    measured[5] = np.nan
    fit = Fit(TIME, measured, ZERO + 0.005, initial=1e3 * NOISE)
    assert fit.pose_range(0) == pytest.approx((-6.0, 16.0))
    assert replace(fit, initial=None).pose_range(0) == pytest.approx((-0.5, 10.5))
    diverged = replace(fit, initial=np.full((50, 6), np.nan))
    assert "diverged" in figures.fit_figure(diverged, "t").axes[6].get_title()
    assert report_plots.fit_plot(diverged).count("starting model") == 12


def test_correlation_figure_names_every_parameter_or_says_that_none_is_identified():
    correlations = np.array([[1.0, -0.5], [-0.5, 1.0]])
    axes = figures.correlation_figure(correlations, ["a", "b"]).axes[0]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["a", "b"]
    np.testing.assert_array_equal(axes.images[0].get_array(), correlations)
    with warnings.catch_warnings(action="error"):
        axes = figures.correlation_figure(np.zeros((0, 0)), []).axes[0]
    assert axes.get_title() == "No parameter is identified: no correlations"
    assert not axes.images


def test_parameter_figure_shows_what_is_identifiable_with_its_interval(result):
    """One that a bound cuts off reaches less far down than up."""
    figure = figures.parameter_figure(result["identification"]["parameters"])
    labels = [text.get_text() for axes in figure.axes for text in axes.get_yticklabels()]
    assert labels == ["joint1.coulomb", "joint1.viscous", "joint_pid.lp", "platform.mass"]
    entry = {"true": 2.0, "estimate": 1.0, "std": 3.0, "interval": [0.5, 6.0], "identifiable": True}
    figure = figures.parameter_figure({"link1.mass": entry})
    segments = [line.get_segments()[0] for line in figure.axes[1].collections]
    np.testing.assert_allclose([segment[:, 0] for segment in segments], [[100 * -1.5 / 2, 100 * 4.0 / 2]])
    assert figures.relative_errors({"a": entry | {"interval": None}})[1:] == (-50.0, 0.0, 0.0)


def test_model_of_another_run_an_incomplete_result_and_a_missing_stage_are_refused(run_folder):
    """With the command that does what is missing."""
    short = build_model_run(np.arange(5) / 60, np.zeros((5, 6)), np.zeros((5, 6)))
    write_model_runs(run_folder.model, short, [short, short])
    with pytest.raises(RecordError, match="excitation differs"):
        write_report(run_folder.path)
    save_result(run_folder.result, {"scenario": "quick"})
    with pytest.raises(RecordError, match=r"lacks .*before, after, seconds, sensor, .*; write .*cmmsim identify"):
        write_report(run_folder.path)
    run_folder.validation.unlink()
    with pytest.raises(OutputFolderError, match=r"no validation\.nc; write it with: cmmsim validate --out"):
        write_report(run_folder.path)
    assert not run_folder.report.exists()
