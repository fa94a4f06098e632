"""Board files and folders that contradict the pictures are named in one line; synthetic views of a known rig."""

from dataclasses import replace

import numpy as np
import pytest

from cmmsim.calibration import Board, CalibrationError, PairView, calibrate, find_board
from cmmsim.calibration.detection import covered_radius
from cmmsim.geometry.camera import Optics
from tests.cmmsim.test_calibration_adjustment import BOARD, SHIFT, SIZE, board_poses, seen_pairs
from tests.cmmsim.test_calibration_images import ASYMMETRIC, BENT, DOTS, PERFECT, rendered


@pytest.fixture(scope="module")
def pairs():
    rng = np.random.default_rng(20)
    return seen_pairs(board_poses(12, rng), 0.05, rng)


def lines_with(word, board, pairs):
    """Warnings that hold a word, each of which must be one line."""
    warnings = calibrate(board, pairs, SIZE).warnings
    assert all("\n" not in line and len(line) < 300 for line in warnings)
    return [line for line in warnings if word in line]


def test_right_names_and_units_are_not_warned_of(pairs):
    for word in ("swap", "units", "not used", "radius", "err alike"):
        assert not lines_with(word, BOARD, pairs)


def test_swapped_folders_are_named_with_the_place_of_the_right_camera(pairs):
    swapped = [PairView(p.name, p.right, p.left) for p in pairs]
    (line,) = lines_with("swap the folders", BOARD, swapped)
    assert f"({SHIFT[0]:.2g}" in line  # of the left camera in the axes of the right one


@pytest.mark.parametrize(("unit", "size"), [(1e3, "400 x 300 m"), (1e2, "40 x 30 m"), (1e-3, "0.0004 x 0.0003 m")])
def test_lengths_that_are_no_metres_are_named(pairs, unit, size):
    (line,) = lines_with("other units", BOARD.model_copy(update={"spacing": unit * BOARD.spacing}), pairs)
    assert size in line
    baseline = unit * np.linalg.norm(SHIFT)
    assert float(line.split("cameras ")[1].split()[0]) == pytest.approx(baseline, rel=0.01)


def test_many_pairs_not_used_are_warned_of_with_the_board_of_the_file(pairs):
    def without(count):
        return [p.without(1, "no chessboard of 9 x 7 found") if k < count else p for k, p in enumerate(pairs)]

    assert not lines_with("not used", BOARD, without(4))
    (line,) = lines_with("not used", BOARD, without(5))
    assert line.startswith("5 of 12 pairs are not used, the first is 00.png (right: no chessboard of 9 x 7 found)")
    assert "9 columns and 7 rows" in line


def test_wrong_board_is_refused_in_one_short_line(pairs):
    none = [p.without(0, "no chessboard of 8 x 7 found").without(1, "no chessboard of 8 x 7 found") for p in pairs]
    with pytest.raises(CalibrationError) as refused:
        calibrate(BOARD, none, SIZE)
    assert str(refused.value).endswith("02.png (both: no chessboard of 8 x 7 found) and 9 more")
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize(("count", "said"), [(1, "in one place only"), (2, "in 2 places only")])
def test_pictures_alike_are_refused_as_such_in_whichever_order_they_are_read(count, said):
    rng = np.random.default_rng(21)
    same = seen_pairs(board_poses(count, rng)[np.arange(10) % count], 0.05, rng)
    turned = [PairView(p.name, *(v.read_as(BOARD.symmetries[k % 2]) for v in p.sides)) for k, p in enumerate(same)]
    for pairs in (same, turned):
        with pytest.raises(CalibrationError, match=f"the 10 pictures of the left .* alike.* {said}.*move and tilt"):
            calibrate(BOARD, pairs, SIZE)


# --- the dots' radius


@pytest.mark.parametrize(("rig", "board", "psf"), [(PERFECT, DOTS, 0.0), (BENT, DOTS, 1.0), (PERFECT, ASYMMETRIC, 0.4)])
@pytest.mark.parametrize("claimed", [1.0, 1.4])
def test_radius_of_dots_is_measured_whatever_the_board_file_says(rig, board, psf, claimed):
    claim = board.model_copy(update={"radius": min(claimed * board.radius, 0.39 * board.nearest)})
    _, frames = rendered(rig, board, 1, optics=Optics(psf_px=psf))
    assert find_board(frames[0].left, claim).radius == pytest.approx(board.radius, rel=0.02)


def test_far_too_small_a_radius_is_the_reason_given():
    _, frames = rendered(PERFECT, DOTS, 1)
    said = find_board(frames[0].left, DOTS.model_copy(update={"radius": 0.002}))
    assert said == "only 0 of 63 points are sharp and whole, its dots measure 0.0125 m in radius, not 0.002"


def test_area_covered_tells_the_radius_of_drawn_discs():
    """Anti-aliased discs by the share of 8 x 8 samples in each pixel."""
    centres = np.array([[30.2, 30.7], [90.4, 31.1], [60.0, 92.3]])
    y, x = (np.mgrid[:960, :960] + 0.5) / 8 - 0.5
    fine = np.max([np.hypot(x - cx, y - cy) < 11.0 for cx, cy in centres], axis=0)
    image = (20 + 200 * fine.reshape(120, 8, 120, 8).mean(axis=(1, 3))).astype(np.uint8)
    assert covered_radius(image, centres, np.tile(25.0 * np.eye(2), (3, 1, 1))) == pytest.approx(11 / 25, rel=0.01)


def test_wrong_radius_is_warned_of_with_both(pairs):
    board = Board(kind="dots", columns=9, rows=7, spacing=0.05, radius=0.014)
    for measured, warned in ((0.0095, True), (0.0132, False)):
        seen = [PairView(p.name, *(replace(v, radius=measured) for v in p.sides)) for p in pairs]
        assert bool(lines_with(f"radius 0.014 m, in the pictures they measure {measured:g} m", board, seen)) == warned
