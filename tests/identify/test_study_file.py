"""Study files: what they say, and what is refused before anything is computed."""

import numpy as np
import pytest
from pydantic import ValidationError

from identify.errors import StudyError
from identify.studies.design import Design, prepare, valid_keys
from identify.studies.runner import compute
from identify.studies.study_file import STUDIES, Law, Study, load_study
from identify.studies.table import SENSOR_UNITS
from tests.identify.study_rows import KIND

FACTORS = {"sensor.camera.dark_noise": [13.0, 26.0], "scenario.pose_method": ["registration", "planes"]}


def study(**entries):
    return Study(**{"name": "mine", "kind": KIND, "factors": FACTORS} | entries)


def refusal(action, *arguments, **entries):
    with pytest.raises(StudyError) as caught:
        action(*arguments, **entries)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def toml(lines="", kind=KIND, factors="sensor.camera.dark_noise = [13.0, 26.0]"):
    return f'name = "mine"\nkind = "{kind}"\n{lines}\n[factors]\n{factors}\n'


def cases(chosen):
    design = Design(chosen)
    return [design.case(number) for number in range(len(design))]


def test_factors_may_be_written_as_dotted_keys_tables_or_quoted_paths():
    written = [
        "sensor.camera.dark_noise = [13.0, 26.0]",
        "[factors.sensor.camera]\ndark_noise = [13.0, 26.0]",
        '"sensor.camera.dark_noise" = [13.0, 26.0]',
    ]
    assert len({STUDIES.from_toml(toml(factors=text), "study").model_dump_json() for text in written}) == 1


def test_a_grid_has_every_combination_once_a_repeat_the_last_factor_fastest():
    rows = cases(study(repeats=2))
    assert [row.number for row in rows] == list(range(8))
    assert [tuple(row.factors.values()) for row in rows[:4]] == [
        (13.0, "registration"),
        (13.0, "planes"),
        (26.0, "registration"),
        (26.0, "planes"),
    ]
    assert [row.repeat for row in rows] == [0] * 4 + [1] * 4
    assert [row.factors for row in rows[:4]] == [row.factors for row in rows[4:]]


def test_seeds_are_the_children_that_numpy_spawns_in_row_order():
    setup = prepare(study(seed=5))
    for number, child in enumerate(np.random.SeedSequence(5).spawn(8)):
        assert np.array_equal(setup.row_seed(number).generate_state(4), child.generate_state(4))


def test_more_repeats_change_no_row_that_is_there_already():
    few, many = cases(study(repeats=2)), cases(study(repeats=5))
    assert many[: len(few)] == few


def test_changes_hold_in_every_row_and_factors_in_their_own():
    setup = prepare(study(changes={"sensor.rig.baseline": 0.8, "scenario.filter.order": 4}, options={"seconds": 0.0}))
    for case in cases(study()):
        scenario = setup.row_scenario(case)
        assert scenario.sensor_changes == {
            "rig.baseline": 0.8,
            "camera.dark_noise": case.factors["sensor.camera.dark_noise"],
        }
        assert (scenario.filter.order, scenario.pose_method) == (4, case.factors["scenario.pose_method"])


def test_options_may_be_factors():
    chosen = study(factors={"options.seconds": [0.0, 1.0]}, options={"odd": 7})
    setup = prepare(chosen)
    options = [setup.row_options(case) for case in cases(chosen)]
    assert options == [{"odd": 7, "seconds": 0.0}, {"odd": 7, "seconds": 1.0}]


