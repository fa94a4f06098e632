"""The frame that three planes A, B and C define (paper section 4.2).

The origin is the intersection of the planes. The z axis is the normal of A. The x axis, along the
intersection line of A and B, is the cross product of the normals of A and B. The y axis is the
cross product of z and x. A plane is n . p = d with the unit normal n.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, rigid
from cmmsim.geometry.registration import SMALLEST_SPREAD

PLANE_NAMES = ("A", "B", "C")
FEWEST_STICKERS = 3


@dataclass(frozen=True)
class FittedPlane:
    """One plane, or an array (...) of planes.

    Planes have unit normals (..., 3), offsets d (...), m, and two unit tangents (..., 3, 2). The
    covariance (..., 3, 3) is that of three parameters: two tilts, rad, and d, m. The tilts (2,)
    change the normal by tangents @ tilts.
    """

    normal: Array
    offset: Array
    tangents: Array
    covariance: Array


def fit_plane(
    points: Array, covariances: Array, rough_normals: Array, name: str = ""
) -> FittedPlane:
    """Fit a weighted least-squares plane to points (n, 3) with covariances (n, 3, 3).

    For sets of points (..., n, 3) the result is one plane per set. Each normal points to the side
    of ``rough_normals`` (..., 3). Raises LostError, which names the plane ``name``, for fewer than
    three points, or if the points of a set lie on one line (SMALLEST_SPREAD).
    """
    count = points.shape[-2]
    if count < FEWEST_STICKERS:
        raise LostError(
            f"plane {name}: {count} visible stickers, but at least {FEWEST_STICKERS} are needed"
        )
    middle = points.mean(axis=-2)
    arms = points - middle[..., None, :]
    _, widths, axes = np.linalg.svd(arms)
    if (width := float(widths[..., 1].min())) < SMALLEST_SPREAD:
        raise LostError(
            f"plane {name}: its {count} visible stickers lie on one line to within "
            f"{width * 1e3:.1f} mm, but at least {SMALLEST_SPREAD * 1e3:.0f} mm of width is needed"
        )
    normal = axes[..., 2, :]
    normal = normal * np.where(_dot(normal, rough_normals) > 0.0, 1.0, -1.0)[..., None]
    # Distance along the normal from the middle of the points to the plane.
    shift = np.zeros(normal.shape[:-1])
    # the start is the unweighted plane, so two weighted steps converge to rounding errors
    for _ in range(2):
        tangents = _tangents(normal)
        jacobian = np.concatenate([arms @ tangents, np.full((*arms.shape[:-1], 1), -1.0)], axis=-1)
        weights = 1.0 / np.einsum("...i,...nij,...j->...n", normal, covariances, normal)
        covariance = np.linalg.inv(jacobian.swapaxes(-1, -2) @ (weights[..., None] * jacobian))
        residuals = (arms @ normal[..., None])[..., 0] - shift[..., None]
        change = -(covariance @ (jacobian.swapaxes(-1, -2) @ (weights * residuals)[..., None]))[
            ..., 0
        ]
        shift = shift + change[..., 2]
        normal = normal + (tangents @ change[..., :2, None])[..., 0]
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    tangents = _tangents(normal)
    # the fit has the parameters [tilts, shift], and the offset is shift + n . middle
    to_offset = np.zeros((*shift.shape, 3, 3)) + np.eye(3)
    to_offset[..., 2, :2] = (middle[..., None, :] @ tangents)[..., 0, :]
    covariance = to_offset @ covariance @ to_offset.swapaxes(-1, -2)
    return FittedPlane(normal, shift + _dot(normal, middle), tangents, covariance)


def frame_from_planes(normals: Array, offsets: Array) -> Array:
    """Return camera_from_planes (..., 4, 4) for the frame of planes A, B, C.

    The rows of ``normals`` (..., 3, 3) are the unit normals, and ``offsets`` are (..., 3).
    """
    first = normals[..., 0, :]
    z = first / np.linalg.norm(first, axis=-1, keepdims=True)
    x = np.cross(first, normals[..., 1, :])
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    corner = np.linalg.solve(normals, offsets[..., None])[..., 0]
    return rigid(np.stack([x, np.cross(z, x), z], axis=-1), corner)


def frame_of_points(
    points: Array, covariances: Array, plane_index: NDArray[np.int_], rough_normals: Array
) -> tuple[Array, Array]:
    """Return the frame (4, 4) of planes through measured stickers, and its covariance (6, 6).

    The frame is that of ``frame_from_planes``, and the covariance that of its small error
    [dt, dphi]. Stickers are points (n, 3) m with covariances (n, 3, 3). ``plane_index`` (n,) is 0,
    1 or 2 for a sticker on plane A, B or C. ``rough_normals`` (3, 3) has one row per plane. Raises
    the LostError of ``fit_plane``.
    """
    frame, planes = frames_of_points(points, covariances, plane_index, rough_normals)
    sensitivity = _frame_sensitivity(
        frame, np.stack([p.normal for p in planes]), np.stack([p.tangents for p in planes])
    )
    return frame, sensitivity @ block_diag(*[p.covariance for p in planes]) @ sensitivity.T


def frames_of_points(
    points: Array, covariances: Array, plane_index: NDArray[np.int_], rough_normals: Array
) -> tuple[Array, list[FittedPlane]]:
    """Return the frames (..., 4, 4) of sets of points (..., n, 3), and the planes A, B and C.

    The parameters are those of ``frame_of_points``. All sets have the same ``plane_index`` (n,).
    """
    planes = []
    for k, name in enumerate(PLANE_NAMES):
        on_plane = plane_index == k
        planes.append(
            fit_plane(
                points[..., on_plane, :],
                covariances[..., on_plane, :, :],
                rough_normals[..., k, :],
                name,
            )
        )
    normals = np.stack([plane.normal for plane in planes], axis=-2)
    return frame_from_planes(normals, np.stack([plane.offset for plane in planes], axis=-1)), planes


def _dot(first: Array, second: Array) -> Array:
    return np.einsum("...i,...i->...", first, second)


def _tangents(normal: Array) -> Array:
    """Return two unit vectors (..., 3, 2) that span the plane of ``normal`` (..., 3)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=-1)


def _frame_sensitivity(frame: Array, normals: Array, tangents: Array) -> Array:
    """Return the derivatives (6, 9) of a frame with respect to the parameters of its planes.

    The parameters are two tilts and the offset of A, then of B and of C. The frame is that of
    ``frame_from_planes``, and its changes are small errors [dt, dphi]. The planes have normals
    (3, 3) and tangents (3, 3, 2).
    """
    x, y, z, origin = frame[:3].T
    # derivatives of all normals and offsets with respect to each of the nine parameters
    turned = np.zeros((9, 3, 3))
    shifted = np.zeros((9, 3))
    for plane in range(3):
        turned[3 * plane : 3 * plane + 2, plane] = tangents[plane].T
        shifted[3 * plane + 2, plane] = 1.0
    by_origin = np.linalg.solve(normals, (shifted - turned @ origin).T)
    along = np.cross(turned[:, 0], normals[1]) + np.cross(normals[0], turned[:, 1])
    by_z = turned[:, 0]
    by_x = (along - np.outer(along @ x, x)) / np.linalg.norm(np.cross(normals[0], normals[1]))
    by_y = np.cross(by_z, x) + np.cross(z, by_x)
    return np.vstack(
        [by_origin, 0.5 * (np.cross(x, by_x) + np.cross(y, by_y) + np.cross(z, by_z)).T]
    )
