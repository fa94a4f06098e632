"""The tests on rendered images: what they find against closed forms and against the stated
noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cmmsim import many_frames
from cmmsim.acceptance import (
    AcceptanceError,
    SensorUnderTest,
    bar_paths,
    latency_test,
    length_test,
    seven_lines,
)
from cmmsim.acceptance.artefacts import rigid_bar
from cmmsim.acceptance.length_test import length_artefact, lengths_from_first, measure_line
from cmmsim.acceptance.moving_bar import bar_run, relative_covariance, relative_error
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, rotation_exp, transform_to_pose
from cmmsim.measuring.measurement import lost_measurement
from tests.cmmsim.sensors import NOISE_FREE

RIG = read_sensor_file("ctrack780").rig


def under_test(seed=0, changes=None):
    return SensorUnderTest(read_sensor_file("ctrack780", changes), seed, "analytic")


def errors_along(volume, line, seed=0, changes=None, shift_px=0.0):
    """Errors (5,) m of the lengths of a line, with the right camera's image shifted along x."""
    sensor = under_test(seed, changes).facing(length_artefact(line), 1)
    sensor.move_rig({"right.cx_px": shift_px})
    return np.array([length.error for length in measure_line(sensor, volume, line, 1)])


@pytest.mark.slow
def test_noise_free_lengths_are_right_to_two_microns(volume):
    found = length_test(under_test(changes=NOISE_FREE), volume, exposures=1)
    assert len(found.lengths) == 35
    assert np.abs(found.errors).max() < 2e-6


@pytest.mark.thorough
def test_lengths_do_not_depend_on_the_number_of_threads(volume, monkeypatch):
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(many_frames, "threads_at_most", lambda threads=threads: threads)
        found.append(length_test(under_test(3), volume, exposures=2))
    np.testing.assert_array_equal(*(one.single_errors for one in found))
    assert [length.line for length in found[0].lengths] == [
        line.name for line in seven_lines(volume) for _ in range(5)
    ]


@pytest.mark.slow
def test_length_errors_are_as_large_as_stated(volume):
    """105 lengths of three exposures: their squares against the stated variances, and the mean is
    no bias.
    """
    found = length_test(under_test(1), volume, exposures=3)
    assert 0.65 < found.variance_ratio < 1.4
    errors, stds = found.errors, np.array([length.std for length in found.lengths]) / np.sqrt(3.0)
    # the lengths of a line share a sticker
    assert abs(errors.mean()) < 4.0 * np.sqrt(np.mean(stds**2) / 7.0)
    assert abs(found.largest.error) == np.abs(errors).max() < 50e-6


def test_shifted_camera_gives_the_lengths_that_linearised_triangulation_predicts(volume):
    """0.1 px in the right image: the points move by the pseudo-inverse of the projection's
    derivative.

    On the front face the stickers look at the rig, so that all pixels weigh the same.
    """
    line, shift = seven_lines(volume)[4], 0.1
    plain, shifted = (errors_along(volume, line, 0, NOISE_FREE, moved) for moved in (0.0, shift))
    rig, camera_from_base = rig_from_file(RIG)
    row = line.start + np.concatenate([[0.0], line.lengths])[:, None] * line.direction
    points = apply(camera_from_base @ volume.base_from_volume, row)
    steps = []
    for point in points:
        slopes = [
            (rig.project(point + h)[0] - rig.project(point - h)[0]).ravel() / 2e-6
            for h in 1e-6 * np.eye(3)
        ]
        steps.append(np.linalg.pinv(np.column_stack(slopes)) @ [0.0, 0.0, shift, 0.0])
    towards = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
    predicted = (np.array(steps[1:]) - steps[0]) @ towards
    assert np.abs(predicted).max() > 20e-6
    np.testing.assert_allclose(shifted - plain, predicted, rtol=0.02, atol=1e-6)


def test_lengths_and_their_deviations_by_hand():
    points = np.array([[0.0, 0.0, 1.0], [3.0, 4.0, 1.0], [0.0, 0.0, 3.0]])
    covariances = np.array([np.diag([1.0, 4.0, 9.0])] * 3)
    lengths, stds = lengths_from_first(points, covariances)
    np.testing.assert_allclose(lengths, [5.0, 2.0])
    np.testing.assert_allclose(stds, np.sqrt([2 * (0.36 * 1.0 + 0.64 * 4.0), 2 * 9.0]))


def pose_measurement(transform, covariance=None):
    covariance = np.eye(6) if covariance is None else covariance
    return replace(
        lost_measurement("made up"),
        pose=transform_to_pose(transform),
        covariance=covariance,
        ok=True,
        reason="",
    )


