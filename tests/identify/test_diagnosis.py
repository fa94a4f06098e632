"""Diagnosis: the cause that was put into the plant or the record is named, with its size; a right
model is accused of nothing.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom

import identify
from dynamics.geometry import RobotGeometry
from identify.commands.diagnosis import _say
from identify.diagnosis import selection
from identify.diagnosis.candidate_fits import Selected, State, shown_sizes
from identify.diagnosis.catalogue import own_cause
from identify.diagnosis.cause import Cause, InList, in_each_run
from identify.diagnosis.diagnose import diagnosis_from
from identify.diagnosis.diagnosis import Diagnosis, Finding, Size, remedies_of
from identify.diagnosis.fit import SETTLED, Point
from identify.diagnosis.linearisation import Linearisation
from identify.diagnosis.score import OrthogonalComplement, score
from identify.diagnosis.selection import CHANCE
from identify.errors import EstimationError
from identify.estimation.explanation import Misfit
from identify.files.run_folder import load_result
from identify.record.stored_common_errors import CommonErrors, store_common_errors
from identify.stages.explain import not_needed, with_diagnosis
from tests.identify import synthetic
from tests.identify.commands import command, one_line, refusal
from tests.identify.synthetic import (
    SIGMA,
    problem_of,
    quick,
    recorded_run_folder,
    rss6,
    run_plant,
    truth,
)


def record_of(seed, monkeypatch=None, plant=None, scenario=None, **given):
    """A record of 5 s, of a plant that is changed by a function."""
    if plant is not None:
        made = synthetic.build_plant
        monkeypatch.setattr(synthetic, "build_plant", lambda *own: plant(made(*own)))
    record = run_plant(scenario or quick(), seed, **{"duration_s": 5.0} | given)[0]
    if plant is not None:
        monkeypatch.setattr(synthetic, "build_plant", made)
    return record


def diagnosed(record, scenario=None, own=()):
    """The diagnosis of a record, searched from the true parameters to save time."""
    return diagnosis_from(problem_of([record], scenario or quick()), truth(), own)


def with_zeros(*shifts):
    """Function that returns a plant whose joints read less by shifts (6,) in rad."""

    def changed(plant):
        geometry: RobotGeometry = plant.robot.geometry
        off = geometry.shifted(np.array(shifts)).deviations_from(geometry)
        return replace(plant, robot=plant.robot.moved(off))

    return changed


def with_numbers(kind, *sizes):
    """Function that returns a plant whose geometric numbers of a kind are off, one size a leg."""

    def changed(plant):
        names = plant.robot.geometry.number_names
        off = np.zeros(len(names))
        off[[names.index(f"leg{k}.{kind}") for k in range(1, 7)]] = sizes
        return replace(plant, robot=plant.robot.moved(off))

    return changed


def crank_length(monkeypatch):
    return record_of(10, monkeypatch, with_numbers("crank_length", 0, 0, 1.3e-4, 0, 0, 0))


def zero(monkeypatch):
    return record_of(2, monkeypatch, with_zeros(0, 3e-4, 0, 0, 0, 0))


def scale(monkeypatch):
    record = record_of(3)
    record["command"] /= 1.0017
    return record


def late(monkeypatch):
    return record_of(4, latency_s=6e-3)


def drift(monkeypatch):
    """The clock of the drives falls behind by 1 ms a second."""
    times = quick().timing.frame_times(10.0)
    return record_of(5, latency_s=1e-3 * times, duration_s=10.0)


def elastic(monkeypatch):
    return record_of(16, scenario=quick(**{"plant.joint_stiffness_N_m_rad": 1.5e4}))


# Records whose residual an injected cause doubles, and the true size of the cause.
CASES = {
    "zero of joint 2": (zero, 3e-4),
    "scale of the commands": (scale, 1.7e-3),
    "latency of the commands": (late, 6e-3),
    "drift of the commands' clock": (drift, 1e-3),
    "crank length of leg 3": (crank_length, 1.3e-4),
    "elasticity of the joints": (elastic, 1 / 1.5e4),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_cause_that_was_injected_is_named_first_with_its_size(name, monkeypatch):
    make, true = CASES[name]
    found = diagnosed(make(monkeypatch))
    assert found.misfit.found > 1.4
    assert not found.none_of_these
    first = found.findings[0]
    assert first.name == name
    size = first.sizes[0]
    assert abs(size.value - true) < 3 * size.std
    assert first.share > 0.9
    # once it is fitted, noise explains the rest
    assert not found.left.significant


@pytest.mark.slow
def test_static_friction_is_named_with_its_ratio_and_its_velocity_and_as_a_line_to_type():
    true = {
        "plant.friction": "stribeck",
        "plant.static_ratio": 1.1,
        "plant.stribeck_velocity_rad_s": 0.05,
    }
    found = diagnosed(record_of(17, scenario=quick(**true)))
    (only,) = found.findings
    assert only.name.startswith("static friction")
    excess, wider = only.sizes
    assert abs(excess.value - 0.1) < 3 * excess.std
    beyond = float(wider.name.split()[-2])
    assert abs(beyond + wider.value - 0.05) < 3 * wider.std
    assert not found.left.significant
    assert "--set model.friction=stribeck --set model.static_ratio=1." in only.remedies[0]
    assert "--set model.stribeck_velocity_rad_s=0.0" in only.remedies[1]


@pytest.mark.slow
def test_another_law_of_the_drives_is_named_as_a_line_to_type():
    found = diagnosed(record_of(18, scenario=quick(**{"plant.drive": "cascade"})))
    first = found.findings[0]
    assert first.name == "drives of the law cascade"
    assert first.sizes == ()
    assert first.remedies == ("--set model.drive=cascade, or --set model.drive=auto",)
    assert not found.left.significant


@pytest.mark.slow
def test_several_zeros_are_named_as_a_group_with_the_size_of_each(monkeypatch):
    true = 2e-4 * np.random.default_rng(3).standard_normal(6)
    found = diagnosed(record_of(6, monkeypatch, with_zeros(*true), duration_s=10.0))
    assert found.findings[0].name == "zeros of the joints"
    sizes = found.findings[0].sizes
    assert [one.name for one in sizes] == [f"zero of joint {k}" for k in range(1, 7)]
    off = [(one.value - size) / one.std for one, size in zip(sizes, true, strict=True)]
    assert np.abs(off).max() < 3


@pytest.mark.slow
def test_causes_that_move_the_platform_alike_are_named_together(monkeypatch):
    """Over a small workspace a link that is longer acts as a zero that is off."""
    record = record_of(11, monkeypatch, with_numbers("link_length", 0, 0, 0, 0, 2e-5, 0))
    first = diagnosed(record).findings[0]
    assert "link length of leg 5" in (first.name, *first.alike)
    assert all(name.endswith(" 5") for name in (first.name, *first.alike))
    several = 2e-5 * np.random.default_rng(5).standard_normal(6)
    record = record_of(12, monkeypatch, with_numbers("link_length", *several))
    first = diagnosed(record).findings[0]
    assert "lengths of the links" in (first.name, *first.alike)


@pytest.mark.thorough
def test_of_two_causes_that_are_alike_in_size_both_are_named(monkeypatch):
    record = record_of(7, monkeypatch, with_zeros(0, 0, 0, 0, 3e-4, 0))
    record["command"] /= 1.0017
    found = diagnosed(record)
    names = {one.name for one in found.findings}
    assert names == {"zero of joint 5", "scale of the commands"}
    assert found.explained == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_a_small_cause_is_named_beside_one_that_is_far_larger(monkeypatch):
    """The model with another zero is exact, so that what it leaves is of another cause."""
    found = diagnosed(record_of(17, monkeypatch, with_zeros(0, 6e-3, 0, 0, 0, 0), latency_s=3e-3))
    names = [one.name for one in found.findings]
    assert names == ["zero of joint 2", "latency of the commands"]
    assert found.findings[1].share < 2e-3
    for one, true in zip(found.findings, (6e-3, 3e-3), strict=True):
        assert abs(one.sizes[0].value - true) < 4 * one.sizes[0].std
    assert not found.left.significant


def test_a_cause_that_is_tried_at_a_size_is_not_left_out_by_its_derivative():
    rng = np.random.default_rng(1)
    by_parameters, columns = rng.standard_normal((60, 3)), rng.standard_normal((60, 2))
    plain = Cause("plain", "1", "a", in_each_run(lambda run, size: run), 1.0, str)
    causes = (plain, replace(plain, name="tried", tried=(0.1,)))
    linear = Linearisation(rng.standard_normal(60), by_parameters, columns)
    beside = OrthogonalComplement.of(by_parameters)
    point = Point(causes, np.zeros(3), np.array([1e-9, 1e-9]), linear, beside)
    assert shown_sizes(point).tolist() == [False, True]


def test_a_cause_stays_without_which_chance_explains_all_others(monkeypatch):
    law, zero = (Selected(None, (place,), 1.0, ()) for place in (0, 1))
    point = SimpleNamespace(sizes=np.ones(2), parameters=np.zeros(1))
    causes = (SimpleNamespace(step=0.0), SimpleNamespace(step=1.0))
    now = State((law, zero), (0, 1), point, causes, None, ())
    monkeypatch.setattr(selection, "fitted", lambda *_: ((), point))
    assert selection._exchanged(None, now, 10.0, None) is now


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, pytest.param(40, marks=pytest.mark.thorough)])
def test_a_right_model_is_accused_of_nothing_but_by_chance(count):
    accused = [seed for seed in range(count) if diagnosed(record_of(100 + seed)).findings]
    assert len(accused) <= binom.ppf(0.999, count, CHANCE)


def test_a_cause_that_is_not_in_the_catalogue_is_called_none_of_these():
    shaken = record_of(8, bias=lambda frame, pose: 8e-6 * np.sin(1.3 * frame) * np.eye(6)[0])
    found = diagnosed(shaken)
    assert found.misfit.significant
    assert found.none_of_these
    assert "none of these explains" in found.warnings()[0]


STATED = np.broadcast_to(np.diag(SIGMA**2), (300, 6, 6)).copy()


@pytest.mark.parametrize("times", [0.7, 1.4])
def test_noise_that_is_stated_wrongly_is_named_with_its_ratio(times):
    found = diagnosed(record_of(13, sigma=times * SIGMA, measured_covariance=STATED))
    (only,) = found.findings
    assert only.name == "noise of the sensor"
    assert all(abs(one.value - times) < 3 * one.std for one in only.sizes)
    assert f"state {only.sizes[0].value:.3g} times" in only.remedies[0]


@pytest.mark.slow
def test_sizes_stand_where_columns_are_not_computed_anew(monkeypatch):
    """Against fits whose columns are those of every new point."""
    record = record_of(3, plant=with_zeros(5e-4, 0, 0, 0, 0, 0), monkeypatch=monkeypatch)
    found = []
    for settled in (SETTLED, 0.0):
        monkeypatch.setattr("identify.diagnosis.fit.SETTLED", settled)
        found.append(diagnosed(record).findings[0])
    one, other = found
    assert one.name == other.name
    assert one.sizes[0].value == pytest.approx(other.sizes[0].value, abs=0.02 * other.sizes[0].std)


@pytest.mark.slow
def test_gross_errors_are_named_by_their_frames():
    frames = {50: 0, 131: 1, 231: 4}
    size = 30 * SIGMA

    def bias(frame, pose):
        return size * np.eye(6)[frames[frame]] if frame in frames else 0.0

    first = diagnosed(record_of(14, bias=bias)).findings[0]
    assert first.name == "gross errors"
    assert {one.name for one in first.sizes} == {
        "x of frame 50",
        "y of frame 131",
        "beta of frame 231",
    }
    off = [(one.value - size[frames[int(one.name.split()[-1])]]) / one.std for one in first.sizes]
    assert np.abs(off).max() < 3
    assert "mark frame 50, at t = 0.8333333 s, as lost: measured_ok = 0" in first.remedies


@pytest.mark.parametrize(("stated", "accused"), [(4e-5, False), (4e-6, True)])
def test_a_camera_that_is_off_by_more_than_it_states_is_named(stated, accused):
    """The error turns the measured platform about z in proportion to its x."""

    def bias(frame, pose):
        return 4e-5 * np.array([0, 0, 0, 0, 0, 1]) * (1 + 100 * pose[0])

    record = record_of(15, bias=bias)
    poses = record["measured_position"].values
    changes = np.zeros((len(poses), 6, 1))
    changes[:, 5, 0] = 1 + 100 * poses[:, 0]
    store_common_errors(record, CommonErrors(("rig.turn_rad",), changes, np.diag([stated**2])))
    found = diagnosed(record)
    named = [one for one in found.findings if one.name == "error rig.turn_rad"]
    assert bool(named) is accused
    if accused:
        assert found.findings[0] is named[0]
        assert abs(named[0].sizes[0].value - 4e-5) < 3 * named[0].sizes[0].std
        assert "calibrate anew" in named[0].remedies[0]


def test_the_statistic_is_the_fall_of_the_cost_by_a_fit_of_the_same_columns():
    rng = np.random.default_rng(0)
    parameters, causes = rng.standard_normal((80, 7)), rng.standard_normal((80, 3))
    residual = rng.standard_normal(80)
    both = np.hstack([parameters, causes])
    without, fitted = (
        residual - rows @ np.linalg.lstsq(rows, residual)[0] for rows in (parameters, both)
    )
    beside = OrthogonalComplement.of(parameters)
    found = score(beside.part(causes), beside.part(residual), np.linalg.norm(causes, axis=0))
    assert found.statistic == pytest.approx(without @ without - fitted @ fitted)
    assert found.sizes == pytest.approx(-np.linalg.lstsq(both, residual)[0][7:])
    covariance = np.linalg.inv(both.T @ both)[7:, 7:]
    assert found.covariance() == pytest.approx(covariance)


def test_a_cause_that_the_parameters_take_up_has_no_statistic():
    rng = np.random.default_rng(1)
    parameters = rng.standard_normal((50, 4))
    beside = OrthogonalComplement.of(parameters)
    column = parameters @ rng.standard_normal((4, 1))
    residual = beside.part(rng.standard_normal(50))
    found = score(beside.part(column), residual, np.linalg.norm(column, axis=0))
    assert (found.statistic, found.freedoms) == (0.0, 0)


def test_entries_of_a_list_of_settings_are_typed_with_those_that_the_model_has_and_those_before():
    def friction(name):
        remedy = InList("model.passive_friction", ("link_joint.viscous",), name)
        return Cause(name, "N m", "friction", lambda problem, size: problem, 1.0, remedy)

    dry, viscous = friction("link_joint.coulomb"), friction("platform_joint.viscous")
    size = Size("", "N m", 1e-3, 1e-4)
    lists = {}
    (first,) = remedies_of([dry], [size], lists)
    (second,) = remedies_of([viscous], [size], lists)
    assert first == (
        '--set \'model.passive_friction=["link_joint.viscous", "link_joint.coulomb"]\''
    )
    assert '"link_joint.coulomb", "platform_joint.viscous"]' in second


def bump(run, size):
    """Joint 3 goes further by a size during the second half of a run."""
    later = np.arange(len(run.logged)) > len(run.logged) / 2
    return replace(run, logged=run.logged + size * np.outer(later, np.eye(6)[2]))


bump.unit = "rad"


def nothing(run, size):
    return run


def no_run(run, size):
    return size


def raising(run, size):
    raise ValueError("too large")


@pytest.fixture
def allowed(monkeypatch):
    monkeypatch.setenv("CMMSIM_PLUGINS", __name__)
    monkeypatch.setitem(__import__("sys").modules, __name__, __import__("sys").modules[__name__])


@pytest.mark.slow
def test_an_own_cause_is_asked_beside_those_of_the_catalogue(allowed):
    record = record_of(9)
    half = np.arange(record.sizes["time"]) > record.sizes["time"] / 2
    record["command"] -= 3e-4 * np.outer(half, np.eye(6)[2])
    found = diagnosed(record, own=[own_cause(f"{__name__}:bump")])
    first = found.findings[0]
    assert first.name == f"{__name__}:bump"
    assert first.sizes[0].unit == "rad"
    assert abs(first.sizes[0].value - 3e-4) < 3 * first.sizes[0].std


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nothing", "changes no pose of the model"),
        ("no_run", "must return a LoopModel, returned float"),
        ("raising", "raised ValueError: too large"),
        ("absent", "has no absent"),
    ],
)
def test_an_own_cause_that_is_no_column_is_refused_in_one_line(name, said, allowed):
    def asked():
        diagnosed(synthetic.short_run()[0], synthetic.SHORT, [own_cause(f"{__name__}:{name}")])

    assert said in refusal(EstimationError, asked)


def test_an_own_cause_needs_a_step_above_zero(allowed, monkeypatch):
    monkeypatch.setattr(bump, "step", -1.0, raising=False)
    assert "step = -1.0" in refusal(EstimationError, own_cause, f"{__name__}:bump")


def test_python_takes_causes_of_its_own():
    record, _ = synthetic.short_run()
    cause = Cause("bump", "rad", "bump", in_each_run(bump), 1e-4, lambda size: "mend it")
    result = identify.identify(record, rss6(), synthetic.SHORT)
    found = identify.diagnose(record, result, rss6(), synthetic.SHORT, causes=[cause])
    assert "bump" in found.to_dataframe().index
    assert found.candidates[0].name in found._repr_html_()


@pytest.fixture
def run_folder(tmp_path, monkeypatch):
    """A folder as `cmmsim identify` leaves it, of a record with a zero that is off."""
    scenario = quick(**{"excitation.duration_s": 4.0})
    plant = with_zeros(0, 5e-4, 0, 0, 0, 0)
    record = record_of(2, monkeypatch, plant, scenario, duration_s=4.0)
    synthetic.store_robot(record, rss6())
    run = synthetic.short_run()[1]
    folder = recorded_run_folder(tmp_path, scenario, (record, run))
    assert command("identify", "--out", folder.path, "--quiet") == 0
    return folder


@pytest.mark.slow
def test_identify_stores_the_diagnosis_and_warns_and_the_command_repeats_it(run_folder, capsys):
    result = load_result(run_folder.result)
    entry = result["diagnosis"]
    assert entry["findings"][0]["name"] == "zero of joint 2"
    warned = [text for text in result["identification"]["warnings"] if "diagnosis" in text]
    assert warned == entry["warnings"]
    assert "zero of joint 2" in warned[0]
    capsys.readouterr()
    assert command("diagnose", run_folder.path, "--json", "-") == 0
    again = json.loads(capsys.readouterr().out)
    assert again["findings"][0]["name"] == "zero of joint 2"
    stored = load_result(run_folder.result)
    assert stored["diagnosis"]["findings"][0]["sizes"] == again["findings"][0]["sizes"]
    assert len(stored["identification"]["warnings"]) == len(result["identification"]["warnings"])
    assert command("diagnose", run_folder.path) == 0
    said = capsys.readouterr().out
    assert "zero of joint 2" in said
    assert "cmmsim geometry finds all zeros" in said


def test_residuals_that_are_noise_and_a_warning_of_the_cameras_need_no_cause_in_the_robot(capsys):
    """An excess of 5 % of the noise, as the errors of taught frames make it, and one of 20 %."""
    accused = Finding("zero of joint 4", "zeros", (), 0.4, 36.0, 1, 1e-6, (), ("--set a=1",))
    found = Diagnosis((accused,), (), Misfit(1.05, 1.0, 0.01), Misfit(1.0, 1.0, 0.01), 0.0)
    result = {
        "drift_watch": None,
        "identification": {
            "noise_ratio": 1.02,
            "expected_noise_ratio": 1.0,
            "noise_ratio_std": 0.02,
            "whiteness": {"p_value": 0.3},
            "warnings": [],
        },
    }
    calm = replace(found, not_needed=not_needed(result, found))
    assert str(calm).startswith("noise explains the record, and no cause is needed")
    assert "; not needed: zero of joint 4" in str(calm)
    assert with_diagnosis(result, calm)["identification"]["warnings"] == []
    for ranked in (False, True):
        _say(calm, ranked)
        said = capsys.readouterr().out
        assert said.startswith("noise explains the record")
        assert ("what each alone explains" in said) == ranked
    missed = replace(found, misfit=Misfit(1.2, 1.0, 0.01))
    assert not_needed(result, missed) == ""
    warned = result | {"drift_watch": {"warning": "stickers are not where they should be"}}
    assert not_needed(warned, missed).startswith("stickers are not where they should be: this")


def test_a_folder_without_a_result_is_not_diagnosed(tmp_path, capsys):
    folder = recorded_run_folder(tmp_path)
    assert command("diagnose", folder.path) == 1
    assert "has no result.json; write it with: cmmsim identify" in one_line(capsys.readouterr().err)
