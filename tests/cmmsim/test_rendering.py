"""Both renderers against closed forms, brute-force sampling and each other; the choice between them
and one's own.
"""

import sys
import warnings

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

import cmmsim
from cmmsim.geometry.disc_image import coverage
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.imaging import analytic, pyrender_renderer
from cmmsim.imaging.layer_kernels import (
    Discs,
    Solids,
    cover_by_polygon,
    draw_layers,
    polygon_contains,
)
from cmmsim.imaging.renderer import Drawable, View, choose_renderer
from cmmsim.imaging.scene_bodies import ConvexSolid, solid_mesh
from cmmsim.imaging.stereo_camera import SUPERSAMPLING
from cmmsim.imaging.view_kernels import convex_hull, solid_outlines
from tests.cmmsim.sensors import (
    CAMERA,
    centre_errors,
    corners_about,
    exact,
    placed_at,
    poses_about_home,
    squared_errors,
)


@pytest.mark.rendering
@pytest.mark.parametrize(
    ("supersampling", "limit"), [(6, 0.0016), (SUPERSAMPLING, 0.0008), (16, 0.0003)]
)
def test_centres_of_pyrender_agree_with_their_projection(supersampling, limit):
    """The pixel convention: half a pixel off would be 0.5; the rest falls with supersampling as the
    renderer states.
    """
    sensor = exact(renderer="pyrender")
    errors = np.concatenate(
        [centre_errors(sensor, pose, supersampling) for pose in poses_about_home(sensor, 8)]
    )
    rms, mean = np.sqrt((errors**2).mean(axis=0)), errors.mean(axis=0)
    assert np.all(rms < limit), rms
    assert np.all(np.abs(mean) < 0.0002), mean
    assert (
        0.85
        < np.sqrt((errors**2).mean()) / pyrender_renderer.PYRENDER.centre_error_px(supersampling)
        < 1.15
    )


@pytest.mark.rendering
@pytest.mark.parametrize(
    ("lens", "supersampling", "count"),
    [
        ("perfect", SUPERSAMPLING, 5),
        pytest.param("perfect", SUPERSAMPLING, 40, marks=pytest.mark.thorough),
        pytest.param("perfect", 16, 5, marks=pytest.mark.slow),
        pytest.param("perfect", 16, 40, marks=pytest.mark.thorough),
        pytest.param("distorted", SUPERSAMPLING, 10, marks=pytest.mark.thorough),
        pytest.param("all", SUPERSAMPLING, 4, marks=pytest.mark.slow),
    ],
)
def test_both_renderers_agree_in_every_sticker_centre(lens, supersampling, count):
    """At most 0.005 px as they are drawn for measuring, and finer; 0.0031 was the largest in 300
    poses, behind a real lens 0.0030 and 0.0014."""
    first, other = exact(lens), exact(lens, renderer="pyrender")
    for pose in poses_about_home(first, count):
        gap = centre_errors(first, pose, size=18) - centre_errors(
            other, pose, supersampling, size=18
        )
        assert np.abs(gap).max() < 0.005


@pytest.mark.rendering
@pytest.mark.parametrize(
    ("lens", "count"), [("perfect", 1), pytest.param("all", 3, marks=pytest.mark.thorough)]
)
def test_the_scene_of_pyrender_itself_shows_every_sticker_at_the_same_place(lens, count):
    """It takes pyrender's camera, light and materials for the window's matrices and levels."""
    scene, others = exact(lens, renderer="scene"), ("analytic", "pyrender")
    for pose in poses_about_home(scene, count):
        centres = centre_errors(scene, pose, size=18)
        for name in others:
            gap = centres - centre_errors(exact(lens, renderer=name), pose, size=18)
            assert np.abs(gap).max() < 0.01


@pytest.mark.rendering
def test_the_scene_lights_a_face_by_its_turn_and_leaves_the_other_renderer_as_it_was():
    """A face has half of its level from all sides, and the rest by the cosine to the camera."""
    box = solid_mesh(trimesh.creation.box((0.2, 0.2, 0.2)), 0.6)
    drawable, camera = Drawable([box], [0], 1.5), exact().rig.left.ideal

    def seen(renderer, turn):
        place = pose_to_transform([0.0, 0.0, 1.5, 0.0, turn, 0.0])
        corner = tuple(np.rint(camera.centre).astype(int) - 4)
        view = View(camera, place[None], corner, (8, 8))
        return choose_renderer(renderer).draw(drawable, [view], 3, 0.2)[0].mean()

    before = seen("pyrender", 0.0)
    for turn in (0.0, 0.6):
        assert seen("scene", turn) == pytest.approx(0.6 * 0.5 * (1.0 + np.cos(turn)), abs=0.01)
    assert seen("pyrender", 0.0) == before == pytest.approx(0.6, abs=0.003)


