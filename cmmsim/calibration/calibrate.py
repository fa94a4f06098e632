"""Calibration of both cameras from the views of a board, with warnings about doubtful results.

The steps are the initial values, the adjustment, the rejection of images that do not fit, and the
correction of the dots' centres.
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
from cmmsim.calibration.sightings import SIDES, PairView, Sightings, sightings_of, views_of
from cmmsim.calibration.start_values import start_values
from cmmsim.errors import CalibrationError
from cmmsim.files.image_files import some
from cmmsim.geometry.camera import camera_from
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import Array, apply, invert
from cmmsim.geometry.stereo_rig import StereoRig

# Smallest number of pairs in which both cameras see the board.
FEWEST_PAIRS = 3
# An image is rejected if its rms residual exceeds this multiple of the median over all images.
LARGEST_RMS_RATIO = 4.0
# Rms residuals below this limit are rounding errors and never lead to a rejection.
ROUNDING_PX = 1e-3
# Largest number of rounds in which images are rejected, and in which dot centres are corrected.
ROUNDS = 5
# The correction of the dot centres ends when it changes by less than this.
TOLERANCE_PX = 1e-4
# Plausible range of a board's longer side, m. Other values give a warning about the unit.
BOARD_SIDES = (0.01, 5.0)
# A warning is given if more than this fraction of the pairs has an unused image.
LARGEST_UNUSED = 1.0 / 3.0
# A warning is given if the right camera stands to the left of the left camera by more than this
# fraction of the baseline.
LARGEST_LEFTWARD = 0.5
# A warning is given if the standard deviation of the focal length exceeds this fraction of the
# focal length, or that of the principal point exceeds this fraction of the image's width.
LARGEST_FOCAL_STD = 0.003
LARGEST_CENTRE_STD = 0.005
# A warning is given if no two board normals differ by this angle, rad (15 degrees).
SMALLEST_TILT = 0.26
# A warning is given if the convex hull of all points covers less than this fraction of the image.
SMALLEST_COVER = 0.4
# A warning is given if there are fewer views than this.
FEW_VIEWS = 8


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a calibration.

    ``distortion`` is the key of DISTORTIONS that names the free distortion terms. ``fix_aspect``
    sets fx = fy. ``min_images`` is the required number of pairs in which both cameras see the
    board. ``correct_dots`` enables the correction for the eccentricity of the dots' images. Raises
    UnknownOptionError for an unknown key, and CalibrationError if ``min_images`` is too small.
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

    A pair in which only one camera sees the board contributes to that camera only. Raises
    CalibrationError, with the reasons, if both cameras see the board in too few pairs, if too few
    pairs agree on the pose of the right camera, or if the views do not determine the cameras.
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
    """Raise CalibrationError if both cameras see the board in too few pairs."""
    good = sum(pair.both for pair in pairs)
    if good < options.min_images:
        reasons = some([f"{pair.name} ({pair.reasons})" for pair in pairs if not pair.both])
        raise CalibrationError(
            f"both cameras see the board in {good} of {len(pairs)} pairs, but "
            f"{options.min_images} are needed"
            + (f"; pairs without it: {reasons}" if good < len(pairs) else "")
        )


def _without_misfits(
    board: Board,
    pairs: Sequence[PairView],
    start: RigState,
    free: Array,
    options: CalibrationOptions,
) -> tuple[list[PairView], list[PairView], Adjustment, tuple[Sightings, Sightings]]:
    """Adjust the rig, and reject images that fit far worse than the others.

    Return all pairs, the used pairs, the adjustment, and the sightings that the adjustment used.
    In the pairs, a reason replaces each rejected view.
    """
    judged = list(pairs)
    boards = start.left_from_boards.copy()
    # the last adjustment follows the last rejection, so that no rejected image takes part in it
    for rejections in range(ROUNDS + 1):
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
        if not len(worst) or rejections == ROUNDS:
            break
        for side, k in worst:
            reason = (
                f"rms {rms[side, k]:.2f} px, more than {LARGEST_RMS_RATIO:g} times the median of "
                f"{usual:.2f} px"
            )
            judged[seen[k]] = judged[seen[k]].without(int(side), reason)
        # the next round starts where this one ended
        start = solved.state
        boards[seen] = solved.state.left_from_boards
    return judged, [judged[k] for k in seen], solved, sightings


def _image_rms(solved: Adjustment, sightings: tuple[Sightings, Sightings]) -> Array:
    """Return the root mean square residual (2, v) of each image, px. Unused images have NaN."""
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
    """Adjust the rig to dot centres that are corrected for the eccentricity of their images.

    Return the adjustment, and the corrected sightings. The correction depends on the rig, so
    correction and adjustment alternate.
    """
    latest = [np.zeros_like(seen.pixels) for seen in measured]
    for _ in range(ROUNDS):
        offsets = [
            _offsets(board, seen, solved.state, side, size) for side, seen in enumerate(measured)
        ]
        corrected = measured[0].shifted(-offsets[0]), measured[1].shifted(-offsets[1])
        solved = adjust(board.points, corrected, solved.state, free)
        change = max(
            np.abs(now - before).max() for now, before in zip(offsets, latest, strict=True)
        )
        latest = offsets
        if change < TOLERANCE_PX:
            break
    return solved, corrected


def _offsets(
    board: Board, seen: Sightings, state: RigState, side: int, size: tuple[int, int]
) -> Array:
    """Return the eccentricities (m, 2) px: a dot image's centre minus the dot centre's image."""
    poses = state.left_from_boards if side == 0 else state.right_from_left @ state.left_from_boards
    centres = (
        np.einsum("mij,mj->mi", poses[seen.view, :3, :3], board.points[seen.point])
        + poses[seen.view, :3, 3]
    )
    normals = -poses[seen.view, :3, 2]
    return centre_offset(
        camera_from(state.intrinsics[side], *size), centres, normals, board.dot_radius
    )


def _used(
    kept: Sequence[PairView], solved: Adjustment, sightings: tuple[Sightings, Sightings]
) -> list[UsedView]:
    """Return the used pairs with the rms residuals of their images."""
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

    The checks are the size of the dots, the order of the two folders, the unit of lengths, and the
    number of unused pairs. ``state`` is the adjusted state. ``pairs`` are all pairs, used or not.
    """
    return [
        *_dot_radius(board, pairs),
        *_swapped(state),
        *_units(board, state),
        *_unused(board, pairs),
    ]


