"""Search of whole images without a prior pose: bright spots, their pairs, and the known layout.

Ellipses are fitted to bright spots that are small enough for a window. A spot of the left image and
a spot of the right image form a pair if the right one lies on the epipolar line of the left one.
Each pair is a point in space, and false pairs occur. The known layout of the stickers is searched
in this cloud of points. Three stickers match three points that have the same mutual distances. Each
match proposes a pose. The best pose is the one at which most stickers of the layout have a point
close by.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import EllipseFits, fit_ellipses
from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, apply
from cmmsim.geometry.registration import rigid_starts
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.geometry.triangulation import linear_triangulation
from cmmsim.measuring.observation import Observer, StickerExposure
from cmmsim.radiometry.noise import GreyImage, cut_windows
from cmmsim.radiometry.stereo_images import StereoImages

# Smallest area of a bright spot, in pixels.
SMALLEST_AREA_PX = 8
# Largest area of a bright spot, as a fraction of a square with the largest allowed side.
LARGEST_SHARE = 25 / 36
# Fraction of the pixels of an image that count as the brightest.
BRIGHT_SHARE = 1e-4
# Fraction of the pixels that count as the darkest.
DARK_SHARE = 1e-3
# Smallest step from the ground to the brightest pixels, as a fraction of the largest grey value.
SMALLEST_STEP = 40.0 / 255.0
SMALLEST_WINDOW_PX = 24  # smallest side of the window around a bright spot
# Margin of windows for the error of a bright spot's rough centre.
ROOM_PX = 8
# Fewest recognised stickers of a platform with taught places.
FEWEST_TAUGHT = 4
# Allowed distance from epipolar lines if the rig is exact.
LINE_TOLERANCE_PX = 0.5
# Additional distance that is allowed for errors of the rig, in their standard deviations.
LINE_STDS = 4.0
# Smallest depth, and largest distance of a point from the left camera, m.
NEAREST = 0.3
FURTHEST = 6.0
# Smallest area of a triangle of stickers, m².
SMALLEST_TRIANGLE = 0.002
# Largest number of triangles that are tried together.
MOST_TOGETHER = 64
# Fraction of the layout's stickers whose recognition ends the search.
ENOUGH = 0.8
# Additional point spreads with which spots are fitted if they can be out of focus, px.
DEFOCUSED_PX = (0.2, 0.4, 0.6, 0.9)


def bright_ellipses(
    images: StereoImages | StickerExposure, observer: Observer
) -> tuple[EllipseFits, EllipseFits]:
    """Fit ellipses, without a limit on misfits, to all bright spots that fit into a window."""
    if isinstance(images, StickerExposure):
        return images.bright(observer)
    frame = images.full()
    noise = observer.upright
    settings = observer.settings
    size = max(SMALLEST_WINDOW_PX, settings.window_size + ROOM_PX)
    limits = replace(settings.limits, largest_misfit=np.inf)
    both = []
    for image in (noise.bright(frame.left), noise.bright(frame.right)):
        image = _without_ghost(image, observer)
        corners = np.rint(find_blobs(image, noise.white_level, size) - 0.5 * (size - 1)).astype(int)
        windows = cut_windows(image, corners, size)
        spots = windows, corners, noise, settings.fit_size, limits
        fits = fit_ellipses(*spots, psf_px=settings.optics.psf_px)
        # Each spot keeps the fit with the point spread that agrees best.
        for defocus in DEFOCUSED_PX if settings.optics.aperture > 0.0 else ():
            others = fit_ellipses(*spots, psf_px=float(np.hypot(settings.optics.psf_px, defocus)))
            better = others.misfits < fits.misfits
            fits = fits.with_others(np.flatnonzero(better), others, better)
        both.append(fits)
    return both[0], both[1]


def _without_ghost(image: GreyImage, observer: Observer) -> GreyImage:
    """Return an image (height, width) without the lens's ghost, to first order."""
    optics = observer.settings.optics
    if optics.ghost == 0.0:
        return image
    x, y = optics.ghost_offset
    light = image.astype(float) - observer.noise.black_level
    clean = image - optics.ghost * np.roll(light, (y, x), axis=(0, 1))
    grey = np.clip(np.rint(clean), 0, observer.noise.white_level)
    return np.asarray(grey, dtype=observer.noise.image_type)


