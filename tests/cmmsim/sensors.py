"""Sensors for the tests: with real lenses and other changes of their file, taught without any error."""

import numpy as np

import cmmsim
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import apply, invert, pose_to_transform

LEFT = {"focal_px": [2295.0, 2301.5], "centre_px": [1017.2, 771.9], "distortion": [-0.11, 0.07, 4e-4, -3e-4, 0.0]}
RIGHT = {"focal_px": [2306.0, 2304.0], "centre_px": [1030.1, 760.4]}
DISTORTED = {"rig.left": LEFT, "rig.right": RIGHT | {"distortion": [-0.15, 0.05, -6e-4, 5e-4, 0.01]}}
LENSES = {
    "perfect": {},
    "distorted": DISTORTED,
    "blurred": {"lens.psf_px": 0.5},
    "darkened": {"lens.vignetting": 0.3},
    "all": DISTORTED | {"lens.psf_px": 0.5, "lens.vignetting": 0.3},
}
NOISE_FREE = {"camera.noise": False}
TWELVE_BIT = {"camera.bit_depth": 12, "camera.gain": 2.08, "camera.black_level": 256.0}
CROPPED = {"rig.width": 800, "rig.height": 640, "rig.target": [0.02, 0.0, 0.29]}  # whole images six times smaller


def exact(lens="perfect", changes=None, renderer="analytic", seed=0, method="registration"):
    """The built-in sensor with another lens and other entries of its file, by dotted key; taught without error."""
    file = read_sensor_file("ctrack780", LENSES[lens] | (changes or {}))
    return cmmsim.Sensor(file, seed, method, cmmsim.Sensor(file).truth, renderer=renderer)


def poses_about_home(sensor, count, seed=0):
    return sensor.home + np.random.default_rng(seed).uniform(-1, 1, (count, 6)) * ([0.009] * 3 + [0.03] * 3)


def camera_from(sensor, pose):
    """True camera_from_platform (4,4)."""
    return invert(sensor.truth.base_from_camera) @ pose_to_transform(pose)


def placed_at(sensor, pose, *others):
    """Transforms (b,4,4) of platform, base and others, base_from_body (4,4), into the axes of each camera."""
    bodies = np.stack([pose_to_transform(pose), np.eye(4), *others])
    return [move @ invert(sensor.truth.base_from_camera) @ bodies for move in sensor.rig.from_camera]


def expected_centres(sensor, pose):
    """Centres (2, n, 2) px of the ellipses in the image, from the true sticker places."""
    centres, places = [], sensor.truth.platform_places
    for camera, bodies in zip(sensor.rig.cameras, placed_at(sensor, pose), strict=True):
        points = apply(bodies[0], places)
        normals = sensor.platform.sticker_normals @ bodies[0, :3, :3].T
        centres.append(camera.project(points)[0] + centre_offset(camera, points, normals, 0.003))
    return np.stack(centres)


def corners_about(sensor, pose, size):
    """First pixels (2, n, 2) of windows about the stickers of the platform."""
    return np.rint(expected_centres(sensor, pose) - 0.5 * (size - 1)).astype(int)


def pose_errors(sensor, poses, **look):
    """Errors (n, 6) of the poses measured near the true ones, um and urad, and the measurements."""
    found = [sensor.estimator.measure(sensor.look(pose, **look), camera_from(sensor, pose))[0] for pose in poses]
    return 1e6 * (np.array([m.pose for m in found]) - poses), found


def squared_error(measured, pose):
    """In units of the stated covariance: chi-square with six degrees of freedom."""
    error = measured.pose - pose
    return error @ np.linalg.solve(measured.covariance, error)


def squared_errors(found, poses):
    return np.array([squared_error(m, pose) for m, pose in zip(found, poses, strict=True)])
