"""What is refused, with name, value and limit: each checker is proved once, each entry point with one value."""

import inspect
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dynamics import checks, closed_loop, fast_forward_dynamics, simulate_batch
from dynamics.closed_loop import FrameTiming, FrictionLaw, JointElasticity, LoopSettings, Reference, ServoGains
from dynamics.engines.mjcf import MjcfSolver, mjcf_text
from dynamics.engines.mujoco_engine import MujocoError, MujocoRobot
from dynamics.errors import (
    ConvergenceError,
    DynamicsError,
    ParameterError,
    RobotFileError,
    ShapeError,
    SimulationError,
    SingularPoseError,
    TravelError,
    UnreachablePoseError,
)
from dynamics.robot import Robot, with_geometry_error
from dynamics.workspace import check_motion, measure
from tests.dynamics.conftest import METHODS

SHAPES = re.escape("numbers of shape (6,) or (N, 6)")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("home", f"pose must be {SHAPES}, got 'home'"),
        (["0"] * 6, "dtype <U1"),
        ([None, 0, 0, 0, 0, 0], "dtype object"),
        (np.zeros(6, complex), "dtype complex128"),
        (np.zeros(6, bool), "dtype bool"),
        ([[0.0] * 6, [0.0]], f"pose must be {SHAPES}"),
        (np.ma.masked_equal([0, 0, 0.2, 0, 0, 0], 0.2), "got masked entries"),
        (np.zeros(7), r"pose must have shape \(6,\) or \(N, 6\), got \(7,\)"),
        (np.zeros((6, 2)), r"got \(6, 2\)"),
        (0.2, r"got \(\)"),
        ([0, 0, np.nan, 0, 0, 0], r"pose\[2\] is nan, must be finite"),
        ([[0.0] * 6, [0, 0, 0, 0, np.inf, 0]], r"pose\[1, 4\] is inf, must be finite"),
    ],
)
def test_arrays_are_numbers_of_a_shape_and_finite(robot, value, message):
    with pytest.raises(ShapeError, match=message):
        robot.inverse_kinematics(value)


@pytest.mark.parametrize(
    ("limit", "value", "message"),
    [
        ("least", "0.3", "gain is '0.3', must be a number >= 0"),
        ("least", True, "gain is True, must be a number"),
        ("least", 0.3 + 1j, "must be a number"),
        ("least", np.array([0.3, 0.3]), r"gain is array\(\[0.3, 0.3\]\), must be a number"),
        ("least", 10**400, "gain is inf, must be finite and >= 0"),
        ("least", np.nan, "must be finite and >= 0"),
        ("least", -1.0, "gain is -1.0, must be finite and >= 0"),
        ("above", 0.0, "gain is 0.0, must be finite and > 0"),
        ("above", None, "gain is None, must be a number > 0"),
    ],
)
def test_a_number_is_one_and_within_its_limit(limit, value, message):
    with pytest.raises(DynamicsError, match=message):
        checks.real("gain", value, DynamicsError, **{limit: 0})


@pytest.mark.parametrize("steps", [0, 2.5, True, "4", None, np.nan, np.inf, 10_001, 4 + 0j])
def test_a_whole_number_is_one_from_least_to_most(loop, steps):
    with pytest.raises(SimulationError, match=r"steps_per_frame is .* must be a whole number >= 1 and <= 10000"):
        loop.settings(steps=steps)
    assert loop.settings(steps=np.float64(4)).steps_per_frame == 4


@pytest.mark.parametrize("value", [0, "yes", None, np.ones(2, bool)])
def test_a_flag_a_mask_a_choice_and_a_type_are_what_they_are_called(value):
    with pytest.raises(ParameterError, match=r"coulomb is .* must be True or False"):
        checks.flag("coulomb", value, ParameterError)
    with pytest.raises(ParameterError, match=r"lost must be bool of shape \(5,\), got"):
        checks.mask("lost", value, 5, ParameterError)
    with pytest.raises(ParameterError, match=r"unknown hold `.*`; valid: zero, linear"):
        checks.check_choice("hold", value, ("zero", "linear"), ParameterError)
    with pytest.raises(ParameterError, match=r"robot must be of type Robot, got .* of type"):
        checks.check_type("robot", value, Robot, ParameterError)


