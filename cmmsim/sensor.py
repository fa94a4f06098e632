"""The synthetic sensor: it takes images of a posed platform and measures its pose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from cmmsim.checks import checked_seed, finite_array
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array, checked_pose
from cmmsim.imaging.stereo_camera import VirtualStereoCamera
from cmmsim.instrument import Instrument
from cmmsim.many_frames import Frames, measure_frames, measure_without_images, pose_rows
from cmmsim.measuring.measurement import MeasuredPoses, Measurement, lost_measurement
from cmmsim.measuring.taught import Taught
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages
from cmmsim.teaching import Progress
from cmmsim.tracker import Tracker
from cmmsim.uncertainty.drift_watch import CHANCE, DriftWatch
from cmmsim.uncertainty.known_rig import KnownRig
from cmmsim.without_images.drawn_stickers import STATISTICAL, DrawnStickers, StatisticalStereoCamera

if TYPE_CHECKING:
    from cmmsim.without_images.statistical_tracker import StatisticalTracker

RUN_STREAM = 1  # separates the random numbers of exposures from those of dropouts
DROPOUT_STREAM = 2


class Sensor(Instrument):
    """Stereo optical CMM that measures the pose of a platform.

    Teaching takes place on first use. `load_sensor` makes a sensor by name.

    Parameters
    ----------
    file : SensorFile
        Content of a sensor file. Its cameras form the images.
    seed, method, taught, progress, renderer
        See `load_sensor`.
    known : KnownRig, optional
        Rig that the estimator uses, if it differs from the file's rig. The file's rig forms the
        images. If ``taught`` is given, the estimator uses the rig that was known at teaching.

    Raises
    ------
    CmmError
        If an argument is of another type.
    UnknownOptionError
        If there is no such method, renderer or detector.
    TeachingError
        If ``taught`` belongs to another sensor.

    Examples
    --------
    >>> from cmmsim import load_sensor
    >>> load_sensor("ctrack780", renderer="statistical")
    Sensor('ctrack780', method 'registration', renderer 'statistical', not yet taught)
    """

    def __init__(
        self,
        file: SensorFile,
        seed: int = 0,
        method: str = "registration",
        taught: Taught | None = None,
        progress: Progress | None = None,
        renderer: str | None = None,
        known: KnownRig | None = None,
    ) -> None:
        super().__init__(file, seed, method, taught, progress, renderer, known)
        self._tracker: Tracker | StatisticalTracker | None = None
        self._watch: DriftWatch | None = None
        self.start_run(seed)

    def start_run(self, seed: int) -> None:
        """Begin a new run, with new noise. The next measurement searches the whole images.

        Every frame has its own noise stream, so a dropped frame does not change the noise of other
        frames.

        Parameters
        ----------
        seed : int
            Seed of the run's noise.

        Raises
        ------
        CmmError
            If the seed is not a whole number, 0 or more.

        Examples
        --------
        >>> sensor.start_run(3)
        >>> first = sensor.measure(sensor.home).pose
        >>> sensor.start_run(3)
        >>> bool(np.all(sensor.measure(sensor.home).pose == first))
        True
        """
        self._run_seed = checked_seed(seed)
        self._frame = 0
        self._dropout_rng = np.random.default_rng([seed, DROPOUT_STREAM])
        if self._tracker is not None:
            self._tracker.forget()
        if self._watch is not None:
            self._watch.restart()

    def look(
        self,
        pose: ArrayLike,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: ArrayLike | None = None,
    ) -> StereoImages | DrawnStickers:
        """Take one exposure. The images are drawn only where they are read.

        Parameters
        ----------
        pose : array_like, shape (6,)
            Pose of the platform in the middle of the exposure, m and rad.
        obstacles : mapping of str to ndarray, shape (4, 4), optional
            Transforms base_from_body of bodies that `add_bodies` registered, by name. The bodies
            stand still.
        pose_rate : array_like, shape (6,), optional
            Time derivative of the pose, m/s and rad/s. It blurs the images if the exposure time of
            the sensor is above zero.

        Returns
        -------
        StereoImages or DrawnStickers
            Images, or with the renderer "statistical" the stickers that would be detected.

        Raises
        ------
        ShapeError
            If the pose or its rate is not six finite numbers.
        UnknownBodyError
            If an obstacle was never registered.
        CmmError
            If the blur is too long, if ``obstacles`` is not a mapping of names to transforms, or if
            the renderer is not valid for this sensor file.

        Examples
        --------
        >>> images = sensor.look(sensor.home)
        """
        checked = checked_pose(pose)
        placed = self.true_cameras.placed(obstacles)
        if pose_rate is not None:
            wanted = "a pose rate is six finite numbers, m/s and rad/s"
            pose_rate = finite_array(pose_rate, (6,), wanted)
        rng = np.random.default_rng([self._run_seed, RUN_STREAM, self._frame])
        camera = self.true_cameras.at(self._frame)
        self._frame += 1
        return camera.look(checked, rng, placed, pose_rate=pose_rate)

    def capture(
        self,
        pose: ArrayLike,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: ArrayLike | None = None,
    ) -> StereoFrame:
        """Take both whole images.

        Parameters
        ----------
        pose, obstacles, pose_rate
            As in `look`, which also lists the exceptions.

        Returns
        -------
        StereoFrame

        Raises
        ------
        CmmError
            If the renderer is "statistical", which draws no images.

        Examples
        --------
        >>> from cmmsim import load_sensor
        >>> drawing = load_sensor("ctrack780", renderer="analytic")
        >>> drawing.capture(drawing.home).left.shape
        (1536, 2048)
        """
        return self.look(pose, obstacles, pose_rate).full()

    def measure(
        self,
        pose: ArrayLike,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: ArrayLike | None = None,
    ) -> Measurement:
        """Measure the platform in one frame.

        The result is the pose in the middle of the exposure. If the frame drops out, the result is
        a lost measurement.

        Parameters
        ----------
        pose, obstacles, pose_rate
            As in `look`, which also lists the exceptions. The estimator does not use these
            arguments.

        Returns
        -------
        Measurement

        Raises
        ------
        TeachingError
            If the sensor is not yet taught, and its teaching fails.

        Examples
        --------
        >>> measured = sensor.measure(sensor.home)
        >>> measured.ok, measured.covariance.shape
        (True, (6, 6))
        """
        images = self.look(pose, obstacles, pose_rate)
        if self._tracker is None:
            self._tracker = self._new_tracker()
        # Each frame takes one random number, so runs over different poses lose the same frames.
        if self._dropout_rng.random() < self.timing.dropout:
            self._tracker.miss()
            measured = lost_measurement(
                f"dropped frame (with a probability of {self.timing.dropout:.3g})"
            )
        else:
            measured = self._tracker.measure(images)
        if self._watch is not None:
            self._watch.look(measured, images, self.observer)
        return measured

    def watch_drift(self, base: bool = False, chance: float = CHANCE) -> DriftWatch:
        """Begin to test, in each run separately, whether the rig has moved since teaching.

        Parameters
        ----------
        base : bool
            True to observe the stickers of the base as well. This doubles the computing time.
            Smaller movements, and movements of the whole rig, are then detected.
        chance : float
            Probability of a false alarm in a run.

        Returns
        -------
        DriftWatch

        Raises
        ------
        CmmError
            If the method is "planes", or ``chance`` is not a probability.

        Examples
        --------
        >>> watch = sensor.watch_drift()
        """
        self._require_registration("drift can be detected in")
        # The systematic errors of a sticker's centre are constant while the sticker stands still.
        offset = float(np.hypot(self.settings.centre_error_px, self.observer.detector.bias_px))
        period = 1.0 / self.timing.frame_rate
        self._watch = DriftWatch(self._geometry, self._known, period, chance, offset, base)
        return self._watch

    def measure_many(
        self,
        poses: ArrayLike,
        pose_rates: ArrayLike | None = None,
        obstacles: Mapping[str, Array] | None = None,
        near: ArrayLike | None = None,
    ) -> MeasuredPoses:
        """Measure the platform in many frames at once, on all cores.

        Each frame has its own noise and dropout. The noise has the same covariance as in `measure`,
        but its random numbers can differ. The rig does not drift.

        Parameters
        ----------
        poses : array_like, shape (N, 6)
            Poses, one per frame, m and rad.
        pose_rates : array_like, shape (N, 6), optional
            Time derivatives of the poses.
        obstacles : mapping of str to ndarray, shape (4, 4), optional
            Transforms of bodies that stand still, as in `look`.
        near : array_like, shape (N, 6), optional
            Poses near which stickers are searched, instead of the true poses. With the renderer
            "statistical", there is usually no search, and they have no effect.

        Returns
        -------
        MeasuredPoses

        Raises
        ------
        ShapeError
            If a row of poses, rates or ``near`` is not six finite numbers.
        UnknownBodyError
            If an obstacle was never registered.

        Examples
        --------
        >>> sensor.measure_many([sensor.home] * 3).poses.shape
        (3, 6)
        """
        pose_values = pose_rows(poses)
        wanted = "each pose needs a pose rate of six finite numbers, m/s and rad/s"
        rates = finite_array(
            0.0 * pose_values if pose_rates is None else pose_rates, pose_values.shape, wanted
        )
        search_poses = finite_array(
            pose_values if near is None else near,
            pose_values.shape,
            "near needs six finite numbers per pose",
        )
        camera = self.camera
        placed = self.true_cameras.placed(obstacles)
        if isinstance(camera, VirtualStereoCamera):
            blocks = measure_frames(camera, self._frames(pose_values, rates, search_poses, placed))
            measured = MeasuredPoses.of([block.found for block in blocks])
        elif isinstance(tracker := self._new_tracker(), Tracker):
            measured = MeasuredPoses.of_each(
                measure_without_images(
                    camera, self._frames(pose_values, rates, search_poses, placed)
                )
            )
        else:
            rng = np.random.default_rng([self._run_seed, RUN_STREAM, self._frame])
            self._frame += len(pose_values)
            measured = tracker.measure_many(
                camera, camera.exposed(pose_values, rates), camera.placed(placed), rng
            )
        return measured.without(self._dropout_rng.random(len(pose_values)) < self.timing.dropout)

    def measure_each(self, poses: ArrayLike, near: ArrayLike) -> list[Measurement]:
        """Measure a platform at rest in many frames, without dropouts.

        Stickers are searched in windows even with the renderer "statistical".

        Parameters
        ----------
        poses, near : array_like, shape (N, 6)
            True poses, and poses near which stickers are searched, m and rad.

        Returns
        -------
        list of Measurement

        Raises
        ------
        ShapeError
            If a row of ``poses`` or ``near`` is not six finite numbers.

        Examples
        --------
        >>> [measured.ok for measured in sensor.measure_each([sensor.home], [sensor.home])]
        [True]
        """
        pose_values = pose_rows(poses)
        camera = self.camera
        search_poses = finite_array(
            near, pose_values.shape, "near needs six finite numbers per pose"
        )
        frames = self._frames(pose_values, 0.0 * pose_values, search_poses, {})
        if isinstance(camera, StatisticalStereoCamera):
            return measure_without_images(camera, frames)
        return [m for block in measure_frames(camera, frames) for m in block.measurements()]

    def _frames(
        self, poses: Array, rates: Array, near: Array, placed: Mapping[str, Array]
    ) -> Frames:
        """Return the next N frames, at poses (N, 6) with rates (N, 6).

        Stickers are searched near the poses ``near`` (N, 6).
        """
        first = self._frame
        self._frame += len(poses)
        streams = range(first, first + len(poses))
        rngs = [np.random.default_rng([self._run_seed, RUN_STREAM, k]) for k in streams]
        period = 1.0 / self.timing.frame_rate
        return Frames(self.estimator, poses, rates, near, rngs, placed, period)

    def _new_tracker(self) -> Tracker | StatisticalTracker:
        # StatisticalTracker is faster, but it supports registration only. It requires that no
        # sticker was left out at teaching, and that the print is perfect.
        whole = len(self.true_cameras.scene[0].sticker_places) == len(self.platform.nominal)
        perfect = self._file.print.is_perfect
        if (
            self.renderer != STATISTICAL.name
            or self.method != "registration"
            or not whole
            or not perfect
        ):
            return Tracker(self.estimator)
        # Imported late, because importing numba takes time.
        from cmmsim.without_images.statistical_tracker import StatisticalTracker

        return StatisticalTracker(self.estimator)
