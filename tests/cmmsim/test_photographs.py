"""Teaching from pairs of images of any source: places and frames with a true covariance, and poses
measured with them.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import cmmsim
from cmmsim.detection.cramer_rao import cramer_rao_bound
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.from_photographs import sensor_for
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.pose import apply, invert, pose_to_transform, rotation_log
from cmmsim.photographs.pairs import numbered
from cmmsim.photographs.taught_file import taught_as_dict
from cmmsim.uncertainty.known_rig import PHOTOGRAPHED, KnownRig
from tests.cmmsim.photographed import photographed, spread_poses
from tests.cmmsim.plain import rigid_start
from tests.cmmsim.sensors import LENSES, refused, require_true, squares

PAIRS = 24


def statistical(seed=1, **more):
    return cmmsim.load_sensor("ctrack780", renderer="statistical", seed=seed, **more)


def teachings(count, seed):
    """Teachings of one sensor from statistical images of 24 poses, each with its own noise."""
    sensor = statistical()
    poses = spread_poses(PAIRS, seed)
    for k in range(count):
        sensor.start_run(1000 * seed + k)
        yield sensor.teach_from(numbered((sensor.look(pose) for pose in poses), 60.0))


def normalised(errors, covariance):
    """Squared error in units of a covariance that can be singular, per determined direction."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-9 * values[-1]
    return np.sum((vectors[:, kept].T @ errors) ** 2 / values[kept]), int(kept.sum())


def base_error(taught, truth):
    """Small error (6,) of the taught base_from_camera."""
    move = taught.base_from_camera @ invert(truth.base_from_camera)
    return np.concatenate([move[:3, 3], rotation_log(move[:3, :3])])


def square_of(found, truth):
    """Squared error of base frame and places in units of its covariance, and its freedom."""
    places = found.taught.platform_places - truth.platform_places
    errors = np.concatenate([base_error(found.taught, truth), places.ravel()])
    size = len(errors)
    return normalised(errors, found.frames.covariance[:size, :size])


def shape_error(found, true):
    """Errors (n, 3) of places after the best rigid movement onto the true ones."""
    return apply(invert(rigid_start(true, found)), found) - true


def fisher(sensor, poses, base, platform):
    """Fisher information of the places of all stickers, from the bound of each centre.

    The derivatives of centres are differences of projected points, and the poses of the pairs are
    unknown, too. The platform moves within its own axes, which the pseudo-inverse leaves out.
    """
    truth, rig = sensor.truth, sensor.rig
    contrast = float(np.subtract(*sensor.noise.mean_grey(np.array([228, 8]) / 255.0)))
    ground = float(sensor.noise.mean_grey(np.array(8 / 255.0)))
    camera_from_base = invert(truth.base_from_camera)

    def information(camera_from_body, body, places):
        """Information (n, 2, 3, 3) of each place in body axes, from each camera."""
        centres, shapes = sticker_outlines(
            rig, camera_from_body, places, body.sticker_normals, 0.003
        )
        steps = 1e-6 * np.eye(3)
        slopes = (
            np.stack(
                [
                    rig.project(apply(camera_from_body, places + step))[0]
                    - rig.project(apply(camera_from_body, places - step))[0]
                    for step in steps
                ],
                axis=-1,
            )
            / 2e-6
        )
        whole = []
        for side in range(2):
            middle = centres[side] - np.rint(centres[side] - 6.0)
            bound = cramer_rao_bound(middle, shapes[side], 13, contrast, ground, sensor.noise)
            whole.append(slopes[side].swapaxes(1, 2) @ np.linalg.inv(bound) @ slopes[side])
        return sum(whole)

    stand = len(poses) * information(camera_from_base, base, truth.base_places)
    count = len(truth.platform_places)
    total = np.zeros((3 * count + 6 * len(poses),) * 2)
    for k, pose in enumerate(poses):
        own = information(
            camera_from_base @ pose_to_transform(pose), platform, truth.platform_places
        )
        for n, place in enumerate(truth.platform_places):
            rows = np.zeros((3, len(total)))
            rows[:, 3 * n : 3 * n + 3] = np.eye(3)
            turn = np.cross(np.eye(3), place)  # what a turn of the body does to a place
            rows[:, 3 * count + 6 * k :][:, :6] = np.hstack([np.eye(3), turn])
            total += rows.T @ own[n] @ rows
    return stand, np.linalg.pinv(total, rcond=1e-12, hermitian=True)[: 3 * count, : 3 * count]


