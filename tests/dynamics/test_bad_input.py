"""Bad input ends in an error that holds the value, the limit and the leg or name; never in a NaN."""

import re
import tomllib
from importlib import resources

import numpy as np
import pytest

import dynamics
from dynamics import mujoco_engine
from dynamics.errors import (
    ConvergenceError,
    DynamicsError,
    ParameterError,
    RobotFileError,
    ShapeError,
    SingularPoseError,
    UnreachablePoseError,
)
from dynamics.forward_dynamics import fast_forward_dynamics
from dynamics.mjcf import mjcf_text

RSS6 = (resources.files("dynamics") / "robots" / "rss6.toml").read_text(encoding="utf-8")
FIRST_JOINT = "[0.33383501391252074, -0.0784425512051534, 0.0]"


@pytest.fixture
def load(tmp_path):
    """The robot of rss6.toml with passages of the file replaced."""

    def changed(replacements):
        text = RSS6
        for old, new in replacements.items():
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "changed.toml"
        path.write_text(text, encoding="utf-8")
        return dynamics.load_robot(path)

    return changed


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ([0, 0, 0.2, 0, 0], r"pose must have shape \(6,\) or \(N, 6\), got \(5,\)"),
        (np.zeros((2, 3, 6)), r"got \(2, 3, 6\)"),
        (np.zeros((6, 1)), r"got \(6, 1\)"),
        (0.2, r"got \(\)"),
        ([0, 0, np.nan, 0, 0, 0], r"pose\[2\] is nan, must be finite"),
        ([[0, 0, 0.2, 0, 0, 0], [0, 0, 0.2, 0, np.inf, 0]], r"pose\[1, 4\] is inf"),
        ("home", "must be numbers"),
        ([[1, 2], [3]], "must be numbers"),
    ],
)
def test_poses_of_wrong_shape_or_not_finite(robot, pose, message):
    """Shape and place are named; nothing is transposed or padded to fit."""
    with pytest.raises(ShapeError, match=message):
        robot.inverse_kinematics(pose)


def test_every_argument_of_every_method_is_checked(robot):
    """Each array argument of each method refuses a NaN by its own name."""
    home, rest, bad = robot.home_pose, np.zeros(6), np.full(6, np.nan)
    calls = {
        "twist": (robot.coriolis_matrix, robot.friction_wrench, robot.regressor, robot.inverse_dynamics),
        "twist_dot": (robot.regressor, robot.inverse_dynamics),
    }
    for name, methods in calls.items():
        for method in methods:
            count = {"coriolis_matrix": 1, "friction_wrench": 1}.get(method.__name__, 2)
            arguments = [rest] * count
            arguments[1 if name == "twist_dot" else 0] = bad
            with pytest.raises(ShapeError, match=rf"{name}\[0\] is nan"):
                method(home, *arguments)
    with pytest.raises(ShapeError, match=r"torque\[0\] is nan"):
        robot.forward_dynamics(home, rest, bad)
    with pytest.raises(ShapeError, match=r"theta\[0\] is nan"):
        robot.forward_kinematics(bad)
    with pytest.raises(ShapeError, match="initial_pose"):
        robot.forward_kinematics(rest, [1.0])


def test_batches_of_different_length(robot):
    """Lengths that do not match are named with the function; 1 is no licence to broadcast anything else."""
    with pytest.raises(ShapeError, match=r"coriolis_matrix: batch lengths differ, shapes \(3, 6\), \(2, 6\)"):
        robot.coriolis_matrix(np.tile(robot.home_pose, (3, 1)), np.zeros((2, 6)))


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (0, 0.0, r"platform.mass = 0 kg is not allowed, must be finite and > 0"),
        (0, -1.0, r"platform.mass = -1 kg"),
        (8, -0.5, r"crank2.mass = -0.5 kg is not allowed, must be finite and >= 0"),
        (29, np.nan, r"link1.Ixx = nan kg m\^2"),
        (54, -0.1, r"joint3.coulomb = -0.1 N m is"),
        (63, np.inf, r"joint6.viscous = inf N m s/rad"),
    ],
)
def test_parameters_outside_their_range(robot, index, value, message):
    """The parameter is named with its value, unit and limit, alone and in a batch."""
    values = robot.nominal_parameters.copy()
    values[index] = value
    with pytest.raises(ParameterError, match=message):
        robot.mass_matrix(robot.home_pose, values)
    with pytest.raises(ParameterError, match=rf"{message}.*\(row 1\)"):
        robot.mass_matrix(robot.home_pose, np.array([robot.nominal_parameters, values]))


