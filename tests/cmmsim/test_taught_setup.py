"""What one sensor was taught is refused by another whose cameras or bodies differ, and taken where only noise does."""

import pickle
from dataclasses import replace

import pytest

import cmmsim
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.teaching import exactly_taught

TAUGHT = exactly_taught(read_sensor_file("ctrack780"))


def load(changes=None, taught=TAUGHT, name="ctrack780"):
    return cmmsim.load_sensor(name, taught=taught, changes=changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rig.target": [0.30, 0.0, 0.185]}, r"rig.target \[0.3, 0.0, 0.18\] there, \[0.3, 0.0, 0.185\] here"),
        ({"rig.distance": 1.5}, r"rig.position \[1.44, 0.0, 1.28\] there, \[1.37"),
        ({"rig.baseline": 0.8}, "rig.baseline 1.0 there, 0.8 here"),
        (
            {"rig.left": {"focal_px": [2301.0, 2301.0], "centre_px": [1023.5, 767.5]}},
            "rig.left.centre_px nothing there",
        ),
        (
            {"rig.right_from_left": {"translation": [-0.9, 0.0, 0.3], "rotation_vector": [0.0, 0.6, 0.0]}},
            "right_from_left",
        ),
        ({"stickers.placement_seed": 781}, "stickers.placement_seed 780 there, 781 here"),
        ({"base.planes.A.point": [0.0, 0.0, 0.181]}, "base.planes.A.point"),
        ({"stickers.per_plane": 4}, "platform.planes.A.stickers .* platform.planes.C.stickers"),
    ],
)
def test_what_another_sensor_was_taught_is_refused_with_what_differs(changes, message):
    with pytest.raises(cmmsim.TeachingError, match=message) as refusal:
        load(changes)
    assert "\n" not in str(refusal.value)


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


def test_a_sensor_based_on_another_takes_what_that_was_taught():
    assert load(name="ctrack780_29hz").taught is TAUGHT


@pytest.mark.rendering
def test_teaching_states_its_setup(taught):
    assert taught.setup == TAUGHT.setup
    assert load(taught=pickle.loads(pickle.dumps(taught))).taught.setup == TAUGHT.setup


def test_one_put_together_by_hand_needs_the_name_and_all_stickers():
    by_hand = replace(TAUGHT, setup="")
    assert load(taught=by_hand).taught is by_hand
    with pytest.raises(cmmsim.TeachingError, match="'ctrack780', not to 'ctrack780_29hz'"):
        load(taught=by_hand, name="ctrack780_29hz")
    with pytest.raises(cmmsim.TeachingError, match="holds 18 stickers of the platform, sensor 'ctrack780' has 12"):
        load({"stickers.per_plane": 4}, taught=by_hand)


def test_one_kept_from_before_setups_were_stated_still_loads():
    old = pickle.dumps(TAUGHT)
    state = dict(TAUGHT.__dict__)
    del state["setup"]
    again = pickle.loads(old)
    again.__dict__.clear()
    again.__dict__.update(state)
    assert load(taught=again).taught is again


def test_arrays_of_another_shape_are_refused():
    with pytest.raises(cmmsim.ShapeError, match=r"place_covariances must have the shape \(17, 3, 3\), got \(18"):
        replace(TAUGHT, platform_places=TAUGHT.platform_places[1:])
