"""ChArUco boards: their corners, whole or in part, against the projected truth."""

import cv2
import numpy as np
import pytest

from cmmsim.calibration import board_poses, calibrate, find_board, render_pairs
from cmmsim.geometry.camera import Optics
from cmmsim.imaging.analytic import ANALYTIC
from tests.cmmsim.sensors import NOISE
from tests.cmmsim.test_calibration_images import (
    BENT,
    CHARUCO,
    DOTS,
    PERFECT,
    normalised_errors,
    pixel_errors,
    rendered,
    views_of,
)


def test_corners_between_markers_are_found_as_well_as_those_of_a_chessboard():
    """OpenCV's own corners of these pictures are off by 0.07 px rms, and by up to 0.7 px."""
    errors = pixel_errors(PERFECT, CHARUCO, *rendered(PERFECT, CHARUCO, 2))
    assert np.sqrt(np.mean(errors**2)) < 0.05
    assert np.abs(errors).max() < 0.25
    assert np.abs(errors.mean(axis=0)).max() < 0.01


@pytest.mark.parametrize("legacy", [False, True])
def test_markers_may_be_in_either_squares_of_a_board_of_an_even_number_of_rows(legacy):
    """OpenCV draws the picture. Its corners lie between pixels."""
    board = CHARUCO.model_copy(update={"rows": 5})
    picture = board.charuco(legacy).generateImage((9 * 40, 6 * 40))
    view = find_board(
        cv2.copyMakeBorder(picture, 20, 20, 20, 20, cv2.BORDER_CONSTANT, 0, 255), board
    )
    np.testing.assert_array_equal(view.index, np.arange(40))
    expected = 800.0 * board.points[:, :2] + 40 + 20 - 0.5
    np.testing.assert_allclose(view.pixels, expected, atol=0.02)


@pytest.mark.parametrize(
    ("changed", "count"), [({"columns": 9}, 31), ({"dictionary": "6X6_100"}, 0)]
)
def test_a_board_file_of_another_board_is_told_by_the_number_of_markers(changed, count):
    picture = rendered(PERFECT, CHARUCO, 2)[1][1].left
    said = find_board(picture, CHARUCO.model_copy(update=changed))
    assert "corners found, but " in said
    assert int(said.split(" but ")[1].split()[0]) == pytest.approx(count, abs=2)


@pytest.mark.parametrize(
    ("rig", "count", "psf_px"),
    [
        pytest.param(PERFECT, 6, 0.0, marks=pytest.mark.slow),
        pytest.param(BENT, 12, 0.4, marks=pytest.mark.thorough),
    ],
)
def test_charuco_boards_that_reach_out_of_the_pictures_give_the_true_cameras(rig, count, psf_px):
    """The middle of the board is where that of a smaller one would be wholly in both pictures."""
    board = CHARUCO.model_copy(update={"columns": 11, "rows": 8, "spacing": 0.07, "marker": 0.05})
    rng = np.random.default_rng(0)
    poses = board_poses(rig, DOTS, count, rng)
    for pose in poses:
        pose[:3, 3] += pose[:3, :3] @ (DOTS.points.mean(axis=0) - board.points.mean(axis=0))
    frames = render_pairs(rig, board, poses, ANALYTIC, Optics(psf_px=psf_px), NOISE, rng)
    views = views_of(frames, board)
    seen = [len(side.index) for pair in views for side in pair.sides]
    assert np.mean(np.array(seen) < len(board.points)) > 0.6
    found = calibrate(board, views, (800, 600))
    assert len(found.used) == count
    assert np.abs(normalised_errors(found, rig)).max() < 4.0
    assert found.adjustment.sigma_px < 0.05
