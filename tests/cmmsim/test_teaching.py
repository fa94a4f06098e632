"""Teaching: the frames and windows that it finds, and which sensors may take over what another one
was taught.
"""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import cmmsim
from cmmsim.errors import TeachingWarning
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, invert, rotation_log
from cmmsim.geometry.stereo_rig import radius_at
from cmmsim.teaching import exactly_taught, window_sizes
from tests.cmmsim.plain import rigid_start
from tests.cmmsim.sensors import LEFT, refused, squares

TAUGHT = exactly_taught(read_sensor_file("ctrack780"))
WIDE_RINGS = {"stickers.ring_radius": 0.012}
LARGER = [
    pytest.param(
        WIDE_RINGS | {"stickers.radius": 0.0035}, id="radius 3.5 mm", marks=pytest.mark.thorough
    ),
    pytest.param(
        WIDE_RINGS | {"stickers.radius": 0.0045}, id="radius 4.5 mm", marks=pytest.mark.slow
    ),
    pytest.param(
        {"rig.distance": 1.0, "rig.height": 2200}, id="distance 1 m", marks=pytest.mark.slow
    ),
]


def load(changes=None, taught=TAUGHT, name="ctrack780"):
    return cmmsim.load_sensor(name, taught=taught, changes=changes)


def require_stated_error(sensor, taught):
    """The taught frames against the true ones: small, and within what the teaching covariance
    states.
    """
    frame = rigid_start(sensor.truth.platform_places, taught.platform_places)
    error = {
        "platform": frame,
        "base": taught.base_from_camera @ invert(sensor.truth.base_from_camera),
    }
    stated = {"platform": taught.platform_covariance, "base": taught.base_covariance}
    for name, transform in error.items():
        values = np.concatenate([transform[:3, 3], rotation_log(transform[:3, :3])])
        assert np.all(np.abs(values) * 1e6 < [2, 2, 2, 10, 10, 10]), (name, values)
        assert values @ np.linalg.solve(stated[name], values) < 22.5, (
            name,
            values,
        )  # one in a thousand
    total = np.sqrt(np.diag(taught.calibration_covariance(sensor.home))) * 1e6
    assert np.all(total < [2, 2, 2, 10, 10, 10])


def test_teaching_error_is_as_stated(sensor, taught):
    require_stated_error(sensor, taught)


@pytest.mark.rendering
@pytest.mark.parametrize(
    ("seed", "frames", "step"),  # larger steps than six lead where the tracker does not look
    [
        pytest.param(1, 40, 6, marks=pytest.mark.slow),
        *(pytest.param(seed, 600, 1, marks=pytest.mark.thorough) for seed in (1, 2, 3)),
    ],
)
def test_teaching_is_repeatable_and_unbiased(seed, frames, step, moving_path):
    sensor = cmmsim.load_sensor("ctrack780", seed=seed)
    steps: list[tuple[int, int]] = []
    sensor.teach(lambda done, total: steps.append((done, total)))
    assert steps[0][0] == 0
    assert steps[-1][0] == steps[-1][1]
    require_stated_error(sensor, sensor.taught)
    path = moving_path(step * frames)[::step]
    errors = np.array([sensor.measure(pose).pose for pose in path]) - path
    assert np.all(np.isfinite(errors))
    assert np.all(np.abs(errors.mean(axis=0)) * 1e6 < [2, 2, 2, 10, 10, 10])
    assert np.all(np.sqrt((errors**2).mean(axis=0)) * 1e6 < [6, 6, 6, 40, 40, 40])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"rig.target": [0.30, 0.0, 0.185]},
            r"rig.target was \[0.3, 0.0, 0.18\], is \[0.3, 0.0, 0.185\]",
        ),
        ({"rig.distance": 1.5}, r"rig.position was \[1.44, 0.0, 1.28\], is \[1.37"),
        ({"rig.left": LEFT}, "rig.left.centre_px was not stated"),
        ({"stickers.placement_seed": 781}, "stickers.placement_seed was 780, is 781"),
        ({"base.planes.A.point": [0.0, 0.0, 0.181]}, "base.planes.A.point"),
        ({"stickers.per_plane": 4}, "platform.planes.A.stickers .* platform.planes.C.stickers"),
    ],
)
def test_what_another_sensor_was_taught_is_refused_with_what_differs(changes, message):
    refused(lambda: load(changes), message, cmmsim.TeachingError)


@pytest.mark.parametrize(
    "changes",
    [
        {"camera.dark_noise": 3.0, "camera.bit_depth": 12, "camera.prnu": 0.01},
        {"timing.exposure": 0.001, "timing.frame_rate": 29.0},
        {"lens.psf_px": 0.5, "lens.vignetting": 0.2},
        {"detection": {"detector": "dual_conic"}, "renderer": "analytic"},
        {"rig.distance": 1.5841717078650281},  # where it stands anyway
    ],
)
def test_what_does_not_change_teaching_may_differ(changes):
    assert load(changes).taught is TAUGHT


def test_teaching_states_its_setup_which_a_sensor_based_on_another_shares(taught):
    assert taught.setup == TAUGHT.setup
    assert load(name="ctrack780_29hz").taught is TAUGHT  # which is based on it
    assert load(taught=pickle.loads(pickle.dumps(taught))).taught.setup == TAUGHT.setup


