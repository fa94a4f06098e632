"""Frame after frame: where to look next comes from what was measured last, never from the true pose."""

from __future__ import annotations

from .errors import LostError
from .estimator import PoseEstimator
from .images import StereoImages
from .measurement import Measurement, lost_measurement
from .pose import Array, invert


class Tracker:
    """Remembers the last two measured poses; after a lost frame it searches the whole images again."""

    def __init__(self, estimator: PoseEstimator) -> None:
        self._estimator = estimator
        self.forget()

    def forget(self) -> None:
        """The next frame is searched as a whole."""
        self._last: Array | None = None
        self._step_before: Array | None = None

    def measure(self, images: StereoImages) -> Measurement:
        """Measure one frame; never raises for what is in the images."""
        try:
            expected = self._estimator.locate(images) if self._last is None else self._predicted()
            measurement, measured = self._estimator.measure(images, expected)
        except LostError as error:
            self.forget()
            return lost_measurement(str(error))
        self._step_before = None if self._last is None else invert(self._last) @ measured
        self._last = measured
        return measurement

    def _predicted(self) -> Array:
        """camera_from_platform (4,4) if the last movement goes on."""
        assert self._last is not None
        return self._last if self._step_before is None else self._last @ self._step_before
