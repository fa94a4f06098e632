"""Camera images of a pose, cropped to the robot, and the stickers that `cmmsim` detects in them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import apply, invert, pose_to_transform
from cmmsim.radiometry.noise import cut_windows
from cmmsim.radiometry.stereo_images import StereoFrame
from identify.arrays import Array
from identify.scene.workcell import Workcell

MARGIN_PX = 24.0  # margin around bodies and stickers in the shown part of the images, px


@dataclass(frozen=True)
class Found:
    """The k stickers of one body that were found in both images.

    Attributes
    ----------
    ids
        Names (k,).
    centres
        Detected centres (2, k, 2) in the whole images, in px.
    shapes
        Matrices (2, k, 2, 2) that map the unit disc to the detected ellipses, in px, or None if
        the detector does not return ellipses.
    expected
        Projections (2, k, 2) of the true positions into the images, in px.
    points, covariances
        Triangulated points (k, 3), in m, and their covariances (k, 3, 3), in m², in the base frame.
    """

    ids: tuple[str, ...]
    centres: Array
    shapes: Array | None
    expected: Array
    points: Array
    covariances: Array


@dataclass(frozen=True)
class StereoView:
    """Camera images of one pose (6,) [m, rad], drawn with noise.

    ``images`` (2, h, w) are parts of the whole images, in 8 bits. ``corners`` (2, 2) are the
    coordinates (x, y) of their first pixels in the whole images. ``found`` maps "platform" and
    "base" to the detected stickers of these bodies.
    """

    pose: Array
    images: NDArray[np.uint8]
    corners: NDArray[np.int_]
    found: Mapping[str, Found]


class ImagingSensor:
    """Sensor of a workcell that draws images at given poses, and detects the stickers in them.

    The sensor is not taught, so a sticker is searched near its nominal position.

    seed      Seed of the noise.
    renderer  "analytic", which needs no OpenGL, "pyrender" or "scene".
    region    First pixels (2, 2) and side, in px, of the shown part; None for the whole images.
    """

    def __init__(
        self,
        cell: Workcell,
        seed: int = 0,
        renderer: str = "analytic",
        region: tuple[NDArray[np.int_], int] | None = None,
    ) -> None:
        assert cell.rig is not None
        self._cell = cell
        self._sensor = cell.live_sensor(seed, renderer)
        self._rig, self._camera_from_base = cell.rig
        self._region = region

    def look(self, pose: Array) -> StereoView:
        """Return images and stickers at a pose (6,).

        Raises dynamics.UnreachablePoseError, dynamics.ChartError or cmmsim.CmmError.
        """
        drawn = self._sensor.look(pose, self._cell.obstacles(pose))
        if self._region is not None and self._sensor.renderer == "analytic":
            # The analytic renderer can draw a part of the image alone, which is faster.
            corners, side = self._region
            images: NDArray = drawn.windows(corners[:, None], side)[:, 0]
        else:
            whole = drawn.full()
            corners = np.zeros((2, 2), dtype=int)
            images = np.stack([whole.left, whole.right])
            if self._region is not None:
                corners, side = self._region
                images = _CroppedImages(images, np.zeros_like(corners)).windows(
                    corners[:, None], side
                )[:, 0]
        cut = _CroppedImages(images, corners)
        found = {body.name: self._found(cut, pose, k) for k, body in enumerate(self._cell.bodies)}
        # The sensor can have more grey levels than the eight bits of images on the page.
        white = self._sensor.noise.white_level
        return StereoView(
            pose, np.asarray(images * (255.0 / white), dtype=np.uint8), corners, found
        )

    def _found(self, images: "_CroppedImages", pose: Array, number: int) -> Found:
        """Find the stickers of the platform (0) or the base (1)."""
        body = self._cell.bodies[number]
        nominal = self._cell.marked(body.name)
        transform = self._camera_from_base @ (pose_to_transform(pose) if number == 0 else np.eye(4))
        seen = self._sensor.observer.observe(
            images, transform, nominal.nominal, nominal.sticker_normals
        )
        base_from_camera = invert(self._camera_from_base)
        turn = base_from_camera[:3, :3]
        return Found(
            ids=tuple(body.ids[k] for k in seen.index),
            centres=np.stack([seen.left_pixels, seen.right_pixels]),
            shapes=None if seen.outlines is None else seen.outlines.shapes,
            expected=self._rig.project(apply(transform, body.places[seen.index]))[0],
            points=apply(base_from_camera, seen.points),
            covariances=turn @ seen.covariances @ turn.T,
        )


def stereo_view(
    cell: Workcell, pose: Array | None = None, seed: int = 0, renderer: str = "analytic"
) -> StereoView:
    """Draw the camera images of a workcell, cropped to the robot, and find the stickers in them.

    The default pose (6,) is home. ``seed`` is the seed of the noise. The renderers "pyrender" and
    "scene" need OpenGL. Raises the exceptions of `ImagingSensor.look`.
    """
    drawn_pose = cell.home if pose is None else np.asarray(pose, dtype=float)
    return ImagingSensor(cell, seed, renderer, region_of(cell, [drawn_pose])).look(drawn_pose)


def region_of(cell: Workcell, poses: Sequence[Array]) -> tuple[NDArray[np.int_], int]:
    """Return a square part of both images that shows both bodies at all poses (6,).

    The returned values are the first pixels (2, 2) of the parts and their side, in px.
    """
    assert cell.rig is not None
    rig, camera_from_base = cell.rig
    platform, base = (body.vertices for body in cell.bodies)
    # Both bodies are convex, so their vertices bound their images.
    points = np.vstack([base, *(apply(pose_to_transform(pose), platform) for pose in poses)])
    pixels = rig.project(apply(camera_from_base, points))[0]
    size = np.array([[camera.width, camera.height] for camera in rig.cameras])
    low = np.clip(pixels.min(axis=1) - MARGIN_PX, 0, size - 1)
    high = np.clip(pixels.max(axis=1) + MARGIN_PX, 0, size - 1)
    # Both images have the same size, so that they can be shown side by side.
    side = int(min(np.ceil((high - low).max()), size.min()))
    corners = np.clip(np.rint(0.5 * (low + high - side)), 0, size - side).astype(int)
    return corners, side


class _CroppedImages:
    """Parts of two images that can be read with coordinates of the whole images."""

    def __init__(self, images: NDArray, corners: NDArray[np.int_]) -> None:
        self._images = images
        self._corners = corners

    def full(self) -> StereoFrame:
        """Return both parts."""
        return StereoFrame(*self._images)

    def windows(self, corners: NDArray[np.int_], size: int) -> NDArray:
        """Return the grey values (2, n, size, size) of windows.

        ``corners`` (2, n, 2) are the first pixels of the windows in the whole images.
        """
        sides = zip(self._images, corners, self._corners, strict=True)
        return np.stack([cut_windows(image, pixel - first, size) for image, pixel, first in sides])
