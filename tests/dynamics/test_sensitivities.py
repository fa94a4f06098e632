"""Sensitivities of the closed loop with respect to the 67 parameters."""

import numpy as np
import pytest

from dynamics import closed_loop
from dynamics.closed_loop.joints import FrictionLaw

STRIBECK = FrictionLaw("stribeck", static_ratio=1.3, stribeck_velocity=0.1)
CASES = {
    "exact friction": ({}, range(67), 1e-6),
    "linear hold, 1.3 frames of delay": ({"hold": "linear", "latency_s": 1.3 / 60}, range(2, 67, 3), 1e-6),
    "Stribeck friction": ({"friction": STRIBECK}, range(1, 67, 3), 1e-6),
    "smoothed friction": ({"smoothing_velocity": 0.05}, range(0, 67, 3), 1e-6),
    "exact friction, 16 steps": ({"steps": 16}, range(0, 67, 9), 1e-6),
    "exact friction, 2 steps": ({"steps": 2}, (0, 2, 3, 12), 1e-7),
}


def _difference(run, parameters, index, step):
    """Fourth-order central difference of the poses, and whether all its runs had the same number of events."""
    runs = {n: run(parameters + n * step * np.eye(67)[index]) for n in (-2, -1, 1, 2)}
    poses = {n: result.pose for n, result in runs.items()}
    difference = (8 * (poses[1] - poses[-1]) - (poses[2] - poses[-2])) / (12 * step)
    return difference, len({result.events for result in runs.values()}) == 1


def _assert_derivative(run, parameters, index, ours, tolerance):
    """A sensitivity (frames, 6) is the derivative of the poses to a share of its own largest entry.

    Steps that move the poses by 1e-7, 1e-8, 1e-6 (m, rad) are tried; one must pass. Rounding in the poses, 1e-15, is
    then 1e-7 at most; where a step changes the pattern of events the poses have a kink.
    """
    largest, misses = np.abs(ours).max(), []
    if largest == 0:  # an inertia about an axis that nothing turns about
        far = run(parameters + 0.4 * parameters * np.eye(67)[index]).pose
        np.testing.assert_array_equal(far, run(parameters).pose, err_msg=f"parameter {index}")
        return
    for movement in (1e-7, 1e-8, 1e-6):
        step = min(movement / largest, 0.4 * abs(parameters[index]))
        numeric, same = _difference(run, parameters, index, step)
        misses.append(np.abs(ours - numeric).max() / largest if same else np.inf)
        if misses[-1] <= tolerance:
            return
    pytest.fail(f"parameter {index}: off by {np.array(misses)} of the largest sensitivity")


@pytest.mark.parametrize(
    ("case", "driven"), [*[(case, False) for case in CASES], pytest.param("exact friction", True, id="logged commands")]
)
def test_sensitivities_are_finite_differences_of_the_run(
    robot, identified, make_reference, make_settings, case, driven
):
    """Within one pattern of events the poses are smooth in the parameters, and the sensitivities are their derivatives
    at the usual 4 steps a frame: steps that events cut are differentiated as they are computed."""
    options, indices, tolerance = CASES[case]
    reference, settings = make_reference(45), make_settings(**options)
    commands = closed_loop.simulate(robot, identified, reference, settings).command if driven else None

    def run(values, sensitivities=False):
        return closed_loop.simulate(robot, values, reference, settings, commands=commands, sensitivities=sensitivities)

    base = run(identified, sensitivities=True)
    assert (base.events > 10) == (case != "smoothed friction")
    for index in indices if not driven else range(0, 67, 3):
        _assert_derivative(run, identified, index, base.pose_sensitivity[:, :, index], tolerance)


def test_a_common_factor_of_all_parameters_cannot_be_seen(robot, identified, make_reference, make_settings):
    """Xi and (lp, li, ld) times c leave every pose unchanged; the sensitivity along that direction vanishes."""
    reference, settings = make_reference(60), make_settings()
    base = closed_loop.simulate(robot, identified, reference, settings, sensitivities=True)
    scaled = closed_loop.simulate(robot, 1.7 * identified, reference, settings)
    np.testing.assert_allclose(scaled.pose, base.pose, atol=1e-12)
    np.testing.assert_allclose(scaled.torque, 1.7 * base.torque, rtol=1e-8, atol=1e-9)
    along = base.pose_sensitivity @ identified
    largest = np.abs(base.pose_sensitivity * identified).max()
    assert np.abs(along).max() < 1e-8 * largest


def test_logged_commands_leave_the_servo_out(robot, identified, make_reference, make_settings):
    """Driven by the commands of a run, the same robot repeats that run bit by bit; servo gains do not matter."""
    reference, settings = make_reference(45), make_settings()
    first = closed_loop.simulate(robot, identified, reference, settings)
    gains = closed_loop.ServoGains(9.0, 9.0, 9.0)
    other = closed_loop.LoopSettings(gains, settings.timing, settings.friction, settings.steps_per_frame)
    again = closed_loop.simulate(robot, identified, reference, other, commands=first.command)
    np.testing.assert_array_equal(again.pose, first.pose)


def test_measuring_without_error_is_the_ideal_sensor(robot, identified, make_reference, make_settings):
    """A sensor that returns the true pose gives the run of `sensor=None` bit by bit, and is called once a frame."""
    reference, settings = make_reference(30), make_settings()
    calls = []

    def sensor(frame, time, pose):
        calls.append((frame, time))
        return pose

    ideal = closed_loop.simulate(robot, identified, reference, settings)
    run = closed_loop.simulate(robot, identified, reference, settings, sensor)
    np.testing.assert_array_equal(run.pose, ideal.pose)
    assert calls == [(n, n * (1 / 60)) for n in range(30)]
