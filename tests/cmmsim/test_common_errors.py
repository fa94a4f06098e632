"""What a rig that is known only so well does to all poses of a run: against the whole chain, and
against images.
"""

from dataclasses import replace

import numpy as np
import pytest

import cmmsim
from cmmsim.errors import CmmError
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, pose_to_transform, transform_to_pose
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.geometry.triangulation import triangulate
from cmmsim.measuring.measurement import lost_measurement
from cmmsim.measuring.observation import faces_camera
from cmmsim.uncertainty.common_errors import NAMES, MeasuringGeometry
from cmmsim.uncertainty.known_rig import PHOTOGRAPHED, KnownRig, rig_changes
from tests.cmmsim.sensors import exact

BOX = np.array([0.01, 0.01, 0.01, 0.04, 0.04, 0.04])
OFF = {
    "left.fx_px": 0.5,
    "right.cx_px": 0.2,
    "left.cy_px": -0.1,
    "right_from_left.ry_rad": 2e-5,
    "right.k1": 2e-4,
}


@pytest.fixture(scope="module")
def geometry():
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic")
    return MeasuringGeometry(sensor.rig, sensor.platform, sensor.base, sensor.truth, sensor.home)


def seen_by_both(geometry):
    placed = [
        move @ geometry.camera_from_base @ pose_to_transform(geometry.home)
        for move in geometry.rig.from_camera
    ]
    places, normals = geometry.taught.platform_places, geometry.platform.sticker_normals
    return np.all(
        [faces_camera(apply(at, places), normals @ at[:3, :3].T) for at in placed], axis=0
    )


def measured(geometry, true, poses, later=None):
    """Poses (N, 6) that the known rig measures through another one, taught by it as well; `later`
    (N, 6): the poses at which the right camera exposes."""
    base_from_camera, places = (one[0] for one in geometry._teach([true]))
    keep, found = seen_by_both(geometry), []
    for each in zip(poses, poses if later is None else later, strict=True):
        points = [
            apply(geometry.camera_from_base @ pose_to_transform(p), geometry.taught.platform_places)
            for p in each
        ]
        pixels = np.stack([true.project(points[side])[0][side] for side in (0, 1)])
        spread = np.tile(np.eye(2), (2, len(places), 1, 1))
        seen = triangulate(geometry.rig, pixels[0], pixels[1], spread[0], spread[1])
        camera_from_platform = register(
            places[keep], seen.points[keep], seen.covariances[keep]
        ).transform
        found.append(transform_to_pose(base_from_camera @ camera_from_platform))
    return np.array(found)


def test_changes_of_poses_are_those_of_the_whole_chain_with_a_moved_rig(geometry):
    rng = np.random.default_rng(0)
    poses = geometry.home + BOX * rng.uniform(-1, 1, (3, 6))
    rates = rng.normal(0.0, 0.05, (3, 6))
    found = geometry.common_errors(poses, rates, np.eye(24), 1.0)
    assert found.names == (
        *PARAMETER_NAMES,
        NAMES[-1],
    )  # frames that were taught without error are left out
    for name, size in OFF.items():
        more, less = (
            measured(geometry, geometry.rig.moved(rig_changes({name: end})), poses)
            for end in (size, -size)
        )
        expected = (more - less) / (2.0 * size)
        changes = found.changes[:, :, PARAMETER_NAMES.index(name)]
        np.testing.assert_allclose(changes, expected, atol=2e-3 * np.abs(expected).max())
    more, less = (
        measured(geometry, geometry.rig, poses, poses + step * rates) for step in (1e-4, -1e-4)
    )
    expected = (more - less) / 2e-4
    np.testing.assert_allclose(
        found.changes[:, :, -1], expected, atol=2e-3 * np.abs(expected).max()
    )


def test_errors_of_teaching_have_the_covariance_that_teaching_states(geometry):
    rng = np.random.default_rng(1)
    spread = [(root := 1e-6 * rng.standard_normal((6, 6))) @ root.T for _ in range(2)]
    taught = replace(geometry.taught, base_covariance=spread[0], platform_covariance=spread[1])
    pose = geometry.home + BOX * rng.uniform(-1, 1, 6)
    found = replace(geometry, taught=taught).common_errors(
        pose[None], np.zeros((1, 6)), np.zeros((24, 24))
    )
    assert len(found.names) == 12
    np.testing.assert_allclose(
        found.pose_covariances[0], taught.calibration_covariance(pose), rtol=1e-9, atol=1e-18
    )


