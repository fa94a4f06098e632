"""Compiled test for a warp: what a wrong image of the whole scene leaves in the residuals of a fit.

If the cameras do not expose at once, row after row, or through a lens that has changed, all
stickers are displaced by an amount that varies smoothly with their places. A part of this looks
like a movement and is an error of the pose. The rest strains the pattern of the stickers, or parts
the two rays of each sticker by a distance that varies linearly with the place. Ten such shapes are
fitted to the residuals together. Smooth errors hide in the residuals of single stickers, because a
pose is some ten times more accurate than the place of a sticker.
"""

from __future__ import annotations

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, pose_slopes, weigh
from cmmsim.geometry.matrix_kernels import factorise, solve_factored

# Strains of the stickers' places, and changes of the distance of their rays.
STRAINS = 6
RAY_SHAPES = 4
SHAPES = STRAINS + RAY_SHAPES
# Inverse squares of the largest strain, and of the largest change of the rays' distance, in
# deviations a metre. They keep the matrices regular if the stickers do not show a shape. For
# example, stickers on one plane do not show all shapes.
KNOWN_STRAIN = 1e6
KNOWN_PARTING = 1e-6
REGULAR = 1e-9


@compiled
def warp(
    used: Array, arms: Array, gaps: Array, informations: Array, rays: Array, covariance: Array
) -> float:
    """Return the squared size of the warp of the used stickers, in units of its noise.

    The stickers have arms, gaps and rays (n, 3), (n, 3) and (n,), see ``ObservedStickers``, and
    inverse covariances ``informations`` (n, 3, 3). ``covariance`` (6, 6) is that of the fitted
    pose. Noise alone gives a chi-square number with SHAPES degrees of freedom.
    """
    shapes = np.zeros((3, STRAINS))
    pushed = np.empty((3, STRAINS))
    by_pose = np.zeros((6, STRAINS))
    strains = np.zeros((STRAINS, STRAINS))
    strain = np.zeros(STRAINS)
    partings = np.zeros((RAY_SHAPES, RAY_SHAPES))
    parting = np.zeros(RAY_SHAPES)
    place = np.ones(RAY_SHAPES)
    for n in range(len(used)):
        if not used[n]:
            continue
        x, y, z = arms[n]
        shapes[0, 0] = shapes[1, 1] = shapes[2, 2] = x
        shapes[0, 1] = shapes[1, 3] = shapes[2, 4] = y
        shapes[0, 2] = shapes[1, 4] = shapes[2, 5] = z
        place[1:] = arms[n]
        for a in range(STRAINS):
            for i in range(3):
                pushed[i, a] = 0.0
                for j in range(3):
                    pushed[i, a] += informations[n, i, j] * shapes[j, a]
                strain[a] += pushed[i, a] * gaps[n, i]
                by_pose[i, a] += pushed[i, a]
            by_pose[3, a] += y * pushed[2, a] - z * pushed[1, a]
            by_pose[4, a] += z * pushed[0, a] - x * pushed[2, a]
            by_pose[5, a] += x * pushed[1, a] - y * pushed[0, a]
            for b in range(a + 1):
                for i in range(3):
                    strains[a, b] += pushed[i, a] * shapes[i, b]
        for a in range(RAY_SHAPES):
            parting[a] += place[a] * rays[n]
            for b in range(a + 1):
                partings[a, b] += place[a] * place[b]
    # A part of each strain is taken up by the pose.
    taken = covariance @ by_pose
    for a in range(STRAINS):
        strains[a, a] += KNOWN_STRAIN
        for b in range(a + 1):
            for i in range(6):
                strains[a, b] -= by_pose[i, a] * taken[i, b]
    for a in range(RAY_SHAPES):
        partings[a, a] += KNOWN_PARTING
    return squared_size(strains, strain) + squared_size(partings, parting)


@compiled
def squared_size(information: Array, right: Array) -> float:
    """Return b' A^-1 b for a symmetric matrix A (n, n), which is overwritten, and b (n,)."""
    found = right.copy()
    factorise(information)
    solve_factored(information, found)
    total = 0.0
    for a in range(len(right)):
        total += right[a] * found[a]
    return total


@compiled
def light_sizes(
    cameras: Cameras, points: Array, arms: Array, spreads: Array, lights: Array, starts: Array,
    sizes: Array,
) -> None:  # fmt: skip
    """Fill the squared movements (f,) of f poses due to light that rises across stickers.

    A pose moves if rising light is fitted with each sticker in place of even light. Its squared
    movement is in units of its noise. Noise alone gives chi-square numbers with six degrees of
    freedom. Frame j has the stickers ``starts[j]`` to ``starts[j + 1]`` at ``points`` (k, 3), with
    ``arms`` (k, 3). The centres have covariances ``spreads`` (2, k, 2, 2). ``lights`` (2, k, 7) are
    those of ``EllipseFits``.
    """
    slope = np.zeros((2, 6))
    pushed = np.empty((6, 2))
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
                weigh(slope, spreads[side, n], weight, pushed)
                light = lights[side, n]
                noise[0, 0] = light[2]
                noise[0, 1] = noise[1, 0] = light[3]
                noise[1, 1] = light[4]
                for i in range(6):
                    moved[i] += pushed[i, 0] * light[0] + pushed[i, 1] * light[1]
                for i in range(6):
                    for j in range(i + 1):
                        for k in range(2):
                            for m in range(2):
                                moved_noise[i, j] += pushed[i, k] * noise[k, m] * pushed[j, m]
        for i in range(6):
            # Few stickers, or stickers on a line, do not show all movements.
            moved_noise[i, i] *= 1.0 + REGULAR
        sizes[f] = squared_size(moved_noise, moved)
