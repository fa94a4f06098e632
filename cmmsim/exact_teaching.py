"""What teaching would find if it made no error: for studies of the observation noise alone."""

from __future__ import annotations

import numpy as np

from cmmsim.files.marked_body import marked_body
from cmmsim.files.rig import rig_from_file
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import invert
from cmmsim.imaging.scene import placed_stickers
from cmmsim.pose_estimation.taught import Taught
from cmmsim.pose_estimation.taught_setup import setup_of


def exactly_taught(file: SensorFile) -> Taught:
    """The true frames and sticker places of a sensor file's scene, with zero covariances. Raises SensorFileError."""
    _, camera_from_base = rig_from_file(file.rig)
    platform, base = (
        placed_stickers(marked_body(name, section), file.stickers, stream)
        for stream, (name, section) in enumerate((("platform", file.platform), ("base", file.base)))
    )
    return Taught(
        file.name,
        invert(camera_from_base),
        np.zeros((6, 6)),
        platform,
        np.zeros((len(platform), 3, 3)),
        np.zeros((6, 6)),
        base,
        setup_of(file),
    )