def candidate_points(
    ellipses: tuple[EllipseFits, EllipseFits], observer: Observer, limits: FitLimits
) -> Array:
    """Return points (m, 3) m in the camera frame that are possible stickers.

    They are triangulated from pairs of ellipses within ``limits``; some pairs are false. Raises
    LostError if an image has no such ellipses.
    """
    left, right = (fits.centres[fits.within(limits, observer.upright).good] for fits in ellipses)
    if not len(left) or not len(right):
        raise LostError(
            f"{len(left)} bright spots in the left image and {len(right)} in the right, at least "
            f"{FEWEST_TAUGHT} are needed in each"
        )
    ideal_pixels = []
    for camera, centres in zip(observer.rig.cameras, (left, right), strict=True):
        pixels, exists = camera.undistort(centres)
        ideal_pixels.append(pixels[exists])
    off_line = LINE_TOLERANCE_PX + LINE_STDS * observer.settings.line_error_px
    return candidate_pairs(observer.rig.ideal, ideal_pixels[0], ideal_pixels[1], off_line)[1]


def find_blobs(image: GreyImage, white_level: int, largest_side: int) -> Array:
    """Return rough centres (n, 2) px of compact bright spots of an image (height, width).

    ``largest_side`` is the largest side of a spot's bounding box, px.
    """
    counts = np.bincount(image.ravel())
    from_top = np.cumsum(counts[::-1])
    bright = len(counts) - 1 - int(np.searchsorted(from_top, max(1.0, BRIGHT_SHARE * image.size)))
    ground = int(np.searchsorted(np.cumsum(counts), 0.5 * image.size))
    if bright - ground < SMALLEST_STEP * white_level:
        # Most of the image is as bright as the spots, so their rings are the darkest part.
        ground = int(np.searchsorted(np.cumsum(counts), DARK_SHARE * image.size))
    if bright - ground < SMALLEST_STEP * white_level:
        return np.zeros((0, 2))
    mask = (image > 0.5 * (bright + ground)).astype(np.uint8)
    _, _, stats, centres = cv2.connectedComponentsWithStats(mask)
    area = stats[1:, cv2.CC_STAT_AREA]
    sides = stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    keep = (area >= SMALLEST_AREA_PX) & (area <= round(LARGEST_SHARE * largest_side**2))
    keep &= sides.max(axis=1) <= largest_side
    # A disc fills pi/4 of its bounding box, and a tilted disc less. Streaks and outlines fill only
    # a small part.
    keep &= area > 0.4 * sides.prod(axis=1)
    return centres[1:][keep]


def epipolar_distance(rig: StereoRig, left: Array, right: Array) -> Array:
    """Return the distances (n, m) of right pixels from the epipolar lines of left pixels.

    ``left`` (n, 2) and ``right`` (m, 2) are ideal pixels.
    """
    lines = np.column_stack([left, np.ones(len(left))]) @ rig.fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    return np.abs(lines @ np.column_stack([right, np.ones(len(right))]).T)


def candidate_pairs(
    rig: StereoRig, left: Array, right: Array, off_line: float = LINE_TOLERANCE_PX
) -> tuple[NDArray[np.int_], Array]:
    """Return pairs (m, 2) of spots in both images that are possibly one point, and these points.

    The pairs are indices of ``left`` (k, 2) and ``right`` (l, 2), which are in ideal px. The points
    are (m, 3), m in the camera frame. The right spot of a pair is less than ``off_line`` px from
    the epipolar line of the left one. A spot can belong to several pairs: the known layout decides
    later which pair is true.
    """
    pairs = np.argwhere(epipolar_distance(rig, left, right) < off_line)
    points = linear_triangulation(rig, left[pairs[:, 0]], right[pairs[:, 1]])
    near = (points[:, 2] > NEAREST) & (np.linalg.norm(points, axis=1) < FURTHEST)
    return pairs[near], points[near]


def find_layout(
    layout: Array, points: Array, tolerance: float, fewest: int, name: str
) -> tuple[Array, NDArray[np.int_], NDArray[np.int_]]:
    """Find the pose of a layout in a cloud of points.

    The layout (n, 3) m is in body axes and the points (m, 3) m in the camera frame. Each place in
    the layout can be off by ``tolerance`` m. The results are camera_from_body (4, 4), the indices
    of the recognised stickers (k,) and of their points (k,). Raises LostError if fewer than
    ``fewest`` stickers are recognised, or if two different poses explain the points about equally
    well. ``name`` is the body's name in messages.
    """
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    tree = cKDTree(points)
    best: Array | None = None
    count = rival = 0
    for triples in _blocks(_triangles(layout)):
        proposer, poses, counts = _proposed(layout, triples, points, distances, tree, tolerance)
        last = len(triples)
        # Poses with smaller counts replace neither the best pose nor the rival.
        for k in np.flatnonzero(counts > min(count, rival)).tolist():
            if proposer[k] > last:
                break
            if best is not None and not _same(best, poses[k], layout, tolerance):
                rival = max(rival, min(count, int(counts[k])))
            if counts[k] > count:
                best = poses[k]
                count = int(counts[k])
            if count >= ENOUGH * len(layout):
                # Other poses from the same triangle can still be rivals.
                last = min(last, proposer[k])
        if count >= ENOUGH * len(layout):
            break
    if best is None or count < fewest:
        raise LostError(
            f"{name}: {count} of {len(layout)} stickers recognised among {len(points)} points, at "
            f"least {fewest} are needed"
        )
    if rival > count - 2:
        raise LostError(f"{name}: two poses explain the points, with {count} and {rival} stickers")
    nearest = _nearest(best[None], layout, tree, tolerance)[0]
    stickers = np.flatnonzero(nearest >= 0)
    return best, stickers, nearest[stickers]


