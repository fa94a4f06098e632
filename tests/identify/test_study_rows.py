"""Rows of studies: the same from the same seed whatever was computed before, and right against
closed forms.
"""

from functools import partial

import numpy as np
import pytest
from scipy.stats import binom, chi2, ks_2samp, ttest_ind

import cmmsim
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import invert, rotation_log
from cmmsim.teaching import exactly_taught
from dynamics import load_robot
from dynamics.closed_loop import (
    Reference,
    differentiate_servo,
)
from identify.errors import EstimationError, ScenarioError
from identify.model.model_side import model_side
from identify.scenario import load_scenario
from identify.setup import Setup
from identify.studies.rows import KINDS, find_kind
from identify.studies.rows.identified import prediction_figures
from identify.studies.rows.row_sensor import SENSORS_KEPT, DrawnSensor, exact_sensor
from identify.validation.unseen import model_run

NOISELESS = {
    "sensor_changes.camera.noise": False,
    "sensor_changes.camera.bit_depth": 12,
    "sensor_changes.camera.gain": 2.08,
    "sensor_changes.camera.black_level": 256.0,
}


def scenario(**overrides):
    return load_scenario("quick").with_overrides({"renderer": "analytic"} | overrides)


def seed(number=0):
    return np.random.SeedSequence(7, spawn_key=(number,))


def row(kind, number=0, settings=None, **options):
    chosen = find_kind(kind)
    return chosen.compute(settings or scenario(), seed(number), chosen.checked(options))


static = partial(row, "static_pose")


def test_a_row_is_that_of_its_seed_whatever_the_process_has_kept():
    exact_sensor.cache_clear()
    assert exact_sensor.cache_info().maxsize == SENSORS_KEPT
    given = seed()
    kind = find_kind("static_pose")
    alone, again = (kind.compute(scenario(), given, kind.checked({})) for _ in range(2))
    assert alone == again
    assert given.n_children_spawned == 0, "the seed is used up"
    assert alone["position_rms_um"] != static(1)["position_rms_um"]
    assert list(alone) == list(find_kind("static_pose").columns)
    for dark_noise in (10.0, 40.0, 80.0):
        static(1, scenario(**{"sensor_changes.camera.dark_noise": dark_noise}))
    kept = exact_sensor.cache_info()
    assert static(0) == alone
    assert exact_sensor.cache_info().hits == kept.hits + 1
    row("path_pose", 3, stretch_s=0.1)
    assert static(0) == alone


@pytest.mark.slow
def test_exact_teaching_is_what_teaching_finds_to_its_own_uncertainty():
    file = read_sensor_file("ctrack780")
    exact, taught = exactly_taught(file), cmmsim.Sensor(file, seed=3, renderer="analytic").taught
    # of the base frame as taught, in base axes
    error = exact.base_from_camera @ invert(taught.base_from_camera)
    small = np.concatenate([error[:3, 3], rotation_log(error[:3, :3])])
    assert small @ np.linalg.solve(taught.base_covariance, small) < chi2.ppf(0.9999, 6)
    assert np.linalg.norm(taught.platform_places - exact.platform_places, axis=1).max() < 5e-6
    assert not exact.platform_covariance.any()


