"""The analytic renderer against closed forms, brute-force sampling and pyrender; the choice between the two."""

import warnings

import numpy as np
import pytest
import trimesh

import cmmsim
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.disc_image import eccentricity, project_discs
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.imaging import pyrender_renderer as render
from cmmsim.imaging.analytic import draw_windows
from cmmsim.imaging.exposure import SUPERSAMPLING
from cmmsim.imaging.kernels import Discs, Solids, cover_by_polygon, lay_layers, polygon_holds
from cmmsim.imaging.scene import ConvexSolid
from cmmsim.radiometry.noise import CameraNoise
from tests.cmmsim import numpy_coverage
from tests.cmmsim.lenses import expected_centres, lens_sensor, poses_about_home

CAMERA = PinholeCamera(2300.0, 1023.5, 767.5, 2048, 1536)
NOISE = CameraNoise(1600.0, 0.13, 26.0, 1800.0, 16.0, enabled=False)
AXES = np.array([1e6] * 6)  # to um and urad


@pytest.fixture
def analytic(taught):
    return cmmsim.load_sensor("ctrack780", seed=0, taught=taught, renderer="analytic")


def placed_at(sensor, pose):
    moves = [m @ sensor._camera_from_base for m in sensor.rig.from_camera]
    return [np.stack([move @ pose_to_transform(pose), move]) for move in moves]


def centres_of(sensor, pose, supersampling=SUPERSAMPLING):
    """Fitted and expected ellipse centres (36, 2) px of the platform's stickers from noise-free windows."""
    placed = placed_at(sensor, pose)
    points = [apply(bodies[0], sensor._scene[0].sticker_places) for bodies in placed]
    normals = [sensor.platform.sticker_normals @ bodies[0, :3, :3].T for bodies in placed]
    expected = [
        camera.project(p)[0] + eccentricity(p, n, 0.003, camera.focal_px)
        for camera, p, n in zip(sensor.rig.cameras, points, normals, strict=True)
    ]
    corners = np.rint(np.stack(expected) - 7.5).astype(int)
    windows = sensor.camera.radiance(placed, corners, 16, supersampling).reshape(-1, 16, 16)
    fits = fit_ellipses(NOISE.mean_grey(windows), corners.reshape(-1, 2), NOISE, 14)
    assert fits.good.all()
    return fits.centres, np.concatenate(expected)


def random_poses(sensor, count):
    return sensor.home + np.random.default_rng(0).uniform(-1, 1, (count, 6)) * ([0.009] * 3 + [0.03] * 3)


