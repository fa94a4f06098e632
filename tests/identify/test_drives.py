"""Identification under drives of other laws than the paper's, and the choice between laws by a
record's evidence.
"""

import os
from concurrent.futures import ProcessPoolExecutor
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
import xarray as xr

from dynamics.closed_loop import LoopFailure, stability
from dynamics.closed_loop.drives import DRIVES, READS, cascade_gains
from identify.errors import EstimationError, ScenarioError
from identify.estimation import drive_choice
from identify.estimation.drive_choice import choose_drive
from identify.estimation.identification import identify, output_error_problem
from identify.loop_parameters import settled_drive
from identify.model.model_side import side_of_record
from identify.progress import SilentProgress
from identify.reporting.parameter_tables import drive_sentence, unidentified
from identify.scenario.plant_sections import DRIVE_GAINS, DriveName
from tests.identify.synthetic import (
    LAYOUT,
    NAMES,
    build_plant,
    problem_of,
    quick,
    rss6,
    run_plant,
    side_of,
)

GAINS = {"lp": 10.5, "li": 11.4, "ld": 0.164}
CASCADE = {"lp": 10.5, "li": 30.0, "ld": 0.3}
LAWS = ("pid", "pd", "pi", "cascade")  # those whose loops are the same kernels

FRICTION_AND_PID = [i for i, name in enumerate(NAMES) if name.startswith("joint")]


def under(law, seconds=5.0, gains=None, model=None, **more):
    """A scenario whose plant and model have drives of a law."""
    chosen = gains or (CASCADE if law == "cascade" else GAINS)
    stated = {name: chosen[name] for name in DRIVE_GAINS[law]}
    drives = {"plant.drive": law, "plant.drive_gains": stated, "model.drive": model or law}
    return quick(**drives, **{"excitation.duration_s": seconds}, **more)


def test_a_further_record_has_its_own_torque_limit():
    limited = quick(**{"control.torque_limit_N_m": 2.5})
    record = xr.Dataset(attrs={"scenario": limited.to_toml()})
    assert side_of_record(side_of(quick()), record).settings == side_of(limited).settings


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS[1:])
def test_the_gains_of_a_named_law_are_within_their_intervals(law):
    """Of the truth, as friction is; a gain that the law does not read is none, and said to be."""
    scenario = under(law)
    record, _ = run_plant(scenario, seed=1, duration_s=5.0)
    result, true = identify(record, rss6(), scenario), build_plant(scenario, rss6()).parameters
    deviation = ((result.estimate - true) / result.std)[FRICTION_AND_PID]
    assert np.abs(deviation).max() < 3
    said, absent = (
        result.to_dict()["drive"],
        {"pd": ["joint_pid.li"], "pi": ["joint_pid.ld"]}.get(law, []),
    )
    assert (said["law"], said["decided_by"], said["fixed_at_zero"]) == (law, "scenario", absent)
    gains = LAYOUT.joint_pid
    assert result.identifiable[gains].tolist() == [name not in absent for name in NAMES[gains]]
    if law == "cascade":
        own, _ = cascade_gains(true[gains])
        for name, value in own._asdict().items():
            assert abs(said["gains"][name]["estimate"] - value) < 3 * said["gains"][name]["std"]
            assert said["gains"][name]["std"] < 0.1 * value


@pytest.mark.slow
def test_a_torque_limit_that_is_met_does_not_bias():
    """Of plant and model: the run without it is another, and the gains are within their
    intervals."""
    scenario = under("pid", **{"control.torque_limit_N_m": 3.38})
    record, run = run_plant(scenario, seed=1, duration_s=5.0)
    assert 0.005 < (np.abs(run.torque) == 3.38).mean() < 0.5
    result, true = identify(record, rss6(), scenario), build_plant(scenario, rss6()).parameters
    assert np.abs((result.estimate - true) / result.std)[FRICTION_AND_PID].max() < 3
    free = quick(**{"excitation.duration_s": 5.0})
    unaware = problem_of([record], free).driven_by_commands().cost(true)
    aware = problem_of([record], scenario).driven_by_commands().cost(true)
    assert aware < 1.1 * 6 * len(run.time) < unaware


@pytest.mark.thorough
def test_a_filter_is_seen_and_the_gains_beside_it_are_within_their_intervals():
    """Among all laws, where its time constant is stated; without a filter in the plant none is
    seen.
    """
    asked = {
        "model.drive": "auto",
        "model.derivative_filter_s": 0.01,
        "excitation.duration_s": 10.0,
    }
    scenario = quick(**asked, **{"plant.drive": "pid_filtered", "plant.derivative_filter_s": 0.01})
    record, _ = run_plant(scenario, seed=1)
    result, true = identify(record, rss6(), scenario), build_plant(scenario, rss6()).parameters
    assert (result.drive.law, result.drive.sure) == ("pid_filtered", True)
    assert np.abs((result.estimate - true) / result.std)[FRICTION_AND_PID].max() < 3
    record, _ = run_plant(quick(**asked), seed=2)
    without = identify(record, rss6(), quick(**asked)).drive
    assert (without.law, without.sure) == ("pid", True)


