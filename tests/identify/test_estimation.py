"""The estimator against known truth, on records with drawn noise (images are in
test_experiment)."""

from dataclasses import replace

import numpy as np
import pytest

from dynamics.closed_loop import (
    LoopFailure,
    differentiate_servo,
    equilibrium,
    simulate_servo,
)
from dynamics.closed_loop.drives import joint_law
from dynamics.errors import ParameterError
from identify.errors import EstimationError
from identify.estimation.base_parameters import structure
from identify.estimation.conditioning import POOR
from identify.estimation.covariance import correlation_matrix, estimate_uncertainty
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.estimation.warm_start import joint_balance
from identify.experiment.plant import drawn_load
from identify.loop_parameters import choose_parameters
from identify.model.from_record import identified_model
from identify.progress import SilentProgress
from identify.record.load import store_payload
from identify.reporting.run_result import prediction_entry
from identify.scenario import load_scenario
from identify.validation.pose_prediction import PosePrediction, predict_poses, predicted_runs
from tests.identify.synthetic import (
    LAYOUT,
    NAMES,
    SIGMA,
    build_plant,
    problem_of,
    quick,
    rss6,
    run_plant,
    side_of,
    truth,
    truth_of,
)
from tests.identify.test_interval_coverage import check_coverage, row_of

FRICTION_AND_PID = [i for i, name in enumerate(NAMES) if name.startswith("joint")]


@pytest.fixture(scope="module")
def scenario():
    return quick()


@pytest.fixture(scope="module")
def record(scenario):
    return run_plant(scenario, seed=1)[0]


@pytest.fixture(scope="module")
def ensemble():
    """Results of six experiments that differ by noise, weighing and starting guess, which errs by
    as much as it says, 30 % of each parameter; the last loses frames."""
    found = []
    for seed in range(6):
        rng = np.random.default_rng([seed, 1])
        guess = np.maximum(1 + 0.3 * rng.standard_normal(len(NAMES)), 0.1) * truth()
        prior = {name: {"value": guess[k], "std": 0.3 * truth()[k]} for k, name in enumerate(NAMES)}
        scenario = quick(**{"identification.prior": prior})
        lost = set(range(200, 215)) | {300, 420} if seed == 5 else ()
        record, _ = run_plant(scenario, seed, lost=lost)
        record.attrs["scale_anchor_value"] += 0.005 * rng.standard_normal()
        found.append(identify(record, rss6(), scenario))
    return found


def assert_near_the_truth(result, limit):
    """Friction and gains are within so many standard deviations of theirs; returns these shares."""
    deviation = ((result.estimate - truth()) / result.std)[FRICTION_AND_PID]
    assert np.all(np.abs(deviation) < limit), dict(
        zip(np.array(NAMES)[FRICTION_AND_PID], deviation, strict=True)
    )
    return deviation


def unseen_error(scenario, parameters, seed=7):
    """RMS (6,) of a model against the noise-free plant on a trajectory it has not seen."""
    record, run = run_plant(scenario, seed=0, sigma=np.zeros(6), trajectory_seed=seed)
    problem = problem_of([record], scenario)
    return np.sqrt(np.mean((problem.runs[0].simulate(parameters).pose - run.pose) ** 2, axis=0))


@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_warm_start_equation_holds_for_the_true_parameters(scenario, hold, jitter):
    """Without dry friction the regression times the truth vanishes against the torques in it, also
    where each command has a latency of its own."""
    parameters, scenario = (
        truth(),
        scenario.with_overrides({"timing.hold": hold, "timing.latency_s": 1 / 60}),
    )
    parameters[52:58] = 0
    latencies = np.random.default_rng(1).uniform(0.0, 2.0, 600) / 60 if jitter else None
    record, run = run_plant(scenario, 0, np.zeros(6), parameters=parameters, latency_s=latencies)
    model = replace(identified_model(record, side_of(scenario)), acted=latencies)
    law = joint_law("pid", parameters[64:])
    columns, slipping = joint_balance(model, run.pose, scenario.filter, law)
    columns = columns[slipping]
    start = equilibrium(
        rss6(), parameters, run.pose[0], build_plant(scenario, rss6()).settings.servo
    )
    unknowns = np.concatenate([parameters, start.joint_integral * parameters[65]])
    balance = columns @ unknowns
    limit = 3e-3 if jitter else 1e-3
    assert np.sqrt(np.mean(balance**2)) < limit * np.sqrt(
        np.mean((columns[:, 64:67] @ parameters[64:]) ** 2)
    )