@pytest.mark.parametrize("method", [*METHODS, "forward_kinematics"])
def test_every_argument_of_every_method_is_checked_by_name(robot, method):
    good = {"pose": robot.home_pose, "initial_pose": robot.home_pose, "parameters": robot.nominal_parameters}
    arguments = {name: good.get(name, np.zeros(6)) for name in inspect.signature(getattr(robot, method)).parameters}
    for name, value in arguments.items():
        words = r"platform.mass = nan kg" if name == "parameters" else rf"{name}\[0\] is nan, must be finite"
        with pytest.raises((ShapeError, ParameterError), match=words):
            getattr(robot, method)(*(arguments | {name: np.full(len(value), np.nan)}).values())
        longer = np.tile(value, (3, 1))
        if len(arguments) > 1 and method != "forward_kinematics":
            batched = {other: np.tile(entry, (2, 1)) for other, entry in arguments.items()}
            with pytest.raises(ShapeError, match=r"batch lengths differ, shapes .*3, "):
                getattr(robot, method)(*(batched | {name: longer}).values())


def test_parameters_outside_their_range_are_named_with_unit_and_row(robot):
    for index, value, message in (
        (0, 0.0, r"platform.mass = 0 kg is not allowed, must be finite and > 0"),
        (8, -0.5, r"crank2.mass = -0.5 kg is not allowed, must be finite and >= 0"),
        (29, np.nan, r"link1.Ixx = nan kg m\^2"),
        (54, -0.1, r"joint3.coulomb = -0.1 N m is"),
        (63, np.inf, r"joint6.viscous = inf N m s/rad"),
    ):
        values = robot.nominal_parameters.copy()
        values[index] = value
        with pytest.raises(ParameterError, match=message):
            robot.mass_matrix(robot.home_pose, values)
        with pytest.raises(ParameterError, match=rf"{message}.*\(row 1\)"):
            robot.mass_matrix(robot.home_pose, np.array([robot.nominal_parameters, values]))


def test_poses_without_an_answer_are_named_and_never_become_nan(robot):
    far, rest = robot.home_pose + 0.2 * np.eye(6)[0], np.zeros(6)
    with pytest.raises(UnreachablePoseError, match=r"leg \d cannot reach pose \[0.2 .*reach margin -.*must be > 0"):
        robot.inverse_kinematics(far)
    with pytest.raises(UnreachablePoseError, match=r"\(row 1\)"):
        robot.mass_matrix([robot.home_pose, far])
    long = np.array([1.234567e-300, 1.234567e200, -1.234567e-200, 1.234567e-100, -1.234567e100, 1.234567e-10])
    with pytest.raises(UnreachablePoseError, match=r"^leg 1 cannot reach pose \[[^\n]*$"):
        robot.inverse_kinematics(long)
    with pytest.raises(ConvergenceError, match="forward kinematics found no pose with crank angles"):
        robot.forward_kinematics(rest, np.full(6, 1e308))
    with pytest.raises(SingularPoseError, match=r"beta = \+-pi/2"):
        robot.pose_rate([0, 0, 0.2, 0, np.pi / 2, 0], np.ones(6))
    with pytest.raises(SingularPoseError, match="forward_dynamics is not finite"):  # a mass and no inertia anywhere
        robot.forward_dynamics(robot.home_pose, rest, np.ones(6), 24.0 * np.eye(64)[0])


