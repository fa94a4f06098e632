"""The estimator against known truth, on records with drawn noise (images are in test_experiment)."""

import numpy as np
import pytest

from dynamics.closed_loop import equilibrium, simulate
from identify.errors import EstimationError, RecordError
from identify.estimation.covariance import estimate_uncertainty
from identify.estimation.identification import identify, output_error_problem
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.estimation.warm_start import linear_warm_start, regression_columns
from identify.experiment.plant import build_plant, drawn_load
from identify.loop_parameters import NAMES, model_settings
from identify.record.payload import store_payload
from identify.record.recorded_run import recorded_run
from identify.scenario import load_scenario
from tests.identify.synthetic import quick, rss6, run_plant, truth

FRICTION_AND_PID = [i for i, name in enumerate(NAMES) if name.startswith("joint")]


@pytest.fixture(scope="module")
def scenario():
    return quick()


@pytest.fixture(scope="module")
def noisy(scenario):
    record, _ = run_plant(scenario, seed=1)
    return record, identify(record, rss6(), scenario)


def unseen_error(scenario, parameters, seed=7):
    """RMS (6,) of a model against the noise-free plant on a trajectory it has not seen."""
    record, run = run_plant(scenario, seed=0, sigma=np.zeros(6), trajectory_seed=seed)
    problem = output_error_problem([record], rss6(), scenario)
    return np.sqrt(np.mean((problem.runs[0].model_poses(parameters) - run.pose) ** 2, axis=0))


def test_warm_start_equation_holds_for_the_true_parameters(scenario):
    """Without dry friction the regression times the truth vanishes against the torques in it."""
    parameters = truth()
    parameters[52:58] = 0
    _, run = run_plant(scenario, 0, np.zeros(6), parameters=parameters)
    columns = regression_columns(rss6(), run.pose, run.command, scenario)
    start = equilibrium(rss6(), parameters, run.pose[0], build_plant(scenario, rss6()).settings.servo)
    unknowns = np.concatenate([parameters, start.joint_integral * parameters[65]])
    balance = columns @ unknowns
    assert np.sqrt(np.mean(balance**2)) < 1e-3 * np.sqrt(np.mean((columns[:, 64:67] @ parameters[64:]) ** 2))


def test_warm_start_is_ten_times_closer_than_the_starting_guess(scenario):
    record, _ = run_plant(scenario, seed=1)
    problem = output_error_problem([record], rss6(), scenario)
    warm = linear_warm_start(problem, scenario)
    before, after = unseen_error(scenario, problem.guess.values), unseen_error(scenario, warm)
    assert np.all(after < before / 10), (before, after)


def test_friction_and_gains_are_within_three_standard_deviations(noisy):
    _, result = noisy
    deviation = (result.estimate - truth())[FRICTION_AND_PID] / result.std[FRICTION_AND_PID]
    assert np.all(np.abs(deviation) < 3), dict(zip(np.array(NAMES)[FRICTION_AND_PID], deviation, strict=True))
    assert np.all(result.identifiable[FRICTION_AND_PID])


def test_unseen_motion_is_predicted_to_micrometres(scenario, noisy):
    _, result = noisy
    error = unseen_error(scenario, result.estimate)
    assert np.all(error[:3] < 3e-6), error
    assert np.all(error[3:] < 15e-6), error


def test_groups_are_known_where_their_members_are_not(noisy):
    """The intervals of the identified groups hold the truth, and there are more of them than of lone parameters."""
    _, result = noisy
    groups = result.groups
    true = groups.combinations @ truth()[:64]
    known = groups.identifiable
    assert known.sum() >= 20
    assert known.sum() > result.identifiable[:64].sum()
    assert np.all(np.abs((groups.estimate - true)[known]) < 4 * groups.std[known])
    crank = groups.names.index("crank5.Izz +")
    assert groups.identifiable[crank]
    assert not result.identifiable[NAMES.index("crank5.mass")]


def test_what_leaves_no_trace_is_not_called_identified(noisy):
    """Crank Ixx, Iyy and link Izz do no work (design of the robot), so no record can tell them."""
    _, result = noisy
    for name in ("crank1.Ixx", "crank4.Iyy", "link2.Izz"):
        index = NAMES.index(name)
        assert not result.identifiable[index]
        assert result.estimate[index] == pytest.approx(result.initial[index], rel=1e-6)


def test_noise_is_explained(noisy):
    """Residuals are the sensor's noise, and what the servo made of it: as the repeated experiments predict."""
    _, result = noisy
    assert 0.9 < result.noise_ratio < 1.2
    assert result.noise_ratio == pytest.approx(result.expected_noise_ratio, abs=0.1)
    assert result.warnings == ()
    assert not result.whiteness.suspicious


