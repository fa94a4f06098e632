"""The joint adjustment against synthetic truth: exact without noise, honest with it, and what
contradicts is named.

Pixels come from a projection written here from Brown's formula, not from the code under test.
"""

import re
from dataclasses import replace
from itertools import repeat

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmmsim.calibration import CalibrationError, CalibrationOptions, PairView, calibrate
from cmmsim.calibration.adjustment import computed_pixels
from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from tests.cmmsim.sensors import refused

BOARD = Board(kind="chessboard", columns=9, rows=7, spacing=0.05)
SIZE = (2048, 1536)
LEFT = np.array([2300.0, 2310.0, 1030.0, 760.0, -0.12, 0.08, 0.0006, -0.0004, 0.01])
RIGHT = np.array([2280.0, 2275.0, 1010.0, 775.0, -0.10, 0.05, -0.0003, 0.0005, -0.02])
TURN = np.array([0.02, 0.6, -0.03])
SHIFT = np.array([-0.95, 0.01, 0.28])
TRUTH = np.concatenate([LEFT, RIGHT, SHIFT, TURN])
RIGHT_FROM_LEFT = np.eye(4)
RIGHT_FROM_LEFT[:3, :3], RIGHT_FROM_LEFT[:3, 3] = Rotation.from_rotvec(TURN).as_matrix(), SHIFT


def brown(values, points):
    """Pixels (n, 2) of points (n, 3) in camera axes."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    s = x**2 + y**2
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
    xd = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x**2)
    yd = y * radial + p1 * (s + 2 * y**2) + 2 * p2 * x * y
    return np.column_stack([fx * xd + cx, fy * yd + cy])


def board_poses(count, rng, tilt=0.6, board=BOARD):
    """left_from_board (count, 4, 4): boards before both cameras, tilted to all sides."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    middle = board.points.mean(axis=0)
    for pose in poses:
        face = Rotation.from_rotvec([0.0, -0.3, 0.0])
        pose[:3, :3] = (face * Rotation.from_rotvec(tilt * rng.uniform(-1, 1, 3))).as_matrix()
        pose[:3, 3] = [*rng.uniform(-0.3, 0.3, 2), rng.uniform(1.4, 2.0)] - pose[:3, :3] @ middle
    return poses


def seen_pairs(poses, noise=0.0, rng=None, values=(LEFT, RIGHT), board=BOARD, points=None):
    """What both cameras see of a board, or of ``points`` of one that is another in each view."""
    pairs = []
    for k, (pose, places) in enumerate(zip(poses, points or repeat(board.points), strict=False)):
        sides = []
        for own, move in zip(values, (pose, RIGHT_FROM_LEFT @ pose), strict=True):
            pixels = brown(own, places @ move[:3, :3].T + move[:3, 3])
            if noise:
                pixels = pixels + rng.normal(0.0, noise, pixels.shape)
            sides.append(BoardView(np.arange(len(pixels)), pixels))
        pairs.append(PairView(f"{k:02d}.png", *sides))
    return pairs


def noisy_pairs(seed, count=12, noise=0.05, board=BOARD, tilt=0.6):
    rng = np.random.default_rng(seed)
    return seen_pairs(board_poses(count, rng, tilt, board), noise, rng, board=board)


def test_projection_and_its_derivatives():
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1.2], [0.5, 0.4, 2.0], (20, 3))
    pixels, by_intrinsics, by_points = computed_pixels(LEFT, points)
    np.testing.assert_allclose(pixels, brown(LEFT, points), atol=1e-9)
    for k, step in enumerate(1e-5 * np.maximum(np.abs(LEFT), 0.1)):
        change = step * np.eye(9)[k]
        slope = (brown(LEFT + change, points) - brown(LEFT - change, points)) / (2 * step)
        np.testing.assert_allclose(by_intrinsics[:, :, k], slope, rtol=1e-6, atol=1e-6)
    for k in range(3):
        change = 1e-6 * np.eye(3)[k]
        slope = (brown(LEFT, points + change) - brown(LEFT, points - change)) / 2e-6
        np.testing.assert_allclose(by_points[:, :, k], slope, rtol=1e-6, atol=1e-4)


def test_noise_free_points_give_the_truth_from_opencvs_start():
    found = calibrate(BOARD, seen_pairs(board_poses(12, np.random.default_rng(1))), SIZE)
    np.testing.assert_allclose(found.values, TRUTH, rtol=1e-6, atol=1e-7)
    assert found.adjustment.sigma_px < 1e-6
    assert not found.rejected