def test_rows_agree_with_the_sensors_own_covariance_and_err_hardly_without_noise():
    many = [static(number) for number in range(40)]
    square = sum((one["position_rms_um"] / one["stated_position_rms_um"]) ** 2 * 12 for one in many)
    assert chi2.ppf(0.0005, 12 * 40) < square < chi2.ppf(0.9995, 12 * 40)
    quiet = static(0, scenario(**NOISELESS))
    for figure in (
        "position_rms_um",
        "orientation_rms_urad",
        "centre_rms_px",
        "point_depth_rms_um",
    ):
        assert quiet[figure] < 0.1 * many[0][figure]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "rows", "options"),
    [
        pytest.param("static_pose", 24, {"poses": 3, "captures": 2}, marks=pytest.mark.slow),
        pytest.param("static_pose", 400, {"poses": 5}, marks=pytest.mark.thorough),
        pytest.param("path_pose", 200, {}, marks=pytest.mark.thorough),
        pytest.param("identification", 60, {"sensor": "images"}, marks=pytest.mark.thorough),
    ],
)
def test_rows_without_images_have_the_means_and_bands_of_rows_with_them(kind, rows, options):
    """Figures of as many rows of both: their means by Welch's test, their bands by the
    Kolmogorov-Smirnov test.

    What is stated beforehand hardly differs among rows along one trajectory: of that the mean
    counts, to the 1 % for which the sensor without images is proved.
    """
    figures = {}
    for start, renderer in enumerate(("analytic", "statistical")):
        found = [
            row(kind, 1000 * start + k, scenario(renderer=renderer), **options) for k in range(rows)
        ]
        figures[renderer] = {name: np.array([one[name] for one in found]) for name in found[0]}
    for name, drawn in figures["analytic"].items():
        said = figures["statistical"][name]
        if np.ptp(drawn) == np.ptp(said) == 0.0:
            assert drawn[0] == said[0], name
            continue
        if kind == "identification" and name.startswith("pose_noise"):
            assert said.mean() == pytest.approx(drawn.mean(), rel=0.01), name
            continue
        assert ttest_ind(drawn, said, equal_var=False).pvalue > 3e-4, (
            name,
            drawn.mean(),
            said.mean(),
        )
        assert ks_2samp(drawn, said).pvalue > 3e-4, name


@pytest.mark.slow
def test_teaching_by_the_sensor_adds_its_own_error_and_is_seeded_by_the_row():
    taught = static(0, captures=1, teaching="sensor")
    assert taught == static(0, captures=1, teaching="sensor")
    assert taught != static(0, captures=1)


def test_a_held_pose_averages_pictures_at_the_frame_rate_of_which_a_binomial_share_is_dropped():
    held = static(0, scenario(**{"timing.frame_rate_hz": 30.0}), hold_s=0.5)
    assert held["captures"] == 15
    assert held["mean_position_rms_um"] < held["position_rms_um"]
    assert static(0, captures=3, poses=2)["captures"] == 6
    dropping = scenario(**{"timing.dropout": 0.4})
    for one in (static(0, dropping, hold_s=0.5), row("path_pose", 1, dropping, stretch_s=0.5)):
        assert one.get("captures", one.get("frames")) == 30
        assert binom.ppf(1e-4, 30, 0.4) <= one["lost_frames"] <= binom.ppf(1 - 1e-4, 30, 0.4)


def test_a_row_of_one_picture_is_lost_and_says_why_or_is_that_of_a_sensor_that_loses_none():
    def one_picture(number, dropout):
        try:
            return static(number, scenario(**{"timing.dropout": dropout}), captures=1)
        except EstimationError as error:
            return str(error)

    whole, halved = (
        [one_picture(number, dropout) for number in range(12)] for dropout in (0.0, 0.5)
    )
    lost = "no pose was found in any of 1 pictures: dropped frame (with a probability of 0.5)"
    assert 0 < halved.count(lost) < 12
    assert all(half in (one, lost) for one, half in zip(whole, halved, strict=True))
    with pytest.raises(
        EstimationError, match=r"no pose was found in any of 4 pictures: \d+ visible stickers"
    ):
        static(0, scenario(**{"sensor_changes.stickers.sticker_level": 12}))


@pytest.mark.parametrize("renderer", ["analytic", "statistical"])
def test_a_path_is_measured_in_motion_by_both_methods_as_exactly_as_they_state(renderer):
    """Over 60 frames of six errors each, whose stickers are drawn out over some tenths of a
    pixel."""
    moving = {"renderer": renderer, "timing.exposure_s": 0.01}
    for method in ("registration", "planes"):
        path = row("path_pose", 4, scenario(pose_method=method, **moving), stretch_s=1.0)
        assert (path["frames"], path["lost_frames"]) == (60, 0)
        for what in ("position_rms_um", "orientation_rms_urad"):
            assert path[what] == pytest.approx(path[f"stated_{what}"], rel=0.25)


