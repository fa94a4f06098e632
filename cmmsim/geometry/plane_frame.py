"""The frame that three planes define (paper section 4.2).

Origin at the intersection of planes A, B and C, z along A's normal, x along the line A and B share, y = z x x.
A plane is n . p = d with unit normal n.
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
    """normal (3,) unit; offset d, m; tangents (3,2); covariance (3,3) of [turn about each tangent..., d]: the normal
    moves by tangents @ parameters[:2]."""

    normal: Array
    offset: float
    tangents: Array
    covariance: Array


def fit_plane(points: Array, covariances: Array, towards: Array, name: str = "") -> FittedPlane:
    """Weighted least-squares plane through ``points`` (n,3) with covariances (n,3,3).

    ``towards`` (3,) is a rough normal that fixes the sign. Raises LostError with fewer than three points off one line.
    """
    if len(points) < FEWEST_STICKERS:
        raise LostError(f"plane {name}: {len(points)} visible stickers, at least {FEWEST_STICKERS} needed")
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle)
    if spread[1] < SMALLEST_SPREAD:
        raise LostError(
            f"plane {name}: its {len(points)} visible stickers lie on one line "
            f"to {spread[1] * 1e3:.1f} mm, at least {SMALLEST_SPREAD * 1e3:.0f} mm of width is needed"
        )
    normal = axes[2] * (1.0 if axes[2] @ towards > 0.0 else -1.0)
    offset = float(normal @ middle)
    for _ in range(2):
        tangents = _tangents(normal)
        jacobian = np.column_stack([(points - middle) @ tangents, -np.ones(len(points))])
        weights = 1.0 / np.einsum("i,nij,j->n", normal, covariances, normal)
        covariance = np.linalg.inv(jacobian.T @ (weights[:, None] * jacobian))
        residuals = (points - middle) @ normal - (offset - normal @ middle)
        change = -covariance @ (jacobian.T @ (weights * residuals))
        shift = offset - normal @ middle + change[2]
        normal = normal + tangents @ change[:2]
        normal /= np.linalg.norm(normal)
        offset = float(shift + normal @ middle)
    tangents = _tangents(normal)
    # parameters were [turn, shift about the middle]; the offset is shift + n . middle
    to_offset = np.eye(3)
    to_offset[2, :2] = middle @ tangents
    return FittedPlane(normal, offset, tangents, to_offset @ covariance @ to_offset.T)


def frame_from_planes(normals: Array, offsets: Array) -> Array:
    """camera_from_planes (4,4): the frame of planes A, B, C given as unit normals (3,3) by row and offsets (3,)."""
    z = normals[0] / np.linalg.norm(normals[0])
    x = np.cross(normals[0], normals[1])
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), np.linalg.solve(normals, offsets))


def frame_of_points(
    points: Array, covariances: Array, plane_index: NDArray[np.int_], towards: Array
) -> tuple[Array, Array]:
    """Frame (4,4) of the planes through measured stickers, and the covariance (6,6) of its small error [dt, dphi].

    Parameters: points (n,3) and covariances (n,3,3); plane_index (n,) 0, 1, 2 for A, B, C; towards (3,3) rough normals
    by row. Raises LostError that names the plane, the count and the limit.
    """
    planes = [
        fit_plane(points[plane_index == k], covariances[plane_index == k], towards[k], PLANE_NAMES[k]) for k in range(3)
    ]
    normals = np.stack([p.normal for p in planes])
    offsets = np.array([p.offset for p in planes])
    frame = frame_from_planes(normals, offsets)
    sensitivity = _frame_sensitivity(frame, normals, np.stack([p.tangents for p in planes]))
    return frame, sensitivity @ block_diag(*[p.covariance for p in planes]) @ sensitivity.T


def _tangents(normal: Array) -> Array:
    """Two unit vectors (3,2) that span the plane of ``normal``."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(normal, first)])


def _frame_sensitivity(frame: Array, normals: Array, tangents: Array) -> Array:
    """Change (6, 9) of [t, phi] of a frame by two turns and the offset of plane A, of B, and of C, whose tangents are
    (3, 3, 2): the derivative of `frame_from_planes`."""
    x, y, z, origin = frame[:3].T
    turned, shifted = np.zeros((9, 3, 3)), np.zeros((9, 3))  # changes of all normals and offsets
    for plane in range(3):
        turned[3 * plane : 3 * plane + 2, plane] = tangents[plane].T
        shifted[3 * plane + 2, plane] = 1.0
    by_origin = np.linalg.solve(normals, (shifted - turned @ origin).T)
    along = np.cross(turned[:, 0], normals[1]) + np.cross(normals[0], turned[:, 1])
    by_z = turned[:, 0]
    by_x = (along - np.outer(along @ x, x)) / np.linalg.norm(np.cross(normals[0], normals[1]))
    by_y = np.cross(by_z, x) + np.cross(z, by_x)
    return np.vstack([by_origin, 0.5 * (np.cross(x, by_x) + np.cross(y, by_y) + np.cross(z, by_z)).T])