@pytest.mark.parametrize(
    ("distortion", "fix_aspect", "free"),
    [("none", False, 4), ("radial2", True, 5), ("brown5", False, 9)],
)
def test_what_is_not_free_stays(distortion, fix_aspect, free):
    values = []
    for own in (LEFT.copy(), RIGHT.copy()):
        own[4:] = own[4:] * {"none": 0, "radial2": [1, 1, 0, 0, 0], "brown5": 1}[distortion]
        own[1] = own[0] if fix_aspect else own[1]
        values.append(own)
    pairs = seen_pairs(
        board_poses(10, np.random.default_rng(2)), 0.05, np.random.default_rng(3), values
    )
    found = calibrate(BOARD, pairs, SIZE, CalibrationOptions(distortion, fix_aspect))
    error, std = found.values - np.concatenate([*values, SHIFT, TURN]), found.std
    assert np.count_nonzero(std[:9]) == free + fix_aspect
    assert np.linalg.matrix_rank(found.covariance / np.outer(std, std).clip(1e-300)) == 2 * free + 6
    np.testing.assert_allclose(error[std == 0], 0, atol=1e-12)
    assert np.abs(error[std > 0] / std[std > 0]).max() < 4.5
    if fix_aspect:
        assert found.values[0] == pytest.approx(found.values[1], rel=1e-12)


def test_covariance_of_the_rotation_vector():
    """Against the scatter of the rotation vector's finite differences."""
    found = calibrate(BOARD, noisy_pairs(6, 8, 0.1), SIZE)
    rotation = Rotation.from_matrix(found.rig.right_from_left[:3, :3])
    turned = [(Rotation.from_rotvec(1e-6 * axis) * rotation).as_rotvec() for axis in np.eye(3)]
    slope = (np.column_stack(turned) - rotation.as_rotvec()[:, None]) / 1e-6
    expected = slope @ found.adjustment.covariance[-3:, -3:] @ slope.T
    np.testing.assert_allclose(found.covariance[-3:, -3:], expected, rtol=1e-4)
    assert len(found.values) == len(PARAMETER_NAMES)


def test_each_picture_may_be_read_in_any_order_of_a_symmetric_board():
    board, rng = Board(kind="chessboard", columns=7, rows=7, spacing=0.05), np.random.default_rng(8)
    pairs = noisy_pairs(8, 10, board=board)
    plain = calibrate(board, pairs, SIZE)
    mixed = [
        PairView(p.name, *(view.read_as(board.symmetries[rng.integers(4)]) for view in p.sides))
        for p in pairs
    ]
    assert np.abs((calibrate(board, mixed, SIZE).values - plain.values) / plain.std).max() < 0.01


@pytest.mark.parametrize("rounds", [1, 5])
def test_wrong_partner_and_bad_image_are_given_up_with_their_reasons(rounds, monkeypatch):
    monkeypatch.setitem(calibrate.__globals__, "ROUNDS", rounds)
    pairs, rng = noisy_pairs(9), np.random.default_rng(9)
    plain, worse = calibrate(BOARD, pairs, SIZE), list(pairs)
    worse[3] = PairView("03.png", pairs[3].left, pairs[4].right)
    noisy = BoardView(pairs[7].left.index, pairs[7].left.pixels + rng.normal(0, 2.0, (63, 2)))
    worse[7] = PairView("07.png", noisy, pairs[7].right)
    found = calibrate(BOARD, worse, SIZE)
    assert set(found.rejected) == {"03.png", "07.png"}
    assert "from that of most pairs" in found.rejected["03.png"]
    assert re.fullmatch(
        r"left: rms 2\.\d\d px, more than 4 times the median of 0\.0\d px", found.rejected["07.png"]
    )
    assert [list(view.rms_px) for view in found.used if view.name == "07.png"] == [["right"]]
    assert np.abs((found.values - plain.values) / plain.std).max() < 3.0


def test_image_with_the_board_in_one_camera_still_helps_that_camera():
    pairs = noisy_pairs(10, 14)
    short = calibrate(BOARD, pairs[:8], SIZE)
    more = calibrate(BOARD, pairs[:8] + [p.without(1, "no board") for p in pairs[8:]], SIZE)
    assert np.all(more.std[:9] < short.std[:9])
    assert more.rejected["09.png"] == "right: no board"
    assert np.abs((more.values - TRUTH) / more.std).max() < 4.0


