"""Where the fitted centre of a sticker lies through a distorting lens: against images of its projected rim."""

import numpy as np
import pytest

from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.camera import Distortion, PinholeCamera
from cmmsim.geometry.disc_image import bending, centre_offset, eccentricity
from cmmsim.radiometry.noise import CameraNoise

NOISE = CameraNoise(1600.0, 0.13, 26.0, 1800.0, 16.0, enabled=False)
CENTRE = np.array([0.62, 0.42, 1.8])  # seen near the corner of the image
RADIUS, SIZE, LINES = 0.0075, 32, 100  # m, px: a radius of some 9.6 px
BENT = Distortion(-0.12, 0.03, 1e-3, -7e-4, -4e-3)


def drawn(camera, normal, corner):
    """Share of each pixel within the rim, projected point by point: exact along x, the mean of scan lines along y."""
    u, v = np.linalg.svd(normal[None])[2][1:]
    angle = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)[:, None]
    rim = camera.project(CENTRE + RADIUS * (np.cos(angle) * u + np.sin(angle) * v))[0]
    rim = np.roll(rim - corner, -np.argmin(rim[:, 1]), axis=0)  # from the top round and back
    lowest = np.argmax(rim[:, 1])
    lines = (np.arange(SIZE * LINES) + 0.5) / LINES - 0.5
    ends = np.sort(
        [
            np.interp(lines, side[:, 1], side[:, 0], np.inf, np.inf)
            for side in (rim[: lowest + 1], np.roll(rim, -1, axis=0)[lowest - 1 :][::-1])
        ],
        axis=0,
    )[..., None]
    ticks = np.arange(SIZE)
    share = np.clip(np.minimum(ends[1], ticks + 0.5) - np.maximum(ends[0], ticks - 0.5), 0.0, 1.0)
    return np.where(np.isfinite(ends[0]), share, 0.0).reshape(SIZE, LINES, SIZE).mean(axis=1)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("lens", "limit"), [(BENT, 5e-5), (Distortion(-0.5, 0.3), 4e-4)], ids=["usual", "strong"])
def test_fitted_centre_of_a_distorted_sticker(tilt, lens, limit):
    camera = PinholeCamera(2300.0, 1023.5, 767.5, 2048, 1536, distortion=lens)
    normal = np.array([0.6 * np.sin(tilt), 0.8 * np.sin(tilt), -np.cos(tilt)])
    projected = camera.project(CENTRE)[0]
    corner = np.rint(projected - 0.5 * (SIZE - 1)).astype(int)
    grey = NOISE.black_level + 200.0 * drawn(camera, normal, corner)
    fit = fit_ellipses(grey[None], corner[None], NOISE, 30, FitLimits(largest_misfit=np.inf), iterations=6)
    found = fit.centres[0] - projected
    predicted = centre_offset(camera, CENTRE[None], normal[None], RADIUS)[0]
    perfect = eccentricity(CENTRE[None], normal[None], RADIUS, camera.focal_px)[0]
    assert np.linalg.norm(found - perfect) > 1.5e-3  # without the lens's share
    assert np.linalg.norm(found - predicted) < limit


def test_round_image_follows_the_second_derivative():
    """The closed form (H_ijj + 2 H_jij) / 8 in the axes of a small round ellipse."""
    camera = PinholeCamera(2300.0, 1023.5, 767.5, 2048, 1536, distortion=BENT)
    middle, step = np.array([1700.0, 300.0]), 2.0
    jacobian = camera.distortion_jacobian(middle)
    shape = 3.0 * np.linalg.inv(jacobian)  # its distorted image is round, of 3 px
    curvature = np.stack(
        [
            (camera.distortion_jacobian(middle + d) - camera.distortion_jacobian(middle - d)) / (2.0 * step)
            for d in step * np.eye(2)
        ],
        axis=-1,
    )
    bent = np.einsum("ijk,jm,kn->imn", curvature, shape, shape) / 3.0
    expected = 3.0 * (np.einsum("ijj->i", bent) + 2.0 * np.einsum("jij->i", bent)) / 8.0
    np.testing.assert_allclose(bending(camera, middle[None], shape[None])[0], expected, rtol=2e-3)
