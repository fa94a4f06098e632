"""What is refused, with name, value and limit: each checker is proved once, each entry point with
one value.
"""

import inspect
import re

import numpy as np
import pytest

from dynamics import checks, closed_loop, fast_forward_dynamics, load_robot
from dynamics.closed_loop import (
    FrameTiming,
    FrictionLaw,
    JointElasticity,
    LoopSettings,
    Reference,
    ServoGains,
    StartState,
    differentiate_commands,
    differentiate_servo,
    repeat_commands,
    repeat_servo,
    simulate_batch,
    simulate_commands,
    simulate_controller,
    simulate_servo,
)
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
from dynamics.robot import Robot
from dynamics.workspace import check_motion, measure
from tests.dynamics.conftest import METHODS

SHAPES = re.escape("numbers of shape (6,) or (N, 6)")


def test_arrays_are_numbers_of_a_shape_and_finite(robot):
    for value, message in (
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
        ([[0.0] * 6, [0, 0, 0, 0, np.inf, 0]], r"pose\[1, 4\] is inf, must be finite"),
    ):
        with pytest.raises(ShapeError, match=message):
            robot.inverse_kinematics(value)


def test_a_number_a_flag_a_mask_a_choice_and_a_type_are_what_they_are_called():
    for check, options, words, values in (
        (
            checks.real,
            {"least": 0},
            "x is .* must be a number >= 0",
            ("0.3", True, 0.3j, np.ones(2), None),
        ),
        (checks.real, {"least": 0}, "x is .* must be finite and >= 0", (10**400, np.nan, -1.0)),
        (checks.real, {"above": 0}, r"x is 0\.0, must be finite and > 0", (0,)),
        (
            checks.whole,
            {"least": 1},
            "x is .* must be a whole number >= 1",
            (0, 2.5, True, "4", None, np.nan, 4j),
        ),
        (
            checks.whole,
            {"least": 1, "most": 9},
            "must be a whole number >= 1 and <= 9",
            (10, np.inf),
        ),
        (checks.flag, {}, "x is .* must be True or False", (0, "yes", None, np.ones(2, bool))),
        (
            checks.mask,
            {"length": 5},
            r"x must be bool of shape \(5,\)",
            (0, np.zeros(5), np.ones(2, bool), [[1], []]),
        ),
        (
            checks.check_choice,
            {"valid": ("zero", "linear")},
            "unknown x `.*`; valid: zero, linear",
            ("cubic", 0, None),
        ),
        (
            checks.check_type,
            {"kind": Robot},
            "x must be of type Robot, got .* of type",
            ("rss6", None),
        ),
    ):
        for value in values:
            with pytest.raises(DynamicsError, match=words):
                check("x", value, error=DynamicsError, **options)
    assert checks.whole("x", np.float64(4), DynamicsError, least=1) == 4


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
    with pytest.raises(ShapeError, match=r"batch lengths differ, shapes \(2, 6\), \(3, 64\)"):
        robot.mass_matrix([robot.home_pose] * 2, [robot.nominal_parameters] * 3)


def test_poses_without_an_answer_are_named_and_never_become_nan(robot):
    far, rest = robot.home_pose + 0.2 * np.eye(6)[0], np.zeros(6)
    with pytest.raises(
        UnreachablePoseError, match=r"leg \d cannot reach pose \[0.2 .*reach margin -.*must be > 0"
    ):
        robot.inverse_kinematics(far)
    with pytest.raises(UnreachablePoseError, match=r"\(row 1\)"):
        robot.mass_matrix([robot.home_pose, far])
    long = np.array(
        [1.234567e-300, 1.234567e200, -1.234567e-200, 1.234567e-100, -1.234567e100, 1.234567e-10]
    )
    with pytest.raises(UnreachablePoseError, match=r"^leg 1 cannot reach pose \[[^\n]*$"):
        robot.inverse_kinematics(long)
    with pytest.raises(
        ConvergenceError, match="forward kinematics found no pose with joint coordinates"
    ):
        robot.forward_kinematics(rest, np.full(6, 1e308))
    with pytest.raises(SingularPoseError, match=r"beta = \+-pi/2"):
        robot.pose_rate([0, 0, 0.2, 0, np.pi / 2, 0], np.ones(6))
    # a mass and no inertia anywhere
    with pytest.raises(SingularPoseError, match="forward_dynamics is not finite"):
        robot.forward_dynamics(robot.home_pose, rest, np.ones(6), 24.0 * np.eye(64)[0])