def test_a_misfit_that_noise_does_not_explain_is_said(scenario):
    """A plant with smoothed friction is not what the model believes: the residuals tell."""
    other = quick(**{"plant.friction": "smoothed", "plant.smoothing_velocity_rad_s": 0.01, "plant.steps_per_frame": 16})
    record, _ = run_plant(other, seed=1)
    result = identify(record, rss6(), scenario.with_overrides({"identification.max_iterations": 4}))
    assert "noise alone" in result.warnings[0]
    assert "not white" in result.warnings[1]
    assert result.whiteness.p_value < 1e-10


def test_the_command_driven_model_explains_the_noise_fully(scenario):
    """Driven by the logged commands, the model follows what the servo made of the noise: residuals are white."""
    driven = scenario.with_overrides({"identification.method": "command_driven"})
    record, _ = run_plant(driven, seed=1)
    result = identify(record, rss6(), driven)
    count = 6 * 600
    assert abs(result.noise_ratio - 1) < 5 * np.sqrt(2 / count)
    deviation = (result.estimate - truth())[FRICTION_AND_PID] / result.std[FRICTION_AND_PID]
    assert np.all(np.abs(deviation) < 3.5), deviation


def test_the_scale_follows_the_anchor(scenario):
    """Poses leave a common factor free: an anchor 10 % higher gives all friction and gains 10 % higher."""
    record, _ = run_plant(scenario, seed=1)
    raised = record.copy(deep=True)
    raised.attrs["scale_anchor_value"] *= 1.1
    one, two = identify(record, rss6(), scenario), identify(raised, rss6(), scenario)
    ratio = two.estimate[FRICTION_AND_PID] / one.estimate[FRICTION_AND_PID]
    assert np.allclose(ratio, 1.1, rtol=0.03), ratio


def test_the_plant_section_of_the_scenario_is_not_read(scenario, noisy):
    """Truth may not leak: another plant in the scenario changes nothing in the estimate."""
    record, result = noisy
    other = scenario.with_overrides({"plant.parameters": "initial", "plant.steps_per_frame": 1})
    assert np.array_equal(identify(record, rss6(), other).estimate, result.estimate)


def test_lost_frames_are_left_out_and_do_not_spoil_the_estimate(scenario):
    lost = set(range(200, 215)) | {300, 420}
    record, _ = run_plant(scenario, seed=2, lost=lost)
    result = identify(record, rss6(), scenario)
    error = unseen_error(scenario, result.estimate)
    assert np.all(error[:3] < 5e-6), error
    assert np.all(error[3:] < 25e-6), error


def test_the_search_is_not_caught_by_the_stick_slip_minimum_near_the_warm_start(scenario):
    """From this record's warm start the closed-loop cost alone stalls at 1.33 times the noise."""
    record, _ = run_plant(scenario, seed=10, trajectory_seed=2)
    assert identify(record, rss6(), scenario).noise_ratio < 1.1


def test_sensitivities_in_the_residuals_match_finite_differences(scenario):
    record, _ = run_plant(scenario, seed=1)
    problem = recorded_run(record, rss6(), scenario)
    _, jacobian = problem.residuals(truth())
    for name in ("platform.Ixx", "joint2.viscous", "joint_pid.ld"):
        index = NAMES.index(name)
        step = np.zeros(67)
        step[index] = 1e-5 * truth()[index]
        difference = problem.model_poses(truth() + step) - problem.model_poses(truth() - step)
        expected = problem.whiten(difference) / (2 * step[index])
        assert np.abs(jacobian[:, :, index] - expected).max() < 2e-3 * np.abs(expected).max(), name


def test_the_gradient_of_the_whole_cost_matches_finite_differences(scenario):
    """Of poses, starting guess and anchor together, off the optimum."""
    record, _ = run_plant(scenario, seed=1)
    problem = output_error_problem([record], rss6(), scenario).driven_by_commands()
    at = 1.01 * truth()
    gradient = estimate_uncertainty(problem, at, np.random.default_rng(0)).gradient
    for name in ("platform.mass", "platform.Ixx", "joint2.viscous", "joint_pid.ld"):
        index = NAMES.index(name)
        step = np.zeros(67)
        step[index] = 1e-4 * truth()[index]
        slope = (problem.cost(at + step) - problem.cost(at - step)) / (2 * step[index])
        assert 2 * gradient[index] == pytest.approx(slope, rel=5e-3), name


def test_records_that_do_not_fit_are_refused(scenario):
    record, _ = run_plant(scenario, seed=1)
    with pytest.raises(EstimationError, match=r"other.*rss6"):
        identify(record.assign_attrs(robot="other"), rss6(), scenario)
    with pytest.raises(EstimationError, match=r"timing.frame_rate_hz = 60.0, the scenario says 30.0"):
        identify(record, rss6(), quick(**{"timing.frame_rate_hz": 30.0}))
    with pytest.raises(EstimationError, match=r"servo.kp = 0.3, the scenario says 0.4"):
        identify(record, rss6(), quick(**{"servo.kp": 0.4}))
    without = record.copy()
    del without.attrs["scale_anchor"]
    with pytest.raises(RecordError, match=r"no scale anchor.*platform_mass"):
        identify(without, rss6(), scenario)
    dark = record.copy(deep=True)
    dark["measured_ok"][:400] = 0
    with pytest.raises(EstimationError, match="200 of 600 frames"):
        identify(dark, rss6(), scenario)