def test_the_fast_forward_dynamics_names_poses_without_an_answer_and_goes_on(robot):
    fast, good = fast_forward_dynamics(robot), [robot.home_pose, np.zeros(6), np.zeros(6)]
    for pose, twist in ((robot.home_pose + 0.5, np.zeros(6)), (robot.home_pose, np.full(6, np.nan))):
        with pytest.raises(SingularPoseError, match="not finite at pose"):
            fast(pose, twist, np.zeros(6))
    np.testing.assert_array_equal(fast(*good), robot.forward_dynamics(*good))


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (64, -1.0, "joint_pid.lp is -1.0, must be finite and >= 0"),
        (65, 0.0, "joint_pid.li is 0.0, must be finite and > 0"),
        (66, np.nan, "joint_pid.ld is nan, must be finite and >= 0"),
        (12, -1.0, r"crank3\.mass = -1 kg is not allowed, must be finite and >= 0"),
    ],
)
def test_parameters_of_runs_batches_and_equilibria(robot, loop, place, value, words):
    values, settings, reference = np.array(loop.parameters), loop.settings(), loop.reference(5)
    values[place] = value
    for call in (
        lambda: loop.run(reference, parameters=values),
        lambda: closed_loop.equilibrium(robot, values, robot.home_pose, settings.servo),
        lambda: simulate_batch(robot, values, reference, settings),
    ):
        with pytest.raises((SimulationError, ParameterError), match=words):
            call()


@pytest.fixture
def asked(robot, identified, loop):
    """Functions that run, repeat in a batch, export and check with good arguments, but for those that are given."""
    reference, settings = loop.reference(5), loop.settings()
    good = {"parameters": identified, "settings": settings}
    return SimpleNamespace(
        robot=robot,
        run=lambda **bad: closed_loop.simulate(**{"robot": robot, "reference": reference, **good, **bad}),
        batch=lambda **bad: simulate_batch(**{"robot": robot, "references": reference, **good, **bad}),
        balance=lambda pose, servo=settings.servo: closed_loop.equilibrium(robot, identified, pose, servo),
        misplace=lambda error: with_geometry_error(robot, error, np.random.default_rng(0)),
        export=lambda **bad: mjcf_text(**{"robot": robot, "allow_unphysical_inertia": True, **bad}),
        accelerate=lambda *bad: fast_forward_dynamics(robot)(*bad, *[np.zeros(6)] * (3 - len(bad))),
        start=lambda **bad: replace(closed_loop.equilibrium(robot, identified, robot.home_pose, settings.servo), **bad),
        state=loop.run(10, lost=np.arange(10) == 4).state_at,
        check=lambda *bad, **limits: check_motion(robot, *(bad or (robot.home_pose,)), **limits),
    )


def _ideal(frame, time, pose):
    return pose


def _elastic(motor_inertia=3e-4, steps=80):
    elasticity = JointElasticity(500.0, motor_inertia, 0.02)
    return LoopSettings(ServoGains(0.3, 0.001, 2.4), FrameTiming(60.0), FrictionLaw(), steps, elasticity)


