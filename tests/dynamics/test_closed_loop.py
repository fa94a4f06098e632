"""The sampled loop: compiled against plain, the frame protocol, a user's controller, batches, runs
that end early.
"""

import itertools
import re
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from dynamics import closed_loop, simulate_batch
from dynamics.closed_loop.frame_kernels import run_frames
from dynamics.errors import DynamicsError, SimulationError
from tests.dynamics.conftest import Loop, assert_same, at_rest

PERIOD, FRAMES, TWIN_FRAMES = 1 / 60, 32, 5
LATE = {"latency_s": 1.3 * PERIOD, "hold": "linear"}
JITTERED = PERIOD * np.random.default_rng(3).uniform(0.0, 3.2, FRAMES)
SOFT = closed_loop.JointElasticity(stiffness=500.0, motor_inertia=7e-4, damping=0.02)
STRIBECK = closed_loop.FrictionLaw("stribeck", static_ratio=1.5, stribeck_velocity=0.05)
paths = pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "plain"])


def _sensor(lost=(), bias=2e-5):
    """A sensor with a repeatable error that loses some frames."""

    def measure(frame, time, pose):
        return None if frame in lost else pose + bias * np.sin(frame + np.arange(6))

    return measure


LOST, NOISE = (
    np.isin(np.arange(24), (0, 5, 9, 10)),
    2e-5 * np.sin(np.arange(24)[:, None] + np.arange(6)),
)
DERIVED = {"sensitivities": True}
ELASTIC = {"elasticity": SOFT, "rate_hz": 240.0, "steps": 5, **LATE}
TWINS = {
    "no delay": ({}, DERIVED),
    "half a frame": ({"latency_s": 0.5 * PERIOD}, DERIVED),
    "one frame": ({"latency_s": PERIOD}, DERIVED),
    "2.7 frames": ({"latency_s": 2.7 * PERIOD}, DERIVED),
    "linear": ({"hold": "linear"}, DERIVED),
    "linear, jitter": (LATE, {"latencies": JITTERED[:TWIN_FRAMES], **DERIVED}),
    "jitter": ({}, {"latencies": JITTERED[:TWIN_FRAMES], **DERIVED}),
    "smoothed": ({"smoothing_velocity": 0.05, "steps": 2, **LATE}, DERIVED),
    "stribeck": ({"friction": STRIBECK, **LATE}, DERIVED),
    "logged commands": (
        {},
        {"commands": 0.02 * np.sin(np.arange(TWIN_FRAMES)[:, None] + np.arange(6)), **DERIVED},
    ),
    "lost frames": ({"latency_s": 0.4 * PERIOD}, {"sensor": _sensor({0, 2, 3})}),
    "from a state": ({}, {"start_sensitivities": True}),
    "late, from a state": (LATE, {"start_sensitivities": True}),
    "elastic, from a state": (ELASTIC, {}),
    "elastic, Stribeck, from a state": ({"friction": STRIBECK, **ELASTIC}, {}),
}


# Cases whose every line another case runs too.
THOROUGH = ("no delay", "half a frame", "linear", "jitter", "from a state", "elastic, from a state")


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [pytest.param(one, marks=pytest.mark.thorough) if one in THOROUGH else one for one in TWINS],
)
def test_compiled_run_equals_plain_run(loop, case):
    """The same lines as machine code and as Python calls them: all records and sensitivities are
    equal bit for bit, but for what hyperbolic functions round. Five frames with events, from
    within a motion."""
    settings, options = loop.settings(**{"steps": 1} | TWINS[case][0]), dict(TWINS[case][1])
    loop.run(TWIN_FRAMES)
    kernels = list(run_frames.signatures)
    reference = loop.reference(TWIN_FRAMES)
    if "commands" not in options:  # those start in equilibrium, which moves with the parameters
        reference, options["start"] = loop.half_way(26 + TWIN_FRAMES, 26, settings)
    compiled, plain = loop.both(reference, settings, **options)
    assert_same(compiled, plain, 1e-13)
    assert (plain.events > 1) == (case != "smoothed")
    assert run_frames.signatures == kernels  # that of a plain run serves those of all kinds