def test_simulate_agrees_with_the_model_of_the_problem(scenario):
    """The estimator's model is the closed loop itself with the ideal sensor, nothing else."""
    record, _ = run_plant(scenario, seed=1)
    recorded = recorded_run(record, rss6(), scenario)
    run = simulate(rss6(), truth(), recorded.reference, model_settings(scenario))
    assert np.array_equal(recorded.model_poses(truth()), run.pose)


def loaded(scenario, seed):
    """A record of the bare robot, and one with the scenario's known load on the platform."""
    load, duration = drawn_load(scenario, np.random.default_rng(0)).stated, scenario.excitation.duration_s
    bare, _ = run_plant(scenario, seed=seed, duration_s=duration)
    heavy, _ = run_plant(scenario, seed=seed + 1000, parameters=truth() + load, duration_s=duration)
    for record in (bare, heavy):
        store_anchor(record, ScaleAnchor("payload"))
    store_payload(heavy, load)
    return [bare, heavy]


def test_a_known_payload_shows_the_scale(scenario):
    """Two runs that differ by a known load identify friction and gains with no weighed platform."""
    result = identify(loaded(scenario, seed=1), rss6(), scenario)
    ratio = (result.estimate / truth())[FRICTION_AND_PID]
    scale, spread = np.median(ratio), np.median((result.std / truth())[FRICTION_AND_PID])
    assert abs(scale - 1) < 0.02, ratio
    assert spread < 0.05
    deviation = (result.estimate - truth())[FRICTION_AND_PID] / result.std[FRICTION_AND_PID]
    assert np.all(np.abs(deviation) < 3.5), deviation


@pytest.mark.slow
def test_the_payload_recovers_the_scale_of_the_papers_experiment():
    """The common factor of all parameters, exactly known load: within 0.5 % (design: to <= 0.5 %)."""
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
    with pytest.raises(EstimationError, match=r"1 records have all the same load"):
        identify(records[:1], rss6(), scenario)
    wrong = records[1].assign_attrs(payload_Ixx=-1.0)
    with pytest.raises(RecordError, match=r"payload_Ixx is -1.0.*kg m2"):
        identify([records[0], wrong], rss6(), scenario)


def test_two_records_tell_more_than_one(scenario):
    """Another run of the same length adds its information: halved variance where both show a parameter equally."""
    records = [run_plant(scenario, seed=seed, trajectory_seed=seed)[0] for seed in (1, 2)]
    one, both = identify(records[0], rss6(), scenario), identify(records, rss6(), scenario)
    viscous = [i for i, name in enumerate(NAMES) if name.endswith(".viscous")]
    ratio = both.std[viscous] / one.std[viscous]
    assert np.all(ratio < 1.05), ratio
    assert np.exp(np.log(ratio).mean()) < 0.85, ratio
    deviation = (both.estimate - truth())[FRICTION_AND_PID] / both.std[FRICTION_AND_PID]
    assert np.all(np.abs(deviation) < 3.5), deviation


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r: r.isel(time=slice(0, 30)), r"30 frames .*at least .* are needed"),
        (lambda r: r.drop_isel(time=range(100, 110)), r"frames 99 and 100 are 11.000 periods"),
        (lambda r: r.assign(command=r["command"] * np.where(np.arange(6) == 2, 0, 1)), r"command of joint 3 is 0 in"),
        (lambda r: r.assign(measured_position=r["measured_position"] * 0 + 1), r"x is 1 in every frame"),
        (lambda r: r.assign(command=r["command"].where(r["time"] != r["time"][50])), r"joint 1 is not finite in 1 f"),
        (lambda r: r.assign(measured_covariance=r["measured_covariance"] * 0), r"not positive definite"),
    ],
    ids=["short", "gap in time", "dead command", "constant pose", "NaN", "covariance"],
)
def test_records_that_cannot_carry_an_identification_are_named(scenario, spoil, says):
    record, _ = run_plant(scenario, seed=1)
    with pytest.raises(EstimationError, match=says):
        recorded_run(spoil(record), rss6(), scenario)


def test_a_long_loss_is_flagged(scenario):
    record, _ = run_plant(scenario, seed=1, lost=range(200, 245))
    assert "45 frames in a row were lost from t = 3.33 s" in recorded_run(record, rss6(), scenario).warnings()[0]
    assert recorded_run(run_plant(scenario, seed=1, lost=[7, 9])[0], rss6(), scenario).warnings() == ()