def test_a_sample_is_spread_as_its_factors_say():
    """Against the distributions' own quantiles; 2,000 points put a share within 0.05 at better than 1e-4."""
    factors = {
        "sensor.rig.baseline": {"low": 0.5, "high": 2.0},
        "sensor.camera.dark_noise": {"low": 1.0, "high": 100.0, "scale": "log"},
        "scenario.filter.order": {"low": 2, "high": 5},
        "scenario.pose_method": ["registration", "planes"],
    }
    chosen = study(factors=factors, sample=2000)
    prepare(chosen)
    drawn = [tuple(case.factors.values()) for case in cases(chosen)]
    baseline, dark, order, method = (np.array(column) for column in zip(*drawn, strict=True))
    assert ((baseline >= 0.5) & (baseline < 2.0)).all()
    assert np.mean(baseline < 1.25) == pytest.approx(0.5, abs=0.05)
    assert np.mean(dark < 10.0) == pytest.approx(0.5, abs=0.05)
    assert {*order.tolist()} == {2, 3, 4, 5}
    assert [np.mean(order == k) for k in (2, 3, 4, 5)] == pytest.approx([0.25] * 4, abs=0.05)
    assert np.mean(method == "planes") == pytest.approx(0.5, abs=0.05)
    assert np.corrcoef(baseline, dark)[0, 1] == pytest.approx(0.0, abs=0.1)
    assert cases(study(factors=factors, sample=50)) == cases(chosen)[:50]


def test_every_key_of_a_sensor_has_its_unit_or_needs_none():
    """So that a new key is not drawn without its unit, and no unit stands for a key that is gone."""
    without = {"timing.dropout", "camera.noise", "camera.prnu", "camera.pattern_seed", "lens.vignetting"}
    without |= {"stickers.placement_seed", "stickers.per_plane", "rig.left.distortion", "rig.right.distortion"}
    without |= {f"stickers.{what}_level" for what in ("sticker", "ring", "body", "obstacle", "background")}
    sections = ("timing", "rig", "camera", "lens", "stickers")
    keys = {path.removeprefix("sensor.") for path in valid_keys(None) if path.startswith("sensor.")}
    assert {key for key in keys if key.partition(".")[0] in sections} == {*SENSOR_UNITS} | without
    assert all(SENSOR_UNITS[key] == "px" for key in SENSOR_UNITS if key.endswith("_px"))


@pytest.mark.parametrize(
    ("text", "evidence"),
    [
        (toml("repeats = 0"), ["repeats = 0"]),
        (toml("reapeats = 2"), ["unknown key 'reapeats'", "repeats"]),
        (toml(factors="sensor.camera.dark_noise = []"), ["sensor.camera.dark_noise", "no values"]),
        (toml(factors="sensor.camera.dark_noise = { low = 1.0, high = 2.0 }"), ["dark_noise", "sample = N"]),
        (toml("sample = 5", factors="sensor.camera.dark_noise = { low = 2.0, high = 1.0 }"), ["low = 2", "high = 1"]),
        (toml("sample = 5", factors='sensor.camera.prnu = { low = 0.0, high = 1.0, scale = "log" }'), ["positive"]),
        (toml("[changes]\nsensor.camera.dark_noise = 1.0"), ["sensor.camera.dark_noise", "both"]),
        (toml(factors="sensor.rig.baseline = 1.0"), ["sensor.rig.baseline = 1.0 is no list", "[changes]"]),
        (toml(factors="sensor.rig.baseline = {}"), ["sensor.rig.baseline", "low is missing"]),
        (toml("sample = 5", factors="sensor.rig.baseline = { low = 1.0, high = inf }"), ["high = inf", "finite"]),
        (toml("sample = 5", factors="sensor.rig.baseline = { low = true, high = 2 }"), ["low = True", "valid number"]),
        (toml("sample = 5", factors="sensor.rig.baseline = { low = 1.0, hgh = 2.0 }"), ["'hgh'", "low, high, scale"]),
        ("name = 1 = 2", ["not valid TOML"]),
    ],
)
def test_study_files_that_contradict_themselves_are_refused(text, evidence):
    message = refusal(STUDIES.from_toml, text, "study")
    assert all(word in message for word in evidence), message
    assert not any(word in message for word in ("function-", "list[", "Range", "valid list"))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"factor": "x"}, "states one of exponent, equals and order, got none"),
        ({"factor": "x", "exponent": 1.0, "equals": "other"}, "got exponent, equals"),
        ({"exponent": 1.0}, "needs a factor"),
        ({"equals": "other", "factor": "x"}, "has no factor"),
        ({"factor": "x", "order": ["one"]}, "two values"),
    ],
)
def test_law_states_one_thing(fields, message):
    with pytest.raises(ValidationError, match=message):
        Law(figure="figure_um", **fields)


