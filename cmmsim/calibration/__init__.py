"""Calibration of the stereo rig from pictures of a board: rendered ones, or real photographs.

The way: a board description, pairs of image files, the board in each image, OpenCV's calibration as a start, one joint
adjustment of both cameras with its covariance.
"""

from cmmsim.calibration.board import Board, read_board
from cmmsim.calibration.board_detection import BoardView, find_board
from cmmsim.calibration.board_poses import board_poses, default_board
from cmmsim.calibration.calibrate import CalibrationOptions, calibrate
from cmmsim.calibration.calibration import PARAMETER_NAMES, Calibration
from cmmsim.calibration.intrinsics import DISTORTIONS
from cmmsim.calibration.photographs import ImagePair, pair_images, read_grey
from cmmsim.calibration.rendering import render_pairs
from cmmsim.calibration.result_text import as_dict, rig_tables
from cmmsim.calibration.sensor_template import SensorTemplate, require_sensor, sensor_template
from cmmsim.calibration.sightings import PairView
from cmmsim.calibration.views_of_images import view_pairs
from cmmsim.calibration_errors import CalibrationError

__all__ = [
    "DISTORTIONS",
    "PARAMETER_NAMES",
    "Board",
    "BoardView",
    "Calibration",
    "CalibrationError",
    "CalibrationOptions",
    "ImagePair",
    "PairView",
    "SensorTemplate",
    "as_dict",
    "board_poses",
    "calibrate",
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
