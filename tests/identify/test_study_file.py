"""Study files: what they say, what their rows read, and what is refused before anything is
computed.
"""

from functools import reduce
from itertools import product
from typing import get_args

import numpy as np
import pytest

from cmmsim.files.sensor_file import read_sensor_file
from identify.errors import IdentifyError, ScenarioError, StudyError
from identify.own_parts import CRITERIA
from identify.scenario import load_scenario
from identify.studies.labels import factor_unit
from identify.studies.rows import find_kind
from identify.studies.runner import compute
from identify.studies.study_design import Design, overrides, prepare, valid_keys
from identify.studies.study_file import STUDIES, Law, load_study
from tests.identify.commands import refusal
from tests.identify.study_rows import DARK, KIND, METHOD, small_study

FACTORS = {DARK: [13.0, 26.0], METHOD: ["registration", "planes"]}


def study(**entries):
    return small_study(**{"factors": FACTORS, "repeats": 1, "seed": 0} | entries)


def toml(lines="", kind=KIND, factors="sensor.camera.dark_noise = [13.0, 26.0]"):
    return f'name = "mine"\nkind = "{kind}"\n{lines}\n[factors]\n{factors}\n'


def cases(chosen):
    design = Design(chosen)
    return [design.case(number) for number in range(len(design))]


def test_a_grid_has_every_combination_once_a_repeat_the_last_factor_fastest_and_none_is_made_before_its_turn():
    rows = cases(study(repeats=2))
    assert [row.number for row in rows] == list(range(8))
    assert [tuple(row.factors.values()) for row in rows[:4]] == [*product(*FACTORS.values())]
    assert [row.repeat for row in rows] == [0] * 4 + [1] * 4
    assert [row.factors for row in rows[:4]] == [row.factors for row in rows[4:]]
    assert cases(study(repeats=5))[:8] == rows
    huge = study(
        factors={f"sensor.camera.{name}": [*range(1, 101)] for name in ("dsnu", "dark_noise")},
        repeats=10**9,
    )
    assert huge.rows == 10**13
    last = Design(huge).case(huge.rows - 1)
    assert (last.repeat, last.factors) == (10**9 - 1, {"sensor.camera.dsnu": 100, DARK: 100})


def test_changes_and_options_hold_in_every_row_and_factors_in_their_own():
    more = {"factors": FACTORS | {"options.seconds": [0.0, 1.0]}, "options": {"odd": 7}}
    chosen = study(changes={"sensor.rig.baseline": 0.8, "scenario.filter.order": 4}, **more)
    setup = prepare(chosen)
    for case in cases(chosen):
        scenario = setup.row_scenario(case)
        assert scenario.sensor_changes == {
            "rig.baseline": 0.8,
            "camera.dark_noise": case.factors[DARK],
        }
        assert (scenario.filter.order, scenario.pose_method) == (4, case.factors[METHOD])
        assert setup.row_options(case) == {"odd": 7, "seconds": case.factors["options.seconds"]}


def test_a_sample_is_spread_as_its_factors_say():
    """Against the distributions' own quantiles; 500 points put a share within 0.1 at better than
    1e-4.
    """
    factors = {
        "sensor.rig.baseline": {"low": 0.5, "high": 2.0},
        DARK: {"low": 1.0, "high": 100.0, "scale": "log"},
        "scenario.filter.order": {"low": 2, "high": 5},
        METHOD: ["registration", "planes"],
    }
    chosen = study(factors=factors, sample=500)
    prepare(chosen)
    columns = zip(*(case.factors.values() for case in cases(chosen)), strict=True)
    baseline, dark, order, method = map(np.array, columns)
    assert ((baseline >= 0.5) & (baseline < 2.0)).all()
    assert np.mean(baseline < 1.25) == pytest.approx(0.5, abs=0.1)
    assert np.mean(dark < 10.0) == pytest.approx(0.5, abs=0.1)
    assert {*order.tolist()} == {2, 3, 4, 5}
    assert [np.mean(order == k) for k in (2, 3, 4, 5)] == pytest.approx([0.25] * 4, abs=0.1)
    assert np.mean(method == "planes") == pytest.approx(0.5, abs=0.1)
    assert np.corrcoef(baseline, dark)[0, 1] == pytest.approx(0.0, abs=0.2)
    assert cases(study(factors=factors, sample=50)) == cases(chosen)[:50]


