"""Images that differ from those that the sensor expects, in 38 kinds: by their light before the
camera's noise is added, by their grey values, or as a pair.
"""

import cv2
import numpy as np

import cmmsim
from tests.cmmsim.deceiving_images import DECEIVING, Shot, between, direction


def filtered(kernel):
    """A change of light by a kernel whose light lies about its middle."""

    def change(shot, light):
        weights = kernel(shot.rng)
        ticks = np.arange(len(weights)) - len(weights) // 2
        weights = np.float32(weights / weights.sum())
        off = np.array([(weights.sum(axis) * ticks).sum() for axis in (0, 1)])
        move = np.float32([[1.0, 0.0, -off[0]], [0.0, 1.0, -off[1]]])
        return [
            cv2.warpAffine(
                cv2.filter2D(part, -1, weights[::-1, ::-1]), move, part.shape[::-1],
                flags=cv2.INTER_CUBIC,
            )
            for part in light
        ]  # fmt: skip

    return change


def _plane():
    ticks = np.arange(-10.0, 11.0)
    return np.meshgrid(ticks, ticks)


def _gauss(rng):
    x, y = _plane()
    return np.exp(-0.5 * (x * x + y * y) / between(rng, 0.15, 1.5) ** 2)


def _disc(rng):
    x, y = _plane()
    return np.clip(between(rng, 0.55, 3.0) + 0.5 - np.hypot(x, y), 0.0, 1.0)


def _oval(rng):
    x, y = _plane()
    angle = rng.uniform(0.0, np.pi)
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    return np.exp(-0.5 * (u / between(rng, 0.2, 1.5)) ** 2 - 0.5 * (v / 0.2) ** 2)


def _line(rng):
    weights = np.zeros((21, 21))
    end = between(rng, 0.1, 5.0) * direction(rng)
    for part in np.linspace(-0.5, 0.5, 41):
        x, y = 10.0 + part * end
        column, row = int(x), int(y)
        for i, j in np.ndindex(2, 2):
            weights[row + j, column + i] += (1 - abs(x - column - i)) * (1 - abs(y - row - j))
    return weights


def _coma(rng):
    """A comet: circles that grow and move away, as in Seidel's third-order coma."""
    weights, towards, length = np.zeros((21, 21)), direction(rng), between(rng, 0.05, 1.5)
    for part in np.linspace(0.05, 1.0, 20):
        for angle in np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False):
            x, y = 10.0 + length * part**2 * (
                2.0 * towards + np.array([np.cos(angle), np.sin(angle)])
            )
            column, row = int(x), int(y)
            for i, j in np.ndindex(2, 2):
                weights[row + j, column + i] += (
                    part * (1 - abs(x - column - i)) * (1 - abs(y - row - j))
                )
    return weights


def glow(shot, light):
    size, share = between(shot.rng, 3.0, 40.0), between(shot.rng, 0.02, 1.0)
    return [part + share * cv2.GaussianBlur(part, (0, 0), size) for part in light]


def haze(shot, light):
    share = shot.rng.uniform(0.02, 0.5)
    return [(1.0 - share) * part + 0.6 * share for part in light]


def lit_from_a_side(shot, light):
    """The light falls off over the whole image, by up to a half."""
    height, width = light[0].shape
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    slope = shot.rng.uniform(0.05, 0.5) * direction(shot.rng)
    return [part * np.float32(1.0 + 0.7 * (slope[0] * x + slope[1] * y)) for part in light]


def double_exposure(shot, light):
    other = shot.light_at(shot.pose + 1e-3 * shot.rng.uniform(-3.0, 3.0, 6))
    share = shot.rng.uniform(0.05, 0.33)
    return [(1.0 - share) * a + share * b for a, b in zip(light, other, strict=True)]


def stale_image(shot, light):
    """One camera still shows an earlier frame."""
    light[shot.rng.integers(2)] = None
    old = shot.light_at(shot.pose - shot.rate / 60.0 * shot.rng.integers(1, 4))
    return [new if new is not None else was for new, was in zip(light, old, strict=True)]


def covered(shot, light):
    x = shot.rng.integers(200, 600)
    light[shot.rng.integers(2)][:, x:] = 0.2
    return light


def dust(shot, light):
    for part in light:
        for _ in range(shot.rng.integers(20, 400)):
            at = shot.rng.integers(0, part.shape[::-1])
            cv2.circle(part, at.tolist(), int(shot.rng.integers(1, 5)), shot.rng.uniform(0, 1), -1)
    return light


