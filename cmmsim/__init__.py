"""Synthetic stereo optical CMM: it renders a posed platform with stickers and measures its pose.

Sensor
    load_sensor(name_or_path, seed)    -> Sensor, built in (`built_in_names()`) or from a TOML file
    Sensor.measure(pose)               -> Measurement: pose (6,) m, rad and its covariance (6, 6)
    Sensor.measure_many(poses)         -> MeasuredPoses of many frames at once
    Sensor.capture(pose)               -> StereoFrame: both whole images
    Sensor.teach()                     -> Taught, for `load_sensor` with the same cameras and bodies
    require_opengl()                   raises OpenGLMissingError if pyrender cannot draw

Images from other sources
    measure_frame(StereoFrame(left, right), sensor.estimator)  -> Measurement
    Tracker(sensor.estimator).measure(images)                  -> Measurement of successive frames
    teach(left, right, "mine.toml")            -> PhotographedTeaching from folders or videos
    measure(left, right, "mine.toml", taught)  -> MeasuredPair of each pair of photographs
    read_taught("taught.json")                 -> Taught, from the file of a teaching

Cameras that drift
    Sensor.drift_rig({"right.cx_px": 0.1}, frames)  moves the true rig, not the estimator's rig
    Sensor.watch_drift()                            -> DriftWatch; its `finding` names a movement

Geometry
    pose_to_transform(pose), transform_to_pose(transform)  poses (6,) and transforms (4, 4)
    PinholeCamera, StereoRig                               cameras with lenses, as in `sensor.rig`
    rod(length, radius), rod_transform(start, end)         a body that can hide stickers

Faults of images
    FaultGenerator(sensor.estimator).draw(kind, pose, rng)  -> Fault
    FaultyImages(images, fault, noise, rng)                 images with a fault laid over them
    fault_bodies()                                          boxes that hide stickers

Every exception that a user can cause is a CmmError, except OpenGLMissingError. The packages
`cmmsim.calibration` and `cmmsim.acceptance` are public as well. Users can write their own detectors
and renderers: `allow_plugin(module)` allows a user's module to run. Everything else is private.

Names are imported on first use, because the command `cmmsim` begins in this package and must not
wait for OpenCV and OpenGL.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cmmsim.errors import (
    CmmError,
    LostError,
    OpenGLMissingError,
    PhotographError,
    SensorFileError,
    ShapeError,
    TeachingError,
    UnknownBodyError,
    UnknownOptionError,
    UnknownSensorError,
)
from cmmsim.foreign_identify import warn_of_foreign_identify

if TYPE_CHECKING:
    from cmmsim.allowed_plugins import allow_plugin as allow_plugin
    from cmmsim.fault_images import Fault as Fault
    from cmmsim.fault_images import FaultyImages as FaultyImages
    from cmmsim.faults import FaultGenerator as FaultGenerator
    from cmmsim.faults import fault_bodies as fault_bodies
    from cmmsim.files.sensor_file import built_in_names as built_in_names
    from cmmsim.from_photographs import measure as measure
    from cmmsim.from_photographs import teach as teach
    from cmmsim.geometry.camera import PinholeCamera as PinholeCamera
    from cmmsim.geometry.pose import pose_to_transform as pose_to_transform
    from cmmsim.geometry.pose import transform_to_pose as transform_to_pose
    from cmmsim.geometry.stereo_rig import StereoRig as StereoRig
    from cmmsim.imaging.pyrender_renderer import require_opengl as require_opengl
    from cmmsim.imaging.scene_bodies import rod as rod
    from cmmsim.imaging.scene_bodies import rod_transform as rod_transform
    from cmmsim.loading import load_sensor as load_sensor
    from cmmsim.measuring.measurement import Measurement as Measurement
    from cmmsim.measuring.pose_estimator import PoseEstimator as PoseEstimator
    from cmmsim.measuring.pose_estimator import measure_frame as measure_frame
    from cmmsim.measuring.taught import Taught as Taught
    from cmmsim.photographs.measuring import MeasuredPair as MeasuredPair
    from cmmsim.photographs.photographed_teaching import (
        PhotographedTeaching as PhotographedTeaching,
    )
    from cmmsim.photographs.taught_file import read_taught as read_taught
    from cmmsim.radiometry.stereo_images import StereoFrame as StereoFrame
    from cmmsim.sensor import Sensor as Sensor
    from cmmsim.tracker import Tracker as Tracker
    from cmmsim.uncertainty.drift_watch import DriftWatch as DriftWatch

_HOME = {
    "load_sensor": "cmmsim.loading",
    "Sensor": "cmmsim.sensor",
    "built_in_names": "cmmsim.files.sensor_file",
    "Measurement": "cmmsim.measuring.measurement",
    "StereoFrame": "cmmsim.radiometry.stereo_images",
    "Taught": "cmmsim.measuring.taught",
    "require_opengl": "cmmsim.imaging.pyrender_renderer",
    **dict.fromkeys(("teach", "measure"), "cmmsim.from_photographs"),
    "read_taught": "cmmsim.photographs.taught_file",
    "PhotographedTeaching": "cmmsim.photographs.photographed_teaching",
    "MeasuredPair": "cmmsim.photographs.measuring",
    **dict.fromkeys(("measure_frame", "PoseEstimator"), "cmmsim.measuring.pose_estimator"),
    "Tracker": "cmmsim.tracker",
    "DriftWatch": "cmmsim.uncertainty.drift_watch",
    **dict.fromkeys(("pose_to_transform", "transform_to_pose"), "cmmsim.geometry.pose"),
    "PinholeCamera": "cmmsim.geometry.camera",
    "StereoRig": "cmmsim.geometry.stereo_rig",
    **dict.fromkeys(("rod", "rod_transform"), "cmmsim.imaging.scene_bodies"),
    "FaultGenerator": "cmmsim.faults",
    **dict.fromkeys(("Fault", "FaultyImages"), "cmmsim.fault_images"),
    "fault_bodies": "cmmsim.faults",
    "allow_plugin": "cmmsim.allowed_plugins",
}

__all__ = [
    "CmmError",
    "LostError",
    "OpenGLMissingError",
    "PhotographError",
    "SensorFileError",
    "ShapeError",
    "TeachingError",
    "UnknownBodyError",
    "UnknownOptionError",
    "UnknownSensorError",
    *_HOME,
]

# Hidden from type checkers, which would otherwise accept any name of this module.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(
                f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}"
            )
        warn_of_foreign_identify()
        return getattr(import_module(_HOME[name]), name)

    def __dir__() -> list[str]:
        return [*__all__, *(name for name in globals() if name.startswith("__"))]