def _dot_radius(board: Board, pairs: Sequence[PairView]) -> list[str]:
    """Return a line if the measured radius of the dots contradicts the board file."""
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
        f"the board file gives dots of radius {board.radius:g} m, but in the pictures the radius "
        f"is {measured:.4g} m for a spacing of {board.spacing:g} m: correct the wrong value, "
        "because the dots' centres depend on it"
    ]


def _swapped(state: RigState) -> list[str]:
    """Return a line if the right camera stands to the left of the left camera."""
    eye = invert(state.right_from_left)[:3, 3]
    if eye[0] >= -LARGEST_LEFTWARD * np.linalg.norm(eye):
        return []
    where = ", ".join(f"{value:.3g}" for value in eye)
    return [
        "the right camera stands on the left of the left camera, at "
        f"({where}) m in the left camera's axes: if this is wrong, swap the folders LEFT and RIGHT"
    ]


def _units(board: Board, state: RigState) -> list[str]:
    """Return a line if the board is so small or large that its unit is probably wrong."""
    width, height = np.ptp(board.points[:, :2], axis=0)
    if BOARD_SIDES[0] <= max(width, height) <= BOARD_SIDES[1]:
        return []
    middle = board.points.mean(axis=0)
    distance = np.median([np.linalg.norm(apply(pose, middle)) for pose in state.left_from_boards])
    baseline = np.linalg.norm(state.right_from_left[:3, 3])
    return [
        f"the board measures {width:.3g} x {height:.3g} m, at {distance:.3g} m from cameras "
        f"{baseline:.3g} m apart: are the lengths in the board file in m?"
    ]


def _unused(board: Board, pairs: Sequence[PairView]) -> list[str]:
    """Return a line if too many pairs have an unused image."""
    unused = [pair for pair in pairs if not pair.both]
    if len(unused) <= LARGEST_UNUSED * len(pairs):
        return []
    return [
        f"in {len(unused)} of {len(pairs)} pairs an image is not used, first in {unused[0].name} "
        f"({unused[0].reasons}): does the board have {board.columns} columns and {board.rows} rows "
        "as its file states?"
    ]


def weaknesses(
    solved: Adjustment, sightings: tuple[Sightings, Sightings], rig: StereoRig
) -> list[str]:
    """Return one line for each weakness of a calibration.

    The checks are common errors of the points of a view, the uncertainty of the cameras, the part
    of the image that the points cover, the tilt of the boards, and the number of views.
    """
    lines = []
    if (factor := solved.shared.factor) > 1.0:
        lines.append(
            f"points of one view have common errors: the covariance is on average {factor:.1f} "
            f"times that of independent errors (limit by chance: {solved.shared.limit:.1f}); is "
            "the board flat, evenly lit and sharp?"
        )
    std = np.sqrt(np.diag(solved.covariance))
    for side, (camera, name) in enumerate(zip(rig.cameras, SIDES, strict=True)):
        focal = std[9 * side : 9 * side + 2].max()
        centre = std[9 * side + 2 : 9 * side + 4].max()
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
                f"board points cover {cover:.0%} of the {name} image, and the distortion outside "
                "is extrapolated; show the board in the corners, too"
            )
    if (tilt := solved.state.largest_tilt) < SMALLEST_TILT:
        lines.append(
            "the boards are nearly parallel: their normals differ by at most "
            f"{np.degrees(tilt):.1f} degrees, so that focal length and distance are hardly "
            "separable; tilt the board by 30 degrees and more"
        )
    if (count := len(solved.state.left_from_boards)) < FEW_VIEWS:
        lines.append(
            f"only {count} views: the stated uncertainty is reliable from {FEW_VIEWS} views on"
        )
    return lines
