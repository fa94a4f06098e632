"""What a closed-loop run refuses before it starts, on both paths: a value goes in, one line with evidence comes out."""

import numpy as np
import pytest

from dynamics import closed_loop, simulate_batch
from dynamics import robot as forward_dynamics
from dynamics.closed_loop import FrameTiming, FrictionLaw, LoopSettings, Reference, ServoGains
from dynamics.engines import mjcf
from dynamics.errors import DynamicsError, ParameterError, ShapeError, SimulationError, UnreachablePoseError

BAD_NUMBERS = {
    "text": ("0.3", "is '0.3'.*must be a number"),
    "None": (None, "is None.*must be a number"),
    "truth value": (True, "is True.*must be a number"),
    "complex": (0.3 + 1j, r"is \(0.3\+1j\).*must be a number"),
    "array": (np.array([0.3, 0.3]), r"is array\(\[0.3, 0.3\]\).*must be a number"),
    "nan": (np.nan, "is nan.*must be finite"),
    "infinite": (np.inf, "is inf.*must be finite"),
    "too large a whole number": (10**400, "is inf.*must be finite"),
    "negative": (-1.0, "is -1.0.*must be"),
}
PLACES = {
    "servo gain kp": lambda value: ServoGains(value, 0.0, 0.0),
    "servo gain kd": lambda value: ServoGains(0.0, value, 0.0),
    "servo gain ki": lambda value: ServoGains(0.0, 0.0, value),
    "frame rate": FrameTiming,
    "latency": lambda value: FrameTiming(60.0, value),
    "smoothing_velocity": lambda value: FrictionLaw("smoothed", value),
    "static_ratio": lambda value: FrictionLaw("stribeck", None, value, 0.1),
    "stribeck_velocity": lambda value: FrictionLaw("stribeck", None, 1.5, value),
    "timestep": lambda value: mjcf.MjcfSolver(timestep_s=value),
    "time constant": lambda value: mjcf.MjcfSolver(time_constant_steps=value),
    "impedance": lambda value: mjcf.MjcfSolver(impedance=value),
}


@pytest.mark.parametrize("bad", BAD_NUMBERS)
@pytest.mark.parametrize("place", PLACES)
def test_every_number_among_the_settings_is_one(place, bad):
    value, words = BAD_NUMBERS[bad]
    with pytest.raises(DynamicsError, match=f"^{place} .*{words}"):
        PLACES[place](value)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: FrameTiming(0.0), "frame rate is 0.0 Hz, must be finite and > 0"),
        (lambda: FrameTiming(60.0, -0.01), "latency is -0.01 s, must be >= 0 and at most 60 frames"),
        (lambda: FrameTiming(60.0, 2.0), r"at most 60 frames \(1 s\)"),
        (lambda: FrameTiming(60.0, hold="cubic"), "unknown hold `cubic`; valid: zero, linear"),
        (lambda: FrameTiming(60.0, hold=np.array(["zero"])), r"unknown hold `array\(\['zero'\].*; valid: zero, linear"),
        (lambda: FrictionLaw("stribek"), "unknown friction law `stribek`; valid: coulomb_viscous, smoothed, stribeck"),
        (lambda: FrictionLaw("smoothed"), "smoothing_velocity .* is None rad/s, must be a number > 0"),
        (lambda: Reference(np.zeros((5, 6)), np.zeros((4, 6))), r"\(5, 6\) and rates \(4, 6\) differ"),
        (lambda: Reference(np.zeros((5, 7)), np.zeros((5, 7))), r"reference poses must have shape \(N, 6\), got \(5"),
        (lambda: Reference(np.zeros((1, 6)), np.zeros((1, 6))), "reference poses must have at least 2 frames, got 1"),
        (lambda: Reference(np.full((5, 6), np.nan), np.zeros((5, 6))), r"reference poses\[0, 0\] is nan, must be fin"),
        (lambda: Reference(np.zeros((5, 6)), np.zeros((5, 6)) * 1j), "reference rates must be numbers .*complex128"),
        (lambda: Reference("still", np.zeros((5, 6))), "reference poses must be numbers .*got 'still'"),
        (lambda: Reference([[0.0] * 6, [0.0]], np.zeros((5, 6))), "reference poses must be numbers"),
        (lambda: Reference(np.zeros((5, 6)), None), "reference rates must be numbers .*got None"),
    ],
)
def test_settings_of_the_loop(build, message):
    """Each setting refuses what it cannot be, with the value and the limit or the valid names."""
    with pytest.raises(SimulationError, match=message):
        build()


@pytest.mark.parametrize("steps", [0, -1, 2.5, True, "4", None, np.nan, np.inf, 10_001, 4 + 0j])
def test_steps_per_frame(make_settings, steps):
    """Steps per frame are whole and positive."""
    with pytest.raises(SimulationError, match=r"steps_per_frame is .* must be a whole number >= 1 and <= 10000"):
        make_settings(steps=steps)


