"""Errors that all poses of a run have in common, due to cameras, teaching, print and exposure.

The noise of a measured pose is new in every frame. Other errors are constant during a run, because
they come from parameters that the estimator assumes to be exact: the rig (24 numbers), the taught
frames of base and platform (12), thickness and retro-reflection of the stickers (2), and the
time at which the right camera exposes (1).

To first order, these errors d change a measured pose by J(pose) d. J is computed without images,
from the derivatives of pixels. Teaching used the same known rig, so the taught frames and sticker
positions have errors as well. To compute them, sticker centres on the teaching path are projected
through a rig with errors and triangulated with the known rig. The errors at teaching and at a
measured pose mostly cancel, and only their difference remains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from cmmsim.checks import finite_array
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.pose import (
    Array,
    apply,
    apply_each,
    euler_rates_matrix,
    invert,
    point_jacobian,
    pose_jacobian,
    pose_to_transform,
    skew,
    small_movement,
    transforms_of,
)
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, PLACE_NAMES, StereoRig
from cmmsim.geometry.triangulation import triangulate
from cmmsim.measuring.constellation import platform_places
from cmmsim.measuring.observation import faces_camera
from cmmsim.measuring.pose_estimator import frames_by_planes
from cmmsim.measuring.taught import Taught
from cmmsim.teaching import teaching_path
from cmmsim.uncertainty.print_errors import PRINT_NAMES, PrintErrors

# Names of all common errors. Errors of the rig are true minus known parameters. Those of the taught
# base are the small movement from the true to the taught base_from_camera, in base axes. Those of
# the taught platform are the small movement from its true to its taught frame, in platform axes.
NAMES = (
    *PARAMETER_NAMES,
    *(f"taught.{body}.{name}" for body in ("base", "platform") for name in PLACE_NAMES),
    *PRINT_NAMES,
    "exposure.right_later_s",
)

# Number of poses on the teaching path. The path is smooth, so few poses suffice without noise.
TEACHING_POSES = 8

# Steps (24, 24) of the rig's parameters for central differences, one parameter each. With steps ten
# times smaller or larger, the derivatives of the built-in sensor differ by less than 0.04 %.
STEPS = np.diag(
    [*2 * (0.1, 0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-5, 1e-5, 1e-4), *3 * (1e-5,), *3 * (1e-5,)]
)


@dataclass(frozen=True)
class CommonErrors:
    """Common errors of N poses, and the changes of the poses that they cause.

    ``names`` (k,) are the names of the errors; each name ends with the unit. ``changes`` (N, 6, k)
    are the changes of the poses, m and rad, per unit of each error. ``covariance`` (k, k) is the
    covariance of the errors.
    """

    names: tuple[str, ...]
    changes: Array
    covariance: Array

    @property
    def pose_covariances(self) -> Array:
        """Covariances (N, 6, 6) that the common errors cause in each pose."""
        return np.asarray(self.changes @ self.covariance @ self.changes.swapaxes(1, 2))


@dataclass(frozen=True)
class MeasuringGeometry:
    """Geometry as an estimator knows it.

    ``home`` (6,) is the platform's pose at teaching. ``print`` is None if it knows no print errors.
    """

    rig: StereoRig
    platform: MarkedBody
    base: MarkedBody
    taught: Taught
    home: Array
    print: PrintErrors | None = None

    @property
    def camera_from_base(self) -> Array:
        """Taught transform camera_from_base (4, 4)."""
        return invert(self.taught.base_from_camera)

    def pose_covariance(
        self, pose: Array, rig_covariance: Array, method: str = "registration"
    ) -> Array:
        """Return the covariance (6, 6) that common errors cause at a pose (6,).

        The errors are those of taught frames, print and rig; ``rig_covariance`` is (24, 24). For
        other methods than registration, the covariance is not known, and the result is NaN.
        """
        if method != "registration":
            return np.full((6, 6), np.nan)
        return self.common_errors(pose[None], np.zeros((1, 6)), rig_covariance).pose_covariances[0]

    def common_errors(
        self, poses: Array, rates: Array, rig_covariance: Array, exposure_std: float = 0.0
    ) -> CommonErrors:
        """Return the common errors of poses (N, 6) measured by registration.

        ``rates`` (N, 6) are the time derivatives of the poses, m/s and rad/s. ``rig_covariance``
        (24, 24) is the covariance of the rig's parameters. ``exposure_std`` is the standard
        deviation of the delay of the right camera's exposure, s. Parameters with zero variance are
        omitted. Raises ShapeError unless each row of poses and rates is six finite numbers.
        """
        poses = finite_array(poses, (len(poses), 6), "poses must be (N,6) and finite")
        rates = finite_array(
            rates, (len(poses), 6), "rates must be one row for each pose, (N,6) and finite"
        )
        covariance = block_diag(
            rig_covariance,
            self.taught.base_covariance,
            self.taught.platform_covariance,
            np.zeros((2, 2)) if self.print is None else np.diag(self.print.std**2),
            exposure_std**2,
        )
        kept = np.flatnonzero(np.diag(covariance) > 0.0)
        view = _view(self, transforms_of(poses))
        small = np.concatenate(
            [
                self._by_rig(view),
                view.by_taught_frames(),
                self._by_print(view),
                view.by_delay(poses, rates),
            ],
            axis=2,
        )
        changes = pose_jacobian(poses) @ small[:, :, kept]
        return CommonErrors(tuple(NAMES[k] for k in kept), changes, covariance[np.ix_(kept, kept)])

    def _by_rig(self, view: _View) -> Array:
        """Return the small errors (N, 6, 24) of base_from_platform per unit of the rig's errors.

        The effect of the rig on teaching is included.
        """
        frames, places = self.taught_by_rig
        return view.by_pixels(view.by_rig) - view.by_places(places) + view.levers @ frames

    @cached_property
    def taught_by_rig(self) -> tuple[Array, Array]:
        """Errors of teaching per unit of the errors of the rig's parameters.

        The first result (6, 24) contains small movements of the taught base_from_camera. The second
        result (24, n, 3) contains errors of the taught positions of the platform's stickers.
        """
        if self.taught.by_rig is not None:
            frames = self.taught.by_rig[:6]
            return frames, self.taught.by_rig[6:].T.reshape(len(STEPS), -1, 3)
        moved = [self.rig.moved(sign * step) for sign in (1.0, -1.0) for step in STEPS]
        frames, places = (
            values.reshape(2, len(STEPS), *values.shape[1:]) for values in self._teach(moved)
        )
        twice = 2.0 * np.diag(STEPS)
        errors = (
            np.stack(
                [small_movement(more, less) for more, less in zip(*frames, strict=True)], axis=1
            )
            / twice
        )
        return errors, (places[0] - places[1]) / twice[:, None, None]

    def _by_print(self, view: _View) -> Array:
        """Return the small errors (N, 6, 2) of base_from_platform per m of the print's errors."""
        if self.print is None:
            return np.zeros((len(view.frames), 6, 2))
        frames, places = self._taught_by_print(self.print)
        camera_from_platform = self.camera_from_base @ view.frames
        pixels = self.print.shifts(
            self.rig, camera_from_platform, self.taught.platform_places, self.platform
        )
        small = view.by_pixels(pixels[:, :, view.seen]) - view.by_places(places)
        std = self.print.std
        return (small + view.levers @ frames) / np.where(std > 0.0, std, 1.0)

    def _taught_by_print(self, print_errors: PrintErrors) -> tuple[Array, Array]:
        """Return the errors of teaching per standard deviation of the print's errors.

        The results (6, 2) and (2, n, 3) have the meaning of those of ``taught_by_rig``. They are
        zero if the sensor was not taught by images.
        """
        if not self.taught.place_covariances.any():
            return np.zeros((6, 2)), np.zeros((2, *self.taught.platform_places.shape))
        base, path, points = self._teaching_points
        shifts = np.concatenate(
            [
                print_errors.shifts(
                    self.rig, self.camera_from_base[None], self.taught.base_places, self.base
                ).reshape(2, len(base), 2, 2),
                print_errors.shifts(
                    self.rig, path, self.taught.platform_places, self.platform
                ).reshape(2, -1, 2, 2),
            ],
            axis=1,
        )
        moved = np.moveaxis(np.concatenate([0.5 * shifts, -0.5 * shifts], axis=-1), -1, 1)
        frames, places = self._taught_from(self.rig.project(points)[0][:, None] + moved, points)
        errors = [small_movement(frames[k], frames[2 + k]) for k in range(2)]
        return np.stack(errors, axis=1), places[:2] - places[2:]

    @property
    def _teaching_points(self) -> tuple[Array, Array, Array]:
        """Stickers of the base, camera_from_platform on the path of teaching, and all points.

        The shapes are (b, 3), (v, 4, 4) and (m, 3). The m points are those of the base, then those
        of the platform in each view.
        """
        path = self.camera_from_base @ transforms_of(teaching_path(self.home, TEACHING_POSES))
        base = apply(self.camera_from_base, self.taught.base_places)
        views = apply_each(path, self.taught.platform_places)
        return base, path, np.concatenate([base, views.reshape(-1, 3)])

    def _teach(self, true: Sequence[StereoRig]) -> tuple[Array, Array]:
        """Return base_from_camera (r, 4, 4) and sticker positions (r, n, 3) from r teachings.

        In each teaching, one of the rigs ``true`` forms the images without noise, and the known rig
        measures them.
        """
        points = self._teaching_points[2]
        return self._taught_from(np.stack([rig.project(points)[0] for rig in true], axis=1), points)

    def _taught_from(self, pixels: Array, near: Array) -> tuple[Array, Array]:
        """Return base_from_camera (r, 4, 4) and sticker positions (r, n, 3) from r teachings.

        Each teaching sees the points ``near`` (m, 3) of ``_teaching_points`` at ``pixels``
        (2, r, m, 2).
        """
        points, covariances = self._observed(pixels, near)
        split = len(self.taught.base_places)
        of_views = (len(points), TEACHING_POSES, *self.taught.platform_places.shape)
        rough_normals = self.base.normals @ self.camera_from_base[:3, :3].T
        camera_from_base = frames_by_planes(
            self.base, points[:, :split], covariances[:, :split], rough_normals
        )
        return invert(camera_from_base), platform_places(
            self.platform,
            points[:, split:].reshape(of_views),
            covariances[:, split:].reshape(*of_views, 3),
        )

    def _observed(self, pixels: Array, near: Array) -> tuple[Array, Array]:
        """Return points (r, m, 3), and covariances (r, m, 3, 3) per px² of noise.

        The known rig triangulates ``pixels`` (2, r, m, 2) of points near ``near`` (m, 3).
        """
        flat = pixels.reshape(2, -1, 2)
        unit_covariance = np.broadcast_to(np.eye(2), (*flat.shape[:2], 2, 2))
        around = np.tile(near, (pixels.shape[1], 1))
        triangulated = triangulate(
            self.rig, flat[0], flat[1], unit_covariance[0], unit_covariance[1], around
        )
        shape = (*pixels.shape[1:3], 3)
        return triangulated.points.reshape(shape), triangulated.covariances.reshape(*shape, 3)


