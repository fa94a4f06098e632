"""Calibration of the stereo rig from pictures of a board, rendered or photographed.

The calibration reads the description of the board, pairs the image files, and finds the board in
each image. OpenCV's calibration gives start values. One joint adjustment of both cameras gives the
rig and its covariance.
"""

from cmmsim.calibration.board import Board, read_board
from cmmsim.calibration.board_detection import BoardView, find_board
from cmmsim.calibration.calibrate import CalibrationOptions, calibrate
from cmmsim.calibration.calibrated_rig import (
    Calibration,
    SensorTemplate,
    as_dict,
    require_sensor,
    rig_tables,
    sensor_template,
)
from cmmsim.calibration.halves import Halves, compare_halves
from cmmsim.calibration.rendered_boards import board_poses, default_board, render_pairs
from cmmsim.calibration.sightings import PairView, read_grey, view_pairs
from cmmsim.errors import CalibrationError
from cmmsim.files.image_files import ImagePair, pair_images
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES

__all__ = [
    "PARAMETER_NAMES",
    "Board",
    "BoardView",
    "Calibration",
    "CalibrationError",
    "CalibrationOptions",
    "Halves",
    "ImagePair",
    "PairView",
    "SensorTemplate",
    "as_dict",
    "board_poses",
    "calibrate",
    "compare_halves",
    "default_board",
    "find_board",
    "pair_images",
    "read_board",
    "read_grey",
    "render_pairs",
    "require_sensor",
    "rig_tables",
    "sensor_template",
    "view_pairs",
]
