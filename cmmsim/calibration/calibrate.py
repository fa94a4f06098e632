"""Calibration of both cameras from the views of a board, and warnings about it.

The steps are start values, the adjustment, giving up images that do not fit, and the correction of
the dots' centres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cmmsim.calibration.adjustment import (
    DEFAULT_DISTORTION,
    DISTORTIONS,
    Adjustment,
    RigState,
    adjust,
    free_directions,
)
from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView, radius_differs
from cmmsim.calibration.calibrated_rig import Calibration, UsedView
from cmmsim.calibration.sightings import SIDES, PairView, Sightings, sightings_of, some, views_of
from cmmsim.calibration.start_values import start_values
from cmmsim.errors import CalibrationError
from cmmsim.geometry.camera import camera_from
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import Array, apply, invert
from cmmsim.geometry.stereo_rig import StereoRig

FEWEST_PAIRS = 3
# An image is given up if its residuals exceed this many medians of all images.
LARGEST_RMS_RATIO = 4.0
# Residuals below this are rounding, however they compare.
ROUNDING_PX = 1e-3
# Rounds of giving up images, and of correcting dot centres.
ROUNDS = 5
# Change of the dots' correction that ends it.
SETTLED_PX = 1e-4
# m: a board whose longer side lies outside is taken for one in a wrong unit.
BOARD_SIDES = (0.01, 5.0)
# Share of the pairs.
LARGEST_UNUSED = 1.0 / 3.0
# Share of the baseline by which the right camera may stand on the left of the left one.
LEFTWARD = 0.5
# Shares of the focal length and of the image width.
LARGEST_FOCAL_STD = 0.003
LARGEST_CENTRE_STD = 0.005
# rad between the board normals that differ most: 15 degrees.
SMALLEST_TILT = 0.26
# Share of the image's area within the hull of all points.
SMALLEST_COVER = 0.4
FEW_VIEWS = 8


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a calibration.

    ``distortion`` names the free terms, a key of DISTORTIONS. ``fix_aspect`` sets fx = fy.
    ``min_images`` is the fewest pairs that show the board to both cameras. ``correct_dots`` takes
    the eccentricity of dots off.
    """

    distortion: str = DEFAULT_DISTORTION
    fix_aspect: bool = False
    min_images: int = FEWEST_PAIRS
    correct_dots: bool = True

    def __post_init__(self) -> None:
        free_directions(self.distortion, self.fix_aspect)
        if self.min_images < FEWEST_PAIRS:
            raise CalibrationError(
                f"at least {FEWEST_PAIRS} pairs are needed, min_images is {self.min_images}"
            )


def calibrate(
    board: Board,
    pairs: Sequence[PairView],
    size: tuple[int, int],
    options: CalibrationOptions | None = None,
) -> Calibration:
    """Calibrate both cameras from pairs of images of size (width, height) px.

    An image pair with the board in one camera only helps that camera. Raises CalibrationError with
    the reasons of all pairs when too few show the board to both, or when the views do not determine
    the cameras.
    """
    options = options or CalibrationOptions()
    _require_pairs(pairs, options)
    free = free_directions(options.distortion, options.fix_aspect)
    start, read = start_values(
        board, pairs, size, bool(DISTORTIONS[options.distortion]), options.fix_aspect
    )
    judged, kept, solved, sightings = _without_misfits(board, read, start, free, options)
    if board.dot_radius and options.correct_dots:
        solved, sightings = _with_true_centres(board, sightings, solved, free, size)
    left, right = (camera_from(values, *size) for values in solved.state.intrinsics)
    rig = StereoRig(left, right, solved.state.right_from_left.copy())
    return Calibration(
        rig,
        board,
        options.distortion,
        options.fix_aspect,
        solved,
        sightings,
        used=_used(kept, solved, sightings),
        rejected={pair.name: pair.reasons for pair in judged if pair.reasons},
        warnings=contradictions(board, solved.state, judged) + weaknesses(solved, sightings, rig),
    )


def _require_pairs(pairs: Sequence[PairView], options: CalibrationOptions) -> None:
    good = sum(pair.both for pair in pairs)
    if good < options.min_images:
        reasons = some([f"{pair.name} ({pair.reasons})" for pair in pairs if not pair.both])
        raise CalibrationError(
            f"{good} of {len(pairs)} pairs show the board to both cameras, {options.min_images} "
            "needed" + (f"; without it: {reasons}" if good < len(pairs) else "")
        )