PLAIN, NONE = noisy_pairs(20), "no chessboard of 8 x 7 found"
UNSEEN = [p.without(0, NONE).without(1, NONE) for p in PLAIN]
MIXED = [PairView(a.name, a.left, b.right) for a, b in zip(PLAIN, noisy_pairs(13), strict=True)]


@pytest.mark.parametrize(
    ("pairs", "least", "message"),
    [
        (
            PLAIN[:2] + UNSEEN[2:5],
            3,
            r"2 of 5 pairs, but 3 are needed; pairs without it: 02.png \(both: no ch",
        ),
        (PLAIN[:5], 12, "12 are needed"),
        (UNSEEN, 3, r"02.png \(both: no chessboard of 8 x 7 found\) and 9 more$"),
        (
            [
                PairView(a.name, a.left, b.right)
                for a, b in zip(PLAIN, noisy_pairs(13), strict=True)
            ],
            3,
            "pairs agree on the place",
        ),
    ],
)
def test_too_few_pairs_and_those_not_taken_together_are_refused_in_one_short_line(
    pairs, least, message
):
    refused(
        lambda: calibrate(BOARD, pairs, SIZE, CalibrationOptions(min_images=least)),
        message,
        CalibrationError,
    )


@pytest.mark.parametrize(("count", "said"), [(1, "in one place only"), (2, "in 2 places only")])
def test_pictures_alike_are_refused_as_such_in_whichever_order_they_are_read(count, said):
    rng = np.random.default_rng(21)
    same = seen_pairs(board_poses(count, rng)[np.arange(10) % count], 0.05, rng)
    turned = [
        PairView(p.name, *(v.read_as(BOARD.symmetries[k % 2]) for v in p.sides))
        for k, p in enumerate(same)
    ]
    for pairs in (same, turned):
        with pytest.raises(
            CalibrationError, match=f"the 10 pictures of the left .* alike.* {said}.*move and tilt"
        ):
            calibrate(BOARD, pairs, SIZE)


def lines_with(word, board=BOARD, pairs=PLAIN):
    """Warnings that hold a word, each of which must be one line."""
    warnings = calibrate(board, pairs, SIZE).warnings
    assert all("\n" not in line and len(line) < 300 for line in warnings)
    return [line for line in warnings if word in line]


def test_good_pairs_are_not_warned_of_and_parallel_boards_are_or_are_refused():
    assert not lines_with("")
    try:
        lines = " ".join(lines_with("", pairs=noisy_pairs(12, 10, 0.1, tilt=0.005)))
    except CalibrationError as error:
        lines = str(error)
    assert "tilt" in lines


def test_swapped_folders_are_named_with_the_place_of_the_right_camera():
    (line,) = lines_with(
        "swap the folders", pairs=[PairView(p.name, p.right, p.left) for p in PLAIN]
    )
    assert f"({SHIFT[0]:.2g}" in line  # of the left camera in the axes of the right one


@pytest.mark.parametrize(
    ("unit", "size"), [(1e3, "400 x 300 m"), (1e2, "40 x 30 m"), (1e-3, "0.0004 x 0.0003 m")]
)
def test_lengths_that_are_no_metres_are_named(unit, size):
    (line,) = lines_with(
        "the lengths in the board file in m?",
        BOARD.model_copy(update={"spacing": unit * BOARD.spacing}),
    )
    assert size in line
    assert float(line.split("cameras ")[1].split()[0]) == pytest.approx(
        unit * np.linalg.norm(SHIFT), rel=0.01
    )


def test_many_pairs_not_used_are_warned_of_with_the_board_of_the_file():
    fewer = [
        [p.without(1, NONE) if k < count else p for k, p in enumerate(PLAIN)] for count in (4, 5)
    ]
    assert not lines_with("not used", pairs=fewer[0])
    (line,) = lines_with("not used", pairs=fewer[1])
    assert line.startswith(
        f"in 5 of 12 pairs an image is not used, first in 00.png (right: {NONE})"
    )
    assert "9 columns and 7 rows" in line


@pytest.mark.parametrize(("measured", "warned"), [(0.0095, True), (0.0132, False)])
def test_wrong_radius_of_dots_is_warned_of_with_both(measured, warned):
    board = Board(kind="dots", columns=9, rows=7, spacing=0.05, radius=0.014)
    seen = [PairView(p.name, *(replace(v, radius=measured) for v in p.sides)) for p in PLAIN]
    assert (
        bool(
            lines_with(
                f"radius 0.014 m, but in the pictures the radius is {measured:g} m", board, seen
            )
        )
        == warned
    )
