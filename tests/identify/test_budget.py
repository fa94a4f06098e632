"""The error budget: its parts sum up to what is stated, and are what an error of a source does."""

import csv
import json
import re

import numpy as np
import pytest

from identify.errors import RecordError
from identify.estimation.budget import CORRELATED, SOURCES, budget_of
from identify.estimation.identification import identify
from identify.files.dataset import read_covariance, read_sources
from identify.files.run_folder import RunFolder, load_result
from identify.model.model_side import model_side
from identify.progress import SilentProgress
from identify.record.provenance import RunFiles, store_robot
from identify.record.stored_common_errors import CommonErrors, store_common_errors
from identify.reporting.figures.estimates import budget_figure
from identify.reporting.run_result import parameter_vector
from identify.stages.explain import error_budget, pose_budget
from identify.validation.pose_prediction import predicted_runs
from tests.identify.commands import command, one_line
from tests.identify.run_files import write_covariance, write_runs
from tests.identify.synthetic import (
    SHORT,
    SIGMA,
    quick,
    recorded_run_folder,
    rss6,
    run_plant,
    short_run,
    truth_of,
)

DOUBTS = {
    "excitation.duration_s": 3.0,
    "model.joint_zero_std_rad": 1e-4,
    "model.command_scale_std": 1e-3,
    "timing.latency_std_s": 1e-4,
}


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """The folder of a run whose clocks and drives are known only so well, with an unseen run."""
    scenario = quick(**DOUBTS)
    made = run_plant(scenario, 3, duration_s=3.0)
    store_robot(made[0], rss6())
    folder = recorded_run_folder(tmp_path_factory.mktemp("budget"), scenario, made)
    assert command("identify", "--out", folder.path, "--quiet") == 0
    record, plant = run_plant(scenario, 4, duration_s=2.0, trajectory_seed=5)
    store_robot(record, rss6())
    write_runs(folder.validation, [(record, truth_of(plant))])
    return folder


@pytest.mark.slow
def test_the_squares_sum_up_to_every_variance_that_is_stated(identified):
    budget = error_budget(identified.path)
    found = dict(zip(budget.quantities, budget.std, strict=True))
    names, covariance = read_covariance(identified.covariance)
    robot = rss6()
    stated = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    for name in robot.layout.names:
        assert found[name] == pytest.approx(stated[name], rel=1e-9)
    entry = load_result(identified.result)["identification"]
    side = model_side(robot, quick(**DOUBTS))
    (record,) = RunFiles(identified).validation
    (prediction,) = predicted_runs(
        side,
        [record],
        parameter_vector(robot, entry, "estimate"),
        covariance,
        0,
        SilentProgress(),
        entry["nuisance_estimates"],
    )
    rms = np.sqrt(np.mean(prediction.std**2, axis=0))
    predicted = [found[f"prediction.{name}"] for name in ("x", "y", "z", "alpha", "beta", "gamma")]
    np.testing.assert_allclose(predicted, rms, rtol=1e-9)
    assert {"noise", "zeros", "scale", "latency", "anchor", "guess", "motion"} <= {*budget.sources}
    assert set(budget.sources) <= SOURCES.keys()
    assert CORRELATED not in budget.sources


