"""Compiled test of the residuals of a fit for a warp, a smooth displacement of all stickers.

A warp has two causes: cameras or rows of pixels are exposed at different times during a movement,
or a lens has changed. A part of the displacement looks like a movement and is an error of the pose.
The rest strains the pattern of the stickers, or separates the two rays of each sticker by a
distance that varies linearly with its place. Ten such shapes are fitted to the residuals together.
Residuals of single stickers do not reveal a warp, because a pose is some ten times more accurate
than the place of a sticker.
"""

from __future__ import annotations

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, pose_slopes, weigh
from cmmsim.geometry.matrix_kernels import factorise, solve_factored

# Numbers of strains of the pattern, and of shapes of the distance between the rays: a constant, and
# a slope along each axis.
STRAINS = 6
RAY_SHAPES = 4
SHAPES = STRAINS + RAY_SHAPES
# Inverse squares of the largest strain, and of the largest slope of the rays' distance, in standard
# deviations per metre. They keep the matrices regular if the stickers do not determine a shape, for
# example because all of them lie on one plane.
KNOWN_STRAIN = 1e6
KNOWN_PARTING = 1e-6
# Relative increase of the diagonal of a matrix that can be singular.
REGULAR = 1e-9


@compiled
def warp(
    used: Array, arms: Array, gaps: Array, informations: Array, rays: Array, covariance: Array
) -> float:
    """Return the squared size of the warp of the used stickers, in units of its noise.

    The stickers have arms (n, 3), gaps (n, 3), inverse covariances ``informations`` (n, 3, 3) and
    rays (n,), see ``ObservedStickers``. ``covariance`` (6, 6) is that of the fitted pose. Noise
    alone gives about a chi-square number with SHAPES degrees of freedom.
    """
    shapes = np.zeros((3, STRAINS))
    weighted = np.empty((3, STRAINS))
    by_pose = np.zeros((6, STRAINS))
    strains = np.zeros((STRAINS, STRAINS))
    strain = np.zeros(STRAINS)
    partings = np.zeros((RAY_SHAPES, RAY_SHAPES))
    parting = np.zeros(RAY_SHAPES)
    linear = np.ones(RAY_SHAPES)
    for n in range(len(used)):
        if not used[n]:
            continue
        x, y, z = arms[n]
        shapes[0, 0] = shapes[1, 1] = shapes[2, 2] = x
        shapes[0, 1] = shapes[1, 3] = shapes[2, 4] = y
        shapes[0, 2] = shapes[1, 4] = shapes[2, 5] = z
        linear[1:] = arms[n]
        for a in range(STRAINS):
            for i in range(3):
                weighted[i, a] = 0.0
                for j in range(3):
                    weighted[i, a] += informations[n, i, j] * shapes[j, a]
                strain[a] += weighted[i, a] * gaps[n, i]
                by_pose[i, a] += weighted[i, a]
            by_pose[3, a] += y * weighted[2, a] - z * weighted[1, a]
            by_pose[4, a] += z * weighted[0, a] - x * weighted[2, a]
            by_pose[5, a] += x * weighted[1, a] - y * weighted[0, a]
            for b in range(a + 1):
                for i in range(3):
                    strains[a, b] += weighted[i, a] * shapes[i, b]
        for a in range(RAY_SHAPES):
            parting[a] += linear[a] * rays[n]
            for b in range(a + 1):
                partings[a, b] += linear[a] * linear[b]
    # The fitted pose absorbs a part of each strain.
    pose_by_strain = covariance @ by_pose
    for a in range(STRAINS):
        strains[a, a] += KNOWN_STRAIN
        for b in range(a + 1):
            for i in range(6):
                strains[a, b] -= by_pose[i, a] * pose_by_strain[i, b]
    for a in range(RAY_SHAPES):
        partings[a, a] += KNOWN_PARTING
    return squared_size(strains, strain) + squared_size(partings, parting)


@compiled
def squared_size(information: Array, right: Array) -> float:
    """Return b' A^-1 b for a symmetric matrix A (n, n), which is overwritten, and b (n,)."""
    solution = right.copy()
    factorise(information)
    solve_factored(information, solution)
    total = 0.0
    for a in range(len(right)):
        total += right[a] * solution[a]
    return total


@compiled
def light_sizes(
    cameras: Cameras, points: Array, arms: Array, spreads: Array, lights: Array, starts: Array,
    sizes: Array,
) -> None:  # fmt: skip
    """Fill ``sizes`` (f,), the squared movements of f poses by light that rises across stickers.

    A pose moves if rising light is fitted with each sticker in place of even light. Its squared
    movement is in units of its noise. Noise alone gives chi-square numbers with six degrees of
    freedom. Frame j has the stickers ``starts[j]:starts[j + 1]`` at ``points`` (k, 3), with
    ``arms`` (k, 3). The centres have covariances ``spreads`` (2, k, 2, 2). ``lights`` (2, k, 7) are
    those of ``EllipseFits``.
    """
    slope = np.zeros((2, 6))
    weighted_slopes = np.empty((6, 2))
    weight = np.empty((2, 2))
    noise = np.empty((2, 2))
    for f in range(len(sizes)):
        moved = np.zeros(6)
        moved_noise = np.zeros((6, 6))
        for side in range(2):
            camera = cameras.intrinsics[side]
            move = cameras.extrinsics[side]
            for n in range(starts[f], starts[f + 1]):
                pose_slopes(camera, move, points[n], arms[n], slope)
                weigh(slope, spreads[side, n], weight, weighted_slopes)
                light = lights[side, n]
                noise[0, 0] = light[2]
                noise[0, 1] = noise[1, 0] = light[3]
                noise[1, 1] = light[4]
                for i in range(6):
                    moved[i] += weighted_slopes[i, 0] * light[0] + weighted_slopes[i, 1] * light[1]
                for i in range(6):
                    for j in range(i + 1):
                        for k in range(2):
                            for m in range(2):
                                moved_noise[i, j] += (
                                    weighted_slopes[i, k] * noise[k, m] * weighted_slopes[j, m]
                                )
        for i in range(6):
            # Few stickers, or stickers on a line, do not determine all movements.
            moved_noise[i, i] *= 1.0 + REGULAR
        sizes[f] = squared_size(moved_noise, moved)
