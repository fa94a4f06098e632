"""Photographs of the built-in sensor, for teaching and measuring: folders of images, whose ground
is not drawn.
"""

import cv2
import numpy as np

import cmmsim
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from cmmsim.radiometry.stereo_images import StereoFrame

SIZE = 40  # px: side of the part around each sticker that is drawn


def spread_poses(count, seed, shift=0.02, turn=0.1):
    home = cmmsim.load_sensor("ctrack780").home
    return home + np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6)) * (
        [shift] * 3 + [turn] * 3
    )


def corners_of_stickers(sensor, pose):
    """First pixels (2, n, 2) of windows about all stickers that both cameras can see."""
    truth, places = sensor.truth, []
    for move, own in (
        (pose_to_transform(pose), truth.platform_places),
        (np.eye(4), truth.base_places),
    ):
        places.append(apply(invert(truth.base_from_camera) @ move, own))
    pixels = sensor.true_cameras.rig.project(np.concatenate(places))[0]
    return np.rint(pixels - 0.5 * (SIZE - 1)).astype(int)


def photographed(sensor, pose, obstacles=None):
    """A frame with the noise of the sensor about its stickers, and even ground elsewhere."""
    corners = corners_of_stickers(sensor, pose)
    windows = sensor.look(pose, obstacles).windows(corners, SIZE)
    camera = sensor.true_cameras.rig.left
    ground = round(sensor.noise.black_level)
    sides = np.full((2, camera.height, camera.width), ground, dtype=windows.dtype)
    for image, at, own in zip(sides, corners, windows, strict=True):
        for (x, y), window in zip(at, own, strict=True):
            image[y : y + SIZE, x : x + SIZE] = window
    return StereoFrame(*sides)


def folders(path, frames, names=None):
    """Folders of left and right images in a path."""
    for side in ("left", "right"):
        (path / side).mkdir(parents=True)
    for k, frame in enumerate(frames):
        name = f"{k:03d}.png" if names is None else names[k]
        for side, image in (("left", frame.left), ("right", frame.right)):
            assert cv2.imwrite(str(path / side / name), image)
    return path / "left", path / "right"