POSES = np.tile([0, 0, 0.2, 0, 0, 0], (3, 1))
FIVE = np.zeros((5, 6))
REFUSED = {
    SimulationError: [
        (lambda _: ServoGains(-1.0, 0.0, 0.0), "servo gain kp is -1.0, must be"),
        (lambda _: FrameTiming(0.0), "frame rate is 0.0 Hz, must be finite and > 0"),
        (lambda _: FrameTiming(60.0, -0.01), "latency is -0.01 s, must be >= 0 and at most 60 frames"),
        (lambda _: FrameTiming(60.0, 2.0), r"at most 60 frames \(1 s\)"),
        (lambda _: FrameTiming(60.0, hold="cubic"), "unknown hold `cubic`; valid: zero, linear"),
        (
            lambda _: FrictionLaw("stribek"),
            "unknown friction law `stribek`; valid: coulomb_viscous, smoothed, stribeck",
        ),
        (lambda _: FrictionLaw("smoothed"), "smoothing_velocity .* is None rad/s, must be a number > 0"),
        (lambda _: FrictionLaw("stribeck", None, 0.9, 0.1), "static_ratio .* is 0.9, must be finite and >= 1"),
        (lambda _: FrictionLaw(static_ratio=1.2), "belongs to the law `stribeck`, not to `coulomb_viscous`"),
        (lambda _: JointElasticity(0.0, 3e-4), r"joint stiffness is 0\.0 N m/rad, must be finite and > 0"),
        (lambda _: JointElasticity(500.0, np.inf), "motor inertia is inf"),
        (lambda _: JointElasticity(500.0, 3e-4, -1.0), r"joint damping is -1\.0"),
        (lambda _: LoopSettings((0.3,), FrameTiming(60.0)), r"servo must be of type ServoGains, got \(0.3,\)"),
        (lambda _: LoopSettings(ServoGains(1, 0, 0), FrameTiming(60.0), None), "friction must be of type FrictionLaw"),
        (lambda _: Reference(FIVE, FIVE[:4]), r"\(5, 6\) and rates \(4, 6\) differ"),
        (lambda _: Reference(FIVE[:1], FIVE[:1]), "reference poses must have at least 2 frames, got 1"),
        (lambda _: Reference(FIVE, None), "reference rates must be numbers .*got None"),
        (lambda asked: asked.run(robot="rss6"), "robot must be of type Robot, got 'rss6' of type str"),
        (lambda asked: asked.run(reference=FIVE), "reference must be of type Reference, got array"),
        (lambda asked: asked.run(settings=None), "settings must be of type LoopSettings, got None of type NoneType"),
        (lambda asked: asked.run(start=np.zeros(6)), "start must be of type StartState"),
        (lambda asked: asked.run(sensor="camera"), "sensor must be a function .*, or None, got 'camera'"),
        (lambda asked: asked.run(servo_robot="rss6"), "servo_robot must be of type Robot"),
        (lambda asked: asked.run(controller=3), "controller must be a function, or None for the servo, got 3"),
        (lambda asked: asked.run(commands=FIVE[:4]), r"commands must have shape \(5, 6\), got \(4, 6\)"),
        (lambda asked: asked.run(lost=[2, 3]), r"lost must be bool of shape \(5,\), got int64 of shape \(2,\)"),
        (lambda asked: asked.run(noise=FIVE + np.inf), r"noise\[0, 0\] is inf, must be finite"),
        (lambda asked: asked.run(latencies=np.zeros(4)), r"latencies must have shape \(5,\)"),
        (lambda asked: asked.run(latencies=-0.01 * np.eye(5)[2]), "latency of frame 2 is -0.01 s, must be >= 0"),
        (lambda asked: asked.run(latencies=1.1 * np.eye(5)[3]), r"of frame 3 is 1.1 s, .*at most 60 frames \(1 s\)"),
        (lambda asked: asked.run(parameters=np.zeros(64)), r"loop parameters must have shape \(67,\).*, got \(64,\)"),
        (lambda asked: asked.run(compiled="yes"), "compiled is 'yes', must be True or False"),
        (lambda asked: asked.run(sensitivities=True, sensor=_ideal), "sensitivities need the ideal sensor"),
        (lambda asked: asked.run(sensitivities=True, servo_robot=asked.robot), "pass servo_robot=None"),
        (lambda asked: asked.run(sensitivities=True, controller=_ideal), "those of the servo: pass controller=None"),
        (lambda asked: asked.run(lost=FIVE[:, 0] > 0, sensor=_ideal), "lost is for the ideal sensor: a sensor returns"),
        (
            lambda asked: asked.run(noise=FIVE, sensor=_ideal),
            "noise is for the ideal sensor: a sensor that is given adds",
        ),
        (lambda asked: asked.run(commands=FIVE, controller=_ideal), "commands take the place of any controller"),
        (lambda asked: asked.run(compiled=True, controller=_ideal), "a controller runs on the plain path"),
        (lambda asked: asked.batch(workers=0), "workers is 0, must be a whole number >= 1"),
        (
            lambda asked: asked.batch(parameters=np.zeros((0, 67))),
            "0 parameter vectors and 1 references do not pair up",
        ),
        (lambda asked: asked.batch(parameters=np.zeros((2, 64))), r"shape \(67,\) or \(N, 67\), got \(2, 64\)"),
        (lambda asked: asked.batch(references=5), "references must be of type Sequence, got 5"),
        (lambda asked: asked.batch(references=[FIVE]), r"references\[0\] must be of type Reference, got array"),
        (lambda asked: asked.batch(starts=[3]), r"starts\[0\] must be of type StartState, got 3"),
        (lambda asked: asked.balance(np.zeros(6), None), "servo must be of type ServoGains, got None"),
        (lambda asked: asked.run(settings=_elastic(1e-3)), r"below the 0.000718 kg m\^2 of crank 2 about its axis"),
        (lambda asked: asked.run(settings=_elastic(steps=20)), r"is 20, must be >= \d+ .* stiffness of 500 N m/rad"),
        (lambda asked: asked.run(settings=_elastic(), sensitivities=True), "pass settings with elasticity=None"),
        (lambda asked: asked.run(settings=_elastic(), start=asked.start()), "needs motor_angle and motor_rate"),
        (lambda asked: asked.start(pose_rate=np.zeros(5)), r"start pose_rate must have shape \(6,\), got \(5,\)"),
        (lambda asked: asked.start(servo_integral=np.full(6, np.nan)), r"start servo_integral\[0\] is nan, must be"),
        (lambda asked: asked.start(commands=np.zeros((0, 6))), "start commands must have at least 1 row, got 0"),
        (lambda asked: asked.state(10), "frame is 10, must be a whole number >= 0 and <= 9"),
        (lambda asked: asked.state(5), "frame 5 follows a lost measurement"),
        (lambda _: closed_loop.prepare(6), "robot must be of type Robot, got 6 of type int"),
    ],
    ShapeError: [
        (lambda asked: asked.balance(np.zeros((2, 6))), r"pose must have shape \(6,\), got \(2, 6\)"),
        (lambda asked: asked.accelerate([0.0] * 6), r"^pose must be a float64 array of shape \(6,\), got \[0.0, 0.0"),
        (lambda asked: asked.accelerate(np.zeros(6), np.zeros(6, np.float32)), "^twist must be a float64 array"),
        (lambda asked: asked.accelerate(np.zeros((1, 6))), r"^pose must have shape \(6,\), got \(1, 6\)"),
        (lambda asked: asked.accelerate(np.zeros(6), np.zeros(6), "rest"), "^torque must be numbers of shape"),
        (lambda asked: asked.check(np.zeros((0, 6))), "a motion needs at least one pose"),
        (lambda asked: asked.check(POSES, np.zeros(2)), r"times must have shape \(3,\), got \(2,\)"),
        (lambda asked: asked.check(POSES, [0.0, 0.2, 0.1]), r"increase, but times\[2\] = 0.1 s follows 0.2 s"),
        (lambda asked: asked.check(POSES, [0.0, 0.0, 0.1]), r"times\[1\] = 0.0 s follows 0.0 s"),
    ],
    UnreachablePoseError: [
        (lambda asked: asked.balance(np.full(6, 9.0)), r"leg 1 cannot reach pose \[9."),
        (lambda asked: asked.run(start=asked.start(pose=np.array([0, 0, 0.7, 0, 0, 0]))), "leg"),
    ],
    RobotFileError: [
        (lambda asked: asked.misplace(0.2), r"with joints off by 0.2 m: leg \d cannot reach the home pose"),
        (lambda asked: asked.misplace(-1.0), "geometry error is -1.0 m, must be finite and >= 0"),
    ],
    TravelError: [(lambda asked: asked.check(travel_margin=-0.1), "travel_margin is -0.1.*must be")],
    ParameterError: [(lambda asked: asked.export(parameters=np.ones(67)), r"must have shape \(64,\), got \(67,\)")],
    DynamicsError: [
        (lambda asked: asked.check(least_leverage=np.nan), "least_leverage is nan.*must be"),
        (lambda asked: asked.check(most_condition=0.5), "most_condition is 0.5.*must be"),
        (lambda _: measure("rss6", np.zeros(6)), "robot must be of type Robot, got 'rss6' of type str"),
        (lambda asked: asked.export(robot="rss6"), "robot must be of type Robot, got 'rss6'"),
        (lambda asked: asked.export(coulomb=1), "coulomb is 1, must be True or False"),
        (lambda asked: asked.export(allow_unphysical_inertia="yes"), "allow_unphysical_inertia is 'yes', must be True"),
        (lambda asked: asked.export(source=None), "source must be of type str, got None"),
        (lambda _: MjcfSolver(timestep_s=0.0), "timestep is 0.0 s"),
        (lambda _: MjcfSolver(time_constant_steps=1.0), "time constant is 1.0 steps"),
        (lambda _: MjcfSolver(impedance=1.0), "impedance is 1.0"),
        (lambda _: MjcfSolver(integrator="midpoint"), "valid: implicitfast, RK4"),
    ],
}