@pytest.mark.rendering
def test_both_renderers_show_the_same_image():
    """The same levels in the same places, obstacles too: only pixels on edges differ, and none by
    much on the mean.
    """
    place, images = cmmsim.rod_transform([0.45, -0.1, 0.35], [0.3, 0.2, 0.45]), []
    for sensor in (exact(), exact(renderer="pyrender")):
        sensor.add_bodies({"rod": cmmsim.rod(0.33, 0.01)})
        images.append(
            sensor.camera.whole_exposure(0, [placed_at(sensor, sensor.home, place)[0]], 6)
        )
    gap = np.abs(images[0] - images[1])
    assert (gap > 0.02).sum() < 6000  # edges of bodies, of 3 million pixels
    assert gap.mean() < 1e-4
    assert (gap > 0.3).sum() == 0  # no sticker that only one of them shows


@pytest.mark.parametrize(
    ("lens", "renderer", "granted"),
    [
        ("perfect", "analytic", 1e-6),
        ("all", "analytic", 2e-3),
        pytest.param("perfect", "pyrender", 1.0 / SUPERSAMPLING**2, marks=pytest.mark.rendering),
    ],
)
def test_the_whole_image_shows_the_windows(lens, renderer, granted):
    """Around every sticker the whole image has the radiance of the finely drawn window.

    Single samples of pyrender on an edge may fall to the other side by rounding: one of the 81 in a
    pixel is granted.
    """
    sensor = exact(lens, renderer=renderer)
    placed, corners = placed_at(sensor, sensor.home), corners_about(sensor, sensor.home, 12)
    windows = sensor.camera.radiances([[placed]], [corners], 12, SUPERSAMPLING)[0]
    for side in (0, 1):
        image = sensor.camera.whole_exposure(side, [placed[side]], SUPERSAMPLING)
        for (x, y), window in zip(corners[side], windows[side], strict=True):
            assert np.abs(image[y : y + 12, x : x + 12] - window).max() < granted


@pytest.mark.slow
def test_tracking_needs_no_opengl(taught, moving_path, monkeypatch):
    monkeypatch.setattr(pyrender_renderer, "_shared_atlas", None)  # any call would fail
    sensor, path = (
        cmmsim.load_sensor("ctrack780", taught=taught, renderer="analytic"),
        moving_path(80),
    )
    found = [sensor.measure(pose) for pose in path]
    errors = 1e6 * (np.array([m.pose for m in found]) - path)
    assert np.all(np.sqrt((errors**2).mean(axis=0)) < [4, 4, 4, 15, 15, 15])
    # 6, plus the constant error of teaching; three deviations of the mean
    assert abs(squared_errors(found, path).mean() - 6.1) < 3 * np.sqrt(12 / len(path))


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
    rod = cmmsim.rod(0.02, 0.004)
    scene = analytic.scene_of(Drawable([solid_mesh(rod, 0.5)], [0], 1.5))
    move = pose_to_transform([0.0, 0.0, 1.5, 0.9, 0.4, 0.0])
    solids = solid_outlines(scene, move[None], CAMERA.focal_lengths, CAMERA.centre, np.array([-1]))
    half_planes = solids.half_planes[: solids.starts[1]]
    pixels = CAMERA.project(apply(move, np.asarray(rod.vertices)))[0]
    np.testing.assert_allclose(
        solids.boxes[0], [*pixels.min(axis=0), *pixels.max(axis=0)], atol=1e-4
    )
    corner, fine, coarse = (1004.5, 744.5), np.empty((40, 40)), np.empty((40, 40))
    cover_by_polygon(half_planes, *corner, 200, fine)
    cover_by_polygon(half_planes, *corner, 6, coarse)
    assert np.abs(coarse - fine).max() < 0.1
    x, y = np.meshgrid(np.arange(40), np.arange(40))
    inside = [
        polygon_contains(half_planes, corner[0] + i, corner[1] + j, 1, 1)
        for i, j in zip(x.ravel(), y.ravel(), strict=True)
    ]
    np.testing.assert_allclose(fine.ravel()[inside], 1.0, atol=1e-6)
    area = fine.sum()
    assert 0.9 * area < np.sum(inside) + 0.5 * np.sum((fine > 0) & (fine < 1)) < 1.1 * area


