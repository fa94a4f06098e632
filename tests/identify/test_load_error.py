"""How well a known load is known: what its error does to the estimate, and what the intervals say
of it.

The oracle is the estimator with its load stated wrong on purpose: how far its optimum moves. The
load decides the common factor of all masses and gains; so a gain is off by the load's relative
error.
"""

import numpy as np
import pytest
from scipy.stats import chi2

from identify.diagnosis.diagnose import diagnose
from identify.errors import EstimationError, RecordError
from identify.estimation.covariance import estimate_uncertainty
from identify.estimation.identification import identify
from identify.estimation.output_error_search import search
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.experiment.plant import drawn_load
from identify.experiment.run import excitation_run
from identify.experiment.truth import true_poses
from identify.record.load import store_payload
from identify.record.recording import poses
from identify.studies.rows.row_sensor import DrawnSensor
from tests.identify.synthetic import (
    LAYOUT,
    NAMES,
    SIGMA,
    build_plant,
    index_of,
    problem_of,
    quick,
    rss6,
    run_plant,
    silent,
    trajectory,
    truth,
)

MASS, GAIN = index_of("platform.mass"), index_of("joint_pid.lp")
JOINTS = [place for place, name in enumerate(NAMES) if name.startswith("joint")]
SHARE = 0.005  # relative standard deviation of the load's mass


SCENARIO = quick(**{
    "identification.cost_tolerance": 1e-8,
    "identification.parameter_tolerance": 1e-5,
    "identification.method": "command_driven",
    "payload.mass_std_kg": SHARE * 8.0,
})  # fmt: skip
DRAWN = drawn_load(LAYOUT, SCENARIO.payload, np.random.default_rng(0))
# What the scenario's load adds to the parameters (67,), and its standard deviations (67,).
LOAD, STD = DRAWN.stated, DRAWN.std


@pytest.fixture(scope="module")
def records():
    """A bare record, and one under the scenario's load, as stated."""
    bare, _ = run_plant(SCENARIO, seed=1, duration_s=3.0)
    heavy, _ = run_plant(SCENARIO, seed=2, parameters=truth() + LOAD, duration_s=3.0)
    store_anchor(bare, ScaleAnchor("payload"))
    store_payload(heavy, LAYOUT, LOAD, STD)
    return [bare, heavy]


def stating(records, *loads):
    """The problem of the bare record, and of the other one for each (load (67,), std (67,) or None)
    as stated.
    """
    restated = [records[1].copy() for _ in loads]
    for record, (load, std) in zip(restated, loads, strict=True):
        store_payload(record, LAYOUT, load, std)
    return problem_of([records[0], *restated], SCENARIO).driven_by_commands()


def covariance(problem, parameters):
    return estimate_uncertainty(problem, parameters, np.random.default_rng(0)).covariance


def test_the_intervals_allow_for_how_far_a_wrong_load_moves_the_estimate(records):
    """Covariance of friction and gains, with all their correlations; all members of the scale move
    together.
    """
    (
        heavier,
        lighter,
    ) = (  # where the optimum lies if the load is stated a standard deviation too heavy, or too light
        search(stating(records, (LOAD + sign * STD, None)), truth(), silent).parameters
        for sign in (1, -1)
    )
    at, shift = (heavier + lighter) / 2, (heavier - lighter) / 2
    known, weighed = (covariance(stating(records, (LOAD, std)), at) for std in (None, STD))
    added, expected = (
        (weighed - known)[np.ix_(JOINTS, JOINTS)],
        np.outer(shift[JOINTS], shift[JOINTS]),
    )
    assert np.abs(added - expected).max() < 0.02 * np.abs(expected).max()
    assert np.sqrt(np.diag(added)) == pytest.approx(np.abs(shift[JOINTS]), rel=0.02)
    # The load alone shows the scale: its relative error is that of the gain, beside what noise
    # leaves.
    assert shift[GAIN] / truth()[GAIN] == pytest.approx(SHARE, rel=0.05)
    relative = [np.sqrt(one[GAIN, GAIN]) / truth()[GAIN] for one in (known, weighed)]
    assert relative[1] == pytest.approx(np.hypot(relative[0], SHARE), rel=0.05)
    assert relative[1] > 1.4 * relative[0]


def test_records_under_the_same_load_share_its_error_and_others_do_not(records):
    """A second record under the load repeats its error; under another load, known as well, the
    errors average.
    """

    def added(other, deviation):
        return covariance(stating(records, (LOAD, deviation), (other, deviation)), truth())[
            GAIN, GAIN
        ]

    exact = added(LOAD, np.zeros(67))
    same, apart = (added(other, STD) - exact for other in (LOAD, LOAD * (1 + 1e-9)))
    assert apart == pytest.approx(same / 2, rel=1e-3)


def test_an_exactly_known_load_leaves_every_digit_as_it_was(records):
    """Stated with a deviation of zero, or with none, as records of before have it."""
    stated = covariance(stating(records, (LOAD, None)), truth())
    unsaid = records[1].copy()
    unsaid.attrs = {
        name: value for name, value in unsaid.attrs.items() if not name.endswith("_std")
    }
    unsaid = problem_of([records[0], unsaid], SCENARIO).driven_by_commands()
    assert np.array_equal(covariance(unsaid, truth()), stated)