def _acting(t, arrivals, hold, commands):
    """Command (6,) that acts at a time t, and its U_dot: the definition, by a clock. Arrivals are
    those of `commands`, of which the first three were issued before the run."""
    newest = np.flatnonzero(arrivals <= t)[-1]
    rate = (commands[newest] - commands[newest - 1]) / PERIOD
    short = 0.0 if hold == "zero" else max(0.0, PERIOD - (t - arrivals[newest]))
    return commands[newest] - short * rate, rate


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("latencies", [JITTERED, np.full(FRAMES, 2 * PERIOD), None])
def test_each_command_acts_from_its_arrival_and_never_before_the_one_before_it(
    loop, latencies, hold
):
    """Commands so small that dry friction holds all joints: the joint PID integrates what acts,
    less a fixed angle.
    """
    usual, issued = 1.3 * PERIOD, PERIOD * np.arange(FRAMES)
    settings, reference = (
        loop.settings(latency_s=usual, hold=hold),
        at_rest(loop.robot.home_pose, FRAMES),
    )
    commands = 1e-4 * np.random.default_rng(8).normal(size=(FRAMES, 6))
    run = loop.run(reference, settings, commands=commands, latencies=latencies)
    assert run.events == 0
    arrivals = issued + (usual if latencies is None else latencies)
    arrivals = np.maximum.accumulate(np.r_[-9, -9, usual - PERIOD, arrivals])
    commands, turns = (
        np.vstack([np.zeros((3, 6)), commands]),
        np.concatenate([arrivals, arrivals + PERIOD, issued]),
    )
    (lp, li, ld), integral = loop.parameters[64:], run.start.joint_integral
    for t, torque, ours in zip(issued, run.torque, run.joint_integral, strict=True):
        np.testing.assert_allclose(ours, integral, rtol=0, atol=1e-14)
        command, rate = _acting(t + 1e-12, arrivals, hold, commands)
        np.testing.assert_allclose(
            torque, lp * command + li * integral + ld * rate, rtol=0, atol=1e-12
        )
        times = np.unique(np.clip(turns, t, t + PERIOD))
        integral = integral + sum(
            (end - begin) * _acting((begin + end) / 2, arrivals, hold, commands)[0]
            for begin, end in itertools.pairwise(times)
        )
    if latencies is None:
        same = loop.run(reference, settings, commands=run.command, latencies=np.full(FRAMES, usual))
        np.testing.assert_array_equal(same.joint_integral, run.joint_integral)


def test_a_lost_frame_holds_the_command_before_it_whether_a_sensor_lost_it_or_a_mask(loop):
    """The first frame, single frames and two in a row; masks and rows of noise do what a sensor
    that adds them and answers None does."""
    settings = loop.settings(latency_s=0.4 * PERIOD)
    asked = loop.run(24, settings, sensor=_sensor({0, 5, 9, 10}))
    drawn = loop.run(24, settings, noise=NOISE, lost=LOST)
    for name in ("pose", "measured", "measured_ok", "command"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(asked, name), err_msg=name)
    np.testing.assert_array_equal(asked.measured_ok, ~LOST)
    assert np.isnan(asked.measured[LOST]).all()
    np.testing.assert_array_equal(asked.command[[5, 9, 10]], asked.command[[4, 8, 8]])
    np.testing.assert_allclose(
        asked.command[0], loop.robot.inverse_kinematics(loop.robot.home_pose), atol=1e-15
    )


