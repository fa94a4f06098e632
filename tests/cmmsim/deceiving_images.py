"""Changes of the light of a scene that deceive an estimator: they move all stickers alike.

A frame is drawn without noise. Its light is changed, then the camera's noise is added, then the
grey values are changed. Changes of light that belong to stickers are drawn with each sticker's own
ellipse. Sizes of changes are drawn from a range that begins where a change does no harm.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

import cmmsim
from cmmsim.geometry.disc_image import coverage, sticker_outlines
from cmmsim.geometry.pose import invert, pose_to_transform
from tests.cmmsim.sensors import CROPPED, NOISE_FREE, exact, poses_about_home

RADIUS = 0.003
STICKER, RING = 228.0 / 255.0, 8.0 / 255.0
WINDOW = 28  # px, about a sticker
FINE = (
    CROPPED
    | NOISE_FREE
    | {
        "camera.bit_depth": 16,
        "camera.electrons_at_white": 30_000.0,
        "camera.full_well": 60_000.0,
        "camera.gain": 1.0,
    }
)
RATES = np.array([0.05] * 3 + [0.2] * 3)  # m/s, rad/s: largest
RIM = 50e-6  # m, thickness of a sticker with a white rim
UNEVEN = 0.1  # rms of the brightness of an uneven print, relative


def between(rng, low, high):
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def direction(rng, size=2):
    vector = rng.standard_normal(size)
    return vector / np.linalg.norm(vector)


class Studio:
    """A sensor that was taught exactly, and the light of its scene at some poses.

    The scene is drawn once at each pose, because that takes longer than a measurement.
    """

    def __init__(self, count=24):
        self.sensor = exact("perfect", CROPPED)
        self.truth = self.sensor.truth
        self.poses = poses_about_home(self.sensor, count, seed=11)
        fine = exact("perfect", FINE)
        self._light = {}
        self._trackers = {}
        for pose in self.poses:
            frame = fine.capture(pose)
            self._light[pose.tobytes()] = [
                np.float32((image - fine.noise.black_level) / fine.noise.electrons_at_white)
                for image in (frame.left.astype(float), frame.right.astype(float))
            ]

    def light(self, pose):
        """Radiances (2, h, w) of both images at one of the poses."""
        return [part.copy() for part in self._light[pose.tobytes()]]

    def tracker_at(self, pose):
        """A tracker that has measured one of the poses."""
        tracker = self._trackers.get(pose.tobytes())
        if tracker is None:
            tracker = self._trackers[pose.tobytes()] = cmmsim.Tracker(self.sensor.estimator)
            assert tracker.measure(self.sensor.look(pose)).ok
        return tracker

    def exposed(self, light, rng, noise=None):
        noise = noise or self.sensor.noise
        return [noise.expose(np.ascontiguousarray(np.float32(part)), rng) for part in light]


@dataclass
class Shot:
    """One changed frame of a platform at ``pose``, which moves at ``rate``."""

    studio: Studio
    pose: np.ndarray
    rate: np.ndarray
    rng: np.random.Generator

    def outlines(self, pose=None, shifts=0.0):
        """Centres (2, n, 2) and shapes (2, n, 2, 2) of stickers moved by ``shifts`` (n, 3) m."""
        pose = self.pose if pose is None else pose
        move = invert(self.studio.truth.base_from_camera) @ np.array(
            [pose_to_transform(one) for one in np.atleast_2d(pose)]
        )
        return sticker_outlines(
            self.studio.sensor.rig,
            move if np.ndim(pose) > 1 else move[0],
            self.studio.truth.platform_places + shifts,
            self.studio.sensor.platform.sticker_normals,
            RADIUS,
        )

    @cached_property
    def normals(self):
        return self.studio.sensor.platform.sticker_normals

    @cached_property
    def usual(self):
        return self.outlines()

    def each(self, light):
        """Side, sticker, window of ``light``, and places (h, w, 2) in it in units of the ellipse."""
        centres, shapes = self.usual
        grid = np.stack(np.meshgrid(np.arange(WINDOW), np.arange(WINDOW)), -1)
        for side, image in enumerate(light):
            for k, centre in enumerate(centres[side]):
                x, y = np.rint(centre - 0.5 * (WINDOW - 1)).astype(int)
                window = image[max(y, 0) : y + WINDOW, max(x, 0) : x + WINDOW]
                if window.shape == (WINDOW, WINDOW):
                    at = (grid + np.array([x, y]) - centre) @ np.linalg.inv(shapes[side, k]).T
                    yield side, k, np.array([x, y]), window, at

    def light_at(self, pose):
        """Radiances of both images at a pose near this one."""
        light = self.studio.light(self.pose)
        return self.redrawn(light, *self.outlines(pose), np.ones(18, dtype=bool))

    def redrawn(self, light, centres, shapes, which):
        """Draw stickers ``which`` (n,) anew, with other ellipses; without ellipses, leave them out."""
        for side, k, corner, window, at in self.each(light):
            if which[k]:
                window[np.linalg.norm(at, axis=-1) < 1.6] = RING
                if centres is not None:
                    ellipse = (centres[side, k] - corner)[None], shapes[side, k][None]
                    window += (STICKER - window) * coverage(*ellipse, WINDOW)[0][0]
        return light


def light_across(shot, light):
    """Brightness rises across each sticker: in one direction, by planes, or each in its own."""
    rng, size = shot.rng, between(shot.rng, 0.01, 0.35)
    kind = rng.integers(3)
    slopes = np.array([[direction(rng) for _ in range(18)] for _ in range(2)])
    if kind == 0:
        slopes[:] = slopes[:, :1] if rng.random() < 0.5 else slopes[:1, :1]
    elif kind == 1:
        slopes = slopes[:, shot.studio.sensor.platform.plane_index]
    for side, k, _, window, at in shot.each(light):
        near = np.linalg.norm(at, axis=-1) < 2.6
        window *= np.where(near, np.clip(1.0 + size * at @ slopes[side, k], 0.0, None), 1.0)
    return light


def slipped(shot, light):
    """A group of up to two thirds of the stickers has moved as one, by 20 um to 2 mm."""
    rng, planes = shot.rng, shot.studio.sensor.platform.plane_index
    group = np.isin(planes, rng.choice(3, rng.integers(1, 3), replace=False))
    if rng.random() < 0.5:
        group = np.isin(np.arange(18), rng.choice(18, rng.integers(3, 13), replace=False))
    shift = between(rng, 20e-6, 2e-3) * direction(rng, 3)
    return shot.redrawn(light, *shot.outlines(shifts=shift * group[:, None]), group)


def few_left(shot, light):
    """Four to nine stickers are left, and each is off on its own, in space or in each image."""
    rng = shot.rng
    gone = ~np.isin(np.arange(18), rng.choice(18, rng.integers(4, 10), replace=False))
    size = between(rng, 10e-6, 500e-6)
    light = shot.redrawn(light, None, None, gone)
    if rng.random() < 0.5:
        return shot.redrawn(
            light, *shot.outlines(shifts=size * rng.standard_normal((18, 3))), ~gone
        )
    centres, shapes = shot.usual
    moved = centres + size / 0.8e-3 * rng.standard_normal(centres.shape)
    return shot.redrawn(light, moved, shapes, ~gone)


def ghost(shot, light):
    """A fainter copy of the image lies beside it, as from a reflection in the lens."""
    rng, share = shot.rng, between(shot.rng, 0.01, 0.4)
    same = rng.random() < 0.5
    for side in range(2):
        if side == 0 or not same:
            offset = np.rint(rng.uniform(3.0, 10.0) * direction(rng)).astype(int)
        light[side] = light[side] + share * np.roll(light[side], offset, (1, 0))
    return light


def rolling_shutter(shot, light):
    """Rows are exposed one after another, 2 to 30 us each; the pose is that at the middle row."""
    delay = between(shot.rng, 2e-6, 30e-6)
    centres = shot.usual[0]
    late = delay * (centres[..., 1] - 0.5 * light[0].shape[0])
    found = [shot.outlines(shot.pose + late[side][:, None] * shot.rate) for side in range(2)]
    return shot.redrawn(
        light,
        np.stack([found[side][0][side] for side in range(2)]),
        np.stack([found[side][1][side] for side in range(2)]),
        np.ones(18, dtype=bool),
    )


def not_at_once(shot, light):
    """The right camera exposes 50 us to 5 ms after the left one."""
    later = shot.pose + between(shot.rng, 50e-6, 5e-3) * shot.rate
    return [light[0], shot.light_at(later)[1]]


def white_rim(shot, light):
    """Stickers are as thick as RIM, with a white rim; their upper faces are where they should."""
    steps = [shot.outlines(shifts=-RIM * part * shot.normals) for part in (0.25, 0.5, 0.75, 1.0)]
    for side, k, corner, window, _ in shot.each(light):
        for centres, shapes in steps:
            ellipse = (centres[side, k] - corner)[None], shapes[side, k][None]
            np.maximum(
                window, RING + (STICKER - RING) * coverage(*ellipse, WINDOW)[0][0], out=window
            )
    return light


def uneven_print(shot, light):
    """Each sticker's brightness varies over it by up to UNEVEN, alike in all frames."""
    weights = np.random.default_rng(7).standard_normal((18, 5))
    size = between(shot.rng, 0.1 * UNEVEN, UNEVEN)
    for _, k, _, window, at in shot.each(light):
        x, y = at[..., 0], at[..., 1]
        parts = np.stack([2.0 * x, 2.0 * y, 4.9 * x * y, 2.45 * (x * x - y * y),
                          3.46 * (x * x + y * y - 0.5)]) / np.sqrt(5.0)  # fmt: skip
        change = 1.0 + size * np.tensordot(weights[k], parts, 1)
        inside = np.linalg.norm(at, axis=-1) < 1.3
        window[inside] = RING + (window[inside] - RING) * np.clip(change[inside], 0.0, None)
    return light


DECEIVING = (
    light_across,
    slipped,
    few_left,
    ghost,
    rolling_shutter,
    not_at_once,
    white_rim,
    uneven_print,
)