@pytest.mark.parametrize(
    ("latency_frames", "expected"), [(0, np.sqrt(1 / 3)), (2, np.sqrt(4 + 2 + 1 / 3))]
)
def test_pose_in_use_lags_by_what_its_age_says(latency_frames, expected):
    """A pose that is L old when it arrives and held for T is off by v sqrt(L^2 + L T + T^2 / 3) in
    the mean.
    """
    rate = 30.0
    settings = scenario(
        **NOISELESS | {"timing.frame_rate_hz": rate, "timing.latency_s": latency_frames / rate}
    )
    path = row("path_pose", 2, settings, stretch_s=1.0)
    assert path["frames"] == 30
    ratio = 1e-3 * path["used_position_rms_um"] / path["speed_rms_mm_s"] * rate
    assert ratio == pytest.approx(expected, rel=0.06)
    assert path["position_rms_um"] < 1.0


def test_drawn_sensor_has_the_covariance_that_it_states_and_loses_its_share_of_frames_alone():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6)) * np.repeat([1e-6, 1e-5], 3)[:, None]
    covariance, pose, count = root @ root.T, np.arange(6.0), 3000
    whole, losing = DrawnSensor(covariance), DrawnSensor(covariance, dropout=0.3)
    for sensor in (whole, losing):
        sensor.start_run(5)
    pairs = [(whole.measure(pose), losing.measure(pose)) for _ in range(count)]
    errors = np.array([first.pose - pose for first, _ in pairs])
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), errors.T)
    assert chi2.ppf(0.0005, 6 * count) < np.sum(whitened**2) < chi2.ppf(0.9995, 6 * count)
    assert np.abs(np.corrcoef(whitened) - np.eye(6)).max() < 5 / np.sqrt(count)
    assert sum(not second.ok for _, second in pairs[:1000]) == pytest.approx(300, abs=60)
    assert all(np.array_equal(first.pose, second.pose) for first, second in pairs if second.ok)


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_says_unit_and_meaning_of_its_columns_and_which_are_drawn(kind):
    columns = find_kind(kind).columns
    assert any(column.main for column in columns.values())
    suffixes = {
        "um": "_um",
        "urad": "_urad",
        "px": "_px",
        "%": "_percent",
        "mm/s": "_mm_s",
        "m": "_m",
        "N m": "_N_m",
    }
    for name, column in columns.items():
        assert column.meaning
        assert name.endswith(suffixes.get(column.unit, ""))


@pytest.mark.thorough
def test_closed_loop_follows_its_reference_with_the_images_in_the_loop():
    settings = scenario(**{"validation.duration_s": 1.0})
    one, again = (row("closed_loop", 0, settings, teaching="exact") for _ in range(2))
    assert (one["frames"], one["lost_frames"]) == (60, 0)
    assert one["position_rms_um"] < 2.0 * one["stated_position_rms_um"]
    assert 10.0 < one["tracking_position_rms_um"] < 1e4
    assert one == again


def test_covariance_of_one_known_error_states_what_that_error_makes_of_the_prediction():
    """An error d with the covariance d d^T: what is stated is exact but for the curvature of the
    model.
    """
    settings = scenario()
    robot = load_robot(settings.robot)
    poses = np.tile(robot.home_pose, (60, 1))
    poses[:, :3] += 0.002 * np.sin(np.arange(60)[:, None] / np.array([5.0, 7.0, 9.0]))
    reference = Reference(poses, np.gradient(poses, settings.timing.frame_period_s, axis=0))
    truth = Setup(settings, loaded=robot).plant.parameters
    loop = model_side(robot, settings).settings
    error = 1e-4 * truth * np.random.default_rng(0).normal(size=len(truth))
    model = differentiate_servo(robot, truth + error, reference, loop)
    true = model_run(robot, loop, truth, reference)
    found = prediction_figures(
        [(model.pose, model.pose_sensitivity)], np.outer(error, error), [true]
    )
    assert found["prediction_rms_um"] > 0.01
    assert found["stated_prediction_rms_um"] == pytest.approx(found["prediction_rms_um"], rel=0.01)


