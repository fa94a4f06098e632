"""The image of a disc: its ellipse, the place of the ellipse's centre, and the share of light in
each pixel.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

import cmmsim
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.disc_image import (
    SHAPE_BASIS,
    centre_offset,
    coverage,
    project_discs,
)
from cmmsim.geometry.lens_distortion import Distortion
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from cmmsim.measuring.observation import DetectionSettings, Observer
from tests.cmmsim.plain import eccentricity
from tests.cmmsim.sensors import CAMERA, NOISE, random_ellipses

NOISE_FREE = replace(NOISE, enabled=False)
BENT = Distortion(-0.12, 0.03, 1e-3, -7e-4, -4e-3)
CENTRE = np.array([0.62, 0.42, 1.8])  # seen near the corner of the image
RADIUS, LINES = 0.0075, 100  # m: a radius of some 9.6 px
LARGE = {
    "A": [[0.12, 0.0], [-0.05, 0.12], [-0.08, -0.12]],
    "B": [[0.05, -0.06], [0.12, -0.06], [0.2, -0.06]],
    "C": [[-0.05, -0.06], [-0.12, -0.06], [-0.2, -0.06]],
}


def circle(normal, count):
    """Points (count, 3) on the unit circle across a normal, in order."""
    u, v = np.linalg.svd(normal[None])[2][1:]
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None]
    return np.cos(angle) * u + np.sin(angle) * v


def test_ellipse_of_a_disc_is_its_projected_rim_and_eccentricity_the_way_to_its_middle():
    rng = np.random.default_rng(1)
    centres = rng.uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 2.0], (30, 3))
    normals = rng.normal((0.0, 0.0, -2.0), 1.0, (30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radii = rng.uniform(0.002, 0.03, 30)
    pixels, shapes = project_discs(CAMERA, centres, normals, radii)
    np.testing.assert_array_equal(shapes, shapes.swapaxes(1, 2))
    for centre, normal, radius, middle, shape in zip(
        centres, normals, radii, pixels, shapes, strict=True
    ):
        way = eccentricity(centre[None], normal[None], radius, CAMERA.focal_px)[0]
        np.testing.assert_allclose(way, middle - CAMERA.project(centre)[0], atol=1e-9)
        rim = CAMERA.project(centre + radius * circle(normal, 50))[0]
        np.testing.assert_allclose(
            np.linalg.norm(np.linalg.solve(shape, (rim - middle).T), axis=0), 1.0, atol=1e-9
        )


def drawn(camera, normal, corner, size):
    """Share of each pixel within the rim, projected point by point: exact along x, the mean of scan
    lines along y.
    """
    rim = camera.project(CENTRE + RADIUS * circle(normal, 2000))[0]
    rim = np.roll(rim - corner, -np.argmin(rim[:, 1]), axis=0)  # from the top round and back
    lowest = np.argmax(rim[:, 1])
    lines = (np.arange(size * LINES) + 0.5) / LINES - 0.5
    ends = np.sort(
        [
            np.interp(lines, side[:, 1], side[:, 0], np.inf, np.inf)
            for side in (rim[: lowest + 1], np.roll(rim, -1, axis=0)[lowest - 1 :][::-1])
        ],
        axis=0,
    )[..., None]
    ticks = np.arange(size)
    share = np.clip(np.minimum(ends[1], ticks + 0.5) - np.maximum(ends[0], ticks - 0.5), 0.0, 1.0)
    return np.where(np.isfinite(ends[0]), share, 0.0).reshape(size, LINES, size).mean(axis=1)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    ("lens", "limit"), [(BENT, 5e-5), (Distortion(-0.5, 0.3), 4e-4)], ids=["usual", "strong"]
)
def test_fitted_centre_of_a_distorted_sticker(tilt, lens, limit):
    camera = replace(CAMERA, distortion=lens)
    normal = np.array([0.6 * np.sin(tilt), 0.8 * np.sin(tilt), -np.cos(tilt)])
    projected = camera.project(CENTRE)[0]
    corner = np.rint(projected - 15.5).astype(int)
    grey = NOISE_FREE.black_level + 200.0 * drawn(camera, normal, corner, 32)
    fit = fit_ellipses(
        grey[None], corner[None], NOISE_FREE, 30, FitLimits(largest_misfit=np.inf), iterations=6
    )
    found = fit.centres[0] - projected
    predicted = centre_offset(camera, CENTRE[None], normal[None], RADIUS)[0]
    perfect = eccentricity(CENTRE[None], normal[None], RADIUS, camera.focal_px)[0]
    assert np.linalg.norm(found - perfect) > 1.5e-3  # without the lens's share
    assert np.linalg.norm(found - predicted) < limit


@pytest.mark.parametrize("radius", [0.02, 0.03])
def test_observation_takes_the_predicted_eccentricity_of_large_stickers_away(radius):
    """Three stickers of plane A, seen at 45 to 60 degrees, all dark around them and no noise;
    without the correction it is the bias."""
    sensor = cmmsim.load_sensor(
        "ctrack780",
        renderer="analytic",
        changes={
            "camera.noise": False,
            "stickers.radius": radius,
            "stickers.ring_radius": 1.02 * radius,
            "stickers.placement": (0.0, 0.0),
            "stickers.body_level": 8,
            **{f"platform.planes.{plane}.stickers": places for plane, places in LARGE.items()},
        },
    )
    camera_from_body = invert(sensor.truth.base_from_camera) @ pose_to_transform(sensor.home)
    places, normals = sensor.platform.nominal[:3], sensor.platform.sticker_normals[:3]
    expected = sensor.rig.project(apply(camera_from_body, places))[0]
    size = 2 * int(np.ceil(1.3 * sensor.rig.left.focal_px * radius / 1.6)) + 8
    errors = []
    for taken in (radius, 0.0):
        observer = Observer(sensor.rig, sensor.noise, DetectionSettings(size + 2, size, taken))
        seen = observer.observe(sensor.look(sensor.home), camera_from_body, places, normals)
        assert seen.index.tolist() == [0, 1, 2]
        errors.append(np.stack([seen.left_pixels, seen.right_pixels]) - expected)
    for side, (camera, move) in enumerate(
        zip(sensor.rig.cameras, sensor.rig.from_camera, strict=True)
    ):
        centres, turned = (
            apply(move @ camera_from_body, places),
            normals @ (move @ camera_from_body)[:3, :3].T,
        )
        tilts = np.degrees(
            np.arccos(-np.einsum("ni,ni->n", centres, turned) / np.linalg.norm(centres, axis=1))
        )
        assert np.all((tilts > 45.0) & (tilts < 62.0)), tilts
        predicted = eccentricity(centres, turned, radius, camera.focal_px)
        assert np.linalg.norm(predicted, axis=1).min() > 0.05
        np.testing.assert_allclose(errors[1][side], predicted, atol=0.002)
    assert np.abs(errors[0]).max() < 0.002


def test_coverage_is_that_of_sampled_pixels_and_its_derivatives_are_those_of_differences():
    centres, shapes = random_ellipses(np.random.default_rng(0), 3, 18)
    area, slopes = coverage(centres, shapes, 18)
    ticks = (np.arange(18 * 50) + 0.5) / 50 - 0.5
    for centre, shape, exact in zip(centres, shapes, area, strict=True):
        unit = np.linalg.solve(
            shape, np.stack(np.meshgrid(ticks, ticks)).reshape(2, -1) - centre[:, None]
        )
        sampled = ((unit**2).sum(axis=0) < 1.0).reshape(18, 50, 18, 50).mean(axis=(1, 3))
        assert np.abs(sampled - exact).max() < 0.01
        assert exact.sum() == pytest.approx(np.pi * np.linalg.det(shape), rel=1e-12)
    for k, unit in enumerate(1e-6 * np.eye(5)):
        turn = np.tensordot(unit[2:], SHAPE_BASIS, 1)
        ahead, behind = (
            coverage(centres + s * unit[:2], shapes + s * turn, 18)[0] for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(slopes[..., k], (ahead - behind) / 2e-6, atol=1e-7)


def plain_coverage(centres, shapes, size):
    """As ``coverage`` by Gauss' theorem in complex numbers, from what of each pixel's sides lies
    within the ellipse.
    """
    ticks, inverse = np.arange(size + 1) - 0.5, np.linalg.inv(shapes)
    places = np.stack(np.meshgrid(ticks, ticks), axis=-1) - centres[:, None, None]
    corners = np.einsum("nij,nyxj->nyxi", inverse, places) @ [
        1.0,
        1j,
    ]  # where the ellipse is a unit disc
    across, down = cut(corners[:, :, :-1], corners[:, :, 1:]), cut(corners[:, :-1], corners[:, 1:])
    area = np.linalg.det(shapes)[:, None, None] * (
        np.diff(down[0], axis=2) - np.diff(across[0], axis=1)
    )
    derivatives = []
    for unit in np.eye(5):
        basis = np.tensordot(unit[2:], SHAPE_BASIS, 1)
        spread = np.trace(basis @ inverse, axis1=1, axis2=2)[:, None, None] * area
        through_x, through_y = (
            length * (unit[i] + (np.conj(basis[i] @ [1.0, 1j]) * middle).real)
            for i, (_, length, middle) in enumerate((down, across))
        )
        derivatives.append(spread - np.diff(through_y, axis=1) - np.diff(through_x, axis=2))
    return area, np.stack(derivatives, axis=-1)


def cut(start, end):
    """Of sides between complex numbers: the area of the unit disc between side and origin, the
    share of the side within the disc, and the middle of that part."""
    step = end - start
    dot, step2 = (start.conj() * step).real, np.abs(step) ** 2
    root = np.sqrt(np.maximum(dot**2 - step2 * (np.abs(start) ** 2 - 1.0), 0.0))
    enter, leave = (np.clip((sign * root - dot) / step2, 0.0, 1.0) for sign in (-1.0, 1.0))
    first, last = start + enter * step, start + leave * step
    sectors = np.angle(first * start.conj()) + np.angle(end * last.conj())
    return 0.5 * (sectors + (first.conj() * last).imag), leave - enter, 0.5 * (first + last)


@pytest.mark.parametrize("radii", [(3.8, 2.4), (0.2, 0.1), (0.5, 9.0), (1.0, 1.0), (30.0, 30.0)])
def test_coverage_is_that_of_plain_numpy(radii):
    """In all cases of a side: within, outside, crossed once or twice; centres on pixel corners are
    among them, and ellipses that a window shows in part."""
    centres, shapes = random_ellipses(np.random.default_rng(0), 50, 16, radii)
    centres[:10] = np.round(2.0 * centres[:10]) / 2.0
    centres[10:30] += np.random.default_rng(1).uniform(-10.0, 10.0, (20, 2))
    for found, expected in zip(
        coverage(centres, shapes, 16), plain_coverage(centres, shapes, 16), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=2e-12)


def integrated(centre, shape, psf_px, rings=120, rays=240):
    """Light of each pixel by quadrature over the whole disc in polar coordinates; (20, 20)."""
    node, weight = np.polynomial.legendre.leggauss(rings)
    radius, angle = 0.5 * (node + 1.0)[:, None], 2.0 * np.pi * np.arange(rays) / rays
    unit = np.stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()])
    area = np.linalg.det(shape) * np.pi / rays * (weight[:, None] * radius * np.ones(rays)).ravel()
    ends = np.arange(20 + 1)[:, None] - 0.5
    x, y = (np.diff(ndtr((ends - p) / psf_px), axis=0) for p in shape @ unit + centre[:, None])
    return (y * area) @ x.T


@pytest.mark.slow
@pytest.mark.parametrize(
    ("psf_px", "limit"),
    [
        *((0.2, 1e-7), (1.0, 1e-6), (2.0, 1e-7)),
        *(pytest.param(one, 1e-7, marks=pytest.mark.thorough) for one in (0.3, 0.5, 1.5)),
    ],
)
def test_blurred_shares_and_their_derivatives_match_brute_force_integration(psf_px, limit):
    centres, shapes = random_ellipses(np.random.default_rng(0), 2, 20)
    for centre, shape, share, slopes in zip(
        centres, shapes, *coverage(centres, shapes, 20, psf_px), strict=True
    ):
        np.testing.assert_allclose(share, integrated(centre, shape, psf_px), atol=2e-7)
        for k, unit in enumerate(2e-5 * np.eye(5)):
            turn = np.tensordot(unit[2:], SHAPE_BASIS, 1)
            ahead, behind = (
                integrated(centre + s * unit[:2], shape + s * turn, psf_px) for s in (1.0, -1.0)
            )
            np.testing.assert_allclose(
                slopes[..., k], (ahead - behind) / 4e-5, rtol=0.0, atol=limit
            )


@pytest.mark.parametrize("psf_px", [0.05, 0.4, 1.0])
@pytest.mark.parametrize("radii", [(1.0, 0.85), (3.8, 2.4), (7.0, 3.0)])
def test_all_light_is_kept_however_narrow_and_small(psf_px, radii):
    centres, shapes = random_ellipses(np.random.default_rng(1), 5, 20, radii)
    shares, _ = coverage(centres + 0.5 * 20, shapes, 2 * 20, psf_px)
    np.testing.assert_allclose(shares.sum(axis=(1, 2)), np.pi * np.prod(radii), rtol=1e-6)
    assert shares.min() > -1e-6
    assert shares.max() < 1.0 + 1e-6