def test_parameters_of_wrong_number(robot):
    """67 values (with the joint PID) where 64 are wanted are an error, not cut off."""
    with pytest.raises(ParameterError, match=r"shape \(64,\) or \(N, 64\), got \(67,\)"):
        robot.mass_matrix(robot.home_pose, np.ones(67))


def test_bodies_without_inertia_give_an_error_and_no_nan(robot):
    """Only a mass and no inertia anywhere: M is singular, and forward dynamics says so."""
    values = np.zeros(64)
    values[0] = 24.0
    with pytest.raises(SingularPoseError, match="forward_dynamics is not finite"):
        robot.forward_dynamics(robot.home_pose, np.zeros(6), np.ones(6), values)


def test_poses_out_of_reach(robot):
    """Leg, pose, row and margin are named, in every method that needs the legs."""
    far = robot.home_pose + np.array([0.2, 0, 0, 0, 0, 0])
    with pytest.raises(UnreachablePoseError, match=r"leg \d cannot reach pose \[0.2 .*reach margin -.*must be > 0"):
        robot.inverse_kinematics(far)
    with pytest.raises(UnreachablePoseError, match=r"\(row 1\)"):
        robot.mass_matrix([robot.home_pose, far])
    for method in (robot.joint_jacobian, robot.pose_jacobian, robot.mass_matrix, robot.gravity_wrench):
        with pytest.raises(UnreachablePoseError):
            method(far)


@pytest.fixture
def flat_robot(load, monkeypatch):
    """A robot whose links all lie in the plane of the platform: they carry no vertical force, J_a2 is singular."""
    monkeypatch.setattr("dynamics.robot.load_library", lambda *_: None)  # one robot is not worth compiling
    legs = tomllib.loads(RSS6)["legs"]
    tips = np.array(legs["base_joints"]) + 0.06 * np.array(legs["crank_zero_directions"])
    flat = np.linalg.norm(np.array(legs["platform_joints"]) - tips, axis=1)[0]
    return load(
        {
            "home_pose = [0.0, 0.0, 0.2,": "home_pose = [0.0, 0.0, 0.0,",
            "link_length = 0.30133373938841": f"link_length = {flat:.17g}",
        }
    )


def test_singular_poses(flat_robot):
    """Where the links carry no vertical force the robot refuses, naming condition and limit."""
    robot = flat_robot
    with pytest.raises(SingularPoseError, match=r"singular at pose \[0. 0. 0. .*condition of J_ad .*limit 1e\+10"):
        robot.forward_dynamics(robot.home_pose, np.zeros(6), np.zeros(6))
    with pytest.raises(SingularPoseError):
        robot.inverse_dynamics([robot.home_pose, robot.home_pose], np.zeros(6), np.zeros(6))


def test_the_fast_forward_dynamics_solves_equation_40_where_the_links_carry_no_vertical_force(flat_robot):
    """M is regular there: the platform falls freely, whatever the torques."""
    pose, rest, torque = flat_robot.home_pose, np.zeros(6), np.linspace(-1, 1, 6)
    wrench = flat_robot.joint_jacobian(pose).T @ torque - flat_robot.gravity_wrench(pose)
    expected = np.linalg.solve(flat_robot.mass_matrix(pose), wrench)
    found = fast_forward_dynamics(flat_robot)(pose, rest, torque)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert found[2] < -9.0


