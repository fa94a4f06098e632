"""Triangulated stickers against the discs that they stand for."""

import numpy as np
import pytest

from cmmsim.imaging.pyrender_meshes import GROUND_SIDES, LARGEST_SAG, RIM_SAMPLES, disc_mesh
from cmmsim.imaging.scene import Disc, DiscStack

NORMAL = np.array([0.48, -0.6, 0.64])
STICKER = Disc(np.array([0.1, -0.2, 0.3]), NORMAL, 0.003, 0.9)
RING = Disc(STICKER.centre - 1e-4 * NORMAL, NORMAL, 0.005, 0.1)
SAMPLES = [2e-5, 9e-5, 3e-4]  # m apart


def parts(sample):
    """Meshes' vertices, triangles and levels of the sticker's plane and of the ring's."""
    mesh = disc_mesh(DiscStack((RING, STICKER)), sample)
    upper = mesh.faces.max(axis=1) < len(mesh.vertices) - GROUND_SIDES
    return mesh, mesh.faces[upper], mesh.faces[~upper]


def integrals(mesh, faces, values):
    """Integral over triangles of a value that is linear on each, and of its product with the place (3,)."""
    corners, at = mesh.vertices[faces], values[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    pairs = (1.0 + np.eye(3)) / 12.0  # integral of two barycentric coordinates over a triangle of area one
    return (area * at.mean(axis=1)).sum(), np.einsum("f,fi,ij,fjx->x", area, at, pairs, corners)


@pytest.mark.parametrize("sample", SAMPLES)
def test_soft_sticker_sends_the_light_of_the_disc_from_its_centre(sample):
    mesh, upper, _ = parts(sample)
    light, moment = integrals(mesh, upper, mesh.levels - RING.level)
    assert light == pytest.approx((STICKER.level - RING.level) * np.pi * STICKER.radius**2, rel=1e-12)
    np.testing.assert_allclose(moment / light, STICKER.centre, atol=1e-12)


@pytest.mark.parametrize("sample", SAMPLES)
def test_rim_falls_off_over_the_stated_samples_in_the_sticker_s_plane(sample):
    mesh, upper, lower = parts(sample)
    vertices = mesh.vertices[np.unique(upper)] - STICKER.centre
    np.testing.assert_allclose(vertices @ NORMAL, 0.0, atol=1e-15)
    radius, bright = np.linalg.norm(vertices, axis=1), mesh.levels[np.unique(upper)] == STICKER.level
    assert radius[~bright].mean() - radius[bright].mean() == pytest.approx(RIM_SAMPLES * sample, rel=0.02)
    np.testing.assert_allclose((mesh.vertices[np.unique(lower)] - RING.centre) @ NORMAL, 0.0, atol=1e-15)
    assert (mesh.levels[np.unique(lower)] == RING.level).all()


@pytest.mark.parametrize("sample", SAMPLES)
def test_polygon_follows_the_circle(sample):
    """A disc with nothing around it is sharp; corners and middles of its sides lie within the stated sag."""
    mesh = disc_mesh(DiscStack((STICKER,)), sample)
    corners = mesh.vertices - STICKER.centre
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    off = np.abs(np.linalg.norm(np.concatenate([corners, middles]), axis=1) - STICKER.radius)
    assert off.max() < LARGEST_SAG * sample
    assert (mesh.levels == STICKER.level).all()


def test_bounds_hold_the_discs():
    bounds = DiscStack((RING, STICKER)).bounds
    across = np.linalg.svd(NORMAL[None])[2][1:]
    angles = np.linspace(0.0, 2.0 * np.pi, 2001)[:, None]
    rims = np.concatenate(
        [d.centre + d.radius * (np.cos(angles) * across[0] + np.sin(angles) * across[1]) for d in (RING, STICKER)]
    )
    np.testing.assert_allclose(bounds, [rims.min(axis=0), rims.max(axis=0)], atol=1e-8)
