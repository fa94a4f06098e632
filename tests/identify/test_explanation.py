"""Whether the model explains its record: misfits told from chance and brought into the intervals,
and whiteness.
"""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from dynamics import Robot
from dynamics.closed_loop import FrameTiming, LoopSettings, ServoGains
from dynamics.parameter_set import ParameterSet
from dynamics.parameters import LANES
from dynamics.robot_file import RobotDescription
from dynamics.robot_lengths import robot_of_lengths
from identify.errors import EstimationError
from identify.estimation.covariance import DRAWS, estimate_uncertainty
from identify.estimation.explanation import (
    Misfit,
    coloured_score_covariance,
    misfit_of_white,
    whiteness,
)
from identify.estimation.identification import identify
from identify.record.stored_common_errors import NONE
from identify.setup import Setup
from tests.identify.synthetic import problem_of, quick, rss6, run_plant


def noise(rng, frames=600, memory=0.0):
    """Six residuals of variance one that follow each other with the correlation `memory` (an AR(1)
    process).
    """
    rows = np.empty((frames, 6))
    rows[0] = rng.standard_normal(6)
    for k in range(1, frames):
        rows[k] = memory * rows[k - 1] + np.sqrt(1 - memory**2) * rng.standard_normal(6)
    return rows


def test_it_is_the_double_sum_over_the_frames_with_gaps_left_out():
    rng = np.random.default_rng(0)
    ok = rng.random(41) > 0.1
    residuals, jacobian = rng.standard_normal((ok.sum(), 6)), rng.standard_normal((ok.sum(), 6, 3))
    rows, slopes = np.zeros((41, 6)), np.zeros((41, 6, 3))
    rows[ok], slopes[ok] = residuals, jacobian
    total = np.zeros((3, 3))
    for i in range(41):
        for j in range(41):
            first, second = max(i - j, 0), max(j - i, 0)
            pairs = rows[first : 41 - second].T @ rows[second : 41 - first] / ok.sum()
            total += max(1 - abs(i - j) / (0.2 * 41), 0) * slopes[i].T @ pairs @ slopes[j]
    np.testing.assert_allclose(
        coloured_score_covariance(residuals, jacobian, ok), total, rtol=1e-9, atol=1e-9
    )


@pytest.mark.slow
def test_scores_of_lasting_residuals_spread_as_it_says_and_four_times_as_far_as_white_ones():
    """The spread of drawn scores is the oracle. Fading correlations lack a part that grows with
    their length.
    """
    rng, frames = np.random.default_rng(1), 600
    ok = np.ones(frames, dtype=bool)
    wave = np.sin(2 * np.pi * np.arange(frames) / 200)[:, None, None] * rng.standard_normal((6, 1))
    drawn = [noise(rng, frames, memory=0.9) for _ in range(300)]
    spread = np.std([np.tensordot(r, wave, 2)[0] for r in drawn])
    said = np.sqrt(np.mean([coloured_score_covariance(r, wave, ok)[0, 0] for r in drawn]))
    white = np.sqrt(np.sum(wave**2))
    assert spread > 3.5 * white
    assert 0.85 * spread < said < 1.05 * spread


def test_of_chance_nothing_is_the_models_a_large_misfit_decides_and_a_small_one_blames_the_covariance():
    """One in a thousand of right models is above the limit; what is above belongs to the model only
    from there on.
    """
    inside, outside = Misfit(1.1, 1.0, 0.0325), Misfit(1.1, 1.0, 0.0320)
    assert (inside.significant, inside.share_of_model, inside.warnings()) == (False, 0.0, ())
    assert outside.share_of_model == pytest.approx(1 / 11)
    assert "intervals are widened" in outside.warnings()[0]
    rng = np.random.default_rng(2)
    assert sum(misfit_of_white(rng.standard_normal((60, 6))).significant for _ in range(2000)) <= 10
    assert Misfit(3.3, 1.05, 0.02).decides
    assert not Misfit(3.1, 1.05, 0.02).decides
    assert "nothing counts as identified" in Misfit(3.3, 1.05, 0.02).warnings()[0]
    assert "too large, and so are the intervals" in Misfit(0.8, 1.0, 0.03).warnings()[0]
    assert not Misfit(0.8, 1.0, 0.03).significant


