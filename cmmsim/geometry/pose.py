"""Poses and transforms, and the covariance of a pose from that of a transform.

A pose is ``[x y z alpha beta gamma]`` in m and rad with R = Rx(alpha) Ry(beta) Rz(gamma) (paper eq.
1). A transform is a 4x4 matrix with a name of the form output_from_input, such as
``camera_from_base``. Adjacent names then cancel in a product. A small error of a transform is
``[dt, dphi]``: the shift of its origin, and the rotation vector that is applied on the left. Both
are in the axes of the output frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmmsim.checks import finite_array
from cmmsim.errors import ShapeError

Array = NDArray[np.float64]

# Largest accepted deviation of a transform from a rigid one. Single precision is accepted.
RIGID_TOLERANCE = 1e-6


def frozen(values: ArrayLike) -> Array:
    """Return a copy of the values as a read-only array."""
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array


IDENTITY = frozen(np.eye(4))


def checked_pose(pose: ArrayLike) -> Array:
    """Return a copy of a pose (6,). Raises ShapeError unless it is six finite numbers."""
    return finite_array(pose, (6,), "a pose is six finite numbers [x y z alpha beta gamma]")


def pose_to_transform(pose: ArrayLike) -> Array:
    """Return the transform of a pose.

    Parameters
    ----------
    pose : array_like, shape (6,)
        Position in m and angles in rad, with R = Rx(alpha) Ry(beta) Rz(gamma).

    Returns
    -------
    ndarray, shape (4, 4)

    Raises
    ------
    ShapeError
        If the pose is not six finite numbers.

    Examples
    --------
    >>> pose_to_transform([0.1, 0.0, 0.2, 0.0, 0.0, 0.0])[:3, 3]
    array([0.1, 0. , 0.2])
    """
    return transforms_of(checked_pose(pose))


def transforms_of(poses: Array) -> Array:
    """Return the transforms (..., 4, 4) of poses (..., 6)."""
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.transform_kernels import pose_transforms

    transforms = np.empty((*poses.shape[:-1], 4, 4))
    flat = np.ascontiguousarray(poses, dtype=float).reshape(-1, 6)
    pose_transforms(flat, transforms.reshape(-1, 4, 4))
    return transforms


def checked_transform(transform: ArrayLike, name: str = "a transform") -> Array:
    """Return a copy of a transform (4, 4).

    Raises ShapeError, whose message begins with ``name``, unless it is a rigid motion of 4x4 finite
    numbers. A transposed, scaled or mirrored transform is not rigid.
    """
    values = finite_array(transform, (4, 4), f"{name} must be (4,4) and finite")
    rotation = values[:3, :3]
    last = values[3]
    if np.abs(last - [0.0, 0.0, 0.0, 1.0]).max() > RIGID_TOLERANCE:
        raise ShapeError(
            f"{name} must have the last row [0 0 0 1], got {last.tolist()}; is it transposed?"
        )
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > RIGID_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise ShapeError(
            f"{name} must be rigid: its rotation R has |R^T R - I| = {error:.3g} (at most "
            f"{RIGID_TOLERANCE:g}) and determinant {np.linalg.det(rotation):.6g} (1)"
        )
    return values


def all_rigid(transforms: Array) -> bool:
    """Return True if ``checked_transform`` would accept all transforms (k, 4, 4)."""
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.transform_kernels import farthest_from_rigid

    return bool(farthest_from_rigid(np.ascontiguousarray(transforms)) <= RIGID_TOLERANCE)


def transform_to_pose(transform: ArrayLike) -> Array:
    """Return the pose of a transform.

    Parameters
    ----------
    transform : array_like, shape (4, 4)
        Rigid transform.

    Returns
    -------
    ndarray, shape (6,)
        Position in m and angles in rad; beta lies in [-pi/2, pi/2], alpha and gamma in [-pi, pi].

    Raises
    ------
    ShapeError
        If the transform is not rigid.

    Examples
    --------
    >>> transform = pose_to_transform([0.1, 0.0, 0.2, 0.25, 0.0, 0.0])
    >>> round(float(transform_to_pose(transform)[3]), 9)
    0.25
    """
    return poses_of(checked_transform(transform))


def poses_of(transforms: Array) -> Array:
    """Return the poses (..., 6) of rigid transforms (..., 4, 4)."""
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.transform_kernels import transform_poses

    poses = np.empty((*transforms.shape[:-2], 6))
    flat = np.ascontiguousarray(transforms, dtype=float).reshape(-1, 4, 4)
    transform_poses(flat, poses.reshape(-1, 6))
    return poses


def rigid(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Return the transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    transform = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation
    transform[..., 3, 3] = 1.0
    return transform


def invert(transform: Array) -> Array:
    """Return the inverses (..., 4, 4) of rigid transforms (..., 4, 4)."""
    transposed = transform[..., :3, :3].swapaxes(-1, -2)
    return rigid(transposed, -(transposed @ transform[..., :3, 3:])[..., 0])


def apply(transform: Array, points: Array) -> Array:
    """Return points (..., 3) transformed by a transform (4, 4)."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def apply_each(transforms: Array, points: Array) -> Array:
    """Return points (..., n, 3) transformed by each of the transforms (..., 4, 4).

    ``points`` is one set (n, 3) for all transforms, or one set per transform (..., n, 3).
    """
    return np.asarray(
        points @ transforms[..., :3, :3].swapaxes(-1, -2) + transforms[..., None, :3, 3]
    )


