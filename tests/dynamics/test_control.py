"""Laws that know a model: what they make the robot do, by simulated plants, and what their linear
figures foretell.
"""

from dataclasses import replace

import numpy as np
import pytest

import dynamics
from dynamics.closed_loop import (
    Drives,
    EveryFrame,
    FrameTiming,
    FrictionLaw,
    IdealSensor,
    LoopFailure,
    LoopSettings,
    Reference,
    ServoGains,
    equilibrium,
    simulate_commands,
    simulate_controller,
    simulate_servo,
    stability,
)
from dynamics.control.computed_torque import DecayingErrors, computed_torque, error_map
from dynamics.control.feedforward import feedforward, joint_commands
from dynamics.control.gains import design_drives, design_servo, servo_figures, torque_figures
from dynamics.control.inverse_dynamics import FITTED_DOUBT, Model, spans
from dynamics.control.law_interface import Assignment, Feedback
from dynamics.errors import SimulationError

SERVO = ServoGains(0.3, 0.001, 2.4)
FAST, SLOW = FrameTiming(60.0), FrameTiming(29.0, 1 / 29)
# Doubt of a model with the plant's parameters: what is left are the steps in which the observer
# follows.
EXACT = 0.6 * FITTED_DOUBT
NOISE = np.diag(np.repeat([5e-6, 30e-6], 3) ** 2)


class Swing:
    """From home and back in every coordinate, at rest and without acceleration at its start."""

    def __init__(self, robot, period_s=2.0, size=0.006):
        chart = robot.geometry.chart
        self.chart, self.w = chart, 2 * np.pi / period_s
        self.home = robot.coordinates(robot.home_pose)
        sizes = np.where(np.array(chart.units) == "m", size, 4 * size)
        self.size = sizes * np.resize([1.0, -0.7, 0.5], len(self.home))

    def _along(self, t, terms):
        return self.chart.lifted(np.asarray(t)[:, None] * 0 + terms[:, None] * self.size)

    def pose(self, t):
        wave = 1 - 4 / 3 * np.cos(self.w * t) + 1 / 3 * np.cos(2 * self.w * t)
        return self.chart.pose(self.home + wave[:, None] * self.size)

    def pose_rate(self, t):
        return self._along(
            t, self.w * (4 / 3 * np.sin(self.w * t) - 2 / 3 * np.sin(2 * self.w * t))
        )

    def pose_acceleration(self, t):
        return self._along(t, self.w**2 * 4 / 3 * (np.cos(self.w * t) - np.cos(2 * self.w * t)))


def follow(
    robot,
    timing,
    law,
    seconds=4.0,
    noise=NOISE,
    dropout=0.0,
    jitter=0.0,
    known=None,
    drive="pid",
    **feedback,
):
    """A run of the true robot under a law, its errors (N, 6), and what the observer expected."""
    parameters, frames = (
        robot.parameter_sets["truth"].vector,
        round(seconds * timing.frame_rate_hz),
    )
    settings = LoopSettings(SERVO, timing, steps_per_frame=8, drives=Drives(law=drive))
    rng = np.random.default_rng(1)
    times, motion = np.arange(frames) / timing.frame_rate_hz, Swing(robot)
    latencies = timing.latency_s + jitter / timing.frame_rate_hz * np.clip(
        rng.standard_normal(frames), -1, 1
    )
    lost = rng.random(frames) < dropout
    drawn = rng.standard_normal((frames, 6)) * np.sqrt(np.diag(noise))
    reference = Reference(motion.pose(times), motion.pose_rate(times))
    task = Assignment(
        Model(
            robot,
            *(
                (parameters, settings.friction, EXACT)
                if known is None
                else (known, settings.friction)
            ),
        ),
        motion,
        frames,
        settings,
        Feedback(**({"bandwidth": timing.frame_rate_hz} | feedback)),
        robot.static_torque(reference.poses[0], parameters[robot.layout.dynamic]),
        latencies,
        lambda frame: noise,
    )
    given = law(task) if law else None
    settings = settings if given is None else replace(settings, drives=given.drives)

    def sensor(frame, time, pose):
        return None if lost[frame] else pose + drawn[frame]

    loop = {"sensor": sensor, "latencies": latencies}
    if given is None or given.controller is None:
        loop["feedforward"] = given and given.feedforward
        run = simulate_servo(robot, parameters, reference, settings, **loop)
    else:
        run = simulate_controller(robot, parameters, reference, settings, given.controller, **loop)
    return run, run.pose - reference.poses, [] if given is None else given.expected


