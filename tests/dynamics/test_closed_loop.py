"""The sampled loop: compiled against plain, the frame protocol, and runs that end early."""

import re
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from dynamics import closed_loop, compilation, robot_file
from dynamics import robot as robot_module
from dynamics.closed_loop import plain_loop as plain_closed_loop
from dynamics.errors import DynamicsError, SimulationError

PERIOD = 1 / 60

TIMINGS = {
    "no delay": {},
    "half a frame": {"latency_s": 0.5 * PERIOD},
    "one frame": {"latency_s": PERIOD},
    "1.3 frames, linear": {"latency_s": 1.3 * PERIOD, "hold": "linear"},
    "linear": {"hold": "linear"},
    "2.7 frames": {"latency_s": 2.7 * PERIOD},
}
STRIBECK = closed_loop.FrictionLaw("stribeck", static_ratio=1.4, stribeck_velocity=0.05)
FRICTION = {
    "exact": {},
    "smoothed": {"smoothing_velocity": 0.05, "steps": 8},
    "stribeck": {"friction": STRIBECK},
}


@pytest.fixture(scope="module", autouse=True)
def compiler():
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")


def _sensor(lost=(), bias=2e-5):
    """A sensor with a repeatable error that loses some frames."""

    def measure(frame, time, pose):
        if frame in lost:
            return None
        return pose + bias * np.sin(frame + np.arange(6))

    return measure


def _assert_same(compiled, plain, tolerance=1e-9):
    assert compiled.events == plain.events
    np.testing.assert_array_equal(compiled.measured_ok, plain.measured_ok)
    for name in ("time", "pose", "pose_rate", "torque", "command", "measured"):
        ours, other = getattr(compiled, name), getattr(plain, name)
        scale = np.nanmax(np.abs(other))
        np.testing.assert_allclose(ours, other, atol=tolerance * scale, rtol=0, err_msg=name)
    if plain.pose_sensitivity is not None:
        largest = np.abs(plain.pose_sensitivity).max(axis=(0, 1))
        # Columns that are zero in exact arithmetic (inertias that do no work) hold rounding only.
        miss = np.abs(compiled.pose_sensitivity - plain.pose_sensitivity).max(axis=(0, 1))
        assert (miss <= tolerance * largest + 1e-14).all(), miss / largest


@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("timing", TIMINGS)
def test_compiled_run_equals_plain_run(robot, identified, make_reference, make_settings, timing, friction):
    """C and NumPy, written apart, agree to 1e-9 in pose, rate, torque, command and all 67 sensitivities."""
    settings, reference = make_settings(**TIMINGS[timing], **FRICTION[friction]), make_reference(32)
    runs = [
        closed_loop.simulate(robot, identified, reference, settings, sensitivities=True, compiled=compiled)
        for compiled in (True, False)
    ]
    assert (runs[1].events > 3) == (friction != "smoothed")
    _assert_same(*runs)


def test_compiled_run_equals_plain_run_with_lost_frames(robot, identified, make_reference, make_settings):
    """A sensor with errors that loses the first frame, single frames and two in a row: both hold the last command."""
    settings, reference, lost = make_settings(latency_s=0.4 * PERIOD), make_reference(24), {0, 5, 9, 10}
    runs = [
        closed_loop.simulate(robot, identified, reference, settings, _sensor(lost), compiled=compiled)
        for compiled in (True, False)
    ]
    _assert_same(*runs)
    run = runs[0]
    assert set(np.flatnonzero(~run.measured_ok)) == lost
    assert np.isnan(run.measured[sorted(lost)]).all()
    np.testing.assert_array_equal(run.command[[5, 9, 10]], run.command[[4, 8, 8]])
    np.testing.assert_allclose(run.command[0], robot.inverse_kinematics(robot.home_pose), atol=1e-15)


@pytest.mark.parametrize("compiled", [True, False])
def test_noise_of_the_ideal_sensor_is_a_sensor_with_that_noise(
    robot, identified, make_reference, make_settings, compiled
):
    """Rows of noise, with frames lost, do what a sensor that adds them and answers None does."""
    settings, reference = make_settings(latency_s=0.4 * PERIOD), make_reference(12)
    noise, lost = 2e-5 * np.sin(np.arange(12)[:, None] + np.arange(6)), np.isin(np.arange(12), (0, 5))
    asked = closed_loop.simulate(robot, identified, reference, settings, _sensor({0, 5}), compiled=compiled)
    drawn = closed_loop.simulate(robot, identified, reference, settings, noise=noise, lost=lost, compiled=compiled)
    for name in ("pose", "measured", "measured_ok", "command"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(asked, name), err_msg=name)


