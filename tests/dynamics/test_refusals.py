"""What is refused, with name, value and limit: each checker is proved once, each entry point with one value."""

import re

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
    ShapeError,
    SimulationError,
    SingularPoseError,
    TravelError,
    UnreachablePoseError,
)
from dynamics.robot import Robot
from dynamics.workspace import check_motion, measure

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


NUMBERS = {
    "least 0": lambda value: checks.real("gain", value, DynamicsError, least=0, unit=" m"),
    "above 0": lambda value: checks.real("gain", value, DynamicsError, above=0),
}


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        ("least 0", "0.3", "gain is '0.3' m, must be a number >= 0"),
        ("least 0", True, "gain is True m, must be a number"),
        ("least 0", 0.3 + 1j, "must be a number"),
        ("least 0", np.array([0.3, 0.3]), r"gain is array\(\[0.3, 0.3\]\) m, must be a number"),
        ("least 0", 10**400, "gain is inf m, must be finite and >= 0"),
        ("least 0", np.nan, "must be finite and >= 0"),
        ("least 0", -1.0, "gain is -1.0 m, must be finite and >= 0"),
        ("above 0", 0.0, "gain is 0.0, must be finite and > 0"),
        ("above 0", None, "gain is None, must be a number > 0"),
    ],
)
def test_a_number_is_one_and_within_its_limit(kind, value, message):
    with pytest.raises(DynamicsError, match=message):
        NUMBERS[kind](value)


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


ARGUMENTS = {  # of a robot's methods, in their order
    **dict.fromkeys(("inverse_kinematics", "joint_jacobian", "pose_jacobian", "reach_margin"), ("pose",)),
    **dict.fromkeys(("static_torque", "mass_matrix", "gravity_wrench"), ("pose", "parameters")),
    "forward_kinematics": ("theta", "initial_pose"),
    "twist": ("pose", "pose_rate"),
    "twist_dot": ("pose", "pose_rate", "pose_acceleration"),
    "pose_rate": ("pose", "twist"),
    **dict.fromkeys(("coriolis_matrix", "friction_wrench"), ("pose", "twist", "parameters")),
    "regressor": ("pose", "twist", "twist_dot"),
    "inverse_dynamics": ("pose", "twist", "twist_dot", "parameters"),
    "forward_dynamics": ("pose", "twist", "torque", "parameters"),
}


@pytest.mark.parametrize("method", ARGUMENTS)
def test_every_argument_of_every_method_is_checked_by_name(robot, method):
    good = {"pose": robot.home_pose, "initial_pose": robot.home_pose, "parameters": robot.nominal_parameters}
    arguments = {name: good.get(name, np.zeros(6)) for name in ARGUMENTS[method]}
    for name, value in arguments.items():
        words = r"platform.mass = nan kg" if name == "parameters" else rf"{name}\[0\] is nan, must be finite"
        with pytest.raises((ShapeError, ParameterError), match=words):
            getattr(robot, method)(*(arguments | {name: np.full(len(value), np.nan)}).values())
        longer = np.tile(value, (3, 1))
        if len(arguments) > 1 and method != "forward_kinematics":
            batched = {other: np.tile(entry, (2, 1)) for other, entry in arguments.items()}
            with pytest.raises(ShapeError, match=r"batch lengths differ, shapes .*3, "):
                getattr(robot, method)(*(batched | {name: longer}).values())


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (0, 0.0, r"platform.mass = 0 kg is not allowed, must be finite and > 0"),
        (8, -0.5, r"crank2.mass = -0.5 kg is not allowed, must be finite and >= 0"),
        (29, np.nan, r"link1.Ixx = nan kg m\^2"),
        (54, -0.1, r"joint3.coulomb = -0.1 N m is"),
        (63, np.inf, r"joint6.viscous = inf N m s/rad"),
    ],
)
def test_parameters_outside_their_range_are_named_with_unit_and_row(robot, index, value, message):
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


def test_the_fast_forward_dynamics_refuses_by_name_and_goes_on(robot):
    fast, good = fast_forward_dynamics(robot), [robot.home_pose, np.zeros(6), np.zeros(6)]
    for place, name in enumerate(("pose", "twist", "torque")):
        for bad, words in (
            ([0.0] * 6, r"must be a float64 array of shape \(6,\), got \[0.0, 0.0"),
            (np.zeros(6, np.float32), "must be a float64 array"),
            (np.zeros((1, 6)), r"must have shape \(6,\), got \(1, 6\)"),
            ("rest", "must be numbers of shape"),
        ):
            with pytest.raises(ShapeError, match=f"^{name} {words}"):
                fast(*good[:place], bad, *good[place + 1 :])
    for pose, twist in ((robot.home_pose + 0.5, np.zeros(6)), (robot.home_pose, np.full(6, np.nan))):
        with pytest.raises(SingularPoseError, match="not finite at pose"):
            fast(pose, twist, np.zeros(6))
    np.testing.assert_array_equal(fast(*good), robot.forward_dynamics(*good))


