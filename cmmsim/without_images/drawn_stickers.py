"""Exposures of two cameras without images: random results with the distribution of ellipse fits.

The result for a sticker that is wholly visible in an image is its true ellipse plus noise in centre
and shape. The covariance of the noise is the one that the fit states: the inverse of its normal
matrix at the true ellipse. Effects of noise beyond the first order are neglected. A partly hidden
sticker is not found.

Exposures without images are verified against exposures with images under certain conditions. Other
conditions are refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import RENDERERS
from cmmsim.detection.detector import DetectedCentres
from cmmsim.detection.ellipse_fit import SMALLEST_RADIUS_PX, EllipseFits, fit_settings
from cmmsim.errors import CmmError
from cmmsim.geometry.camera import Optics, PinholeCamera
from cmmsim.geometry.disc_image import curvature_shift, distort_outlines, project_discs
from cmmsim.geometry.pose import IDENTITY, Array, frozen, rigid, transforms_of
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.geometry.sticker_print import PrintSizes, SeenStickers
from cmmsim.imaging.renderer import Renderer
from cmmsim.imaging.scene_bodies import PlacedBodies
from cmmsim.imaging.stereo_camera import Quality
from cmmsim.measuring.observation import Observer
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.without_images.sticker_scene import CentreErrors, StickerScene
from cmmsim.without_images.verified import NAME, require_short

if TYPE_CHECKING:
    from cmmsim.detection.ellipse_fit_kernels import FitSettings
    from cmmsim.without_images.drawn_fit_kernels import Ellipses, Fits, Windows

THIN_PX = 0.885
"""Smaller half axis of an ellipse at which half of the fits end at the smallest allowed ellipse.

