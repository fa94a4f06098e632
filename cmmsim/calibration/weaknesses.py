"""What the user should know before trusting a calibration."""

from __future__ import annotations

import cv2
import numpy as np

from cmmsim.calibration.joint_adjustment import Adjustment
from cmmsim.calibration.sightings import SIDES, Sightings
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import StereoRig

LARGEST_FOCAL_STD = 0.003  # of the focal length
LARGEST_CENTRE_STD = 0.005  # of the image width
SMALLEST_TILT = 0.26  # rad between the board normals that differ most: 15 degrees
SMALLEST_COVER = 0.4  # of the image's area within the hull of all points
FEW_VIEWS = 8


def weaknesses(solved: Adjustment, sightings: tuple[Sightings, Sightings], rig: StereoRig) -> list[str]:
    """One line for each weakness of a calibration: errors shared within a view, uncertain cameras, boards alike, images
    not covered, few views."""
    lines = []
    if (factor := solved.shared.factor) > 1.0:
        lines.append(
            f"points of one view err alike: the covariance is on average {factor:.1f} times that of "
            f"independent errors (chance allows {solved.shared.limit:.1f}); is the board flat, evenly lit and "
            "sharp?"
        )
    spread = np.sqrt(np.diag(solved.covariance))
    tilt = solved.state.largest_tilt
    for side, (camera, name) in enumerate(zip(rig.cameras, SIDES, strict=True)):
        focal, centre = spread[9 * side : 9 * side + 2].max(), spread[9 * side + 2 : 9 * side + 4].max()
        if focal > LARGEST_FOCAL_STD * camera.focal_px or centre > LARGEST_CENTRE_STD * camera.width:
            lines.append(
                f"the {name} camera is uncertain: focal length {camera.focal_px:.1f} ± {focal:.1f} px, "
                f"principal point ± {centre:.1f} px (condition {solved.condition:.0e}); show the board tilted "
                "to all sides"
            )
        cover = _cover(sightings[side].pixels, camera.width, camera.height)
        if cover < SMALLEST_COVER:
            lines.append(
                f"board points cover {cover:.0%} of the {name} image, distortion beyond them is extrapolated; "
                "show the board in the corners too"
            )
    if tilt < SMALLEST_TILT:
        lines.append(
            f"the boards are nearly parallel: their normals differ by at most {np.degrees(tilt):.1f} degrees, "
            "so that focal length and distance can hardly be told apart; tilt the board by 30 "
            "degrees and more"
        )
    if (count := len(solved.state.left_from_boards)) < FEW_VIEWS:
        lines.append(f"{count} views only; {FEW_VIEWS} and more make an estimate of the uncertainty reliable")
    return lines


def _cover(pixels: Array, width: int, height: int) -> float:
    """Share of the image's area within the convex hull of all points."""
    hull = cv2.convexHull(pixels.astype(np.float32))
    return float(cv2.contourArea(hull)) / (width * height)
