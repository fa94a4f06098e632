"""Sensors with real lenses and other changes of their file, taught without error; ellipses in
windows; statistics.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

import cmmsim
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from cmmsim.imaging.stereo_camera import SUPERSAMPLING
from cmmsim.radiometry.noise import CameraNoise

CAMERA = PinholeCamera(2300.0, 1023.5, 767.5, 2048, 1536)
NOISE = CameraNoise(
    electrons_at_white=1600.0, gain=0.13, dark_noise=26.0, full_well=1800.0, black_level=16.0
)

LEFT = {
    "focal_px": [2295.0, 2301.5],
    "centre_px": [1017.2, 771.9],
    "distortion": [-0.11, 0.07, 4e-4, -3e-4, 0.0],
}
RIGHT = {"focal_px": [2306.0, 2304.0], "centre_px": [1030.1, 760.4]}
DISTORTED = {
    "rig.left": LEFT,
    "rig.right": RIGHT | {"distortion": [-0.15, 0.05, -6e-4, 5e-4, 0.01]},
}
LENSES = {
    "perfect": {},
    "distorted": DISTORTED,
    "blurred": {"lens.psf_px": 0.5},
    "darkened": {"lens.vignetting": 0.3},
    "all": DISTORTED | {"lens.psf_px": 0.5, "lens.vignetting": 0.3},
}
NOISE_FREE = {"camera.noise": False}
TWELVE_BIT = {"camera.bit_depth": 12, "camera.gain": 2.08, "camera.black_level": 256.0}
CROPPED = {
    "rig.width": 800,
    "rig.height": 640,
    "rig.target": [0.02, 0.0, 0.29],
}  # whole images six times smaller
REACH = np.array([0.009] * 3 + [0.035] * 3)  # m, rad: of the poses


def exact(lens="perfect", changes=None, renderer="analytic", seed=0, method="registration"):
    """The built-in sensor with another lens and other entries of its file, by dotted key; taught
    without error.
    """
    file = read_sensor_file("ctrack780", LENSES[lens] | (changes or {}))
    return cmmsim.Sensor(file, seed, method, cmmsim.Sensor(file).truth, renderer=renderer)


def poses_about_home(sensor, count, seed=0):
    return sensor.home + np.random.default_rng(seed).uniform(-1, 1, (count, 6)) * (
        [0.009] * 3 + [0.03] * 3
    )


def camera_from(sensor, pose):
    """True camera_from_platform (4,4)."""
    return invert(sensor.truth.base_from_camera) @ pose_to_transform(pose)


def placed_at(sensor, pose, *others):
    """Transforms (b,4,4) of platform, base and others, base_from_body (4,4), into the axes of each
    camera.
    """
    bodies = np.stack([pose_to_transform(pose), np.eye(4), *others])
    return [
        move @ invert(sensor.truth.base_from_camera) @ bodies for move in sensor.rig.from_camera
    ]


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


def centre_errors(sensor, pose, supersampling=SUPERSAMPLING, size=16):
    """Fitted minus expected ellipse centres (36, 2) px from unrounded noise-free windows."""
    corners, noise = corners_about(sensor, pose, size), replace(sensor.noise, enabled=False)
    grey = noise.mean_grey(
        sensor.camera.radiances([[placed_at(sensor, pose)]], [corners], size, supersampling)[0]
    )
    grey = replace(sensor.observer, noise=noise).evenly_lit(grey, corners)
    flat, psf_px = corners.reshape(-1, 2), sensor.optics.psf_px
    fits = fit_ellipses(grey.reshape(-1, size, size), flat, noise, size - 2, psf_px=psf_px)
    assert fits.good.all()
    return fits.centres - expected_centres(sensor, pose).reshape(-1, 2)


def pose_errors(sensor, poses, **look):
    """Errors (n, 6) of the poses measured near the true ones, um and urad, and the measurements."""
    found = [
        sensor.estimator.measure(sensor.look(pose, **look), camera_from(sensor, pose))[0]
        for pose in poses
    ]
    return 1e6 * (np.array([m.pose for m in found]) - poses), found


def squares(errors, covariances):
    """Squared errors (...,) in units of their covariances."""
    return np.einsum("...i,...ij,...j->...", errors, np.linalg.inv(covariances), errors)


def squared_error(measured, pose):
    """In units of the stated covariance: chi-square with six degrees of freedom."""
    return squares(measured.pose - pose, measured.covariance)


def squared_errors(found, poses):
    return np.array([squared_error(m, pose) for m, pose in zip(found, poses, strict=True)])


def require_true(squared, freedom=6):
    """The mean of independent chi-square numbers lies where it does but for 27 in 10,000 times
    (three deviations).
    """
    low, high = chi2.ppf([0.00135, 0.99865], freedom * np.size(squared)) / np.size(squared)
    assert low < np.mean(squared) < high, (low, np.mean(squared), high)


def require_regions(squared, freedom=6):
    """The 95 % regions hold as many of independent chi-square numbers as 99 of 100 such series let
    them.
    """
    low, high = binom.interval(0.99, len(squared), 0.95)
    assert low <= np.sum(squared < chi2.ppf(0.95, freedom)) <= high, np.mean(
        squared < chi2.ppf(0.95, freedom)
    )


def refused(call, message, kind=cmmsim.CmmError):
    """What is wrong is said in one short line."""
    with pytest.raises(kind, match=message) as error:
        call()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def random_ellipses(rng, count, size, radii=(3.8, 2.4)):
    """Centres (count, 2) within 1 px of the middle of windows of ``size`` px, and shapes (count, 2,
    2), turned at random."""
    angle = rng.uniform(0.0, np.pi, count)
    turn = np.stack(
        [
            np.stack([np.cos(angle), -np.sin(angle)], -1),
            np.stack([np.sin(angle), np.cos(angle)], -1),
        ],
        1,
    )
    return 0.5 * (size - 1) + rng.uniform(-1.0, 1.0, (count, 2)), turn @ np.diag(
        radii
    ) @ turn.transpose(0, 2, 1)