@dataclass(frozen=True)
class _View:
    """Stickers at the N poses of a run. They are those that both cameras see at home.

    frames  (N, 4, 4), base_from_platform
    seen    (n,), indices of the stickers
    arms    (N, n, 3), from the platform's origin to the stickers, in camera axes
    slopes  (2, N, n, 2, 3), derivatives d(pixels)/d(points) of the stickers
    by_rig  (2, N, n, 2, 24), derivatives d(pixels)/d(rig's parameters) of the stickers
    """

    camera_from_base: Array
    frames: Array
    seen: NDArray[np.int_]
    arms: Array
    slopes: Array
    by_rig: Array

    @property
    def levers(self) -> Array:
        """Matrices (N, 6, 6) that map small movements of base_from_camera to pose errors.

        The latter are small errors of base_from_platform. Both are in base axes.
        """
        levers = np.tile(np.eye(6), (len(self.frames), 1, 1))
        levers[:, :3, 3:] = -skew(self.frames[:, :3, 3])
        return levers

    def by_taught_frames(self) -> Array:
        """Return the small errors (N, 6, 12) of base_from_platform per error of taught frames."""
        turns = np.zeros((len(self.frames), 6, 6))
        turns[:, :3, :3] = turns[:, 3:, 3:] = self.frames[:, :3, :3]
        return np.concatenate([self.levers, turns], axis=2)

    def by_delay(self, poses: Array, rates: Array) -> Array:
        """Return small errors (N, 6, 1) of base_from_platform per s of the right camera's delay."""
        spin = (euler_rates_matrix(poses) @ rates[:, 3:, None])[..., 0]
        rotation = self.camera_from_base[:3, :3]
        velocities = (rates[:, :3] @ rotation.T)[:, None] + np.cross(
            (spin @ rotation.T)[:, None], self.arms
        )
        pixels = np.zeros((*self.slopes.shape[:-1], 1))
        pixels[1, ..., 0] = np.einsum("nmij,nmj->nmi", self.slopes[1], velocities)
        return self.by_pixels(pixels)

    def by_pixels(self, pixels: Array) -> Array:
        """Return small errors (N, 6, p) of base_from_platform that changes of pixels cause.

        The errors are in base axes. ``pixels`` (2, N, n, 2, p) are the changes of the stickers'
        pixels. The information of a triangulated point cancels: it weights the point, and its
        inverse is a factor of the point's change.
        """
        count, seen = self.arms.shape[:2]
        of_each = pixels.reshape(2, count, 2 * seen, -1)
        return self._registered((self._by_movement.swapaxes(2, 3) @ of_each).sum(axis=0))

    def by_places(self, places: Array) -> Array:
        """Return the small errors (N, 6, p) of base_from_platform that fit changes of stickers.

        ``places`` (p, n, 3) are the changes of the taught positions of all stickers.
        """
        turns = self.camera_from_base[:3, :3] @ self.frames[:, :3, :3]
        count, seen = self.arms.shape[:2]
        by_place = (self.slopes @ turns[:, None]).reshape(2, count, seen, 2, 3)
        by_movement = self._by_movement.reshape(2, count, seen, 2, 6)
        pulls = (by_movement.swapaxes(3, 4) @ by_place).sum(axis=0)
        rows = pulls.transpose(0, 2, 1, 3).reshape(6 * count, 3 * seen)
        columns = places[:, self.seen].reshape(-1, 3 * seen).T
        return self._registered((rows @ columns).reshape(count, 6, -1))

    def _registered(self, pulls: Array) -> Array:
        """Return small errors (N, 6, p), in base axes, for right-hand sides in camera axes."""
        errors = np.linalg.solve(self._normal, pulls)
        base_from_camera = self.camera_from_base[:3, :3].T
        return np.concatenate(
            [base_from_camera @ errors[:, :3], base_from_camera @ errors[:, 3:]], axis=1
        )

    @cached_property
    def _by_movement(self) -> Array:
        """Derivatives (2, N, 2 n, 6) of the pixels with respect to movements of the platform.

        The movements are in camera axes, and turn the platform about its origin.
        """
        return (self.slopes @ point_jacobian(self.arms)).reshape(2, len(self.arms), -1, 6)

    @cached_property
    def _normal(self) -> Array:
        """Normal matrix (N, 6, 6) of a registration for pixel noise of 1 px²."""
        return (self._by_movement.swapaxes(2, 3) @ self._by_movement).sum(axis=0)


