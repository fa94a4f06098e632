"""Synthetic stereo optical CMM: renders a posed platform with stickers, and measures its pose from the images."""

from .camera import PinholeCamera
from .errors import (
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
from .estimator import PoseEstimator, measure_frame
from .faults import FaultGenerator, fault_bodies
from .faulty_images import Fault, FaultyImages
from .images import StereoFrame
from .measurement import Measurement
from .pose import pose_to_transform, transform_to_pose
from .render import require_opengl
from .scene import rod, rod_transform
from .sensor import Sensor, load_sensor
from .sensor_file import built_in_names
from .stereo_rig import StereoRig
from .taught import Taught
from .tracking import Tracker

__all__ = [
    "CmmError", "Fault", "FaultGenerator", "FaultyImages", "LostError", "Measurement", "OpenGLMissingError",
    "PinholeCamera", "PoseEstimator", "Sensor", "SensorFileError", "ShapeError", "StereoFrame", "StereoRig", "Taught",
    "TeachingError", "Tracker", "UnknownBodyError", "UnknownOptionError", "UnknownSensorError", "built_in_names",
    "fault_bodies", "load_sensor", "measure_frame", "pose_to_transform", "require_opengl", "rod", "rod_transform",
    "transform_to_pose",
]
