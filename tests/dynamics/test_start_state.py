"""Runs from a given state, and their derivatives with respect to it."""

from dataclasses import replace

import numpy as np
import pytest

from dynamics import closed_loop, simulate_batch
from dynamics.errors import SimulationError, UnreachablePoseError

FRAME = 20  # of the reference: there four joints move and two stick
ENTRIES = ("pose", "pose_rate", "joint_integral", "servo_integral")
TIMINGS = {"no delay": {}, "1.3 frames, linear": {"latency_s": 1.3 / 60, "hold": "linear"}}


def _from(reference, frame):
    return closed_loop.Reference(reference.poses[frame:], reference.rates[frame:])


@pytest.fixture(scope="module")
def half_way(robot, identified, make_reference, make_settings):
    """(frames, **settings) -> the rest of a reference, the settings, and the state that a run over it has reached."""

    def make(frames=45, frame=FRAME, **options):
        reference, settings = make_reference(frames), make_settings(**options)
        run = closed_loop.simulate(robot, identified, reference, settings)
        return _from(reference, frame), settings, run.state_at(frame)

    return make


def _moved(start, direction):
    """The start state, moved by a vector of its 24 entries."""
    changes = {name: getattr(start, name) + part for name, part in zip(ENTRIES, np.split(direction, 4), strict=True)}
    return replace(start, **changes)


@pytest.mark.parametrize("frame", [0, 3, FRAME, 33])
@pytest.mark.parametrize("timing", TIMINGS)
def test_a_run_from_the_state_of_another_repeats_its_rest(
    robot, identified, make_reference, make_settings, timing, frame
):
    """Bit by bit: the state is complete. Joints stick at some of these frames, and commands are on their way."""
    reference, settings = make_reference(45), make_settings(**TIMINGS[timing])
    run = closed_loop.simulate(robot, identified, reference, settings)
    rest = closed_loop.simulate(robot, identified, _from(reference, frame), settings, start=run.state_at(frame))
    for name in ("pose", "pose_rate", "torque", "command", "measured", "joint_integral", "servo_integral"):
        np.testing.assert_array_equal(getattr(rest, name), getattr(run, name)[frame:], err_msg=name)


def test_the_default_start_is_the_equilibrium(robot, identified, make_reference, make_settings):
    """Given or not, it is the same start, and the sensitivities contain that it follows the parameters."""
    reference, settings = make_reference(20), make_settings()
    start = closed_loop.equilibrium(robot, identified, reference.poses[0], settings.servo)
    given, default = (
        closed_loop.simulate(robot, identified, reference, settings, start=s, sensitivities=True) for s in (start, None)
    )
    np.testing.assert_array_equal(given.pose, default.pose)
    np.testing.assert_array_equal(given.pose_sensitivity, default.pose_sensitivity)
    fixed = replace(start, joint_integral_sensitivity=np.zeros((6, 67)))
    held = closed_loop.simulate(robot, identified, reference, settings, start=fixed, sensitivities=True)
    assert np.abs(held.pose_sensitivity[-1] - default.pose_sensitivity[-1]).max() > 0
    through = _through_the_start(robot, identified, reference, settings, start)
    np.testing.assert_allclose(held.pose_sensitivity + through, default.pose_sensitivity, rtol=1e-9, atol=1e-12)


def _through_the_start(robot, parameters, reference, settings, start):
    run = closed_loop.simulate(robot, parameters, reference, settings, start=start, start_sensitivities=True)
    return run.start_sensitivity[:, :, 12:18] @ start.joint_integral_sensitivity


def _directions(robot, start):
    """Unit moves of pose and integrals, and pose rates that turn one joint by 1 rad/s; which of these joints stick."""
    jacobian = robot.pose_jacobian(start.pose)
    rates = np.zeros((6, 24))
    rates[:, 6:12] = np.linalg.inv(jacobian).T
    others = np.delete(np.eye(24), np.arange(6, 12), axis=0)
    sticking = np.abs(jacobian @ start.pose_rate) < 1e-12
    return np.vstack([others, rates[~sticking]]), rates[sticking]


