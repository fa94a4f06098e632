"""Parameters that no robot has are refused with name, value, unit and limit."""

import numpy as np
import pytest

from dynamics.errors import ParameterError, ShapeError

ARGUMENTS = {  # between the pose and the parameters, each of shape (6,)
    "mass_matrix": 0,
    "gravity_wrench": 0,
    "coriolis_matrix": 1,
    "friction_wrench": 1,
    "static_torque": 0,
}


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


@pytest.mark.parametrize("method", ARGUMENTS)
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
    arguments = [robot.home_pose, *np.zeros((ARGUMENTS[method], 6)), bad]
    with pytest.raises(ParameterError, match=words):
        getattr(robot, method)(*arguments)


def test_rows_of_parameters_must_match_the_poses(robot):
    """Three sets for two poses are named as such; one set serves all."""
    poses = np.tile(robot.home_pose, (2, 1))
    with pytest.raises(ShapeError, match=r"mass_matrix: batch lengths differ, shapes \(2, 6\), \(3, 64\)"):
        robot.mass_matrix(poses, np.tile(robot.nominal_parameters, (3, 1)))
    assert robot.mass_matrix(poses, robot.nominal_parameters[None]).shape == (2, 6, 6)