def glints(shot, light):
    for part in light:
        y, x = np.mgrid[: part.shape[0], : part.shape[1]]
        for _ in range(shot.rng.integers(1, 6)):
            u, v = shot.rng.uniform(0, part.shape[1]), shot.rng.uniform(0, part.shape[0])
            size = between(shot.rng, 2.0, 40.0)
            part += np.float32(
                shot.rng.uniform(0.1, 2.0) * np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / size**2)
            )
    return light


LIGHT = {
    **{change.__name__: change for change in DECEIVING},
    "blur": filtered(_gauss),
    "defocus": filtered(_disc),
    "astigmatism": filtered(_oval),
    "motion_blur": filtered(_line),
    "coma": filtered(_coma),
    "saturated": lambda shot, light: [shot.rng.uniform(1.02, 1.5) * part for part in light],
    "dark": lambda shot, light: [part * np.float32(shot.gain) for part in light],
    "flicker": lambda shot, light: [light[0], light[1] * np.float32(shot.gain)],
    **{
        change.__name__: change
        for change in (
            *(glow, haze, lit_from_a_side, double_exposure, stale_image, covered, dust, glints),
        )
    },
}


def salt(rng, image):
    spots = rng.random(image.shape) < between(rng, 1e-5, 1e-2)
    return np.where(spots, 255 * (rng.random(image.shape) < 0.5), image)


def jpeg(rng, image):
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(50, 101))])[1]
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


def bleeding(rng, image):
    """Bright columns bleed downwards."""
    kernel = np.exp(-np.arange(60) / rng.uniform(3.0, 30.0))
    grey = image.astype(float)
    return grey + between(rng, 0.005, 0.2) * cv2.filter2D(
        grey, -1, kernel[::-1, None], anchor=(0, 59)
    )


def interlaced(rng, image):
    moved = image.copy()
    moved[1::2] = np.roll(image[1::2], int(rng.choice([-2, -1, 1, 2])), axis=1)
    return moved


def sharpened(rng, image):
    grey = image.astype(float)
    return grey + rng.uniform(0.2, 2.0) * (grey - cv2.GaussianBlur(grey, (0, 0), 1.2))


def coarse(rng, image):
    step = int(rng.choice([4, 8, 16, 32]))
    return image // step * step + step // 2


GREY = {
    "noise": lambda rng, image: image + between(rng, 0.5, 15.0) * rng.standard_normal(image.shape),
    "salt": salt,
    "jpeg": jpeg,
    "gamma": lambda rng, image: 255.0 * (image / 255.0) ** between(rng, 0.6, 1.6),
    "stripes": lambda rng, image: image + between(rng, 0.5, 15.0) * rng.standard_normal(image.shape[1]),
    "coarse": coarse,
    "sharpened": sharpened,
    "median": lambda rng, image: cv2.medianBlur(image, int(rng.choice([3, 5]))),
    "bleeding": bleeding,
    "interlaced": interlaced,
}  # fmt: skip


def torn(shot, pair):
    """The lower part of one image or of both, with less than half of the stickers, is older."""
    old = shot.studio.exposed(shot.light_at(shot.pose - shot.rate / 60.0), shot.rng)
    for side in shot.rng.choice(2, shot.rng.integers(1, 3), replace=False):
        rows = np.sort(shot.usual[0][side][:, 1])
        row = int(shot.rng.uniform(rows[9], rows[-1]))
        pair[side][row:] = old[side][row:]
    return pair


PAIRS = {
    "tearing": torn,
    "exchanged": lambda shot, pair: pair[::-1],
    "flipped_left_right": lambda shot, pair: [image[:, ::-1] for image in pair],
    "flipped_up_down": lambda shot, pair: [image[::-1] for image in pair],
}
KINDS = (*LIGHT, *GREY, *PAIRS)


def changed(studio, kind, pose, rate, rng):
    """A frame of one of the KINDS, or a clean one."""
    shot = Shot(studio, pose, rate, rng)
    shot.gain = rng.uniform(0.15, 0.9)
    light = studio.light(pose)
    if kind in LIGHT:
        light = LIGHT[kind](shot, light)
    pair = studio.exposed(light, rng)
    if kind in GREY:
        pair = [np.uint8(np.clip(np.rint(GREY[kind](rng, one)), 0, 255)) for one in pair]
    if kind in PAIRS:
        pair = PAIRS[kind](shot, pair)
    return cmmsim.StereoFrame(*(np.ascontiguousarray(image) for image in pair))