@pytest.mark.slow
def test_intervals_cover_as_often_as_they_say_and_friction_and_gains_are_found_without_bias(
    ensemble,
):
    """Each within what its standard deviation says, and their mean over all experiments within that
    of a mean.

    Residuals are the sensor's noise, and what the servo made of it: as the repeated experiments
    predict.
    """
    check_coverage([row_of(number, result, truth()) for number, result in enumerate(ensemble)])
    errors = [assert_near_the_truth(result, 4) for result in ensemble]
    assert np.abs(np.mean(errors, axis=0)).max() < 3.5 / np.sqrt(len(ensemble))
    for result in ensemble:
        assert np.all(result.identifiable[FRICTION_AND_PID])
        assert 0.9 < result.noise_ratio < 1.2
        assert result.noise_ratio == pytest.approx(result.expected_noise_ratio, abs=0.1)
        assert result.warnings == ()
        assert not result.whiteness.suspicious


@pytest.mark.slow
def test_the_error_on_unseen_motions_is_the_one_predicted(scenario, ensemble):
    """To micrometres, also where frames were lost; its square in units of what was predicted is one
    on average. With exactly known parameters the plant strays by what the servo lets through of the
    noise alone."""
    ratios, exact = [], []
    for unseen in range(6):
        result, rng = ensemble[unseen], np.random.default_rng(unseen)
        record, plant = run_plant(
            scenario, seed=100 + unseen, trajectory_seed=50 + unseen, duration_s=5.0
        )
        run = identified_model(record, side_of(scenario))
        for found, model in (
            (ratios, (result.estimate, result.covariance)),
            (exact, (truth(), np.zeros((67, 67)))),
        ):
            found.append(predict_poses(run, *model, rng).normalised_squared_error(plant.pose))
    assert 0.8 < np.mean(ratios) < 1.2, ratios
    assert np.mean(exact) == pytest.approx(1.0, abs=0.1), exact
    for experiment, limits in ((1, [3e-6, 15e-6]), (5, [5e-6, 25e-6])):
        assert np.all(
            unseen_error(scenario, ensemble[experiment].estimate) < np.repeat(limits, 3)
        ), experiment


def test_a_prediction_keeps_the_models_slopes_where_no_frame_was_lost(scenario):
    """Found by the parameters that stand for all, they are those by all."""
    record, _ = run_plant(scenario, seed=3, trajectory_seed=4, duration_s=3.0)
    run, rng = identified_model(record, side_of(scenario)), np.random.default_rng(0)
    whole, few = (np.arange(len(run.ok)) != lost for lost in (-1, 20))
    alone = differentiate_servo(rss6(), truth(), run.reference, run.settings)
    for groups in (None, structure(rss6()).rigid_groups):
        one = replace(run, ok=whole, groups=groups)
        found = predict_poses(one, truth(), np.zeros((67, 67)), rng)
        np.testing.assert_array_equal(found.poses, alone.pose)
        scale = np.abs(alone.pose_sensitivity).max()
        np.testing.assert_allclose(found.slopes, alone.pose_sensitivity, rtol=0, atol=1e-12 * scale)
        assert predict_poses(replace(one, ok=few), truth(), np.zeros((67, 67)), rng).slopes is None


