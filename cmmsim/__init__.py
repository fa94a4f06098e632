"""Synthetic stereo optical CMM: renders a posed platform with stickers, and measures its pose from the images.

Sensor
    load_sensor(name_or_path, seed) -> Sensor   built in (`built_in_names() -> list[str]`), or a TOML file
    Sensor.measure(pose) -> Measurement         pose (6,) m, rad and its covariance (6,6); teaches itself on first use
    Sensor.capture(pose) -> StereoFrame         both whole images
    Sensor.teach() -> Taught                    what other sensors with the same cameras and bodies may take over
    require_opengl()                            raises OpenGLMissingError where pyrender cannot draw

Images from elsewhere
    measure_frame(StereoFrame(left, right), sensor.estimator) -> Measurement    of a PoseEstimator
    Tracker(sensor.estimator).measure(images) -> Measurement                    frame after frame

Geometry
    pose_to_transform(pose), transform_to_pose(transform)       poses (6,) and transforms (4,4)
    PinholeCamera, StereoRig                                    cameras with lenses, as in `sensor.rig`
    rod(length, radius), rod_transform(start, end)              a body that may hide stickers, and its place

Faults of images
    FaultGenerator(sensor.estimator).draw(kind, pose, rng) -> Fault
    FaultyImages(images, fault, noise, rng)                     images with a fault laid over them
    fault_bodies()                                              the boxes that stand in the way

Every error that a user can cause is a CmmError, but for OpenGLMissingError. Rooms of their own: `cmmsim.calibration`
and `cmmsim.acceptance`; detectors and renderers of a user's own: `cmmsim.plugins`. Everything else is private.
"""

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
