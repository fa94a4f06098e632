"""Result of a calibration: its figures, its text (TOML, JSON), and the sensor file that it
completes.
"""

import json
import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cmmsim.calibration.adjustment import Adjustment
from cmmsim.calibration.board import Board
from cmmsim.calibration.sightings import SIDES, Sightings
from cmmsim.errors import CalibrationError
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.files.sensor_file import built_in_names, read_sensor_file, sensor_text
from cmmsim.geometry.pose import Array, skew, transform_to_pose
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, StereoRig
from cmmsim.uncertainty.known_rig import KnownRig

TABLES = ("rig.left", "rig.right", "rig.right_from_left")
HEADER = re.compile(r"^\s*\[+\s*([^\[\]]+?)\s*\]+\s*(#.*)?$")
BASIS = re.compile(r"^[ \t]*based_on[ \t]*=.*$", re.MULTILINE)
# Ratio of the baselines of calibration and sensor file, the larger over the smaller.
LARGEST_RATIO = 1.5


@dataclass(frozen=True)
class UsedView:
    """Name of a used pair, its place in left_from_boards, and the rms residual in px of each used
    image.
    """

    name: str
    view: int
    rms_px: dict[str, float]


@dataclass(frozen=True)
class Calibration:
    """Both cameras with their covariance, and all that they rest on.

    ``sightings`` are those adjusted, where dots have no eccentricity. ``rejected`` has the reason
    by the pair's name, also for pairs of which one image is used. ``warnings`` are one line each.
    """

    rig: StereoRig
    board: Board
    distortion: str
    fix_aspect: bool
    adjustment: Adjustment
    sightings: tuple[Sightings, Sightings]
    used: list[UsedView]
    rejected: dict[str, str]
    warnings: list[str]

    @property
    def rotation_vector(self) -> Array:
        """Rotation vector (3,) of right_from_left, rad."""
        return np.asarray(cv2.Rodrigues(self.rig.right_from_left[:3, :3])[0], dtype=float).ravel()

    @property
    def values(self) -> Array:
        """Estimates (24,) in the order of PARAMETER_NAMES."""
        shift = self.rig.right_from_left[:3, 3]
        return np.concatenate([*self.adjustment.state.intrinsics, shift, self.rotation_vector])

    @property
    def covariance(self) -> Array:
        """Covariance (24, 24) in the order of PARAMETER_NAMES; rows of fixed parameters are
        zero.
        """
        spread = np.eye(len(PARAMETER_NAMES))
        spread[-3:, -3:] = _inverse_left_jacobian(self.rotation_vector)
        return np.asarray(spread @ self.adjustment.covariance @ spread.T)

    @property
    def known(self) -> KnownRig:
        """Both cameras as the calibration knows them, with their covariance."""
        return KnownRig(self.rig, self.covariance)

    @property
    def std(self) -> Array:
        """Standard deviations (24,)."""
        return np.sqrt(np.diag(self.covariance))


def _inverse_left_jacobian(vector: Array) -> Array:
    """Return the change (3, 3) of a rotation vector (3,) by a small turn applied on the left.

    See Sola et al. 2018, eq. 146.
    """
    angle = float(np.linalg.norm(vector))
    k = skew(vector)
    # The general formula divides rounding by the square of a small angle; this is its series.
    if angle < 1e-4:
        return np.eye(3) - 0.5 * k + k @ k / 12.0
    return (
        np.eye(3)
        - 0.5 * k
        + (1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))) * k @ k
    )


def rig_tables(found: Calibration) -> str:
    """Return the tables [rig.left], [rig.right] and [rig.right_from_left] of a sensor file."""
    state = found.adjustment.state
    lines = []
    for side, values in zip(SIDES, state.intrinsics, strict=True):
        lines += [
            f"[rig.{side}]",
            f"focal_px = {values[:2].tolist()}",
            f"centre_px = {values[2:4].tolist()}",
            f"distortion = {values[4:].tolist()}  # k1, k2, p1, p2, k3",
            "",
        ]
    lines += [
        "[rig.right_from_left]",
        f"translation = {found.rig.right_from_left[:3, 3].tolist()}  # m",
        f"rotation_vector = {found.rotation_vector.tolist()}  # rad",
    ]
    return "\n".join(lines) + "\n"