@pytest.fixture
def derivatives(robot, identified, half_way):
    """(settings) -> start, its sensitivities (frames, 6, 24), and the differences of runs along a move of the start."""

    def make(**options):
        reference, settings, start = half_way(**options)

        def difference(direction, step):
            poses = {}
            for n in (-2, -1, 1, 2):
                moved = _moved(start, n * step * direction)
                poses[n] = closed_loop.simulate(robot, identified, reference, settings, start=moved).pose
            return (8 * (poses[1] - poses[-1]) - (poses[2] - poses[-2])) / (12 * step)

        run = closed_loop.simulate(robot, identified, reference, settings, start=start, start_sensitivities=True)
        return start, run.start_sensitivity, difference

    return make


@pytest.mark.parametrize("timing", TIMINGS)
def test_start_sensitivities_are_finite_differences_of_the_run(robot, derivatives, timing):
    """To 1e-6 of the largest, for every pose, integral and velocity of a joint that slips at the start."""
    start, by_start, difference = derivatives(**TIMINGS[timing])
    directions, _ = _directions(robot, start)
    assert len(directions) == 22
    for direction in directions:
        ours = by_start @ direction
        largest = np.abs(ours).max()
        misses = [np.abs(ours - difference(direction, d / largest)).max() / largest for d in (1e-7, 1e-8)]
        assert min(misses) <= 1e-6, (direction, misses)


def test_start_velocities_of_joints_that_stick_are_lost(robot, derivatives):
    """Such a velocity is lost after a path that grows with its square: extrapolating from two steps takes that kink
    out. It also cuts a step, which changes the error of the integrator: hence 16 steps a frame."""
    start, by_start, difference = derivatives(steps=16)
    _, directions = _directions(robot, start)
    assert len(directions) == 2
    for direction in directions:
        ours = by_start @ direction
        h = 1e-7 / np.abs(ours).max()
        numeric = 2 * difference(direction, h) - difference(direction, 2 * h)
        np.testing.assert_allclose(numeric, ours, rtol=0, atol=1e-6 * np.abs(ours).max())


def test_velocities_of_a_robot_at_rest_have_no_effect(robot, identified, half_way):
    """With all joints stuck a start velocity is lost at once: its derivative is zero, what is left is its square."""
    reference, settings, start = half_way(frame=0)
    run = closed_loop.simulate(robot, identified, reference, settings, start=start, start_sensitivities=True)
    np.testing.assert_array_equal(run.start_sensitivity[:, :, 6:12], 0)
    changes = []
    for speed in (1e-4, 1e-5):
        direction = np.zeros(24)
        direction[6:12] = speed
        moved = closed_loop.simulate(robot, identified, reference, settings, start=_moved(start, direction))
        changes.append(np.abs(moved.pose - run.pose).max())
    assert 50 < changes[0] / changes[1] < 200


def _entries(state):
    return np.concatenate([getattr(state, name) for name in ENTRIES])


@pytest.mark.parametrize("timing", TIMINGS)
def test_the_end_state_moves_with_start_and_parameters_as_runs_do(robot, identified, half_way, timing):
    """All 24 entries of the last frame's state, by finite differences of runs along the start and the parameters."""
    reference, settings, start = half_way(**TIMINGS[timing])

    def end(move, change):
        run = closed_loop.simulate(robot, identified + change, reference, settings, start=_moved(start, move))
        return _entries(run.state_at(len(reference.poses) - 1))

    def difference(move, change):
        ends = {n: end(n * move, n * change) for n in (-2, -1, 1, 2)}
        return (8 * (ends[1] - ends[-1]) - (ends[2] - ends[-2])) / 12

    run = closed_loop.simulate(robot, identified, reference, settings, start=start, start_sensitivities=True)
    assert run.end_sensitivity.shape == (24, 67)
    assert run.end_start_sensitivity.shape == (24, 24)
    moves = [(direction, np.zeros(67)) for direction in _directions(robot, start)[0]]
    moves += [(np.zeros(24), identified[k] * np.eye(67)[k]) for k in (0, 1, 7, 28, 29, *range(52, 67))]
    for move, change in moves:
        ours = run.end_start_sensitivity @ move + run.end_sensitivity @ change
        scale = np.maximum(np.abs(ours).reshape(4, 6).max(axis=1).repeat(6), 1e-3 * np.abs(ours).max())
        misses = []
        for step in (1e-7, 1e-8, 1e-9):
            h = step / np.abs(ours[:6]).max()
            misses.append((np.abs(difference(h * move, h * change) / h - ours) / scale).max())
        assert min(misses) <= 1e-6, (move, change, misses)


