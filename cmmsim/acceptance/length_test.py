"""Length measurement error in the style of VDI/VDE 2634-1.

An artefact with a row of six stickers stands on each measuring line. The test lengths are the
distances from the first sticker to the other five. A measured length is the mean over a few
exposures of the artefact at rest. The error of a length is the measured minus the certified length.
The standard limits the magnitude of this error. Its tests of sphere form and sphere spacing are
omitted, because the targets are flat stickers.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cmmsim.acceptance.artefacts import SensorUnderTest, board, estimator_of, locate
from cmmsim.acceptance.volume import MeasuringLine, MeasuringVolume, seven_lines
from cmmsim.errors import AcceptanceError
from cmmsim.files.schema import Platform
from cmmsim.geometry.pose import Array
from cmmsim.imaging.renderer import choose_renderer
from cmmsim.many_frames import on_all_cores
from cmmsim.sensor import Sensor

STREAM = 1  # number that selects the random noise of the first line. The next lines have the next.
# Number of exposures of the artefact at rest over which lengths are averaged.
EXPOSURES = 5
# Irregular coordinates of the stickers that serve to recognise the artefact. Along the artefact,
# they are counted from its middle, as fractions of the longest length. Across, they are in m.
RECOGNITION_B = (-0.37, -0.08, 0.31)
RECOGNITION_C = (-0.29, 0.13, 0.4)
RECOGNITION_ACROSS = (0.044, 0.025, 0.040)


@dataclass(frozen=True)
class MeasuredLength:
    """Measured length on a line.

    ``true`` is the certified length, m. ``measured`` (k,) are the lengths in k exposures, m, and
    ``std`` is the stated standard deviation of the length in one exposure, m.
    """

    line: str
    true: float
    measured: Array
    std: float

    @property
    def error(self) -> float:
        """Length measurement error E: mean over exposures minus certified length, m."""
        return float(self.measured.mean()) - self.true


@dataclass(frozen=True)
class LengthTest:
    """Measuring volume, its seven lines, and all measured lengths."""

    volume: MeasuringVolume
    lines: tuple[MeasuringLine, ...]
    lengths: tuple[MeasuredLength, ...]

    @property
    def errors(self) -> Array:
        """All length measurement errors E (n,), m."""
        return np.array([length.error for length in self.lengths])

    @property
    def single_errors(self) -> Array:
        """Errors (n,k) of the lengths in single exposures, m."""
        return np.array([length.measured - length.true for length in self.lengths])

    @property
    def largest(self) -> MeasuredLength:
        """Measured length whose error has the largest magnitude."""
        return max(self.lengths, key=lambda length: abs(length.error))

    @property
    def variance_ratio(self) -> float:
        """Mean of squared errors in single exposures divided by their stated variances.

        It is about 1 if the stated variances are right.
        """
        stds = np.array([length.std for length in self.lengths])
        return float(np.mean((self.single_errors / stds[:, None]) ** 2))

    def of_line(self, name: str) -> tuple[MeasuredLength, ...]:
        """Return the measured lengths of one line."""
        return tuple(length for length in self.lengths if length.line == name)


def length_artefact(line: MeasuringLine) -> Platform:
    """Return the artefact of a line, with six stickers in a row on side A.

    The first of them lies at the start of the line.
    """
    longest = float(line.lengths.max())
    along = np.concatenate([[0.0], line.lengths]) - 0.5 * longest
    return board(
        (along, np.zeros(len(along))),
        (longest * np.array(RECOGNITION_B), RECOGNITION_ACROSS),
        (longest * np.array(RECOGNITION_C), RECOGNITION_ACROSS),
    )


def length_test(
    under_test: SensorUnderTest,
    volume: MeasuringVolume,
    exposures: int = EXPOSURES,
    advance: Callable[[], None] = lambda: None,
) -> LengthTest:
    """Measure five lengths on each of the seven lines of a volume.

    The lines are measured on all cores, each with its own noise. ``advance`` is called after each
    line. Raises AcceptanceError if a line breaks a rule of the standard, if an artefact is not
    found in its images, or if a sticker of its row is not measured.
    """
    lines = seven_lines(volume)
    lengths: list[MeasuredLength] = []

    def measured(number: int) -> list[MeasuredLength]:
        sensor = under_test.facing(length_artefact(lines[number]), STREAM + number)
        return measure_line(sensor, volume, lines[number], exposures)

    for of_line in on_all_cores(
        measured, range(len(lines)), choose_renderer(under_test.renderer_name())
    ):
        lengths += of_line
        advance()
    return LengthTest(volume, lines, tuple(lengths))


def measure_line(
    sensor: Sensor, volume: MeasuringVolume, line: MeasuringLine, exposures: int
) -> list[MeasuredLength]:
    """Measure the lengths of one line in a number of exposures.

    The platform of ``sensor`` must be the artefact of the line. Raises AcceptanceError if the
    artefact is not found, or if a sticker of its row is not measured.
    """
    pose = volume.pose(line.direction, 0.5 * (line.start + line.end))
    body = sensor.platform
    estimator = estimator_of(sensor, body)
    expected = locate(estimator, sensor.look(pose))
    count = 1 + len(line.lengths)  # the stickers of the row are the first of the artefact
    values = np.empty((exposures, len(line.lengths)))
    stds = np.empty((exposures, len(line.lengths)))
    for k in range(exposures):
        seen = estimator.observe(sensor.look(pose), expected, body.nominal, body.sticker_normals)
        missing = np.setdiff1d(np.arange(count), seen.index)
        if len(missing):
            names = ", ".join(body.sticker_ids[missing])
            raise AcceptanceError(
                f"line {line.name}: stickers {names} are not measured by both cameras"
            )
        values[k], stds[k] = lengths_from_first(seen.points[:count], seen.covariances[:count])
    return [
        MeasuredLength(line.name, float(true), value, float(np.sqrt(np.mean(std**2))))
        for true, value, std in zip(line.lengths, values.T, stds.T, strict=True)
    ]


def lengths_from_first(points: Array, covariances: Array) -> tuple[Array, Array]:
    """Return the distances (n - 1,) m of points from the first, and their standard deviations.

    The points are (n, 3) with covariances (n, 3, 3).
    """
    steps = points[1:] - points[0]
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / lengths[:, None]
    variances = np.einsum("ni,nij,nj->n", directions, covariances[1:] + covariances[0], directions)
    return lengths, np.sqrt(variances)