@pytest.mark.parametrize(
    ("entries", "evidence"),
    [
        ({"factors": {"sensor.camera.drk_noise": [1.0]}}, ["sensor.camera.drk_noise", "sensor.camera.dark_noise"]),
        ({"factors": {"camera.dark_noise": [1.0]}}, ["camera.dark_noise", "nearest", "sensor.camera.dark_noise"]),
        ({"factors": {"scenario.timing.frame_rate": [1.0]}}, ["scenario.timing.frame_rate_hz"]),
        ({"factors": {"sensor.camera.dark_noise": [1.0, "much"]}}, ["sensor.camera.dark_noise = 'much'", "number"]),
        ({"factors": {"sensor.camera.dark_noise": [True]}}, ["sensor.camera.dark_noise = True"]),
        ({"factors": {"sensor.camera.bit_depth": [9]}}, ["sensor.camera.bit_depth = 9", "8, 10 or 12"]),
        ({"factors": {"scenario.filter.order": {"low": 2.5, "high": 4}}, "sample": 2}, ["order = 2.5", "integer"]),
        ({"factors": {"sensor.camera": [1.0]}}, ["unknown key 'sensor.camera'"]),
        ({"factors": {"scenario.sensor_changes": [1.0]}}, ["unknown key 'scenario.sensor_changes'"]),
        ({"factors": {"sensor.camera.dark_noise": [1.0, 2.0, 1.0]}}, ["a value twice", "repeats"]),
        ({"factors": {"options.mixed": [1, 2.5, "two"]}}, ["options.mixed", "several kinds: number, str"]),
        ({"changes": {"sensor.lens.psf": 1.0}}, ["sensor.lens.psf", "sensor.lens.psf_px"]),
        ({"changes": {"options.odd": 1.0}}, ["changes.options.odd", "[options]"]),
        ({"changes": {"scenario.filter.cutoff_hz": 40.0}}, ["filter.cutoff_hz = 40", "Nyquist"]),
        ({"options": {"odd": 2}, "factors": {"options.odd": [1, 4]}}, ["options.odd is both a factor and among the"]),
        ({"scenario": "papper"}, ["papper", "paper", "quick"]),
        ({"kind": "static_poses"}, ["static_poses", "static_pose", "path_pose", "module:function"]),
        ({"kind": "tests.identify.study_rows:rou"}, ["study_rows", "rou"]),
        ({"kind": "no_such_module:row"}, ["no_such_module", "PYTHONPATH"]),
        ({"kind": "static_pose", "options": {"capturs": 4}}, ["unknown key 'capturs'; valid names: poses, captures"]),
        ({"kind": "static_pose", "options": {"captures": 0}}, ["options of static_pose: captures = 0"]),
        ({"kind": "static_pose", "factors": {"options.captures": ["many"]}}, ["options.captures = 'many'"]),
        ({"kind": "path_pose", "factors": {"options.zz": [4]}}, ["'options.zz'", "stretch_s, options.teaching"]),
        ({"kind": f"{__name__}:wrong_row"}, ["wrong_row' takes (scenario);", "(scenario, seed) or (scenario, seed, "]),
        ({"kind": f"{__name__}:plain_row", "options": {"odd": 1}}, ["plain_row' takes no options, got odd"]),
        ({"kind": f"{__name__}:plain_row", "factors": {"options.odd": [1]}}, ["plain_row' takes no options, got odd"]),
    ],
)
def test_kinds_keys_and_values_are_checked_before_any_row(entries, evidence):
    message = refusal(prepare, study(**entries))
    assert all(word in message for word in evidence), message


def plain_row(scenario, seed):
    """A row of a study without options."""
    return {"rate_hz": scenario.timing.frame_rate_hz, "draw": float(np.random.default_rng(seed).normal())}


def wrong_row(scenario):
    """No row: it takes no seed."""