def _triangles(layout: Array) -> NDArray[np.int_]:
    """Return triples (t, 3) of stickers that form large triangles, in a fixed random order."""
    triples = np.array(list(combinations(range(len(layout)), 3)), dtype=int).reshape(-1, 3)
    a, b, c = layout[triples.T]
    triples = triples[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 2.0 * SMALLEST_TRIANGLE]
    # In random order, the first triangles differ much. The seed makes results repeatable.
    return np.random.default_rng(0).permutation(triples)


def _blocks(triples: NDArray[np.int_]) -> Iterator[NDArray[np.int_]]:
    """Yield the triples (t, 3) in parts that are tried together.

    The first parts are small, because the first triples usually end the search.
    """
    first = 0
    while first < len(triples):
        size = min(1 + first, MOST_TOGETHER)
        yield triples[first : first + size]
        first += size


def _congruent(distances: Array, corners: Array, tolerance: float) -> NDArray[np.int_]:
    """Return all ordered triples (c, 3) of points with the same mutual distances as three corners.

    The corners are (3, 3). ``distances`` (m, m) are those of the points. Distances within
    ``tolerance`` m of each other count as the same.
    """
    d01, d02, d12 = (np.linalg.norm(corners[a] - corners[b]) for a, b in ((0, 1), (0, 2), (1, 2)))
    first, second = np.nonzero(np.abs(distances - d01) < tolerance)
    fits = (np.abs(distances[first] - d02) < tolerance) & (
        np.abs(distances[second] - d12) < tolerance
    )
    pair, third = np.nonzero(fits)
    return np.column_stack([first[pair], second[pair], third])


def _proposed(
    layout: Array,
    triples: NDArray[np.int_],
    points: Array,
    distances: Array,
    tree: cKDTree,
    tolerance: float,
) -> tuple[NDArray[np.int_], Array, NDArray[np.int_]]:
    """Return c poses that triples (t, 3) of stickers propose.

    A triple proposes a pose if three points have the same mutual distances. The first result is the
    index (c,) of the proposing triple. The second result contains the poses (c, 4, 4), refitted to
    all stickers with a point close by. The third result is the number (c,) of stickers with a point
    close by at the refitted pose. Poses with fewer than three such stickers before refitting are
    omitted.
    """
    # Both ends of a side can be off by the tolerance.
    corners = [_congruent(distances, layout[triple], 2.0 * tolerance) for triple in triples]
    proposer = np.repeat(np.arange(len(triples)), [len(c) for c in corners])
    start = rigid_starts(
        layout[triples[proposer]], points[np.concatenate(corners)], np.ones((len(proposer), 3))
    )
    nearest = _nearest(start, layout, tree, tolerance)
    enough = (nearest >= 0).sum(axis=1) >= 3
    nearest = nearest[enough]
    poses = rigid_starts(layout, points[nearest], (nearest >= 0).astype(float))
    return proposer[enough], poses, (_nearest(poses, layout, tree, tolerance) >= 0).sum(axis=1)


def _nearest(poses: Array, layout: Array, tree: cKDTree, tolerance: float) -> NDArray[np.int_]:
    """Return the index (c, n) of the point nearest to each sticker at poses (c, 4, 4).

    It is -1 if no point lies within 1.5 tolerances, or if the point is nearer to another sticker.
    """
    places = layout @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    nearest = tree.query(places, distance_upper_bound=1.5 * tolerance)[1]
    nearest[nearest == tree.n] = -1
    candidate, sticker = np.nonzero(nearest >= 0)
    point = tree.data[nearest[candidate, sticker]]
    nearest_sticker = np.linalg.norm(places[candidate] - point[:, None], axis=2).argmin(axis=1)
    taken = nearest_sticker != sticker
    nearest[candidate[taken], sticker[taken]] = -1
    return np.asarray(nearest)


def _same(first: Array, second: Array, layout: Array, tolerance: float) -> bool:
    """Return True if two poses differ by less than four tolerances at each sticker."""
    return bool(
        np.linalg.norm(apply(first, layout) - apply(second, layout), axis=1).max() < 4.0 * tolerance
    )