def test_a_deviation_that_cannot_be_is_refused_and_none_makes_two_loads_of_one(records):
    bare, heavy = records
    again = heavy.assign_attrs(payload_mass_std=0.01)
    store_anchor(again, ScaleAnchor("payload"))
    for pair, error, says in (
        (
            (bare, heavy.assign_attrs(payload_mass_std="0.04")),
            RecordError,
            "mass_std is '0.04', must be a number >= 0",
        ),
        (
            (bare.assign_attrs(payload_mass_std=0.04), heavy),
            RecordError,
            "payload_mass is None, must be a number >= 0",
        ),
        ((again, heavy), EstimationError, "2 records all have the same load"),
    ):
        with pytest.raises(error, match=says):
            identify(list(pair), rss6(), SCENARIO)


@pytest.mark.slow
def test_drawn_loads_spread_as_stated_and_are_never_negative():
    """Mean and spread of many: of a weighed mass, and of one hardly known, which normal deviations
    would make none.
    """
    rng = np.random.default_rng(0)
    masses = np.array([drawn_load(LAYOUT, SCENARIO.payload, rng).true[MASS] for _ in range(2000)])
    assert masses.std() == pytest.approx(0.04, rel=0.07)
    assert masses.mean() == pytest.approx(8.0, abs=4 * 0.04 / np.sqrt(2000))
    vague = quick(**{"payload.mass_std_kg": 8.0, "payload.Izz_std_kg_m2": 0.04})
    drawn = np.array([drawn_load(LAYOUT, vague.payload, rng).true for _ in range(200)])
    assert (drawn >= 0).all()
    assert np.flatnonzero(np.ptp(drawn, axis=0)).tolist() == [MASS, index_of("platform.Izz")]


def test_an_experiment_states_the_load_and_keeps_the_drawn_one_in_its_truth():
    """A stream of its own: the bare run is the same to the last digit, and so is the noise of the
    loaded one.
    """
    sensor, short = DrawnSensor(np.diag(SIGMA**2)), {"excitation.duration_s": 1.0}
    vague, exact = (
        SCENARIO.with_overrides(short),
        SCENARIO.with_overrides(short | {"payload.mass_std_kg": 0.0}),
    )

    def run(one, seed=0, payload=True):
        load = one.payload if payload else None
        plant = build_plant(one, rss6())
        return excitation_run(plant, sensor, trajectory(0), one.excitation, seed, payload=load)

    heavy, known = run(vague), run(exact)
    assert heavy.record.attrs["payload_mass"] == known.record.attrs["payload_mass"] == 8.0
    assert heavy.record.attrs["payload_mass_std"] == pytest.approx(0.04)
    assert known.truth.attrs["payload_mass"] == 8.0
    drawn = heavy.truth.attrs["payload_mass"]
    assert 0 < abs(drawn - 8.0) < 4 * 0.04
    assert (
        run(vague).truth.attrs["payload_mass"]
        == drawn
        != run(vague, seed=1).truth.attrs["payload_mass"]
    )
    noise = [poses(one.record, "measured") - true_poses(one.truth) for one in (heavy, known)]
    assert noise[0] == pytest.approx(noise[1], abs=1e-15)
    assert not np.array_equal(true_poses(heavy.truth), true_poses(known.truth))
    np.testing.assert_array_equal(
        *(true_poses(run(one, payload=False).truth) for one in (vague, exact))
    )
    np.testing.assert_array_equal(*(one.truth["parameter_value"].values for one in (heavy, known)))


@pytest.mark.parametrize(
    "count", [pytest.param(count, marks=pytest.mark.thorough) for count in (4, 40)]
)
def test_gains_miss_the_truth_as_often_as_they_say_where_the_load_is_drawn(count):
    """Whole experiments, each with noise and a load of its own: errors of the gain in standard
    deviations have the variance one (99.8 % of chance); were the load called exact, twice the
    deviation and more."""
    sensor = DrawnSensor(np.diag(SIGMA**2))
    weighed = SCENARIO.with_overrides(
        {"payload.mass_std_kg": 0.08, "identification.scale_anchor": "payload"}
    )

    plant = build_plant(weighed, rss6())

    def identified(seed, **attributes):
        bare, heavy = (
            excitation_run(
                plant, sensor, trajectory(0), weighed.excitation, seed, payload=payload
            ).record
            for payload in (None, weighed.payload)
        )
        return identify([bare, heavy.assign_attrs(attributes)], rss6(), weighed)

    results = [identified(seed) for seed in range(count)]
    errors = np.array([result.estimate[GAIN] - truth()[GAIN] for result in results])
    stated = np.mean((errors / [result.std[GAIN] for result in results]) ** 2)
    least, most = chi2.ppf([0.001, 0.999], count) / count
    assert least < stated < most, errors
    exact = identified(0, payload_mass_std=0.0).std[GAIN]
    assert np.sqrt(np.mean((errors / exact) ** 2)) > 2


@pytest.mark.slow
@pytest.mark.parametrize("error", [0.0, 0.03, pytest.param(-0.05, marks=pytest.mark.thorough)])
def test_a_gain_that_contradicts_a_known_load_is_named_with_its_error(records, error):
    """The load shows the scale to better than 1 % in six seconds, one record does not show it."""
    bare, heavy = (record.copy() for record in records)
    store_anchor(bare, ScaleAnchor("joint_gain", (1 + error) * truth()[GAIN], 0.01))
    found = diagnose([bare, heavy], scenario=SCENARIO).findings
    if not error:
        assert found == ()
        return
    (finding,) = found
    assert finding.name == "scale anchor joint_gain against the weight of the known load"
    (size,) = finding.sizes
    assert size.std < 0.01
    assert size.value == pytest.approx(error, abs=3 * size.std)
    assert "agrees with the load, whose mass is stated to 0.5 %" in finding.remedies[0]
    assert diagnose(bare, scenario=SCENARIO).findings == ()