def test_a_sensor_is_asked_once_a_frame_for_the_true_pose_and_a_rate_sensor_gets_its_rate_too(loop):
    """A perfect one makes the run of the ideal one, bit by bit."""
    seen = []

    def measure(*true):
        seen.append(true)
        return true[2]

    ideal = loop.run(24)
    for sensor in (measure, closed_loop.RateSensor(measure)):
        seen.clear()
        run = loop.run(24, sensor=sensor)
        records = (np.arange(24), np.arange(24) * (1 / 60), run.pose, run.pose_rate)
        for column, expected in zip(zip(*seen, strict=True), records, strict=sensor is not measure):
            np.testing.assert_array_equal(column, expected)
        np.testing.assert_array_equal(run.pose, ideal.pose)
    assert np.abs(run.pose_rate).max() > 0.01


def test_logged_commands_drive_and_what_is_measured_beside_them_steers_nothing(loop):
    """The commands of a run repeat it bit by bit, whatever the servo's gains, sensors and lost
    frames.
    """
    first = loop.run(20)
    plain = loop.settings()
    other = closed_loop.LoopSettings(closed_loop.ServoGains(9.0, 9.0, 9.0), plain.timing)
    np.testing.assert_array_equal(loop.run(20, other, commands=first.command).pose, first.pose)
    sensed = loop.run(
        20,
        sensor=lambda frame, time, pose: None if frame == 2 else pose + 0.1,
        commands=first.command,
    )
    np.testing.assert_array_equal(sensed.pose, first.pose)
    np.testing.assert_array_equal(sensed.command, first.command)
    np.testing.assert_array_equal(
        np.delete(sensed.measured, 2, axis=0), np.delete(first.pose, 2, axis=0) + 0.1
    )
    np.testing.assert_array_equal(sensed.measured_ok, np.arange(20) != 2)


def _paper_servo(robot, settings, start):
    """Eq. 30, written down once more from the robot's public Jacobian; it starts as the loop's
    equilibrium does.
    """
    gains, period = settings.servo, 1 / settings.timing.frame_rate_hz
    before, before_at = start, -period
    integral = (
        np.linalg.solve(robot.pose_jacobian(start), robot.inverse_kinematics(start)) / gains.ki
    )

    def command(frame, t, measured, desired, desired_rate):
        nonlocal before, before_at, integral
        error, rate = desired - measured, (measured - before) / (t - before_at)
        integral, before, before_at = integral + period * error, measured, t
        demand = gains.kp * error + gains.kd * (desired_rate - rate) + gains.ki * integral
        return robot.pose_jacobian(measured) @ demand

    return command


@pytest.mark.parametrize(
    ("latency_s", "measured"),
    [(0.0, {"sensor": _sensor({5, 6, 17})}), (0.025, {"lost": LOST, "noise": NOISE})],
)
def test_the_servo_of_equation_30_written_by_a_user_runs_as_the_built_in_one(
    robot, loop, latency_s, measured
):
    """As a controller, with a sensor that errs and loses frames or with noise and a mask, and late
    commands.
    """
    settings, reference = loop.settings(latency_s=latency_s), loop.reference(24)
    own = loop.run(
        reference,
        settings,
        controller=_paper_servo(robot, settings, reference.poses[0]),
        **measured,
    )
    built_in = loop.run(reference, settings, **measured)
    np.testing.assert_allclose(own.command, built_in.command, atol=1e-11)
    np.testing.assert_allclose(own.pose, built_in.pose, atol=1e-11)
    assert np.abs(np.diff(own.command, axis=0)).max() > 1e-3


def test_a_controller_is_asked_with_copies_where_the_frame_was_measured(robot, loop):
    reference, asked, command = loop.reference(20), [], np.zeros(6)

    def spoiling(frame, t, measured, desired, desired_rate):
        asked.append((frame, t))
        assert np.array_equal(desired, reference.poses[frame])
        assert np.array_equal(desired_rate, reference.rates[frame])
        command[:] = robot.inverse_kinematics(desired)
        measured[:] = np.nan
        return command

    run = loop.run(reference, sensor=_sensor({5, 6, 17}), controller=spoiling)
    good = [frame for frame in range(20) if frame not in (5, 6, 17)]
    assert asked == [(frame, frame * (1 / 60)) for frame in good]
    assert np.isfinite(run.measured[good]).all()
    np.testing.assert_array_equal(
        run.command[good], robot.inverse_kinematics(reference.poses[good])
    )
    np.testing.assert_array_equal(run.command[[5, 6, 17]], run.command[[4, 4, 16]])