def size(errors, axes=slice(0, 3)):
    return np.sqrt(np.mean(errors[:, axes] ** 2))


@pytest.mark.parametrize(
    "timing", [FAST, replace(FAST, hold="linear"), SLOW], ids=["60 Hz", "linear", "29 Hz"]
)
@pytest.mark.parametrize(
    "name", ["rss6", pytest.param("ups6", marks=pytest.mark.thorough), "delta3"]
)
def test_feedforward_of_the_true_model_leaves_a_fiftieth_of_what_the_servo_alone_does(name, timing):
    """By simulated plants with dry friction, which know nothing of the law."""
    robot = dynamics.load_robot(name)
    alone = size(follow(robot, timing, None, noise=0 * NOISE)[1])
    fed = size(follow(robot, timing, feedforward, noise=0 * NOISE, observer=False)[1])
    assert fed < alone / 50


@pytest.mark.slow
@pytest.mark.parametrize(
    "timing",
    [
        pytest.param(FAST, id="60 Hz", marks=pytest.mark.thorough),
        pytest.param(SLOW, id="29 Hz"),
    ],
)
def test_computed_torque_with_an_observer_leaves_an_eighth_of_what_the_servo_alone_does(
    robot, timing
):
    """Of positions and of orientations, with dry friction and noise; half as fast it leaves more:
    noise is no limit.
    """
    bandwidths = timing.frame_rate_hz, 0.5 * timing.frame_rate_hz
    alone = follow(robot, timing, None, seconds=2.0)[1]
    own, slow = (
        follow(robot, timing, computed_torque, seconds=2.0, bandwidth=one)[1] for one in bandwidths
    )
    for axes in (slice(0, 3), slice(3, 6)):
        assert size(own, axes) < size(alone, axes) / 8
        assert size(own, axes) < size(slow, axes)


def test_a_torque_held_for_a_frame_brings_the_rates_where_the_way_back_has_them(robot):
    """By the simulated robot without friction, from rest beside where it should be."""
    parameters, motion, period = robot.parameter_sets["guess"].vector, Swing(robot), 1 / 60
    settings = LoopSettings(SERVO, FAST, steps_per_frame=16, drives=Drives(torques=True))
    error = 0.01 * motion.size
    way = DecayingErrors(motion, motion.chart, error_map(Feedback(60.0)), 0.0, error, 0 * error)
    torque = spans(Model(robot, parameters, settings.friction), way, np.zeros(1), period).torque
    beside = np.tile(motion.pose(np.zeros(1))[0] - error, (2, 1))
    run = simulate_commands(
        robot,
        parameters,
        Reference(beside, 0 * beside),
        settings,
        commands=np.vstack([torque, torque]),
    )
    wanted = way.pose_rate(np.array([period]))[0]
    assert np.abs(run.pose_rate[1] - wanted).max() < 0.01 * np.abs(wanted).max()


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["pd", "cascade", "pi"])
def test_feedforward_and_observer_know_the_law_of_the_drives(robot, drive):
    """The true model of the plant, against the servo alone; and the observer's prediction against
    the truth.
    """
    alone = size(follow(robot, FAST, None, noise=0 * NOISE, drive=drive)[1])
    fed = size(follow(robot, FAST, feedforward, noise=0 * NOISE, observer=False, drive=drive)[1])
    assert fed < alone / 1000
    run, _, expected = follow(robot, FAST, feedforward, drive=drive)
    missed = np.array([one.coordinates for one in expected]) - run.pose
    assert size(missed) < 1.4 * np.sqrt(NOISE[0, 0])  # of the PID 1.23


