"""What pyrender is given: triangulated stickers against their discs, and windows that are drawn
without depths.
"""

import cv2
import numpy as np
import pytest
import trimesh

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import pose_to_transform
from cmmsim.imaging import pyrender_renderer as render
from cmmsim.imaging.pyrender_meshes import (
    GROUND_SIDES,
    LARGEST_SAG,
    RIM_SAMPLES,
    PaintedSolids,
    PaintedWindows,
    disc_mesh,
)
from cmmsim.imaging.renderer import NEAR, Drawable, View, Views
from cmmsim.imaging.scene_bodies import Disc, DiscStack, rod, rod_transform, solid_mesh
from cmmsim.imaging.stereo_camera import SUPERSAMPLING
from cmmsim.imaging.window_kernels import mean_of_cells
from cmmsim.loading import load_sensor

CAMERA = PinholeCamera(1000.0, 500.0, 400.0, 1001, 801)
UP = np.array([0.0, 0.0, 1.0])
NORMAL = np.array([0.48, -0.6, 0.64])
STICKER = Disc(np.array([0.1, -0.2, 0.3]), NORMAL, 0.003, 0.9)
RING = Disc(STICKER.centre - 1e-4 * NORMAL, NORMAL, 0.005, 0.1)
SAMPLES = [2e-5, 9e-5, 3e-4]  # m apart


def stack(x=0.0, normal=UP, height=0.05):
    """A sticker on its ring, 0.3 mm and 0.2 mm above the box's upper side where it is ``height``
    high.
    """
    place = np.array([x, 0.0, height])
    return DiscStack(
        (
            Disc(place + 2e-4 * normal, normal, 0.009, 0.1),
            Disc(place + 3e-4 * normal, normal, 0.003, 0.9),
        )
    )


def box(size=(0.2, 0.2, 0.1)):
    return solid_mesh(trimesh.creation.box(size), 0.3)


def body(*patches):
    return Drawable(patches, [0] * len(patches), 1.0)


def looking_down(corners, size=14):
    """Views from 1 m above the box's middle, which shows at (500, 400) px."""
    turned = pose_to_transform([0.0, 0.0, 1.0, np.pi, 0.0, 0.0])
    return [View(CAMERA, turned[None], (x, y), (size, size)) for x, y in corners]


def painted(drawable, views):
    together = Views.of(views)
    return PaintedSolids(drawable).painted(together, drawable.reaching(together))


def test_sticker_on_a_box_is_laid_and_the_box_fills_the_window():
    """The upper side, 0.95 m away, reaches 105.3 px from the middle."""
    found = painted(
        body(stack(), box()), looking_down([(493, 393), (595, 393), (599, 393), (600, 500)])
    )
    np.testing.assert_array_equal(found.solid, [1, 1, 1, 1])
    np.testing.assert_array_equal(found.filled, [True, False, False, False])
    assert painted(body(stack(), box()), looking_down([(590, 393)])).filled.all()


@pytest.mark.parametrize(
    "patches",
    [
        pytest.param([stack(height=0.0), box()], id="sunk in the box"),
        pytest.param([stack(normal=-UP), box()], id="looks away"),
        pytest.param([DiscStack(stack().discs[::-1]), box()], id="lowest not first"),
        pytest.param([stack(), stack(0.008), box()], id="two stickers"),
        pytest.param([stack(), box(), box((0.3, 0.01, 0.01))], id="two solids"),
        pytest.param(
            [stack(0.05), solid_mesh(trimesh.creation.annulus(0.02, 0.2, 0.1), 0.3)],
            id="not convex",
        ),
    ],
)
def test_what_may_hide_something_is_drawn_by_depth(patches):
    found = painted(body(*patches), looking_down([(500, 393)], 60))
    assert found.solid.tolist() == [-1]
    assert not found.filled.any()