def skew(vectors: Array) -> Array:
    """Return the cross product matrices (..., 3, 3) of vectors (..., 3)."""
    result = np.zeros((*vectors.shape, 3))
    x = vectors[..., 0]
    y = vectors[..., 1]
    z = vectors[..., 2]
    result[..., 0, 1] = -z
    result[..., 0, 2] = y
    result[..., 1, 2] = -x
    result[..., 1, 0] = z
    result[..., 2, 0] = -y
    result[..., 2, 1] = x
    return result


def point_jacobian(arms: Array) -> Array:
    """Return the derivatives (..., 3, 6) of points for a small error [dt, dphi] of their transform.

    ``arms`` (..., 3) lead from the transform's origin to the points, in output axes.
    """
    return np.concatenate([np.broadcast_to(np.eye(3), (*arms.shape, 3)), -skew(arms)], axis=-1)


def rotation_exp(vector: Array) -> Array:
    """Return the rotation (3, 3) of a rotation vector (3,), by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    k = skew(vector)
    return (
        # written with sinc, Rodrigues' formula loses no digits at small angles
        np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * k @ k
    )


def rotation_log(rotation: Array) -> Array:
    """Return the rotation vector (3,) of a rotation (3, 3), whose angle must be well below pi."""
    axis = 0.5 * np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = float(np.linalg.norm(axis))
    cosine = 0.5 * (np.trace(rotation) - 1.0)
    # for a tiny angle, the rotation vector equals ``axis`` to first order
    return axis if sine < 1e-12 else axis * (np.arctan2(sine, cosine) / sine)


def small_movement(moved: Array, transform: Array) -> Array:
    """Return the small movement [dt, dphi] (6,) that turns a transform (4, 4) into ``moved``.

    A point p in the output frame moves by dt + dphi x p. Unlike a small error, the movement thus
    turns the transform about the origin of the output frame.
    """
    rotation = moved[:3, :3] @ transform[:3, :3].T
    return np.concatenate([moved[:3, 3] - rotation @ transform[:3, 3], rotation_log(rotation)])


def euler_rates_matrix(pose: Array) -> Array:
    """Return the matrices (..., 3, 3) that map rates of pose angles to angular velocities (eq. 2).

    Poses are (..., 6), and angular velocities are in the axes of the output frame.
    """
    ca = np.cos(pose[..., 3])
    sa = np.sin(pose[..., 3])
    cb = np.cos(pose[..., 4])
    sb = np.sin(pose[..., 4])
    rates = np.zeros((*pose.shape[:-1], 3, 3))
    rates[..., 0, 0] = 1.0
    rates[..., 0, 2] = sb
    rates[..., 1, 1] = ca
    rates[..., 1, 2] = -sa * cb
    rates[..., 2, 1] = sa
    rates[..., 2, 2] = ca * cb
    return rates


def pose_jacobian(poses: Array) -> Array:
    """Return the derivatives (..., 6, 6) of poses (..., 6) with respect to small errors [dt, dphi].

    The small errors are those of the poses' transforms. At beta = ±pi/2 the derivatives are
    singular.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.transform_kernels import all_angle_rates

    flat = np.ascontiguousarray(poses, dtype=float).reshape(-1, 6)
    rates = np.empty((len(flat), 3, 3))
    all_angle_rates(flat, rates)
    jacobian = np.zeros((*poses.shape[:-1], 6, 6))
    jacobian[..., :3, :3] = np.eye(3)
    jacobian[..., 3:, 3:] = rates.reshape(*poses.shape[:-1], 3, 3)
    return jacobian


def pose_covariance(transforms: Array, covariances: Array) -> Array:
    """Return the covariances (..., 6, 6) of the poses of transforms (..., 4, 4), to first order.

    ``covariances`` (..., 6, 6) are those of the transforms' small errors [dt, dphi], which
    ``pose_fit_kernels`` computes for a transform that is fitted to points.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.transform_kernels import pose_covariances

    converted = np.empty(covariances.shape)
    poses = poses_of(transforms).reshape(-1, 6)
    flat = np.ascontiguousarray(covariances, dtype=float).reshape(-1, 6, 6)
    pose_covariances(poses, flat, converted.reshape(-1, 6, 6))
    return converted


def compose_covariance(outer: Array, covariance: Array) -> Array:
    """Return the covariance (..., 6, 6) of the small error of a product ``outer @ inner``.

    ``covariance`` (..., 6, 6) belongs to ``inner``, and ``outer`` (4, 4) is exact.
    """
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = outer[:3, :3]
    return turn @ covariance @ turn.T