def case(number):
    """(law, choice) of a seeded case: law by turns, gains some 20 % about the usual ones,
    trajectory and noise.
    """
    rng, law = np.random.default_rng([number, 17]), LAWS[number % len(LAWS)]
    usual = CASCADE if law == "cascade" else GAINS
    while True:
        gains = {
            name: float(value * np.exp(0.2 * rng.standard_normal()))
            for name, value in usual.items()
        }
        scenario = under(law, gains=gains, model="auto")
        plant = build_plant(scenario, rss6())
        if (
            stability.spectral_radius(rss6(), plant.parameters, plant.settings, rss6().home_pose)
            < 1
        ):
            break
    record, _ = run_plant(scenario, seed=number, duration_s=5.0, trajectory_seed=100 + number)

    side = side_of(scenario)

    def under_law(named):
        return output_error_problem([record], side.with_drive(named), scenario.identification)

    return law, choose_drive(under_law, scenario.model, SilentProgress())


@pytest.mark.slow
def test_the_record_tells_the_law_of_the_drives():
    """A PI and a cascade, which a PID can nearly be."""
    for number in (2, 3):
        law, choice = case(number)
        assert choice.law == law or not choice.sure, (number, law, choice)
        assert sum(choice.probabilities.values()) == pytest.approx(1)
        assert bool(choice.warnings()) != choice.sure


@pytest.mark.thorough
def test_the_law_is_right_in_95_of_100_cases_or_said_to_be_unknown(record_property):
    """And where it is sure it is as sure as it should be: the expected number of wrong ones is that
    of the figure.
    """
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        cases = list(pool.map(case, range(100)))
    wrong = [(law, choice) for law, choice in cases if choice.sure and choice.law != law]
    unsure = sum(not choice.sure for _, choice in cases)
    record_property("wrong", len(wrong))
    record_property("unsure", unsure)
    assert len(wrong) <= 5, wrong
    assert unsure <= 25


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"model.drive": "pdi"},
            "model.drive = 'pdi'.*'pid', 'pd', 'pi', 'cascade', 'pid_filtered' or 'auto'",
        ),
        (
            {"plant.drive": "pid_filtered"},
            "derivative_filter_s = None: the law pid_filtered needs it",
        ),
        ({"model.derivative_filter_s": 0.01}, "drive = 'pid' with derivative_filter_s = 0.01"),
        (
            {"plant.drive": "pd", "plant.drive_gains": {"li": 3.0}},
            "gains.li = 3: the law pd has the gains lp, ld",
        ),
        ({"plant.drive_gains": {"lp": 0.0}}, "drive_gains.lp = 0"),
    ],
)
def test_drives_that_are_none_are_refused(changes, said):
    with pytest.raises(ScenarioError, match=said):
        quick(**changes)


def test_a_law_that_was_settled_holds_for_the_stages_that_follow():
    law = settled_drive({"drive": {"law": "pi"}})
    asked = quick(**{"model.drive": "auto"})
    assert asked.with_drive(law).model.drive == "pi"
    assert side_of(asked).with_drive(law).settings.drives.law == "pi"
    assert quick().with_drive("pi").model.drive == "pid"
    assert side_of(quick()).with_drive("pi") == side_of(quick())


def test_scenarios_know_the_laws_and_gains_that_the_drives_have():
    assert get_args(DriveName) == DRIVES
    assert dict(READS) == DRIVE_GAINS


def test_the_report_says_how_the_law_is_known():
    usual = {
        "law": "pid",
        "decided_by": "scenario",
        "sure": True,
        "probabilities": {"pid": 1.0},
        "fixed_at_zero": [],
    }
    assert drive_sentence({"drive": usual}) == drive_sentence({}) == ""
    told = {
        "law": "pd",
        "decided_by": "record",
        "sure": False,
        "probabilities": {"pid": 0.3, "pd": 0.7, "pi": 0.0},
    }
    said = drive_sentence({"drive": usual | told})
    assert said == (
        "The law of the drives is a PD (without an integral); the record does not decide, and this "
        "law is the most probable (probability 70 %; pid 30 %)."
    )
    left = {"joint_pid.li": {"identifiable": False}, "joint_pid.lp": {"identifiable": True}}
    reasons = unidentified(
        {"parameters": left, "drive": told | {"fixed_at_zero": ["joint_pid.li"]}}
    )
    assert reasons == [("the law of the drives has no such gain", ["joint_pid.li"])]


def test_a_record_of_which_no_law_gives_a_model_is_refused_with_the_reasons():
    def problem_of(law):
        raise EstimationError(f"nothing under {law}")

    with pytest.raises(
        EstimationError,
        match="the model is unstable under every law of the drives: pid: nothing under pid; ",
    ):
        choose_drive(problem_of, quick(**{"model.drive": "auto"}).model, SilentProgress())


def test_a_law_whose_model_is_unstable_at_the_optimum_is_left_out(monkeypatch):
    scenario = quick(**{"model.drive": "auto"})
    problem = problem_of([run_plant(scenario, 0, duration_s=2.2)[0]], scenario)
    search = SimpleNamespace(solution=SimpleNamespace(costs=[1.0], parameters=None))
    outcomes = iter([LoopFailure("unstable", 0, 0)])

    def evidence(found):
        for failure in outcomes:
            raise failure
        return drive_choice.Evidence(1.0, 1.0, 0.0)

    for name, stand_in in (
        ("linear_warm_start", lambda problem: None),
        ("_searched", lambda problem, start: search),
        ("evidence", evidence),
    ):
        monkeypatch.setattr(drive_choice, name, stand_in)
    found = choose_drive(lambda law: problem, scenario.model, SilentProgress())
    left_out, *others = found.probabilities.values()
    assert left_out == 0.0
    assert min(others) > 0
