"""Derivatives of runs with respect to the 67 parameters and the start, and runs from a given
state."""

from dataclasses import replace

import numpy as np
import pytest

from dynamics import closed_loop
from dynamics.closed_loop import FrictionLaw
from dynamics.errors import SimulationError
from tests.dynamics.conftest import RECORDS

LATE = {"latency_s": 1.3 / 60, "hold": "linear"}
CASES = {
    "exact friction": ({}, range(67), 1e-6),
    "logged commands": ({}, range(0, 67, 3), 1e-6),
    "linear hold, 1.3 frames of delay": (LATE, range(2, 67, 3), 1e-6),
    "Stribeck friction": (
        {"friction": FrictionLaw("stribeck", None, 1.3, 0.1)},
        range(1, 67, 3),
        1e-6,
    ),
    "smoothed friction": ({"smoothing_velocity": 0.05}, range(0, 67, 3), 1e-6),
    "exact friction, 16 steps": ({"steps": 16}, range(0, 67, 9), 1e-6),
    "exact friction, 2 steps": ({"steps": 2}, (0, 2, 3, 12), 1e-7),
    "lost frames": ({"latency_s": 0.4 / 60}, range(52, 67, 7), 1e-6),
    "jitter": ({}, (0, 52, 58, 64, 65), 1e-6),
    "jitter, linear hold": (LATE, (0, 52, 58, 64, 65), 1e-6),
}
FRAME = 20  # of the reference: there four joints move and two stick
ENTRIES = ("pose", "pose_rate", "joint_integral", "servo_integral")
TIMINGS = {"no delay": {}, "1.3 frames, linear": LATE}


def _central(values, step):
    """Fourth-order central difference of values at -2, -1, 1 and 2 steps."""
    return (8 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12 * step)


def _assert_derivative(run, parameters, index, ours, tolerance):
    """A sensitivity (frames, 6) is the derivative of the poses to a share of its own largest entry.

    Steps that move the poses by 1e-7, 1e-8, 1e-6 (m, rad) are tried; one must pass. Rounding in the
    poses, 1e-15, is then 1e-7 at most; where a step changes the pattern of events the poses have a
    kink.
    """
    largest, misses, unit = np.abs(ours).max(), [], np.eye(len(parameters))[index]
    if largest == 0:  # an inertia about an axis that nothing turns about
        far = run(parameters + 0.4 * parameters * unit).pose
        np.testing.assert_array_equal(far, run(parameters).pose, err_msg=f"parameter {index}")
        return
    for movement in (1e-7, 1e-8, 1e-6):
        step = min(movement / largest, 0.4 * abs(parameters[index]))
        runs = {n: run(parameters + n * step * unit) for n in (-2, -1, 1, 2)}
        same = len({result.events for result in runs.values()}) == 1
        numeric = _central({n: result.pose for n, result in runs.items()}, step)
        misses.append(np.abs(ours - numeric).max() / largest if same else np.inf)
        if misses[-1] <= tolerance:
            return
    pytest.fail(f"parameter {index}: off by {np.array(misses)} of the largest sensitivity")


@pytest.mark.parametrize("case", CASES)
def test_sensitivities_are_finite_differences_of_the_run(loop, case):
    """Within one pattern of events the poses are smooth in the parameters, and the sensitivities
    are their derivatives at the usual 4 steps a frame: steps that events cut are differentiated as
    they are computed."""
    settings, reference, given = loop.settings(**CASES[case][0]), loop.reference(45), {}
    if case == "logged commands":
        given["commands"] = loop.run(reference, settings).command
    if case == "lost frames":
        given["lost"] = np.isin(np.arange(45), (0, 5, 9, 10))
    if case.startswith("jitter"):
        given["latencies"] = np.random.default_rng(3).uniform(0, 3.2 / 60, 45)

    def run(values, sensitivities=False):
        return loop.run(reference, settings, values, sensitivities=sensitivities, **given)

    base = run(loop.parameters, sensitivities=True)
    assert (base.events > 10) == (case != "smoothed friction")
    for index in CASES[case][1]:
        _assert_derivative(
            run, loop.parameters, index, base.pose_sensitivity[:, :, index], CASES[case][2]
        )


def test_a_common_factor_of_all_parameters_cannot_be_seen(loop):
    """Xi and (lp, li, ld) times c leave every pose unchanged; the sensitivity along that direction
    vanishes.
    """
    base = loop.run(60, sensitivities=True)
    scaled = loop.run(60, parameters=1.7 * loop.parameters)
    np.testing.assert_allclose(scaled.pose, base.pose, atol=1e-12)
    np.testing.assert_allclose(scaled.torque, 1.7 * base.torque, rtol=1e-8, atol=1e-9)
    along = base.pose_sensitivity @ loop.parameters
    assert np.abs(along).max() < 1e-8 * np.abs(base.pose_sensitivity * loop.parameters).max()