@pytest.mark.slow
def test_groups_are_known_where_their_members_are_not_and_the_common_factor_ties_gains_together(
    ensemble,
):
    """The intervals of the identified groups hold the truth, and there are more of them than of
    lone parameters. Crank Ixx, Iyy and link Izz do no work (design of the robot), so no record can
    tell them."""
    result = ensemble[1]
    groups = result.groups
    true, known = groups.combinations @ truth()[:64], groups.identifiable
    assert known.sum() >= 20
    assert known.sum() > result.identifiable[:64].sum()
    assert np.all(np.abs((groups.estimate - true)[known]) < 4 * groups.std[known])
    assert groups.identifiable[groups.names.index("crank5.Izz +")]
    assert not result.identifiable[NAMES.index("crank5.mass")]
    for index in map(NAMES.index, ("crank1.Ixx", "crank4.Iyy", "link2.Izz")):
        assert not result.identifiable[index]
        assert result.estimate[index] == pytest.approx(result.initial[index], rel=1e-6)
    # What a weighed platform leaves of the common factor is larger than what is left of the ratio
    # of two gains.
    assert (
        correlation_matrix(result.covariance)[
            NAMES.index("joint_pid.lp"), NAMES.index("joint_pid.li")
        ]
        > 0.99
    )


@pytest.mark.slow
def test_a_result_shows_itself_in_a_line_as_a_table_and_as_a_file_of_parameters(ensemble, tmp_path):
    result = ensemble[1]
    assert repr(result).startswith(
        f"<IdentificationResult: {result.identifiable.sum()} of 67 parameters and "
    )
    assert repr(result).endswith(", 0 warnings>")
    frame = result.to_dataframe()
    assert list(frame.columns) == [
        "unit",
        "initial",
        "estimate",
        "std",
        "low",
        "high",
        "identifiable",
    ]
    assert (len(frame), frame.index.name) == (67, "parameter")
    assert (
        frame.loc["joint_pid.lp", "low"]
        < frame.loc["joint_pid.lp", "estimate"]
        < frame.loc["joint_pid.lp", "high"]
    )
    result.save(tmp_path / "mine.json")
    read = choose_parameters(rss6(), str(tmp_path / "mine.json"))
    np.testing.assert_array_equal(read.values, result.estimate[:64])


@pytest.mark.slow
def test_a_record_that_hardly_moves_is_called_poorly_conditioned(scenario, ensemble):
    """A motion of 1 mm and 4 mrad leaves too little beside the sensor's noise; the scenario's
    motion does not warn.
    """
    plain = ensemble[0]
    assert plain.conditioning.poses_alone < POOR
    few = scenario.with_overrides({"identification.max_iterations": 5})
    little = identify(run_plant(scenario, seed=1, size=0.1, duration_s=5.0)[0], rss6(), few)
    assert little.conditioning.poses_alone > POOR
    assert little.conditioning.unshown > plain.conditioning.unshown
    assert any("poorly conditioned" in warning for warning in little.warnings)
    assert little.groups.identifiable.sum() < plain.groups.identifiable.sum()


@pytest.fixture(scope="module")
def driven(record):
    """The scenario with a search by the logged commands, which is quicker, and what it finds in the
    record.
    """
    scenario = quick(**{"identification.method": "command_driven"})
    return scenario, identify(record, rss6(), scenario)


@pytest.mark.slow
def test_the_command_driven_model_explains_the_noise_fully_and_scales_with_the_anchor_and_no_plant_is_read(
    record, driven
):
    """It follows what the servo made of the noise. Poses leave a common factor free: an anchor 10 %
    higher gives all friction and gains 10 % higher. Truth may not leak: another plant changes
    nothing."""
    scenario, one = driven
    assert abs(one.noise_ratio - 1) < 5 * np.sqrt(2 / (6 * 600))
    assert_near_the_truth(one, 3.5)
    raised = record.assign_attrs(scale_anchor_value=1.1 * record.attrs["scale_anchor_value"])
    ratio = (identify(raised, rss6(), scenario).estimate / one.estimate)[FRICTION_AND_PID]
    assert np.allclose(ratio, 1.1, rtol=0.03), ratio
    other = scenario.with_overrides({"plant.parameters": "guess", "plant.steps_per_frame": 1})
    assert np.array_equal(identify(record, rss6(), other).estimate, one.estimate)


