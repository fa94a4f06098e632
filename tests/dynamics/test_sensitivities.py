"""Sensitivities of the closed loop with respect to the 67 parameters."""

import numpy as np
import pytest

from dynamics import closed_loop
from dynamics.friction import FrictionLaw


def _difference(run, parameters, index, step):
    """Fourth-order central difference of the poses, and whether all its runs had the same stick-slip events."""
    poses, events = {}, set()
    for n in (-2, -1, 1, 2):
        moved = parameters.copy()
        moved[index] += n * step
        result = run(moved)
        poses[n] = result.pose
        events.add(result.events)
    return (8 * (poses[1] - poses[-1]) - (poses[2] - poses[-2])) / (12 * step), len(events) == 1


CASES = {
    "exact friction": ({"steps": 16}, range(67), 1e-6),
    "four steps a frame": ({"steps": 4}, range(0, 67, 3), 1e-3),
    "linear hold, 1.3 frames of delay": ({"steps": 16, "hold": "linear", "latency_s": 1.3 / 60}, range(1, 67, 3), 1e-6),
    "Stribeck friction": (
        {"steps": 16, "friction": FrictionLaw("stribeck", static_ratio=1.3, stribeck_velocity=0.1)},
        range(1, 67, 3),
        1e-5,
    ),
    "smoothed friction": ({"steps": 16, "smoothing_velocity": 0.02}, range(2, 67, 3), 2e-3),
    "smoothed friction, fine": ({"steps": 64, "smoothing_velocity": 0.05}, range(2, 67, 6), 1e-6),
}


@pytest.mark.parametrize(
    ("case", "driven"), [*[(case, False) for case in CASES], pytest.param("exact friction", True, id="logged commands")]
)
def test_sensitivities_are_finite_differences_of_the_run(
    robot, identified, make_reference, make_settings, case, driven
):
    """Within one pattern of events the poses are smooth in the parameters, and the sensitivities are their derivatives:
    to 1e-6 of the largest at 16 steps a frame. (They differentiate the flow, not the Runge-Kutta steps, where a step
    is cut at an event; at 4 steps a frame the two differ by some 1e-4.) Steps that change the pattern are passed over:
    there the poses have a kink. Rounding (1e-15 in the pose) over the step is allowed for.
    """
    options, indices, tolerance = CASES[case]
    reference, settings = make_reference(45), make_settings(**options)
    commands = closed_loop.simulate(robot, identified, reference, settings).command if driven else None

    def run(values, sensitivities=False):
        return closed_loop.simulate(
            robot, values, reference, settings, commands=commands, sensitivities=sensitivities
        )

    base = run(identified, sensitivities=True)
    for index in indices:
        ours = base.pose_sensitivity[:, :, index]
        largest, misses = np.abs(ours).max(), []
        for relative in (1e-3, 1e-4, 1e-5, 1e-6):
            step = relative * identified[index]
            numeric, same = _difference(run, identified, index, step)
            misses.append(np.abs(ours - numeric).max() - 1e-14 / step if same else np.inf)
            if misses[-1] <= tolerance * largest:
                break
        else:
            pytest.fail(f"parameter {index}: off by {np.array(misses) / largest} of the largest sensitivity")


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