def test_a_motion_needs_poses_times_and_limits_that_are_some(robot):
    poses = np.tile(robot.home_pose, (3, 1))
    for arguments, error, words in (
        ((np.zeros((0, 6)),), ShapeError, "a motion needs at least one pose"),
        ((poses, np.zeros(2)), ShapeError, r"times must have shape \(3,\), got \(2,\)"),
        ((poses, [0.0, 0.2, 0.1]), ShapeError, r"times must increase, but times\[2\] = 0.1 s follows 0.2 s"),
        ((poses, [0.0, 0.0, 0.1]), ShapeError, r"times\[1\] = 0.0 s follows 0.0 s"),
    ):
        with pytest.raises(error, match=words):
            check_motion(robot, *arguments)
    for option, bad in (("travel_margin", -0.1), ("least_leverage", np.nan), ("most_condition", 0.5)):
        with pytest.raises(TravelError if "travel" in option else DynamicsError, match=f"{option} is {bad}.*must be"):
            check_motion(robot, robot.home_pose, **{option: bad})
    with pytest.raises(DynamicsError, match="robot must be of type Robot, got 'rss6' of type str"):
        measure("rss6", np.zeros(6))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ServoGains(-1.0, 0.0, 0.0), "servo gain kp is -1.0, must be"),
        (lambda: FrameTiming(0.0), "frame rate is 0.0 Hz, must be finite and > 0"),
        (lambda: FrameTiming(60.0, -0.01), "latency is -0.01 s, must be >= 0 and at most 60 frames"),
        (lambda: FrameTiming(60.0, 2.0), r"at most 60 frames \(1 s\)"),
        (lambda: FrameTiming(60.0, hold="cubic"), "unknown hold `cubic`; valid: zero, linear"),
        (lambda: FrictionLaw("stribek"), "unknown friction law `stribek`; valid: coulomb_viscous, smoothed, stribeck"),
        (lambda: FrictionLaw("smoothed"), "smoothing_velocity .* is None rad/s, must be a number > 0"),
        (lambda: FrictionLaw("stribeck", None, 0.9, 0.1), "static_ratio .* is 0.9, must be finite and >= 1"),
        (lambda: FrictionLaw(static_ratio=1.2), "belongs to the law `stribeck`, not to `coulomb_viscous`"),
        (lambda: JointElasticity(0.0, 3e-4), r"joint stiffness is 0\.0 N m/rad, must be finite and > 0"),
        (lambda: JointElasticity(500.0, np.inf), "motor inertia is inf"),
        (lambda: JointElasticity(500.0, 3e-4, -1.0), r"joint damping is -1\.0"),
        (lambda: LoopSettings((0.3,), FrameTiming(60.0)), r"servo must be of type ServoGains, got \(0.3,\)"),
        (lambda: LoopSettings(ServoGains(1, 0, 0), FrameTiming(60.0), None), "friction must be of type FrictionLaw"),
        (lambda: Reference(np.zeros((5, 6)), np.zeros((4, 6))), r"\(5, 6\) and rates \(4, 6\) differ"),
        (lambda: Reference(np.zeros((1, 6)), np.zeros((1, 6))), "reference poses must have at least 2 frames, got 1"),
        (lambda: Reference(np.zeros((5, 6)), None), "reference rates must be numbers .*got None"),
    ],
)
def test_settings_of_the_loop_name_value_and_limit_or_the_valid_names(build, message):
    with pytest.raises(SimulationError, match=message):
        build()


@pytest.mark.parametrize(
    ("place", "value", "error", "message"),
    [
        (slice(3), 0.0, SimulationError, r"loop parameters must have shape \(67,\).*, got \(64,\)"),
        (64, -1.0, SimulationError, "joint_pid.lp is -1.0, must be finite and >= 0"),
        (65, 0.0, SimulationError, "joint_pid.li is 0.0, must be finite and > 0"),
        (66, np.nan, SimulationError, "joint_pid.ld is nan, must be finite and >= 0"),
        (12, -1.0, ParameterError, r"crank3\.mass = -1 kg is not allowed, must be finite and >= 0"),
    ],
)
def test_parameters_of_runs_batches_and_equilibria(robot, identified, loop, place, value, error, message):
    values = (
        identified[place.stop :] if isinstance(place, slice) else np.where(np.arange(67) == place, value, identified)
    )
    settings, reference = loop.settings(), loop.reference(5)
    for call in (
        lambda: closed_loop.simulate(robot, values, reference, settings),
        lambda: closed_loop.equilibrium(robot, values, robot.home_pose, settings.servo),
        lambda: simulate_batch(robot, values, reference, settings),
    ):
        with pytest.raises(error, match=message):
            call()


def _ideal(frame, time, pose):
    return pose