def _view(geometry: MeasuringGeometry, frames: Array) -> _View:
    """Return the view of the stickers at poses base_from_platform (N, 4, 4)."""
    camera_from_base = geometry.camera_from_base
    seen = _seen_at_home(geometry)
    arms = np.einsum("nij,mj->nmi", frames[:, :3, :3], geometry.taught.platform_places[seen])
    points = apply(camera_from_base, arms + frames[:, None, :3, 3])
    slopes, by_rig = (
        each.reshape(2, *points.shape[:-1], 2, -1)
        for each in geometry.rig.derivatives(points.reshape(-1, 3))
    )
    return _View(camera_from_base, frames, seen, arms @ camera_from_base[:3, :3].T, slopes, by_rig)


def _seen_at_home(geometry: MeasuringGeometry) -> NDArray[np.int_]:
    """Return the indices (n,) of the platform's stickers that both cameras see at home."""
    camera_from_platform = geometry.camera_from_base @ pose_to_transform(geometry.home)
    seen = []
    for move in geometry.rig.from_camera:
        placed = move @ camera_from_platform
        normals = geometry.platform.sticker_normals @ placed[:3, :3].T
        seen.append(faces_camera(apply(placed, geometry.taught.platform_places), normals))
    return np.flatnonzero(np.all(seen, axis=0))
