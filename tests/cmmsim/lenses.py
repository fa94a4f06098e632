"""Sensors with real lenses for the tests: their files, and a teaching without any error."""

import numpy as np

import cmmsim
from cmmsim.files.sensor_file import sensor_text
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import apply, pose_to_transform

CAMERAS = """
[rig.left]
focal_px = [2295.0, 2301.5]
centre_px = [1017.2, 771.9]
distortion = [-0.11, 0.07, 4e-4, -3e-4, 0.0]
[rig.right]
focal_px = [2306.0, 2304.0]
centre_px = [1030.1, 760.4]
"""
DISTORTED = CAMERAS + "distortion = [-0.15, 0.05, -6e-4, 5e-4, 0.01]\n"
LENSES = {
    "perfect": "",
    "distorted": DISTORTED,
    "blurred": "[lens]\npsf_px = 0.5\n",
    "darkened": "[lens]\nvignetting = 0.3\n",
    "all": DISTORTED + "[lens]\npsf_px = 0.5\nvignetting = 0.3\n",
}


def lens_sensor(folder, lens="perfect", renderer="analytic", seed=0, changes=()):
    """A ctrack780 with another lens, and other changes of its file; taught without error."""
    text = sensor_text("ctrack780") + LENSES[lens]
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "sensor.toml"
    path.write_text(text, encoding="utf-8")
    sensor = cmmsim.load_sensor(path, seed=seed, renderer=renderer)
    return cmmsim.load_sensor(path, seed=seed, renderer=renderer, taught=perfectly_taught(sensor))


def perfectly_taught(sensor):
    """What a teaching without error would find."""
    places = sensor._scene[0].sticker_places
    zero = np.zeros((6, 6))
    return cmmsim.Taught(
        sensor.name,
        np.linalg.inv(sensor._camera_from_base),
        zero,
        places.copy(),
        np.zeros((len(places), 3, 3)),
        zero,
        sensor._scene[1].sticker_places.copy(),
    )


def poses_about_home(sensor, count, seed=0):
    return sensor.home + np.random.default_rng(seed).uniform(-1, 1, (count, 6)) * ([0.009] * 3 + [0.03] * 3)


def placed_at(sensor, pose):
    moves = [m @ sensor._camera_from_base for m in sensor.rig.from_camera]
    return [np.stack([move @ pose_to_transform(pose), move]) for move in moves]


def expected_centres(sensor, pose):
    """Centres (2, n, 2) px of the ellipses in the image, from the true sticker places."""
    centres = []
    for camera, bodies in zip(sensor.rig.cameras, placed_at(sensor, pose), strict=True):
        points = apply(bodies[0], sensor._scene[0].sticker_places)
        normals = sensor.platform.sticker_normals @ bodies[0, :3, :3].T
        centres.append(camera.project(points)[0] + centre_offset(camera, points, normals, 0.003))
    return np.stack(centres)


def pose_errors(sensor, poses, **look):
    """Errors (n, 6) of the poses measured near the true ones, um and urad, and the measurements."""
    found = [
        sensor.estimator.measure(sensor.look(pose, **look), sensor._camera_from_base @ pose_to_transform(pose))[0]
        for pose in poses
    ]
    return 1e6 * (np.array([m.pose for m in found]) - poses), found
