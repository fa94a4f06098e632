"""Errors that all poses of a run have in common, from cameras, taught frames and exposure.

A measured pose errs by noise, which is new in every frame. It also errs because the estimator
assumes inexact values to be exact: the rig (24 numbers), the taught frames of base and platform
(12), and the instant at which the right camera exposes. The error of each value is constant during
a run.

To first order, these errors d move a measured pose by J(pose) d. J needs no images: centres are
projected through a rig with errors, and measured with the known rig. Teaching with this rig also
gives wrong frames and sticker places, which cancel much of the error. Only the difference between
the errors at the pose and at teaching remains.
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
    pose_jacobian,
    pose_to_transform,
    rotation_log,
    skew,
    transforms_of,
)
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, PLACE_NAMES, StereoRig, triangulate
from cmmsim.measuring.observation import faces_camera
from cmmsim.measuring.pose_estimator import frames_by_planes
from cmmsim.measuring.taught import Taught
from cmmsim.teaching import platform_places, teaching_path

NAMES = (
    *PARAMETER_NAMES,
    *(f"taught.{body}.{name}" for body in ("base", "platform") for name in PLACE_NAMES),
    "exposure.right_later_s",
)
"""Names of all common errors. Those of the rig are true minus known, those of taught frames known
against true, in the axes of base and platform."""

# Poses of the teaching path: it is smooth, so that without noise few of its poses suffice.
TEACHING_POSES = 8

# Changes of the rig's parameters for central differences: ten times what a good calibration leaves.
STEPS = np.diag(
    [*2 * (0.1, 0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-5, 1e-5, 1e-4), *3 * (1e-5,), *3 * (1e-5,)]
)


@dataclass(frozen=True)
class CommonErrors:
    """Common errors by name. Each name ends with the unit.

    ``changes`` (N, 6, k) of the poses are per unit of each error, m and rad, and ``covariance`` (k,
    k) belongs to the errors.
    """

    names: tuple[str, ...]
    changes: Array
    covariance: Array

    @property
    def pose_covariances(self) -> Array:
        """Covariances (N, 6, 6) of each pose due to the errors, which are the same in all poses."""
        return np.asarray(self.changes @ self.covariance @ self.changes.swapaxes(1, 2))


@dataclass(frozen=True)
class MeasuringGeometry:
    """Set-up as an estimator knows it: the rig, both bodies, the result of teaching, and the pose
    (6,) at teaching.
    """

    rig: StereoRig
    platform: MarkedBody
    base: MarkedBody
    taught: Taught
    home: Array

    @property
    def camera_from_base(self) -> Array:
        """Place (4, 4) of the base as it was taught."""
        return invert(self.taught.base_from_camera)

    def pose_covariance(
        self, pose: Array, rig_covariance: Array, method: str = "registration"
    ) -> Array:
        """Return the covariance (6, 6) that a pose (6,) measured by registration has in common with
        others.

        It comes from taught frames and a rig with a covariance (24, 24). It is NaN for another
        method, where it is not known.
        """
        if method != "registration":
            return np.full((6, 6), np.nan)
        return self.common_errors(pose[None], np.zeros((1, 6)), rig_covariance).pose_covariances[0]

    def common_errors(
        self, poses: Array, rates: Array, rig_covariance: Array, exposure_std: float = 0.0
    ) -> CommonErrors:
        """Return the common errors of poses (N, 6) measured by registration.

        They move at rates (N, 6), m/s and rad/s. ``rig_covariance`` (24, 24) belongs to the rig's
        parameters, and ``exposure_std`` to the time by which the right camera exposes later, s.
        Exact parameters are left out. Raises ShapeError for anything but rows of six finite
        numbers.
        """
        poses = finite_array(poses, (len(poses), 6), "poses must be (N,6) and finite")
        rates = finite_array(
            rates, (len(poses), 6), "rates must be one row for each pose, (N,6) and finite"
        )
        covariance = block_diag(
            rig_covariance,
            self.taught.base_covariance,
            self.taught.platform_covariance,
            exposure_std**2,
        )
        kept = np.flatnonzero(np.diag(covariance) > 0.0)
        view = _view(self, transforms_of(poses))
        small = np.concatenate(
            [self._by_rig(view), view.by_taught_frames(), view.by_delay(poses, rates)], axis=2
        )
        changes = np.stack([pose_jacobian(pose) for pose in poses]) @ small[:, :, kept]
        return CommonErrors(tuple(NAMES[k] for k in kept), changes, covariance[np.ix_(kept, kept)])

    def _by_rig(self, view: _View) -> Array:
        """Return small errors (N, 6, 24) of base_from_platform by each parameter of the rig.

        The errors of teaching are included.
        """
        frames, places = self.taught_by_rig
        return (
            view.registered(view.points_by_rig() - view.points_by_places(places))
            + view.levers @ frames
        )

    @cached_property
    def taught_by_rig(self) -> tuple[Array, Array]:
        """Errors of teaching by each parameter of the rig.

        They are the small error (6, 24) of the taught base_from_camera, and changes (24, n, 3) of
        the places of the platform's stickers.
        """
        moved = [self.rig.moved(sign * step) for sign in (1.0, -1.0) for step in STEPS]
        frames, places = (
            values.reshape(2, len(STEPS), *values.shape[1:]) for values in self._teach(moved)
        )
        twice = 2.0 * np.diag(STEPS)
        errors = (
            np.stack([_small_error(more, less) for more, less in zip(*frames, strict=True)], axis=1)
            / twice
        )
        return errors, (places[0] - places[1]) / twice[:, None, None]

    def _teach(self, true: Sequence[StereoRig]) -> tuple[Array, Array]:
        """Return base_from_camera (r, 4, 4) and sticker places (r, n, 3) as the known rig teaches
        them.

        The cameras are those of r other rigs, each by itself, and there is no noise.
        """
        path = transforms_of(teaching_path(self.home, TEACHING_POSES))
        places = self.taught.platform_places
        base = apply(self.camera_from_base, self.taught.base_places)
        views = apply_each(self.camera_from_base @ path, places)
        points, covariances = self._observed(true, np.concatenate([base, views.reshape(-1, 3)]))
        split = len(base)
        of_views = (len(true), *views.shape)
        towards = self.base.normals @ self.camera_from_base[:3, :3].T
        camera_from_base = frames_by_planes(
            self.base, points[:, :split], covariances[:, :split], towards
        )
        return invert(camera_from_base), platform_places(
            self.platform,
            points[:, split:].reshape(of_views),
            covariances[:, split:].reshape(*of_views, 3),
        )

    def _observed(self, true: Sequence[StereoRig], points: Array) -> tuple[Array, Array]:
        """Return points (r, n, 3), and covariances (r, n, 3, 3) per px² of noise, by the known rig.

        Points (n, 3) in the camera frame are seen by the cameras of other rigs.
        """
        pixels = np.stack([rig.project(points)[0] for rig in true], axis=1).reshape(2, -1, 2)
        spread = np.broadcast_to(np.eye(2), (*pixels.shape[:2], 2, 2))
        near = np.tile(points, (len(true), 1))
        found = triangulate(self.rig, pixels[0], pixels[1], spread[0], spread[1], near)
        shape = (len(true), *points.shape)
        return found.points.reshape(shape), found.covariances.reshape(*shape, 3)


@dataclass(frozen=True)
class _View:
    """Stickers seen at the poses of a run, by index (n,).

    ``frames`` (N, 4, 4) are base_from_platform. ``arms`` (N, n, 3) lead from the platform's origin
    to the stickers, in camera axes. The changes of their pixels are ``slopes`` (2, N, n, 2, 3) by
    their points, and ``by_rig`` (2, N, n, 2, 24) by the rig's parameters.
    """

    camera_from_base: Array
    frames: Array
    seen: NDArray[np.int_]
    arms: Array
    slopes: Array
    by_rig: Array

    @property
    def levers(self) -> Array:
        """Small errors (N, 6, 6) of base_from_platform by that of base_from_camera, both in base
        axes.
        """
        levers = np.tile(np.eye(6), (len(self.frames), 1, 1))
        levers[:, :3, 3:] = -skew(self.frames[:, :3, 3])
        return levers

    def by_taught_frames(self) -> Array:
        """Return small errors (N, 6, 12) of base_from_platform by those of both taught frames."""
        turns = np.zeros((len(self.frames), 6, 6))
        turns[:, :3, :3] = turns[:, 3:, 3:] = self.frames[:, :3, :3]
        return np.concatenate([self.levers, turns], axis=2)

    def by_delay(self, poses: Array, rates: Array) -> Array:
        """Return small errors (N, 6, 1) of base_from_platform, per s by which the right camera is
        late.
        """
        spin = np.einsum(
            "nij,nj->ni", np.stack([euler_rates_matrix(pose) for pose in poses]), rates[:, 3:]
        )
        turn = self.camera_from_base[:3, :3]
        velocities = (rates[:, :3] @ turn.T)[:, None] + np.cross(
            (spin @ turn.T)[:, None], self.arms
        )
        pixels = np.zeros((*self.slopes.shape[:-1], 1))
        pixels[1, ..., 0] = np.einsum("nmij,nmj->nmi", self.slopes[1], velocities)
        return self.registered(self._points(pixels))

    def points_by_rig(self) -> Array:
        """Return changes (N, n, 3, 24) of the triangulated points by each parameter of the true
        rig.
        """
        return self._points(self.by_rig)

    def points_by_places(self, places: Array) -> Array:
        """Return changes (N, n, 3, 24) of expected stickers by changes (24, n, 3) of their taught
        places.
        """
        turns = self.camera_from_base[:3, :3] @ self.frames[:, :3, :3]
        return np.einsum("nij,pmj->nmip", turns, places[:, self.seen])

    def registered(self, changes: Array) -> Array:
        """Return small errors (N, 6, p) of base_from_platform, in base axes, by changes of
        stickers.

        The changes (N, n, 3, p) of their points are in camera axes.
        """
        rows = np.concatenate(
            [np.broadcast_to(np.eye(3), (*self.arms.shape[:2], 3, 3)), -skew(self.arms)], axis=3
        )
        weighted = np.einsum("nmij,nmik->nmjk", rows, self._information)
        normal = np.einsum("nmij,nmjk->nik", weighted, rows)
        found = np.linalg.solve(normal, np.einsum("nmij,nmjp->nip", weighted, changes))
        turn = self.camera_from_base[:3, :3].T
        return np.concatenate([turn @ found[:, :3], turn @ found[:, 3:]], axis=1)

    @property
    def _information(self) -> Array:
        """Information of each point (N, n, 3, 3) per squared pixel of both images."""
        return np.einsum("cnmki,cnmkj->nmij", self.slopes, self.slopes)

    def _points(self, pixels: Array) -> Array:
        """Return changes (N, n, 3, p) of triangulated points by changes (2, N, n, 2, p) of their
        pixels.
        """
        return np.linalg.solve(
            self._information, np.einsum("cnmki,cnmkp->nmip", self.slopes, pixels)
        )


def _view(geometry: MeasuringGeometry, frames: Array) -> _View:
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


def _small_error(moved: Array, other: Array) -> Array:
    """Return [dt, dphi] (6,) by which points p of the output frame move: dt + dphi x p.

    They move from the second transform to the first.
    """
    turn = moved[:3, :3] @ other[:3, :3].T
    return np.concatenate([moved[:3, 3] - turn @ other[:3, 3], rotation_log(turn)])
