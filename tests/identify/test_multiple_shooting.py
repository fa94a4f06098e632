"""Multiple shooting: the segments of the right model make up its run, and a model that does not run is brought to."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dynamics import DynamicsError
from identify.errors import EstimationError
from identify.estimation.identification import output_error_problem
from identify.estimation.multiple_shooting import STATES, MultipleShooting, end_state, measured_states, segments
from identify.estimation.output_error_search import output_error_searches, runnable_start, search, shoot
from identify.estimation.prior import StartingGuess
from identify.progress import SilentProgress
from tests.identify.synthetic import SIGMA, Stages, quick, rss6, run_plant, silent, truth

SMOOTHED = {
    f"{side}.{key}": value
    for side in ("plant", "model")
    for key, value in (("friction", "smoothed"), ("smoothing_velocity_rad_s", 0.05))
}


def recorded(duration_s, changes=None, **how):
    scenario = quick(**{"plant.steps_per_frame": 4} | (changes or {}))
    record, run = run_plant(scenario, seed=1, duration_s=duration_s, **how)
    return scenario, output_error_problem([record], rss6(), scenario).driven_by_commands(), run


def states_of(run):
    return np.hstack([run.pose, run.pose_rate, run.joint_integral])


def test_segments_from_the_true_states_make_up_the_run():
    """Poses within segments and states at their ends are those of one uninterrupted run."""
    _, problem, run = recorded(3.0, sigma=1e-3 * SIGMA)
    chain, true = segments(problem.runs[0]), states_of(run)
    assert [(part.first, part.last) for part in chain] == list(pairwise([0, 30, 60, 90, 119, 149, 179]))
    for part in chain:
        one = part.simulate(truth(), true[part.first])
        assert np.allclose(one.pose, run.pose[part.first : part.last + 1], rtol=0, atol=1e-12)
        assert np.allclose(end_state(one), true[part.last], rtol=0, atol=1e-9)


def test_states_are_measured_to_what_the_filter_leaves():
    """Poses to the sensor's noise, and the integral of the joint PID to 2 mrad s of the 0.2 that hold the robot."""
    scenario, problem, run = recorded(5.0)
    chain = segments(problem.runs[0])
    states = measured_states(chain, truth(), scenario)
    error = np.abs(states - states_of(run)[[part.first for part in chain]])[1:]
    assert np.all(error[:, :6] < 5 * SIGMA)
    assert np.all(error[:, 6:12] < 0.1 * np.abs(run.pose_rate).max(axis=0))
    assert np.all(error[:, 12:] < 2e-3)


def residuals(shooting, parameters, states):
    """All residuals of the problem with the states as unknowns, one after the other."""
    known, _ = shooting.problem.known(parameters)
    rows, chain = [known], shooting.chains[0]
    for k, part in enumerate(chain):
        run = part.simulate(parameters, states[k])
        rows.append(part.whitened(run.pose - part.measured))
        if not part.ends_the_run:
            rows.append((end_state(run) - states[k + 1]) / part.state_std)
    return np.concatenate(rows)


def distance(found, expected, scale):
    """Of two vectors, as a share of the second, in units of `scale`."""
    return np.linalg.norm((found - expected) / scale) / np.linalg.norm(expected / scale)


@pytest.mark.slow
def test_condensing_takes_the_step_of_the_whole_problem():
    """Against a dense Gauss-Newton step in parameters and states, its Jacobian by finite differences. The friction is
    smoothed, so that no event stands between two of them, and the guess exact enough to tell all parameters apart."""
    scenario, problem, _ = recorded(2.0, SMOOTHED, lost=[30, 47])
    problem = replace(problem, guess=StartingGuess(truth(), 0.02 * truth()))
    start = truth() * np.random.default_rng(0).uniform(0.95, 1.05, 67)
    chain = segments(problem.runs[0])
    shooting = MultipleShooting(problem, [chain], [measured_states(chain, start, scenario)])
    states, inner = shooting.states[0].copy(), slice(1, None)
    size, count = len(start), states[inner].size

    def of(unknowns):
        moved = states.copy()
        moved[inner] = unknowns[size:].reshape(-1, STATES)
        return residuals(shooting, unknowns[:size], moved)

    at = np.concatenate([start, states[inner].ravel()])
    steps = np.concatenate([1e-3 * start, np.tile(np.repeat([1e-6, 1e-5, 1e-6], 6), count // STATES)])
    jacobian = np.column_stack([(of(at + h) - of(at - h)) / (2 * h.sum()) for h in np.diag(steps)])
    expected = -np.linalg.lstsq(jacobian * steps, of(at), rcond=None)[0] * steps
    cost, factor, residual = shooting.linearise(start)
    assert cost == pytest.approx(np.sum(of(at) ** 2), rel=1e-9)
    step = -np.linalg.solve(factor, residual)
    assert distance(step, expected[:size], problem.guess.std) < 3e-3
    shooting.linearise(start + step)
    moved = (shooting.states[0][inner] - states[inner]).ravel()
    scale = np.tile(chain[0].state_std, count // STATES)
    assert distance(moved, expected[size:], scale) < 3e-3


@pytest.mark.slow
def test_a_model_that_does_not_run_is_brought_to_the_optimum():
    """No friction and gains far off make an unstable loop: no search can start there, and no warm start is at hand.
    Segment by segment the model runs, and it ends where the search from the truth does."""
    scenario = quick()
    record, _ = run_plant(scenario, seed=1)
    problem = output_error_problem([record], rss6(), scenario)
    unstable = problem.guess.values.copy()
    unstable[64:] = [10.0, 24.0, 0.02]
    problem = replace(problem, guess=replace(problem.guess, values=unstable))
    driven = problem.driven_by_commands()
    with pytest.raises(DynamicsError, match="unstable"):
        search(driven, unstable, scenario, silent)
    assert runnable_start(driven, unstable) is None
    progress = Stages()
    found = output_error_searches(problem, scenario, unstable, progress)
    assert [name for name, _, _ in progress.seen] == ["multiple shooting", "identify"]
    assert all(sum(steps) == total for _, total, steps in progress.seen)
    assert progress.seen[0][2][: found["multiple_shooting"].iterations] == [1] * found["multiple_shooting"].iterations
    assert list(found) == ["multiple_shooting", "command_driven", "closed_loop"]
    for name, judged in (("command_driven", driven), ("closed_loop", problem)):
        from_truth = search(judged, truth(), scenario, silent)
        assert found[name].costs[-1] < from_truth.costs[-1] + 0.1


def test_a_model_that_no_segment_bears_is_named():
    scenario, problem, _ = recorded(2.0)
    wild = truth().copy()
    wild[64:] *= [1e4, 1e4, 1e-4]
    hopeless = replace(problem, guess=replace(problem.guess, values=wild))
    with pytest.raises(EstimationError, match=r"nor does multiple shooting.*frame"):
        shoot(hopeless, scenario, wild, SilentProgress())