def test_ellipse_of_a_disc_holds_its_projected_rim():
    rng = np.random.default_rng(1)
    centres = rng.uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 2.0], (30, 3))
    normals = rng.normal((0.0, 0.0, -2.0), 1.0, (30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radii = rng.uniform(0.002, 0.03, 30)
    pixels, shapes = project_discs(CAMERA, centres, normals, radii)
    for centre, normal, radius, middle, shape in zip(centres, normals, radii, pixels, shapes, strict=True):
        u, v = np.linalg.svd(normal[None])[2][1:]
        angle = np.linspace(0.0, 2.0 * np.pi, 50)[:, None]
        rim = CAMERA.project(centre + radius * (np.cos(angle) * u + np.sin(angle) * v))[0]
        np.testing.assert_allclose(np.linalg.norm(np.linalg.solve(shape, (rim - middle).T), axis=0), 1.0, atol=1e-9)


def test_centres_are_exact(analytic):
    """At most 0.0005 px in every sticker, not only in the mean."""
    for pose in random_poses(analytic, 8):
        found, expected = centres_of(analytic, pose)
        assert np.abs(found - expected).max() < 5e-4


@pytest.mark.rendering
@pytest.mark.parametrize("supersampling", [SUPERSAMPLING, 12, 16])
def test_both_renderers_agree_in_every_sticker_centre(analytic, taught, supersampling):
    """At most 0.005 px as they are drawn for measuring, and finer; 0.0031 was the largest in 300 poses."""
    other = cmmsim.load_sensor("ctrack780", taught=taught, renderer="pyrender")
    for pose in random_poses(analytic, 40):
        gap = centres_of(analytic, pose)[0] - centres_of(other, pose, supersampling)[0]
        assert np.abs(gap).max() < 0.005


@pytest.mark.slow
@pytest.mark.rendering
@pytest.mark.parametrize("lens", ["distorted", "all"])
def test_both_renderers_agree_in_every_sticker_centre_behind_a_real_lens(tmp_path, lens):
    """At most 0.005 px; 0.0030 and 0.0014 px were the largest that were measured."""
    first, other = (lens_sensor(tmp_path, lens, renderer) for renderer in ("analytic", "pyrender"))
    for pose in poses_about_home(first, 10):
        corners = np.rint(expected_centres(first, pose) - 8.5).astype(int)
        centres = []
        for sensor in (first, other):
            windows = sensor.camera.radiance(placed_at(sensor, pose), corners, 18, SUPERSAMPLING).reshape(-1, 18, 18)
            fits = fit_ellipses(
                NOISE.mean_grey(windows),
                corners.reshape(-1, 2),
                NOISE,
                16,
                FitLimits(largest_misfit=np.inf),
                psf_px=sensor.optics.psf_px,
            )
            assert fits.good.all()
            centres.append(fits.centres)
        assert np.abs(centres[0] - centres[1]).max() < 0.005


@pytest.mark.rendering
def test_both_renderers_show_the_same_image(analytic, taught):
    """The same levels in the same places, obstacles too: only pixels on edges differ, and none by much on the mean."""
    other = cmmsim.load_sensor("ctrack780", taught=taught, renderer="pyrender")
    place = cmmsim.rod_transform([0.45, -0.1, 0.35], [0.3, 0.2, 0.45])
    images = []
    for sensor in (analytic, other):
        sensor.add_bodies({"rod": cmmsim.rod(0.33, 0.01)})
        bodies = [
            np.concatenate([b, [c @ place]])
            for b, c in zip(
                placed_at(sensor, sensor.home),
                [m @ sensor._camera_from_base for m in sensor.rig.from_camera],
                strict=True,
            )
        ]
        images.append(sensor.camera.whole_exposure(0, [bodies[0]], 6))
    gap = np.abs(images[0] - images[1])
    assert (gap > 0.02).sum() < 6000  # edges of bodies, of 3 million pixels
    assert gap.mean() < 1e-4
    assert (gap > 0.3).sum() == 0  # no sticker that only one of them shows


def test_windows_are_cut_out_of_the_whole_image(analytic):
    placed = placed_at(analytic, analytic.home)
    points = apply(placed[0][0], analytic._scene[0].sticker_places)
    corners = np.rint(CAMERA.project(points)[0] - 5.5).astype(int)
    windows = analytic.camera.radiance(placed, np.stack([corners, corners]), 12, 6)[0]
    image = analytic.camera.whole_exposure(0, [placed[0]], 6)
    for (x, y), window in zip(corners, windows, strict=True):
        np.testing.assert_allclose(image[y : y + 12, x : x + 12], window, atol=1e-6)


def test_tracking_needs_no_opengl(analytic, moving_path, monkeypatch):
    monkeypatch.setattr(render, "_shared_atlas", None)  # any call would fail
    path = moving_path(200)
    found = [analytic.measure(pose) for pose in path]
    errors = np.array([m.pose for m in found]) - path
    assert np.all(np.sqrt((errors**2).mean(axis=0)) * AXES < [4, 4, 4, 15, 15, 15])
    squared = [e @ np.linalg.solve(m.covariance, e) for e, m in zip(errors, found, strict=True)]
    assert 5.2 < np.mean(squared) < 7.0  # 6, plus the constant error of teaching


def test_partly_hidden_platform_is_measured_with_what_is_left(analytic):
    centre = np.array([0.15, 0.12, 0.28])
    place = np.eye(4)
    place[:3, 3] = centre + 0.04 * (np.array([1.44, 0.0, 1.28]) - centre)
    analytic.add_bodies({"box": trimesh.creation.box(extents=(0.02, 0.15, 0.12))})
    m = [analytic.measure(analytic.home, obstacles={"box": place}) for _ in range(3)][-1]
    assert m.ok
    assert 3 <= len(m.target_ids) < 18
    error = m.pose - analytic.home
    assert error @ np.linalg.solve(m.covariance, error) < 40.0
    assert len(analytic.measure(analytic.home).target_ids) == 18


def test_solid_hides_what_a_ray_caster_says():
    rng = np.random.default_rng(2)
    mesh = trimesh.creation.box(extents=(0.2, 0.1, 0.3))
    move = pose_to_transform([0.05, -0.02, 1.5, 0.3, 0.5, -0.4])
    points = rng.uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 1.8], (2000, 3))
    share = np.linspace(0.0, 1.0, 1500)[:-1, None, None]
    along = apply(np.linalg.inv(move), share * points)
    sampled = np.all(np.abs(along) < [0.1, 0.05, 0.15], axis=2).any(axis=0)
    found = ConvexSolid(np.asarray(mesh.vertices)).hides(move, points)
    assert np.mean(found != sampled) < 0.002
    assert 0.05 < found.mean() < 0.5