@pytest.mark.slow
def test_two_records_tell_more_than_one(record, driven):
    """Another run of the same length adds its information: halved variance where both show a
    parameter equally.
    """
    scenario, one = driven
    both = identify([record, run_plant(scenario, seed=2, trajectory_seed=2)[0]], rss6(), scenario)
    viscous = [i for i, name in enumerate(NAMES) if name.endswith(".viscous")]
    ratio = both.std[viscous] / one.std[viscous]
    assert np.all(ratio < 1.05), ratio
    assert np.exp(np.log(ratio).mean()) < 0.85, ratio
    assert_near_the_truth(both, 3.5)


@pytest.mark.slow
def test_the_search_is_not_caught_by_the_stick_slip_minimum_near_the_warm_start(scenario):
    """From this record's warm start the closed-loop cost alone stalls at 1.33 times the noise."""
    record, _ = run_plant(scenario, seed=10, trajectory_seed=2)
    assert identify(record, rss6(), scenario).noise_ratio < 1.1


@pytest.mark.slow
def test_the_model_is_the_closed_loop_itself_and_the_gradient_of_the_whole_cost_is_that_of_finite_differences(
    scenario, record
):
    """Of poses, starting guess and anchor together, off the optimum."""
    run = identified_model(record, side_of(scenario))
    loop = simulate_servo(rss6(), truth(), run.reference, side_of(scenario).settings)
    assert np.array_equal(run.simulate(truth()).pose, loop.pose)
    whole = problem_of([record], scenario)
    at = 1.01 * truth()
    for problem in (whole, whole.driven_by_commands()):
        gradient = estimate_uncertainty(problem, at, np.random.default_rng(0)).gradient
        for name in ("platform.mass", "platform.Ixx", "joint2.viscous", "joint_pid.ld"):
            index = NAMES.index(name)
            step = 1e-4 * truth() * (np.arange(67) == index)
            slope = (problem.cost(at + step) - problem.cost(at - step)) / (2 * step[index])
            assert 2 * gradient[index] == pytest.approx(slope, rel=5e-3), name


def test_a_long_loss_is_flagged(scenario):
    record, _ = run_plant(scenario, seed=1, lost=range(200, 245))
    assert (
        "45 frames in a row were lost from t = 3.33 s"
        in identified_model(record, side_of(scenario)).warnings()[0]
    )
    assert (
        identified_model(run_plant(scenario, seed=1, lost=[7, 9])[0], side_of(scenario)).warnings()
        == ()
    )


def loaded(scenario, seed):
    """A record of the bare robot, and one with the scenario's known load on the platform."""
    load, duration = (
        drawn_load(LAYOUT, scenario.payload, np.random.default_rng(0)).stated,
        scenario.excitation.duration_s,
    )
    bare, _ = run_plant(scenario, seed=seed, duration_s=duration)
    heavy, _ = run_plant(scenario, seed=seed + 1000, parameters=truth() + load, duration_s=duration)
    for record in (bare, heavy):
        store_anchor(record, ScaleAnchor("payload"))
    store_payload(heavy, LAYOUT, load)
    return [bare, heavy]


@pytest.mark.slow
def test_a_known_payload_shows_the_scale(scenario):
    result = identify(loaded(scenario, seed=1), rss6(), scenario)
    ratio = (result.estimate / truth())[FRICTION_AND_PID]
    assert abs(np.median(ratio) - 1) < 0.02, ratio
    assert np.median((result.std / truth())[FRICTION_AND_PID]) < 0.05
    assert_near_the_truth(result, 3.5)


@pytest.mark.thorough
def test_the_payload_recovers_the_scale_of_the_papers_experiment():
    """The common factor of all parameters, exactly known load: within 0.5 % (design: to <=
    0.5 %)."""
    paper = load_scenario("paper").with_overrides({"identification.scale_anchor": "payload"})
    scales = []
    for seed in (1, 2):
        result = identify(loaded(paper, seed), rss6(), paper)
        ratio = (result.estimate / truth())[FRICTION_AND_PID]
        weight = (truth() / result.std)[FRICTION_AND_PID] ** 2
        scales.append(np.sum(weight * ratio) / np.sum(weight))
    assert np.all(np.abs(np.array(scales) - 1) < 0.005), scales