def test_run_starts_in_equilibrium(robot, loop):
    """With the reference at rest, away from home, nothing moves and the torque holds the weight
    exactly.
    """
    pose = robot.home_pose + np.array([0.005, -0.004, 0.006, 0.02, -0.01, 0.03])
    reference = at_rest(pose, 60)
    run = loop.run(reference)
    np.testing.assert_allclose(run.pose, reference.poses, atol=1e-14)
    weight = robot.static_torque(pose, loop.parameters[:64])
    np.testing.assert_allclose(run.torque, np.tile(weight, (60, 1)), atol=1e-11)


def test_the_loop_is_stable_where_the_paper_is_or_names_frame_time_and_the_leg_that_leaves_its_reach(
    robot, loop
):
    """At 29 Hz with one frame of delay Table 2 follows for 20 s within 20 mm; Table 1 does not: at
    the frame before, all legs reach."""
    settings, reference = (
        loop.settings(29.0, latency_s=1 / 29),
        loop.reference(580, 29.0, scale=0.5),
    )
    assert np.abs(loop.run(reference, settings).pose - reference.poses)[:, :3].max() < 0.02
    reference = loop.reference(580, 29.0)
    unstable = robot.parameter_sets["guess"].vector
    with pytest.raises(closed_loop.LoopFailure) as caught:
        loop.run(reference, settings, unstable)
    frame = caught.value.frame
    assert 5 < frame < 580
    said = rf"stopped at frame {frame} \(t = .* s\): .*unstable\): leg [1-6] has the least reach margin, (\S+), must be"
    margin = re.search(said, str(caught.value))
    assert -0.5 < float(margin[1]) <= 0
    shorter = closed_loop.Reference(reference.poses[: frame + 1], reference.rates[: frame + 1])
    assert robot.reach_margin(loop.run(shorter, settings, unstable).pose[-1]).min() > 0


@pytest.mark.parametrize("asked", ["sensor", "controller"])
@pytest.mark.parametrize(
    "error", [ConnectionError("cable"), KeyboardInterrupt()], ids=["exception", "interrupt"]
)
def test_errors_of_sensor_and_controller_reach_the_caller_unchanged(robot, loop, error, asked):
    """The very exception object that was raised comes out, nobody is called again, and the next run
    is as ever.
    """
    poses, before = loop.reference(7).poses, loop.run(20)
    answers = poses if asked == "sensor" else robot.inverse_kinematics(poses)
    failing = Mock(side_effect=[*answers, error])
    with pytest.raises(type(error)) as caught:
        loop.run(20, **{asked: failing})
    assert caught.value is error
    assert failing.call_count == 8
    assert_same(loop.run(20), before, 0.0)