It was determined from images. The errors of such fits are not of first order.
"""
THIN_STD_PX = 0.055
"""Standard deviation of this limit between fits, also determined from images."""
# base_from_body (4, 4) of an absent obstacle, which lies far below the scene.
ABSENT = frozen(rigid(np.eye(3), (0.0, 0.0, -1e3)))


@dataclass(frozen=True)
class Light:
    """Radiances, 0 to 1, of stickers and of their rings, with the lens and the print.

    Of ``print``, only thickness and retro-reflection are used here.
    """

    sticker: float
    ring: float
    optics: Optics
    print: PrintSizes


def refuse_images(*_: object, **__: object) -> NoReturn:
    """Raise CmmError, with the names of the renderers that draw images."""
    drawing = ", ".join(name for name in RENDERERS if name != NAME)
    raise CmmError(
        f"renderer {NAME!r} draws no images but only simulates the results of detection; {drawing} "
        "draw images"
    )


STATISTICAL = Renderer(NAME, refuse_images)


@dataclass(frozen=True)
class StatisticalStereoCamera:
    """Two virtual cameras that simulate the results of the fit in the true scene.

    They correspond to `VirtualStereoCamera`, but draw no images. ``rig`` and ``camera_from_base``
    (4, 4) are the true values. ``exposure`` is the exposure time, s, and ``right_later`` the delay
    of the right camera, s. ``obstacle_names`` are the names of the scene's solids after platform
    and base. ``print_errors`` has the errors of centres due to uneven print and outlines, or is
    None.
    """

    rig: StereoRig
    camera_from_base: Array
    scene: StickerScene
    light: Light
    obstacle_names: Sequence[str] = ()
    exposure: float = 0.0
    right_later: float = 0.0
    print_errors: CentreErrors | None = None

    def look(
        self,
        pose: Array,
        rng: np.random.Generator,
        obstacles: Mapping[str, Array] | None = None,
        quality: Quality | None = None,
        pose_rate: Array | None = None,
    ) -> "DrawnStickers":
        """Take one exposure; the parameters are those of ``VirtualStereoCamera.look``.

        ``quality`` is ignored, because the observer's noise states how many exposures are averaged.
        """
        rates = None if pose_rate is None else pose_rate[None]
        return DrawnStickers(
            self, self.exposed(pose[None], rates)[0], self.placed(obstacles or {}), rng
        )

    def moved(self, changes: Array) -> "StatisticalStereoCamera":
        """Return the cameras after adding ``changes`` (24,) to the parameters of their rig."""
        return replace(self, rig=self.rig.moved(changes))

    def exposed(self, poses: Array, rates: Array | None) -> Array:
        """Return the poses (N, 6, 6) of the platform at six instants of each of N exposures.

        ``poses`` (N, 6) are the poses in the middle of the left camera's exposure, and ``rates``
        (N, 6) their rates, or None at rest. The instants are the middle, the beginning and the end
        of the left camera's exposure, then of the right camera's.
        """
        if rates is None:
            return np.repeat(poses[:, None], 6, axis=1)
        half = 0.5 * self.exposure
        lag = self.right_later
        later = np.array([0.0, -half, half, lag, lag - half, lag + half])
        return np.asarray(poses[:, None] + later[:, None] * rates[:, None])

    def placed(self, obstacles: Mapping[str, Array]) -> Array:
        """Return base_from_body (b, 4, 4) of the base and of all obstacles.

        Obstacles that are not named in ``obstacles`` lie far below the scene.
        """
        if isinstance(obstacles, PlacedBodies) and obstacles.names == tuple(self.obstacle_names):
            return np.concatenate((IDENTITY[None], obstacles.together))
        return np.array([IDENTITY, *(obstacles.get(name, ABSENT) for name in self.obstacle_names)])

    def centre_error_px(self, quality: Quality) -> float:
        """Return the error of a sticker's centre due to rendering: 0, as nothing is rendered."""
        return 0.0

    def greys(self, noise: CameraNoise, side: int, centres: Array) -> tuple[Array, Array]:
        """Return contrasts (k,) and grounds (k,), in grey values, of stickers in one image.

        A ground is the grey value of the ring. The stickers have centres (k, 2), px.
        """
        lit = self.light.optics.illumination(self.rig.cameras[side], centres)
        grounds = np.asarray(noise.mean_grey(self.light.ring * lit))
        return np.asarray(noise.mean_grey(self.light.sticker * lit)) - grounds, grounds

    @cached_property
    def from_base(self) -> list[Array]:
        """Transforms camera_from_base (4, 4) of the left and the right camera."""
        return [move @ self.camera_from_base for move in self.rig.from_camera]

    def side(
        self, camera: PinholeCamera, camera_from_bodies: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return centres (m, 2) and shapes (m, 2, 2) of the ellipses in one image, px.

        The third result is the mask (m,) of stickers that face the camera and are not hidden. They
        can lie outside the image. The ellipse of a sticker that faces away is meaningless.
        """
        places, normals = self.scene.placed(camera_from_bodies)
        facing = (np.einsum("ni,ni->n", places, normals) < 0.0) & (places[:, 2] > self.scene.radius)
        with np.errstate(invalid="ignore", divide="ignore"):
            middles, shapes = project_discs(
                camera.ideal, places, normals, np.full(len(places), self.scene.radius)
            )
        facing &= np.isfinite(shapes).all(axis=(1, 2))
        middles = np.where(facing[:, None], middles, 0.0)
        shapes = np.where(facing[:, None, None], shapes, np.eye(2))
        printed = self.light.print
        if printed.thickness or printed.retro_shift:
            seen = SeenStickers.through(
                camera.focal_lengths, places[facing], normals[facing], self.scene.radius
            )
            middles[facing] += seen.shifts_of_kind(printed).sum(axis=-1)
        if not camera.distortion.is_zero:
            valid = camera.distort(middles)[1]
            shift = curvature_shift(camera, middles, shapes)
            distort_outlines(camera, middles, shapes)
            middles += shift
            facing &= valid
        return (
            middles,
            shapes,
            facing & ~self.scene.hidden(camera_from_bodies, places, normals, facing),
        )


class DrawnStickers:
    """Simulated results of fits in one exposure, which are computed when they are needed.

    ``exposed`` (6, 6) are poses from ``StatisticalStereoCamera.exposed``, ``bodies`` (b, 4, 4) are
    transforms from ``StatisticalStereoCamera.placed``, and ``rng`` generates the noise.
    """

    full = windows = refuse_images

    def __init__(
        self,
        camera: StatisticalStereoCamera,
        exposed: Array,
        bodies: Array,
        rng: np.random.Generator,
    ) -> None:
        self.camera = camera
        self.exposed = exposed
        self.bodies = bodies
        self.rng = rng

    @cached_property
    def _found(self) -> "Ellipses":
        """Ellipses of all stickers, without contrasts and grounds.

        The grey values depend on the observer's noise, which is not known here.
        """
        from cmmsim.without_images.drawn_fit_kernels import Ellipses

        camera = self.camera
        centres: list[Array] = []
        shapes: list[Array] = []
        smears: list[Array] = []
        seen: list[NDArray[np.bool_]] = []
        places = transforms_of(self.exposed)
        for side, (lens, from_base) in enumerate(
            zip(camera.rig.cameras, camera.from_base, strict=True)
        ):
            middle, first, last = (
                from_base @ np.concatenate([place[None], self.bodies])
                for place in places[3 * side : 3 * side + 3]
            )
            centre, shape, visible = camera.side(lens, middle)
            centres.append(centre)
            shapes.append(shape)
            seen.append(visible)
            # A body at rest has no motion blur.
            if np.array_equal(first, last):
                smears.append(np.zeros(centre.shape))
                continue
            ends = (
                lens.project(camera.scene.placed(camera_from_bodies)[0])[0]
                for camera_from_bodies in (last, first)
            )
            smears.append(np.asarray(np.subtract(*ends)))
        require_short(float(np.linalg.norm(smears, axis=-1).max(where=np.stack(seen), initial=0.0)))
        noise = self.rng.standard_normal((2, len(seen[0]), 6))
        centre, shape, smear = (np.stack(values) for values in (centres, shapes, smears))
        if camera.print_errors is not None:
            centre = camera.print_errors.added_to(centre, self.rng)
        return Ellipses(
            centre, shape, smear, np.stack(seen), noise, np.zeros((2, 0)), np.zeros((2, 0))
        )

    def detected(self, corners: NDArray[np.int_], size: int, observer: Observer) -> DetectedCentres:
        """Simulate the fit of the sticker nearest to each window's middle (``StickerExposure``)."""
        from cmmsim.without_images.drawn_fit_kernels import nearest_stickers

        windows = _empty_windows(2 * corners.shape[1], observer)
        ellipses = self._found
        nearest_stickers(
            ellipses.seen, ellipses.centres, np.ascontiguousarray(corners), size, windows
        )
        return self._fitted(windows, observer)

    def bright(self, observer: Observer) -> tuple[EllipseFits, EllipseFits]:
        """Simulate the fits of all ellipses that lie wholly inside an image."""
        found = []
        for side, camera in enumerate(self.camera.rig.cameras):
            centres = self._found.centres[side]
            reach = np.linalg.norm(self._found.shapes[side], axis=2)
            complete = self._found.seen[side] & np.all(
                (centres - reach > 0.0) & (centres + reach < (camera.width - 1, camera.height - 1)),
                axis=1,
            )
            windows = _empty_windows(int(complete.sum()), observer)
            windows.sides[:] = side
            windows.stickers[:] = np.flatnonzero(complete)
            windows.found[:] = True
            windows.corners[:] = np.rint(centres[complete] - 0.5 * (windows.size - 1))
            found.append(self._fitted(windows, observer))
        return found[0], found[1]

    def _fitted(self, windows: "Windows", observer: Observer) -> EllipseFits:
        """Return the simulated fits in windows."""
        from cmmsim.without_images.drawn_fit_kernels import DetectionLimits, Fits, fit_stickers

        settings = observer.settings
        noise = observer.noise
        count = len(windows.stickers)
        sides = [
            self.camera.greys(noise, side, centres)
            for side, centres in enumerate(self._found.centres)
        ]
        contrasts, grounds = (np.stack(values) for values in zip(*sides, strict=True))
        shapes = ((2,), (2, 2), (5, 5), (), ())
        found = Fits(np.empty(count, dtype=bool), *(np.empty((count, *shape)) for shape in shapes))
        smallest = DetectionLimits(
            1.01 * SMALLEST_RADIUS_PX,
            THIN_PX,
            THIN_STD_PX,
            float(settings.limits.smallest_contrast),
        )
        fit_options = fit_settings(noise, settings.optics.psf_px)
        fit_stickers(
            self._found._replace(contrasts=contrasts, grounds=grounds),
            windows,
            smallest,
            fit_options,
            found,
        )
        if settings.allowed.largest_light == 0.0:
            found = self._lit(found, windows, fit_options)
        return EllipseFits(
            found.centres,
            found.covariances[:, :2, :2],
            found.good,
            found.shapes,
            found.covariances[:, 2:, 2:],
            np.ones(count),
            found.contrasts,
            found.grounds,
            np.zeros((count, 7)),
        )

    def _lit(self, even: "Fits", windows: "Windows", fit_options: "FitSettings") -> "Fits":
        """Return the simulated fits in windows if light that rises is fitted in each of them.

        ``even`` are the simulated fits of even light, with the same random numbers. ``fit_options``
        are the settings of the fit.
        """
        from cmmsim.without_images.drawn_fit_kernels import lit_covariances

        at = windows.sides, windows.stickers
        ellipses = self._found
        covariances = np.array(even.covariances)
        good = np.flatnonzero(even.good)
        lit = np.empty((len(good), 5, 5))
        lit_covariances(
            (ellipses.centres[at] - windows.corners)[good],
            ellipses.shapes[at][good],
            ellipses.smears[at][good],
            even.contrasts[good],
            even.grounds[good],
            windows.size,
            fit_options,
            lit,
        )
        covariances[good] = lit
        roots = np.linalg.cholesky(covariances)
        errors = np.einsum("kij,kj->ki", roots, ellipses.noise[at][:, :5])
        shapes = ellipses.shapes[at] + errors[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
        centres = ellipses.centres[at] + errors[:, :2]
        return even._replace(centres=centres, shapes=shapes, covariances=covariances)


def _empty_windows(count: int, observer: Observer) -> "Windows":
    """Return ``count`` fitted parts of the observer's size, with uninitialised values."""
    # Imported late, because importing numba takes time.
    from cmmsim.without_images.drawn_fit_kernels import Windows

    indices = np.empty((2, count), dtype=int)
    found = np.empty(count, dtype=bool)
    return Windows(
        indices[0], indices[1], np.empty((count, 2), dtype=int), found, observer.settings.fit_size
    )