def test_a_function_of_ones_own_needs_no_options_where_the_study_has_none():
    chosen = study(kind=f"{__name__}:plain_row")
    figures = compute(prepare(chosen), cases(chosen)[:1])[0].figures
    draw = np.random.default_rng(np.random.SeedSequence(0).spawn(1)[0]).normal()
    assert figures == {"rate_hz": 60.0, "draw": draw}


LAW = {"figure": "position_rms_um", "factor": "sensor.camera.dark_noise", "exponent": 1.0}


@pytest.mark.parametrize(
    ("law", "evidence"),
    [
        ({"figure": "posishun_rms_um"}, ["figure = 'posishun_rms_um'", "static_pose", "position_rms_um"]),
        ({"per": "sight"}, ["per = 'sight'", "sight_m"]),
        ({"factor": None, "exponent": None, "equals": "stated_position_um"}, ["equals", "stated_position_rms_um"]),
        ({"factor": "sensor.camera.dsnu"}, ["factor = 'sensor.camera.dsnu'", "sensor.camera.dark_noise"]),
        ({"factor": "pixel_noise"}, ["factor = 'pixel_noise'", "pixel_noise_grey"]),
        ({"exponent": None, "order": [26.0, 14.0]}, ["order has 14.0", "[13.0, 26.0]"]),
    ],
)
def test_laws_of_what_a_kind_does_not_measure_or_a_study_does_not_vary_are_refused_before_any_row(law, evidence):
    right = Law(**LAW)
    prepare(study(kind="static_pose", theory=[right, Law(**LAW | {"factor": "pixel_noise_grey"})]))
    message = refusal(prepare, study(kind="static_pose", theory=[right, Law(**LAW | law)]))
    assert all(word in message for word in ["[[theory]] 2", *evidence]), message


def test_figures_of_a_kind_of_ones_own_are_not_known_before_its_rows_but_its_factors_are():
    prepare(study(theory=[Law(**LAW | {"figure": "any_um"}), Law(**LAW | {"factor": "any_m"})]))
    message = refusal(prepare, study(theory=[Law(**LAW | {"factor": "sensor.camera.drk_noise"})]))
    assert "the nearest are sensor.camera.dark_noise" in message


def test_unknown_study_lists_the_built_in_ones():
    assert "'pixel_nois'" in refusal(load_study, "pixel_nois")
    assert "pixel_noise" in refusal(load_study, "pixel_nois")


def test_paths_in_a_study_file_start_from_the_file_and_built_in_names_win(tmp_path, monkeypatch):
    """As those in a scenario do, also where they are varied, whichever way the keys are written."""
    (tmp_path / "scenarios").mkdir()
    own, sensor = tmp_path / "scenarios" / "paper.toml", tmp_path / "scenarios" / "eye.toml"
    for path in (own, sensor):
        path.write_text("")
    scenario = 'scenario = "{}"\n[changes]\nscenario.robot = "mine.toml"'
    factors = '"scenario.sensor" = ["ctrack780", "eye.toml", "nowhere"]'
    for name, found in (("paper.toml", str(own)), ("paper", "paper"), ("nowhere", "nowhere")):
        file = own.with_name("study.toml")
        file.write_text(toml(scenario.format(name), factors=factors))
        monkeypatch.chdir(tmp_path)
        chosen = load_study("scenarios/study.toml")
        assert chosen.scenario == found
        assert chosen.changes == {"scenario.robot": str(own.with_name("mine.toml"))}
        assert chosen.factors == {"scenario.sensor": ["ctrack780", str(sensor), "nowhere"]}


def test_rows_of_a_huge_grid_are_counted_without_making_them():
    huge = study(factors={f"sensor.camera.{name}": [*range(1, 101)] for name in ("dsnu", "dark_noise")}, repeats=10**9)
    assert huge.rows == 10**13
    last = Design(huge).case(huge.rows - 1)
    assert last.factors == {"sensor.camera.dsnu": 100, "sensor.camera.dark_noise": 100}
    assert last.repeat == 10**9 - 1
