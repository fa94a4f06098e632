"""Search of whole images with no prior pose: bright spots, their pairs in both images, and which is
which sticker.

Bright spots that a window holds are fitted with ellipses. Spots of both images that lie on each
other's epipolar lines are pairs, true and false ones together, and each pair is a point in space.
In this cloud of points the known layout of the stickers is looked for: three stickers far from each
other by their three mutual distances; each find proposes a pose, which is judged by how many
stickers of the layout then have a point close by.
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
from cmmsim.geometry.stereo_rig import StereoRig, linear_triangulation
from cmmsim.measuring.observation import Observer, StickerExposure
from cmmsim.radiometry.noise import GreyImage, cut_windows
from cmmsim.radiometry.stereo_images import StereoImages

SMALLEST_AREA_PX = 8
LARGEST_SHARE = 25 / 36  # of a square with the largest side
BRIGHT_SHARE = 1e-4  # share of the image's pixels that are taken as the brightest
# of the largest grey value: between the ground and the brightest pixels
SMALLEST_STEP = 40.0 / 255.0
SMALLEST_WINDOW_PX = 24
ROOM_PX = 8  # a bright spot's rough centre differs from a prediction of it
FEWEST_TAUGHT = 4  # stickers by whose taught places a platform is found
LINE_TOLERANCE_PX = 0.5
LINE_STDS = 4.0  # of what is not known of the rig
NEAREST = 0.3
FURTHEST = 6.0  # m
SMALLEST_TRIANGLE = 0.002  # m² area
MOST_TOGETHER = 64  # triangles judged together
ENOUGH = 0.8  # share of the layout that ends the search


def bright_ellipses(
    images: StereoImages | StickerExposure, observer: Observer
) -> tuple[EllipseFits, EllipseFits]:
    """Ellipses of any misfit fitted to all bright spots of the left and of the right image that a
    window holds.
    """
    if isinstance(images, StickerExposure):
        return images.bright(observer)
    frame = images.full()
    noise = observer.noise
    settings = observer.settings
    size = max(SMALLEST_WINDOW_PX, settings.window_size + ROOM_PX)
    limits = replace(settings.limits, largest_misfit=np.inf)
    found = []
    for image in (frame.left, frame.right):
        corners = np.rint(find_blobs(image, noise.white_level, size) - 0.5 * (size - 1)).astype(int)
        windows = cut_windows(image, corners, size)
        found.append(
            fit_ellipses(
                windows, corners, noise, settings.fit_size, limits, psf_px=settings.optics.psf_px
            )
        )
    return found[0], found[1]


def candidate_points(
    ellipses: tuple[EllipseFits, EllipseFits], observer: Observer, limits: FitLimits
) -> Array:
    """Points (m,3) in the camera frame that may be stickers, of ellipses that keep within
    ``limits``; true and false pairings together. Raises LostError where there are too few bright
    spots."""
    left, right = (fits.centres[fits.within(limits, observer.noise).good] for fits in ellipses)
    if not len(left) or not len(right):
        raise LostError(
            f"{len(left)} bright spots in the left image and {len(right)} in the right, "
            f"at least {FEWEST_TAUGHT} in each needed"
        )
    ideal = []
    for camera, centres in zip(observer.rig.cameras, (left, right), strict=True):
        pixels, found = camera.undistort(centres)
        ideal.append(pixels[found])
    off_line = LINE_TOLERANCE_PX + LINE_STDS * observer.settings.line_error_px
    return candidate_pairs(observer.rig.ideal, ideal[0], ideal[1], off_line)[1]


def find_blobs(image: GreyImage, white_level: int, largest_side: int) -> Array:
    """Rough centres (n, 2) px of compact bright spots of an image (height, width).

    Parameters: white_level: largest grey value; largest_side of a spot's bounding box, px.
    """
    counts = np.bincount(image.ravel())
    from_top = np.cumsum(counts[::-1])
    bright = len(counts) - 1 - int(np.searchsorted(from_top, max(1.0, BRIGHT_SHARE * image.size)))
    ground = int(np.searchsorted(np.cumsum(counts), 0.5 * image.size))
    if bright - ground < SMALLEST_STEP * white_level:
        return np.zeros((0, 2))
    mask = (image > 0.5 * (bright + ground)).astype(np.uint8)
    _, _, stats, centres = cv2.connectedComponentsWithStats(mask)
    area = stats[1:, cv2.CC_STAT_AREA]
    sides = stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    keep = (area >= SMALLEST_AREA_PX) & (area <= round(LARGEST_SHARE * largest_side**2))
    keep &= sides.max(axis=1) <= largest_side
    keep &= area > 0.4 * sides.prod(axis=1)
    return centres[1:][keep]


def epipolar_distance(rig: StereoRig, left: Array, right: Array) -> Array:
    """Distance (n, m) of each right pixel (m, 2) from the epipolar line of each left pixel (n, 2),
    ideal px.
    """
    lines = np.column_stack([left, np.ones(len(left))]) @ rig.fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    return np.abs(lines @ np.column_stack([right, np.ones(len(right))]).T)


def candidate_pairs(
    rig: StereoRig, left: Array, right: Array, off_line: float = LINE_TOLERANCE_PX
) -> tuple[NDArray[np.int_], Array]:
    """All pairs (m, 2) of left and right spots that may be one point, and their points (m, 3) in
    the camera frame.

    Parameters: left (k, 2) and right (l, 2) in ideal px; off_line: how far, px, a spot may be off
    the other's line. A spot may appear in several pairs; the known layout decides later which of
    them is true.
    """
    pairs = np.argwhere(epipolar_distance(rig, left, right) < off_line)
    points = linear_triangulation(rig, left[pairs[:, 0]], right[pairs[:, 1]])
    near = (points[:, 2] > NEAREST) & (np.linalg.norm(points, axis=1) < FURTHEST)
    return pairs[near], points[near]


def find_layout(
    layout: Array, points: Array, tolerance: float, fewest: int, name: str
) -> tuple[Array, NDArray[np.int_], NDArray[np.int_]]:
    """Pose of a layout in a cloud of points.

    Parameters: layout (n,3) m in body axes; points (m,3) m in the camera frame; tolerance in m of
    the layout's places; fewest stickers to be found. Returns camera_from_body (4,4), and the
    indices of the stickers (k,) and of their points (k,). Raises LostError when fewer are found, or
    two different poses explain the points about equally well.
    """
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    tree = cKDTree(points)
    best: Array | None = None
    count = rival = 0
    for triples in _blocks(_triangles(layout)):
        proposer, poses, counts = _proposed(layout, triples, points, gaps, tree, tolerance)
        ended = len(triples)
        for k in np.flatnonzero(counts > min(count, rival)).tolist():  # others change neither
            if proposer[k] > ended:
                break
            if best is not None and not _same(best, poses[k], layout, tolerance):
                rival = max(rival, min(count, int(counts[k])))
            if counts[k] > count:
                best = poses[k]
                count = int(counts[k])
            if count >= ENOUGH * len(layout):
                ended = min(ended, proposer[k])  # this triangle's other finds may be rivals yet
        if count >= ENOUGH * len(layout):
            break
    if best is None or count < fewest:
        raise LostError(
            f"{name}: {count} of {len(layout)} stickers recognised among {len(points)} points, at "
            f"least {fewest} needed"
        )
    if rival > count - 2:
        raise LostError(f"{name}: two poses explain the points, with {count} and {rival} stickers")
    nearest = _nearest(best[None], layout, tree, tolerance)[0]
    stickers = np.flatnonzero(nearest >= 0)
    return best, stickers, nearest[stickers]


def _triangles(layout: Array) -> NDArray[np.int_]:
    """Triples (t,3) of stickers with a large triangle, in a fixed mixed order."""
    triples = np.array(list(combinations(range(len(layout)), 3)), dtype=int).reshape(-1, 3)
    a, b, c = layout[triples.T]
    triples = triples[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 2.0 * SMALLEST_TRIANGLE]
    return np.random.default_rng(0).permutation(triples)


def _blocks(triples: NDArray[np.int_]) -> Iterator[NDArray[np.int_]]:
    """The triples (t,3) in parts that are judged together: the first ones alone, since they mostly
    end the search.
    """
    first = 0
    while first < len(triples):
        size = min(1 + first, MOST_TOGETHER)
        yield triples[first : first + size]
        first += size


def _congruent(gaps: Array, corners: Array, tolerance: float) -> NDArray[np.int_]:
    """All ordered triples (c,3) of points whose distances (``gaps``, (m,m)) are those of three
    corners (3,3).
    """
    d01, d02, d12 = (np.linalg.norm(corners[a] - corners[b]) for a, b in ((0, 1), (0, 2), (1, 2)))
    first, second = np.nonzero(np.abs(gaps - d01) < tolerance)
    fits = (np.abs(gaps[first] - d02) < tolerance) & (np.abs(gaps[second] - d12) < tolerance)
    pair, third = np.nonzero(fits)
    return np.column_stack([first[pair], second[pair], third])


def _proposed(
    layout: Array,
    triples: NDArray[np.int_],
    points: Array,
    gaps: Array,
    tree: cKDTree,
    tolerance: float,
) -> tuple[NDArray[np.int_], Array, NDArray[np.int_]]:
    """Find the triples (t,3) of stickers that propose poses (c,), where three points are as far
    from each other.

    Returned are also the poses (c,4,4), laid onto all stickers that then have a point close by, and
    the number (c,) of those that have one in the end.

    Poses with fewer than three stickers are left out.
    """
    corners = [_congruent(gaps, layout[triple], 2.0 * tolerance) for triple in triples]
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
    """Measured point (c,n) of each sticker within the tolerance at poses (c,4,4), each point used
    once; -1: none.
    """
    places = layout @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    nearest = tree.query(places, distance_upper_bound=1.5 * tolerance)[1]
    nearest[nearest == tree.n] = -1
    candidate, sticker = np.nonzero(nearest >= 0)
    point = tree.data[nearest[candidate, sticker]]
    rivals = np.linalg.norm(places[candidate] - point[:, None], axis=2).argmin(axis=1)
    lost = rivals != sticker
    nearest[candidate[lost], sticker[lost]] = -1
    return np.asarray(nearest)


def _same(first: Array, second: Array, layout: Array, tolerance: float) -> bool:
    """Tell whether two poses put the layout in the same place."""
    return bool(
        np.linalg.norm(apply(first, layout) - apply(second, layout), axis=1).max() < 4.0 * tolerance
    )