@pytest.mark.rendering
def test_laid_windows_show_what_is_drawn_by_depths(monkeypatch):
    """To the last bit, with links before some of the stickers."""
    rng, kinds, sensor = (
        np.random.default_rng(0),
        set(),
        load_sensor("ctrack780"),
    )  # only its scene is looked at
    camera, drawable = crossed_by_links(sensor)
    for _ in range(6):
        views = sticker_views(sensor, camera, rng)
        found = painted(drawable, views)
        kinds |= set(
            zip(
                (found.solid >= 0).tolist(),
                found.filled.tolist(),
                (found.ringed >= 0).tolist(),
                strict=True,
            )
        )
        without = render.render_windows(drawable, views, SUPERSAMPLING, 0.02)
        with monkeypatch.context() as patched:
            none = np.full(len(views), -1)
            nowhere = PaintedWindows(none, np.zeros(len(views), dtype=bool), none)
            patched.setattr(PaintedSolids, "painted", lambda *_, nowhere=nowhere: nowhere)
            np.testing.assert_array_equal(
                without, render.render_windows(drawable, views, SUPERSAMPLING, 0.02)
            )
    assert kinds == {
        (True, True, True),
        (True, False, False),
        (False, False, False),
    }  # laid, filled, ringed


def crossed_by_links(sensor):
    """The sensor's left camera, and its bodies with two links beside them."""
    scene = sensor.true_cameras.scene
    patches = [p for body in scene for p in body.stickers] + [body.solid for body in scene]
    owners = [k for k, body in enumerate(scene) for _ in body.stickers] + [0, 1, 2, 3]
    links = [solid_mesh(rod(0.5, radius), 0.24) for radius in (0.01, 0.02)]
    return sensor.rig.left, Drawable([*patches, *links], owners, 2.0)


def sticker_views(sensor, camera, rng):
    """Windows about the stickers of platform and base, and some beside them, of a random pose and
    two random links.
    """
    platform = pose_to_transform(sensor.home + rng.uniform(-1, 1, 6) * ([0.02] * 3 + [0.3] * 3))
    ends = sensor.home[:3] + rng.uniform([0.05, -0.25, -0.15], [0.55, 0.25, 0.35], (4, 3))
    placed = np.stack([platform, np.eye(4), rod_transform(*ends[:2]), rod_transform(*ends[2:])])
    scene = sensor.true_cameras.scene
    bodies = (sensor.rig.from_camera[0] @ sensor.true_cameras.camera_from_base) @ placed
    points = np.concatenate(
        [
            body.sticker_places @ move[:3, :3].T + move[:3, 3]
            for body, move in zip(scene, bodies, strict=False)
        ]
    )
    pixels = camera.project(points)[0] - 7 + rng.integers(-4, 5, (len(points), 2))
    return [View(camera, bodies, (int(x), int(y)), (14, 14)) for x, y in pixels]


@pytest.mark.parametrize("supersampling", [1, 2, 3, 9, 16])
def test_cells_are_averaged_as_opencv_does(supersampling):
    """To the last bit; the atlas may have cells left over."""
    drawn = np.random.default_rng(0).integers(
        0, 256, (2 * 6 * supersampling, 3 * 5 * supersampling), dtype=np.uint8
    )
    windows = np.empty((5, 6, 5), dtype=np.float32)
    mean_of_cells(drawn, 3, supersampling, windows)
    pooled = cv2.resize(
        drawn.astype(np.float32), (15, 12), interpolation=cv2.INTER_AREA
    ) / np.float32(255.0)
    np.testing.assert_array_equal(
        windows, pooled.reshape(2, 6, 3, 5).swapaxes(1, 2).reshape(-1, 6, 5)[:5]
    )


