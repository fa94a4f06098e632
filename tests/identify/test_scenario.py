"""Scenarios: what the built-in ones say, what comes from the sensor's file, what no scenario may
be, and what may change for another estimator on a record that exists."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from cmmsim.files import read_sensor_file
from cmmsim.visibility import sight_lines
from dynamics import load_robot
from identify import pipeline
from identify.errors import ScenarioError
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import DEFAULT_STD
from identify.files.run_folder import load_result
from identify.progress import SilentProgress
from identify.record.recording import read
from identify.reporting.report_sections import provenance_section
from identify.reporting.run_data import read_run
from identify.reporting.run_result import parameter_vector
from identify.reporting.settings import changed_settings, settings_set_anew
from identify.scenario import Scenario, load_scenario, scenario_from_toml, scenario_names
from identify.scenario.scenario import ESTIMATOR_SECTIONS, scenario_schema
from identify.scenario.sections import Identification
from identify.setup import Setup
from tests.identify.commands import command, one_line, refusal
from tests.identify.synthetic import NAMES, SHORT, changed_robot_file, rss6


def refused(overrides):
    return refusal(ScenarioError, load_scenario("paper").with_overrides, overrides)


def test_paper_scenario_has_the_papers_numbers_and_the_quick_one_differs_only_in_what_takes_time():
    paper = load_scenario("paper")
    assert (paper.servo.kp, paper.servo.kd, paper.servo.ki) == (0.3, 0.001, 2.4)
    assert (paper.excitation.fundamental_hz, paper.excitation.harmonics) == (0.1, 5)
    assert (paper.timing.frame_rate_hz, paper.timing.latency_s) == (60.0, 0.0)
    assert (paper.excitation.duration_s, paper.validation.count, paper.validation.duration_s) == (
        20.0,
        10,
        10.0,
    )
    assert paper.filter.order == 8
    slow, quick = paper.model_dump(), load_scenario("quick").model_dump()
    differing = {
        f"{s}.{k}"
        for s in slow
        if isinstance(slow[s], dict)
        for k in slow[s]
        if slow[s][k] != quick[s][k]
    }
    assert {name for name in slow if slow[name] != quick[name]} == {
        "name",
        "description",
        "excitation",
        "validation",
    }
    takes_time = {"excitation.duration_s", "excitation.candidates", "excitation.method"}
    assert differing == takes_time | {"validation.count", "validation.duration_s"}


def test_paper_settings_are_those_that_the_paper_states_and_otherwise_ours():
    """Sections 3.2, 4.2 and 4.3 of the paper."""
    theirs = load_scenario("paper_settings")
    assert (theirs.servo.kp, theirs.servo.kd, theirs.servo.ki) == (0.3, 0.001, 2.4)
    assert (theirs.excitation.fundamental_hz, theirs.excitation.harmonics) == (0.1, 5)
    assert (theirs.excitation.method, theirs.excitation.generations) == ("evolutionary", 324)
    assert theirs.excitation.criterion == "observability"
    assert (theirs.filter.order, theirs.filter.cutoff_hz) == (8, 60.0)
    assert theirs.timing.frame_rate_hz > 2 * theirs.filter.cutoff_hz
    assert (theirs.identification.method, theirs.identification.qr_threshold) == (
        "closed_loop",
        1e-3,
    )
    assert theirs.validation.count == 10
    ours = load_scenario("paper").model_dump()
    differing = {
        f"{section}.{key}"
        for section, values in theirs.model_dump().items()
        if isinstance(values, dict)
        for key, value in values.items()
        if ours[section][key] != value
    }
    assert differing == {"timing.frame_rate_hz", "excitation.method", "filter.cutoff_hz"}


def test_timing_is_the_sensors_unless_the_scenario_states_it():
    paper = load_scenario("paper")
    slow = paper.with_overrides({"sensor": "ctrack780_29hz"})
    assert (slow.timing.frame_rate_hz, slow.timing.latency_s) == (29.0, 1 / 29)
    assert "assumed" in slow.sensor_note
    assert slow.with_overrides({"sensor": "ctrack780"}) == paper
    faster = slow.with_overrides({"timing.frame_rate_hz": 58.0})
    assert (faster.timing.frame_rate_hz, faster.timing.latency_s) == (58.0, 1 / 29)
    assert faster.with_overrides({"timing.frame_rate_hz": None}) == slow
    still_faster = faster.with_overrides({"sensor": "ctrack780"})
    assert (still_faster.timing.frame_rate_hz, still_faster.timing.latency_s) == (58.0, 0.0)


def test_resolved_scenario_keeps_its_timing_whatever_the_sensor_file_says(tmp_path):
    """What a run folder holds: every number is stated there, so the sensor's file is not asked."""
    sensor = tmp_path / "mine.toml"
    sensor.write_text(
        'name = "mine"\nbased_on = "ctrack780"\n[timing]\nframe_rate = 50\nlatency = '
        "0.02\ndropout = 0.1\n"
        "latency_jitter = 0.005\nexposure = 0.002\n"
    )
    scenario = load_scenario("paper").with_overrides({"sensor": str(sensor)})
    timing = scenario.timing
    assert (timing.frame_rate_hz, timing.exposure_s, timing.latency_s) == (50.0, 0.002, 0.02)
    assert (timing.latency_jitter_s, timing.dropout) == (0.005, 0.1)
    sensor.write_text('name = "mine"\nbased_on = "ctrack780"\n[timing]\nframe_rate = 5000\n')
    assert f"timing of the sensor {str(sensor)!r}: frame_rate_hz = 5000.0 [Hz]" in refused(
        {"sensor": str(sensor)}
    )
    sensor.unlink()
    assert scenario_from_toml(scenario.to_toml()) == scenario


