"""Errors that all stickers of an image share: delays, and lenses that blur more than known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import cmmsim
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.measuring.frame_solver import solve_frames
from cmmsim.tracker import part_of_step
from tests.cmmsim import plain
from tests.cmmsim.sensors import CROPPED, exact, poses_about_home, require_true, squared_error
from tests.cmmsim.test_covariance import (
    BODY,
    CAMERA_FROM_BODY,
    OBSERVER,
    PIXELS,
    RIG,
    observed,
    pixel_covariances,
)

STEP = pose_to_transform((4e-4, -3e-4, 2e-4, 1e-3, -2e-3, 3e-3))
ENDS = np.stack([CAMERA_FROM_BODY @ part_of_step(STEP, part) for part in (-0.5, 0.5)])


def seen_with(late=0.0, row=0.0, shifts=(0.0, 0.0), seed=0):
    """All stickers of a body that moves by STEP a frame; delays are in frame periods."""
    rng = np.random.default_rng(seed)
    before, after = (RIG.project(apply(end, BODY.nominal))[0] for end in ENDS)
    delays = row * (PIXELS[..., 1] / RIG.left.height - 0.5)
    delays[1] += late
    pixels = PIXELS + delays[..., None] * (after - before)
    spread = [pixel_covariances(rng, 18) for _ in range(2)]
    return replace(
        observed(rng, pixels, spread, np.arange(18)),
        spreads=np.stack(spread, axis=1),
        shifts=np.array([shifts]),
        frame_ends=ENDS[None],
    )


def solved(seen):
    return solve_frames(seen, CAMERA_FROM_BODY[None], OBSERVER, BODY, BODY.nominal)


@pytest.mark.parametrize("late", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("row", [0.0, 0.1])
@pytest.mark.parametrize("shifts", [(0.0, 0.0), (0.004, 0.01)])
def test_covariance_equals_that_of_fitted_delays(late, row, shifts):
    seen = seen_with(late, row, shifts)
    found = solved(seen)
    move = found.camera_from_body[0]
    pixels = np.stack([seen.left_pixels, seen.right_pixels], axis=1)
    expected = plain.shared_errors(RIG, move, BODY.nominal, pixels, seen.spreads, shifts, ENDS)
    assert found.used.all()
    size = np.sqrt(np.diag(found.covariances[0]))
    np.testing.assert_allclose(
        found.shared[0] / np.outer(size, size), expected / np.outer(size, size), atol=2e-3
    )
    assert (late + row + sum(shifts) == 0.0) == (not found.shared.any())


def test_a_movement_that_is_not_known_tells_no_delay():
    seen = replace(seen_with(late=0.02), frame_ends=None)
    assert not solved(seen).shared.any()


def test_clean_frames_of_a_moving_body_are_hardly_widened():
    """Noise makes four of 100 frames a little wider."""
    found = [solved(seen_with(seed=seed)) for seed in range(300)]
    wider = [np.mean(np.diag(one.shared[0]) / np.diag(one.covariances[0])) for one in found]
    assert np.mean(np.array(wider) > 0.0) < 0.05
    assert np.mean(wider) < 0.02


@pytest.mark.parametrize(("method", "least"), [("registration", 3.0), ("planes", 1.3)])
def test_a_lens_that_leans_widens_the_covariance(method, least):
    """Light that leans by a share of a pixel moves all centres, and blurs all rims."""
    sensor = exact("perfect", CROPPED, method=method)
    kernel = np.float32([0.0, 0.93, 0.07])
    squared, growth = [], []
    for pose in poses_about_home(sensor, 6):
        frame = sensor.capture(pose)
        still = cmmsim.measure_frame(frame, sensor.estimator)
        moved = cmmsim.StereoFrame(*(_leant(image, kernel) for image in (frame.left, frame.right)))
        found = cmmsim.measure_frame(moved, sensor.estimator)
        squared.append(squared_error(found, pose))
        growth.append(np.trace(found.covariance[:3, :3]) / np.trace(still.covariance[:3, :3]))
    assert min(growth) > least
    assert max(squared) < 36.0


def _leant(image, kernel):
    """An image by ``kernel`` along x whose light lies about its middle, moved by whole spectra."""
    light = cv2.filter2D(image.astype(float), -1, kernel[None, ::-1], borderType=cv2.BORDER_REFLECT)
    waves = np.fft.rfftfreq(image.shape[1])
    back = np.exp(2j * np.pi * waves * kernel[2])
    light = np.fft.irfft(np.fft.rfft(light) * back, image.shape[1])
    return np.uint8(np.clip(np.rint(light), 0, 255))


def test_the_stated_error_of_clean_moving_frames_is_true():
    """Sixty frames after each other, tracked, in which delays are tested."""
    sensor = exact("perfect", CROPPED)
    tracker = cmmsim.Tracker(sensor.estimator)
    steps = np.arange(60)[:, None] * np.array([1e-4, -5e-5, 8e-5, 2e-4, -1e-4, 3e-4])
    squared = [
        squared_error(tracker.measure(sensor.look(sensor.home + s)), sensor.home + s) for s in steps
    ]
    require_true(np.array(squared))