def test_relative_error_of_known_poses():
    """The second end 10 um too far along x and turned by 1 mrad about z, wherever the bar is."""
    bar = np.eye(4)
    bar[:3, :3], bar[:3, 3] = rotation_exp(np.array([0.3, -0.2, 1.1])), [0.2, -0.1, 1.5]
    second = np.eye(4)
    second[:3, :3], second[0, 3] = rotation_exp(np.array([0.0, 0.0, 1e-3])), 0.30001
    error, distance, _ = relative_error(pose_measurement(bar), pose_measurement(bar @ second))
    np.testing.assert_allclose(error, [1e-5, 0, 0, 0, 0, 1e-3], atol=1e-12)
    assert distance == pytest.approx(1e-5)


def test_relative_covariance_against_sampling():
    """Poses with drawn errors: the spread of the relative pose is the predicted one."""
    rng, first, along = np.random.default_rng(5), np.eye(4), np.eye(4)
    first[:3, :3], first[:3, 3] = rotation_exp(np.array([0.2, 0.4, -0.3])), [0.1, 0.2, 1.4]
    along[0, 3] = 0.3
    root = np.diag([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4]) @ (
        np.eye(6) + 0.3 * rng.standard_normal((6, 6))
    )
    measured = [pose_measurement(transform, root @ root.T) for transform in (first, first @ along)]
    draws = []
    for _ in range(2000):
        drawn = [replace(m, pose=m.pose + root @ rng.standard_normal(6)) for m in measured]
        draws.append(relative_error(*drawn)[0])
    whitened = np.linalg.solve(
        np.linalg.cholesky(relative_covariance(*measured)), np.array(draws).T
    )
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.15)


@pytest.mark.slow
def test_standing_and_moving_bar_have_the_stated_errors(volume):
    sensor = under_test(3).facing(rigid_bar(), 1)
    found = bar_run(sensor, bar_paths(volume)[3], np.arange(-10, 40) / 60.0)
    assert found.lost == 0
    assert found.moving.sum() == 40
    assert 0.75 < found.variance_ratios.mean() < 1.3
    assert np.sqrt(np.mean(found.distance_errors**2)) < 8e-6
    assert np.sqrt(np.mean(found.errors[:, :3] ** 2)) < 60e-6


@pytest.mark.thorough
def test_motion_blur_reaches_the_moving_bar_only(volume):
    """With 1 ms of exposure a standing bar gives the frames it gives with 1 ns, and others once it
    moves fast.
    """
    path, times = bar_paths(volume)[3], np.arange(-2, 16) / 60.0
    sharp, blurred = (
        bar_run(under_test(3, {"timing.exposure": exposure}).facing(rigid_bar(), 1), path, times)
        for exposure in (1e-9, 1e-3)
    )
    # the bar starts to move at time 0
    np.testing.assert_array_equal(sharp.errors[:3], blurred.errors[:3])
    assert np.all(np.any(sharp.errors[-6:] != blurred.errors[-6:], axis=1))
    assert np.abs(blurred.distance_errors).max() < 30e-6


@pytest.mark.thorough
def test_a_run_that_loses_the_bar_is_given_up(volume):
    """The bar is taken out of sight after four frames."""
    path = bar_paths(volume)[0]
    gone = path.pose(0.0) + np.array([0.0, 0.0, -5.0, 0.0, 0.0, 0.0])
    hidden = SimpleNamespace(
        name="hidden",
        pose=lambda time: gone if time > 0.02 else path.pose(0.0),
        pose_rate=lambda time: np.zeros(6),
    )
    sensor = under_test().facing(rigid_bar(), 1)
    found = bar_run(sensor, hidden, np.arange(-2, 30) / 60.0)
    assert (len(found.time), found.lost) == (4, 28)
    assert "needed" in found.given_up
    with pytest.raises(
        AcceptanceError,
        match=r"hidden: the bar was not measured at rest, or not in motion",
    ):
        bar_run(sensor, hidden, np.arange(-2, 0) / 60.0)


def test_same_seed_same_numbers(volume):
    first, same, other = (
        errors_along(volume, seven_lines(volume)[4], seed).tolist() for seed in (0, 0, 1)
    )
    assert first == same != other


@pytest.mark.slow
def test_latency_and_jitter_of_the_sensor_file_are_found_from_images(volume):
    found = latency_test(under_test(changes={"timing.latency": 0.0142}), volume, frames=40)
    assert (found.lost, found.stated) == (0, 0.0142)
    low, high = found.latency.interval
    assert low <= 0.0142 <= high
    assert high - low < 5e-6
    assert found.latency.std == pytest.approx(found.latency.resolution, rel=0.3)
    changes = {"timing.latency": 0.014, "timing.latency_jitter": 0.001}
    jittering = latency_test(under_test(changes=changes), volume, frames=60).latency
    assert jittering.mean == pytest.approx(0.014, abs=4e-4)
    assert jittering.std == pytest.approx(0.001, rel=0.25)
    assert jittering.resolution < 1e-4


@pytest.mark.slow
def test_artefact_that_cannot_be_measured_is_named(volume):
    """Cameras that see nothing but darkness."""
    with pytest.raises(AcceptanceError, match="is not found in the images"):
        length_test(under_test(changes={"stickers.sticker_level": 10}), volume)