def test_every_key_of_a_sensor_has_its_unit_or_needs_none():
    """So that a new key is not drawn without its unit, nor without words."""
    without = {
        "timing.dropout",
        "camera.noise",
        "camera.prnu",
        "camera.pattern_seed",
        "lens.vignetting",
    }
    without |= {
        "stickers.placement_seed",
        "stickers.per_plane",
        "rig.left.distortion",
        "rig.right.distortion",
        "rig.covariance.matrix",
    }
    without |= {
        f"stickers.{what}_level" for what in ("sticker", "ring", "body", "obstacle", "background")
    }
    without |= {"lens.ghost", "lens.known", "light.ambient", "light.fall_off"}
    without |= {"light.lamps.direction", "light.lamps.strength"}
    without |= {f"light.clutter{what}" for what in ("", "_level", "_seed")}
    without |= {f"print.{what}" for what in ("rim_level", "unevenness", "seed", "known")}
    sections = ("timing", "rig", "camera", "lens", "light", "print", "stickers")
    fields = {path: field for path, field in valid_keys(None).items() if path.startswith("sensor.")}
    keys = {path.removeprefix("sensor.") for path in fields}
    units = {key: factor_unit(f"sensor.{key}") for key in keys if key.partition(".")[0] in sections}
    assert {key for key, unit in units.items() if not unit} == without
    assert all(unit == "px" for key, unit in units.items() if key.endswith("_px"))
    assert all(fields[f"sensor.{key}"].description for key in units)


@pytest.mark.parametrize(
    ("text", "evidence"),
    [
        (toml("repeats = 0"), ["repeats = 0"]),
        (toml("reapeats = 2"), ["unknown key 'reapeats'", "repeats"]),
        (
            toml(factors="sensor.camera.dark_noise = { low = 1.0, high = 2.0 }"),
            ["dark_noise", "sample = N"],
        ),
        (
            toml("sample = 5", factors="sensor.camera.dark_noise = { low = 2.0, high = 1.0 }"),
            ["low = 2", "high = 1"],
        ),
        (
            toml(
                "sample = 5",
                factors='sensor.camera.prnu = { low = 0.0, high = 1.0, scale = "log" }',
            ),
            ["positive"],
        ),
        (toml("[changes]\nsensor.camera.dark_noise = 1.0"), ["sensor.camera.dark_noise", "both"]),
        (
            toml(factors="sensor.rig.baseline = 1.0"),
            ["sensor.rig.baseline = 1.0 is not a list", "[changes]"],
        ),
        (toml(factors="sensor.rig.baseline = []"), ["sensor.rig.baseline", "no values"]),
        (
            toml("sample = 5", factors="sensor.rig.baseline = { low = true, high = inf }"),
            ["low = True", "high = inf"],
        ),
        (
            toml("sample = 5", factors="sensor.rig.baseline = { low = 1.0, hgh = 2.0 }"),
            ["'hgh'", "low, high, scale"],
        ),
        (
            toml('[[theory]]\nfigure = "x_um"\nfactor = "x"'),
            ["one of exponent, equals and order, got none"],
        ),
        (toml('[[theory]]\nfigure = "x_um"\nexponent = 1.0'), ["needs a factor"]),
        (toml('[[theory]]\nfigure = "x_um"\nequals = "y_um"\nfactor = "x"'), ["has no factor"]),
        (toml('[[theory]]\nfigure = "x_um"\nfactor = "x"\norder = ["one"]'), ["two values"]),
        ("name = 1 = 2", ["not valid TOML"]),
    ],
)
def test_study_files_that_contradict_themselves_are_refused(text, evidence):
    message = refusal(StudyError, STUDIES.from_toml, text, "study")
    assert all(word in message for word in evidence), message
    assert not any(word in message for word in ("function-", "list[", "Range", "valid list"))