def _without_misfits(
    board: Board,
    pairs: Sequence[PairView],
    start: RigState,
    free: Array,
    options: CalibrationOptions,
) -> tuple[list[PairView], list[PairView], Adjustment, tuple[Sightings, Sightings]]:
    """Adjust the rig, giving up images that fit far worse than the others.

    Return all pairs, those that are used, the adjustment and its sightings.
    """
    judged = list(pairs)
    boards = start.left_from_boards.copy()
    for _ in range(ROUNDS):
        _require_pairs(judged, options)
        seen = sorted(views_of(judged, 0).keys() | views_of(judged, 1).keys())
        sightings = sightings_of([judged[k] for k in seen])
        solved = adjust(
            board.points,
            sightings,
            RigState(start.intrinsics, start.right_from_left, boards[seen]),
            free,
        )
        rms = _image_rms(solved, sightings)
        usual = float(np.nanmedian(rms))
        worst = np.argwhere(rms > max(LARGEST_RMS_RATIO * usual, ROUNDING_PX))
        if not len(worst):
            break
        for side, k in worst:
            reason = (
                f"rms {rms[side, k]:.2f} px, more than {LARGEST_RMS_RATIO:g} times the median of "
                f"{usual:.2f} px"
            )
            judged[seen[k]] = judged[seen[k]].without(int(side), reason)
        # The next round starts where this one ended.
        start = solved.state
        boards[seen] = solved.state.left_from_boards
    return judged, [judged[k] for k in seen], solved, sightings


def _image_rms(solved: Adjustment, sightings: tuple[Sightings, Sightings]) -> Array:
    """Return the root mean square residual (2, v) of each image, px; NaN where it is not used."""
    views = len(solved.state.left_from_boards)
    rms = np.full((2, views), np.nan)
    for side, (seen, residuals) in enumerate(zip(sightings, solved.residuals, strict=True)):
        for k in np.unique(seen.view):
            rms[side, k] = np.sqrt(np.mean(residuals[seen.view == k] ** 2))
    return rms


def _with_true_centres(
    board: Board,
    measured: tuple[Sightings, Sightings],
    solved: Adjustment,
    free: Array,
    size: tuple[int, int],
) -> tuple[Adjustment, tuple[Sightings, Sightings]]:
    """Adjust the rig with the eccentricity of the dots' images taken off.

    The correction needs the rig, so both are found in turns.
    """
    last = [np.zeros_like(seen.pixels) for seen in measured]
    for _ in range(ROUNDS):
        offsets = [
            _offsets(board, seen, solved.state, side, size) for side, seen in enumerate(measured)
        ]
        corrected = measured[0].shifted(-offsets[0]), measured[1].shifted(-offsets[1])
        solved = adjust(board.points, corrected, solved.state, free)
        change = max(np.abs(now - before).max() for now, before in zip(offsets, last, strict=True))
        last = offsets
        if change < SETTLED_PX:
            break
    return solved, corrected


def _offsets(
    board: Board, seen: Sightings, state: RigState, side: int, size: tuple[int, int]
) -> Array:
    """Return the centre of each dot's image minus the image of its centre (m, 2), px."""
    moves = state.left_from_boards if side == 0 else state.right_from_left @ state.left_from_boards
    places = (
        np.einsum("mij,mj->mi", moves[seen.view, :3, :3], board.points[seen.point])
        + moves[seen.view, :3, 3]
    )
    normals = -moves[seen.view, :3, 2]
    return centre_offset(
        camera_from(state.intrinsics[side], *size), places, normals, board.dot_radius
    )


def _used(
    kept: Sequence[PairView], solved: Adjustment, sightings: tuple[Sightings, Sightings]
) -> list[UsedView]:
    rms = _image_rms(solved, sightings)
    return [
        UsedView(
            pair.name,
            k,
            {side: float(rms[j, k]) for j, side in enumerate(SIDES) if np.isfinite(rms[j, k])},
        )
        for k, pair in enumerate(kept)
    ]


def contradictions(board: Board, state: RigState, pairs: Sequence[PairView]) -> list[str]:
    """Return one line for each contradiction between the pictures and their board file.

    They are dots of another size, folders that seem swapped, lengths that seem no metres, and many
    unused pairs. ``state`` is adjusted; ``pairs`` are all, with the reasons of those not used.
    """
    return [
        *_dot_radius(board, pairs),
        *_swapped(state),
        *_units(board, state),
        *_unused(board, pairs),
    ]


