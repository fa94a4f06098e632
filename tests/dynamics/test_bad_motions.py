"""Poses, twists and torques that are none end in an error that holds name, place and value; never in a NaN."""

import numpy as np
import pytest

from dynamics.errors import ConvergenceError, DynamicsError, ShapeError, UnreachablePoseError


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


def test_a_start_beyond_all_numbers_does_not_converge(robot):
    """Newton's method from a pose whose squares overflow ends in its own error."""
    with pytest.raises(ConvergenceError, match="forward kinematics found no pose with crank angles"):
        robot.forward_kinematics(np.zeros(6), np.full(6, 1e308))


def test_errors_are_one_line_whatever_the_numbers(robot):
    """Long numbers do not break the line of a pose."""
    pose = np.array([1.234567e-300, 1.234567e200, -1.234567e-200, 1.234567e-100, -1.234567e100, 1.234567e-10])
    with pytest.raises(UnreachablePoseError, match=r"^leg 1 cannot reach pose \[[^\n]*$"):
        robot.inverse_kinematics(pose)


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