@pytest.mark.parametrize(
    ("entries", "evidence"),
    [
        (
            {"factors": {"sensor.camera.drk_noise": [1.0]}},
            ["sensor.camera.drk_noise", "sensor.camera.dark_noise"],
        ),
        (
            {"factors": {"camera.dark_noise": [1.0]}},
            ["camera.dark_noise", "nearest", "sensor.camera.dark_noise"],
        ),
        (
            {"factors": {"sensor.camera.dark_noise": [1.0, "much"]}},
            ["sensor.camera.dark_noise = 'much'", "number"],
        ),
        ({"factors": {"sensor.camera.dark_noise": [True]}}, ["sensor.camera.dark_noise = True"]),
        (
            {"factors": {"scenario.filter.order": {"low": 2.5, "high": 4}}, "sample": 2},
            ["order = 2.5", "integer"],
        ),
        (
            {"factors": {"scenario.sensor_changes": [1.0]}},
            ["unknown key 'scenario.sensor_changes'"],
        ),
        ({"factors": {"sensor.camera.dark_noise": [1.0, 2.0, 1.0]}}, ["a value twice", "repeats"]),
        (
            {"factors": {"options.mixed": [1, 2.5, "two"]}},
            ["options.mixed", "several kinds: number, str"],
        ),
        ({"changes": {"options.odd": 1.0}}, ["changes.options.odd", "[options]"]),
        ({"changes": {"scenario.filter.cutoff_hz": 40.0}}, ["filter.cutoff_hz = 40", "Nyquist"]),
        (
            {"options": {"odd": 2}, "factors": {"options.odd": [1, 4]}},
            ["options.odd is both a factor and among the"],
        ),
        ({"kind": "static_poses"}, ["static_poses", "static_pose", "path_pose", "module:function"]),
        ({"kind": "tests.no_such_module:row"}, ["no_such_module", "PYTHONPATH"]),
        ({"kind": "os:abort"}, ["not allowed to run", "--plugin os "]),
        (
            {"kind": "static_pose", "options": {"capturs": 4}},
            ["unknown key 'capturs'; valid names: poses, captures"],
        ),
        (
            {"kind": "static_pose", "factors": {"options.captures": ["many"]}},
            ["options.captures = 'many'"],
        ),
        (
            {"kind": "path_pose", "factors": {"options.zz": [4]}},
            ["'options.zz'", "stretch_s, options.teaching"],
        ),
        (
            {
                "kind": "static_pose",
                "changes": {"scenario.renderer": "statistical", "sensor.lens.psf_px": 2.0},
            },
            ["first row", "not verified for lens.psf_px 2", "at most 0.8", "analytic or pyrender"],
        ),
        (
            {"kind": f"{__name__}:wrong_row"},
            ["wrong_row' takes (scenario);", "(scenario, seed) or (scenario, seed, "],
        ),
        (
            {"kind": f"{__name__}:plain_row", "options": {"odd": 1}},
            ["plain_row' takes no options, got odd"],
        ),
    ],
)
def test_kinds_keys_and_values_are_checked_before_any_row(entries, evidence):
    message = refusal(StudyError, prepare, study(**entries))
    assert all(word in message for word in evidence), message


def test_dark_noise_is_not_varied_beside_a_percentage():
    chosen = study(changes={"sensor.camera.grey_noise_percent": 1.33})
    message = refusal(ScenarioError, prepare, chosen)
    assert "dark_noise = 13.0 does nothing beside camera.grey_noise_percent = 1.33" in message


