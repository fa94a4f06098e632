"""The exposure of a moving platform: what of it is drawn, the fit of smeared discs, and the
measured pose.
"""

import numpy as np
import pytest

import cmmsim
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.disc_image import coverage
from cmmsim.imaging.formation import ImageFormation, Side
from cmmsim.imaging.stereo_camera import LARGEST_STEP_PX, sub_frame_poses
from cmmsim.imaging.whole_image import exposed_windows
from tests.cmmsim.sensors import (
    CROPPED,
    NOISE,
    NOISE_FREE,
    corners_about,
    exact,
    expected_centres,
    placed_at,
    pose_errors,
    poses_about_home,
    random_ellipses,
    require_true,
    squared_error,
)

EXPOSED = {"timing.exposure": 0.004}
TILE = 64
DIRECTION = np.array([0.2, 0.6, 0.3, 0.5, -0.4, 0.6])  # m/s, rad/s


def rate_of(sensor, pose, longest_px):
    """The pose rate along DIRECTION at which the fastest sticker moves so far in one exposure."""
    step = 1e-4 * DIRECTION
    moved = expected_centres(sensor, pose + step) - expected_centres(sensor, pose - step)
    return step * longest_px / (0.002 * np.linalg.norm(moved, axis=-1).max())


def test_sub_frames_are_close_and_lie_about_the_middle():
    def pixels(poses):
        return np.tile(1000.0 * poses[:, None, :2], (2, 1, 1, 1))

    pose, rate = np.arange(6.0), np.array([3.0, 4.0, 0.0, 0.0, 0.0, 1.0])
    (poses,) = sub_frame_poses(pose[None], rate[None], 1e-3, pixels)
    assert len(poses) == np.ceil(5.0 / LARGEST_STEP_PX)
    np.testing.assert_allclose(poses.mean(axis=0), pose, atol=1e-15)
    steps = np.diff(poses, axis=0)
    np.testing.assert_allclose(steps, np.tile(steps[0], (len(steps), 1)), atol=1e-15)
    assert 1000.0 * np.linalg.norm(steps[0, :2]) <= LARGEST_STEP_PX
    np.testing.assert_allclose(steps[0] * len(poses), 1e-3 * rate, atol=1e-15)
    each = np.array([pose, pose, -pose]), np.array([0.0 * rate, rate, -rate])
    for still in (sub_frame_poses(*each, 1e-3, pixels)[0], sub_frame_poses(*each, 0.0, pixels)[1]):
        np.testing.assert_array_equal(still, pose[None])
    np.testing.assert_array_equal(sub_frame_poses(*each, 1e-3, pixels)[2], -poses)


@pytest.mark.parametrize(("lens", "longest_px"), [("perfect", 0.5), ("blurred", 1.5), ("all", 1.5)])
def test_constant_velocity_does_not_move_the_measured_pose(lens, longest_px):
    """The pose in the middle of the exposure, within the 2 um and 10 urad of images at rest."""
    sensor = exact(lens, EXPOSED | NOISE_FREE)
    for pose in poses_about_home(sensor, 3):
        errors, (m,) = pose_errors(sensor, pose[None], pose_rate=rate_of(sensor, pose, longest_px))
        assert len(m.target_ids) == 18
        assert np.all(np.abs(errors) < [2, 2, 2, 10, 10, 10])


@pytest.mark.parametrize("smear", [(0.0, 0.0), (0.9, 0.0), (-0.7, 1.5), (0.0, 3.1)])
@pytest.mark.parametrize("psf_px", [0.0, 0.5])
def test_fit_of_noise_free_smeared_windows_is_exact(smear, psf_px):
    """Light added up over four times as many places as the fit takes; centres of the middle, shapes
    of the disc.
    """
    centres, shapes = random_ellipses(np.random.default_rng(2), 30, 20)
    parts = (np.arange(44) + 0.5) / 44 - 0.5
    share = np.mean(
        [coverage(centres + part * np.array(smear), shapes, 20, psf_px)[0] for part in parts],
        axis=0,
    )
    windows, moved = NOISE.mean_grey((8.0 + 220.0 * share) / 255.0), np.tile(smear, (30, 1))
    fits = fit_ellipses(
        windows, np.zeros((30, 2), dtype=int), NOISE, 20, psf_px=psf_px, smears=moved
    )
    assert fits.good.all()
    assert np.abs(fits.centres - centres).max() < 1e-3
    assert np.abs(fits.shapes - shapes).max() < 4e-3


