"""Batches of runs and the fast forward dynamics give what the plain calls give."""

import numpy as np
import pytest

from dynamics import simulate_batch
from dynamics.closed_loop import simulate
from dynamics.errors import SimulationError, SingularPoseError
from dynamics.robot import fast_forward_dynamics


@pytest.mark.parametrize("workers", [1, 3])
def test_a_batch_is_its_runs(robot, identified, make_reference, make_settings, workers):
    settings, reference = make_settings(), make_reference(30)
    vectors = identified * np.linspace(0.95, 1.05, 5)[:, None] ** np.arange(67)[None, :].clip(0, 1)
    runs = simulate_batch(robot, vectors, reference, settings, sensitivities=True, workers=workers)
    for vector, run in zip(vectors, runs, strict=True):
        alone = simulate(robot, vector, reference, settings, sensitivities=True)
        assert np.array_equal(run.pose, alone.pose)
        assert np.array_equal(run.pose_sensitivity, alone.pose_sensitivity)


def test_one_vector_serves_many_references(robot, identified, make_reference, make_settings):
    references = [make_reference(20, scale=scale) for scale in (0.5, 1.0)]
    runs = simulate_batch(robot, identified, references, make_settings())
    assert np.array_equal(runs[1].pose, simulate(robot, identified, references[1], make_settings()).pose)
    assert not np.array_equal(runs[0].pose, runs[1].pose)


def test_lengths_that_do_not_pair_up_are_refused(robot, identified, make_reference, make_settings):
    with pytest.raises(SimulationError, match="3 parameter vectors and 2 references"):
        simulate_batch(robot, np.tile(identified, (3, 1)), [make_reference(20)] * 2, make_settings())


def test_fast_forward_dynamics_is_the_robots(robot, identified):
    rng = np.random.default_rng(0)
    fast = fast_forward_dynamics(robot, identified[:64])
    for _ in range(20):
        pose = robot.home_pose + rng.uniform(-1, 1, 6) * np.repeat([0.01, 0.04], 3)
        twist, torque = rng.standard_normal((2, 6))
        expected = robot.forward_dynamics(pose, twist, torque, identified[:64])
        assert np.array_equal(fast(pose, twist, torque), expected)


def test_fast_forward_dynamics_never_returns_nan(robot):
    fast = fast_forward_dynamics(robot)
    far = robot.home_pose + np.array([0, 0, 0.5, 0, 0, 0])
    with pytest.raises(SingularPoseError, match="not finite at pose"):
        fast(far, np.zeros(6), np.zeros(6))
    with pytest.raises(SingularPoseError):
        fast(robot.home_pose, np.array([0, 0, np.nan, 0, 0, 0]), np.zeros(6))
