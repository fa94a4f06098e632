"""Random faults of stereo images.

They serve to test whether each measurement of faulty images is right, or states that it is lost.

    faults = cmmsim.FaultGenerator(sensor.estimator)
    fault = faults.draw("false_discs", pose, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    images = cmmsim.FaultyImages(sensor.look(pose), fault, sensor.noise, rng)
    cmmsim.Tracker(sensor.estimator).measure(images)

A fault changes the grey values of finished images, so the images can come from any source. Faults
of the kinds "obstacles" and "several" can also contain bodies, which have to be drawn with the
scene. Register these bodies once with ``sensor.add_bodies(fault_bodies())``, then call
``sensor.look(pose, obstacles=fault.obstacles)``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from cmmsim.checks import require_kind
from cmmsim.errors import UnknownOptionError
from cmmsim.fault_images import DiscMark, Fault, FillMark, GlintMark, Mark, PlateMark
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.pose import Array, apply, checked_pose, invert, pose_to_transform
from cmmsim.measuring.pose_estimator import PoseEstimator, require_estimator

# Sides of the boxes that hide stickers, m. The third side of each box is half as long.
BODY_SIZES = (0.008, 0.02, 0.04, 0.08, 0.16)
# With probability one half, a fault changes at most this number of stickers.
FEW = 4
# Kinds of faults. The method FaultGenerator._<kind> draws a fault of the kind, and returns its
# marks or a whole Fault.
KINDS = (
    *(
        "hidden",
        "half_hidden",
        "obstacles",
        "one_camera_dark",
        "one_camera_covered",
        "false_discs",
        "false_points",
    ),
    *("glint", "merging", "swapped", "black", "saturated", "several"),
)
# Radiance of discs that look like stickers, and of plates that hide stickers.
STICKER_RADIANCE = 228.0 / 255.0
DARK_RADIANCE = 60.0 / 255.0
SATURATING = 1.5  # radiance above that of white


def fault_bodies() -> dict[str, trimesh.Trimesh]:
    """Return the boxes that hide stickers.

    Returns
    -------
    dict of str to trimesh.Trimesh
        Boxes in m, by the names that ``Fault.obstacles`` uses.

    Examples
    --------
    >>> sorted(fault_bodies())[0]
    'fault box 0'
    """
    return {
        f"fault box {k}": trimesh.creation.box(extents=(0.5 * size, size, size))
        for k, size in enumerate(BODY_SIZES)
    }


class FaultGenerator:
    """Generator of random faults in the images, at the pixels where stickers are expected.

    Parameters
    ----------
    estimator : PoseEstimator
        Estimator of the images, such as ``sensor.estimator``.

    Raises
    ------
    CmmError
        If the estimator is of another type.

    Examples
    --------
    >>> faults = FaultGenerator(sensor.estimator)
    >>> faults.draw("one_camera_dark", sensor.home, np.random.default_rng(1))
    Fault('one_camera_dark', 1 marks, 0 obstacles)
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        require_estimator(estimator)
        self._rig = estimator.rig
        self._platform = estimator.platform
        self._taught = estimator.taught
        self._radius = estimator.settings.radius

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the kinds of faults.

        ==================  ===============================================================
        hidden              stickers that are covered in one image or in both
        half_hidden         stickers that are cut off by a straight edge
        obstacles           bodies in front of the platform
        one_camera_dark     one black image
        one_camera_covered  one image of a single grey level
        false_discs         discs that look like stickers, each in one image only
        false_points        discs in both images that look like stickers at wrong positions
        glint               bright light with a tail, on stickers or beside them
        merging             discs that overlap stickers, touch them or leave a small gap
        swapped             left and right image exchanged
        black, saturated    both images black or saturated
        several             two or three faults of the kinds that leave stickers to measure
        ==================  ===============================================================
        """
        return KINDS

    def draw(self, kind: str, pose: ArrayLike, rng: np.random.Generator) -> Fault:
        """Draw a fault of a kind for the platform at a pose.

        Parameters
        ----------
        kind : str
            One of ``kinds``.
        pose : array_like, shape (6,)
            Pose of the platform, m and rad.
        rng : numpy.random.Generator
            Generator of the random numbers.

        Returns
        -------
        Fault

        Raises
        ------
        UnknownOptionError
            If there is no such kind.
        ShapeError
            If the pose is not six finite numbers.
        CmmError
            If ``rng`` is not a numpy.random.Generator.
        """
        if kind not in KINDS:
            raise UnknownOptionError("fault", kind, KINDS)
        require_kind(
            rng, np.random.Generator, "rng must be a generator, such as numpy.random.default_rng(1)"
        )
        drawn = getattr(self, f"_{kind}")(checked_pose(pose), rng)
        return drawn if isinstance(drawn, Fault) else Fault(kind, tuple(drawn))

    def _outlines(
        self, pose: Array, stickers: slice = slice(None), offset: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Return centres (2, n, 2) and shapes (2, n, 2, 2), px, of the ellipses of n stickers.

        The stickers are displaced by ``offset`` (3,) m in platform axes.
        """
        camera_from_platform = invert(self._taught.base_from_camera) @ pose_to_transform(pose)
        places = self._taught.platform_places[stickers] + offset
        normals = self._platform.sticker_normals[stickers]
        return sticker_outlines(self._rig, camera_from_platform, places, normals, self._radius)

    def _some(self, rng: np.random.Generator, most: int | None = None) -> NDArray[np.int_]:
        """Return the indices of 1 to ``most`` random stickers; by default, up to all stickers.

        With probability one half, at most FEW stickers are chosen.
        """
        count = len(self._taught.platform_places)
        largest = min(most or count, FEW if rng.random() < 0.5 else count, count)
        return rng.choice(count, rng.integers(1, largest + 1), replace=False)

    def _hidden(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        """Cover stickers with opaque plates."""
        centres, shapes = self._outlines(pose)
        sides = _one_or_both(rng)
        for k in self._some(rng):
            for side in sides:
                # The 2-norm of the shape is the ellipse's largest half axis, so the plate covers
                # the ellipse at any angle.
                half = np.linalg.norm(shapes[side, k], 2) + rng.uniform(1.0, 12.0, 2)
                yield PlateMark(
                    side, centres[side, k], half, rng.uniform(0.0, np.pi), DARK_RADIANCE
                )

    def _half_hidden(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        """Hide parts of stickers behind straight edges. The hidden parts are often small."""
        centres, shapes = self._outlines(pose)
        sides = _one_or_both(rng)
        for k in self._some(rng):
            angle = rng.uniform(0.0, 2.0 * np.pi)
            depth = rng.uniform(0.0, 1.0) ** rng.choice([1, 3])
            normal = np.array([np.cos(angle), np.sin(angle)])
            for side in sides:
                rim = float(np.linalg.norm(shapes[side, k] @ normal))
                half = np.array([rng.uniform(6.0, 20.0), 15.0])
                away = half[0] + rim * (1.0 - 2.0 * depth)
                yield PlateMark(side, centres[side, k] + away * normal, half, angle, DARK_RADIANCE)

    def _obstacles(self, pose: Array, rng: np.random.Generator) -> Fault:
        """Place boxes between stickers and cameras."""
        names = list(fault_bodies())
        base_from_bodies = {}
        for number in rng.choice(len(names), rng.integers(1, len(names) + 1), replace=False):
            sticker = self._taught.platform_places[rng.integers(len(self._taught.platform_places))]
            position = apply(pose_to_transform(pose), sticker)
            between_cameras = apply(self._taught.base_from_camera, 0.5 * self._rig.right_centre)
            position = (
                position
                + rng.uniform(0.02, 0.5) * (between_cameras - position)
                + rng.uniform(-0.7, 0.7, 3) * BODY_SIZES[number]
            )
            base_from_bodies[names[number]] = pose_to_transform(
                np.r_[position, rng.uniform(-1.0, 1.0, 3)]
            )
        return Fault("obstacles", obstacles=base_from_bodies)

    def _one_camera_dark(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        yield FillMark(int(rng.integers(2)), 0.0)

    def _one_camera_covered(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        yield FillMark(int(rng.integers(2)), rng.uniform(0.0, 1.0))

    def _false_discs(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        """Lay discs among the stickers, on them or near them."""
        centres, shapes = self._outlines(pose)
        for _ in range(rng.integers(1, 31)):
            side = int(rng.integers(2))
            sticker = centres[side, rng.integers(centres.shape[1])]
            shape = shapes[side, rng.integers(centres.shape[1])]
            centre = sticker + rng.choice([2.0, 6.0, 80.0]) * rng.standard_normal(2)
            yield DiscMark(side, centre, rng.uniform(0.7, 1.4) * shape, _radiance(rng))

    def _false_points(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        """Lay discs at points in space near stickers. The discs hide what is behind them."""
        for _ in range(rng.integers(1, 21)):
            k = rng.integers(len(self._taught.platform_places))
            offset = rng.choice([0.0005, 0.003, 0.01, 0.1]) * rng.standard_normal(3)
            centres, shapes = self._outlines(pose, slice(k, k + 1), offset)
            radiance = _radiance(rng)
            for side in range(2):
                yield DiscMark(side, centres[side, 0], shapes[side, 0], radiance)

    def _glint(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        """Add glints near stickers, in one image or in both.

        The two cameras see the glint of a surface in different directions and strengths.
        """
        centres, shapes = self._outlines(pose)
        for k in self._some(rng, 6):
            for side in _one_or_both(rng):
                centre = centres[side, k] + rng.uniform(0.0, 4.0) * shapes[side, k] @ _direction(
                    rng
                )
                peak = 10.0 ** rng.uniform(-1.5, 1.0)
                core = rng.uniform(0.5, 3.0)
                tail_peak = 10.0 ** rng.uniform(-2.5, 0.5)
                tail = rng.uniform(2.0, 20.0)
                yield GlintMark(side, centre, peak, core, tail_peak, tail, rng.uniform(0.0, np.pi))

    def _merging(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        """Lay discs whose rims overlap the stickers' rims, touch them, or leave a small gap."""
        centres, shapes = self._outlines(pose)
        sides = _one_or_both(rng)
        for k in self._some(rng):
            direction = _direction(rng)
            distance = rng.uniform(0.2, 2.4)  # in sticker radii; rims touch at 2
            radiance = _radiance(rng)
            for side in sides:
                centre = centres[side, k] + distance * shapes[side, k] @ direction
                yield DiscMark(side, centre, shapes[side, k], radiance)

    def _swapped(self, pose: Array, rng: np.random.Generator) -> Fault:
        return Fault("swapped", swapped=True)

    def _black(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        return (FillMark(side, 0.0) for side in range(2))

    def _saturated(self, pose: Array, rng: np.random.Generator) -> Iterator[Mark]:
        return (FillMark(side, SATURATING) for side in range(2))

    def _several(self, pose: Array, rng: np.random.Generator) -> Fault:
        kinds = [
            "hidden",
            "half_hidden",
            "obstacles",
            "false_discs",
            "false_points",
            "glint",
            "merging",
        ]
        parts = [
            self.draw(kind, pose, rng)
            for kind in rng.choice(kinds, rng.integers(2, 4), replace=False)
        ]
        obstacles = {name: move for part in parts for name, move in part.obstacles.items()}
        return Fault(
            "several", tuple(mark for part in parts for mark in part.marks), obstacles=obstacles
        )


def _one_or_both(rng: np.random.Generator) -> tuple[int, ...]:
    """Choose both images with probability one half, otherwise the left or the right one."""
    return ((0,), (1,), (0, 1), (0, 1))[rng.integers(4)]


def _radiance(rng: np.random.Generator) -> float:
    """Choose the radiance of a sticker, or with probability one half a random radiance."""
    return STICKER_RADIANCE if rng.random() < 0.5 else float(rng.uniform(0.3, 1.3))


def _direction(rng: np.random.Generator) -> Array:
    """Return a random unit vector (2,)."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])