def test_the_fast_forward_dynamics_names_what_has_no_answer_and_goes_on(robot):
    fast, home, rest = fast_forward_dynamics(robot), robot.home_pose, np.zeros(6)
    for bad, error, words in (
        ((home + 0.5, rest, rest), SingularPoseError, "not finite at pose"),
        ((home, np.full(6, np.nan), rest), SingularPoseError, "not finite at pose"),
        (
            ([0.0] * 6, rest, rest),
            ShapeError,
            r"^pose must be a float64 array of shape \(6,\), got \[0.0, 0.0",
        ),
        ((home, rest.astype(np.float32), rest), ShapeError, "^twist must be a float64 array"),
        ((home[None], rest, rest), ShapeError, r"^pose must have shape \(6,\), got \(1, 6\)"),
        (
            (home, np.frombuffer(bytes(49), np.uint8)[1:].view(float), rest),
            ShapeError,
            "must be aligned float64 arrays$",
        ),
    ):
        with pytest.raises(error, match=words):
            fast(*bad)
    np.testing.assert_array_equal(fast(home, rest, rest), robot.forward_dynamics(home, rest, rest))


@pytest.fixture
def ask(robot, loop):
    """Call an entry point with good arguments, but for those that are given."""
    good = {
        "robot": robot,
        "parameters": loop.parameters,
        "pose": robot.home_pose,
        "settings": loop.settings(),
    }
    good |= dict.fromkeys(
        ("kp", "kd", "ki", "frame_rate_hz", "stiffness", "motor_inertia", "std"), 1e-3
    )
    good |= dict.fromkeys(("poses", "rates", "commands"), FIVE)
    good |= dict.fromkeys(("reference", "references"), loop.reference(5))
    good |= {"controller": _ideal, "noises": np.zeros((2, 5, 6))}
    good |= {"servo": good["settings"].servo, "timing": good["settings"].timing}

    def call(entry, **bad):
        arguments = inspect.signature(entry).parameters.values()
        needed = {
            one.name: good.get(one.name, np.zeros(6))
            for one in arguments
            if one.default is one.empty
        }
        return entry(**needed | bad)

    return call


def equilibrium(robot, parameters, pose, servo):
    return closed_loop.equilibrium(robot, parameters, pose, servo)


def misplaced(std):
    return load_robot("rss6").geometry.with_errors(std, np.random.default_rng(0))


SAID = {"name": "friction law", "std": "geometry error"}


def test_every_argument_of_every_entry_point_is_checked_by_name(robot, loop, ask):
    for entry in (
        *(
            ServoGains,
            FrameTiming,
            FrictionLaw,
            JointElasticity,
            LoopSettings,
            Reference,
            StartState,
            MjcfSolver,
        ),
        *(
            simulate_servo,
            simulate_commands,
            simulate_controller,
            differentiate_servo,
            differentiate_commands,
            repeat_servo,
            repeat_commands,
            simulate_batch,
            closed_loop.prepare,
            equilibrium,
            loop.run(5).state_at,
            fast_forward_dynamics,
        ),
        *(misplaced, measure, check_motion, mjcf_text),
        *[getattr(robot, name) for name in (*METHODS, "forward_kinematics")],
    ):
        for name in inspect.signature(entry).parameters:
            with pytest.raises(
                DynamicsError, match=f"{SAID.get(name, name.split('_')[0])}.*object"
            ):
                ask(entry, **{name: object()})


def _ideal(frame, time, pose):
    return pose


def _elastic(motor_inertia=3e-4, steps=80):
    elasticity = JointElasticity(500.0, motor_inertia, 0.02)
    return LoopSettings(
        ServoGains(0.3, 0.001, 2.4), FrameTiming(60.0), FrictionLaw(), steps, elasticity
    )