def pose_errors(taught, poses):
    """Errors (n, 6) of poses that a sensor measures with a result of teaching, and the covariance
    of what they have in common at home."""
    sensor = statistical(seed=5, taught=taught)
    common = sensor.estimator.common_at(sensor.home)
    return sensor.measure_many(poses).poses - poses, common


@pytest.mark.thorough
def test_places_reach_the_cramer_rao_bound_and_all_stated_covariances_are_true():
    """100 teachings from 24 pairs: the mean of normalised errors has a deviation of 0.02, and that
    of 20 mean pose errors of 0.13. Poses scatter as those after the simulated teaching.
    """
    sensor = statistical()
    truth = sensor.truth
    true_base = apply(invert(truth.base_from_camera), truth.base_places)
    stand, bound = fisher(sensor, spread_poses(PAIRS, 7), sensor.base, sensor.platform)
    near = spread_poses(100, 8, 0.009, 0.035)
    total, freedom, shapes, bases, common, scatter = 0.0, 0, [], [], [], []
    for k, found in enumerate(teachings(100, 7)):
        taught = found.taught
        square, determined = square_of(found, truth)
        total += square
        freedom += determined
        shapes.append(shape_error(taught.platform_places, truth.platform_places))
        bases.append(found.bundle.state.places[:18] - true_base)
        if k % 5 == 0:
            errors, shared = pose_errors(taught, near)
            scatter.append(errors - errors.mean(axis=0))
            mean = errors.mean(axis=0)
            common.append(mean @ np.linalg.solve(shared + np.cov(errors.T) / 100, mean) / 6.0)
    assert freedom == 100 * (6 + 48)
    assert total / freedom == pytest.approx(1.0, abs=0.05)
    assert np.mean(common) == pytest.approx(1.0, abs=0.4)
    for errors, covariance in (
        (shapes, bound / 54.0),
        (bases, sum(np.linalg.inv(one) for one in stand) / 54.0),
    ):
        rms, best = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.trace(covariance))
        assert 0.9 * best < rms < 1.2 * best, (rms, best)
    rms = 1e6 * np.sqrt(np.mean(np.square(scatter), axis=(0, 1)))
    usual = pose_errors(cmmsim.load_sensor("ctrack780", renderer="statistical").taught, near)[0]
    today = 1e6 * (usual - usual.mean(axis=0)).std(axis=0)
    assert np.all(rms < 1.1 * today), (rms, today)


def test_a_sensor_measures_with_what_it_was_taught_from_frames(tmp_path):
    """Also after it went through a file."""
    sensor = statistical(seed=3)
    poses = spread_poses(8, 3)
    taught = sensor.teach(frames=[sensor.look(pose) for pose in poses])
    assert sensor.taught is taught
    found = sensor.teach_from(numbered((sensor.look(pose) for pose in poses), 60.0))
    found.save(tmp_path / "taught.json")
    read = cmmsim.read_taught(tmp_path / "taught.json")
    for name, value in vars(found.taught).items():
        np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)
    for one in (sensor, statistical(seed=3, taught=read)):
        measured = one.measure(one.home)
        error = measured.pose - one.home
        assert error @ np.linalg.solve(measured.single_covariance, error) < 22.5