def test_draws_of_a_rig_spread_as_its_covariance_says_and_what_is_none_is_refused():
    rig, _ = rig_from_file(read_sensor_file("ctrack780").rig)
    root = np.zeros((24, 24))
    root[:4, :4] = np.random.default_rng(0).standard_normal((4, 4))
    rng, covariance, count = np.random.default_rng(1), root @ root.T, 500
    drawn = np.array(
        [rig.parameters - KnownRig.drawn(rig, covariance, rng).rig.parameters for _ in range(count)]
    )
    variances = np.diag(covariance)[:4]
    chance = np.sqrt((np.outer(variances, variances) + covariance[:4, :4] ** 2) / count)
    assert (np.abs(np.cov(drawn.T) - covariance)[:4, :4] < 4.0 * chance).all()
    assert np.abs(drawn[:, 4:]).max() < 1e-9
    for spoilt, words in (
        (-np.eye(24), "variance of left.fx_px is negative"),
        (np.eye(24) + np.triu(root + 1), "row is not symmetric"),
    ):
        with pytest.raises(CmmError, match=words):
            KnownRig(rig, spoilt)


def test_the_common_part_is_that_of_many_calibrations_and_is_added_to_the_noise_only_when_asked(
    geometry,
):
    """Poses of 60 rigs that one covariance draws, each of which taught itself: their mean squared
    error is 6 in units of the common part, with a deviation of 0.45; one with noise beside it is 6
    in units of both."""
    rng, pose = np.random.default_rng(4), geometry.home + 0.5 * BOX
    covariance = 1e-2 * PHOTOGRAPHED
    stated = geometry.pose_covariance(pose, covariance)
    rigs = [KnownRig.drawn(geometry.rig, covariance, rng).rig for _ in range(60)]
    errors = np.array([measured(geometry, rig, pose[None])[0] - pose for rig in rigs])
    assert np.mean(
        np.einsum("ni,ij,nj->n", errors, np.linalg.inv(stated), errors)
    ) == pytest.approx(6.0, abs=1.4)
    sensor = exact()
    one = replace(sensor.measure(pose), common_at=lambda _: stated)
    noisy = errors + rng.multivariate_normal(np.zeros(6), one.covariance, len(errors))
    weights = np.linalg.inv(one.single_covariance)
    assert np.mean(np.einsum("ni,ij,nj->n", noisy, weights, noisy)) == pytest.approx(6.0, abs=1.4)


@pytest.mark.slow
def test_a_measurement_states_what_is_known_of_its_common_part(geometry):
    sensor = exact()
    assert not sensor.measure(sensor.home).common_covariance.any()
    assert "in common" not in repr(sensor.measure(sensor.home))
    file, taught = (
        read_sensor_file("ctrack780"),
        replace(sensor.truth, known=KnownRig(sensor.rig, 1e-2 * PHOTOGRAPHED)),
    )
    stated = {
        method: cmmsim.Sensor(file, 0, method, taught, renderer="analytic").measure(sensor.home)
        for method in ("registration", "planes")
    }
    seen = stated["registration"]
    expected = geometry.pose_covariance(seen.pose, 1e-2 * PHOTOGRAPHED)
    np.testing.assert_allclose(seen.common_covariance, expected, rtol=1e-9)
    assert np.isnan(stated["planes"].common_covariance).all()
    assert np.isnan(lost_measurement("dark").common_covariance).all()


@pytest.mark.thorough
def test_poses_measured_with_the_cameras_of_photographs_are_off_as_predicted_down_to_the_noise():
    """Taught and measured from images, in motion, with a right camera that exposes later: of errors
    of 200 um, what a rig that is off in all its numbers explains to first order leaves noise and
    what teaching states."""
    file, later = read_sensor_file("ctrack780"), 2e-4
    true, _ = rig_from_file(file.rig)
    known = KnownRig.drawn(true, PHOTOGRAPHED, np.random.default_rng(0), exposure_std=later)
    sensor = cmmsim.Sensor(file, 0, renderer="analytic", known=known)
    sensor.move_rig({}, right_later=later)
    poses = sensor.home + BOX * np.random.default_rng(2).uniform(-1, 1, (10, 6))
    rates = np.tile([0.05, -0.02, 0.03, 0.1, 0.0, -0.1], (10, 1))
    found = sensor.common_errors(poses, rates)
    drawn = dict(zip(PARAMETER_NAMES, true.parameters - known.rig.parameters, strict=True)) | {
        NAMES[-1]: later
    }
    predicted = found.changes @ [drawn.get(name, 0.0) for name in found.names]
    measured = [
        sensor.measure(pose, pose_rate=rate) for pose, rate in zip(poses, rates, strict=True)
    ]
    errors = np.array([one.pose for one in measured]) - poses
    taught = sensor.taught.calibration_covariance(sensor.home)
    rig = np.mean([np.diag(one.common_covariance - taught)[:3] for one in measured])
    assert 0.5 < np.sqrt(np.mean(errors[:, :3] ** 2) / rig) < 2.0  # one draw of some ten directions
    left = errors - predicted
    stated = np.sqrt(np.mean([np.diag(one.covariance + taught) for one in measured], axis=0))
    assert np.sqrt(np.mean(errors[:, :3] ** 2)) > 1e-4
    assert (np.sqrt(np.mean(left**2, axis=0)) < 2.0 * stated).all(), (
        np.sqrt(np.mean(left**2, axis=0)) / stated
    )