@pytest.mark.parametrize("compiled", [True, False])
def test_ideal_sensor_with_lost_frames_is_a_sensor_that_loses_them(
    robot, identified, make_reference, make_settings, compiled
):
    """A mask of lost frames does what a perfect sensor that answers None does; sensitivities then still come."""
    settings, reference, lost = make_settings(latency_s=0.4 * PERIOD), make_reference(24), {0, 5, 9, 10}
    mask = np.isin(np.arange(24), list(lost))
    masked = closed_loop.simulate(robot, identified, reference, settings, lost=mask, compiled=compiled)
    sensed = closed_loop.simulate(robot, identified, reference, settings, _sensor(lost, bias=0.0), compiled=compiled)
    assert np.array_equal(masked.pose, sensed.pose)
    assert np.array_equal(masked.command, sensed.command)
    with_tangents = closed_loop.simulate(
        robot, identified, reference, settings, lost=mask, sensitivities=True, compiled=compiled
    )
    step = np.zeros(67)
    step[52] = 1e-5
    ahead, behind = (
        closed_loop.simulate(robot, identified + sign * step, reference, settings, lost=mask, compiled=compiled).pose
        for sign in (1, -1)
    )
    expected = (ahead - behind) / 2e-5
    assert np.abs(with_tangents.pose_sensitivity[:, :, 52] - expected).max() < 1e-3 * np.abs(expected).max()


def test_compiled_run_equals_plain_run_with_logged_commands(robot, identified, make_reference, make_settings):
    """Driven by recorded commands, with sensitivities (the servo's share is then absent)."""
    settings, reference = make_settings(), make_reference(24)
    commands = closed_loop.simulate(robot, identified, reference, settings).command * 1.01
    options = {"commands": commands, "sensitivities": True}
    runs = [closed_loop.simulate(robot, identified, reference, settings, compiled=c, **options) for c in (True, False)]
    _assert_same(*runs)
    np.testing.assert_array_equal(runs[0].command, commands)


def test_servo_follows_equation_30(robot, identified, make_reference, make_settings):
    """Commands recomputed from the measured poses of a run, in three lines of NumPy, equal those the loop issued."""
    settings, reference = make_settings(), make_reference(30)
    run = closed_loop.simulate(robot, identified, reference, settings, _sensor())
    gains = settings.servo
    error = reference.poses - run.measured
    start = closed_loop.equilibrium(robot, identified, reference.poses[0], gains).servo_integral
    integral = start + PERIOD * np.cumsum(error, axis=0)
    rate = np.diff(np.vstack([reference.poses[:1], run.measured]), axis=0) / PERIOD
    demand = gains.kp * error + gains.kd * (reference.rates - rate) + gains.ki * integral
    expected = (robot.pose_jacobian(run.measured) @ demand[..., None])[..., 0]
    np.testing.assert_allclose(run.command, expected, atol=1e-13)


def test_commands_arrive_after_the_latency(robot, identified, make_settings):
    """A step of the logged command, given at frame 10, first moves the platform in the frame that it reaches."""
    poses = np.tile(robot.home_pose, (24, 1))
    reference, commands = closed_loop.Reference(poses, 0 * poses), np.zeros((24, 6))
    commands[10:] = 0.05
    for latency, first_moved in ((0.0, 11), (0.6, 11), (1.0, 12), (2.5, 13), (3.0, 14)):
        settings = make_settings(latency_s=latency * PERIOD)
        run = closed_loop.simulate(robot, identified, reference, settings, commands=commands)
        moved = np.flatnonzero(np.abs(run.pose - robot.home_pose).max(axis=1))
        assert moved[0] == first_moved, latency


def test_run_starts_in_equilibrium(robot, identified, make_settings):
    """With the reference at rest, away from home, nothing moves and the torque holds the weight exactly."""
    pose = robot.home_pose + np.array([0.005, -0.004, 0.006, 0.02, -0.01, 0.03])
    poses = np.tile(pose, (60, 1))
    settings, reference = make_settings(), closed_loop.Reference(poses, 0 * poses)
    run = closed_loop.simulate(robot, identified, reference, settings)
    np.testing.assert_allclose(run.pose, poses, atol=1e-14)
    weight = robot.static_torque(pose, identified[:64])
    np.testing.assert_allclose(run.torque, np.tile(weight, (60, 1)), atol=1e-11)