def as_dict(found: Calibration) -> dict[str, Any]:
    """Return everything of a calibration, ready for JSON."""
    solved = found.adjustment
    return {
        "opencv": cv2.__version__,
        "board": found.board.model_dump(),
        "image_size_px": [found.rig.left.width, found.rig.left.height],
        "options": {"distortion": found.distortion, "fix_aspect": found.fix_aspect},
        "rms_px": {
            side: float(np.sqrt(np.mean(r**2)))
            for side, r in zip(SIDES, solved.residuals, strict=True)
        },
        "sigma_px": solved.sigma_px,
        "degrees_of_freedom": solved.freedom,
        "condition": solved.condition,
        "shared_errors": {
            "ratio": solved.shared.ratio,
            "limit": solved.shared.limit,
            "factor": solved.shared.factor,
        },
        "parameters": {
            name: {"estimate": float(value), "std": float(std), "free": bool(std > 0.0)}
            for name, value, std in zip(PARAMETER_NAMES, found.values, found.std, strict=True)
        },
        "covariance": {"names": list(PARAMETER_NAMES), "matrix": found.covariance.tolist()},
        "used": [
            {
                "name": view.name,
                "rms_px": view.rms_px,
                "left_from_board_pose": transform_to_pose(
                    solved.state.left_from_boards[view.view]
                ).tolist(),
            }
            for view in found.used
        ],
        "rejected": found.rejected,
        "warnings": found.warnings,
    }


@dataclass(frozen=True)
class SensorTemplate:
    """Sensor file without its calibrated cameras.

    ``text`` may stand in the folder that it was made for. ``size`` is (width, height) of the
    images, px, and ``baseline`` the distance of the cameras, m. ``name`` is that of the file, or
    its path.
    """

    text: str
    size: tuple[int, int]
    baseline: float
    name: str

    def require_size(self, size: tuple[int, int]) -> None:
        """Raise CalibrationError for images of another size (width, height) px."""
        if size != self.size:
            raise CalibrationError(
                f"the images are {size[0]} x {size[1]} px, those of the sensor file {self.name} "
                f"{self.size[0]} x {self.size[1]}: take a sensor file of the same cameras"
            )

    def filled(self, found: Calibration) -> str:
        """Return the text of the sensor file with the calibrated cameras.

        Raises CalibrationError for images of another size.
        """
        self.require_size((found.rig.left.width, found.rig.left.height))
        return self.text + rig_tables(found)

    def disagreements(self, found: Calibration) -> list[str]:
        """Return one line where the calibrated baseline is far from the sensor file's."""
        baseline = float(np.linalg.norm(found.rig.right_from_left[:3, 3]))
        if max(baseline / self.baseline, self.baseline / baseline) <= LARGEST_RATIO:
            return []
        return [
            f"the cameras stand {baseline:.4g} m apart, those of the sensor file {self.name} "
            f"{self.baseline:.4g} m: are the lengths of the board file in m, and is it the file of "
            "these cameras?"
        ]


def sensor_template(name: str | Path, folder: str | Path) -> SensorTemplate:
    """Return a sensor file of a built-in name or a path, to be filled and written into ``folder``.

    A file that the sensor file is based on is named as seen from the folder. Raises as
    read_sensor_file, and CalibrationError where the cameras stand in inline tables.
    """
    section = read_sensor_file(name).rig
    text = (
        _without_tables(_based_from(sensor_text(name), name, Path(folder)), TABLES).rstrip()
        + "\n\n"
    )
    try:
        tomllib.loads(text + "".join(f"[{table}]\n" for table in TABLES))
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(
            f"sensor file {name} must hold {', '.join(TABLES)} as tables of their own: {error}"
        ) from error
    baseline = float(np.linalg.norm(rig_from_file(section)[0].right_from_left[:3, 3]))
    return SensorTemplate(text, (section.width, section.height), baseline, str(name))


def require_sensor(path: str | Path) -> None:
    """Raise SensorFileError where a file describes no sensor."""
    rig_from_file(read_sensor_file(path).rig)


def _based_from(text: str, name: str | Path, folder: Path) -> str:
    """Return the text whose based_on, where it is a file, names that file from ``folder``."""
    basis = tomllib.loads(text).get("based_on")
    if basis is None or basis in built_in_names() or Path(basis).is_absolute():
        return text
    from_folder = os.path.relpath((Path(name).parent / basis).resolve(), folder.resolve())
    entry = f"based_on = {json.dumps(from_folder, ensure_ascii=False)}"
    text, count = BASIS.subn(lambda _: entry, text, count=1)
    if not count:
        raise CalibrationError(
            f"sensor file {name}: write based_on = {json.dumps(basis)} on a line of its own"
        )
    return text


def _without_tables(text: str, names: Sequence[str]) -> str:
    """Return a TOML text without some tables.

    Comments before the next header go with the table that they follow.
    """
    kept = []
    skipping = False
    for line in text.splitlines():
        header = HEADER.match(line)
        if header:
            skipping = header[1].replace(" ", "") in names
        if not skipping:
            kept.append(line)
    return "\n".join(kept) + "\n"
