"""Predicted covariance against sampling: pixel noise is drawn 2,000 times, without rendering."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.files.setup import marked_body
from cmmsim.geometry.pose import apply, compose_covariance, pose_covariance, pose_to_transform, transform_to_pose
from cmmsim.geometry.stereo_rig import toed_in_rig, triangulate
from cmmsim.pose_estimation.estimator import by_planes, by_registration
from cmmsim.pose_estimation.observation import StickerObservation
from tests.cmmsim.sensors import CAMERA, require_regions, require_true, squares

FILE = read_sensor_file("ctrack780")
BODY = marked_body("platform", FILE.platform)
RIG, CAMERA_FROM_BASE = toed_in_rig(CAMERA, 1.0, np.array(FILE.rig.position), np.array(FILE.rig.target))
BASE_FROM_CAMERA = np.linalg.inv(CAMERA_FROM_BASE)
POSES = [
    FILE.platform.home,
    (0.008, -0.009, 0.195, 0.04, -0.03, 0.035),
    (-0.009, 0.006, 0.208, -0.03, 0.035, -0.04),
]


def pixel_covariances(rng, count):
    """Unlike ones, as tilted stickers have them: 0.006 to 0.012 px along their axes."""
    turn = Rotation.from_rotvec(rng.uniform(0.0, np.pi, (count, 1)) * [[0.0, 0.0, 1.0]]).as_matrix()[:, :2, :2]
    return turn @ (np.eye(2) * rng.uniform(0.006, 0.012, (count, 1, 2)) ** 2) @ turn.transpose(0, 2, 1)


def drawn(pose, count):
    """True camera_from_body and points, and observations of them."""
    rng = np.random.default_rng(7)
    camera_from_body = CAMERA_FROM_BASE @ pose_to_transform(pose)
    points = apply(camera_from_body, BODY.nominal)
    pixels = RIG.project(points)[0]
    spread = [pixel_covariances(rng, len(points)) for _ in range(2)]
    roots = [np.linalg.cholesky(s) for s in spread]
    observed = []
    for _ in range(count):
        left, right = (
            q + np.einsum("nij,nj->ni", r, rng.standard_normal(q.shape)) for q, r in zip(pixels, roots, strict=True)
        )
        seen = triangulate(RIG, left, right, *spread)
        observed.append(StickerObservation(np.arange(len(points)), left, right, seen.points, seen.covariances))
    return camera_from_body, points, observed


EACH = pytest.mark.parametrize("pose", POSES, ids=["home", "corner", "other corner"])


@EACH
def test_point_covariance(pose):
    _, points, observed = drawn(pose, 2000)
    errors = np.stack([o.points - points for o in observed])
    require_true(squares(errors, np.stack([o.covariances for o in observed])), 3)


@pytest.mark.parametrize(
    ("method", "count"),
    [("registration", 2000), ("planes", 300), pytest.param("planes", 2000, marks=pytest.mark.thorough)],
)
@EACH
def test_pose_covariance(pose, method, count):
    camera_from_body, _, observed = drawn(pose, count)
    errors, covariances = [], []
    for seen in observed:
        if method == "planes":
            found, covariance, _ = by_planes(seen, BODY, BODY.normals @ camera_from_body[:3, :3].T)
        else:
            found, covariance, _ = by_registration(seen, BODY.nominal)
        base_from_body = BASE_FROM_CAMERA @ found
        errors.append(transform_to_pose(base_from_body) - pose)
        covariances.append(pose_covariance(base_from_body, compose_covariance(BASE_FROM_CAMERA, covariance)))
    errors, covariances = np.array(errors), np.array(covariances)
    squared = squares(errors, covariances)
    require_true(squared)
    require_regions(squared)
    assert np.abs(errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(count))).max() < 4.5  # no bias


@EACH
def test_registration_beats_planes(pose):
    camera_from_body, _, (seen,) = drawn(pose, 1)
    planes = by_planes(seen, BODY, BODY.normals @ camera_from_body[:3, :3].T)[1]
    rigid = by_registration(seen, BODY.nominal)[1]
    assert np.all(np.linalg.eigvalsh(planes - rigid) > -1e-16)