@pytest.mark.parametrize("count", [3, 4, 10, 60])
def test_convex_hull_is_that_of_qhull(count):
    """Of points on a grid, too, where many lie on one line."""
    rng = np.random.default_rng(count)
    for points in (
        rng.normal(size=(count, 2)),
        rng.integers(0, 5, (count, 2)).astype(float),
        np.zeros((count, 2)),
    ):
        found = convex_hull(points.copy())
        if np.linalg.matrix_rank(points - points[0]) < 2:
            assert set(map(tuple, found)) <= set(map(tuple, points))
            continue
        expected = points[ConvexHull(points).vertices]
        assert set(map(tuple, found)) == set(map(tuple, expected))
        assert len(found) == len(set(map(tuple, expected)))


def test_auto_falls_back_to_analytic_with_one_line(monkeypatch):
    def missing():
        raise cmmsim.OpenGLMissingError(ImportError("x")) from ImportError("no\nEGL")

    monkeypatch.setattr(pyrender_renderer, "_shared_atlas", missing)
    sensor = exact(renderer=None)  # says nothing before something is to be drawn
    with pytest.warns(
        UserWarning, match=r"^images are drawn by the analytic renderer, [^\n]*no EGL[^\n]*$"
    ) as caught:
        assert sensor.measure(sensor.home).ok
    assert sensor.renderer == "analytic"
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert exact(renderer="pyrender").renderer == "pyrender"
        assert exact(renderer="analytic").renderer == "analytic"


CALLS = []


def draw_and_count(drawable, views, supersampling, background=0.0):
    """A renderer of one's own."""
    CALLS.append(len(views))
    return analytic.draw_windows(drawable, views, supersampling, background)


def test_a_renderer_of_one_s_own_draws_by_its_module_and_name():
    name = f"{__name__}:draw_and_count"
    sensor, usual = exact("perfect", {"renderer": name}, renderer=None), exact()
    np.testing.assert_array_equal(sensor.measure(sensor.home).pose, usual.measure(usual.home).pose)
    assert sensor.renderer == name
    assert CALLS
    with pytest.raises(cmmsim.CmmError, match="called"):
        exact(renderer=f"{__name__}:CAMERA")


def test_layers_are_laid_as_plain_numpy_lays_them():
    """Two discs over a ground, the second behind a solid that covers the left half of the
    window."""
    rng = np.random.default_rng(3)
    centres, shapes = (
        rng.uniform(6.0, 9.0, (2, 2)),
        np.stack([np.diag([5.0, 3.0]), [[2.5, 0.4], [0.4, 1.8]]]),
    )
    levels, corner = np.array([0.1, 0.9]), np.array([100.0, 50.0])
    half = np.array([[1.0, 0.0, corner[0] + 7.25]])
    solids = Solids(
        half,
        np.array([0, 1]),
        np.array([[-1e3, -1e3, corner[0] + 7.25, 1e3]]),
        np.array([0.4]),
        np.array([0]),
    )
    discs = Discs(
        centres + corner,
        shapes,
        np.linalg.norm(shapes, axis=2),
        levels,
        np.array([[False, False], [True, True]])[:, :1],  # a part, as renderers give it
    )
    shares = coverage(centres, shapes, 16)[0]
    cover = np.tile(np.clip(7.75 - np.arange(16), 0.0, 1.0), (16, 1))
    expected = 0.2 + cover * (0.4 - 0.2)
    for share, level in zip((shares[0], shares[1] * (1.0 - cover)), levels, strict=True):
        expected += share * (level - expected)
    for function in (draw_layers, draw_layers.py_func):
        images = np.full((1, 16, 16), 0.2, dtype=np.float32)
        function(images, np.array([0]), corner[None], solids, 6, discs)
        np.testing.assert_allclose(images[0], expected, atol=3e-7)


def test_missing_opengl_names_the_packages(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrender", None)
    with pytest.raises(cmmsim.OpenGLMissingError, match=r"libegl1\b.* and libgl1-mesa-dri"):
        pyrender_renderer._shared_atlas.__wrapped__()
