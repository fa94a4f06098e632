"""Result of a calibration, as tables of a sensor file, for JSON, and as a completed sensor file."""

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

TABLES = ("rig.left", "rig.right", "rig.right_from_left", "rig.covariance")
HEADER = re.compile(r"^\s*\[+\s*([^\[\]]+?)\s*\]+\s*(#.*)?$")
BASIS = re.compile(r"^[ \t]*based_on[ \t]*=.*$", re.MULTILINE)
# A warning is given if the baselines of the calibration and of the sensor file differ by more than
# this factor.
LARGEST_BASELINE_RATIO = 1.5
# If they differ by more than this factor, the lengths of the board file are certainly not in m. A
# board file in mm gives about 1000, and one in cm about 100.
OTHER_UNIT_RATIO = 30.0


@dataclass(frozen=True)
class UsedView:
    """A used pair of images.

    ``name`` is the name of the pair, ``view`` its index in left_from_boards, and ``rms_px`` the rms
    residual of each used image by side, px.
    """

    name: str
    view: int
    rms_px: dict[str, float]


@dataclass(frozen=True)
class Calibration:
    """Both cameras with their covariance, and the data from which they were calibrated.

    The pixels of ``sightings`` are those of the adjustment, corrected for the eccentricity of dots.
    ``rejected`` maps the name of each pair with an unused image to the reason; the other image can
    be in use. Each of the ``warnings`` is one line.
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
        """Covariance (24, 24) in the order of PARAMETER_NAMES.

        Rows and columns of fixed parameters are zero.
        """
        # the adjustment's covariance is for a small rotation, the parameter is a rotation vector
        jacobian = np.eye(len(PARAMETER_NAMES))
        jacobian[-3:, -3:] = _inverse_left_jacobian(self.rotation_vector)
        return np.asarray(jacobian @ self.adjustment.covariance @ jacobian.T)

    @property
    def known(self) -> KnownRig:
        """The estimated rig with its covariance."""
        return KnownRig(self.rig, self.covariance)

    @property
    def std(self) -> Array:
        """Standard deviations (24,) in the order of PARAMETER_NAMES."""
        return np.sqrt(np.diag(self.covariance))


def _inverse_left_jacobian(vector: Array) -> Array:
    """Return the derivative (3, 3) of a rotation vector (3,) with respect to a small rotation.

    The small rotation multiplies the rotation matrix from the left.

    Source: J. Sola et al., A micro Lie theory for state estimation in robotics (2018), eq. 146.
    """
    angle = float(np.linalg.norm(vector))
    k = skew(vector)
    # at small angles, the general formula divides rounding errors by the angle squared; the series
    # does not
    if angle < 1e-4:
        return np.eye(3) - 0.5 * k + k @ k / 12.0
    return (
        np.eye(3)
        - 0.5 * k
        + (1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))) * k @ k
    )


def rig_tables(calibration: Calibration) -> str:
    """Return the tables of a sensor file with the calibrated cameras and their covariance."""
    state = calibration.adjustment.state
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
        f"translation = {calibration.rig.right_from_left[:3, 3].tolist()}  # m",
        f"rotation_vector = {calibration.rotation_vector.tolist()}  # rad",
        "",
        "[rig.covariance]",
        "matrix = [",
        *(f"    {row.tolist()}," for row in calibration.covariance),
        "]",
    ]
    return "\n".join(lines) + "\n"


def as_dict(calibration: Calibration) -> dict[str, Any]:
    """Return all results of a calibration as a dictionary for JSON."""
    solved = calibration.adjustment
    return {
        "opencv": cv2.__version__,
        "board": calibration.board.model_dump(),
        "image_size_px": [calibration.rig.left.width, calibration.rig.left.height],
        "options": {"distortion": calibration.distortion, "fix_aspect": calibration.fix_aspect},
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
            for name, value, std in zip(
                PARAMETER_NAMES, calibration.values, calibration.std, strict=True
            )
        },
        "covariance": {"names": list(PARAMETER_NAMES), "matrix": calibration.covariance.tolist()},
        "used": [
            {
                "name": view.name,
                "rms_px": view.rms_px,
                "left_from_board_pose": transform_to_pose(
                    solved.state.left_from_boards[view.view]
                ).tolist(),
            }
            for view in calibration.used
        ],
        "rejected": calibration.rejected,
        "warnings": calibration.warnings,
    }


@dataclass(frozen=True)
class SensorTemplate:
    """Text of a sensor file without the tables of its cameras.

    A relative path in ``based_on`` refers to the folder for which ``text`` was made. ``size`` is
    (width, height) of the images, px, and ``baseline`` the distance between the cameras, m, both
    from the original file. ``name`` is the built-in name or the path of that file.
    """

    text: str
    size: tuple[int, int]
    baseline: float
    name: str

    def require_size(self, size: tuple[int, int]) -> None:
        """Raise CalibrationError for images of another size (width, height) px."""
        if size != self.size:
            raise CalibrationError(
                f"the images are {size[0]} x {size[1]} px, but the sensor file {self.name} states "
                f"{self.size[0]} x {self.size[1]} px: use a sensor file of the same cameras"
            )

    def filled(self, calibration: Calibration) -> str:
        """Return the text of the sensor file with the calibrated cameras.

        Raises CalibrationError for images of another size.
        """
        self.require_size((calibration.rig.left.width, calibration.rig.left.height))
        return self.text + rig_tables(calibration)

    def disagreements(self, calibration: Calibration) -> list[str]:
        """Return a warning if the calibrated baseline differs much from that of the sensor file."""
        baseline, ratio = self._compared(calibration)
        if ratio <= LARGEST_BASELINE_RATIO:
            return []
        return [
            f"the calibrated cameras stand {baseline:.4g} m apart, but {self.baseline:.4g} m in "
            f"the sensor file {self.name}: are the lengths of the board file in m, and does the "
            "sensor file describe these cameras?"
        ]

    def wrong_unit(self, calibration: Calibration) -> str:
        """Return why the lengths of the board are certainly not in m; empty if they can be."""
        baseline, ratio = self._compared(calibration)
        if ratio <= OTHER_UNIT_RATIO:
            return ""
        return (
            f"cameras {baseline:.4g} m apart, and {self.baseline:.4g} m in the sensor file "
            f"{self.name}, cannot be the same: give the lengths of the board file in m"
        )

    def _compared(self, calibration: Calibration) -> tuple[float, float]:
        """Return the calibrated baseline, m, and the ratio of the longer of both to the shorter."""
        baseline = float(np.linalg.norm(calibration.rig.right_from_left[:3, 3]))
        return baseline, max(baseline / self.baseline, self.baseline / baseline)


def sensor_template(name: str | Path, folder: str | Path) -> SensorTemplate:
    """Return the template of a sensor file, given by a built-in name or a path.

    The completed file is meant for ``folder``, so a relative path in ``based_on`` is rewritten
    relative to ``folder``. Raises the exceptions of read_sensor_file. Raises CalibrationError if
    the cameras are given as inline tables, or if ``based_on`` cannot be rewritten.
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
            f"sensor file {name} must have [{'], ['.join(TABLES)}] as separate tables: {error}"
        ) from error
    baseline = float(np.linalg.norm(rig_from_file(section)[0].right_from_left[:3, 3]))
    return SensorTemplate(text, (section.width, section.height), baseline, str(name))


def require_sensor(path: str | Path) -> None:
    """Raise SensorFileError if a file does not describe a sensor."""
    rig_from_file(read_sensor_file(path).rig)


def _based_from(text: str, name: str | Path, folder: Path) -> str:
    """Return the text with a relative path in ``based_on`` rewritten relative to ``folder``.

    Raises CalibrationError if ``based_on`` does not stand on a line of its own.
    """
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
    """Return a TOML text without the tables of the given names.

    Comments between such a table and the next header are removed, too.
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