@pytest.mark.thorough
def test_with_ten_images_of_each_pose_poses_are_as_accurate_as_after_the_simulated_teaching():
    sensor = statistical()
    poses, near = np.repeat(spread_poses(PAIRS, 7), 10, axis=0), spread_poses(200, 8, 0.009, 0.035)
    sensor.start_run(700)
    found = sensor.teach_from(numbered((sensor.look(pose) for pose in poses), 60.0))
    errors = pose_errors(found.taught, near)[0]
    usual = pose_errors(statistical(seed=0).taught, near)[0]
    for axes, largest in ((slice(0, 3), 3.3e-6), (slice(3, 6), 12.5e-6)):
        ours = np.sqrt(np.mean(errors[:, axes] ** 2))
        assert ours < min(largest, 1.2 * np.sqrt(np.mean(usual[:, axes] ** 2)))


@pytest.mark.thorough
def test_places_from_rendered_images_are_as_accurate_as_stated():
    """24 pairs: the mean of 54 squares has a deviation of 0.19."""
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", changes=LENSES["distorted"])
    frames = [photographed(sensor, pose) for pose in spread_poses(PAIRS, 40)]
    found = sensor.teach_from(numbered(frames, 60.0))
    assert found.bundle.factor == pytest.approx(1.0, abs=0.1)
    square, freedom = square_of(found, sensor.truth)
    assert square / freedom == pytest.approx(1.0, abs=0.57)


@pytest.mark.thorough
def test_cameras_are_adjusted_within_their_covariance_and_all_errors_stay_as_stated():
    """Ten rigs as known from fifteen photographs of a board. Teaching, rig and poses: means of
    normalised errors, with deviations of 0.06, 0.1 and 0.18."""
    truth, true_rig = statistical().truth, statistical().rig
    poses, near = spread_poses(PAIRS, 7), spread_poses(60, 8, 0.009, 0.035)
    file, free = read_sensor_file("ctrack780"), np.flatnonzero(np.diag(PHOTOGRAPHED))
    std = np.sqrt(np.diag(PHOTOGRAPHED)[free])
    taught, rigs, common, gains = [], [], [], []
    for k in range(10):
        known = KnownRig.drawn(true_rig, PHOTOGRAPHED, np.random.default_rng([3, k]))
        sensor = cmmsim.Sensor(file, seed=50 + k, renderer="statistical", known=known)
        found = sensor.teach_from(numbered((sensor.look(pose) for pose in poses), 60.0))
        taught.append(np.divide(*square_of(found, truth)))
        errors = (found.taught.known.rig.parameters - true_rig.parameters)[free] / std
        spread = found.taught.known.covariance[np.ix_(free, free)] / np.outer(std, std)
        rigs.append(np.divide(*normalised(errors, spread)))
        gains.append(np.sqrt(np.diag(spread)))
        errors, shared = pose_errors(found.taught, near)
        mean = errors.mean(axis=0)
        common.append(mean @ np.linalg.solve(shared + np.cov(errors.T) / 60, mean) / 6.0)
    assert np.mean(taught) == pytest.approx(1.0, abs=0.18)
    assert np.mean(rigs) == pytest.approx(1.0, abs=0.3)
    assert np.mean(common) == pytest.approx(1.0, abs=0.55)
    assert np.max(gains) < 1.0
    assert np.mean(gains) < 0.7


def test_a_sensor_file_states_the_covariance_of_its_cameras(tmp_path):
    path = tmp_path / "mine.toml"
    rows = "".join(f"{row},\n" for row in PHOTOGRAPHED.tolist())
    text = f'name = "mine"\nbased_on = "ctrack780"\n[rig.covariance]\nmatrix = [\n{rows}]\n'
    path.write_text(text)
    sensor = statistical(seed=3)
    images = [sensor.look(pose) for pose in spread_poses(6, 3)]
    found = sensor_for(path).teach_from(numbered(images, 60.0))
    assert np.all(np.diag(found.taught.known.covariance) <= np.diag(PHOTOGRAPHED))
    found.save(tmp_path / "taught.json")
    read = cmmsim.read_taught(tmp_path / "taught.json")
    np.testing.assert_allclose(
        read.known.rig.parameters, found.taught.known.rig.parameters, rtol=1e-12, atol=1e-15
    )
    again = cmmsim.load_sensor(path, renderer="statistical", taught=read)
    assert again.measure(again.home).ok
    path.write_text(text.replace("matrix = [\n[1.0", "matrix = [\n[-1.0"))
    refused(
        lambda: sensor_for(path),
        "mine.toml: rig.covariance.matrix: .*left.fx_px is negative",
        cmmsim.SensorFileError,
    )


