"""Windows grow with the stickers' images, so that larger and nearer stickers are taught and measured as well."""

import numpy as np
import pytest

import cmmsim
from cmmsim.geometry.pose import apply

WIDE_RINGS = {"stickers.ring_radius": 0.012}
LARGER = [
    pytest.param(WIDE_RINGS | {"stickers.radius": 0.0035}, id="radius 3.5 mm"),
    pytest.param(WIDE_RINGS | {"stickers.radius": 0.0045}, id="radius 4.5 mm"),
    pytest.param({"rig.distance": 1.0, "rig.height": 2200}, id="distance 1 m, base and platform in sight"),
]


def load(changes):
    return cmmsim.load_sensor("ctrack780", seed=2, renderer="analytic", changes=changes)


@pytest.mark.parametrize(
    ("changes", "sizes"),
    [
        ({}, (14, 12)),
        ({"stickers.radius": 0.002}, (14, 12)),
        ({"rig.distance": 3.0}, (14, 12)),
        ({"lens.psf_px": 0.6}, (16, 14)),
        ({"timing.exposure": 0.004}, (16, 14)),
    ],
)
def test_the_built_in_stickers_and_smaller_ones_get_the_smallest_windows(changes, sizes):
    sensor = load(changes)
    assert (sensor.settings.window_size, sensor.settings.fit_size) == sizes
    plan = sensor._window_sizes.plan()
    assert (plan.base_window, plan.first_window, plan.platform_window) == (20, 24, 16)


@pytest.mark.parametrize("factor", [1.5, 2.0, 4.0])
def test_what_is_fitted_holds_a_sticker_that_is_a_fifth_nearer(factor):
    """A disc that faces a camera looks focal length * radius / distance large; its middle is rounded to a pixel."""
    sensor = load({"stickers.radius": 0.003 * factor, "stickers.ring_radius": 0.009 * factor})
    nearest = 0.82 * np.hypot(1.5841717, 0.5)
    reach = 2300.0 * 0.003 * factor / nearest + 0.5
    assert reach < 0.5 * sensor.settings.fit_size < 1.3 * reach + 1.0
    assert sensor.settings.window_size >= sensor.settings.fit_size + 2


@pytest.mark.slow
@pytest.mark.parametrize("changes", LARGER)
def test_larger_stickers_are_taught_and_measured_with_a_true_covariance(changes, moving_path):
    """150 frames: their mean squared error, normalised by the stated covariances, is 6 with a deviation of 0.28."""
    sensor, path = load(changes), moving_path(150)
    found = [sensor.measure(pose) for pose in path]
    assert [m.reason for m in found if not m.ok] == []
    assert min(len(m.target_ids) for m in found) >= 17
    errors = np.array([m.pose for m in found]) - path
    spread = np.array([m.covariance for m in found]) + sensor.taught.calibration_covariance(sensor.home)
    squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(spread), errors)
    assert squared.mean() == pytest.approx(6.0, abs=1.0), squared.mean()


def test_teaching_names_the_stickers_that_no_image_shows():
    """One metre from the middle of platform and base, the lower stickers of the base lie below both images."""
    sensor = load({"rig.distance": 1.0})
    below = [
        str(sensor.base.sticker_ids[k])
        for k in np.flatnonzero(
            ~sensor.rig.project(apply(sensor._camera_from_base, sensor.base.nominal))[1].all(axis=0)
        )
    ]
    with pytest.raises(cmmsim.TeachingError, match=f"; {', '.join(below)} lie outside of an image"):
        sensor.teach()