def test_a_start_beyond_all_numbers_does_not_converge(robot):
    """Newton's method from a pose whose squares overflow ends in its own error."""
    with pytest.raises(ConvergenceError, match="forward kinematics found no pose with crank angles"):
        robot.forward_kinematics(np.zeros(6), np.full(6, 1e308))


def test_errors_are_one_line_whatever_the_numbers(robot):
    """Long numbers do not break the line of a pose."""
    pose = np.array([1.234567e-300, 1.234567e200, -1.234567e-200, 1.234567e-100, -1.234567e100, 1.234567e-10])
    with pytest.raises(UnreachablePoseError, match=r"^leg 1 cannot reach pose \[[^\n]*$"):
        robot.inverse_kinematics(pose)


def test_euler_angles_at_their_singularity(robot):
    """Pose rates have no value at beta = pi/2."""
    with pytest.raises(SingularPoseError, match=r"beta = \+-pi/2"):
        robot.pose_rate([0, 0, 0.2, 0, np.pi / 2, 0], np.ones(6))


def test_unknown_robot_lists_the_known_ones(tmp_path):
    """The valid names are in the message, and a missing file is named by its path."""
    with pytest.raises(RobotFileError, match=r"unknown robot `rss7`; built-in robots: rss6; or give the path"):
        dynamics.load_robot("rss7")
    with pytest.raises(RobotFileError, match=r"cannot read robot file .*none\.toml"):
        dynamics.load_robot(tmp_path / "none.toml")
    assert dynamics.built_in_robots() == ["rss6"]


@pytest.mark.parametrize("name", [None, 5, b"rss6", ["rss6"]])
def test_a_robot_is_asked_for_by_name_or_path(name):
    """Anything else is one line with what was given, not an error of pathlib."""
    with pytest.raises(RobotFileError, match=re.escape(f"by its name or the path of its file, got {name!r}")):
        dynamics.load_robot(name)


def test_a_path_that_no_system_has():
    """A null byte is refused by Python before any file is looked for."""
    with pytest.raises(RobotFileError, match=r"cannot read robot file .*null byte"):
        dynamics.load_robot("rss6\0.toml")


def test_a_file_by_path_is_the_same_robot(load, robot):
    """A copy of the built-in file gives an equal geometry and equal parameters."""
    copy = load({})
    assert copy.geometry == robot.geometry
    np.testing.assert_array_equal(copy.nominal_parameters, robot.nominal_parameters)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "rss6"', 'name = "rss6"\ncolour = "red"', "unknown key colour; valid: name, family, home_pose"),
        ("crank_length = 0.06", "crank_lenght = 0.06", "legs: .*unknown key crank_lenght; valid: crank_length"),
        ("crank_length = 0.06\n", "", "legs.crank_length: Field required"),
        ("mass = 24.0, ", "mass = 24.0, weight = 1, ", "initial.platform: .*unknown key weight; valid: mass"),
        ('family = "rss6"', 'family = "delta"', "family: Input should be 'rss6'"),
        ("link_length = 0.30133373938841", "link_length = -0.3", "link_length must be positive and finite, got -0.3"),
        ("link_length = 0.30133373938841", "link_length = nan", "link_length must be positive and finite, got nan"),
        ("link_length = 0.30133373938841", "link_length = 0.1", "leg 1 cannot reach the home pose: reach margin -"),
        ("link_length = 0.30133373938841", 'link_length = "long"', "legs.link_length: Input should be a valid number"),
        (f"    {FIRST_JOINT},\n", "", r"base_joints must be .*\(6, 3\), got shape \(5, 3\)"),
        (FIRST_JOINT, "[0.33, -0.07]", "base_joints of leg 1 needs 3 numbers, got 2"),
        ("    [0.0, 0.0, 1.0],\n", "    [0.0, 0.0, 2.0],\n", "crank_axes of leg 1 has length 2, must be 1"),
        ("    [0.0, 0.0, 1.0],\n", "    [0.0, 0.6, 0.8],\n", "leg 1 must be normal to its crank axis; .*limit 1e-9"),
        ("mass = [0.671, ", "mass = [", r"crank.mass needs one value or 6 values, got 5"),
        ("crank = { mass = 0.685", "crank = { mass = -0.685", r"crank1.mass = -0.685 kg is not allowed"),
        ("home_pose = [0.0, ", "home_pose = [", r"home_pose must be finite with shape \(6,\)"),
        ("[parameters.initial]", "[parameters.first]", "needs a parameter set `initial`; it has .*first"),
        ('name = "rss6"', "name = ", "is not valid TOML"),
    ],
)
def test_robot_files_that_make_no_robot(load, old, new, message):
    """Unknown keys list the valid ones; places, counts, values and legs are named; the file is named first."""
    with pytest.raises(RobotFileError, match=rf"robot file .*changed.toml.*{message}"):
        load({old: new})