def test_of_information_that_no_computer_inverts_the_variances_are_right_and_positive_whatever_the_misfit():
    """A linear problem J = U diag(s) V^T whose guess is known to one in each direction; its
    information spans 20 orders of magnitude. A direction that only the guess shows is known as well
    as that says; no residual takes from that."""
    rng, frames, size = np.random.default_rng(0), 40, 12
    singular = np.logspace(10, -2, size)
    left, right = (
        np.linalg.qr(rng.standard_normal((rows, size)))[0] for rows in (6 * frames, size)
    )
    jacobian, noise = (
        (left * singular @ right.T).reshape(frames, 6, size),
        rng.standard_normal((frames, 6)),
    )

    def found(scale):
        run = SimpleNamespace(
            noise_linearised=lambda parameters: (scale * noise, jacobian),
            without_common=lambda rows: rows,
            whitened_modes=np.zeros((frames, 6, 0)),
            common=NONE,
            driven=True,
            ok=np.ones(frames, dtype=bool),
            payload_errors=np.zeros((size, 7)),
        )
        guess = SimpleNamespace(rows=np.eye(size))
        problem = SimpleNamespace(
            runs=(run,), known=lambda parameters: (np.zeros(size), np.eye(size)), guess=guess
        )
        with warnings.catch_warnings(action="error"):
            return estimate_uncertainty(problem, np.zeros(size), np.random.default_rng(0))

    right_model, wrong_model = found(0.9), found(1e3)
    assert not right_model.misfit.significant
    assert np.linalg.cond(right_model.information + np.eye(size)) > 1e15
    np.testing.assert_allclose(
        right_model.covariance, right / (1 + singular**2) @ right.T, rtol=1e-5, atol=1e-7
    )
    assert wrong_model.misfit.decides
    eigenvalues, unseen = np.linalg.eigvalsh(wrong_model.covariance), right[:, singular < 0.1]
    assert eigenvalues[0] > -1e-9 * eigenvalues[-1]
    assert np.all(np.diag(unseen.T @ wrong_model.covariance @ unseen) > 0.98)
    assert np.all(np.diag(wrong_model.covariance) > 0)


@pytest.mark.parametrize("model_error", [0.0, 10.0])
def test_a_residual_far_above_white_noise_is_judged_by_what_the_servo_makes_of_noise(model_error):
    """A servo that doubles the noise leaves four times its variance. A few repeated experiments
    tell that a residual of 104 times the variance is none of it.
    """
    rng, frames, asked = np.random.default_rng(0), 400, []
    missed = 2 * rng.standard_normal((frames, 6)) + model_error

    def simulate_repeats(parameters, noises):
        asked.append(len(noises))
        return [SimpleNamespace(measured=2 * noise) for noise in noises]

    run = SimpleNamespace(
        noise_linearised=lambda parameters: (missed, rng.standard_normal((frames, 6, 2))),
        without_common=lambda rows: rows,
        whiten=lambda rows: rows,
        whitened_modes=np.zeros((frames, 6, 0)),
        common=NONE,
        covariance=np.eye(6),
        measured=-missed,
        simulate_repeats=simulate_repeats,
        driven=False,
        ok=np.ones(frames, dtype=bool),
        payload_errors=np.zeros((2, 7)),
    )
    guess = SimpleNamespace(rows=np.eye(2))
    problem = SimpleNamespace(
        runs=(run,), known=lambda parameters: (np.zeros(2), np.eye(2)), guess=guess
    )
    misfit = estimate_uncertainty(problem, np.zeros(2), np.random.default_rng(0)).misfit
    assert misfit.expected == pytest.approx(4.0, rel=0.05)
    assert misfit.decides == misfit.significant == (model_error > 0)
    assert sum(asked) == (LANES if model_error else DRAWS)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(4))
