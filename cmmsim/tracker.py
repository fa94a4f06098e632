"""Frame after frame: where to look next comes from what was measured last, never from the true
pose.
"""

from __future__ import annotations

from cmmsim.checks import require_kind
from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, invert, rigid, rotation_exp, rotation_log
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.pose_estimator import PoseEstimator, require_fitting
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages, readable

# A tracked frame that shows less than this share of the stickers seen before is searched as a whole
# too: most windows may have been laid beside their stickers.
EXPECTED_SHARE = 0.7


class Tracker:
    """Remembers the last two measured poses.

    A frame in which the prediction fails is searched as a whole at once; where that finds fewer
    stickers, what the prediction found stands. What moves is fitted as the exposure smears it, as
    fast as it moved since the last frame; in the first frame of a run, and in the first after a
    loss, the smear itself tells how far.
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        require_kind(
            estimator,
            PoseEstimator,
            "an estimator must be a PoseEstimator, such as sensor.estimator",
        )
        self._estimator = estimator
        self.forget()

    def forget(self) -> None:
        """The next frame is searched as a whole."""
        self._last: Array | None = None
        self._step_before: Array | None = None
        self._seen = 0

    def measure(self, images: StereoImages | StereoFrame) -> Measurement:
        """Measure one frame, such as ``sensor.look`` returns or a StereoFrame; never raises for
        what is in the images.

        Raises ShapeError for a StereoFrame of another size or bit depth, CmmError for what is no
        image.
        """
        if isinstance(images, StereoFrame):
            require_fitting(images, self._estimator)
        images = readable(images)
        best = self._tracked(images)
        if best is None or len(best[0].target_ids) < EXPECTED_SHARE * self._seen:
            try:
                found = self._found(images)
            except LostError as error:
                if best is None:
                    self.forget()
                    return lost_measurement(str(error))
            else:
                best = (
                    found
                    if best is None
                    else max(best, found, key=lambda result: len(result[0].target_ids))
                )
        measurement, measured = best
        self._step_before = None if self._last is None else invert(self._last) @ measured
        self._last = measured
        self._seen = len(measurement.target_ids)
        return measurement

    def miss(self) -> None:
        """A frame passed that nobody saw: the movement is taken to go on."""
        if self._last is not None:
            self._last = self._predicted()

    def _tracked(self, images: StereoImages) -> tuple[Measurement, Array] | None:
        """The measurement in the predicted windows; None without a prediction or where it did not
        hold.
        """
        if self._last is None:
            return None
        try:
            if self._step_before is not None:
                predicted = self._predicted()
                return self._estimator.measure(images, predicted, self._swept(predicted))
            found = self._estimator.measure(images, self._last)
            swept = self._swept(found[1])
            return found if swept is None else self._estimator.measure(images, found[1], swept)
        except LostError:
            return None

    def _found(self, images: StereoImages) -> tuple[Measurement, Array]:
        """The measurement after a search of the whole images, with no prior for where the platform
        is.
        """
        found = self._estimator.locate(images)
        if self._last is None:
            return self._estimator.measure_anew(images, found)
        return self._estimator.measure(images, found, self._swept(found))

    def _swept(self, middle: Array) -> tuple[Array, Array] | None:
        """camera_from_platform (4,4) at the beginning and the end of an exposure about ``middle``.

        As fast as since the last frame; None where there was none or the exposure takes no time.
        """
        share = self._estimator.settings.exposed_share
        if self._last is None or share == 0.0:
            return None
        step = invert(self._last) @ middle
        return middle @ part_of_step(step, -0.5 * share), middle @ part_of_step(step, 0.5 * share)

    def _predicted(self) -> Array:
        """camera_from_platform (4,4) if the last movement goes on."""
        assert self._last is not None
        return self._last if self._step_before is None else self._last @ self._step_before


def part_of_step(step: Array, share: float) -> Array:
    """A ``share`` of a small movement (4,4), to first order."""
    return rigid(rotation_exp(share * rotation_log(step[:3, :3])), share * step[:3, 3])