@pytest.mark.parametrize(("error", "call", "words"), [(error, *row) for error, rows in REFUSED.items() for row in rows])
def test_bad_settings_and_arguments_are_refused_with_value_and_limit_or_the_valid_names(asked, error, call, words):
    with pytest.raises(error, match=words):
        call(asked)


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize(
    ("answer", "words"),
    [("home", "must be numbers"), (np.zeros((1, 6)), "shape"), (np.full(6, np.nan), "is nan, must")],
)
def test_answers_of_sensor_and_controller_are_six_numbers_or_name_the_frame(loop, answer, words, compiled):
    """Never a lost frame; None is one of a sensor, and nothing of a controller."""
    with pytest.raises(SimulationError, match=rf"what the pose sensor returned at frame 2.* {words}"):
        loop.run(5, sensor=lambda frame, time, pose: answer if frame == 2 else pose, compiled=compiled)
    for bad in (answer, None):
        with pytest.raises(SimulationError, match="what the controller returned at frame 0"):
            loop.run(5, controller=lambda *_, bad=bad: bad)


@pytest.mark.parametrize("frame", [0, 3, 4])
def test_every_frame_of_the_reference_is_in_reach_or_the_sensor_is_never_asked(robot, loop, frame):
    reference, asked = loop.reference(5), []
    poses = reference.poses.copy()
    poses[frame] += [0.2, 0, 0, 0, 0, 0]
    margin = robot.reach_margin(poses[frame])
    leg = int(np.flatnonzero(margin <= 0)[0])
    words = (
        rf"^leg {leg + 1} cannot reach reference pose \[.*\(frame {frame}\): reach margin {margin[leg]:.3g}, must be"
    )
    with pytest.raises(UnreachablePoseError, match=words):
        loop.run(Reference(poses, reference.rates), sensor=lambda *measured: asked.append(measured))
    assert not asked


def test_the_engine_takes_no_bad_input_and_no_other_model(robot):
    pytest.importorskip("mujoco")
    engine = MujocoRobot(robot, mjcf_text(robot, allow_unphysical_inertia=True))
    for call, words in (
        (lambda: engine.put(np.zeros((1, 6)), np.zeros(6)), r"pose must have shape \(6,\), got \(1, 6\)"),
        (lambda: engine.put(np.zeros(6), None), "twist must be numbers"),
        (lambda: engine.twist_dot(1.0), r"torque must have shape \(6,\), got \(\)"),
        (lambda: engine.step(np.full(6, np.nan)), r"control\[0\] is nan, must be finite"),
        (lambda: engine.feed_back("stiff", 1.0), "stiffness is 'stiff', must be a number"),
        (lambda: engine.feed_back(1.0, -1.0), "damping is -1.0, must be finite and >= 0"),
    ):
        with pytest.raises(DynamicsError, match=words):
            call()
    for text, words in (
        (None, "text must be of type str, got None"),
        ("no model", "MuJoCo refuses the model of rss6"),
        ("<mujoco/>", "the model is no export of rss6: .*joint1"),
    ):
        with pytest.raises(MujocoError, match=words):
            MujocoRobot(robot, text)
