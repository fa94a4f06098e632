"""What a kind of row reads, against what acts on its rows, and studies that set what does nothing."""

from functools import reduce
from typing import get_args

import numpy as np
import pytest

from cmmsim.files.sensor_file import read_sensor_file
from identify.errors import IdentifyError, StudyError
from identify.plugins import CRITERIA
from identify.scenario import load_scenario
from identify.studies.design import overrides, prepare, valid_keys
from identify.studies.rows import find_kind
from identify.studies.study_file import Study
from tests.identify.study_rows import KIND

KP, DARK, NOISE = "scenario.servo.kp", "sensor.camera.dark_noise", "sensor.camera.noise"
ALONE = {
    "scenario.name", "scenario.description", "scenario.sensor_note", "sensor.name", "sensor.note", "scenario.robot",
    *(f"scenario.{side}.{name}" for side in ("plant", "model") for name in (
        "friction", "smoothing_velocity_rad_s", "static_ratio", "stribeck_velocity_rad_s")),
    "scenario.plant.parameters", "scenario.model.start_parameters",
}  # fmt: skip
"""Keys whose other values are names, or stand with others: not tried by `with_others`."""


def study(**entries):
    return Study(**{"name": "mine", "kind": "static_pose", "scenario": "quick"} | entries)


def refusal(**entries):
    with pytest.raises(StudyError) as caught:
        prepare(study(**entries))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def others(value, annotation):
    """Some other values of a key's type, one of which will fit the rest of a scenario."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, (int, float)):
        return [type(value)(other) for other in (1.25 * value, value + 1, 0.8 * value, 0.001)]
    if value is None:
        return [100.0, 1e-5]
    return [other for other in get_args(annotation) or CRITERIA if other != value]


def with_others(scenario, paths):
    """The scenario with another value at each of the paths, and those for which there is none."""
    file, left = read_sensor_file(scenario.sensor, scenario.sensor_changes), set()
    for path in paths:
        root, _, key = path.partition(".")
        for value in others(
            reduce(getattr, key.split("."), scenario if root == "scenario" else file), valid_keys(None)[path].annotation
        ):
            try:
                scenario = scenario.with_overrides(overrides({path: value}))
                break
            except IdentifyError:
                continue
        else:
            left.add(path)
    return scenario, left


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("static_pose", {"captures": 2}),
        ("path_pose", {"stretch_s": 0.05}),
        pytest.param("closed_loop", {"teaching": "exact"}, marks=pytest.mark.slow),
        pytest.param("identification", {}, marks=pytest.mark.slow),
    ],
)
def test_what_a_kind_does_not_read_changes_nothing_in_its_rows(kind, options):
    """All of it at once, each at another value, and not a digit of the row is another."""
    given = {
        "renderer": "analytic",
        "timing.latency_s": 0.004,
        "timing.latency_jitter_s": 0.001,
        "validation.duration_s": 0.5,
        "validation.count": 1,
        "identification.method": "command_driven",
    }
    scenario, reads = load_scenario("quick").with_overrides(given), find_kind(kind).reads
    unread = [path for path in valid_keys(None) if not reads.covers(path) and "prior." not in path]
    other, left = with_others(scenario, unread)
    shared = {"sensor.timing.latency", "sensor.timing.latency_jitter"}  # which the scenario states
    assert left <= ALONE | shared | {"sensor.renderer"}
    one, two = (find_kind(kind).row(settings, np.random.SeedSequence(3), options) for settings in (scenario, other))
    assert one == two


@pytest.mark.parametrize(
    ("path", "value"),
    [("scenario.timing.exposure_s", 0.004), ("scenario.timing.dropout", 0.6), ("scenario.pose_method", "planes"),
     ("scenario.excitation.position_amplitude_m", 0.005), ("scenario.excitation.orientation_amplitude_rad", 0.02),
     ("scenario.timing.frame_rate_hz", 50.0), ("sensor.rig.distance", 2.1), (DARK, 40.0), (NOISE, False),
     ("sensor.timing.dropout", 0.6), ("options.hold_s", 0.3)],
)  # fmt: skip
def test_what_a_held_pose_reads_acts_on_its_rows(path, value):
    scenario = load_scenario("quick").with_overrides({"renderer": "analytic"})
    options = {"hold_s": 0.1}
    one = find_kind("static_pose").row(scenario, np.random.SeedSequence(3), options)
    assert find_kind("static_pose").reads.covers(path)
    if path.startswith("options."):
        options |= {path.partition(".")[2]: value}
    assert (
        find_kind("static_pose").row(
            scenario.with_overrides(overrides({path: value})), np.random.SeedSequence(3), options
        )
        != one
    )


@pytest.mark.parametrize(
    ("entries", "evidence"),
    [
        ({"factors": {KP: [0.1, 0.3]}}, [f"factors.{KP} does nothing", "'static_pose'", "scenario.pose_method"]),
        ({"changes": {KP: 0.1}}, [f"changes.{KP} does nothing", "sensor.camera.*", "but sensor.stickers.obstacle_l"]),
        ({"kind": "identification", "factors": {"scenario.identification.qr_threshold": [1e-3, 1e-4]}},
         ["qr_threshold does nothing", "they read scenario.*, sensor.rig.*"]),
        ({"factors": {"options.hold_s": [0.2, 0.4], "options.captures": [1, 4]}},
         ["factors.options.captures does nothing", "where options.hold_s is given"]),
        ({"options": {"hold_s": 0.2, "captures": 4}}, ["options.captures does nothing", "hold_s is given"]),
        ({"factors": {"scenario.timing.frame_rate_hz": [40.0, 60.0]}}, ["hold_s is not given: options.captures sets"]),
        ({"changes": {NOISE: False}, "factors": {DARK: [1.0, 2.0]}}, [f"factors.{DARK}", f"{NOISE} is false"]),
        ({"kind": "identification", "changes": {NOISE: False}}, [f"changes.{NOISE}", "options.sensor is drawn"]),
        ({"kind": "identification", "factors": {"scenario.payload.mass_kg": [8.0, 9.0]}}, ["anchor is not payload"]),
        ({"kind": "closed_loop", "factors": {"scenario.plant.geometry_seed": [0, 1]}}, ["geometry_error_m is 0"]),
    ],
)  # fmt: skip
def test_what_does_nothing_is_refused_before_any_row(entries, evidence):
    message = refusal(**entries)
    assert all(word in message for word in evidence), message


@pytest.mark.parametrize(
    "entries",
    [
        {"kind": KIND, "factors": {KP: [0.1, 0.3]}},
        {"kind": "closed_loop", "factors": {KP: [0.1, 0.3]}},
        {"factors": {NOISE: [False, True], DARK: [1.0, 2.0]}},
        {"factors": {"scenario.timing.frame_rate_hz": [40.0, 60.0]}, "options": {"hold_s": 0.2}},
        {"kind": "identification", "options": {"sensor": "images"}, "changes": {NOISE: False}},
        {"kind": "identification", "factors": {"scenario.identification.scale_anchor": ["payload", "joint_gain"],
                                               "scenario.payload.mass_kg": [8.0, 9.0]}},
        {"kind": "closed_loop", "factors": {"scenario.plant.geometry_seed": {"low": 0, "high": 9},
                                            "scenario.plant.geometry_error_m": {"low": 0, "high": 1e-4}}, "sample": 4},
        {"changes": {"scenario.filter.cutoff_hz": 12.0, "scenario.renderer": "analytic", "scenario.name": "mine"}},
    ],
)  # fmt: skip
def test_what_acts_on_some_rows_or_fits_the_scenario_together_is_taken(entries):
    prepare(study(**entries))