@pytest.mark.parametrize("name", scenario_names())
def test_resolved_toml_names_every_value_and_reads_back_equal(name):
    scenario = load_scenario(name).with_overrides(
        {
            "description": 'quotes " and \\ and é',
            "plant.friction": "smoothed",
            "plant.smoothing_velocity_rad_s": 1e-3,
        }
        | {PRIOR: {"link2.Izz": {"value": 3e-3, "std": 1e-4}}}
    )
    text = scenario.to_toml()
    for section, model in Scenario.model_fields.items():
        for key in getattr(model.annotation, "model_fields", ()):
            assert f"{key} =" in text.partition(f"\n[{section}]")[2].partition("\n[")[0]
    assert scenario_from_toml(text) == scenario
    assert tomllib.loads(text) == scenario.model_dump(exclude_none=True)


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder with a scenario and the robot and sensor that it names, called from one with files
    of the same names.
    """
    folder = tmp_path / "project"
    here = tmp_path / "here"
    for place, cranks, rate in ((folder / "files", 0.062, 50), (here / "files", 0.065, 40)):
        place.mkdir(parents=True)
        changed_robot_file(
            place / "robot.toml", "crank_length = 0.06\n", f"crank_length = {cranks}\n"
        )
        (place / "sensor.toml").write_text(
            f'name = "s"\nbased_on = "ctrack780"\n[timing]\nframe_rate = {rate}\n'
        )
    (folder / "mine.toml").write_text(
        'name = "mine"\nrobot = "files/robot.toml"\nsensor = "files/sensor.toml"\n'
    )
    monkeypatch.chdir(here)
    return folder


def test_paths_in_a_scenario_start_from_its_own_file_and_hold_from_anywhere(elsewhere, monkeypatch):
    scenario = load_scenario("../project/mine.toml")
    assert load_robot(scenario.robot).geometry.legs[0].crank_length == 0.062
    assert scenario.timing.frame_rate_hz == 50
    typed = scenario.with_overrides({"robot": "files/robot.toml"})
    assert load_robot(typed.robot).geometry.legs[0].crank_length == 0.065, (
        "found from where it is typed"
    )
    assert Path(typed.robot).is_absolute()
    assert typed.timing.frame_rate_hz == 50
    (elsewhere / "left").mkdir()
    resolved = elsewhere / "left" / "scenario.toml"
    resolved.write_text(scenario.to_toml(), encoding="utf-8")
    monkeypatch.chdir("/")
    assert load_scenario(resolved) == scenario
    again = load_scenario(resolved).with_overrides({"timing.frame_rate_hz": None})
    assert again.timing.frame_rate_hz == 50, "the sensor's file is found again"


def test_a_built_in_name_wins_over_a_file_and_one_that_is_nothing_is_left_as_it_stands(elsewhere):
    (elsewhere / "rss6").write_text("no robot")
    (elsewhere / "ctrack780").write_text("no sensor")
    (elsewhere / "mine.toml").write_text('name = "mine"\nrobot = "rss6"\nsensor = "ctrack780"\n')
    scenario = load_scenario(elsewhere / "mine.toml")
    assert (scenario.robot, scenario.sensor) == ("rss6", "ctrack780")
    (elsewhere / "mine.toml").write_text('name = "mine"\nrobot = "rss7"\n')
    assert load_scenario(elsewhere / "mine.toml").robot == "rss7"
    (elsewhere / "mine.toml").write_text('name = "mine"\nsensor = "none.toml"\n')
    with pytest.raises(ScenarioError, match=str(elsewhere / "none.toml")):
        load_scenario(elsewhere / "mine.toml")


def test_scenario_is_that_of_a_file_and_what_is_none_is_named(tmp_path):
    mine, bad = tmp_path / "mine.toml", tmp_path / "bad.toml"
    mine.write_text('name = "mine"\n[timing]\nframe_rate_hz = 120\n', encoding="utf-8")
    assert load_scenario(mine).timing.frames(0.5) == 60
    bad.write_text("name = ", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"bad\.toml is not valid TOML"):
        load_scenario(bad)
    with pytest.raises(
        ScenarioError,
        match=r"'nope' is neither built in \(geometry, paper, paper_settings, quick\) nor a file",
    ):
        load_scenario("nope")
    with pytest.raises(
        ScenarioError, match=r"robot 'd9' is neither built in \(.*rss6.*\) nor a file"
    ):
        load_scenario("quick", robot="d9")
    with pytest.raises(ValueError, match="frozen"):
        load_scenario("paper").timing.latency_s = 1.0


PRIOR = "identification.prior"
PAYLOAD = {"identification.scale_anchor": "payload", "identification.anchor_std": 0.1}


@pytest.mark.parametrize(
    ("overrides", "evidence"),
    [
        (
            {"timing.frame_rat": 3.0},
            ["unknown key 'timing.frame_rat'; valid names in [timing]: frame_rate_hz, "],
        ),
        ({"camera.gain": 3.0}, ["unknown key 'camera'"]),
        ({"robot.name": "x"}, ["robot.name", "not a section"]),
        ({"name": "a/b"}, ["name", "a/b"]),
        ({"sensor": "ctrack79"}, ["ctrack79", "ctrack780", "ctrack780_29hz"]),
        (
            {"timing.latency_s": 0.7, "timing.frame_rate_hz": 100.0},
            ["0.7 s", "70.0 frames", "at most 60 frames"],
        ),
        (
            {"timing.latency_s": 0.9, "timing.latency_jitter_s": 0.1},
            ["jitter_s = 0.1 s", "1.2 s", "72.0 frames"],
        ),
        (
            {"timing.latency_s": 0.01, "timing.latency_jitter_s": 0.02},
            ["latency_jitter 0.02 s", "latency 0.01 s"],
        ),
        ({"timing.exposure_s": 0.02}, ["exposure 0.02 s", "60 Hz"]),
        ({"timing.hold": "cubic"}, ["cubic", "zero", "linear"]),
        ({"excitation.harmonics": 1}, ["excitation.harmonics = 1 [1]", "2"]),
        ({"validation.duration_s": 5.01}, ["300.6 frames", "60 Hz"]),
        ({"filter.cutoff_hz": 30.0}, ["30 Hz", "60 Hz", "Nyquist"]),
        ({"filter.cutoff_hz": 0.4}, ["highest harmonic is 0.5 Hz"]),
        (
            {"filter.cutoff_hz": 0.4, "timing.frame_rate_hz": 0.9},
            ["frame_rate_hz = 0.9 Hz is not above twice the"],
        ),
        (
            {"filter.cutoff_hz": 60.0, "timing.frame_rate_hz": 120.0},
            ["Nyquist"],
        ),  # the paper's, at twice its rate
        (
            {PRIOR: {"foo": {"value": 1.0, "std": 0.1}}},
            ["no parameter 'foo'", "or viscous of joint1 to joint6"],
        ),
        (
            {PRIOR: {"platform": {"mass": {"value": 1.0, "std": 0.1}}}},
            ["'platform'", '{"platform.…" = {value'],
        ),
        (
            {PRIOR: {"platform.mass": {"value": 1.0}}},
            ["identification.prior.platform.mass.std is missing"],
        ),
        ({PRIOR: {"platform.mass": {"value": 1.0, "std": 0.0}}}, ["prior.platform.mass.std = 0.0"]),
        (
            {PRIOR: {"platform.mass": {"value": 1.0, "std": 0.1, "a": 1}}},
            ["mass.a'", "platform.mass]: value, std"],
        ),
        (
            PAYLOAD,
            ["anchor_std = 0.1: the anchor payload measures no parameter", "payload.mass_std_kg"],
        ),
        (
            {"payload.Ixx_kg_m2": 100.0},
            ["payload: Ixx_kg_m2 100 > Iyy_kg_m2 0.02 + Izz_kg_m2 0.04 by 1e+02 kg m2"],
        ),
        ({"payload.mass_std_kg": 9.0}, ["payload: mass_std_kg = 9 kg exceeds mass_kg = 8 kg"]),
        ({"plant.friction": "smoothed"}, ["smoothing_velocity_rad_s"]),
        (
            {"plant.geometry_error_m": 2e-3},
            ["plant.geometry_error_m = 0.002 [m]: input should be less than or equal"],
        ),
        (
            {"timing.latency_s": -1.0, "servo.kq": 1.0},
            ["timing.latency_s = -1.0 [s]", "servo.kq"],
        ),  # all at once
        ({"sensor_changes.camera.drk_noise": 1.0}, ["camera.drk_noise", "dark_noise"]),
        ({"sensor_changes.camera": 1.0}, ["camera = 1.0 is a section", "dark_noise"]),
        (
            {"sensor_changes.based_on": "ctrack780_29hz"},
            ["based_on", "ctrack780_29hz", "another sensor"],
        ),
    ],
)
def test_what_no_scenario_may_be_is_refused_by_name_in_one_line(overrides, evidence):
    message = refused(overrides)
    assert all(part in message for part in evidence), message


def test_what_lies_just_inside_the_limits_is_taken():
    flat = {"payload.Ixx_kg_m2": 0.1, "payload.Iyy_kg_m2": 0.2, "payload.Izz_kg_m2": 0.1 + 0.2}
    smoothed = {"model.friction": "smoothed", "model.smoothing_velocity_rad_s": 0.001}
    paper = load_scenario("paper")
    for overrides in (flat, smoothed, {"filter.cutoff_hz": 29.9}):
        assert paper.with_overrides(overrides) != paper
    assert (
        paper.with_overrides(
            {"filter.cutoff_hz": 60.0, "timing.frame_rate_hz": 125.0}
        ).filter.cutoff_hz
        == 60.0
    )
    known = {name: {"value": 1.0, "std": 0.1} for name in NAMES}
    assert len(paper.with_overrides({PRIOR: known}).identification.prior) == 67


def test_every_number_has_a_unit():
    for section in (
        f.annotation
        for f in Scenario.model_fields.values()
        if hasattr(f.annotation, "model_fields")
    ):
        for name, entry in section.model_fields.items():
            if entry.annotation in (int, float, float | None) and name != "count":
                assert entry.json_schema_extra["unit"], f"{section.__name__}.{name}"


def test_the_anchor_without_a_stated_deviation_has_that_of_an_ordinary_instrument():
    said = Identification.model_fields["anchor_std"].description
    assert all(f"{std:g} {unit}" in said for unit, std in DEFAULT_STD.items())


def test_every_comment_of_a_listing_can_be_read_alone():
    """A reader who looks for one key does not read the comment of the key before."""
    lines = [line for line in load_scenario("paper").to_toml().splitlines() if " # " in line]
    assert len(lines) > 60
    referring = ("the same for", "the same of", "of that", "side of that")
    assert [one for one in lines if any(words in one for words in referring)] == []
    assert any(one.startswith("pose_method") for one in lines)


@pytest.mark.parametrize(
    ("section", "key", "name"),
    [("timing", "frame_rate_hz", "Timing"), ("plant", "geometry_error_m", "Plant")],
)
def test_the_largest_value_of_the_schema_is_taken_and_a_larger_one_is_refused(section, key, name):
    """The limit of the field holds, which is narrower than the range of its unit."""
    most = scenario_schema()["$defs"][name]["properties"][key]["maximum"]
    load_scenario("quick").with_overrides({f"{section}.{key}": float(most)})
    with pytest.raises(ScenarioError, match=f"{section}.{key}"):
        load_scenario("quick").with_overrides({f"{section}.{key}": 1.001 * most})


CHANGES = {"camera.dark_noise": 52.0, "lens.psf_px": 0.6, "rig.baseline": 0.8}


def test_changed_sensor_is_that_of_a_file_with_the_same_entries_in_the_loop_and_for_the_excitation(
    tmp_path,
):
    """Baseline and noise decide what a pose is worth; the loop's sensor must be the changed one."""
    mine = tmp_path / "mine.toml"
    mine.write_text(
        'name = "ctrack780"\nbased_on = "ctrack780"\n[camera]\ndark_noise = 52.0\n[lens]\npsf_px '
        "= 0.6\n"
        "[rig]\nbaseline = 0.8\n"
    )
    expected = read_sensor_file(mine).model_copy(update={"based_on": None})
    nested = {"camera": {"dark_noise": 52.0}, "lens": {"psf_px": 0.6}, "rig": {"baseline": 0.8}}
    assert (
        read_sensor_file("ctrack780", CHANGES) == read_sensor_file("ctrack780", nested) == expected
    )
    assert read_sensor_file("ctrack780") == read_sensor_file("ctrack780", {})
    changed = load_scenario("paper").with_overrides(
        {f"sensor_changes.{key}": CHANGES[key] for key in CHANGES}
    )
    sensor = Setup(changed).sensor_plan.make(load_robot("rss6"), seed=0)
    assert (sensor.noise.dark_noise, sensor.optics.psf_px) == (52.0, 0.6)
    for rig in (sensor.rig, sight_lines("ctrack780", changed.sensor_changes).rig):
        assert np.linalg.norm(rig.from_camera[1][:3, 3]) == pytest.approx(0.8)