@pytest.mark.parametrize("compiled", [None, False])
def test_whole_steps_are_taken_however_they_are_written(robot, identified, make_reference, make_settings, compiled):
    """4.0 and NumPy's 4 are 4."""
    runs = [
        closed_loop.simulate(robot, identified, make_reference(3), make_settings(steps=steps), compiled=compiled)
        for steps in (4, 4.0, np.int64(4))
    ]
    for run in runs[1:]:
        np.testing.assert_array_equal(run.pose, runs[0].pose)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"servo": (0.3, 0.001, 2.4)}, r"servo must be of type ServoGains, got \(0.3, 0.001, 2.4\) of type tuple"),
        ({"timing": 60.0}, "timing must be of type FrameTiming, got 60.0 of type float"),
        ({"friction": "coulomb_viscous"}, "friction must be of type FrictionLaw, got 'coulomb_viscous' of type str"),
        ({"friction": None}, "friction must be of type FrictionLaw, got None"),
    ],
)
def test_parts_of_the_settings_are_what_they_are_called(change, message):
    parts = {"servo": ServoGains(0.3, 0.001, 2.4), "timing": FrameTiming(60.0)}
    with pytest.raises(SimulationError, match=message):
        LoopSettings(**{**parts, **change})


def _with(index, value):
    return lambda parameters: np.concatenate([parameters[:index], [value], parameters[index + 1 :]])


BAD_LOOP_PARAMETERS = {
    "64 of them": (lambda p: p[:64], SimulationError, r"loop parameters must have shape \(67,\), got \(64,\)"),
    "a row of them": (lambda p: p[None], SimulationError, r"must have shape \(67,\), got \(1, 67\)"),
    "text": (lambda p: "identified", SimulationError, "loop parameters must be numbers .*got 'identified'"),
    "numbers as text": (lambda p: p.astype(str), SimulationError, "must be numbers"),
    "None": (lambda p: None, SimulationError, "loop parameters must be numbers"),
    "complex": (lambda p: p + 0j, SimulationError, "must be numbers .*dtype complex128"),
    "ragged": (lambda p: [[1.0], [1.0, 2.0]], SimulationError, "must be numbers"),
    "lp": (_with(64, -1.0), SimulationError, "joint_pid.lp is -1.0, must be finite and >= 0"),
    "li": (_with(65, 0.0), SimulationError, "joint_pid.li is 0.0, must be finite and > 0"),
    "ld": (_with(66, np.nan), SimulationError, "joint_pid.ld is nan, must be finite and >= 0"),
    "mass": (_with(12, -1.0), ParameterError, r"crank3\.mass = -1 kg is not allowed, must be finite and >= 0"),
    "inertia": (_with(13, np.inf), ParameterError, r"crank3\.Ixx = inf kg m\^2"),
}


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("bad", BAD_LOOP_PARAMETERS)
def test_parameters_of_a_run(robot, identified, make_reference, make_settings, bad, compiled):
    """The same on both paths, in a batch, and for the equilibrium alone."""
    change, error, message = BAD_LOOP_PARAMETERS[bad]
    values, reference, settings = change(identified), make_reference(5), make_settings()
    with pytest.raises(error, match=message):
        closed_loop.simulate(robot, values, reference, settings, compiled=compiled)
    with pytest.raises(error, match=message):
        closed_loop.equilibrium(robot, values, robot.home_pose, settings.servo)
    if bad != "a row of them":
        with pytest.raises(error, match=message.replace(r"(67,\)", r"(67,\) or \(N, 67\)")):
            simulate_batch(robot, values, reference, settings)


def _ideal(frame, time, pose):
    return pose