@paths
def test_measured_pose_out_of_reach_ends_the_run_without_warnings(robot, loop, compiled):
    """A gross error at frame 3 is named as such, with leg and margin; one that overflows has a
    margin of -inf.
    """
    answers = []

    def sensor(frame, time, pose):
        answers.append(pose + (frame == 3))
        return answers[-1]

    with pytest.raises(
        closed_loop.LoopFailure, match=r"frame 3 .*measured pose is out of reach"
    ) as caught:
        loop.run(5, sensor=sensor, compiled=compiled)
    margins = robot.reach_margin(answers[-1])
    leg = int(np.argmin(margins))
    assert margins[leg] < 0
    assert (
        f"there leg {leg + 1} has the least reach margin, {margins[leg]:.3g}, must be > 0"
        in str(caught.value)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(
            closed_loop.LoopFailure, match=r"frame 0 .*least reach margin, -inf, must be > 0"
        ):
            loop.run(5, sensor=lambda frame, time, pose: np.full(6, 1e308), compiled=compiled)


@paths
def test_a_singular_mass_matrix_is_said(loop, compiled):
    """A platform without inertia on massless legs cannot be accelerated: named as such, on both
    paths.
    """
    parameters = loop.parameters.copy()
    parameters[1:64] = 0
    with pytest.raises(DynamicsError, match=r"not positive definite|singular"):
        loop.run(10, parameters=parameters, compiled=compiled)


def test_a_batch_is_its_runs_in_order_for_any_number_of_workers(robot, loop):
    """Many vectors with one reference; one vector with many references, or with many starts, as
    multiple shooting wants them. Runs with a sensor on four threads are those in turn: no run
    leaves anything behind for another."""

    def compare(runs, references, vectors, starts, **options):
        for run, reference, vector, start in zip(runs, references, vectors, starts, strict=True):
            alone = loop.run(reference, parameters=vector, start=start, **options)
            for name in ("pose", "pose_sensitivity", "start_sensitivity"):
                np.testing.assert_array_equal(
                    getattr(run, name), getattr(alone, name), err_msg=name
                )
        assert not np.array_equal(runs[0].pose, runs[1].pose)

    settings, reference, one = loop.settings(), loop.reference(30), loop.parameters
    vectors = [one * (1 + 0.001 * n * np.cos(np.arange(67))) for n in range(16)]
    for workers in (1, 3):
        runs = simulate_batch(
            robot, vectors[:5], reference, settings, sensitivities=True, workers=workers
        )
        compare(runs, [reference] * 5, vectors[:5], [None] * 5, sensitivities=True)
    sensor = _sensor({4})
    with ThreadPoolExecutor(4) as pool:
        runs = list(
            pool.map(lambda values: loop.run(120, parameters=values, sensor=sensor), vectors)
        )
    compare(runs, [120] * 16, vectors, [None] * 16, sensor=sensor)
    references = [loop.reference(20, scale=scale) for scale in (0.5, 1.0)]
    compare(simulate_batch(robot, one, references, settings), references, [one] * 2, [None] * 2)
    start = loop.run(reference).state_at(20)
    starts = [
        replace(start, joint_integral=start.joint_integral + change) for change in (0, 1e-5, 2e-5)
    ]
    runs = simulate_batch(robot, one, reference, settings, starts=starts, start_sensitivities=True)
    compare(runs, [reference] * 3, [one] * 3, starts, start_sensitivities=True)
    with pytest.raises(
        SimulationError, match="5 parameter vectors and 1 references and 3 start states"
    ):
        simulate_batch(robot, vectors[:5], reference, settings, starts=starts)


@pytest.mark.slow  # compiles the plant
def test_the_servo_commands_with_the_kinematics_it_knows(loop, robot):
    """As a user's servo with the nominal robot does, and as when plain; one that knows the plant
    commands otherwise, and one that knows its robot as ever."""
    plant = robot.with_geometry(robot.geometry.with_errors(1e-4, np.random.default_rng(3)))
    reference, theirs = loop.reference(40), Loop(plant, loop.parameters)
    assert_same(*theirs.both(4, sensor=_sensor(), servo_robot=robot), 1e-13)
    run = theirs.run(reference, sensor=_sensor(), servo_robot=robot)
    assert run.events > 3
    servo = _paper_servo(robot, loop.settings(), reference.poses[0])
    np.testing.assert_allclose(
        theirs.run(reference, sensor=_sensor(), controller=servo).command, run.command, atol=1e-11
    )
    assert np.abs(run.pose - theirs.run(reference, sensor=_sensor()).pose).max() > 1e-7
    np.testing.assert_array_equal(
        loop.run(reference, servo_robot=robot).pose, loop.run(reference).pose
    )