def test_noise_explains_a_stiff_robot_at_29_hz_whose_servo_amplifies_it(seed):
    """A 6-RSS with bodies of the paper, four times its gains and other lengths, and a sensor with
    a latency of one frame. Model and plant are equal.

    The oracle is the plant, which is repeated with noise. Its true motion differs from the one
    without noise by so much that the truth leaves more than three times the noise in a closed loop.
    """
    paper = rss6()
    loops = [
        LoopSettings(ServoGains(0.3, 0.001, 2.4), FrameTiming(rate, latency))
        for rate, latency in ((60.0, 0.0), (29.0, 1 / 29))
    ]
    lengths = {"base_radius": 0.25, "crank": 0.08, "link": 0.25}
    geometry = robot_of_lengths("stiff", paper, lengths, loops)[0].geometry
    sets = {
        name: ParameterSet(values.dynamic, 4 * values.joint_pid)
        for name, values in paper.parameter_sets.items()
    }
    robot = Robot(RobotDescription("stiff", geometry, sets))
    scenario = quick(sensor="ctrack780_29hz", renderer="statistical")
    setup = Setup(scenario, seed, robot)
    record = setup.run()
    run = problem_of([record], scenario, robot).runs[0]
    calm = setup.plant.run(run.reference).pose
    root = np.linalg.cholesky(run.covariance)

    def repeated(draws):
        plant = setup.plant.run(
            run.reference, lambda frame, time, pose: pose + root @ draws.standard_normal(6)
        )
        return np.mean(run.whiten(plant.measured - calm) ** 2)

    squares = [repeated(np.random.default_rng([seed, number])) for number in range(20)]
    assert np.mean(squares) > 3.0
    result = identify(record, robot, scenario)
    assert result.expected_noise_ratio == pytest.approx(np.mean(squares), abs=3 * np.std(squares))
    assert not result.misfit.significant
    assert result.driven_misfit.found == pytest.approx(1.0, abs=4 * result.driven_misfit.std)
    assert not any("explain" in warning for warning in result.warnings)
    own = slice(robot.layout.coulomb.start, None)  # frictions and gains
    assert result.identifiable[own].all()
    errors = ((result.estimate - sets["truth"].vector) / result.std)[own]
    assert chi2.sf(np.sum(errors**2), len(errors)) > 1e-3


def test_frames_marked_as_lost_afterwards_leave_nothing_identified():
    """The servo had them, the model's has not: 20 frames are enough to miss the record by far more
    than the noise.
    """
    record = run_plant(quick(), seed=0, duration_s=3.0)[0]
    record["measured_ok"][90:110] = 0
    result = identify(record, rss6(), quick(**{"identification.max_iterations": 5}))
    assert result.noise_ratio > 10
    assert not result.identifiable.any()
    assert not result.groups.identifiable.any()
    assert "nothing counts as identified" in result.warnings[0]


@pytest.mark.parametrize("lost", [0.0, 0.1], ids=["whole", "one frame in ten lost"])
def test_the_probability_of_white_noise_is_uniform(lost):
    rng = np.random.default_rng(5)
    values = []
    for _ in range(200):
        ok = rng.random(600) >= lost
        residuals = np.where(ok[:, None], rng.standard_normal((600, 6)), np.nan)
        values.append(whiteness(residuals, ok).p_value)
    assert kstest(values, "uniform").pvalue > 1e-3


def test_a_little_memory_is_seen_and_too_few_frames_are_refused():
    """A correlation of 0.2 from frame to frame, in 600 frames of six components."""
    ok = np.ones(600, dtype=bool)
    assert all(
        whiteness(noise(np.random.default_rng(seed), memory=0.2), ok).suspicious
        for seed in range(20)
    )
    found = whiteness(
        noise(np.random.default_rng(3), 20_000, 0.5), np.ones(20_000, dtype=bool)
    ).autocorrelations
    assert np.allclose(found[:, :3], 0.5 ** np.arange(1, 4), atol=0.04)
    with pytest.raises(
        EstimationError, match=r"40 of 40 frames have a good pose.* 100 are needed for 10"
    ):
        whiteness(np.zeros((40, 6)), np.ones(40, dtype=bool))
