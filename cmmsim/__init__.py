"""Synthetic stereo optical CMM: renders a posed platform with stickers, and measures its pose from the images."""

from cmmsim.errors import (
    CmmError,
    LostError,
    OpenGLMissingError,
    SensorFileError,
    ShapeError,
    TeachingError,
    UnknownBodyError,
    UnknownOptionError,
    UnknownSensorError,
)
from cmmsim.fault_images import Fault, FaultyImages
from cmmsim.faults import FaultGenerator, fault_bodies
from cmmsim.files.sensor_file import built_in_names
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import pose_to_transform, transform_to_pose
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.pyrender_renderer import require_opengl
from cmmsim.imaging.scene import rod, rod_transform
from cmmsim.pose_estimation.estimator import Measurement, PoseEstimator, measure_frame
from cmmsim.pose_estimation.taught import Taught
from cmmsim.radiometry.images import StereoFrame
from cmmsim.sensor import Sensor, load_sensor
from cmmsim.tracker import Tracker
from cmmsim_command import warn_of_foreign_identify

warn_of_foreign_identify()

__all__ = [
    "CmmError",
    "Fault",
    "FaultGenerator",
    "FaultyImages",
    "LostError",
    "Measurement",
    "OpenGLMissingError",
    "PinholeCamera",
    "PoseEstimator",
    "Sensor",
    "SensorFileError",
    "ShapeError",
    "StereoFrame",
    "StereoRig",
    "Taught",
    "TeachingError",
    "Tracker",
    "UnknownBodyError",
    "UnknownOptionError",
    "UnknownSensorError",
    "built_in_names",
    "fault_bodies",
    "load_sensor",
    "measure_frame",
    "pose_to_transform",
    "require_opengl",
    "rod",
    "rod_transform",
    "transform_to_pose",
]