@pytest.mark.slow
def test_identification_finds_the_parameters_to_what_it_states():
    settings = scenario(**{"identification.method": "command_driven", "validation.count": 1})
    *found, again = (row("identification", number, settings) for number in (0, 1, 2, 0))
    columns = find_kind("identification").columns
    assert set(again) == {name for name in columns if not name.startswith("unaware")}
    assert found[0] == again
    assert np.mean([one["covered_percent"] for one in found]) > 85.0
    assert all(one["unseen_position_rms_um"] < one["pose_noise_um"] for one in found)
    assert np.sqrt(np.mean([one["normalised_error"] ** 2 for one in found])) < 1.5


@pytest.mark.parametrize(
    ("duration_s", "within"),
    [pytest.param(*row, marks=pytest.mark.thorough) for row in ((3.0, 0.2), (10.0, 0.1))],
)
def test_identification_from_images_is_as_good_as_from_drawn_noise(duration_s, within):
    once = {
        "identification.method": "command_driven",
        "validation.count": 1,
        "validation.duration_s": 1.0,
    }
    settings = scenario(**once, **{"excitation.duration_s": duration_s})
    drawn, images = (
        row("identification", 5, settings, sensor=sensor) for sensor in ("drawn", "images")
    )
    for figure in ("pose_noise_um", "viscous_std_percent"):
        assert images[figure] == pytest.approx(drawn[figure], rel=within)


@pytest.mark.thorough
def test_intervals_that_know_of_inexact_cameras_hold_where_those_that_do_not_do_not():
    """Two rows of the study `inexact`, with short records."""
    inexact = {
        "rig.known": "photographs",
        "timing.latency_std_s": 0.002,
        "rig.right_later_std_s": 2e-4,
    }
    driven = {
        "identification.method": "command_driven",
        "validation.count": 1,
        "validation.duration_s": 1.0,
    }
    settings = scenario(
        **inexact,
        **driven,
        **{"renderer": "statistical", "identification.scale_anchor": "joint_gain"},
    )
    found = [
        row("identification", number, settings, sensor="images", unaware=True) for number in (0, 1)
    ]
    assert found[0]["unseen_position_rms_um"] != found[1]["unseen_position_rms_um"]
    for one in found:
        assert one["covered_percent"] > 80.0
        assert (
            one["unaware_covered_percent" if one["unaware_intervals"] else "unaware_intervals"]
            < 80.0
        )
        assert one["unaware_poses_covered_percent"] < 80.0


@pytest.mark.thorough
def test_a_law_follows_the_closer_the_better_its_model_and_pid_knows_none():
    settings = scenario(
        **{"renderer": "statistical", "validation.count": 1, "validation.duration_s": 2.0}
    )
    truth, between, start = (
        row("tracking", 0, settings, model_error=share) for share in (0.0, 0.1, 1.0)
    )
    assert truth == row("tracking", 0, settings)
    assert start["position_rms_um"] == pytest.approx(
        row("tracking", 0, settings, model="initial")["position_rms_um"]
    )
    figures = [one["position_share_percent"] for one in (truth, between, start)]
    assert figures == sorted(figures)
    assert figures[0] < 1.0 < figures[2] < 100.0
    assert start["pid_position_rms_um"] == truth["pid_position_rms_um"]
    same = row("tracking", 0, settings, law="pid")
    assert same["position_rms_um"] == same["pid_position_rms_um"]
    torques = row("tracking", 0, settings, law="computed_torque", off=0.15)
    assert 0.1 < torques["observer_normalised_error"] < 10.0


@pytest.mark.slow
def test_estimators_are_compared_on_the_same_record():
    settings = scenario(
        **{"renderer": "statistical", "validation.count": 1, "validation.duration_s": 1.0}
    )
    found = row(
        "estimators", 0, settings, sensor="images", estimators=["torque_ls", "command_driven"]
    )
    assert (
        found["command_driven_position_um"]
        < found["torque_ls_position_um"]
        < found["starting_guess_position_um"]
    )
    assert "closed_loop_position_um" not in found
    with pytest.raises(ScenarioError, match="nobody"):
        row("estimators", 0, settings, estimators=["nobody"])
