"""Detection of a drift from measurements, frame after frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import ThreadpoolController

from cmmsim.errors import CmmError, LostError
from cmmsim.geometry.pose import Array
from cmmsim.measuring.frame_solver import solve_frame
from cmmsim.measuring.measurement import Measurement
from cmmsim.measuring.observation import Observer
from cmmsim.measuring.sticker_windows import StickerObservation
from cmmsim.radiometry.stereo_images import StereoImages
from cmmsim.uncertainty.common_errors import MeasuringGeometry
from cmmsim.uncertainty.drift_blocks import RIG, FrameBlock, base_rows, platform_rows, stacked
from cmmsim.uncertainty.drift_evidence import SIZES, Evidence, Finding, movements, unseen_directions
from cmmsim.uncertainty.known_rig import KnownRig

# Probability of a false alarm in a run.
CHANCE = 0.01
# Largest number of frames in a block. The residuals of a block are averaged.
BLOCK_FRAMES = 6
# Number of blocks that are evaluated together. Longer runs therefore need no more memory.
BLOCKS_TOGETHER = 64
# A frame with fewer stickers is not used.
FEWEST_STICKERS = 4
# Standard deviation of a centre's error from teaching and image formation. The error is constant
# while the sticker stands still.
TAUGHT_OFFSET_PX = 3e-4


class DriftWatch:
    """Detection of movements of the rig since its calibration and teaching.

    Parameters
    ----------
    geometry : MeasuringGeometry
        Geometry as the estimator knows it.
    known : KnownRig, optional
        Uncertainty of the geometry's rig. By default, the rig is exact.
    frame_period : float
        Time from frame to frame, s.
    chance : float
        Probability of a false alarm in a run, however long.
    offset_px : float
        Standard deviation of a centre's systematic error, px.
    base : bool
        True if the base's stickers are observed as well.

    Raises
    ------
    CmmError
        If ``chance`` is not between 0 and 1.

    Examples
    --------
    >>> sensor.start_run(1)
    >>> watch = sensor.watch_drift()
    >>> measured = sensor.measure(sensor.home)
    >>> watch.finding.frames, watch.finding.warning
    (1, None)
    """

    def __init__(
        self,
        geometry: MeasuringGeometry,
        known: KnownRig | None = None,
        frame_period: float = 1.0 / 60.0,
        chance: float = CHANCE,
        offset_px: float = 0.0,
        base: bool = False,
    ) -> None:
        if not 0.0 < chance < 1.0:
            raise CmmError(
                f"the probability of a false alarm must lie between 0 and 1, got {chance!r}"
            )
        self.geometry = geometry
        self.chance = chance
        self.watches_base = base
        self._period = frame_period
        self._known = known
        self._offset_std = float(np.hypot(offset_px, TAUGHT_OFFSET_PX))
        self._threads = ThreadpoolController()
        self.restart()

    def restart(self) -> None:
        """Begin a new run, without findings from earlier runs."""
        taught = self.geometry.taught
        known = self._known
        centres = len(taught.platform_places) + (
            len(taught.base_places) if self.watches_base else 0
        )
        covariance = (
            np.zeros((RIG, RIG))
            if known is None
            else known.covariance / np.outer(SIZES[:RIG], SIZES[:RIG])
        )
        values, vectors = np.linalg.eigh(covariance)
        # Directions without variance belong to parameters that are known exactly.
        kept = values > 1e-12 * max(float(values[-1]), 1e-300)
        delay_std = 0.0 if known is None else known.exposure_std
        offsets = np.full(4 * centres, self._offset_std)
        calibration = vectors[:, kept] * np.sqrt(values[kept])
        self._evidence = Evidence(calibration, delay_std, offsets, self.watches_base)
        self._frames = self._counted = self._judged = 0
        self._platform: FrameBlock | None = None
        self._base: FrameBlock | None = None
        self._blocks: list[_Block] = []
        self._largest = 0.0
        self._noticed: int | None = None

    def look(self, measurement: Measurement, images: StereoImages, observer: Observer) -> None:
        """Add the next frame. If the base is watched, it is observed in the frame's images."""
        self.add(
            measurement, self._base_in(images, observer) if len(measurement.target_ids) else None
        )

    def _base_in(self, images: StereoImages, observer: Observer) -> StickerObservation | None:
        """Return the stickers of the base in a frame.

        The result is None if the base is not watched, or if too few stickers agree.
        """
        if not self.watches_base:
            return None
        body = self.geometry.base
        places = self.geometry.taught.base_places
        camera_from_base = self.geometry.camera_from_base
        seen = observer.observe(images, camera_from_base, places, body.sticker_normals)
        try:
            return solve_frame(seen, camera_from_base, observer, body, places).used_in(0)
        except LostError:
            return None

    def add(self, measurement: Measurement, base: StickerObservation | None = None) -> None:
        """Add the next frame, with the stickers of the ``base`` that it shows.

        A frame with fewer than FEWEST_STICKERS stickers of the platform only advances the time, and
        so does a lost frame.
        """
        time = self._frames * self._period
        self._frames += 1
        if not measurement.ok or len(measurement.target_ids) < FEWEST_STICKERS:
            return
        self._judged += 1
        if not self._continues_block(measurement, base):
            self._end_block(self._frames - 1)
            self._begin_block(measurement, base)
        assert self._platform is not None
        pixels = measurement.left_pixels, measurement.right_pixels
        self._platform.add(time, measurement.pose, pixels, measurement.pixel_variances)
        if self._base is not None and base is not None:
            pixels = base.left_pixels, base.right_pixels
            self._base.add(time, np.zeros(6), pixels, base.pixel_variances)
        if len(self._platform.times) == BLOCK_FRAMES:
            self._end_block(self._frames)

    @property
    def finding(self) -> Finding:
        """Finding from all frames since ``restart``.

        Reading it ends the block that is being filled.
        """
        self._end_block(self._frames)
        self._evaluate_blocks()
        drift_information = self._evidence.drift_information
        moved, explained = movements(drift_information) if self._noticed is not None else ((), 0.0)
        return Finding(
            None if self._noticed is None else self._noticed * self._period,
            self._noticed,
            self._largest,
            float(-np.log(self.chance)),
            self.chance,
            self._frames,
            self._judged,
            moved,
            explained,
            self._noticed is not None and drift_information.from_start,
            unseen_directions(self._evidence.sensitivity),
        )

    def _continues_block(self, measurement: Measurement, base: StickerObservation | None) -> bool:
        """Return True if a frame shows the same stickers as the block that is being filled."""
        if self._platform is None or not np.array_equal(self._platform_ids, measurement.target_ids):
            return False
        seen = None if base is None or not self.watches_base else base.index
        if self._base is None or seen is None:
            return self._base is None and seen is None
        return np.array_equal(self._base.index, seen)

    def _begin_block(self, measurement: Measurement, base: StickerObservation | None) -> None:
        """Begin a block of frames that show the same stickers as a frame."""
        taught = self.geometry.taught
        self._platform_ids = measurement.target_ids
        index = np.flatnonzero(np.isin(self.geometry.platform.sticker_ids, measurement.target_ids))
        camera_from_base = self.geometry.camera_from_base
        self._platform = FrameBlock(index, taught.platform_places[index], camera_from_base)
        self._base = None
        if base is not None and self.watches_base:
            self._base = FrameBlock(base.index, taught.base_places[base.index], camera_from_base)

    def _end_block(self, end: int) -> None:
        """End the block that is being filled, after ``end`` frames of the run."""
        if self._platform is None:
            return
        self._blocks.append(_Block(self._platform, self._base, end))
        self._platform = self._base = None
        if len(self._blocks) == BLOCKS_TOGETHER:
            self._evaluate_blocks()

    def _evaluate_blocks(self) -> None:
        """Update the evidence with all ended blocks, and note the first one above the limit."""
        # with more than one thread, BLAS takes ten times as long for these small matrices
        with self._threads.limit(limits=1, user_api="blas"):
            for block, products in zip(self._blocks, self._products(), strict=True):
                self._evidence.step(products, block.end - self._counted)
                ratio = self._evidence.log_ratio
                self._counted = block.end
                self._largest = max(self._largest, ratio)
                if self._noticed is None and ratio > -np.log(self.chance):
                    self._noticed = block.end - 1
        self._blocks.clear()

    def _products(self) -> list[Array]:
        """Return the products of each block for ``Evidence.step``.

        The products of blocks with the same stickers are computed together.
        """
        alike: dict[tuple[bytes, bytes | None], list[int]] = {}
        for number, block in enumerate(self._blocks):
            alike.setdefault(block.stickers, []).append(number)
        products_of: dict[int, Array] = {}
        taught = self.geometry.taught
        centres = len(taught.platform_places), len(taught.base_places)
        for numbers in alike.values():
            rows = [
                platform_rows(self.geometry, [self._blocks[number].platform for number in numbers])
            ]
            bases = [base for number in numbers if (base := self._blocks[number].base) is not None]
            if bases:
                rows.append(base_rows(self.geometry, bases))
            products = self._evidence.products(stacked(rows, centres[: 1 + self.watches_base]))
            products_of |= dict(zip(numbers, products, strict=True))
        return [products_of[number] for number in range(len(self._blocks))]


@dataclass(frozen=True)
class _Block:
    """Frames with the same stickers of the platform, and of the base if it is watched.

    ``end`` is the number of frames of the run up to the end of the block.
    """

    platform: FrameBlock
    base: FrameBlock | None
    end: int

    @property
    def stickers(self) -> tuple[bytes, bytes | None]:
        """Key that is equal for blocks with the same stickers."""
        return (
            self.platform.index.tobytes(),
            None if self.base is None else self.base.index.tobytes(),
        )