@pytest.mark.parametrize("compiled", [True, False])
def test_unstable_loop_ends_with_frame_and_reason(robot, make_reference, make_settings, compiled):
    """Table 1 parameters at 29 Hz with one frame of delay: the loop is unstable and says where it ended."""
    settings, reference = make_settings(29.0, latency_s=1 / 29), make_reference(580, 29.0)
    with pytest.raises(closed_loop.LoopFailure, match=r"stopped at frame \d+ \(t = .* s\): .*unstable") as caught:
        closed_loop.simulate(robot, robot.parameter_sets["initial"].vector, reference, settings, compiled=compiled)
    assert 5 < caught.value.frame < 580
    assert f"frame {caught.value.frame} " in str(caught.value)


def _reach_margins(robot, pose, numerics):
    """1 - cos^2 of the angle between crank and reach (6,) by the law of cosines in each crank's plane."""
    g = robot.geometry
    reach = pose[:3] + g.platform_joints @ numerics.base_from_platform(pose).T - g.base_joints
    square = np.sum(reach**2, axis=1)
    in_plane = square - np.sum(reach * g.crank_axes, axis=1) ** 2
    return 1 - ((square + g.crank_length**2 - g.link_length**2) / (2 * g.crank_length)) ** 2 / in_plane


def test_the_leg_that_leaves_its_reach_is_named(robot, make_reference, make_settings, numerics):
    """Both paths, written apart, name the same leg and margin, out of reach; at the frame before, all legs reach."""
    settings, reference = make_settings(29.0, latency_s=1 / 29), make_reference(580, 29.0)
    unstable, messages = robot.parameter_sets["initial"].vector, []
    for compiled in (True, False):
        with pytest.raises(closed_loop.LoopFailure) as caught:
            closed_loop.simulate(robot, unstable, reference, settings, compiled=compiled)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]
    margin = re.search(r"unstable\): leg [1-6] has the least reach margin, (\S+), must be > 0$", messages[0])
    assert -0.5 < float(margin[1]) <= 0
    stop = caught.value.frame + 1
    shorter = closed_loop.Reference(reference.poses[:stop], reference.rates[:stop])
    assert _reach_margins(robot, closed_loop.simulate(robot, unstable, shorter, settings).pose[-1], numerics).min() > 0


def test_stable_where_the_paper_is(robot, identified, make_reference, make_settings):
    """Table 2 parameters at 29 Hz with one frame of delay follow the reference within 20 mm for 20 s."""
    settings, reference = make_settings(29.0, latency_s=1 / 29), make_reference(580, 29.0, scale=0.5)
    run = closed_loop.simulate(robot, identified, reference, settings)
    assert np.abs(run.pose - reference.poses)[:, :3].max() < 0.02


class Unplugged(Exception):
    """A stranger's error."""


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("error", [Unplugged("cable"), KeyboardInterrupt()], ids=["exception", "interrupt"])
def test_errors_of_the_sensor_reach_the_caller_unchanged(
    robot, identified, make_reference, make_settings, compiled, error
):
    """The very exception object that the sensor raised comes out, and the sensor is not called again."""
    calls = []

    def sensor(frame, time, pose):
        calls.append(frame)
        if frame == 7:
            raise error
        return pose

    with pytest.raises(type(error)) as caught:
        closed_loop.simulate(robot, identified, make_reference(20), make_settings(), sensor, compiled=compiled)
    assert caught.value is error
    assert calls == list(range(8))


@pytest.mark.parametrize("compiled", [True, False])
def test_measured_pose_out_of_reach_ends_the_run(robot, identified, make_reference, make_settings, numerics, compiled):
    """A gross measurement error at frame 3 is named as such, not as instability, with leg and margin."""
    answers = []

    def sensor(frame, time, pose):
        answers.append(pose + (frame == 3))
        return answers[-1]

    with pytest.raises(closed_loop.LoopFailure, match=r"frame 3 .*measured pose is out of reach") as caught:
        closed_loop.simulate(robot, identified, make_reference(5), make_settings(), sensor, compiled=compiled)
    margins = _reach_margins(robot, answers[-1], numerics)
    leg = int(np.argmin(margins))
    assert margins[leg] < 0
    assert f"there leg {leg + 1} has the least reach margin, {margins[leg]:.3g}, must be > 0" in str(caught.value)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_measured_pose_that_overflows_ends_the_run_without_warnings(
    robot, identified, make_reference, make_settings, compiled
):
    """Differences of the largest floats are infinite; the error is the only thing said."""
    settings, sensor = make_settings(), lambda frame, time, pose: np.full(6, 1e308)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(closed_loop.LoopFailure, match=r"frame 0 .*least reach margin, -inf, must be > 0"):
            closed_loop.simulate(robot, identified, make_reference(5), settings, sensor, compiled=compiled)