def test_binary_files_are_no_robot_files(tmp_path):
    """A file that is not text is an error of the robot file, not of the decoder."""
    path = tmp_path / "picture.toml"
    path.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(RobotFileError, match="cannot read robot file"):
        dynamics.load_robot(path)


BAD_ARRAYS = {
    "text": "home",
    "None in it": [None, 0, 0, 0, 0, 0],
    "ragged": [[0.0] * 6, [0.0]],
    "too long": np.zeros(7),
    "transposed batch": np.zeros((6, 2)),
    "three axes": np.zeros((1, 1, 6)),
    "complex": np.full(6, 1j),
    "complex without imaginary part": np.zeros(6, dtype=complex),
    "truth values": np.zeros(6, dtype=bool),
    "numbers as text": ["0"] * 6,
    "None": None,
    "masked": np.ma.masked_equal([0, 0, 0.2, 0, 0, 0], 0.2),
    "dictionary": {"x": 0.0},
    "nan": np.full(6, np.nan),
    "inf": np.full((2, 6), -np.inf),
    "three rows where two are": np.tile([0, 0, 0.2, 0, 0, 0], (3, 1)),
    "too large to square": np.full(6, 1e200),
}
METHODS = {  # arguments after the pose, each of shape (6,) or (N, 6)
    "inverse_kinematics": 0,
    "forward_kinematics": 0,
    "joint_jacobian": 0,
    "pose_jacobian": 0,
    "static_torque": 0,
    "reach_margin": 0,
    "mass_matrix": 0,
    "gravity_wrench": 0,
    "twist": 1,
    "pose_rate": 1,
    "coriolis_matrix": 1,
    "friction_wrench": 1,
    "twist_dot": 2,
    "regressor": 2,
    "inverse_dynamics": 2,
    "forward_dynamics": 2,
}
WITH_PARAMETERS = ("mass_matrix", "gravity_wrench", "coriolis_matrix", "friction_wrench", "static_torque")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bad", BAD_ARRAYS)
def test_no_method_takes_a_bad_array_or_returns_a_nan(robot, method, bad):
    """Every array argument in turn is replaced: the answer is an error of the package, or finite where it may be."""
    for place in range(METHODS[method] + 1):
        arguments = [np.tile(robot.home_pose, (2, 1)), *np.zeros((METHODS[method], 2, 6))]
        arguments[place] = BAD_ARRAYS[bad]
        try:
            result = getattr(robot, method)(*arguments)
        except DynamicsError:
            continue
        # Three rows alone are a batch; what is linear in a large number may still be a number.
        assert bad in ("three rows where two are", "too large to square"), result
        assert not np.isnan(result).any()


@pytest.mark.parametrize("method", WITH_PARAMETERS)
@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ("mass", r"must be numbers of shape \(64,\) or \(N, 64\), got 'mass'"),
        (["1"] * 64, "must be numbers .*dtype <U1"),
        (np.zeros(3), r"got \(3,\)"),
        (np.zeros((2, 3, 64)), r"got \(2, 3, 64\)"),
        (np.zeros((0, 3)), r"got \(0, 3\)"),
        (np.full(64, np.nan), "platform.mass = nan kg"),
        (-np.ones(64), "platform.mass = -1 kg"),
        (np.zeros(64), "platform.mass = 0 kg"),
        ([1.0, [2.0]], "must be numbers"),
        (5.0, r"got \(\)"),
        (np.ones(64) * (1 + 0.5j), "must be numbers .*dtype complex128"),
        (np.ones(64, dtype=bool), "must be numbers .*dtype bool"),
        ([None] * 64, "must be numbers .*dtype object"),
    ],
    ids=lambda value: value[:20] if isinstance(value, str) else "",
)
def test_no_method_takes_bad_parameters(robot, method, bad, words):
    arguments = [robot.home_pose, *np.zeros((METHODS[method], 6)), bad]
    with pytest.raises(ParameterError, match=words):
        getattr(robot, method)(*arguments)