def test_the_payload_anchor_needs_two_loads(scenario):
    records = loaded(scenario, seed=1)
    with pytest.raises(EstimationError, match=r"1 records all have the same load"):
        identify(records[:1], rss6(), scenario)


def test_normalised_squared_error_is_one_for_errors_of_the_stated_covariance():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    errors = rng.normal(size=(4000, 6)) @ root.T
    chart, covariance = rss6().geometry.chart, np.broadcast_to(root @ root.T, (4000, 6, 6))
    prediction = PosePrediction(chart, np.zeros((4000, 6)), covariance)
    assert prediction.normalised_squared_error(errors) == pytest.approx(
        1.0, abs=5 * np.sqrt(2 / 24000)
    )
    assert prediction.normalised_squared_error(2 * errors) == pytest.approx(4.0, rel=0.05)
    np.testing.assert_allclose(prediction.std[7], np.sqrt(np.diag(root @ root.T)))


def test_the_normalised_squared_error_counts_only_directions_in_which_the_platform_moves():
    """As while four of six joints stick. Coordinates have units of their own: some are small."""
    rng = np.random.default_rng(1)
    root = 1e-7 * rng.normal(size=(6, 2)) * np.logspace(0, 2, 6)[:, None]
    draws = rng.normal(size=(300, 2))
    covariance = np.broadcast_to(root @ root.T, (300, 6, 6)).copy()
    covariance[:100] = 0.0  # at rest
    draws[:100] = 0.0
    prediction = PosePrediction(rss6().geometry.chart, np.zeros((300, 6)), covariance)
    assert prediction.normalised_squared_error(draws @ root.T) == pytest.approx(
        np.mean(draws[100:] ** 2), rel=1e-6
    )


def test_where_nothing_can_be_predicted_nothing_is_said():
    """Too many frames lost to know the sensor's noise; and a model whose loop is unstable: the
    starting guess, which has no friction, at 29 Hz with a frame of latency."""
    slow = quick(sensor="ctrack780_29hz")
    unstable, known = rss6().parameter_sets["guess"].vector, np.zeros((67, 67))
    dark, plant = run_plant(quick(), 0, duration_s=2.0, lost=range(80))
    good, plant_29hz = run_plant(slow, 0, duration_s=8.0)
    with pytest.raises(LoopFailure, match="the loop is unstable"):
        identified_model(good, side_of(slow)).simulate(unstable)
    for scenario, record, parameters, true in (
        (quick(), dark, truth(), plant),
        (slow, good, unstable, plant_29hz),
    ):
        (prediction,) = predicted_runs(
            side_of(scenario), [record], parameters, known, 0, SilentProgress()
        )
        assert prediction.std.shape == (record.sizes["time"], 6)
        assert np.isnan(prediction.std).all()
        figures = prediction_entry(prediction, truth_of(true))["predicted"]
        assert np.isnan(figures["normalised_squared_error"])


def test_a_motion_too_short_to_identify_from_can_be_predicted_and_what_cannot_be_asked_is_an_error():
    """With exactly known parameters what remains is what the servo lets through of the sensor's
    noise. Another servo or parameters of no model are errors, as everywhere else."""
    record, plant = run_plant(quick(), 0, duration_s=0.5)

    def predicted(record, parameters, **scenario):
        return predicted_runs(
            side_of(quick(**scenario)),
            [record],
            parameters,
            np.zeros((67, 67)),
            0,
            SilentProgress(),
        )

    (prediction,) = predicted(record, truth())
    np.testing.assert_allclose(prediction.poses[0], plant.pose[0])
    assert np.all((prediction.std > 0) & (prediction.std < SIGMA))
    with pytest.raises(
        EstimationError, match=r"made with servo.kp = 0.3, but the scenario has 0.2"
    ):
        predicted(record, truth(), **{"servo.kp": 0.2})
    with pytest.raises(ParameterError, match=r"platform.mass = -23.5 kg is not allowed"):
        predicted(record, -truth())