def test_outline_covers_what_sampling_says():
    solid = ConvexSolid(np.asarray(cmmsim.rod(0.02, 0.004).vertices))
    outline = solid.outline(CAMERA, pose_to_transform([0.0, 0.0, 1.5, 0.9, 0.4, 0.0]))
    corner, fine, coarse = (1004.5, 744.5), np.empty((40, 40)), np.empty((40, 40))
    cover_by_polygon(outline.half_planes, *corner, 200, fine)
    cover_by_polygon(outline.half_planes, *corner, 6, coarse)
    assert np.abs(coarse - fine).max() < 0.1
    x, y = np.meshgrid(np.arange(40), np.arange(40))
    inside = [
        polygon_holds(outline.half_planes, corner[0] + i, corner[1] + j, 1, 1)
        for i, j in zip(x.ravel(), y.ravel(), strict=True)
    ]
    np.testing.assert_allclose(fine.ravel()[inside], 1.0, atol=1e-6)
    area = fine.sum()
    assert 0.9 * area < np.sum(inside) + 0.5 * np.sum((fine > 0) & (fine < 1)) < 1.1 * area


def test_auto_falls_back_with_one_line(monkeypatch, taught):
    def missing():
        raise cmmsim.OpenGLMissingError(ImportError("x")) from ImportError("no\nEGL")

    monkeypatch.setattr(render, "_shared_atlas", missing)
    sensor = cmmsim.load_sensor("ctrack780", taught=taught)  # says nothing before something is to be drawn
    with pytest.warns(UserWarning, match=r"^images are drawn by the analytic renderer, [^\n]*no EGL[^\n]*$") as caught:
        assert sensor.measure(sensor.home).ok
    assert sensor.renderer == "analytic"
    assert len(caught) == 1
    assert sensor._renderer.draw is draw_windows
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cmmsim.load_sensor("ctrack780", taught=taught, renderer="pyrender").renderer == "pyrender"
        assert cmmsim.load_sensor("ctrack780", taught=taught, renderer="analytic").renderer == "analytic"


def test_unknown_renderer_names_the_valid_ones():
    with pytest.raises(cmmsim.UnknownOptionError, match="analytic, auto, pyrender"):
        cmmsim.load_sensor("ctrack780", renderer="blender")


def test_layers_are_laid_as_plain_numpy_lays_them():
    """Two discs over a ground, the second behind a solid that covers the left half of the window."""
    rng = np.random.default_rng(3)
    centres, shapes = rng.uniform(6.0, 9.0, (2, 2)), np.stack([np.diag([5.0, 3.0]), [[2.5, 0.4], [0.4, 1.8]]])
    levels, corner = np.array([0.1, 0.9]), np.array([100.0, 50.0])
    half = np.array([[1.0, 0.0, corner[0] + 7.25]])
    solids = Solids(
        half, np.array([0, 1]), np.array([[-1e3, -1e3, corner[0] + 7.25, 1e3]]), np.array([0.4]), np.array([0])
    )
    discs = Discs(centres + corner, shapes, np.linalg.norm(shapes, axis=2), levels, np.array([[False], [True]]))
    shares = numpy_coverage.covered_area(centres, shapes, 16)
    cover = np.tile(np.clip(7.75 - np.arange(16), 0.0, 1.0), (16, 1))
    expected = 0.2 + cover * (0.4 - 0.2)
    for share, level in zip((shares[0], shares[1] * (1.0 - cover)), levels, strict=True):
        expected += share * (level - expected)
    for function in (lay_layers, lay_layers.py_func):
        images = np.full((1, 16, 16), 0.2, dtype=np.float32)
        function(images, np.array([0]), corner[None], solids, 6, discs)
        np.testing.assert_allclose(images[0], expected, atol=3e-7)
