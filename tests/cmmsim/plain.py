"""Plain NumPy, SciPy and OpenCV for what the sensor has compiled: the oracles of its kernels."""

import cv2
import numpy as np
from scipy.linalg import sqrtm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from cmmsim.geometry.pose import rigid, skew

FEWEST, LARGEST_MISFIT, LARGEST_EXCESS = 5, chi2.isf(1e-4, 3), 6.0
FEWEST_RIVALS, WARP_CHANCE, WARP_SHARE, EXCESS_SHARE, TAIL = 3, 1e-3, 8.0, 4.0, 0.999
LARGEST_DELAY, DELAY_SHARE = 3.0, 2.0
LARGEST_STRAIN, LARGEST_PARTING = 1e-3, 1e3  # a metre
SLIP_CHANCE, LARGEST_SLIP = 1e-3, 1e-3  # m
SMALLEST_SHARE = 0.01  # of a sticker's noise that must show in its residual


def eccentricity(centres, normals, radius, focal_px):
    """Ellipse centres less projected circle centres through a perfect lens, px (n, 2)."""
    d13_d23 = centres[:, :2] * centres[:, 2:] + radius**2 * normals[:, :2] * normals[:, 2:]
    d33 = centres[:, 2:] ** 2 - radius**2 * (1.0 - normals[:, 2:] ** 2)
    return focal_px * (d13_d23 / d33 - centres[:, :2] / centres[:, 2:])


def project(camera, points):
    """Pixels (n, 2) of points (n, 3) in camera axes, and their derivatives (n, 2, 3), by OpenCV."""
    zero, lens = np.zeros(3), camera.intrinsics[4:]
    pixels, slopes = cv2.projectPoints(
        np.ascontiguousarray(points), zero, zero, camera.matrix, lens
    )
    return pixels[:, 0], slopes[:, 3:6].reshape(len(points), 2, 3)


def outlines(rig, camera_from_body, places, normals, radius):
    """Shapes (2, n, 2, 2) of stickers' ellipses: the dual conic, and the root of J M J'."""
    found = []
    for camera, move in zip(rig.cameras, rig.from_camera, strict=True):
        move = move @ camera_from_body
        centres, turned = places @ move[:3, :3].T + move[:3, 3], normals @ move[:3, :3].T
        for c, n in zip(centres, turned, strict=True):
            dual = np.outer(c, c) - radius**2 * (np.eye(3) - np.outer(n, n))
            middle = dual[:2, 2] / dual[2, 2]
            square = np.outer(middle, middle) - dual[:2, :2] / dual[2, 2]
            slope = project(camera, np.array([[*middle, 1.0]]))[1][0][:, :2]
            found.append(sqrtm(slope @ square @ slope.T))
    return np.array(found).reshape(2, len(places), 2, 2)


def triangulate(rig, pixels, covariances, near, line_variance=0.0):
    """Points (n, 3) and covariances (n, 3, 3) from pixels (2, n, 2), by OpenCV's derivatives."""
    points = np.array(near)
    weights = np.linalg.inv(covariances + line_variance * np.eye(2))
    for _ in range(8):
        normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for side, (camera, move) in enumerate(zip(rig.cameras, rig.from_camera, strict=True)):
            found, slopes = project(camera, points @ move[:3, :3].T + move[:3, 3])
            slopes = slopes @ move[:3, :3]
            weighted = slopes.swapaxes(1, 2) @ weights[side]
            normal += weighted @ slopes
            right += np.einsum("nij,nj->ni", weighted, pixels[side] - found)
        points += np.linalg.solve(normal, right[..., None])[..., 0]
    noise = 0.25 * np.einsum("cnii->n", covariances)
    return points, np.linalg.inv(normal) * (noise / (noise + line_variance))[:, None, None]


def rigid_start(source, target):
    """Unweighted rigid transform (4,4) from source to target (n,3), by singular values."""
    middle, other = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - other).T @ (source - middle))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rigid(rotation, other - rotation @ middle)


def fitted(places, points, covariances):
    """Rigid fit: transform (4,4), its covariance (6,6), and each point's squared residual."""
    transform, weights = rigid_start(places, points), np.linalg.inv(covariances)
    for _ in range(5):
        turned = places @ transform[:3, :3].T
        slopes = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), -skew(turned)], axis=2)
        residuals = points - turned - transform[:3, 3]
        covariance = np.linalg.inv(np.einsum("nij,nik,nkl->jl", slopes, weights, slopes))
        step = covariance @ np.einsum("nij,nik,nk->j", slopes, weights, residuals)
        turn = Rotation.from_rotvec(step[3:]).as_matrix()
        transform = rigid(turn @ transform[:3, :3], transform[:3, 3] + step[:3])
    residuals = points - places @ transform[:3, :3].T - transform[:3, 3]
    return transform, covariance, np.einsum("ni,nij,nj->n", residuals, weights, residuals)