def test_the_pid_gives_the_torque_of_the_inverse_dynamics_in_the_mean_of_each_frame(robot):
    """Oracle: the PID of eq. 31 integrated by hand along the motion, on a fine grid."""
    parameters, motion, fine = robot.parameter_sets["truth"].vector, Swing(robot), 400
    model, frames = Model(robot, parameters, FrictionLaw()), 30
    commands = joint_commands(model, motion, FAST, frames)
    lp, li, ld = parameters[robot.layout.joint_pid]
    start = motion.pose(np.zeros(1))
    integral = robot.static_torque(start, parameters[robot.layout.dynamic])[0] / li
    before = robot.inverse_kinematics(start)[0]
    for k in range(frames):
        t = (k + (np.arange(fine) + 0.5) / fine) / 60
        pose, rate, acceleration = motion.pose(t), motion.pose_rate(t), motion.pose_acceleration(t)
        angle, turning = (
            robot.inverse_kinematics(pose),
            np.einsum("nij,nj->ni", robot.pose_jacobian(pose), rate),
        )
        error = commands[k] - angle
        wound = integral + (np.cumsum(error, axis=0) - error / 2) / fine / 60
        torque = lp * error + ld * (60 * (commands[k] - before) - turning) + li * wound
        twist, twist_dot = robot.twist(pose, rate), robot.twist_dot(pose, rate, acceleration)
        wanted = robot.inverse_dynamics(pose, twist, twist_dot, parameters[robot.layout.dynamic])
        assert (
            np.abs(torque.mean(axis=0) - wanted.mean(axis=0)).max() < 2e-3
        )  # N m; dry friction meets a coarse grid
        integral, before = integral + error.mean(axis=0) / 60, commands[k]


def test_a_feedforward_of_nothing_is_the_servo_bit_for_bit(robot, identified):
    """From the same start."""
    times, motion = np.arange(60) / 60, Swing(robot)
    reference, settings = (
        Reference(motion.pose(times), motion.pose_rate(times)),
        LoopSettings(SERVO, FAST),
    )
    start = equilibrium(robot, identified, reference.poses[0], SERVO)
    alone = simulate_servo(robot, identified, reference, settings, start=start)
    fed = simulate_servo(
        robot, identified, reference, settings, start=start, feedforward=np.zeros((60, 6))
    )
    assert np.array_equal(alone.pose, fed.pose)
    assert np.array_equal(alone.torque, fed.torque)


@pytest.mark.parametrize(
    "drives", [Drives(), Drives(torque_limit=3.0), Drives(torques=True)], ids=str
)
def test_plain_lines_do_what_compiled_code_does(robot, identified, drives):
    times, motion = np.arange(4) / 60, Swing(robot, period_s=0.5)
    reference = Reference(motion.pose(times), motion.pose_rate(times))
    settings = LoopSettings(SERVO, FAST, drives=drives)
    model = Model(robot, identified, settings.friction)
    simulate, asked = simulate_servo, {"feedforward": joint_commands(model, motion, FAST, 4)}
    if drives.torques:
        holding = robot.static_torque(robot.home_pose, identified[robot.layout.dynamic])
        simulate = simulate_commands
        asked = {"commands": holding + np.linspace(0, 1, 4)[:, None]}
    runs = [
        simulate(robot, identified, reference, settings, compiled=compiled, **asked)
        for compiled in (True, False)
    ]
    assert np.allclose(runs[0].pose, runs[1].pose, rtol=0, atol=1e-13)
    assert np.allclose(runs[0].torque, runs[1].torque, rtol=0, atol=1e-10)


def test_drives_that_take_torques_accelerate_the_robot_as_forward_dynamics_says(robot):
    parameters, poses = robot.parameter_sets["guess"].vector, np.tile(robot.home_pose, (3, 1))
    holding = robot.static_torque(robot.home_pose, parameters[robot.layout.dynamic])
    push = holding + np.array([0.1, -0.05, 0.02, 0.0, 0.08, 0.03])
    settings = LoopSettings(SERVO, FrameTiming(1000.0), drives=Drives(torques=True))
    run = simulate_commands(
        robot, parameters, Reference(poses, 0 * poses), settings, commands=np.tile(push, (3, 1))
    )
    wanted = robot.forward_dynamics(
        robot.home_pose, np.zeros(6), push, parameters[robot.layout.dynamic]
    )
    assert np.allclose(run.pose_rate[1] * 1000, wanted, rtol=1e-3, atol=1e-4)
    still = simulate_commands(
        robot, parameters, Reference(poses, 0 * poses), settings, commands=np.tile(holding, (3, 1))
    )
    assert np.abs(still.pose_rate).max() < 1e-12


def test_an_actuator_gives_no_more_than_its_limit(robot, identified):
    times, motion = np.arange(60) / 60, Swing(robot, period_s=0.5)
    reference = Reference(motion.pose(times), motion.pose_rate(times))
    free = simulate_servo(robot, identified, reference, LoopSettings(SERVO, FAST))
    limit = 0.9 * np.abs(free.torque).max()
    held = simulate_servo(
        robot, identified, reference, LoopSettings(SERVO, FAST, drives=Drives(torque_limit=limit))
    )
    assert np.abs(held.torque).max() == limit
    assert not np.array_equal(free.pose, held.pose)