def test_runs_in_threads_equal_runs_in_turn(robot, identified, make_reference, make_settings):
    """The compiled loop keeps no state between calls: sixteen runs on four threads give the same bits."""
    settings, reference = make_settings(), make_reference(120)
    sets = [identified * (1 + 0.001 * n * np.cos(np.arange(67))) for n in range(16)]

    def run(values):
        return closed_loop.simulate(robot, values, reference, settings, _sensor({4})).pose

    expected = [run(values) for values in sets]
    with ThreadPoolExecutor(4) as pool:
        for ours, other in zip(pool.map(run, sets), expected, strict=True):
            np.testing.assert_array_equal(ours, other)


def _forget():
    for cached in (compilation.find_compiler, compilation.can_compile, robot_module._functions):
        cached.cache_clear()


@pytest.fixture
def compiled_results(robot, identified, states, make_reference, make_settings):
    """Accelerations and a run from the compiled path, taken before the compiler is taken away."""
    accelerations = robot.forward_dynamics(states.pose, states.twist, states.twist_dot)
    run = closed_loop.simulate(robot, identified, make_reference(10), make_settings(), compiled=True)
    return accelerations, run


@pytest.fixture(params=["missing", "broken", "no folder"])
def no_compiler(request, compiled_results, monkeypatch, tmp_path):
    """A machine without a compiler; with one that has no headers; without a folder to write to."""
    if request.param == "missing":
        monkeypatch.setenv("CC", "none-existing")
    if request.param == "broken":
        script = tmp_path / "cc"
        script.write_text("#!/bin/sh\necho 'fatal error: math.h: No such file' >&2\nexit 1\n")
        script.chmod(0o755)
        monkeypatch.setenv("CC", str(script))
        monkeypatch.setenv("CMMSIM_CACHE", str(tmp_path / "cache"))
    if request.param == "no folder":
        (tmp_path / "file").touch()
        monkeypatch.setenv("CMMSIM_CACHE", str(tmp_path / "file" / "cache"))
    _forget()
    yield {"missing": "no C compiler found", "broken": "math.h", "no folder": "CMMSIM_CACHE"}[request.param]
    _forget()


def test_everything_works_without_a_compiler_after_one_warning(
    identified, states, make_reference, make_settings, compiled_results, no_compiler
):
    """Robot and loop fall back to CasADi's virtual machine with the same numbers, and say so in exactly one line."""
    reference, settings = make_reference(10), make_settings()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fresh = robot_module.Robot(robot_file.read_robot_file("rss6"))
        accelerations = fresh.forward_dynamics(states.pose, states.twist, states.twist_dot)
        runs = [closed_loop.simulate(fresh, identified, reference, settings) for _ in range(2)]
        with pytest.raises(SimulationError, match="compiled=True"):
            closed_loop.simulate(fresh, identified, reference, settings, compiled=True)
    assert [warning.category for warning in caught] == [compilation.CompilerWarning]
    assert no_compiler in str(caught[0].message)
    assert "\n" not in str(caught[0].message)
    np.testing.assert_allclose(accelerations, compiled_results[0], rtol=1e-10, atol=1e-12)
    _assert_same(compiled_results[1], runs[1])


def test_robots_of_equal_geometry_share_what_was_built(robot):
    """Loading a robot again builds nothing anew; another geometry is another key."""
    again = robot_module.load_robot("rss6")
    assert again is not robot
    assert again.functions is robot.functions
    assert again.geometry == robot.geometry
    assert plain_closed_loop._functions(again.geometry) is plain_closed_loop._functions(robot.geometry)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_singular_mass_matrix_is_said(robot, identified, make_reference, make_settings, compiled):
    """A platform without inertia on massless legs cannot be accelerated: named as such, on both paths."""
    parameters = identified.copy()
    parameters[1:64] = 0
    with pytest.raises(DynamicsError, match=r"not positive definite|singular"):
        closed_loop.simulate(robot, parameters, make_reference(10), make_settings(), compiled=compiled)
