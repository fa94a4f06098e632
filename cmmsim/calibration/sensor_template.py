"""A sensor file whose cameras a calibration replaces."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cmmsim.calibration.calibration import Calibration
from cmmsim.calibration.result_text import rig_tables
from cmmsim.calibration_errors import CalibrationError
from cmmsim.files.rig import rig_from_file
from cmmsim.files.sensor_file import built_in_names, read_sensor_file, sensor_text

TABLES = ("rig.left", "rig.right", "rig.right_from_left")
HEADER = re.compile(r"^\s*\[+\s*([^\[\]]+?)\s*\]+\s*(#.*)?$")
LARGEST_RATIO = 1.5  # of the baselines of calibration and sensor file, one over the other
BASIS = re.compile(r"^\s*based_on\s*=.*$")


@dataclass(frozen=True)
class SensorTemplate:
    """text: the sensor file without its calibrated cameras, as it may stand in the folder it was made for; size (width,
    height) px of its images; baseline m between its cameras; name or path of it."""

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
        """Text of the sensor file with the calibrated cameras. Raises CalibrationError for images of another size."""
        self.require_size((found.rig.left.width, found.rig.left.height))
        return self.text + rig_tables(found)

    def disagreements(self, found: Calibration) -> list[str]:
        """One line where the calibrated baseline is far from the sensor file's."""
        baseline = float(np.linalg.norm(found.rig.right_from_left[:3, 3]))
        if max(baseline / self.baseline, self.baseline / baseline) <= LARGEST_RATIO:
            return []
        return [
            f"the cameras stand {baseline:.4g} m apart, those of the sensor file {self.name} {self.baseline:.4g} "
            "m: are the lengths of the board file in m, and is it the file of these cameras?"
        ]


def sensor_template(name: str | Path, folder: str | Path) -> SensorTemplate:
    """The sensor file of a built-in name or a path, to be filled and written into ``folder``.

    A file beside the sensor file that it is based on is named as seen from the folder. Raises what read_sensor_file
    raises, and CalibrationError where the cameras stand in inline tables.
    """
    section = read_sensor_file(name).rig
    text = _without_tables(_based_from(sensor_text(name), name, Path(folder)), TABLES).rstrip() + "\n\n"
    try:
        tomllib.loads(text + "".join(f"[{table}]\n" for table in TABLES))
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(
            f"sensor file {name} must hold {', '.join(TABLES)} as tables of their own: {error}"
        ) from error
    baseline = float(np.linalg.norm(rig_from_file(section)[0].right_from_left[:3, 3]))
    return SensorTemplate(text, (section.width, section.height), baseline, str(name))


def require_sensor(path: str | Path) -> None:
    """Raise SensorFileError where a file describes no sensor, such as one whose right camera stands on the left."""
    rig_from_file(read_sensor_file(path).rig)


def _based_from(text: str, name: str | Path, folder: Path) -> str:
    """The text whose based_on, where it is a file, names that file from ``folder``."""
    basis = tomllib.loads(text).get("based_on")
    if basis is None or basis in built_in_names() or Path(basis).is_absolute():
        return text
    from_folder = os.path.relpath((Path(name).parent / basis).resolve(), folder.resolve())
    lines = text.splitlines()
    place = next((k for k, line in enumerate(lines) if BASIS.match(line)), None)
    if place is None:
        raise CalibrationError(f"sensor file {name}: write based_on = {json.dumps(basis)} on a line of its own")
    lines[place] = f"based_on = {json.dumps(from_folder, ensure_ascii=False)}"
    return "\n".join(lines) + "\n"


def _without_tables(text: str, names: Sequence[str]) -> str:
    """TOML text without some tables; comments before the next header go with the table they follow."""
    kept, skipping = [], False
    for line in text.splitlines():
        header = HEADER.match(line)
        if header:
            skipping = header[1].replace(" ", "") in names
        if not skipping:
            kept.append(line)
    return "\n".join(kept) + "\n"