@pytest.mark.parametrize(
    "entry",
    [
        ("by_rig", 3, 5),
        ("sticker_radius",),
        ("rig", "exposure_std_s"),
        ("rig", "parameters", "left.k1"),
        ("rig", "parameters", "right_from_left.tx_m"),
    ],
)
def test_a_taught_file_with_a_number_that_is_not_finite_is_refused(tmp_path, entry):
    exact = cmmsim.Taught.without_error("mine", np.eye(4), np.zeros((3, 3)), np.zeros((0, 3)))
    known = KnownRig(statistical().rig, np.zeros((24, 24)))
    taught = replace(exact, known=known, by_rig=np.zeros((15, 24)), radius=0.003)
    part = content = taught_as_dict(taught)
    path = tmp_path / "taught.json"
    path.write_text(json.dumps(content))
    assert cmmsim.read_taught(path).known.rig.parameters == pytest.approx(known.rig.parameters)
    *parents, last = entry
    for key in parents:
        part = part[key]
    part[last] = np.nan
    path.write_text(json.dumps(content))
    name = next(key for key in reversed(entry) if isinstance(key, str))
    refused(
        lambda: cmmsim.read_taught(path),
        f"no taught.json of `cmmsim teach`: {name} is not finite",
        cmmsim.TeachingError,
    )


DARK = {
    "stickers.sticker_level": 20,
    "stickers.ring_level": 220,
    "stickers.body_level": 200,
    "stickers.background_level": 200,
}
SIXTEEN_BIT = {"camera.bit_depth": 16, "camera.gain": 33.28, "camera.black_level": 4096.0}


@pytest.mark.slow
@pytest.mark.parametrize("changes", [DARK, SIXTEEN_BIT], ids=["dark discs", "16 bit"])
def test_other_kinds_of_images_are_taught_and_measured_with_a_true_covariance(changes):
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", seed=4, changes=changes)
    frames = [photographed(sensor, pose) for pose in spread_poses(6, 5)]
    found = sensor.teach_from(numbered(frames, 60.0))
    assert (found.rejected_pairs, found.rejected_stickers, found.warnings) == ({}, {}, ())
    assert found.taught.radius == pytest.approx(0.003, rel=2e-3)
    assert found.bundle.factor == pytest.approx(1.0, abs=0.15)
    sensor.teach(frames=frames)
    near = spread_poses(40, 6, 0.009, 0.035)
    measured = sensor.measure_many(near)
    errors = measured.poses - near
    require_true(squares(errors - errors.mean(axis=0), measured.covariances) * 40 / 39)
    mean = errors.mean(axis=0)
    spread = sensor.estimator.common_at(sensor.home) + measured.covariances.mean(axis=0) / 40
    assert mean @ np.linalg.solve(spread, mean) < 22.5
    assert cmmsim.measure_frame(frames[0], sensor.estimator).ok


def test_rough_places_may_be_off_by_millimetres():
    """Each sticker lies up to 4 mm from where the file says, and the frames are still right."""
    planes = read_sensor_file("ctrack780").platform.planes
    rng = np.random.default_rng(6)
    changes = {
        f"platform.planes.{name}.stickers": (
            np.array(plane.stickers) + rng.uniform(-4e-3, 4e-3, (6, 2))
        ).tolist()
        for name, plane in planes
    }
    sensor = statistical(seed=6, changes=changes)
    exposures = [sensor.look(pose) for pose in spread_poses(8, 6)]
    found = statistical().teach_from(numbered(exposures, 60.0))
    assert len(found.taught.platform_places) == 18
    assert np.ptp(found.taught.platform_places - statistical().platform.nominal) > 4e-3
    square, freedom = square_of(found, sensor.truth)
    assert square / freedom == pytest.approx(1.0, abs=0.6)