def test_rows_of_parameters_must_match_the_poses(robot):
    """Three sets for two poses are named as such; one set serves all."""
    poses = np.tile(robot.home_pose, (2, 1))
    with pytest.raises(ShapeError, match=r"mass_matrix: batch lengths differ, shapes \(2, 6\), \(3, 64\)"):
        robot.mass_matrix(poses, np.tile(robot.nominal_parameters, (3, 1)))
    assert robot.mass_matrix(poses, robot.nominal_parameters[None]).shape == (2, 6, 6)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"robot": "rss6"}, DynamicsError, "robot must be of type Robot, got 'rss6'"),
        ({"parameters": "initial"}, ParameterError, r"parameters must be numbers of shape \(64,\), got 'initial'"),
        ({"parameters": np.ones(64) + 1j}, ParameterError, "must be numbers .*dtype complex128"),
        ({"parameters": np.ones(67)}, ParameterError, r"must have shape \(64,\), got \(67,\)"),
        ({"solver": "RK4"}, DynamicsError, "solver must be of type MjcfSolver, got 'RK4'"),
        ({"coulomb": 1}, DynamicsError, "coulomb is 1, must be True or False"),
        ({"allow_unphysical_inertia": "yes"}, DynamicsError, "allow_unphysical_inertia is 'yes', must be True or"),
        ({"source": None}, DynamicsError, "source must be of type str, got None"),
    ],
)
def test_no_model_is_exported_from_bad_input(robot, change, error, words):
    with pytest.raises(error, match=words):
        mjcf_text(**{"robot": robot, "allow_unphysical_inertia": True, **change})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda engine: engine.put("home", np.zeros(6)), "pose must be numbers"),
        (lambda engine: engine.put(np.zeros((1, 6)), np.zeros(6)), r"pose must have shape \(6,\), got \(1, 6\)"),
        (lambda engine: engine.put(np.zeros(6), None), "twist must be numbers"),
        (lambda engine: engine.twist_dot(1.0), r"torque must have shape \(6,\), got \(\)"),
        (lambda engine: engine.step(np.full(6, np.nan)), r"control\[0\] is nan, must be finite"),
        (lambda engine: engine.step(np.zeros(5)), r"control must have shape \(6,\), got \(5,\)"),
        (lambda engine: engine.feed_back("stiff", 1.0), "stiffness is 'stiff', must be a number"),
        (lambda engine: engine.feed_back(1.0, -1.0), "damping is -1.0, must be finite and >= 0"),
    ],
)
def test_the_engine_takes_no_bad_input(robot, call, words):
    pytest.importorskip("mujoco")
    engine = mujoco_engine.MujocoRobot(robot, mjcf_text(robot, allow_unphysical_inertia=True))
    with pytest.raises(DynamicsError, match=words):
        call(engine)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "text must be of type str, got None"),
        ("no model", "MuJoCo refuses the model of rss6"),
        ("<mujoco/>", "the model is no export of rss6: .*joint1"),
    ],
)
def test_the_engine_takes_no_other_model(robot, text, words):
    pytest.importorskip("mujoco")
    with pytest.raises(mujoco_engine.MujocoError, match=words):
        mujoco_engine.MujocoRobot(robot, text)


def test_a_robot_is_made_from_a_description():
    with pytest.raises(RobotFileError, match="description must be of type RobotDescription, got 'rss6' of type str"):
        dynamics.Robot("rss6")