POSES = np.tile([0, 0, 0.2, 0, 0, 0], (3, 1))
FIVE = np.zeros((5, 6))
REFUSED = {
    SimulationError: [
        (ServoGains, {"kp": -1.0}, "kp is -1.0, must be"),
        (FrameTiming, {"frame_rate_hz": 0.0}, "frame rate is 0.0 Hz, must be finite and > 0"),
        (
            FrameTiming,
            {"frame_rate_hz": 60.0, "latency_s": -0.01},
            "latency is -0.01 s, must be >= 0",
        ),
        (
            FrameTiming,
            {"frame_rate_hz": 60.0, "latency_s": 2.0},
            r"latency is 2.0 s.* at most 60 frames \(1 s\)",
        ),
        (
            FrictionLaw,
            {"name": "smoothed"},
            "smoothing_velocity .* is None rad/s, must be a number > 0",
        ),
        (
            FrictionLaw,
            {"name": "stribeck", "stribeck_velocity": 0.1, "static_ratio": 0.9},
            "is 0.9, .* >= 1",
        ),
        (
            FrictionLaw,
            {"static_ratio": 1.2},
            "belongs to the law `stribeck`, not to `coulomb_viscous`",
        ),
        (
            JointElasticity,
            {"stiffness": 0.0},
            "joint stiffness is 0.0 N m/rad, must be finite and > 0",
        ),
        (
            LoopSettings,
            {"steps_per_frame": 10_001},
            "steps_per_frame is 10001, .* >= 1 and <= 10000",
        ),
        (Reference, {"rates": FIVE[:4]}, r"\(5, 6\) and rates \(4, 6\) differ"),
        (Reference, {"poses": FIVE[:1]}, "reference poses must have at least 2 frames, got 1"),
        (
            StartState,
            {"pose_rate": np.zeros(5)},
            r"start pose_rate must have shape \(6,\), got \(5,\)",
        ),
        (StartState, {"commands": FIVE[:0]}, "start commands must have at least 1 row, got 0"),
        *[
            (entry, bad, rf"{name} must .* shape \(5,.*\(4, 6\)")
            for entry, name, bad in (
                (simulate_commands, "commands", {"commands": FIVE[:4]}),
                (simulate_servo, "feedforward", {"feedforward": FIVE[:4]}),
                (simulate_servo, "latencies", {"latencies": FIVE[:4]}),
                (simulate_servo, "noise", {"sensor": closed_loop.IdealSensor(noise=FIVE[:4])}),
                (simulate_servo, "lost", {"sensor": closed_loop.IdealSensor(lost=FIVE[:4])}),
            )
        ],
        (
            simulate_servo,
            {"latencies": -0.01 * np.eye(5)[2]},
            "latency of frame 2 is -0.01 s, must be >= 0",
        ),
        (
            simulate_servo,
            {"latencies": 1.1 * np.eye(5)[3]},
            r"of frame 3 is 1.1 s, .*at most 60 frames \(1 s\)",
        ),
        (
            simulate_servo,
            {"parameters": np.zeros(64)},
            r"loop parameters must have shape \(67,\).*, got \(64,\)",
        ),
        (differentiate_servo, {"sensor": _ideal}, "sensor must be of type IdealSensor, got"),
        (differentiate_commands, {"sensor": _ideal}, "sensor must be of type IdealSensor, got"),
        (
            differentiate_servo,
            {"settings": _elastic()},
            "pass settings with elasticity=None",
        ),
        (
            simulate_servo,
            {"settings": _elastic(1e-3)},
            r"below the 0.000718 kg m\^2 of crank2 including its motor",
        ),
        (
            simulate_servo,
            {"settings": _elastic(steps=20)},
            r"is 20, must be >= \d+ .* stiffness of 500 N m/rad",
        ),
        (simulate_batch, {"workers": 0}, "workers is 0, must be a whole number >= 1"),
        (
            simulate_batch,
            {"parameters": np.zeros((0, 67))},
            "got 0 parameter vectors and 1 references; each number must be 1",
        ),
        (
            simulate_batch,
            {"parameters": np.zeros((2, 64))},
            r"shape \(67,\) or \(N, 67\), got \(2, 64\)",
        ),
        (
            simulate_batch,
            {"references": [FIVE]},
            r"references\[0\] must be of type Reference, got array",
        ),
        (simulate_batch, {"starts": [3]}, r"starts\[0\] must be of type StartState, got 3"),
    ],
    ShapeError: [
        (equilibrium, {"pose": np.zeros((2, 6))}, r"pose must have shape \(6,\), got \(2, 6\)"),
        (check_motion, {"pose": np.zeros((0, 6))}, "a motion needs at least one pose"),
        (
            check_motion,
            {"pose": POSES, "times": np.zeros(2)},
            r"times must have shape \(3,\), got \(2,\)",
        ),
        (
            check_motion,
            {"pose": POSES, "times": [0.0, 0.0, 0.1]},
            r"increase, but times\[1\] = 0.0 s follows 0.0 s",
        ),
    ],
    UnreachablePoseError: [
        (equilibrium, {"pose": np.full(6, 9.0)}, r"leg 1 cannot reach pose \[9.")
    ],
    RobotFileError: [
        (
            misplaced,
            {"std": 0.2},
            r"with errors of 0.2 m of the joints, 0 m .*: leg \d cannot reach the home pose",
        )
    ],
    TravelError: [(check_motion, {"travel_margin": -0.1}, "travel_margin is -0.1.*must be")],
    ParameterError: [
        (mjcf_text, {"parameters": np.ones(67)}, r"must have shape \(64,\), got \(67,\)")
    ],
    DynamicsError: [
        (check_motion, {"least_leverage": np.nan}, "least_leverage is nan.*must be"),
        (check_motion, {"most_condition": 0.5}, "most_condition is 0.5.*must be"),
        (MjcfSolver, {"timestep_s": 0.0}, "timestep is 0.0 s"),
        (MjcfSolver, {"time_constant_steps": 1.0}, "time constant is 1.0 steps"),
        (MjcfSolver, {"impedance": 1.0}, "impedance is 1.0"),
    ],
}