@pytest.mark.thorough
@pytest.mark.parametrize(
    "speed",
    [pytest.param(0.3, marks=pytest.mark.slow), pytest.param(0.2, marks=pytest.mark.thorough)],
)
def test_tracked_frames_of_a_moving_platform_keep_their_covariance(speed):
    """Squared pose errors along y in units of the stated covariance, with 2 ms of exposure through
    a sharp lens: after the first frame of each run, whose movement nobody can know."""
    sensor = exact("perfect", {"timing.exposure": 0.002})
    rate, squared = np.array([0.0, speed, 0.0, 0.0, 0.0, 0.0]), []
    for run, start in enumerate(poses_about_home(sensor, 8)):
        sensor.start_run(run)
        path = start + np.outer(np.arange(-4, 5) / 60.0, rate) - [0.0, start[1], 0.0, 0.0, 0.0, 0.0]
        for pose in path:
            m = sensor.measure(pose, pose_rate=rate)
            assert m.ok, m.reason
            if not np.array_equal(pose, path[0]):
                squared.append(squared_error(m, pose))
    assert len(squared) == 64
    require_true(squared)


@pytest.mark.slow
def test_a_platform_that_has_stopped_is_not_taken_for_moving():
    """The images show no smear where the last frames make one of 1.3 px likely."""
    sensor = exact("perfect", CROPPED | {"timing.exposure": 0.008})
    squared = []
    for run in range(8):
        sensor.start_run(run)
        for y in (0.0, 0.002, 0.004):
            pose = sensor.home + np.array([0.0, y, 0.0, 0.0, 0.0, 0.0])
            m = sensor.measure(pose)
            assert len(m.target_ids) >= 17
            squared.append(squared_error(m, pose))
    assert len(squared) == 24
    require_true(squared)


def test_whole_image_is_blurred_as_its_windows_are():
    sensor = exact("perfect", EXPOSED | NOISE_FREE)
    pose = sensor.home
    rate = rate_of(sensor, pose, 3.0)
    corners = corners_about(sensor, pose, 12)
    windows = sensor.look(pose, pose_rate=rate).windows(corners, 12)
    frame = sensor.capture(pose, pose_rate=rate)
    for image, side, cut in zip((frame.left, frame.right), corners, windows, strict=True):
        for (x, y), window in zip(side, cut, strict=True):
            np.testing.assert_allclose(image[y : y + 12, x : x + 12], window.astype(float), atol=1)


def test_a_movement_that_cannot_be_drawn_is_refused():
    sensor = exact("perfect", EXPOSED)
    with pytest.raises(
        cmmsim.CmmError, match=r"moves \d+ px during the exposure of 0.004 s .* at most 150 px"
    ):
        sensor.measure(sensor.home, pose_rate=[100.0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("lens", ["perfect", "all"])
def test_windows_over_an_exposure_show_what_drawing_every_window_at_every_moment_shows(
    monkeypatch, lens
):
    """Four moments while the platform moves by 6 mm, and one."""
    sensor, drawn = exact(lens), []
    formation, camera = sensor.camera.formation, sensor.rig.left
    moments = [
        placed_at(sensor, sensor.home + s * np.eye(6)[1])[0] for s in np.linspace(-0.003, 0.003, 4)
    ]
    tiles = TILE * np.stack(np.meshgrid(np.arange(32), np.arange(24)), axis=-1).reshape(-1, 2)
    every = [
        formation.windows([Side(camera, bodies, tiles)], TILE, 2, 1, shade=False)[0]
        for bodies in moments
    ]
    draw = ImageFormation.windows

    def counted(self, sides, *arguments, **options):
        drawn.append(len(sides[0].corners))
        return draw(self, sides, *arguments, **options)

    monkeypatch.setattr(ImageFormation, "windows", counted)
    mean, largest = exposed_windows(formation, camera, moments, tiles, TILE, 2, 1)
    np.testing.assert_allclose(mean, np.mean(every, axis=0), atol=1e-6)
    np.testing.assert_allclose(largest, np.max(every, axis=0), atol=1e-6)
    assert np.any(np.ptp(every, axis=0) > 0.5)
    assert sum(drawn) < 0.5 * len(moments) * len(tiles)
    for found in exposed_windows(formation, camera, moments[:1], tiles, TILE, 2, 1):
        np.testing.assert_array_equal(found, every[0])
