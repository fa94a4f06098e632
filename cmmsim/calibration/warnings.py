"""Warnings about a calibration, and contradictions between the pictures and their board file."""

from collections.abc import Sequence

import cv2
import numpy as np

from cmmsim.calibration.adjustment import Adjustment, RigState
from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView, radius_differs
from cmmsim.calibration.sightings import SIDES, PairView, Sightings
from cmmsim.geometry.pose import apply, invert
from cmmsim.geometry.stereo_rig import StereoRig

BOARD_SIDES = (
    0.01,
    5.0,
)  # m, smallest and largest longer side of a board that is hardly a wrong unit
LARGEST_UNUSED = 1.0 / 3.0  # of the pairs
LEFTWARD = 0.5  # of the baseline, by which the right camera may stand on the left of the left one
LARGEST_FOCAL_STD = 0.003  # of the focal length
LARGEST_CENTRE_STD = 0.005  # of the image width
SMALLEST_TILT = 0.26  # rad between the board normals that differ most: 15 degrees
SMALLEST_COVER = 0.4  # of the image's area within the hull of all points
FEW_VIEWS = 8


def contradictions(board: Board, state: RigState, pairs: Sequence[PairView]) -> list[str]:
    """One line each: dots of another size, folders that seem swapped, lengths that seem no metres,
    many pairs not used.

    state: as adjusted; pairs: all of them, with the reasons of those that are not used.
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
        f"{measured:.4g} m "
        f"where their spacing is {board.spacing:g} m: correct the one that is wrong, the dots' "
        "centres rest on it"
    ]


def _swapped(state: RigState) -> list[str]:
    eye = invert(state.right_from_left)[:3, 3]
    if eye[0] >= -LEFTWARD * np.linalg.norm(eye):
        return []
    place = ", ".join(f"{value:.3g}" for value in eye)
    return [
        f"the right camera stands on the left of the left one, at ({place}) m in its axes: if "
        "that is not so, swap "
        "the folders LEFT and RIGHT"
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
        f"{baseline:.3g} m apart: "
        "the board file gives lengths in m, are these other units?"
    ]


def _unused(board: Board, pairs: Sequence[PairView]) -> list[str]:
    unused = [pair for pair in pairs if not pair.both]
    if len(unused) <= LARGEST_UNUSED * len(pairs):
        return []
    return [
        f"{len(unused)} of {len(pairs)} pairs are not used, the first is {unused[0].name} "
        f"({unused[0].reasons}): "
        f"has the board {board.columns} columns and {board.rows} rows as its file says?"
    ]


def weaknesses(
    solved: Adjustment, sightings: tuple[Sightings, Sightings], rig: StereoRig
) -> list[str]:
    """One line for each weakness of a calibration: errors shared within a view, uncertain cameras,
    boards alike, images not covered, few views."""
    lines = []
    if (factor := solved.shared.factor) > 1.0:
        lines.append(
            f"points of one view err alike: the covariance is on average {factor:.1f} times that "
            "of "
            f"independent errors (chance allows {solved.shared.limit:.1f}); is the board flat, "
            "evenly lit and "
            "sharp?"
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
                f"the {name} camera is uncertain: focal length {camera.focal_px:.1f} ± "
                f"{focal:.1f} px, "
                f"principal point ± {centre:.1f} px (condition {solved.condition:.0e}); show the "
                "board tilted "
                "to all sides"
            )
        hull = cv2.convexHull(sightings[side].pixels.astype(np.float32))
        cover = cv2.contourArea(hull) / (camera.width * camera.height)
        if cover < SMALLEST_COVER:
            lines.append(
                f"board points cover {cover:.0%} of the {name} image, distortion beyond them is "
                "extrapolated; "
                "show the board in the corners too"
            )
    if (tilt := solved.state.largest_tilt) < SMALLEST_TILT:
        lines.append(
            "the boards are nearly parallel: their normals differ by at most "
            f"{np.degrees(tilt):.1f} degrees, "
            "so that focal length and distance can hardly be told apart; tilt the board by 30 "
            "degrees and more"
        )
    if (count := len(solved.state.left_from_boards)) < FEW_VIEWS:
        lines.append(
            f"{count} views only; {FEW_VIEWS} and more make an estimate of the uncertainty reliable"
        )
    return lines