BAD_ARGUMENTS = {
    "robot by name": ({"robot": "rss6"}, "robot must be of type Robot, got 'rss6' of type str"),
    "reference as an array": ({"reference": np.zeros((5, 6))}, "reference must be of type Reference, got array"),
    "no settings": ({"settings": None}, "settings must be of type LoopSettings, got None of type NoneType"),
    "sensor by name": ({"sensor": "camera"}, "sensor must be a function .*, or None, got 'camera'"),
    "too few commands": ({"commands": np.zeros((4, 6))}, r"commands must have shape \(5, 6\), got \(4, 6\)"),
    "commands in words": ({"commands": "hold"}, r"commands must be numbers of shape \(5, 6\), got 'hold'"),
    "ragged commands": ({"commands": [[0.0] * 6, [0.0]]}, "commands must be numbers"),
    "complex commands": ({"commands": np.zeros((5, 6), complex)}, "commands must be numbers .*dtype complex128"),
    "commands of None": ({"commands": [[None] * 6] * 5}, "commands must be numbers .*dtype object"),
    "a command that is no number": ({"commands": np.full((5, 6), np.nan)}, r"commands\[0, 0\] is nan, must be finite"),
    "lost as whole numbers": ({"lost": [0, 1, 0, 0, 0]}, r"lost must be bool of shape \(5,\), got int64 of"),
    "lost as floats": ({"lost": np.full(5, 0.5)}, "lost must be bool .*got float64"),
    "lost frame numbers": ({"lost": [2, 3]}, r"lost must be bool of shape \(5,\), got int64 of shape \(2,\)"),
    "lost too short": ({"lost": np.zeros(4, dtype=bool)}, r"lost must be bool .*got bool of shape \(4,\)"),
    "lost ragged": ({"lost": [[True], [True, False]]}, "lost must be bool"),
    "lost beside a sensor": (
        {"lost": np.zeros(5, dtype=bool), "sensor": _ideal},
        "lost is for the ideal sensor: a sensor returns None at the frames that it loses",
    ),
    "noise of one frame": ({"noise": np.zeros(6)}, r"noise must have shape \(5, 6\), got \(6,\)"),
    "noise that is no number": ({"noise": np.full((5, 6), np.inf)}, r"noise\[0, 0\] is inf, must be finite"),
    "noise beside a sensor": (
        {"noise": np.zeros((5, 6)), "sensor": _ideal},
        "noise is for the ideal sensor: a sensor that is given adds its own",
    ),
    "sensitivities of a sensor": ({"sensitivities": True, "sensor": _ideal}, "sensitivities need the ideal sensor"),
    "sensitivities in words": ({"sensitivities": "all"}, "sensitivities is 'all', must be True or False"),
    "sensitivities counted": ({"sensitivities": 67}, "sensitivities is 67, must be True or False"),
    "compiled in words": ({"compiled": "yes"}, "compiled is 'yes', must be True or False"),
}


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("bad", BAD_ARGUMENTS)
def test_arguments_of_a_run(robot, identified, make_reference, make_settings, bad, compiled):
    change, message = BAD_ARGUMENTS[bad]
    arguments = {"robot": robot, "reference": make_reference(5), "settings": make_settings(), "compiled": compiled}
    with pytest.raises(SimulationError, match=message):
        closed_loop.simulate(parameters=identified, **{**arguments, **change})


BAD_ANSWERS = {
    "text": ("home", r"must be numbers of shape \(6,\), got 'home'"),
    "numbers as text": (["0"] * 6, "must be numbers"),
    "ragged": ([[0.0], [0.0, 1.0]], "must be numbers"),
    "complex": (np.zeros(6, dtype=complex), "must be numbers .*dtype complex128"),
    "with None": ([None, 0, 0, 0, 0, 0], "must be numbers .*dtype object"),
    "too short": (np.zeros(5), r"must have shape \(6,\), got \(5,\)"),
    "a row": (np.zeros((1, 6)), r"must have shape \(6,\), got \(1, 6\)"),
    "nan": (np.full(6, np.nan), "is nan, must be finite"),
}


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("bad", BAD_ANSWERS)
def test_answers_of_the_sensor(robot, identified, make_reference, make_settings, bad, compiled):
    """Anything but six finite numbers or None is an error that names the frame, never a lost frame."""
    answer, words = BAD_ANSWERS[bad]

    def sensor(frame, time, pose):
        return answer if frame == 2 else pose

    with pytest.raises(SimulationError, match=rf"what the pose sensor returned at frame 2.* {words}"):
        closed_loop.simulate(robot, identified, make_reference(5), make_settings(), sensor, compiled=compiled)


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("frame", [0, 3, 4])
def test_every_frame_of_the_reference_is_in_reach(robot, identified, make_reference, make_settings, frame, compiled):
    """A reference that leaves reach at one frame is refused before the run: the sensor is never asked."""
    reference, asked = make_reference(5), []
    poses = reference.poses.copy()
    poses[frame] += [0.2, 0, 0, 0, 0, 0]
    with pytest.raises(UnreachablePoseError) as caught:
        closed_loop.simulate(
            robot,
            identified,
            Reference(poses, reference.rates),
            make_settings(),
            lambda *measured: asked.append(measured),
            compiled=compiled,
        )
    margin = robot.reach_margin(poses[frame])
    leg = int(np.flatnonzero(margin <= 0)[0])
    assert str(caught.value).startswith(f"leg {leg + 1} cannot reach reference pose [")
    assert str(caught.value).endswith(f"(frame {frame}): reach margin {margin[leg]:.3g}, must be > 0")
    assert not asked