@pytest.mark.parametrize("timing", TIMINGS)
def test_both_paths_give_the_same_from_a_start(robot, identified, half_way, timing):
    """Compiled and plain: poses, and the derivatives with respect to start and parameters, to 1e-9."""
    reference, settings, start = half_way(FRAME + 12, **TIMINGS[timing])
    ours, plain = (
        closed_loop.simulate(
            robot, identified, reference, settings, start=start, start_sensitivities=True, compiled=compiled
        )
        for compiled in (True, False)
    )
    assert ours.events == plain.events > 3
    for name in ("pose", "joint_integral", "servo_integral", "pose_sensitivity", "start_sensitivity"):
        other = getattr(plain, name)
        scale = np.abs(other).max(axis=(0, 1))
        assert (np.abs(getattr(ours, name) - other) <= 1e-9 * scale + 1e-14).all(), name
    for name in ("end_sensitivity", "end_start_sensitivity"):
        other = getattr(plain, name)
        scale = np.abs(other).reshape(4, 6, -1).max(axis=1).repeat(6, axis=0)
        assert (np.abs(getattr(ours, name) - other) <= 1e-9 * scale + 1e-14).all(), name


def test_a_batch_carries_starts_and_their_sensitivities(robot, identified, half_way):
    """Three starts for one parameter vector, as multiple shooting wants them: what three single runs give."""
    reference, settings, start = half_way(30)
    starts = [_moved(start, scale * np.ones(24)) for scale in (0, 1e-5, 2e-5)]
    runs = simulate_batch(robot, identified, reference, settings, starts=starts, start_sensitivities=True)
    for begin, run in zip(starts, runs, strict=True):
        alone = closed_loop.simulate(robot, identified, reference, settings, start=begin, start_sensitivities=True)
        np.testing.assert_array_equal(run.pose, alone.pose)
        np.testing.assert_array_equal(run.pose_sensitivity, alone.pose_sensitivity)
        np.testing.assert_array_equal(run.start_sensitivity, alone.start_sensitivity)
    assert not np.array_equal(runs[0].pose, runs[1].pose)
    with pytest.raises(SimulationError, match="2 parameter vectors and 1 references and 3 start states"):
        simulate_batch(robot, np.tile(identified, (2, 1)), reference, settings, starts=starts)


def test_bad_starts_are_refused(robot, identified, half_way):
    reference, settings, start = half_way(30)
    with pytest.raises(SimulationError, match=r"start pose_rate must have shape \(6,\), got \(5,\)"):
        replace(start, pose_rate=np.zeros(5))
    with pytest.raises(SimulationError, match=r"start servo_integral\[0\] is nan, must be finite"):
        replace(start, servo_integral=np.full(6, np.nan))
    with pytest.raises(SimulationError, match=r"start commands must have shape \(N, 6\), got \(6,\)"):
        replace(start, commands=np.zeros(6))
    far = replace(start, pose=start.pose + np.array([0, 0, 0.5, 0, 0, 0]))
    with pytest.raises(UnreachablePoseError, match="leg"):
        closed_loop.simulate(robot, identified, reference, settings, start=far)
    with pytest.raises(SimulationError, match="start must be of type StartState"):
        closed_loop.simulate(robot, identified, reference, settings, start=start.pose)


def test_states_that_a_run_does_not_know_are_refused(robot, identified, make_reference, make_settings):
    reference, settings = make_reference(10), make_settings()
    lost = np.arange(10) == 4
    run = closed_loop.simulate(robot, identified, reference, settings, lost=lost)
    with pytest.raises(SimulationError, match="frame is 10, must be a whole number >= 0 and <= 9"):
        run.state_at(10)
    with pytest.raises(SimulationError, match="frame 5 follows a lost measurement"):
        run.state_at(5)
    assert run.state_at(0) is run.start