def test_pairs_that_do_not_belong_together_are_lost_with_a_hint():
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", seed=8)
    frames = [photographed(sensor, pose) for pose in spread_poses(3, 8)]
    mixed = [frames[0], cmmsim.StereoFrame(frames[1].left, frames[2].right), frames[2]]
    images = [[getattr(frame, side) for frame in mixed] for side in ("left", "right")]
    found = [one.measurement for one in cmmsim.measure(*images, "ctrack780", sensor.truth)]
    assert [one.ok for one in found] == [True, False, True]
    assert "36 bright spots in the left image and 36 in the right: do" in found[1].reason
    smaller = replace(sensor.truth, radius=0.98 * 0.003)
    found = [one.measurement for one in cmmsim.measure(*images, "ctrack780", smaller)]
    assert not found[0].ok
    assert "stickers of another radius, or images of another blur" in found[0].reason


@pytest.mark.slow
def test_the_radius_of_stickers_is_taken_from_the_images():
    """With that of the file, whose stickers are 6 % smaller, no sticker would be measured."""
    larger = {"stickers.radius": 0.0032}
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", seed=8, changes=larger)
    frames = [photographed(sensor, pose) for pose in spread_poses(3, 8)]
    usual = cmmsim.load_sensor("ctrack780", renderer="analytic", seed=8)
    found = usual.teach_from(numbered(frames, 60.0))
    assert found.taught.radius == pytest.approx(0.0032, rel=2e-3)
    assert "a radius of 0.0032 m in the images" in found.warnings[0]
    taught = cmmsim.load_sensor("ctrack780", renderer="analytic", taught=found.taught)
    measured = [cmmsim.measure_frame(frame, taught.estimator) for frame in frames]
    assert [len(one.target_ids) for one in measured] == [18] * 3
    stated = cmmsim.load_sensor("ctrack780", renderer="analytic", taught=usual.truth)
    assert not cmmsim.measure_frame(frames[0], stated.estimator).ok


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"lens.psf_px": 0.6}, "with lens.psf_px = 0.6 they are (1|1.1|0.9\\d?) times"),
        ({"camera.dark_noise": 60.0}, "enlarge camera.dark_noise from 26 to about 5[0-9] "),
    ],
)
def test_images_that_are_blurred_or_noisier_than_stated_are_said_to_be(changes, said):
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", seed=8, changes=changes)
    frames = [photographed(sensor, pose) for pose in spread_poses(3, 8)]
    usual = cmmsim.load_sensor("ctrack780", renderer="analytic")
    warnings = usual.teach_from(numbered(frames, 60.0)).warnings
    assert re.search(f"^0: squared residuals of grey values are .*{said}", warnings[0]), warnings


@pytest.mark.slow
def test_stickers_that_something_hides_in_some_pairs_are_taught_from_the_others():
    """A rod that stands elsewhere before each pair hides a part of the stickers, or half of one."""
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", seed=300)
    sensor.add_bodies({"rod": cmmsim.rod(0.5, 0.012)})
    rng = np.random.default_rng(2)
    frames = []
    for pose in spread_poses(7, 170):
        start = np.array([0.6, rng.uniform(-0.3, 0.3), 0.3 + rng.uniform(-0.1, 0.2)])
        along = np.array([0.2, rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)])
        end = start + along
        frames.append(photographed(sensor, pose, {"rod": cmmsim.rod_transform(start, end)}))
    found = sensor.teach_from(numbered(frames, 60.0))
    assert len(found.observations.pair) < 0.97 * 7 * 36
    assert (found.rejected_pairs, found.rejected_stickers) == ({}, {})
    square, freedom = square_of(found, sensor.truth)
    assert square / freedom == pytest.approx(1.0, abs=0.57)