@pytest.mark.parametrize("compiled", [None, False])
def test_what_is_measured_beside_logged_commands_is_recorded_and_steers_nothing(
    robot, identified, make_reference, make_settings, compiled
):
    """A sensor, or frames marked as lost, leave the motion under given commands as it is."""
    reference, settings = make_reference(5), make_settings()
    commands = closed_loop.simulate(robot, identified, reference, settings).command * 1.01
    options = {"commands": commands, "compiled": compiled}
    lost = np.array([False, False, True, False, False])
    alone = closed_loop.simulate(robot, identified, reference, settings, **options)
    sensed = closed_loop.simulate(robot, identified, reference, settings, lambda *seen: seen[2] + 0.1, **options)
    masked = closed_loop.simulate(robot, identified, reference, settings, lost=lost, **options)
    for run in (sensed, masked):
        np.testing.assert_array_equal(run.pose, alone.pose)
        np.testing.assert_array_equal(run.command, commands)
    np.testing.assert_array_equal(sensed.measured, alone.pose + 0.1)
    np.testing.assert_array_equal(masked.measured_ok, ~lost)


@pytest.mark.parametrize(
    ("pose", "servo", "error", "message"),
    [
        (np.zeros((2, 6)), ServoGains(0.3, 0, 2.4), ShapeError, r"pose must have shape \(6,\), got \(2, 6\)"),
        ("home", ServoGains(0.3, 0, 2.4), ShapeError, "pose must be numbers"),
        (np.full(6, 9.0), ServoGains(0.3, 0, 2.4), UnreachablePoseError, r"leg 1 cannot reach pose \[9."),
        (np.zeros(6), None, SimulationError, "servo must be of type ServoGains, got None"),
    ],
)
def test_arguments_of_the_equilibrium(robot, identified, pose, servo, error, message):
    with pytest.raises(error, match=message):
        closed_loop.equilibrium(robot, identified, pose, servo)


def test_only_a_robot_is_compiled():
    with pytest.raises(SimulationError, match="robot must be of type Robot, got 6 of type int"):
        closed_loop.prepare(6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"workers": -1}, "workers is -1, must be a whole number >= 1"),
        ({"workers": 0}, "workers is 0, must be a whole number >= 1"),
        ({"workers": 1.5}, "workers is 1.5, must be a whole number >= 1"),
        ({"workers": True}, "workers is True, must be a whole number >= 1"),
        ({"workers": "x"}, "workers is 'x', must be a whole number >= 1"),
        ({"parameters": np.zeros((0, 67))}, "0 parameter vectors and 1 references do not pair up"),
        ({"parameters": np.zeros((2, 64))}, r"loop parameters must have shape \(67,\) or \(N, 67\), got \(2, 64\)"),
        ({"references": []}, "1 parameter vectors and 0 references do not pair up"),
        ({"references": None}, "references must be of type Sequence, got None"),
        ({"references": 5}, "references must be of type Sequence, got 5"),
        ({"references": [np.zeros((5, 6))]}, r"references\[0\] must be of type Reference, got array"),
        ({"robot": None}, "robot must be of type Robot, got None"),
        ({"settings": {}}, "settings must be of type LoopSettings, got {} of type dict"),
        ({"sensitivities": 1}, "sensitivities is 1, must be True or False"),
    ],
)
def test_arguments_of_a_batch(robot, identified, make_reference, make_settings, change, message):
    arguments = {"robot": robot, "parameters": identified, "references": make_reference(5), "settings": make_settings()}
    with pytest.raises(SimulationError, match=message):
        simulate_batch(**{**arguments, **change})


GOOD = {"at_pose": np.array([0, 0, 0.2, 0, 0, 0]), "at_twist": np.zeros(6), "at_torque": np.zeros(6)}


@pytest.mark.parametrize("place", GOOD)
@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ([0.0] * 6, r"must be a float64 array of shape \(6,\), got \[0.0, 0.0"),
        (np.zeros(6, dtype=np.float32), "must be a float64 array"),
        (np.zeros(6, dtype=int), "must be a float64 array"),
        (np.zeros(5), r"must have shape \(6,\), got \(5,\)"),
        (np.zeros((1, 6)), r"must have shape \(6,\), got \(1, 6\)"),
        (np.zeros(6, dtype=complex), "must be numbers .*dtype complex128"),
        ("rest", "must be numbers of shape"),
        (None, "must be numbers of shape"),
        (0.0, r"must have shape \(6,\), got \(\)"),
    ],
    ids=["list", "float32", "whole", "short", "row", "complex", "text", "None", "scalar"],
)
def test_inputs_of_the_fast_forward_dynamics(robot, place, bad, words):
    """Refused by name where the inner loop's own check fails; the next good call is none the worse."""
    fast = forward_dynamics.fast_forward_dynamics(robot)
    with pytest.raises(ShapeError, match=f"^{place[3:]} {words}"):
        fast(*{**GOOD, place: bad}.values())
    expected = robot.forward_dynamics(GOOD["at_pose"], np.zeros(6), np.zeros(6))
    assert np.array_equal(fast(*GOOD.values()), expected)