def test_a_run_that_weak_actuators_lose_says_so(robot, identified):
    """All of them: at rest each has to give half as much again."""
    reference, drives = (
        Reference(np.tile(robot.home_pose, (60, 1)), np.zeros((60, 6))),
        Drives(torque_limit=2.0),
    )
    assert (
        np.abs(robot.static_torque(robot.home_pose, identified[robot.layout.dynamic])).min()
        > 1.4 * 2.0
    )
    with pytest.raises(LoopFailure) as caught:
        simulate_servo(robot, identified, reference, LoopSettings(SERVO, FAST, drives=drives))
    frame = caught.value.frame
    assert caught.value.saturated == frame > 0
    assert (
        f", saturated in {frame} of {frame} frames, limit 2 N m): the robot left the reachable "
        "set: leg" in str(caught.value)
    )


def test_a_controller_of_every_frame_is_asked_where_the_measurement_is_lost(robot, identified):
    asked = []

    def command(frame, time, measured):
        asked.append(measured is None)
        return robot.inverse_kinematics(robot.home_pose)

    poses = np.tile(robot.home_pose, (4, 1))
    settings = LoopSettings(SERVO, FAST)
    lost = {1, 2}
    sensor = lambda frame, time, pose: None if frame in lost else pose  # noqa: E731
    simulate_controller(
        robot,
        identified,
        Reference(poses, 0 * poses),
        settings,
        EveryFrame(command),
        sensor,
    )
    assert asked == [False, True, True, False]


def test_a_controller_sees_the_noise_of_the_record_where_the_platform_cannot_move():
    robot = dynamics.load_robot("delta3")
    seen = []

    def command(frame, time, measured):
        seen.append(measured)
        return robot.inverse_kinematics(robot.home_pose)

    poses = np.tile(robot.home_pose, (4, 1))
    noise = np.random.default_rng(0).normal(0, 1e-5, (4, 6))
    run = simulate_controller(
        robot,
        robot.parameter_sets["truth"].vector,
        Reference(poses, 0 * poses),
        LoopSettings(SERVO, FAST),
        EveryFrame(command),
        IdealSensor(noise=noise),
    )
    np.testing.assert_array_equal(seen, run.measured)
    np.testing.assert_allclose(run.measured - run.pose, noise, atol=1e-15)


@pytest.mark.thorough
@pytest.mark.parametrize("law", [feedforward, computed_torque])
@pytest.mark.parametrize("timing", [FrameTiming(60.0, 1 / 60), SLOW], ids=["60 Hz", "29 Hz"])
def test_the_observer_knows_how_well_it_predicts_over_jitter_and_lost_frames(
    law, timing, record_property
):
    """Mean normalised error of what it expects, over three robots: a fifth of the frames lost,
    jitter of half one.
    """
    ratios = []
    for name in ("rss6", "ups6", "delta3"):
        robot = dynamics.load_robot(name)
        run, errors, expected = follow(robot, timing, law, seconds=8.0, dropout=0.2, jitter=0.5)
        off = robot.coordinates(run.pose) - np.array([one.coordinates for one in expected])
        weighted = np.linalg.solve(np.array([one.covariance for one in expected]), off[..., None])[
            ..., 0
        ]
        ratios.append(np.mean(np.sum(off * weighted, axis=1)) / off.shape[1])
        assert size(errors) < 3e-4  # m: it has not been lost
    record_property("normalised error", float(np.mean(ratios)))
    assert 0.85 < np.mean(ratios) < 1.15, ratios


@pytest.mark.slow
def test_computed_torque_with_an_observer_survives_a_model_without_friction(robot):
    """The starting model of the paper: the observer has to learn what friction does, or the loop is
    lost at 29 Hz.
    """
    known = robot.parameter_sets["guess"].vector
    assert size(follow(robot, SLOW, computed_torque, known=known)[1]) < size(
        follow(robot, SLOW, None)[1]
    )


