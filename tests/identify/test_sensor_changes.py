"""A scenario's changes to its sensor: what they reach, and what is refused."""

import numpy as np
import pytest

from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.visibility import sight_lines
from dynamics import load_robot
from identify.errors import ScenarioError
from identify.experiment.sensor_in_loop import make_sensor
from identify.scenario import load_scenario, scenario_from_toml

CHANGES = {"camera.dark_noise": 52.0, "lens.psf_px": 0.6, "rig.baseline": 0.8}


@pytest.fixture(scope="module")
def paper():
    return load_scenario("paper")


def with_changes(scenario, changes):
    return scenario.with_overrides({f"sensor_changes.{key}": value for key, value in changes.items()})


def test_changed_sensor_is_that_of_a_file_with_the_same_entries(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text(
        'name = "ctrack780"\nbased_on = "ctrack780"\n[camera]\ndark_noise = 52.0\n[lens]\npsf_px = 0.6\n'
        "[rig]\nbaseline = 0.8\n"
    )
    expected = read_sensor_file(mine).model_copy(update={"based_on": None})
    assert read_sensor_file("ctrack780", CHANGES) == expected
    nested = {"camera": {"dark_noise": 52.0}, "lens": {"psf_px": 0.6}, "rig": {"baseline": 0.8}}
    assert read_sensor_file("ctrack780", nested) == expected
    assert read_sensor_file("ctrack780") == read_sensor_file("ctrack780", {})


def test_sensor_of_the_loop_and_the_excitations_knowledge_have_the_changes(paper):
    """Baseline and noise decide what a pose is worth; the loop's sensor must be the changed one."""
    changed = with_changes(paper, CHANGES)
    sensor = make_sensor(changed, load_robot("rss6"), seed=0)
    assert (sensor.noise.dark_noise, sensor.optics.psf_px) == (52.0, 0.6)
    assert np.linalg.norm(sensor.rig.from_camera[1][:3, 3]) == pytest.approx(0.8)
    sight = sight_lines("ctrack780", changed.sensor_changes)
    assert np.linalg.norm(sight.rig.from_camera[1][:3, 3]) == pytest.approx(0.8)


def test_timing_follows_the_changes_unless_the_scenario_states_another(paper):
    faster = with_changes(paper, {"timing.frame_rate": 125.0})
    assert faster.timing.frame_rate_hz == 125.0
    with pytest.raises(ScenarioError, match=r"frame_rate = 125 has no effect .* timing.frame_rate_hz = 60"):
        faster.with_overrides({"timing.frame_rate_hz": 60.0})


def test_resolved_scenario_with_changes_reads_back_equal(paper):
    changed = with_changes(
        paper,
        CHANGES
        | {"timing.frame_rate": 125.0, "camera.noise": False, "platform.planes.A.stickers": [[0, 1], [1, 0], [0.1, 1]]},
    )
    assert scenario_from_toml(changed.to_toml()) == changed
    assert with_changes(changed, dict.fromkeys(changed.sensor_changes)) == paper


@pytest.mark.parametrize(
    ("changes", "evidence"),
    [
        ({"camera.drk_noise": 1.0}, ["camera.drk_noise", "dark_noise"]),
        ({"camera": 1.0}, ["camera = 1.0 is a section", "dark_noise"]),
        ({"camera.dark_noise.rms": 1.0}, ["'dark_noise'", "a value, not a section"]),
        ({"camera.dark_noise": "much"}, ["camera.dark_noise", "'much'"]),
        ({"camera.dark_noise": -1.0}, ["camera.dark_noise", "-1.0"]),
        ({"based_on": "ctrack780_29hz"}, ["based_on", "ctrack780_29hz", "another sensor"]),
        ({"lens.focus": 1.0}, ["lens.focus", "psf_px", "vignetting"]),
    ],
)
def test_changes_that_no_sensor_file_may_hold_are_named(paper, changes, evidence):
    with pytest.raises(ScenarioError) as caught:
        with_changes(paper, changes)
    assert all(word in str(caught.value) for word in evidence)
    assert "\n" not in str(caught.value)