def test_resolved_scenario_with_changes_reads_back_equal_and_its_timing_follows_them():
    more = {
        "timing.frame_rate": 125.0,
        "camera.noise": False,
        "platform.planes.A.stickers": [[0, 1], [1, 0], [0.1, 1]],
    }
    paper = load_scenario("paper")
    changed = paper.with_overrides(
        {f"sensor_changes.{key}": value for key, value in (CHANGES | more).items()}
    )
    assert scenario_from_toml(changed.to_toml()) == changed
    assert (
        changed.with_overrides({f"sensor_changes.{key}": None for key in changed.sensor_changes})
        == paper
    )
    assert changed.timing.frame_rate_hz == 125.0
    with pytest.raises(
        ScenarioError, match=r"frame_rate = 125 has no effect .* timing.frame_rate_hz = 60"
    ):
        changed.with_overrides({"timing.frame_rate_hz": 60.0})


def test_the_renderer_of_a_sensor_file_is_used_unless_the_scenario_states_another(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('name = "mine"\nbased_on = "ctrack780"\nrenderer = "analytic"\n')
    scenario = load_scenario("quick", sensor=str(mine))
    assert scenario.renderer == Setup(scenario).sensor_plan.renderer == "analytic"
    assert scenario.with_overrides({"renderer": "statistical"}).renderer == "statistical"
    assert scenario.with_overrides({"sensor": "ctrack780"}).renderer == "auto"
    assert scenario_from_toml(scenario.to_toml()) == scenario


DRIVEN = {"identification.method": "command_driven"}


@pytest.mark.slow
def test_a_setting_acts_and_is_kept_for_the_next_stages_and_the_reader(recorded_folder):
    pipeline.identify(recorded_folder.path, SilentProgress(), DRIVEN)
    kept, result = load_scenario(recorded_folder.scenario), load_result(recorded_folder.result)
    assert kept == SHORT.with_overrides(DRIVEN)
    assert result["settings"]["identification.method"] == "command_driven"
    expected = identify(read(recorded_folder.experiment), rss6(), SHORT.with_overrides(DRIVEN))
    np.testing.assert_array_equal(
        parameter_vector(rss6(), result["identification"], "estimate"), expected.estimate
    )
    assert result["identification"]["searches"] == ["command_driven"]
    _, changed = changed_settings(
        read(recorded_folder.experiment).attrs["scenario"], result["settings"]
    )
    method = next(one for one in changed if one.key == "identification.method")
    assert (method.value, method.built_in) == ("command_driven", "closed_loop")
    assert method.meaning.endswith("when the record was made: closed_loop")
    pipeline.identify(recorded_folder.path, SilentProgress())
    assert load_result(recorded_folder.result)["identification"]["searches"] == ["command_driven"]


@pytest.mark.slow
def test_without_settings_the_scenario_is_left_as_it_is_and_by_an_identification_that_fails_the_result_too(
    recorded_folder,
):
    mine = "# mine\n" + SHORT.to_toml()
    recorded_folder.scenario.write_text(mine, encoding="utf-8")
    with pytest.raises(
        ScenarioError, match="robot rss6 has no parameter set 'nobody'; it has guess"
    ):
        pipeline.identify(
            recorded_folder.path, SilentProgress(), {"model.start_parameters": "nobody"}
        )
    assert not recorded_folder.result.exists()
    pipeline.identify(recorded_folder.path, SilentProgress())
    assert recorded_folder.scenario.read_text(encoding="utf-8") == mine
    result = load_result(recorded_folder.result)
    assert result["settings"] == SHORT.estimator_settings()
    assert changed_settings(SHORT.to_toml(), result["settings"]) == changed_settings(
        SHORT.to_toml()
    )


def test_what_the_record_was_made_with_is_refused_in_one_line_and_every_setting_of_the_sections_is_listed(
    recorded_folder, capfd
):
    for setting in ({"timing.latency_s": 0.01}, {"sensor": "ctrack780"}, {"identification": {}}):
        with pytest.raises(
            ScenarioError, match=f"'{next(iter(setting))}' cannot be set for an identification"
        ):
            SHORT.with_estimator_settings(setting)
    with pytest.raises(
        ScenarioError, match=r"valid names in \[identification\]: method, scale_anchor"
    ):
        SHORT.with_estimator_settings({"identification.methode": "closed_loop"})
    assert (
        command(
            "identify", "--out", recorded_folder.path, "--set", "identification.scale_anchor=prior"
        )
        == 1
    )
    said = one_line(capfd.readouterr().err)
    assert "'identification.scale_anchor' cannot be set for an identification" in said
    assert (
        "allowed: identification.*, model.*, filter.*, except identification.scale_anchor and"
        in said
    )
    assert not recorded_folder.result.exists()
    listed = {key.partition(".")[0] for key in SHORT.estimator_settings()}
    assert listed == set(ESTIMATOR_SECTIONS) < set(Scenario.model_fields)


def test_a_setting_is_named_as_set_anew_also_where_the_built_in_scenario_has_its_value():
    recorded = SHORT.with_overrides(DRIVEN).to_toml()
    settings = SHORT.with_overrides(DRIVEN).estimator_settings()
    assert settings_set_anew(recorded, settings) == []
    settings |= {"identification.method": "closed_loop"}
    ((key, value, meaning),) = settings_set_anew(recorded, settings)
    assert (key, value) == ("identification.method", "closed_loop")
    assert meaning.endswith("when the record was made: command_driven")


def test_the_report_says_what_differs_from_the_built_in_scenario_and_what_was_set_anew(run_folder):
    """Beside it everything is folded: the times, the versions, and the scenario as a whole."""
    assert changed_settings(load_scenario("quick").to_toml()) == ("quick", [])
    mine = load_scenario("quick").with_overrides({"name": "mine", "timing.latency_s": 0.01})
    base, changed = changed_settings(mine.to_toml())
    assert base == "paper"
    assert ("timing.latency_s", "0.01", "0.0") in [one[:3] for one in changed]
    data = read_run(run_folder)
    data.result["settings"] = {
        "model.steps_per_frame": 9,
        "filter.order": 8,
        "identification.anchor_std": 0.1,
    }
    section = provenance_section(data)
    rows = {row[0]: row for row in section.tables[0].rows}
    assert section.tables[0].title == "What differs from the scenario quick"
    assert rows["model.steps_per_frame"][1:3] == ("9", "4")
    assert rows["model.steps_per_frame"][3].endswith("when the record was made: 4")
    assert rows["identification.anchor_std"][1:3] == ("0.1", "-")
    assert "filter.order" not in rows
    assert [table.folded for table in section.tables] == [False, True, True]
    assert section.folds[0].text == data.scenario_toml
