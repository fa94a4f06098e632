"""Measuring volume, a cuboid that both cameras see, and the seven lines of VDI/VDE 2634-1 in it.

The origin of the volume axes is the target of the rig. As seen from the rig, x points to the right
and y downwards; z points away from the middle of the baseline. Four lines lie on the space
diagonals. The other three lie on diagonals of three faces that meet in a corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from cmmsim.errors import AcceptanceError
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.files.schema import Rig
from cmmsim.geometry.pose import Array, apply, frozen, invert, rigid, transform_to_pose
from cmmsim.geometry.stereo_rig import StereoRig

# Smallest distance of the corners from the image edges. It leaves space for the artefacts' width.
MARGIN_PX = 40.0
# Largest ratio of half the volume's depth to the distance from the baseline to the target.
LARGEST_DEPTH_RATIO = 0.8
# Smallest side of a volume, m. The stickers of an artefact do not fit into a smaller volume.
SMALLEST_SIZE = 0.1
# Corners (8, 3) of the volume, in units of its sides.
CORNERS = frozen(list(product((-0.5, 0.5), repeat=3)))
# Rules of the standard: smallest numbers of lines, and of different test lengths on each line.
FEWEST_LINES = 7
FEWEST_LENGTHS = 5
# Smallest ratio of the longest test length to the space diagonal of the volume.
SMALLEST_LENGTH_RATIO = 2.0 / 3.0
# Ratio of a line to its diagonal. The rest leaves space for the ends of the artefact.
LINE_RATIO = 0.9
# Test lengths of a line, as fractions of its longest test length.
TEST_LENGTHS = frozen([0.19, 0.41, 0.6, 0.82, 1.0])
# Ends of the diagonals on which the lines lie, in half sides of the volume.
LINES = {
    "space 1": ((-1, -1, -1), (1, 1, 1)),
    "space 2": ((1, -1, -1), (-1, 1, 1)),
    "space 3": ((-1, 1, -1), (1, -1, 1)),
    "space 4": ((1, 1, -1), (-1, -1, 1)),
    "front face": ((-1, 1, -1), (1, -1, -1)),
    "bottom face": ((-1, 1, -1), (1, 1, 1)),
    "right face": ((1, 1, -1), (1, -1, 1)),
}


@dataclass(frozen=True)
class MeasuringVolume:
    """Cuboid with sides ``size`` (3,) along x, y and z, m.

    The origin of the volume axes is the middle of the cuboid. ``base_from_volume`` is (4, 4).
    ``distance`` is the distance of the origin from the middle of the baseline, m. Raises
    AcceptanceError if a side is shorter than SMALLEST_SIZE.
    """

    base_from_volume: Array
    size: Array
    distance: float

    def __post_init__(self) -> None:
        if (
            self.size.shape != (3,)
            or not np.all(np.isfinite(self.size))
            or self.size.min() < SMALLEST_SIZE
        ):
            raise AcceptanceError(
                f"measuring volume {self}: three sides of at least {1e3 * SMALLEST_SIZE:.0f} mm "
                "are needed"
            )
        self.base_from_volume.setflags(write=False)
        self.size.setflags(write=False)

    def __str__(self) -> str:
        return " x ".join(f"{1e3 * side:.0f}" for side in np.ravel(self.size)) + " mm"

    def pose(self, along: Array, position: Array, turn: Array | None = None) -> Array:
        """Return the pose (6,) of an artefact in the base frame.

        The artefact's origin is at ``position`` (3,) m in volume axes. The artefact's x axis has
        the direction ``along`` (3,) of any length, which must not be parallel to z. Side A faces
        the rig. Finally the artefact is rotated by ``turn`` (3, 3) in its own axes.
        """
        x = along / np.linalg.norm(along)
        towards = np.array([0.0, 0.0, -1.0])
        z = towards - (towards @ x) * x
        z = z / np.linalg.norm(z)
        rotation = np.column_stack([x, np.cross(z, x), z])
        return transform_to_pose(
            self.base_from_volume @ rigid(rotation if turn is None else rotation @ turn, position)
        )

    @property
    def diagonal(self) -> float:
        """Length of the space diagonal, m."""
        return float(np.linalg.norm(self.size))

    @property
    def depth_range(self) -> tuple[float, float]:
        """Smallest and largest distance of the volume from the baseline, along its z axis, m."""
        return self.distance - 0.5 * float(self.size[2]), self.distance + 0.5 * float(self.size[2])


def common_volume(place: Rig) -> MeasuringVolume:
    """Return the largest cube around the target of a rig that is wholly visible to both cameras.

    The images of its corners lie at least MARGIN_PX from the image edges. The sides are rounded
    down to whole millimetres. Raises AcceptanceError if they are shorter than SMALLEST_SIZE.
    """
    rig, camera_from_base = rig_from_file(place)
    frame, distance = _volume_frame(rig, camera_from_base, place)
    low = 0.0
    high = 2.0 * LARGEST_DEPTH_RATIO * distance
    # after 40 steps of bisection, the side is accurate to rounding
    for _ in range(40):
        middle = 0.5 * (low + high)
        if _unseen(rig, camera_from_base @ frame, np.full(3, middle), distance) is None:
            low = middle
        else:
            high = middle
    if low < SMALLEST_SIZE:
        raise AcceptanceError(
            "nothing is visible to both cameras around their target: the largest common cube has "
            f"sides of {1e3 * low:.1f} mm, but at least {1e3 * SMALLEST_SIZE:.0f} mm are needed"
        )
    return MeasuringVolume(frame, np.full(3, np.floor(1e3 * low) / 1e3), distance)


def volume_of_size(place: Rig, size: Array) -> MeasuringVolume:
    """Return the cuboid of ``size`` (3,) m around the target of a rig.

    Raises AcceptanceError, which names the reason and the largest visible cube, if the cuboid is
    not wholly visible, and if a side is shorter than SMALLEST_SIZE.
    """
    rig, camera_from_base = rig_from_file(place)
    frame, distance = _volume_frame(rig, camera_from_base, place)
    volume = MeasuringVolume(frame, np.array(size, dtype=float), distance)
    hidden = _unseen(rig, camera_from_base @ frame, volume.size, distance)
    if hidden is not None:
        largest = 1e3 * common_volume(place).size[0]
        raise AcceptanceError(
            f"measuring volume {volume} is not wholly visible to both cameras: {hidden}; the "
            f"largest visible cube has sides of {largest:.0f} mm"
        )
    return volume


def _volume_frame(rig: StereoRig, camera_from_base: Array, place: Rig) -> tuple[Array, float]:
    """Return base_from_volume (4, 4), and the distance of the target from the baseline's middle, m.

    The x axis of the volume is the direction of the baseline, made perpendicular to z.
    """
    centres = [invert(move @ camera_from_base)[:3, 3] for move in rig.from_camera]
    view = np.array(place.target) - 0.5 * (centres[0] + centres[1])
    distance = float(np.linalg.norm(view))
    z = view / distance
    x = (centres[1] - centres[0]) - ((centres[1] - centres[0]) @ z) * z
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), place.target), distance


def _unseen(rig: StereoRig, camera_from_volume: Array, size: Array, distance: float) -> str | None:
    """Return the reason why a cuboid is not wholly visible to both cameras, or None if it is.

    A cuboid that comes too close to the cameras does not count as visible.
    """
    corners = CORNERS * size
    if 0.5 * size[2] > LARGEST_DEPTH_RATIO * distance:
        return (
            f"its front face comes within {1e3 * (distance - 0.5 * size[2]):.0f} mm of the cameras"
        )
    points = apply(camera_from_volume, corners)
    pixels, valid = rig.project(points)
    for camera, name, corner_pixels, ahead in zip(
        rig.cameras, ("left", "right"), pixels, valid, strict=True
    ):
        inside = ahead & camera.shows(corner_pixels, MARGIN_PX)
        if not inside.all():
            k = int(np.flatnonzero(~inside)[0])
            corner = ", ".join(f"{1e3 * v:+.0f}" for v in corners[k])
            x, y = corner_pixels[k]
            return (
                f"the corner ({corner}) mm is at pixel ({x:.0f}, {y:.0f}) of the {name} camera, "
                f"whose image has {camera.width} x {camera.height} px and {MARGIN_PX:.0f} px of "
                "margin"
            )
    return None


@dataclass(frozen=True)
class MeasuringLine:
    """Measuring line from ``start`` (3,) to ``end`` (3,), m in volume axes.

    ``lengths`` (k,) are the test lengths, m. All test lengths begin at ``start``, and the longest
    extends to ``end``.
    """

    name: str
    start: Array
    end: Array
    lengths: Array

    def __post_init__(self) -> None:
        for array in (self.start, self.end, self.lengths):
            array.setflags(write=False)

    @property
    def direction(self) -> Array:
        """Unit vector (3,) from start to end."""
        return (self.end - self.start) / np.linalg.norm(self.end - self.start)


def seven_lines(volume: MeasuringVolume) -> tuple[MeasuringLine, ...]:
    """Return the seven lines of a volume, with five test lengths each.

    Raises AcceptanceError if the lines break a rule of the standard.
    """
    lines = []
    for name, corners in LINES.items():
        start, end = (LINE_RATIO * (0.5 * np.array(corner) * volume.size) for corner in corners)
        lines.append(
            MeasuringLine(name, start, end, TEST_LENGTHS * float(np.linalg.norm(end - start)))
        )
    require_rules(lines, volume)
    return tuple(lines)


def require_rules(lines: Sequence[MeasuringLine], volume: MeasuringVolume) -> None:
    """Raise AcceptanceError if measuring lines break a rule of the standard.

    The message names the line, the value and the limit.
    """
    if len(lines) < FEWEST_LINES:
        raise AcceptanceError(
            f"{len(lines)} measuring lines, but at least {FEWEST_LINES} are needed"
        )
    for line in lines:
        different = len(np.unique(np.round(line.lengths, 6)))
        if different < FEWEST_LENGTHS:
            raise AcceptanceError(
                f"line {line.name}: {different} different test lengths, but at least "
                f"{FEWEST_LENGTHS} are needed"
            )
        longest = line.lengths.max()
        limit = SMALLEST_LENGTH_RATIO * volume.diagonal
        if longest < limit:
            raise AcceptanceError(
                f"line {line.name}: its longest test length of {1e3 * longest:.0f} mm is less than "
                f"two thirds of the volume's space diagonal, {1e3 * limit:.0f} mm; choose a volume "
                "nearer to a cube"
            )
        for point in (line.start, line.end):
            # Rounding errors can put an end slightly outside.
            if np.any(np.abs(point) > 0.5 * volume.size + 1e-9):
                raise AcceptanceError(
                    f"line {line.name} leaves the volume at {np.round(1e3 * point)} mm"
                )