@pytest.mark.slow
def test_the_command_writes_table_picture_and_numbers_that_agree(identified, capfd):
    assert command("budget", identified.path) == 0
    said = capfd.readouterr().out
    assert "the largest predicted um first" in " ".join(said.split())
    assert "drives: zeros of the joints" in said
    assert "combined" in said
    budget = error_budget(identified.path)
    table = budget.to_dataframe()
    for name, title in (("pose.", "pose um"), ("prediction.", "predicted um")):
        axes = table[table["quantity"].isin([name + axis for axis in "xyz"])]
        most = axes.assign(square=axes["added"] ** 2).groupby("source")["square"].sum().idxmax()
        assert re.search(f"{title}[^:]*: {re.escape(most)}", said.partition("largest source ")[2])
    folder = RunFolder(identified.path).budget
    whole = json.loads((folder / "budget.json").read_text())
    with (folder / "budget.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    entries = load_result(identified.result)["identification"]["parameters"]
    for row in rows:
        known = entries.get(row["quantity"], {"identifiable": ""})["identifiable"]
        assert row["identified"] == str(known)
    for name, entry in whole.items():
        own = [row for row in rows if row["quantity"] == name]
        squares = sum(float(row["added"]) ** 2 for row in own)
        assert squares == pytest.approx(entry["combined"] ** 2, rel=1e-9)
        assert sum(float(row["share"]) for row in own) == pytest.approx(float(bool(own)), abs=1e-9)
        assert [float(row["share"]) for row in own] == sorted(
            (float(row["share"]) for row in own), reverse=True
        )
    assert (folder / "budget.png").stat().st_size > 10_000


def test_what_the_anchor_adds_is_what_its_error_does_to_the_estimate():
    """By a second identification, from an anchor that is off by its standard deviation."""
    scenario = quick(**{"identification.method": "command_driven"})
    record = run_plant(scenario, 3, duration_s=3.0)[0]
    result = identify(record, scenario=scenario)
    attributes = {**record.attrs}
    attributes["scale_anchor_value"] += attributes["scale_anchor_std"]
    moved = identify(record.assign_attrs(attributes), scenario=scenario)
    part = np.sqrt(np.diag(result.sources["anchor"]))[: len(result.names)]
    change = np.abs(moved.estimate - result.estimate)
    seen = part > 1e-3 * result.std
    assert seen.sum() > 5
    np.testing.assert_allclose(change[seen], part[seen], rtol=0.05)
    budget = result.budget()
    np.testing.assert_allclose(budget.std, result.std, rtol=1e-9)
    assert budget.to_dataframe().query("quantity == 'platform.mass'")["source"].iloc[0] == (
        SOURCES["anchor"].words
    )


@pytest.mark.thorough
def test_the_parts_sum_up_where_two_records_share_some_errors_and_not_others():
    scenario = quick(**DOUBTS)
    records = [run_plant(scenario, k, duration_s=3.0, trajectory_seed=k)[0] for k in (3, 4)]
    result = identify(records, scenario=scenario)
    whole = result.whole_covariance
    std = np.sqrt(np.diag(whole))
    off = np.sum(list(result.sources.values()), axis=0) - whole
    assert np.abs(off / np.outer(std, std)).max() < 1e-9


def test_cameras_and_teaching_add_to_the_measured_pose_what_the_record_states():
    """Also where they are correlated, and where the identification takes them as exact."""
    record = short_run()[0].copy()
    rng = np.random.default_rng(2)
    names = ("taught.platform.x_m", "left.focal_length_px", "right.focal_length_px")
    changes = 1e-6 * rng.standard_normal((record.sizes["time"], 6, 3))
    for between in (0.0, 0.5):
        covariance = np.array([[1.0, between, 0.0], [between, 1.0, 0.3], [0.0, 0.3, 2.0]])
        store_common_errors(record, CommonErrors(names, changes, covariance))
        budget = pose_budget(record, model_side(rss6(), SHORT))
        stated = changes @ covariance @ changes.transpose(0, 2, 1)
        whole = SIGMA**2 + np.diagonal(stated.mean(axis=0))
        np.testing.assert_allclose(budget.std**2, whole, rtol=1e-9)
        own = np.diagonal(
            (changes[..., 1:] @ covariance[1:, 1:] @ changes[..., 1:].swapaxes(1, 2)).mean(0)
        )
        np.testing.assert_allclose(budget.variances[:, budget.sources.index("rig")], own, rtol=1e-9)
        assert ("teaching" in budget.sources, CORRELATED in budget.sources) == (True, between > 0)


def test_covariances_between_sources_have_a_row_of_their_own():
    budget = budget_of(
        ["x"], ["m"], {"rig": np.array([4.0]), "teaching": np.array([1.0])}, np.array([3.0])
    )
    assert budget.sources == ("rig", "teaching", CORRELATED)
    assert budget.std == pytest.approx(np.sqrt(3.0))
    added = budget.to_dataframe().set_index("source")["added"]
    assert added[SOURCES[CORRELATED].words] == pytest.approx(-np.sqrt(2.0))


def test_a_run_of_an_older_version_and_parts_that_do_not_sum_up_are_refused(
    identified, tmp_path, capfd
):
    files = RunFiles(identified)
    covariance = files.covariance
    write_covariance(tmp_path / "covariance.nc", rss6().layout, covariance[:67, :67])
    with pytest.raises(RecordError, match="has no sources of its covariance, because an older"):
        read_sources(tmp_path / "covariance.nc", covariance[:67, :67])
    with pytest.raises(
        RecordError, match="the parts of the covariance do not add up to the covariance"
    ):
        read_sources(identified.covariance, covariance + np.diag(1e-6 * np.diag(covariance)))
    assert command("budget", tmp_path / "none") != 0
    assert "no run folder" in one_line(capfd.readouterr().err)


def test_the_folder_of_a_study_is_called_one(tmp_path, capfd):
    (tmp_path / "study.json").write_text("{}")
    assert command("budget", tmp_path) == 1
    assert "is the folder of a study, and not of a run" in one_line(capfd.readouterr().err)


def test_the_picture_has_the_identified_parameters_alone_most_of_the_main_source_first():
    noise = np.array([1.0, 2.0, 9.0, 5.0])
    names = ("pose.x", "a", "b", "hidden")
    found = budget_of(names, ["um", *["kg"] * 3], {"noise": noise, "guess": np.ones(4)}, noise + 1)
    figure = budget_figure(found, {"a": True, "b": True, "hidden": False})
    rows = [label.get_text().split(":")[0] for label in figure.axes[0].get_yticklabels()]
    assert rows == ["pose.x", "b", "a"]
