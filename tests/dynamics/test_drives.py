"""Laws of the drives: what they command, that they hold the robot, and the derivatives of their
runs.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from dynamics.closed_loop import (
    Drives,
    FrameTiming,
    LoopSettings,
    ServoGains,
    simulate_servo,
    stability,
)
from dynamics.closed_loop.drives import DRIVES, FILTERED, CascadeGains, cascade_gains
from dynamics.errors import SimulationError
from tests.dynamics.conftest import assert_same, at_rest
from tests.dynamics.test_sensitivities import _assert_derivative

LIMIT = 3.3  # N m: the robot needs some 2 to 3 to hold itself


# All; loops with filters are kernels of their own, which take long to compile.
LAWS = [
    pytest.param(law, marks=[pytest.mark.thorough] if law == FILTERED else []) for law in DRIVES
]


def drives_of(law):
    """A law by its name; `limited` before it: at a limit that it meets."""
    name = law.removeprefix("limited ")
    filter_time = 0.008 if name == "pid_filtered" else None
    return Drives(law=name, filter_time=filter_time, torque_limit=LIMIT if name != law else None)


@pytest.mark.parametrize("law", LAWS)
def test_the_robot_rests_where_it_starts(loop, law):
    """The command at rest, its torque and the servo's integral hold it; a PD holds by an error
    alone.
    """
    settings = loop.settings(drives=drives_of(law))
    run = loop.run(at_rest(loop.robot.home_pose, 30), settings)
    np.testing.assert_allclose(run.pose, run.pose[:1].repeat(30, 0), atol=1e-12)
    held = loop.robot.static_torque(
        loop.robot.home_pose, loop.parameters[loop.robot.layout.dynamic]
    )
    np.testing.assert_allclose(run.torque, np.tile(held, (30, 1)), rtol=1e-9)
    error = run.command - loop.robot.inverse_kinematics(run.pose)
    np.testing.assert_allclose(error[0], held / 10.5 if law == "pd" else 0.0, atol=1e-12)


def _dense(loop, law, gains, frames=900, hz=600.0):
    """A run at many frames a second, and joint coordinates, their integral, rates and commands held
    for a frame.
    """
    values = loop.parameters.copy()
    values[loop.robot.layout.joint_pid] = gains
    settings = LoopSettings(ServoGains(0.3, 0.001, 2.4), FrameTiming(hz), drives=drives_of(law))
    run = simulate_servo(loop.robot, values, loop.reference(frames, hz), settings)
    angle = loop.robot.inverse_kinematics(run.pose)
    integral = make_interp_spline(run.time, angle, k=5).antiderivative()(run.time)
    rate = np.einsum("nij,nj->ni", loop.robot.pose_jacobian(run.pose), run.pose_rate)
    commanded = np.vstack([np.zeros(6), np.cumsum(run.command[:-1], axis=0) / hz])
    return run, angle, rate, commanded - integral


def test_a_cascade_is_a_pi_controller_of_the_velocity_in_one_of_the_position(loop):
    """kv (w - theta_dot) + ki integral(w - theta_dot) with w = kp (U - theta), integrated here from
    the record.
    """
    gains = np.array([10.5, 30.0, 0.3])
    run, angle, rate, error_integral = _dense(loop, "cascade", gains)
    (kp, kv, ki), _ = cascade_gains(gains)
    assert (kp, kv, ki) == CascadeGains(35.0, 0.3, pytest.approx(30 / 35))
    wanted = kp * (run.command - angle) - rate
    torque = kv * wanted + ki * (kp * error_integral - (angle - angle[0]))
    at_start = run.torque[0] - torque[0]
    np.testing.assert_allclose(run.torque, torque + at_start, atol=2e-5 * np.ptp(run.torque))
    assert np.ptp(run.torque) > 1.0


@pytest.mark.parametrize("law", ["pd", "pi"])
def test_a_law_is_the_pid_without_what_it_does_not_read(loop, law):
    """Its torque from the record; and what it does not read may be anything."""
    lp, li, ld = 10.5, 0.0 if law == "pd" else 11.4, 0.0 if law == "pi" else 0.164
    run, angle, rate, error_integral = _dense(loop, law, np.array([10.5, 11.4, 0.164]), 300)
    before = np.vstack([run.start.commands[-1:], run.command[:-1]])
    torque = (
        lp * (run.command - angle)
        + ld * (600 * (run.command - before) - rate)
        + li * error_integral
    )
    at_start = run.torque[0] - torque[0] if law == "pi" else 0.0
    np.testing.assert_allclose(run.torque, torque + at_start, atol=1e-5 * np.ptp(run.torque))
    other, *_ = _dense(
        loop, law, np.array([10.5, 11.4 + 3 * (li == 0), 0.164 + 3 * (ld == 0)]), 300
    )
    np.testing.assert_array_equal(other.pose, run.pose)


@pytest.mark.thorough
def test_the_filter_is_one_of_first_order(loop):
    """Its differential equation solved along the recorded joint rates, which a spline carries
    between frames.
    """
    run, angle, rate, error_integral = _dense(
        loop, "pid_filtered", np.array([10.5, 11.4, 0.164]), 300
    )
    fine = np.linspace(run.time[0], run.time[-1], 20 * (len(run.time) - 1) + 1)
    turning = make_interp_spline(run.time, rate, k=3)(fine)
    before = np.vstack([run.start.commands[-1:], run.command[:-1]])
    asked = np.repeat(600 * (run.command - before), 20, axis=0)[: len(fine)]
    filtered, step = np.zeros_like(turning), 1 / 12000
    for k in range(len(fine) - 1):
        mean = asked[k] - (turning[k] + turning[k + 1]) / 2
        filtered[k + 1] = mean + (filtered[k] - mean) * np.exp(-step / 0.008)
    torque = 10.5 * (run.command - angle) + 11.4 * error_integral + 0.164 * filtered[::20]
    np.testing.assert_allclose(
        run.torque, torque + run.torque[0] - torque[0], atol=2e-4 * np.ptp(run.torque)
    )
    np.testing.assert_allclose(run.filtered_rate, filtered[::20], atol=2e-3 * np.ptp(filtered))


@pytest.mark.thorough
def test_a_run_from_the_state_of_another_repeats_its_rest(loop):
    """The filtered rates are part of the state."""
    settings = loop.settings(drives=drives_of("pid_filtered"))
    reference, start = loop.half_way(45, 20, settings)
    rest, run = loop.run(reference, settings, start=start), loop.run(45, settings)
    np.testing.assert_array_equal(rest.pose, run.pose[20:])
    assert np.abs(start.filtered_rate).max() > 0


CASES = [*LAWS[1:], "limited pid", pytest.param("limited cascade", marks=pytest.mark.slow)]


@pytest.mark.parametrize("driven", [False, True], ids=["closed loop", "logged commands"])
@pytest.mark.parametrize("case", CASES)
def test_sensitivities_are_finite_differences_of_the_run(loop, case, driven):
    """Of every law, and where torques are cut at their limit; logged commands begin with latency,
    so that those of the start act, too."""
    settings = loop.settings(latency_s=0.7 / 60, drives=drives_of(case))
    reference, given = loop.reference(45, scale=2.0), {}
    if driven:
        given["commands"] = loop.run(reference, settings).command

    def run(values, sensitivities=False):
        return loop.run(reference, settings, values, sensitivities=sensitivities, **given)

    base = run(loop.parameters, sensitivities=True)
    limited = "limited" in case
    if limited:
        assert 20 < (np.abs(base.torque) == LIMIT).sum() < 0.5 * base.torque.size
    for index in (0, 2, 12, 52, 58, 64, 65, 66):
        ours = base.pose_sensitivity[:, :, index]
        if index - 64 in np.flatnonzero(settings.drives.joint_law(loop.parameters[64:]).reads == 0):
            assert not ours.any()
            continue
        _assert_derivative(run, loop.parameters, index, ours, 1e-5 if limited else 1e-6)


@pytest.mark.parametrize("law", ["pid", "cascade"])
def test_the_integrator_of_a_drive_at_its_limit_waits_until_the_error_turns(loop, law):
    """What it holds, li z - lx theta, stays as long as the torque is at the limit, but for frames
    within which damping takes it from there for a moment; by the errors of these frames it would
    have grown."""
    run = loop.run(loop.reference(45, scale=3.0), loop.settings(drives=drives_of(f"limited {law}")))
    joint = drives_of(law).joint_law(loop.parameters[64:])
    angle = loop.robot.inverse_kinematics(run.pose)
    held, side = (
        joint.li * run.joint_integral - joint.lx * angle,
        np.sign(run.torque) * (np.abs(run.torque) == LIMIT),
    )
    grown, error = np.diff(held, axis=0) * side[:-1], (run.command - angle) * side
    stays = (side[:-1] * side[1:] > 0) & (error[:-1] > 1e-3) & (error[1:] > 1e-3)
    assert stays.sum() > 10
    assert np.median(np.abs(grown[stays])) < 1e-9
    assert grown[stays].sum() < 0.03 * (joint.li / 60 * error[:-1][stays]).sum()


def test_sensitivities_of_the_start_are_finite_differences(loop):
    """Of the pose, its rate and both integrals, from a start given half way, under the cascade."""
    settings = loop.settings(drives=drives_of("cascade"))
    reference, start = loop.half_way(45, 20, settings)
    ours = loop.run(reference, settings, start=start, start_sensitivities=True).start_sensitivity
    for entry, name in (
        (0, "pose"),
        (6, "pose_rate"),
        (12, "joint_integral"),
        (18, "servo_integral"),
    ):
        ends = []
        for sign in (1, -1):
            moved = getattr(start, name) + 1e-8 * sign * np.eye(6)[0]
            ends.append(loop.run(reference, settings, start=replace(start, **{name: moved})).pose)
        numeric = (ends[0] - ends[1]) / 2e-8
        np.testing.assert_allclose(ours[:, :, entry], numeric, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.slow
@pytest.mark.parametrize("law", ["pd", pytest.param("cascade", marks=pytest.mark.slow), LAWS[-1]])
def test_compiled_and_plain_runs_agree(loop, law):
    settings = loop.settings(latency_s=0.01, drives=replace(drives_of(law), torque_limit=4.0))
    assert_same(*loop.both(loop.reference(4), settings, sensitivities=True))


def test_the_linear_loop_says_what_a_cascade_bears(loop):
    """The rate weight is none: the loop of the cascade is another than that of the PID with the
    same gains.
    """
    robot, values = loop.robot, loop.parameters
    settings = [loop.settings(drives=drives_of(law)) for law in DRIVES]
    radii = [stability.spectral_radius(robot, values, each, robot.home_pose) for each in settings]
    assert len(set(np.round(radii, 6))) == len(DRIVES)


@pytest.mark.parametrize(
    ("law", "gains", "said"),
    [
        ("pd", [0.0, 1.0, 1.0], "joint_pid.lp is 0"),
        ("cascade", [1.0, 1.0, 0.0], "joint_pid.ld is 0"),
        ("pi", [1.0, 0.0, 0.0], "joint_pid.li is 0"),
        ("pid_filtered", [1.0, 0.0, 0.0], "joint_pid.li is 0"),
    ],
)
def test_a_law_without_a_gain_that_it_needs_is_refused(loop, law, gains, said):
    values = np.append(loop.parameters[:64], gains)
    with pytest.raises(SimulationError, match=said):
        loop.run(3, loop.settings(drives=drives_of(law)), values)


def test_an_unknown_law_is_refused_with_the_valid_names():
    with pytest.raises(SimulationError, match="`pdi`; valid: pid, pd, pi, cascade, pid_filtered"):
        Drives(law="pdi")


def test_a_filtered_rate_follows_the_unfiltered_one_late(loop):
    """The plain lines: its derivative is what is missing, over the time constant, in steps of a
    60th of that.
    """
    settings = replace(loop.settings(7200.0, steps=1), drives=drives_of(FILTERED))
    rates, start = loop.reference(3, 7200.0), loop.run(at_rest(loop.robot.home_pose, 2)).start
    moving = replace(
        start, pose_rate=np.array([0.02, 0, 0, 0, 0.05, 0]), filtered_rate=np.full(6, 0.1)
    )
    run = loop.run(
        rates, settings, start=moving, commands=np.tile(start.commands, (3, 1)), compiled=False
    )
    turning = np.einsum("nij,nj->ni", loop.robot.pose_jacobian(run.pose), run.pose_rate)
    wanted = 0.1 + (-turning[:2].mean(axis=0) - 0.1) * (1 - np.exp(-1 / 7200 / 0.008))
    np.testing.assert_allclose(run.filtered_rate[1], wanted, rtol=1e-4)
    torque = (
        10.5 * (start.commands[0] - loop.robot.inverse_kinematics(run.pose))
        + 0.164 * run.filtered_rate
    )
    np.testing.assert_allclose(run.torque, torque + 11.4 * run.joint_integral, rtol=1e-9)


@pytest.mark.parametrize(
    ("law", "seconds"), [("pid_filtered", None), ("pid_filtered", 0.0), ("pi", 0.01)]
)
def test_a_filter_belongs_to_its_law(law, seconds):
    with pytest.raises(SimulationError, match="filter_time"):
        Drives(law=law, filter_time=seconds)