def _moved(start, direction):
    """The start state, moved by a vector of its 24 entries."""
    changes = {
        name: getattr(start, name) + part
        for name, part in zip(ENTRIES, np.split(direction, 4), strict=True)
    }
    return replace(start, **changes)


@pytest.mark.parametrize("timing", [*TIMINGS, "elastic joints"])
def test_a_run_from_the_state_of_another_repeats_its_rest(loop, timing):
    """Bit by bit: the state is complete. Joints stick at some of these frames, and commands are on
    their way.
    """
    elastic = {"steps": 80, "elasticity": closed_loop.JointElasticity(500.0, 3e-4, 0.02)}
    settings = loop.settings(**TIMINGS.get(timing, elastic))
    run = loop.run(45, settings)
    assert run.state_at(0) is run.start
    for frame in (0, 3, FRAME, 33):
        reference, start = loop.half_way(45, frame, settings)
        rest = loop.run(reference, settings, start=start)
        for name in RECORDS if timing == "elastic joints" else RECORDS[:-2]:
            np.testing.assert_array_equal(
                getattr(rest, name), getattr(run, name)[frame:], err_msg=name
            )


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_state_with_the_latencies_of_its_commands_goes_on_where_each_frame_has_its_own(
    loop, hold
):
    """Bit by bit, also where a command that was issued long before arrives after the state."""
    settings, frames = loop.settings(latency_s=1.3 / 60, hold=hold), 45
    latencies = np.random.default_rng(3).uniform(0.0, 4.2, frames) / 60
    latencies[FRAME - 4] = 6.5 / 60
    run = loop.run(frames, settings, latencies=latencies)
    for frame in (3, FRAME, 33):
        reference, start = loop.half_way(frames, frame, settings)[0], run.state_at(frame)
        before = np.concatenate([[settings.timing.latency_s], latencies[:frame]])
        rest = loop.run(
            reference, settings, start=replace(start, latencies=before), latencies=latencies[frame:]
        )
        for name in RECORDS[:-2]:
            np.testing.assert_array_equal(
                getattr(rest, name), getattr(run, name)[frame:], err_msg=name
            )


def test_the_default_start_is_the_equilibrium(robot, loop):
    """Given or not, it is the same start, and the sensitivities contain that it follows the
    parameters.
    """
    reference, settings = loop.reference(20), loop.settings()
    start = closed_loop.equilibrium(robot, loop.parameters, reference.poses[0], settings.servo)
    given, default = (loop.run(reference, start=s, sensitivities=True) for s in (start, None))
    np.testing.assert_array_equal(given.pose, default.pose)
    np.testing.assert_array_equal(given.pose_sensitivity, default.pose_sensitivity)
    fixed = replace(start, joint_integral_sensitivity=np.zeros((6, 67)))
    held = loop.run(reference, start=fixed, sensitivities=True)
    assert np.abs(held.pose_sensitivity[-1] - default.pose_sensitivity[-1]).max() > 0
    through = loop.run(reference, start=start, start_sensitivities=True).start_sensitivity[
        :, :, 12:18
    ]
    through = through @ start.joint_integral_sensitivity
    np.testing.assert_allclose(
        held.pose_sensitivity + through, default.pose_sensitivity, rtol=1e-9, atol=1e-12
    )


def _directions(robot, start):
    """Unit moves of pose and integrals, and pose rates that turn one joint by 1 rad/s; which of
    these joints stick.
    """
    jacobian = robot.pose_jacobian(start.pose)
    rates = np.zeros((6, 24))
    rates[:, 6:12] = np.linalg.inv(jacobian).T
    others = np.delete(np.eye(24), np.arange(6, 12), axis=0)
    sticking = np.abs(jacobian @ start.pose_rate) < 1e-12
    return np.vstack([others, rates[~sticking]]), rates[sticking]


