"""Measurement frame after frame.

Stickers are searched at a pose predicted from previous measurements, never at the true pose.
"""

from __future__ import annotations

from cmmsim.errors import DividedError, LostError
from cmmsim.geometry.pose import Array, invert, rigid, rotation_exp, rotation_log
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.pose_estimator import PoseEstimator, require_estimator, require_fitting
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages, readable

# The whole images are searched as well if the predicted windows show fewer stickers than this
# fraction of those in the previous frame. A wrong prediction places windows beside the stickers.
EXPECTED_SHARE = 0.7
Ends = tuple[Array, Array] | None
"""Transforms camera_from_platform (4, 4) at the beginning and at the end of some time, or None."""


class Tracker:
    """Tracker that measures frame after frame, near a pose predicted from the previous two poses.

    If the predicted windows show too few stickers, the whole images are searched as well, and the
    result with more stickers is used. Moving stickers are blurred during the exposure. The fit
    computes the blur from the speed since the previous frame. In the first frame of a run, and in
    the first frame after a loss, the speed is estimated from the blur.

    Parameters
    ----------
    estimator : PoseEstimator
        Estimator of single frames, such as ``sensor.estimator``.

    Raises
    ------
    CmmError
        If the estimator is of another type.

    Examples
    --------
    >>> tracker = Tracker(sensor.estimator)
    >>> tracker.measure(sensor.look(sensor.home)).ok
    True
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        require_estimator(estimator)
        self._estimator = estimator
        self.forget()

    def forget(self) -> None:
        """Forget all poses, so that the next measurement searches the whole images."""
        self._last: Array | None = None
        self._step_before: Array | None = None
        self._seen = 0

    def measure(self, images: StereoImages | StereoFrame) -> Measurement:
        """Measure one frame. No content of the images raises an exception.

        Parameters
        ----------
        images : StereoFrame or images of ``sensor.look``
            Images that the estimator's rig took.

        Returns
        -------
        Measurement
            Pose with its covariance, or the reason why the frame is lost.

        Raises
        ------
        ShapeError
            If a StereoFrame has another size or bit depth.
        CmmError
            If ``images`` is neither a StereoFrame nor images of ``sensor.look``.
        """
        if isinstance(images, StereoFrame):
            require_fitting(images, self._estimator)
        images = readable(images)
        best = self._tracked(images)
        if best is None or len(best[0].target_ids) < EXPECTED_SHARE * self._seen:
            try:
                searched = self._searched(images)
            except LostError as error:
                # If two groups of stickers contradict each other, windows that show only one of
                # them must not decide for this group.
                if best is None or isinstance(error, DividedError):
                    self.forget()
                    return lost_measurement(str(error))
            else:
                best = (
                    searched
                    if best is None
                    else max(best, searched, key=lambda result: len(result[0].target_ids))
                )
        measurement, measured = best
        self._step_before = None if self._last is None else invert(self._last) @ measured
        self._last = measured
        self._seen = len(measurement.target_ids)
        return measurement

    def miss(self) -> None:
        """Skip a frame without an image; the movement is assumed to continue."""
        if self._last is not None:
            self._last = self._predicted()

    def _tracked(self, images: StereoImages) -> tuple[Measurement, Array] | None:
        """Return the measurement in the predicted windows, or None.

        The result is None without a previous pose, and if the predicted windows give no pose.
        """
        if self._last is None:
            return None
        try:
            if self._step_before is not None:
                predicted = self._predicted()
                return self._estimator.measure(images, predicted, *self._ends(predicted))
            _, rough = self._estimator.measure(images, self._last)
            return self._estimator.measure(images, rough, *self._ends(rough))
        except LostError:
            return None

    def _searched(self, images: StereoImages) -> tuple[Measurement, Array]:
        """Return the measurement after a search of the whole images."""
        rough = self._estimator.locate(images)
        if self._last is None:
            return self._estimator.measure_anew(images, rough)
        return self._estimator.measure(images, rough, *self._ends(rough))

    def _ends(self, middle: Array) -> tuple[Ends, Ends]:
        """Return camera_from_platform at both ends of the exposure, and of a frame period.

        Both intervals have the same middle, in which camera_from_platform is ``middle``. The first
        result is None if the exposure takes no time. Without a previous pose, both are None.
        """
        share = self._estimator.settings.exposed_share
        return self._part_of_frame(middle, share), self._part_of_frame(middle, 1.0)

    def _part_of_frame(self, middle: Array, share: float) -> Ends:
        """Return camera_from_platform (4, 4) at both ends of the fraction ``share`` of a period.

        In the middle of this interval, camera_from_platform is ``middle``. The speed is the mean
        speed since the previous frame. The result is None without a previous pose, or if ``share``
        is zero.
        """
        if self._last is None or share == 0.0:
            return None
        step = invert(self._last) @ middle
        return middle @ part_of_step(step, -0.5 * share), middle @ part_of_step(step, 0.5 * share)

    def _predicted(self) -> Array:
        """Return camera_from_platform (4, 4) of the next frame if the movement continues."""
        assert self._last is not None
        return self._last if self._step_before is None else self._last @ self._step_before


def part_of_step(step: Array, share: float) -> Array:
    """Return the fraction ``share`` of a small movement (4, 4), to first order."""
    return rigid(rotation_exp(share * rotation_log(step[:3, :3])), share * step[:3, 3])