def test_factors_may_be_written_as_dotted_keys_tables_or_quoted_paths():
    for text in (
        "[factors.sensor.camera]\ndark_noise = [13.0, 26.0]",
        '"sensor.camera.dark_noise" = [13.0, 26.0]',
    ):
        assert STUDIES.from_toml(toml(factors=text), "study") == STUDIES.from_toml(toml(), "study")


DRIFT = "scenario.rig.drift.right.cx_px"


def test_numbers_by_names_with_dots_are_varied_by_name_or_as_a_table():
    """How far a camera drifts, as a change, a factor, a setting of the command line, or several at
    once.
    """

    def drifts(chosen):
        return [prepare(chosen).row_scenario(case).rig.drift for case in cases(chosen)]

    def written(lines, factors="scenario.servo.ki = [2.4]"):
        return STUDIES.from_toml(toml(lines, factors=factors), "mine")

    drift, none = "scenario.rig.drift", {"scenario.rig.drift": {}}
    table = written(f'[changes]\n{drift} = {{ "right.cx_px" = 0.1, "left.cx_px" = 0.2 }}')
    assert drifts(table) == [{"right.cx_px": 0.1, "left.cx_px": 0.2}]
    assert drifts(table.with_settings({DRIFT: 0.3})) == [{"right.cx_px": 0.3, "left.cx_px": 0.2}]
    assert drifts(table.with_settings({drift: {"right.cx_px": 0.4}})) == [{"right.cx_px": 0.4}]
    assert drifts(table.with_settings(none)) == [{}]
    factor = written("", f'{drift}."right.cx_px" = [0.0, 0.1]')
    assert (
        drifts(factor)
        == [{"right.cx_px": 0.0}, {"right.cx_px": 0.1}]
        == drifts(written("").with_settings({DRIFT: [0.0, 0.1]}))
    )
    assert list(factor.factors) == [DRIFT]
    assert factor_unit(DRIFT) == "px"
    assert drifts(written("", f'{drift} = [{{}}, {{ "right.cx_px" = 0.1 }}]')) == [
        {},
        {"right.cx_px": 0.1},
    ]
    assert "input should be a valid number" in refusal(
        StudyError, prepare, written("", f'{drift}."a.b" = ["x"]')
    )
    assert "do not read it" in refusal(
        StudyError,
        prepare,
        STUDIES.from_toml(toml("", "static_pose", f'{drift}."right.cx_px" = [0.1]'), "mine"),
    )


def plain_row(scenario, seed):
    """A row of a study without options."""
    return {
        "rate_hz": scenario.timing.frame_rate_hz,
        "draw": float(np.random.default_rng(seed).normal()),
    }


def wrong_row(scenario):
    """No row: it takes no seed."""


def test_a_function_of_ones_own_needs_no_options_where_the_study_has_none_and_gets_the_seeds_that_numpy_spawns():
    chosen = study(kind=f"{__name__}:plain_row", seed=5)
    draws = [np.random.default_rng(child).normal() for child in np.random.SeedSequence(5).spawn(4)]
    found = [row.figures for row in compute(prepare(chosen), cases(chosen))]
    assert found == [{"rate_hz": 60.0, "draw": draw} for draw in draws]


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


LAW = {"figure": "position_rms_um", "factor": "sensor.camera.dark_noise", "exponent": 1.0}