def test_one_kept_from_before_setups_were_stated_or_put_together_by_hand_needs_the_name_and_all_stickers():
    old = pickle.loads(pickle.dumps(TAUGHT))
    del old.__dict__["setup"]
    assert load(taught=old).taught is old
    by_hand = replace(TAUGHT, setup="")
    assert load(taught=by_hand).taught is by_hand
    with pytest.raises(cmmsim.TeachingError, match="'ctrack780', not to 'ctrack780_29hz'"):
        load(taught=by_hand, name="ctrack780_29hz")
    with pytest.raises(
        cmmsim.TeachingError, match="has 18 stickers of the platform, sensor 'ctrack780' has 12"
    ):
        load({"stickers.per_plane": 4}, taught=by_hand)


def teaching_itself(changes):
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
    settings = teaching_itself(changes).settings
    assert (settings.window_size, settings.fit_size) == sizes


def test_a_point_spread_that_blurs_the_edge_of_rings_is_named_before_and_after_teaching_fails():
    """The largest one is proportional to the width of the ring beyond 2.4 radii of a sticker, and
    there is no limit if the bodies are as dark as the rings.
    """
    widest = teaching_itself({})._view.widest_psf_px
    wider = teaching_itself({"stickers.ring_radius": 0.0084})._view.widest_psf_px
    assert wider == pytest.approx(widest * (2.8 - 2.4) / (3.0 - 2.4))
    assert teaching_itself({"stickers.body_level": 8})._view.widest_psf_px == np.inf
    blurred = teaching_itself({"lens.psf_px": 2.0})
    said = "lens.psf_px = 2 blurs the light of the bodies over .* this is small up to 0.82 px"
    with (
        pytest.warns(TeachingWarning, match=said),
        pytest.raises(
            cmmsim.TeachingError, match=r"or lens.psf_px = 2 blurs the edge of its ring$"
        ),
    ):
        blurred.teach()


def test_windows_of_teaching_grow_as_those_of_measuring():
    smallest, larger = window_sizes(3.0, 4.0, 0.0, False), window_sizes(12.0, 4.0, 0.0, False)
    assert (smallest.fit, smallest.growth) == (12, 1.0)
    plan, grown = smallest.plan(), larger.plan()
    assert (plan.base_window, plan.first_window, plan.platform_window) == (20, 24, 16)
    for name in ("base_window", "first_window", "platform_window"):
        assert getattr(grown, name) == pytest.approx(getattr(plan, name) * larger.fit / 12, abs=1)


@pytest.mark.parametrize("factor", [1.5, 2.0, 4.0])
def test_what_is_fitted_holds_a_sticker_that_is_a_fifth_nearer(factor):
    """A disc that faces a camera looks focal length * radius / distance large; the cameras stand
    half a metre aside, and its middle is rounded to a pixel."""
    radius, distance = 0.003 * factor, np.hypot(1.5841717, 0.5)
    sensor = teaching_itself({"stickers.radius": radius, "stickers.ring_radius": 3.0 * radius})
    found = radius_at(
        sensor.rig, invert(sensor.truth.base_from_camera), np.array([0.3, 0.0, 0.18]), radius
    )
    assert found == pytest.approx(2300.0 * radius / distance, rel=1e-6)
    reach = found / 0.82 + 0.5
    assert reach < 0.5 * sensor.settings.fit_size < 1.3 * reach + 1.0
    assert sensor.settings.window_size >= sensor.settings.fit_size + 2


@pytest.mark.parametrize("changes", LARGER)
def test_larger_stickers_are_taught_and_measured_with_a_true_covariance(changes, moving_path):
    """60 frames: their mean squared error, normalised by the stated covariances, is 6 with a
    deviation of 0.45.
    """
    sensor, path = teaching_itself(changes), moving_path(60)
    found = [sensor.measure(pose) for pose in path]
    assert [m.reason for m in found if not m.ok] == []
    assert min(len(m.target_ids) for m in found) >= 17
    spread = np.array([m.single_covariance for m in found])
    squared = squares(np.array([m.pose for m in found]) - path, spread)
    assert squared.mean() == pytest.approx(6.0, abs=1.35), squared.mean()


def test_teaching_names_the_stickers_that_no_image_shows():
    """One metre from the middle of platform and base, the lower stickers of the base lie below both
    images.
    """
    sensor = teaching_itself({"rig.distance": 1.0})
    places = apply(invert(sensor.truth.base_from_camera), sensor.base.nominal)
    below = sensor.base.sticker_ids[~sensor.rig.project(places)[1].all(axis=0)]
    with pytest.raises(cmmsim.TeachingError, match=f"; {', '.join(below)} lie outside of an image"):
        sensor.teach()


def test_planes_that_meet_in_no_point_cannot_be_taught():
    sensor = teaching_itself({"platform.planes.B.normal": [0.0, 0.0, 1.0]})
    refused(
        sensor.teach,
        r"planes A, B and C do not meet in one point.*volume of 0",
        cmmsim.TeachingError,
    )
