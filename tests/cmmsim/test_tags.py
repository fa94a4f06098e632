"""Tags of others on the planes of the platform, drawn and found by OpenCV, and the poses from them.

The oracle of a corner is the projection of its place, and that of a covariance is sampling.
"""

import numpy as np
import pytest

from cmmsim import tag_comparison
from cmmsim.detection.tags import REFINEMENTS, find_tags, tag_dictionary
from cmmsim.errors import CmmError, UnknownOptionError
from cmmsim.files.rig_and_bodies import marked_body
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.sensor import Sensor

FILE = read_sensor_file("ctrack780")
SENSOR = Sensor(FILE, renderer="analytic")
BODY = marked_body("platform", FILE.platform)


def test_tags_lie_on_the_planes_between_the_stickers_and_face_outwards():
    tags = tag_comparison.tags_on("APRILTAG_36h11", BODY, FILE.stickers)
    for plane, corners in enumerate(tags.corners):
        np.testing.assert_allclose(corners @ BODY.normals[plane], BODY.offsets[plane], atol=1e-12)
        # Seen from outside, the corners go round clockwise.
        around = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        assert around @ BODY.normals[plane] < 0.0
        own = BODY.nominal[BODY.plane_index == plane]
        axes = BODY.in_plane[BODY.plane_index == plane][0]
        assert np.all(corners @ axes >= (own @ axes).min(axis=0))
        assert np.all(corners @ axes <= (own @ axes).max(axis=0))


def test_opencv_finds_each_tag_where_its_corners_are_projected():
    tags = tag_comparison.tags_on("5X5_100", BODY, FILE.stickers)
    pose = SENSOR.home + np.array([0.004, -0.006, 0.003, 0.02, -0.03, 0.01])
    camera = SENSOR.camera
    frame = tag_comparison._tag_frames(camera, FILE.stickers, tags, pose, 0)[0]
    places = apply(camera.camera_from_base @ pose_to_transform(pose), tags.corners.reshape(-1, 3))
    expected = camera.rig.project(places)[0].reshape(2, 3, 4, 2)
    for image, corners in zip((frame.left, frame.right), expected, strict=True):
        found = find_tags(image, tag_dictionary(tags.name), "subpix")
        assert sorted(found) == [0, 1, 2]
        errors = np.array([found[k] for k in range(3)]) - corners
        assert np.sqrt(np.mean(errors**2)) < 0.25
        assert np.abs(errors.mean(axis=(0, 1))).max() < 0.1


def test_covariance_of_a_pose_from_corners_is_that_of_sampled_noise():
    tags = tag_comparison.tags_on("5X5_100", BODY, FILE.stickers)
    places = tags.corners.reshape(-1, 3)
    rng = np.random.default_rng(1)
    camera_from_platform = SENSOR.camera.camera_from_base @ pose_to_transform(SENSOR.home)
    exact = SENSOR.rig.project(apply(camera_from_platform, places))[0]
    squares = []
    for _ in range(400):
        pixels = exact + rng.normal(0.0, 0.05, exact.shape)
        pose, covariance = tag_comparison._pose_of(SENSOR, places, pixels)
        error = pose - SENSOR.home
        squares.append(error @ np.linalg.solve(covariance, error) / 6.0)
    # The variance is estimated with 42 degrees of freedom, so the mean is that of an F distribution.
    assert np.mean(squares) == pytest.approx(42.0 / 40.0, abs=0.1)


@pytest.mark.thorough
def test_poses_from_tags_are_worse_by_an_order_than_those_from_stickers():
    scores = tag_comparison.compare_tags(FILE, ["APRILTAG_36h11"], 3, np.random.default_rng(0))
    ours, *others = scores
    assert [score.method for score in others] == list(REFINEMENTS)
    assert ours.lost == 0.0
    assert ours.position_bias_um < 0.5
    assert 0.7 < ours.normalised_error < 1.3
    best = min(others, key=lambda score: score.position_bias_um)
    assert best.method == "subpix"
    assert best.position_bias_um > 10.0 * ours.position_bias_um
    assert best.position_scatter_um > 2.0 * ours.position_scatter_um


def test_comparisons_that_cannot_be_made_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(UnknownOptionError, match="unknown dictionary '9X9': valid are 4X4_100"):
        tag_comparison.compare_tags(FILE, ["9X9"], 2, rng)
    with pytest.raises(CmmError, match="needs at least 2 poses, got 1"):
        tag_comparison.compare_tags(FILE, ["5X5_100"], 1, rng)