def place_misfits(transform, covariance, places, points, covariances):
    """Squared residuals (n,) of a fit in units of S - J C J', in directions that can be checked."""
    turned = places @ transform[:3, :3].T
    slopes = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), -skew(turned)], axis=2)
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))  # makes the noise the unit matrix
    pulled = whiten @ slopes
    shares, axes = np.linalg.eigh(np.eye(3) - pulled @ covariance @ pulled.swapaxes(1, 2))
    residuals = points - turned - transform[:3, 3]
    along = np.einsum("nji,njk,nk->ni", axes, whiten, residuals)
    return (along**2 / np.where(shares > SMALLEST_SHARE, shares, np.inf)).sum(axis=1)


def excess(total, freedom):
    """Mean square of residuals where it is larger than noise makes it, else 1."""
    return total / freedom if freedom > 0 and total > chi2.isf(1e-4, freedom) else 1.0


def outline_misfits(shapes, covariances, expected):
    """Squared differences (2, n) of ellipses with shapes (2, n, 2, 2) from expected ones."""
    change = (shapes - expected)[..., [0, 0, 1], [0, 1, 1]]
    return (change * np.linalg.solve(covariances, change[..., None])[..., 0]).sum(axis=-1)


def warp(transform, places, points, covariances, rays):
    """Decrease of the squared residuals if strains are fitted, and a part of the rays linear in the
    place: by least squares of whitened rows.
    """
    turned = places @ transform[:3, :3].T
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))
    pose = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), -skew(turned)], axis=2)
    sides = np.triu_indices(3)
    strains = np.array([np.eye(3)[[i]].T @ np.eye(3)[[j]] for i, j in zip(*sides, strict=True)])
    strains = np.array([part if part.trace() else part + part.T for part in strains])
    shapes = np.einsum("aij,nj->nia", strains, turned)
    residuals = np.einsum("nij,nj->ni", whiten, points - turned - transform[:3, 3]).ravel()
    rows = [(whiten @ part).reshape(3 * len(places), -1) for part in (pose, shapes)]
    known = np.hstack([np.zeros((6, 6)), np.eye(6) / LARGEST_STRAIN])
    linear = np.column_stack([np.ones(len(places)), turned])
    found = [
        _decrease(np.vstack([np.hstack(rows), known]), np.append(residuals, np.zeros(6))),
        _decrease(np.vstack([linear, np.eye(4) / LARGEST_PARTING]), np.append(rays, np.zeros(4))),
    ]
    return sum(found) - _decrease(rows[0], residuals)


def slip(transform, places, points, covariances, planes):
    """Squared slip of the plane that slipped most, and the mean square (6, 6) of the pose's error.

    The slip is fitted together with the pose, once as one of the plane and once as one of the rest.
    """
    turned = places @ transform[:3, :3].T
    pose = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), -skew(turned)], axis=2)
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))
    gaps = np.einsum("nij,nj->ni", whiten, points - turned - transform[:3, 3]).ravel()
    known = np.hstack([np.zeros((3, 6)), np.eye(3) / LARGEST_SLIP])
    found = []
    for plane in range(3):
        spread = np.zeros((6, 6))
        for moved in (planes == plane, planes != plane):
            columns = np.concatenate([pose, moved[:, None, None] * np.eye(3)], axis=2)
            rows = np.vstack([(whiten @ columns).reshape(-1, 9), known])
            every = np.linalg.inv(rows.T @ rows)
            change = every @ rows[:-3].T @ gaps
            effect = every[:6, 6:] @ np.linalg.inv(every[6:, 6:])
            mean_square = every[6:, 6:] + np.outer(change[6:], change[6:])
            spread += 0.5 * effect @ mean_square @ effect.T
        found.append((change[6:] @ np.linalg.solve(every[6:, 6:], change[6:]), spread))
    return max(found, key=lambda one: one[0])