@pytest.mark.parametrize(
    ("law", "evidence"),
    [
        (
            {"figure": "posishun_rms_um"},
            ["figure = 'posishun_rms_um'", "static_pose", "position_rms_um"],
        ),
        ({"per": "sight"}, ["per = 'sight'", "sight_m"]),
        (
            {"factor": None, "exponent": None, "equals": "stated_position_um"},
            ["equals", "stated_position_rms_um"],
        ),
        (
            {"factor": "sensor.camera.dsnu"},
            ["factor = 'sensor.camera.dsnu'", "sensor.camera.dark_noise"],
        ),
        ({"factor": "pixel_noise"}, ["factor = 'pixel_noise'", "pixel_noise_grey"]),
        ({"exponent": None, "order": [26.0, 14.0]}, ["order has 14.0", "[13.0, 26.0]"]),
    ],
)
def test_laws_of_what_a_kind_does_not_measure_or_a_study_does_not_vary_are_refused_before_any_row(
    law, evidence
):
    """Figures of a kind of one's own are not known before its rows, but its factors are."""
    right = Law(**LAW)
    one = {"factors": {DARK: FACTORS[DARK]}}
    against = Law(**LAW | {"factor": "pixel_noise_grey"})
    prepare(study(kind="static_pose", theory=[right, against], **one))
    message = refusal(
        StudyError, prepare, study(kind="static_pose", theory=[right, Law(**LAW | law)])
    )
    assert all(word in message for word in ["[[theory]] 2", *evidence]), message
    mine = [Law(**LAW | {"figure": "any_um"}), Law(**LAW | {"factor": "any_m"})]
    prepare(study(theory=mine, **one))
    message = refusal(
        StudyError, prepare, study(theory=[Law(**LAW | {"factor": "sensor.camera.drk_noise"})])
    )
    assert "the nearest are sensor.camera.dark_noise" in message


KP, NOISE = "scenario.servo.kp", "sensor.camera.noise"
ZERO = "scenario.plant.joint_zero_error_rad"
ALONE = {
    "scenario.name", "scenario.description", "scenario.sensor_note", "sensor.name", "sensor.note", "scenario.robot",
    *(f"scenario.{side}.{name}" for side in ("plant", "model") for name in (
        "friction", "smoothing_velocity_rad_s", "smoothing_velocity_m_s", "static_ratio", "stribeck_velocity_rad_s",
        "stribeck_velocity_m_s")),
    "scenario.plant.parameters", "scenario.model.start_parameters",
    "scenario.plant.inertia", "scenario.model.inertia", "scenario.plant.values",
    "scenario.plant.passive_friction", "scenario.model.passive_friction",
    "scenario.rig.known", "scenario.rig.errors", "scenario.rig.drift",
    "scenario.identification.nuisances", "scenario.control.law", "scenario.excitation.law",
    "scenario.plant.drive_gains", "scenario.plant.derivative_filter_s", "scenario.model.derivative_filter_s",
}  # fmt: skip
"""Keys whose other values are names, or stand with others: not tried by `with_others`."""


def sensor_study(**entries):
    return study(**{"kind": "static_pose", "scenario": "quick", "factors": {}} | entries)