@pytest.mark.parametrize(
    ("error", "entry", "bad", "words"), [(e, *row) for e, rows in REFUSED.items() for row in rows]
)
def test_bad_settings_and_arguments_are_refused_with_value_and_limit(ask, error, entry, bad, words):
    with pytest.raises(error, match=words):
        ask(entry, **bad)


def test_parameters_of_the_joint_pid_have_their_limits_and_a_start_what_its_run_needs(
    robot, identified, loop, ask
):
    for entry, index, value, words in (
        (simulate_servo, 12, -1, "crank3.mass = -1 kg is not allowed, must be finite and >= 0"),
        (simulate_servo, 64, -1, "joint_pid.lp is -1.0, must be finite and >= 0"),
        (equilibrium, 65, 0, "joint_pid.li is 0.0, must be finite and > 0"),
        (simulate_batch, 66, np.nan, "joint_pid.ld is nan, must be finite and >= 0"),
    ):
        with pytest.raises(DynamicsError, match=words):
            ask(entry, parameters=np.where(np.arange(67) == index, value, identified))
    with pytest.raises(SimulationError, match="needs motor_angle and motor_rate"):
        ask(simulate_servo, settings=_elastic(), start=ask(StartState))
    with pytest.raises(UnreachablePoseError, match="leg"):
        ask(simulate_servo, start=ask(StartState, pose=[0, 0, 0.7, 0, 0, 0]))
    state_at = loop.run(10, lost=np.arange(10) == 4).state_at
    for frame, words in (
        (10, "frame is 10, must be a whole number >= 0 and <= 9"),
        (5, "5 follows a lost measurement"),
    ):
        with pytest.raises(SimulationError, match=words):
            state_at(frame)


def test_answers_of_sensor_and_controller_are_six_numbers_or_name_the_frame(robot, loop):
    """Never a lost frame; None is one of a sensor, and nothing of a controller."""
    with pytest.raises(
        SimulationError, match=r"at frame 2 .*value returned by the pose sensor.* is nan, must"
    ):
        loop.run(5, sensor=lambda frame, time, pose: pose * (np.nan if frame == 2 else 1))
    for answer, words in ((np.zeros((1, 6)), "shape"), (None, "must be numbers")):
        answers = [*robot.inverse_kinematics(loop.reference(2).poses), answer]
        with pytest.raises(
            SimulationError, match=rf"at frame 2 .*value returned by the controller.* {words}"
        ):
            loop.run(5, controller=lambda frame, *_, answers=answers: answers[frame])


@pytest.mark.parametrize("frame", [0, 4])
def test_every_frame_of_the_reference_is_in_reach_or_the_sensor_is_never_asked(robot, loop, frame):
    reference, asked = loop.reference(5), []
    poses = reference.poses.copy()
    poses[frame] += [0.2, 0, 0, 0, 0, 0]
    margin = robot.reach_margin(poses[frame])
    leg = int(np.flatnonzero(margin <= 0)[0])
    words = rf"leg {leg + 1} cannot reach reference pose .*\(frame {frame}\): reach margin {margin[leg]:.3g}, must be"
    with pytest.raises(UnreachablePoseError, match=words):
        loop.run(Reference(poses, reference.rates), sensor=lambda *measured: asked.append(measured))
    assert not asked


def test_the_engine_takes_no_bad_input_and_no_other_model(robot, ask):
    pytest.importorskip("mujoco")
    engine = MujocoRobot(robot, mjcf_text(robot, allow_unphysical_inertia=True))
    for method in (engine.put, engine.twist_dot, engine.step, engine.feed_back):
        for name in inspect.signature(method).parameters:
            with pytest.raises(DynamicsError, match=f"{name}.*object"):
                ask(method, **{name: object()})
    with pytest.raises(DynamicsError, match=r"damping is -1\.0, must be finite and >= 0"):
        engine.feed_back(1.0, -1.0)
    for text, words in (
        (None, "text must be of type str"),
        ("no model", "MuJoCo refuses the model of rss6"),
        ("<mujoco/>", "the model is no export of rss6: .*joint1"),
    ):
        with pytest.raises(MujocoError, match=words):
            MujocoRobot(robot, text)