def _dot_radius(board: Board, pairs: Sequence[PairView]) -> list[str]:
    radii = [
        view.radius
        for pair in pairs
        for view in pair.sides
        if isinstance(view, BoardView) and view.radius is not None
    ]
    measured = float(np.median(radii)) if radii else None
    if not radius_differs(measured, board.radius):
        return []
    return [
        f"the board file gives dots of radius {board.radius:g} m, in the pictures they measure "
        f"{measured:.4g} m where their spacing is {board.spacing:g} m: correct the one that is "
        "wrong, the dots' centres rest on it"
    ]


def _swapped(state: RigState) -> list[str]:
    eye = invert(state.right_from_left)[:3, 3]
    if eye[0] >= -LEFTWARD * np.linalg.norm(eye):
        return []
    place = ", ".join(f"{value:.3g}" for value in eye)
    return [
        f"the right camera stands on the left of the left one, at ({place}) m in its axes: if that "
        "is not so, swap the folders LEFT and RIGHT"
    ]


def _units(board: Board, state: RigState) -> list[str]:
    width, height = np.ptp(board.points[:, :2], axis=0)
    if BOARD_SIDES[0] <= max(width, height) <= BOARD_SIDES[1]:
        return []
    middle = board.points.mean(axis=0)
    distance = np.median([np.linalg.norm(apply(pose, middle)) for pose in state.left_from_boards])
    baseline = np.linalg.norm(state.right_from_left[:3, 3])
    return [
        f"a board of {width:.3g} x {height:.3g} m, seen from {distance:.3g} m by cameras "
        f"{baseline:.3g} m apart: the board file gives lengths in m, are these other units?"
    ]


def _unused(board: Board, pairs: Sequence[PairView]) -> list[str]:
    unused = [pair for pair in pairs if not pair.both]
    if len(unused) <= LARGEST_UNUSED * len(pairs):
        return []
    return [
        f"{len(unused)} of {len(pairs)} pairs are not used, the first is {unused[0].name} "
        f"({unused[0].reasons}): has the board {board.columns} columns and {board.rows} rows as "
        "its file says?"
    ]


def weaknesses(
    solved: Adjustment, sightings: tuple[Sightings, Sightings], rig: StereoRig
) -> list[str]:
    """Return one line for each weakness of a calibration.

    They are errors shared within a view, uncertain cameras, boards alike, images not covered, and
    few views.
    """
    lines = []
    if (factor := solved.shared.factor) > 1.0:
        lines.append(
            f"points of one view err alike: the covariance is on average {factor:.1f} times that "
            f"of independent errors (chance allows {solved.shared.limit:.1f}); is the board flat, "
            "evenly lit and sharp?"
        )
    spread = np.sqrt(np.diag(solved.covariance))
    for side, (camera, name) in enumerate(zip(rig.cameras, SIDES, strict=True)):
        focal = spread[9 * side : 9 * side + 2].max()
        centre = spread[9 * side + 2 : 9 * side + 4].max()
        if (
            focal > LARGEST_FOCAL_STD * camera.focal_px
            or centre > LARGEST_CENTRE_STD * camera.width
        ):
            lines.append(
                f"the {name} camera is uncertain: focal length {camera.focal_px:.1f} ± {focal:.1f} "
                f"px, principal point ± {centre:.1f} px (condition {solved.condition:.0e}); show "
                "the board tilted to all sides"
            )
        hull = cv2.convexHull(sightings[side].pixels.astype(np.float32))
        cover = cv2.contourArea(hull) / (camera.width * camera.height)
        if cover < SMALLEST_COVER:
            lines.append(
                f"board points cover {cover:.0%} of the {name} image, distortion beyond them is "
                "extrapolated; show the board in the corners too"
            )
    if (tilt := solved.state.largest_tilt) < SMALLEST_TILT:
        lines.append(
            "the boards are nearly parallel: their normals differ by at most "
            f"{np.degrees(tilt):.1f} degrees, so that focal length and distance can hardly be told "
            "apart; tilt the board by 30 degrees and more"
        )
    if (count := len(solved.state.left_from_boards)) < FEW_VIEWS:
        lines.append(
            f"{count} views only; {FEW_VIEWS} and more make an estimate of the uncertainty reliable"
        )
    return lines