def shared_errors(rig, transform, places, pixels, spreads, shifts, ends):
    """Covariance (6, 6) of a pose by errors that pixels (n, 2, 2) share, from whitened rows.

    ``shifts`` (2,) px are deviations of a shift of each image. Delays are fitted with the pose:
    that of the right image, and that of rows, along the movement between both ``ends`` (2, 4, 4).
    """
    turned = places @ transform[:3, :3].T
    pose = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), -skew(turned)], axis=2)
    rows, columns, right = [], [[] for _ in range(6)], []
    for side, (camera, move) in enumerate(zip(rig.cameras, rig.from_camera, strict=True)):
        found, slopes = project(camera, (turned + transform[:3, 3]) @ move[:3, :3].T + move[:3, 3])
        whiten = np.linalg.inv(np.linalg.cholesky(spreads[:, side]))
        rows.append(whiten @ slopes @ move[:3, :3] @ pose)
        right.append(np.einsum("nij,nj->ni", whiten, pixels[:, side] - found))
        before, after = (
            project(camera, places @ one[:3, :3].T + one[:3, 3])[0] for one in move @ ends
        )
        late = (found[:, 1:] / camera.height - 0.5) * (after - before)
        shared = [np.eye(2)[i] * (own == side) for own in range(2) for i in range(2)]
        for column, part in zip(columns, [*shared, side * (after - before), late], strict=True):
            column.append(whiten @ np.broadcast_to(part, found.shape)[..., None])
    rows, right = np.concatenate(rows).reshape(-1, 6), np.concatenate(right).ravel()
    spread = np.zeros((6, 6))
    for k, column in enumerate(columns):
        column = np.concatenate(column).ravel()
        change = np.linalg.lstsq(rows, column, rcond=None)[0]
        rest = column - rows @ change
        deviation = 1.0 / np.sqrt(rest @ rest + 1.0)
        beyond = max(abs(rest @ right) * deviation - LARGEST_DELAY, 0.0)
        size = shifts[k // 2] if k < 4 else DELAY_SHARE * deviation * beyond
        spread += size**2 * np.outer(change, change)
    return spread


def _decrease(rows, right):
    rest = right - rows @ np.linalg.lstsq(rows, right, rcond=None)[0]
    return right @ right - rest @ rest


def agreeing(kept, fewest, seen, rig, radius, places, normals, planes):
    """Stickers of ``kept`` that agree, their fit, and the growth of covariances; None when lost."""
    left_out = 0
    while len(kept) >= fewest and len(kept) > left_out:
        own = places[seen.index[kept]], seen.points[kept], seen.covariances[kept]
        transform, covariance, squared = fitted(*own)
        total, freedom = squared.sum(), 3 * len(kept) - 6
        found = place_misfits(transform, covariance, *own)
        found = np.array([m / excess(total - m, freedom - 3) for m in found])
        outline = np.zeros(len(kept))
        if seen.outlines is not None:
            expected = outlines(rig, transform, own[0], normals[seen.index[kept]], radius)
            shown = seen.outlines.shapes[:, kept], seen.outlines.covariances[:, kept]
            outline = outline_misfits(*shown, expected).max(axis=0)
        misfits, growth = np.maximum(found, outline), excess(total, freedom)
        agreed = misfits.max() <= LARGEST_MISFIT
        if outline.max() <= LARGEST_MISFIT and not agreed:
            agreed = slip(transform, *own, planes[seen.index[kept]])[0] > growth * found.max()
        if agreed and growth <= LARGEST_EXCESS:
            return kept, transform, covariance, growth
        kept, left_out = np.delete(kept, misfits.argmax()), left_out + 1
    return None


def few_growth(seen, kept, rejected, transform, covariance, places):
    """Mean square of the residuals of all stickers, with the tail of Student's distribution."""
    every = np.concatenate([kept, rejected])
    turned = places[seen.index[every]] @ transform[:3, :3].T
    gaps = seen.points[every] - turned - transform[:3, 3]
    slopes = np.concatenate([np.tile(np.eye(3), (len(every), 1, 1)), -skew(turned)], axis=2)
    spread = seen.covariances[every].copy()
    spread[len(kept) :] += (slopes @ covariance @ slopes.swapaxes(1, 2))[len(kept) :]
    squared = np.einsum("ni,nij,nj->n", gaps, np.linalg.inv(spread), gaps)
    squared[len(kept) :] = np.minimum(squared[len(kept) :], LARGEST_MISFIT)
    mean = max(squared.sum() / (3 * len(every) - 6), 1.0)
    return mean * 6.0 * f.ppf(TAIL, 6, 3 * len(kept) - 6) / chi2.ppf(TAIL, 6)


def consistent(seen, rig, radius, places, normals, planes):
    """Stickers that agree: their index, camera_from_body and its covariance; None when lost."""
    scene = seen, rig, radius, places, normals, planes
    found = agreeing(np.arange(len(seen.index)), FEWEST, *scene)
    if found is None:
        return None
    kept, transform, covariance, growth = found
    rejected = np.setdiff1d(np.arange(len(seen.index)), kept)
    if agreeing(rejected, FEWEST_RIVALS, *scene) is not None:
        return None
    own = places[seen.index[kept]], seen.points[kept], seen.covariances[kept]
    warped = warp(transform, *own, seen.rays[kept])
    size, spread = slip(transform, *own, planes[seen.index[kept]])
    slipped = size > growth * chi2.isf(SLIP_CHANCE / 3.0, 3)
    factors = [growth * (EXCESS_SHARE if growth > 1.0 else 1.0)]
    if 2 * len(kept) <= len(seen.index):
        factors.append(few_growth(seen, kept, rejected, transform, covariance, places))
    beyond = max(warped - growth * chi2.isf(WARP_CHANCE, 10), 0.0)
    factors.append(growth + WARP_SHARE * beyond / 10.0)
    return seen.index[kept], transform, max(factors) * covariance + slipped * spread