def test_the_linear_response_is_that_of_the_simulated_loop(robot):
    """A small oscillation of one coordinate, without dry friction, against the column of the
    response.
    """
    parameters = robot.parameter_sets["truth"].vector.copy()
    parameters[robot.layout.coulomb] = 0.0
    settings, w, frames = LoopSettings(SERVO, FAST, steps_per_frame=8), 2 * np.pi * 0.5, 1200
    times = np.arange(frames) / 60
    poses = np.tile(robot.home_pose, (frames, 1))
    poses[:, 0] += 1e-4 * np.sin(w * times)
    rates = np.zeros_like(poses)
    rates[:, 0] = (
        np.diff(poses[:, 0], prepend=poses[0, 0]) * 60
    )  # what the servo's difference makes of it
    run = simulate_servo(robot, parameters, Reference(poses, rates), settings)
    last = slice(-120, None)  # one period
    found = (
        2
        * np.mean(
            (run.pose - robot.home_pose)[last] * np.exp(-1j * w * times[last])[:, None], axis=0
        )
        * 1j
        / 1e-4
    )
    said = stability.pose_response(robot, parameters, settings, robot.home_pose)(w)[:, 0]
    assert np.abs(found - said).max() < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["delta3", pytest.param("rss6", marks=pytest.mark.thorough)])
def test_designed_gains_give_the_bandwidth_and_damping_that_were_asked_for(name):
    robot = dynamics.load_robot(name)
    model = Model(robot, robot.parameter_sets["truth"].vector, FrictionLaw())
    settings = LoopSettings(SERVO, FAST)
    gains = design_servo(model, settings, robot.home_pose, 3.0, 0.15)
    found = servo_figures(model, replace(settings, servo=gains), robot.home_pose)
    assert found.bandwidth == pytest.approx(3.0, rel=0.03)
    assert found.damping > 0.15 - 0.02
    assert found.gain_margin > 1


@pytest.mark.slow
def test_a_bandwidth_that_no_gains_give_is_refused_with_what_can_be_had():
    robot = dynamics.load_robot("delta3")
    model = Model(robot, robot.parameter_sets["truth"].vector, FrictionLaw())
    with pytest.raises(
        SimulationError,
        match=r"bandwidth of 40 rad/s with a damping of 0\.9 at 29 Hz: the best gains have",
    ):
        design_servo(model, LoopSettings(SERVO, SLOW), robot.home_pose, 40.0, 0.9)


@pytest.mark.slow
def test_the_loop_of_computed_torque_is_lost_where_its_eigenvalue_says_so():
    """Without observer, where vision alone closes the loop, and without dry friction."""
    robot = dynamics.load_robot("delta3")
    parameters = robot.parameter_sets["truth"].vector
    model = Model(robot, parameters, FrictionLaw())
    settings = LoopSettings(SERVO, FAST)
    at = lambda w: torque_figures(model, settings, robot.home_pose, Feedback(w, 1.0, False)).radius  # noqa: E731
    low, high = 5.0, 200.0
    for _ in range(30):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if at(middle) < 1 else (low, middle)
    quiet = 1e-6 * NOISE
    calm = follow(robot, FAST, computed_torque, noise=quiet, observer=False, bandwidth=0.8 * low)[1]
    assert size(calm[-60:]) < 1e-4
    try:
        wild = size(
            follow(robot, FAST, computed_torque, noise=quiet, observer=False, bandwidth=1.4 * low)[
                1
            ][-60:]
        )
    except LoopFailure:
        wild = np.inf
    assert wild > 100 * size(calm[-60:])


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"settings": LoopSettings(SERVO, FAST, drives=Drives(torques=True))},
            "need a controller or commands",
        ),
        ({"feedforward": np.zeros((3, 6))}, "feedforward must have shape"),
    ],
    ids=["servo", "rows"],
)
def test_what_the_servo_cannot_drive_is_refused(robot, identified, asked, said):
    poses = np.tile(robot.home_pose, (4, 1))
    given = {"settings": LoopSettings(SERVO, FAST)} | asked
    with pytest.raises(SimulationError, match=said):
        simulate_servo(robot, identified, Reference(poses, 0 * poses), **given)


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan")])
def test_a_torque_limit_is_a_number_above_zero(limit):
    with pytest.raises(SimulationError, match="torque limit"):
        Drives(torque_limit=limit)


def test_a_loop_that_no_gains_make_stable_is_said_to_be_so_without_a_number(monkeypatch):
    robot = dynamics.load_robot("rss6")
    truth = robot.parameter_sets["truth"].dynamic
    monkeypatch.setattr("dynamics.control.gains.stability.gain_margin", lambda *_: float("nan"))
    with pytest.raises(SimulationError, match="at 29 Hz: the loop is unstable with any gains of"):
        design_drives(robot, [truth], [LoopSettings(SERVO, SLOW)])
