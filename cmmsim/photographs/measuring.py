"""Measuring in photographs: one pose for each pair of images, as a row of a table.

The columns are named as in a record of an experiment, so the table can become a part of a record.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import PhotographError
from cmmsim.geometry.pose import Array
from cmmsim.measuring.layout_search import bright_ellipses
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.pose_estimator import PoseEstimator, measure_frame
from cmmsim.photographs.pairs import Photograph
from cmmsim.radiometry.stereo_images import StereoFrame, readable
from cmmsim.tracker import Tracker

# Coordinates of a pose and their units, as in the names of columns.
POSE = ("x", "y", "z", "alpha", "beta", "gamma")
UNITS = ("m", "m", "m", "rad", "rad", "rad")
# Entries (row, column) on and above the diagonal of a covariance (6, 6).
ENTRIES = [(row, column) for row in range(6) for column in range(row, 6)]
# Columns of the table; ``covariance`` is for noise, ``common`` for errors shared by all pairs.
COLUMNS = (
    "pair",
    "time_s",
    *(f"measured_{name}_{unit}" for name, unit in zip(POSE, UNITS, strict=True)),
    *(f"covariance_{POSE[row]}_{POSE[column]}" for row, column in ENTRIES),
    *(f"common_{POSE[row]}_{POSE[column]}" for row, column in ENTRIES),
    "stickers",
    "ok",
    "why",
)
# A hint is given if each image of a lost pair shows at least this many bright spots, as a fraction
# of the number of the platform's stickers.
SHOWN_SHARE = 0.5
# Radius of the circle around a used sticker in a picture, px.
CIRCLE_PX = 14


@dataclass(frozen=True)
class MeasuredPair:
    """Measurement of one pair of images.

    Attributes
    ----------
    name : str
        Name of the pair: its file, or its number.
    time : float
        Time of the images, s.
    measurement : Measurement
        Pose with its covariance, or the reason why there is none.
    images : StereoFrame
        Both images.

    Examples
    --------
    >>> images = StereoFrame(*np.zeros((2, 30, 40), dtype=np.uint8))
    >>> MeasuredPair("dark.png", 0.0, lost_measurement("no stickers"), images).row[-2:]
    ['0', 'no stickers']
    """

    name: str
    time: float
    measurement: Measurement
    images: StereoFrame

    @property
    def row(self) -> list[str]:
        """Cells of the columns `COLUMNS`; cells of a missing pose are empty."""
        measurement = self.measurement
        numbers = [
            *measurement.pose,
            *(measurement.covariance[entry] for entry in ENTRIES),
            *(measurement.common_covariance[entry] for entry in ENTRIES),
        ]
        return [
            self.name,
            repr(float(self.time)),
            *(repr(float(number)) if np.isfinite(number) else "" for number in numbers),
            str(len(measurement.target_ids)),
            str(int(measurement.ok)),
            measurement.reason,
        ]

    def picture(self) -> NDArray[np.uint8]:
        """Return both images side by side, with a circle and a name at each sticker used."""
        sides = zip(
            (self.images.left, self.images.right),
            (self.measurement.left_pixels, self.measurement.right_pixels),
            strict=True,
        )
        return np.hstack(
            [_marked(image, pixels, self.measurement.target_ids) for image, pixels in sides]
        )


def _marked(image: NDArray, at: Array, names: NDArray[np.str_]) -> NDArray[np.uint8]:
    """Return an image in colours with marks at pixels (n, 2)."""
    white = max(float(np.percentile(image, 99.9)), 1.0)
    grey = np.clip(image * (255.0 / white), 0.0, 255.0).astype(np.uint8)
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    for (x, y), name in zip(np.rint(at).astype(int).tolist(), names, strict=True):
        cv2.circle(picture, (x, y), CIRCLE_PX, (0, 255, 0), 1, cv2.LINE_AA)
        label_position = (x + CIRCLE_PX, y - CIRCLE_PX)
        cv2.putText(
            picture, str(name), label_position, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 255, 0), 1
        )
    return np.asarray(picture, dtype=np.uint8)


def measure_pairs(
    photographs: Iterable[Photograph], estimator: PoseEstimator
) -> Iterator[MeasuredPair]:
    """Yield the measurement of each pair.

    Stickers are searched near the pose that the preceding pairs predict. Raises PhotographError if
    no pose is found in the first pair until its images are exchanged.
    """
    tracker = Tracker(estimator)
    for number, photograph in enumerate(photographs):
        measurement = tracker.measure(photograph.images)
        if not measurement.ok:
            if number == 0:
                _require_order(photograph, estimator)
            reason = measurement.reason
            measurement = lost_measurement(reason + _hint(reason, photograph, estimator))
        yield MeasuredPair(photograph.name, photograph.time, measurement, photograph.images)


def _hint(reason: str, lost: Photograph, estimator: PoseEstimator) -> str:
    """Return a hint if each image of a lost pair shows enough bright spots; otherwise no text.

    reason: why the pair is lost, as `frame_solver.lost_reason` says it.
    """
    sides = bright_ellipses(readable(lost.images), estimator)
    counts = [int(fits.good.sum()) for fits in sides]
    if min(counts) < SHOWN_SHARE * len(estimator.platform.sticker_ids):
        return ""
    outlines = (
        "; stickers of another radius, or images of another blur, than those of teaching have "
        "other outlines: teach anew with such images"
        if "of its outline" in reason
        else ""
    )
    return (
        f" ({counts[0]} bright spots in the left image and {counts[1]} in the right: do the images "
        f"belong together, and have the cameras stood still since teaching?{outlines})"
    )


def _require_order(first: Photograph, estimator: PoseEstimator) -> None:
    """Raise PhotographError if a pose is found in the images of a pair when they are exchanged."""
    left, right = first.images.left, first.images.right
    if left.shape == right.shape and measure_frame(StereoFrame(right, left), estimator).ok:
        raise PhotographError(
            f"{first.name}: left and right are exchanged: give the two folders in the other order"
        )
