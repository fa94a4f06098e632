"""Test your own pose estimator: any callable from a stereo frame to a pose.

This one takes grey centroids of bright blobs, triangulates and fits a rigid motion. It starts from
where the stickers would be with the platform at home, so the platform must not be far from there.
"""

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import cmmsim

REACH = np.array([0.005, 0.005, 0.005, 0.02, 0.02, 0.02])  # m and rad around home
FARTHEST_PX = 20.0  # largest motion of a sticker's image within this reach
BRIGHT, GROUND = 100, 40  # grey values inside of a blob, and of the background
AREA_PX = (15, 400)


class BlobEstimator:
    """Map a stereo frame to the pose (6,) [m, rad] of the platform in the base frame."""

    def __init__(self, rig: cmmsim.StereoRig, taught: cmmsim.Taught, home: np.ndarray) -> None:
        self.rig, self.taught = rig, taught
        camera_from_platform = np.linalg.inv(taught.base_from_camera) @ cmmsim.pose_to_transform(
            home
        )
        places = (
            taught.platform_places @ camera_from_platform[:3, :3].T + camera_from_platform[:3, 3]
        )
        self.expected, _ = rig.project(places)  # pixels (2, n, 2)

    def __call__(self, frame: cmmsim.StereoFrame) -> np.ndarray:
        left, right = (
            self.find(frame.left, self.expected[0]),
            self.find(frame.right, self.expected[1]),
        )
        seen = np.isfinite(left + right).all(axis=1)
        # Triangulation is for lenses without distortion.
        ideal = self.rig.left.undistort(left[seen])[0], self.rig.right.undistort(right[seen])[0]
        points = cv2.triangulatePoints(*self.rig.projection_matrices, ideal[0].T, ideal[1].T)
        points, places = (points[:3] / points[3]).T, self.taught.platform_places[seen]
        turn, _ = Rotation.align_vectors(points - points.mean(axis=0), places - places.mean(axis=0))
        camera_from_platform = np.eye(4)
        camera_from_platform[:3, :3] = turn.as_matrix()
        camera_from_platform[:3, 3] = points.mean(axis=0) - turn.apply(places.mean(axis=0))
        return cmmsim.transform_to_pose(self.taught.base_from_camera @ camera_from_platform)

    def find(self, image: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Centres (n, 2) of the blobs nearest to the expected pixels (n, 2), NaN where there is
        none.
        """
        blobs = blob_centres(image)
        distance, index = cKDTree(blobs).query(near, distance_upper_bound=FARTHEST_PX)
        return np.where(
            np.isfinite(distance)[:, None], blobs[np.minimum(index, len(blobs) - 1)], np.nan
        )


def blob_centres(image: np.ndarray) -> np.ndarray:
    """Grey centroids (m, 2) of all bright blobs."""
    _, _, boxes, _ = cv2.connectedComponentsWithStats((image > BRIGHT).astype(np.uint8))
    centres = []
    for x, y, width, height, area in boxes[1:]:
        if AREA_PX[0] <= area <= AREA_PX[1]:
            window = image[y - 2 : y + height + 2, x - 2 : x + width + 2]
            moments = cv2.moments(np.clip(window.astype(float) - GROUND, 0, None))
            centres.append(
                (x - 2 + moments["m10"] / moments["m00"], y - 2 + moments["m01"] / moments["m00"])
            )
    return np.array(centres)


@pytest.fixture
def estimate_pose(cmmsim_sensor):
    return BlobEstimator(cmmsim_sensor.rig, cmmsim_sensor.taught, cmmsim_sensor.home)


def test_pose_error(accuracy, cmmsim_sensor, cmmsim_seed, estimate_pose):
    shifts = REACH * np.random.default_rng(cmmsim_seed).uniform(-1, 1, (12, 6))
    poses = cmmsim_sensor.home + shifts
    errors = 1e6 * np.array([estimate_pose(cmmsim_sensor.capture(pose)) - pose for pose in poses])
    accuracy.sample("position error", np.linalg.norm(errors[:, :3], axis=1), unit="um", limit=25)
    accuracy.sample(
        "orientation error", np.linalg.norm(errors[:, 3:], axis=1), unit="urad", limit=150
    )
    cmmsim_sensor.start_run(cmmsim_seed)
    built_in = 1e6 * np.array([cmmsim_sensor.measure(pose).pose - pose for pose in poses])
    accuracy.sample(
        "position error, built-in estimator", np.linalg.norm(built_in[:, :3], axis=1), unit="um"
    )
    accuracy.sample(
        "orientation error, built-in estimator",
        np.linalg.norm(built_in[:, 3:], axis=1),
        unit="urad",
    )