FIVE = np.zeros(5, bool)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "rss6"}, "robot must be of type Robot, got 'rss6' of type str"),
        ({"reference": np.zeros((5, 6))}, "reference must be of type Reference, got array"),
        ({"settings": None}, "settings must be of type LoopSettings, got None of type NoneType"),
        ({"start": np.zeros(6)}, "start must be of type StartState"),
        ({"sensor": "camera"}, "sensor must be a function .*, or None, got 'camera'"),
        ({"servo_robot": "rss6"}, "servo_robot must be of type Robot"),
        ({"controller": 3}, "controller must be a function, or None for the servo, got 3"),
        ({"commands": np.zeros((4, 6))}, r"commands must have shape \(5, 6\), got \(4, 6\)"),
        ({"lost": [2, 3]}, r"lost must be bool of shape \(5,\), got int64 of shape \(2,\)"),
        ({"noise": np.full((5, 6), np.inf)}, r"noise\[0, 0\] is inf, must be finite"),
        ({"latencies": np.zeros(4)}, r"latencies must have shape \(5,\)"),
        ({"latencies": -0.01 * np.eye(5)[2]}, "latency of frame 2 is -0.01 s, must be >= 0"),
        ({"latencies": 1.1 * np.eye(5)[3]}, r"latency of frame 3 is 1.1 s, .*at most 60 frames \(1 s\)"),
        ({"compiled": "yes"}, "compiled is 'yes', must be True or False"),
        ({"sensitivities": True, "sensor": _ideal}, "sensitivities need the ideal sensor"),
        ({"sensitivities": True, "servo_robot": ...}, "pass servo_robot=None"),
        ({"sensitivities": True, "controller": _ideal}, "sensitivities are those of the servo: pass controller=None"),
        ({"lost": FIVE, "sensor": _ideal}, "lost is for the ideal sensor: a sensor returns None at the frames that it"),
        ({"noise": np.zeros((5, 6)), "sensor": _ideal}, "noise is for the ideal sensor: a sensor that is given adds"),
        ({"commands": np.zeros((5, 6)), "controller": _ideal}, "commands take the place of any controller"),
        ({"compiled": True, "controller": _ideal}, "a controller runs on the plain path"),
    ],
)
def test_arguments_of_a_run_and_those_that_exclude_each_other(robot, identified, loop, change, message):
    arguments = {"robot": robot, "reference": loop.reference(5), "settings": loop.settings()}
    changed = {name: robot if value is ... else value for name, value in change.items()}
    with pytest.raises(SimulationError, match=message):
        closed_loop.simulate(parameters=identified, **{**arguments, **changed})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"workers": 0}, "workers is 0, must be a whole number >= 1"),
        ({"parameters": np.zeros((0, 67))}, "0 parameter vectors and 1 references do not pair up"),
        ({"parameters": np.zeros((2, 64))}, r"loop parameters must have shape \(67,\) or \(N, 67\), got \(2, 64\)"),
        ({"references": 5}, "references must be of type Sequence, got 5"),
        ({"references": [np.zeros((5, 6))]}, r"references\[0\] must be of type Reference, got array"),
        ({"starts": [3]}, r"starts\[0\] must be of type StartState, got 3"),
    ],
)
def test_arguments_of_a_batch(robot, identified, loop, change, message):
    arguments = {"parameters": identified, "references": loop.reference(5), **change}
    with pytest.raises(SimulationError, match=message):
        simulate_batch(robot, settings=loop.settings(), **arguments)


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


def test_arguments_of_the_equilibrium_and_what_is_compiled(robot, identified):
    for pose, servo, error, words in (
        (np.zeros((2, 6)), ServoGains(0.3, 0, 2.4), ShapeError, r"pose must have shape \(6,\), got \(2, 6\)"),
        (np.full(6, 9.0), ServoGains(0.3, 0, 2.4), UnreachablePoseError, r"leg 1 cannot reach pose \[9."),
        (np.zeros(6), None, SimulationError, "servo must be of type ServoGains, got None"),
    ):
        with pytest.raises(error, match=words):
            closed_loop.equilibrium(robot, identified, pose, servo)
    with pytest.raises(SimulationError, match="robot must be of type Robot, got 6 of type int"):
        closed_loop.prepare(6)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"robot": "rss6"}, DynamicsError, "robot must be of type Robot, got 'rss6'"),
        ({"parameters": np.ones(67)}, ParameterError, r"must have shape \(64,\), got \(67,\)"),
        ({"coulomb": 1}, DynamicsError, "coulomb is 1, must be True or False"),
        ({"allow_unphysical_inertia": "yes"}, DynamicsError, "allow_unphysical_inertia is 'yes', must be True or"),
        ({"source": None}, DynamicsError, "source must be of type str, got None"),
    ],
)
def test_no_model_is_exported_from_bad_input(robot, change, error, words):
    with pytest.raises(error, match=words):
        mjcf_text(**{"robot": robot, "allow_unphysical_inertia": True, **change})


@pytest.mark.parametrize(
    ("options", "evidence"),
    [
        ({"timestep_s": 0.0}, "timestep is 0.0 s"),
        ({"time_constant_steps": 1.0}, "time constant is 1.0 steps"),
        ({"impedance": 1.0}, "impedance is 1.0"),
        ({"integrator": "midpoint"}, "valid: implicitfast, RK4"),
    ],
)
def test_solver_settings_that_mujoco_would_bend_are_refused(options, evidence):
    with pytest.raises(DynamicsError, match=evidence):
        MjcfSolver(**options)


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