def others(value, annotation):
    """Some other values of a key's type, one of which will fit the rest of a scenario."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, (int, float)):
        return [type(value)(other) for other in (1.25 * value, value + 1, 0.8 * value, 0.001)]
    if value is None:
        return [100.0, 1e-5, [-0.9, 0.9]]
    return [other for other in get_args(annotation) or CRITERIA if other != value]


def with_others(scenario, paths):
    """The scenario with another value at each of the paths, and those for which there is none."""
    file, left = read_sensor_file(scenario.sensor, scenario.sensor_changes), set()
    for path in paths:
        root, _, key = path.partition(".")
        now = reduce(getattr, key.split("."), scenario if root == "scenario" else file)
        for value in others(now, valid_keys(None)[path].annotation):
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
        "excitation.duration_s": 3.0,
        "validation.duration_s": 0.5,
        "validation.count": 1,
        "identification.method": "command_driven",
    }
    scenario, reads = load_scenario("quick").with_overrides(given), find_kind(kind).reads
    unread = [path for path in valid_keys(None) if not reads.covers(path) and "prior." not in path]
    other, left = with_others(scenario, unread)
    shared = {"sensor.timing.latency", "sensor.timing.latency_jitter"}  # which the scenario states
    assert left <= ALONE | shared | {"sensor.renderer"}
    chosen = find_kind(kind)
    one, two = (
        chosen.compute(settings, np.random.SeedSequence(3), chosen.checked(options))
        for settings in (scenario, other)
    )
    assert one == two


def test_what_a_held_pose_reads_acts_on_its_rows():
    def row(options, **changes):
        settings = scenario.with_overrides(overrides(changes))
        return kind.compute(settings, np.random.SeedSequence(3), kind.checked(options))

    kind, scenario = (
        find_kind("static_pose"),
        load_scenario("quick").with_overrides({"renderer": "analytic"}),
    )
    one = row({"hold_s": 0.1})
    assert kind.reads.covers("options.hold_s")
    assert row({"hold_s": 0.3}) != one
    for path, value in (
        ("scenario.timing.exposure_s", 0.004), ("scenario.timing.dropout", 0.6), ("scenario.pose_method", "planes"),
        ("scenario.excitation.position_amplitude_m", 0.005), ("scenario.excitation.orientation_amplitude_rad", 0.02),
        ("scenario.timing.frame_rate_hz", 50.0), ("sensor.rig.distance", 2.1), (DARK, 40.0), (NOISE, False),
        ("sensor.timing.dropout", 0.6),
    ):  # fmt: skip
        assert kind.reads.covers(path)
        assert row({"hold_s": 0.1}, **{path: value}) != one, path


@pytest.mark.parametrize(
    ("entries", "evidence", "acts"),
    [
        ({"factors": {KP: [0.1, 0.3]}}, [f"factors.{KP} does "
                                         "nothing", "'static_pose'", "scenario.pose_method"],
         {"kind": "closed_loop"}),
        ({"changes": {KP: 0.1}}, [f"changes.{KP} does nothing", "sensor.camera.*", "but "
                                                                                   "sensor.stickers.obstacle_l"],
         {"kind": KIND}),
        ({"kind": "identification", "factors": {"scenario.identification.qr_threshold": [1e-3, 1e-4]}},
         ["qr_threshold does nothing", "they read scenario.*, sensor.rig.*"], {"kind": KIND}),
        ({"factors": {"options.hold_s": [0.2, 0.4], "options.captures": [1, 4]}},
         ["factors.options.captures does nothing", "where options.hold_s is given"],
         {"factors": {"options.captures": [1, 4]}}),
        ({"factors": {"scenario.timing.frame_rate_hz": [40.0, 60.0]}}, ["hold_s is not given: "
                                                                        "options.captures sets"],
         {"options": {"hold_s": 0.2}}),
        ({"changes": {NOISE: False}, "factors": {DARK: [1.0, 2.0]}}, [f"factors.{DARK}", f"{NOISE} is false"],
         {"changes": {}, "factors": {NOISE: [False, True], DARK: [1.0, 2.0]}}),
        ({"kind": "identification", "changes": {NOISE: False}}, [f"changes.{NOISE}", "options.sensor is drawn"],
         {"options": {"sensor": "images"}}),
        ({"kind": "identification", "factors": {"scenario.payload.mass_kg": [8.0, 9.0]}}, ["anchor is not payload"],
         {"changes": {"scenario.identification.scale_anchor": "payload"}}),
        ({"kind": "closed_loop", "factors": {"scenario.plant.geometry_seed": [0, 1]}}, ["geometry_error_m is 0"],
         {"factors": {"scenario.plant.geometry_seed": {"low": 0, "high": 9},
                      "scenario.plant.geometry_error_m": {"low": 0, "high": 1e-4}}, "sample": 4}),
        ({"kind": "closed_loop", "factors": {"scenario.plant.geometry_seed": [0, 1]},
          "changes": {ZERO: [1e-3] * 6}}, ["other errors that are drawn"], {"changes": {ZERO: 1e-3}}),
    ],
)  # fmt: skip
def test_what_does_nothing_is_refused_before_any_row_and_taken_where_it_acts(
    entries, evidence, acts
):
    message = refusal(StudyError, prepare, sensor_study(**entries))
    assert all(word in message for word in evidence), message
    prepare(sensor_study(**entries | acts))