@pytest.mark.parametrize("timing", [*TIMINGS, "sticking"])
def test_start_sensitivities_are_finite_differences_of_the_run(robot, loop, timing):
    """To 1e-6 of the largest, for every pose, integral and velocity of a joint that slips at the
    start. The velocity of one that sticks is lost after a path that grows with its square:
    extrapolating from two steps takes that kink out. It also cuts a step, which changes the error
    of the integrator: hence 16 steps a frame."""
    settings = loop.settings(**TIMINGS.get(timing, {"steps": 16}))
    reference, start = loop.half_way(45, FRAME, settings)
    by_start = loop.run(
        reference, settings, start=start, start_sensitivities=True
    ).start_sensitivity

    def difference(direction, step):
        moves = {n: _moved(start, n * step * direction) for n in (-2, -1, 1, 2)}
        return _central(
            {n: loop.run(reference, settings, start=moved).pose for n, moved in moves.items()}, step
        )

    slipping, sticking = _directions(robot, start)
    assert (len(slipping), len(sticking)) == (22, 2)
    for direction in sticking if timing == "sticking" else slipping:
        ours = by_start @ direction
        largest = np.abs(ours).max()
        if timing == "sticking":
            h = 1e-7 / largest
            numeric = [2 * difference(direction, h) - difference(direction, 2 * h)]
        else:
            numeric = (difference(direction, h / largest) for h in (1e-7, 1e-8))
        misses = [np.abs(ours - other).max() / largest for other in numeric]
        assert min(misses) <= 1e-6, (direction, misses)


@pytest.mark.parametrize("timing", TIMINGS)
def test_the_end_state_moves_with_start_and_parameters_as_runs_do(robot, loop, timing):
    """All 24 entries of the last frame's state, by finite differences of runs along the start and
    the parameters.
    """
    settings = loop.settings(**TIMINGS[timing])
    reference, start = loop.half_way(45, FRAME, settings)

    def end(move, change):
        run = loop.run(reference, settings, loop.parameters + change, start=_moved(start, move))
        state = run.state_at(len(reference.poses) - 1)
        return np.concatenate([getattr(state, name) for name in ENTRIES])

    run = loop.run(reference, settings, start=start, start_sensitivities=True)
    assert run.end_sensitivity.shape == (24, 67)
    assert run.end_start_sensitivity.shape == (24, 24)
    moves = [(direction, np.zeros(67)) for direction in _directions(robot, start)[0]]
    moves += [
        (np.zeros(24), loop.parameters * np.eye(67)[k]) for k in (0, 1, 7, 28, 29, *range(52, 67))
    ]
    for move, change in moves:
        ours = run.end_start_sensitivity @ move + run.end_sensitivity @ change
        scale = np.maximum(
            np.abs(ours).reshape(4, 6).max(axis=1).repeat(6), 1e-3 * np.abs(ours).max()
        )
        misses = []
        for step in (1e-7, 1e-8, 1e-9):
            h = step / np.abs(ours[:6]).max()
            ends = {n: end(n * h * move, n * h * change) for n in (-2, -1, 1, 2)}
            misses.append((np.abs(_central(ends, h) - ours) / scale).max())
            if misses[-1] <= 1e-6:
                break
        assert min(misses) <= 1e-6, (move, change, misses)


@pytest.mark.parametrize(
    ("given", "hold"), [("commands", "zero"), ("commands", "linear"), ("feedforward", "zero")]
)
def test_a_run_is_differentiated_along_directions_of_its_commands(loop, given, hold):
    """The derivatives are differences of runs, and those by the parameters stay as they are."""
    settings = loop.settings(latency_s=1.3 / 60, hold=hold)
    reference = loop.reference(45)
    commands = loop.run(reference, settings).command
    if given == "feedforward":
        commands = loop.robot.inverse_kinematics(reference.poses)
    directions = np.random.default_rng(2).standard_normal((45, 6, 3))
    more = {given: commands, "sensitivities": True}
    run = loop.run(45, settings, directions=directions, **more)
    plain = loop.run(45, settings, **more)
    np.testing.assert_array_equal(run.pose_sensitivity, plain.pose_sensitivity)
    for k in range(3):
        step = 1e-7 / np.abs(run.command_sensitivity[:, :, k]).max()
        ends = {
            n: loop.run(45, settings, **{given: commands + n * step * directions[:, :, k]}).pose
            for n in (-2, -1, 1, 2)
        }
        np.testing.assert_allclose(
            run.command_sensitivity[:, :, k],
            _central(ends, step),
            atol=1e-6 * np.abs(run.command_sensitivity[:, :, k]).max(),
        )


def test_directions_that_do_not_fit_are_refused_with_their_number(loop):
    most = closed_loop.most_directions(loop.robot)
    given = {"commands": np.zeros((5, 6)), "sensitivities": True}
    with pytest.raises(SimulationError, match=f"{most + 1} directions .* at most {most} fit"):
        loop.run(5, directions=np.zeros((5, 6, most + 1)), **given)
    with pytest.raises(SimulationError, match=r"directions.*shape \(5, 6, 2\)"):
        loop.run(5, directions=np.zeros((4, 6, 2)), **given)
    with pytest.raises(SimulationError, match="at most 0 fit"):
        loop.run(
            5,
            commands=np.zeros((5, 6)),
            start_sensitivities=True,
            directions=np.zeros((5, 6, 1)),
        )