def test_reaching_patches_are_those_whose_corners_span_the_window():
    """Against the camera's projection of the corners; near the camera anything may show, behind it
    nothing.
    """
    rng = np.random.default_rng(0)
    sizes, places = rng.uniform(0.01, 0.3, (40, 3)), rng.uniform([-1, -1, -1], [1, 1, 2], (40, 3))
    meshes = [solid_mesh(trimesh.creation.box(size), 0.5) for size in sizes]
    bodies = np.stack([pose_to_transform([*place, *rng.uniform(-1, 1, 3)]) for place in places])
    drawable = Drawable(meshes, np.arange(40), 1.0)
    views = [
        View(CAMERA, bodies, (int(x), int(y)), (30, 20)) for x, y in rng.uniform(0, 800, (50, 2))
    ]
    found = drawable.reaching(Views.of(views))
    for p, (mesh, body) in enumerate(zip(meshes, bodies, strict=True)):
        points = mesh.vertices @ body[:3, :3].T + body[:3, 3]
        pixels = CAMERA.project(points)[0]
        for n, view in enumerate(views):
            first, last = np.array(view.corner) - 0.5, np.array(view.corner) + view.size - 0.5
            spans = bool(np.all((pixels.max(axis=0) >= first) & (pixels.min(axis=0) <= last)))
            expected = points[:, 2].max() > 0.0 if points[:, 2].min() <= NEAR else spans
            assert found[n, p] == expected
    assert 0.02 < found.mean() < 0.9


def integrals(mesh, faces, values):
    """Integral over triangles of a value that is linear on each, and of its product with the place
    (3,).
    """
    corners, at = mesh.vertices[faces], values[faces]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    pairs = (
        1.0 + np.eye(3)
    ) / 12.0  # integral of two barycentric coordinates over a triangle of area one
    return (area * at.mean(axis=1)).sum(), np.einsum("f,fi,ij,fjx->x", area, at, pairs, corners)


@pytest.mark.parametrize("sample", SAMPLES)
def test_soft_sticker_falls_off_over_samples_with_the_light_of_its_disc_and_a_sharp_one_follows_the_circle(
    sample,
):
    mesh = disc_mesh(DiscStack((RING, STICKER)), sample)
    is_upper = mesh.faces.max(axis=1) < len(mesh.vertices) - GROUND_SIDES
    light, moment = integrals(mesh, mesh.faces[is_upper], mesh.levels - RING.level)
    assert light == pytest.approx(
        (STICKER.level - RING.level) * np.pi * STICKER.radius**2, rel=1e-12
    )
    np.testing.assert_allclose(moment / light, STICKER.centre, atol=1e-12)
    upper, lower = np.unique(mesh.faces[is_upper]), np.unique(mesh.faces[~is_upper])
    np.testing.assert_allclose((mesh.vertices[upper] - STICKER.centre) @ NORMAL, 0.0, atol=1e-15)
    np.testing.assert_allclose((mesh.vertices[lower] - RING.centre) @ NORMAL, 0.0, atol=1e-15)
    radius, bright = (
        np.linalg.norm(mesh.vertices[upper] - STICKER.centre, axis=1),
        mesh.levels[upper] == STICKER.level,
    )
    assert radius[~bright].mean() - radius[bright].mean() == pytest.approx(
        RIM_SAMPLES * sample, rel=0.02
    )
    assert (mesh.levels[lower] == RING.level).all()
    # nothing is around it; corners and middles of sides lie close
    sharp = disc_mesh(DiscStack((STICKER,)), sample)
    corners = sharp.vertices - STICKER.centre
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    off = np.abs(np.linalg.norm(np.concatenate([corners, middles]), axis=1) - STICKER.radius)
    assert off.max() < LARGEST_SAG * sample
    assert (sharp.levels == STICKER.level).all()


def test_bounds_hold_the_discs():
    bounds = DiscStack((RING, STICKER)).bounds
    across = np.linalg.svd(NORMAL[None])[2][1:]
    angles = np.linspace(0.0, 2.0 * np.pi, 2001)[:, None]
    rims = np.concatenate(
        [
            d.centre + d.radius * (np.cos(angles) * across[0] + np.sin(angles) * across[1])
            for d in (RING, STICKER)
        ]
    )
    np.testing.assert_allclose(bounds, [rims.min(axis=0), rims.max(axis=0)], atol=1e-8)
