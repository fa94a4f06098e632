"""Kinematic calibration at full count: 200 experiments a robot with drawn noise, and through
images.
"""

import json

import numpy as np
import pytest

from dynamics import built_in_robots
from identify.files.dataset import read_covariance
from identify.files.run_folder import rms_figures
from tests.identify.commands import command
from tests.identify.static_poses import designer, drawn, poses_of, unseen_errors

EXPERIMENTS, POSES = 200, 60


@pytest.mark.thorough
@pytest.mark.parametrize("robot", built_in_robots())
def test_intervals_of_what_is_told_cover_95_percent_and_unseen_poses_are_met(
    robot, record_property
):
    among = poses_of(robot, 400)
    design = designer(robot)
    chosen = design.moved(design.greedy(among, POSES), among)
    covered, told, worst, ratios = [], [], np.zeros(6), []
    for seed in range(EXPERIMENTS):
        made = drawn(robot, seed, chosen)
        found = made.calibrated(robot)
        told.append(found.observable)
        covered.append(np.abs(found.deviations - made.deviations) < 1.96 * found.std)
        figures = rms_figures(unseen_errors(robot, found, made.deviations))
        worst = np.maximum(worst, [*figures["position_rms_um"], *figures["orientation_rms_urad"]])
        ratios.append(found.noise_ratio)
    always = np.all(told, axis=0)
    each = np.mean(covered, axis=0)[always]
    record_property("coverage", float(each.mean()))
    record_property("least coverage of a number", float(each.min()))
    record_property("worst rms position um", float(worst[:3].max()))
    record_property("worst rms orientation urad", float(worst[3:].max()))
    record_property("noise ratio", float(np.mean(ratios)))
    assert 0.93 < each.mean() < 0.97
    assert each.min() > 0.88  # 95 % of 200 within four standard deviations
    assert worst[:3].max() < 5
    assert worst[3:].max() < 20
    assert np.mean(ratios) == pytest.approx(1, abs=0.05)


def through_images(folder, robot, *settings):
    """The entry of a calibration through images; the errors of what is told, in standard
    deviations; and the mean square of these in units of their covariance, which is one where that
    is right."""
    assert command("geometry", "--robot", robot, "--out", folder, "--quiet", *settings) == 0
    entry = json.loads((folder / "geometry.json").read_text())
    names, covariance = read_covariance(folder / "covariance.nc")
    told = [k for k, name in enumerate(names) if entry["parameters"][name]["observable"]]
    rows = [entry["parameters"][names[k]] for k in told]
    errors, std = (
        np.array([one["estimate"] - one["true"] for one in rows]),
        np.array([one["std"] for one in rows]),
    )
    scaled = covariance[np.ix_(told, told)] / np.outer(std, std)
    return (
        entry,
        errors / std,
        float(errors / std @ np.linalg.solve(scaled, errors / std)) / len(told),
    )


def judge(entry, errors, normalised):
    assert entry["lost_frames"] == 0
    assert not entry["warnings"]
    assert np.abs(errors).max() < 5
    assert abs(normalised - 1) < 4 * np.sqrt(2 / len(errors))
    assert max(entry["unseen"]["position_rms_um"]) < 5
    assert max(entry["unseen"]["orientation_rms_urad"]) < 20
    assert max(entry["uncalibrated"]["position_rms_um"]) > 10 * max(
        entry["unseen"]["position_rms_um"]
    )


@pytest.mark.thorough
def test_a_geometry_is_found_through_images(tmp_path):
    settings = {"poses": 15, "frames_per_pose": 3, "candidates": 60, "unseen": 30}
    chosen = [
        word for name, value in settings.items() for word in ("--set", f"geometry.{name}={value}")
    ]
    judge(*through_images(tmp_path / "out", "rss6", *chosen, "--set", "renderer=analytic"))


@pytest.mark.thorough
@pytest.mark.rendering
@pytest.mark.parametrize("robot", built_in_robots())
def test_the_geometry_of_every_robot_is_found_through_images(robot, tmp_path, record_property):
    entry, errors, normalised = through_images(tmp_path / "out", robot)
    record_property("coverage", float(np.mean(np.abs(errors) < 1.96)))
    record_property("normalised squared error", normalised)
    record_property("unseen um", float(max(entry["unseen"]["position_rms_um"])))
    record_property("unseen urad", float(max(entry["unseen"]["orientation_rms_urad"])))
    record_property("noise ratio", entry["noise_ratio"])
    judge(entry, errors, normalised)
