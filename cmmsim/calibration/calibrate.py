"""From the views of a board to both cameras: start, adjust, give up what does not fit, correct the
dots' centres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

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
from cmmsim.calibration.calibrated_rig import Calibration, UsedView
from cmmsim.calibration.sightings import SIDES, PairView, Sightings, sightings_of, some, views_of
from cmmsim.calibration.start_values import start_values
from cmmsim.calibration.warnings import contradictions, weaknesses
from cmmsim.errors import CalibrationError
from cmmsim.geometry.camera import camera_from
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import StereoRig

FEWEST_PAIRS = 3
LARGEST_RMS_RATIO = 4.0  # an image with residuals above this many medians of all images is given up
ROUNDING_PX = 1e-3  # residuals below this are rounding, however they compare
ROUNDS = 5  # of giving up images, and of correcting dot centres
SETTLED_PX = 1e-4  # change of the dots' correction that ends it


@dataclass(frozen=True)
class CalibrationOptions:
    """distortion: free terms, a key of DISTORTIONS; fix_aspect: fx = fy; min_images: fewest pairs
    that show the board to both cameras; correct_dots: whether the eccentricity of dots is
    corrected."""

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
    """Calibrate both cameras from what pairs of images of size (width, height) px show.

    Images with the board in one camera only help that camera. Raises CalibrationError with the
    reasons of all pairs when too few show the board to both, or when the views do not determine the
    cameras.
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
    """Adjusted rig after giving up images that fit far worse than the others: all pairs, and those
    that are used.
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
                f"rms {rms[side, k]:.2f} px, more than {LARGEST_RMS_RATIO:g} times the "
                f"median of {usual:.2f} px"
            )
            judged[seen[k]] = judged[seen[k]].without(int(side), reason)
        start = solved.state
        boards[seen] = solved.state.left_from_boards
    return judged, [judged[k] for k in seen], solved, sightings


def _image_rms(solved: Adjustment, sightings: tuple[Sightings, Sightings]) -> Array:
    """Root mean square residual (2, v) of each image, px; NaN where it is not used."""
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
    """Adjusted rig with the eccentricity of the dots' images taken off, which needs the rig: by
    iteration.
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
    """Centre of each dot's image minus the image of its centre (m, 2), px."""
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
