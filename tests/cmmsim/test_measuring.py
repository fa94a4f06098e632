"""The whole chain from images to poses against the true poses, which only the renderer is given."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares

import cmmsim
from cmmsim.geometry.pose import apply, pose_to_transform
from tests.cmmsim.sensors import CROPPED, camera_from, exact, squared_error

pytestmark = pytest.mark.rendering


def box_before(centre, size):
    """A box (4,4) just before a point of the base frame, towards the rig, and its mesh."""
    place = np.eye(4)
    place[:3, 3] = centre + 0.04 * (np.array([1.44, 0.0, 1.28]) - centre)
    return place, trimesh.creation.box(extents=size)


def test_first_frame_without_prior_finds_all_ids_in_images_drawn_as_far_as_read_or_handed_over_as_arrays(
    sensor,
):
    """Each measured point lies where the sticker of that name truly is."""
    pose = sensor.home + np.array([0.009, -0.008, 0.007, 0.03, -0.035, 0.03])
    truth = apply(camera_from(sensor, pose), sensor.truth.platform_places)
    for m in (sensor.measure(pose), cmmsim.measure_frame(sensor.capture(pose), sensor.estimator)):
        assert (m.ok, m.reason) == (True, "")
        np.testing.assert_array_equal(m.target_ids, sensor.platform.sticker_ids)
        assert np.linalg.norm(m.points - truth, axis=1).max() < 1e-4
        assert np.all(np.abs(m.pose - pose) * 1e6 < [20, 20, 20, 100, 100, 100])


@pytest.mark.slow
def test_planes_and_registration_agree(taught):
    found = {}
    for method in ("registration", "planes"):
        sensor = cmmsim.load_sensor("ctrack780", seed=3, method=method, taught=taught)
        sensor.measure(sensor.home)
        found[method] = [sensor.measure(sensor.home) for _ in range(30)]
    mean = {k: np.mean([m.pose for m in v], axis=0) - sensor.home for k, v in found.items()}
    spread = {k: np.std([m.pose for m in v], axis=0) for k, v in found.items()}
    stated = {k: np.sqrt(np.diag(v[0].covariance)) for k, v in found.items()}
    for k in found:
        assert np.all(np.abs(spread[k] / stated[k] - 1.0) < 0.45), (k, spread[k] / stated[k])
    assert np.all(np.abs(mean["planes"]) < 6.0 * stated["planes"] / np.sqrt(30) + 3e-6)
    assert np.all(stated["planes"] > 1.5 * stated["registration"])


@pytest.mark.slow
def test_same_seed_same_numbers(taught, moving_path):
    sensor, runs = cmmsim.load_sensor("ctrack780", seed=5, taught=taught), []
    for seed in (None, 6, 5):
        if seed is not None:
            sensor.start_run(seed)
        runs.append([sensor.measure(pose).pose.tolist() for pose in moving_path(2)])
    assert runs[0] == runs[2] != runs[1]


@pytest.mark.slow
def test_images_decide_the_result(taught):
    """One camera's image shifted by 0.1 px moves the pose as a least-squares fit of exact pixels
    predicts.
    """
    poses = {}
    for shift in (0.0, 0.1):
        sensor = cmmsim.load_sensor("ctrack780", seed=9, taught=taught)
        sensor.move_rig({"right.cx_px": shift})
        poses[shift] = np.mean([sensor.measure(sensor.home).pose for _ in range(15)], axis=0)
    moved = poses[0.1] - poses[0.0]

    pixels = sensor.rig.project(apply(camera_from(sensor, sensor.home), taught.platform_places))[0]
    shifted = pixels + np.array([[[0.0, 0.0]], [[0.1, 0.0]]])

    def residuals(pose):
        model = apply(camera_from(sensor, pose), taught.platform_places)
        return (sensor.rig.project(model)[0] - shifted).ravel()

    predicted = (
        least_squares(residuals, sensor.home, x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        - sensor.home
    )
    assert np.linalg.norm(predicted[:3]) > 30e-6
    noise = 5.0 * np.sqrt(np.diag(sensor.measure(sensor.home).covariance) * 2.0 / 15.0)
    assert np.all(np.abs(moved - predicted) < 0.1 * np.abs(predicted) + noise), (moved, predicted)


@pytest.mark.slow
def test_hidden_plane_is_lost_by_name_and_found_again(taught):
    """A box hides plane B: `planes` says so; without the box the next frame is measured again."""
    sensor = cmmsim.load_sensor("ctrack780", seed=1, taught=taught, method="planes")
    middle_of_b = sensor.platform.nominal[sensor.platform.plane_index == 1].mean(axis=0)
    centre = apply(pose_to_transform(sensor.home), middle_of_b)
    place, mesh = box_before(centre, (0.02, 0.26, 0.12))
    sensor.add_bodies({"box": mesh})
    assert sensor.measure(sensor.home).ok
    m = sensor.measure(sensor.home, obstacles={"box": place})
    assert not m.ok
    assert np.isnan(m.pose).all()
    assert len(m.points) == 0
    assert m.reason.startswith("plane B")
    assert "at least 3 are needed" in m.reason
    assert sensor.measure(sensor.home).ok


@pytest.mark.parametrize("renderer", ["analytic", "pyrender"])
def test_a_partly_hidden_platform_is_measured_with_what_is_left(renderer):
    sensor = exact("perfect", CROPPED, renderer)
    place, mesh = box_before(np.array([0.15, 0.12, 0.28]), (0.02, 0.15, 0.12))
    sensor.add_bodies({"box": mesh})
    m = [sensor.measure(sensor.home, obstacles={"box": place}) for _ in range(3)][-1]
    assert m.ok
    assert 3 <= len(m.target_ids) < 18
    assert squared_error(m, sensor.home) < 40.0
    assert len(sensor.measure(sensor.home).target_ids) == 18


@pytest.mark.thorough
def test_another_process_measures_the_same(sensor, taught, moving_path, tmp_path):
    path = moving_path(5)
    (tmp_path / "given.pickle").write_bytes(pickle.dumps((taught, path)))
    program = (
        "import pickle, numpy as np, cmmsim\n"
        "taught, path = pickle.load(open('given.pickle', 'rb'))\n"
        "sensor = cmmsim.load_sensor('ctrack780', seed=0, taught=taught)\n"
        "np.save('poses.npy', [sensor.measure(pose).pose for pose in path])\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(cmmsim.__file__).parents[1])}
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=environment, check=True)
    np.testing.assert_array_equal(
        np.load(tmp_path / "poses.npy"), [sensor.measure(pose).pose for pose in path]
    )


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_frame_shows_both_images_without_a_display_and_as_a_picture_in_notebooks(kind):
    """Matplotlib's figure holds the images as they are; the picture is their mean over pixels."""
    full = np.iinfo(kind).max
    left = np.zeros((40, 1000), dtype=kind)
    left[:, 500:] = full
    frame = cmmsim.StereoFrame(left, np.full_like(left, full))
    shown = [axis.images[0].get_array() for axis in frame.show().axes]
    np.testing.assert_array_equal(shown, [frame.left, frame.right])
    picture = cv2.imdecode(np.frombuffer(frame._repr_png_(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (32, 1600)
    assert (picture[:, :399] == 0).all()
    assert (picture[:, 401:] == 255).all()
    lower = cmmsim.StereoFrame(left[:20], np.full_like(left, full))
    assert cv2.imdecode(np.frombuffer(lower._repr_png_(), np.uint8), 0).shape == (32, 1600)
