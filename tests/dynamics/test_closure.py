"""Geometric numbers of every kind of leg, and where loops close when they are off: against the
inverse kinematics.
"""

import casadi as ca
import numpy as np
import pytest

import dynamics
from dynamics.closure import Closure
from dynamics.errors import ConvergenceError
from dynamics.geometry import RobotGeometry
from dynamics.kinematics.platform import Chart
from dynamics.rigid_body.jacobians import joint_coordinates
from tests.dynamics.conftest import SLOW_ROBOTS, derivative

OFF_M, OFF_RAD = 1e-4, 1e-3


def mixed():
    """Cranks with links on ball joints, on universal joints, and on both; they share a chart and a
    unit.
    """
    legs = [
        dynamics.load_robot(name).geometry.legs[k] for k, name in enumerate(3 * ("rss6", "rus6"))
    ]
    return RobotGeometry(
        tuple(legs), Chart("free", (0, 0, 0.2, 0, 0, 0)), 0.9948, np.array([0, 0, -9.81])
    )


@pytest.fixture(scope="module", params=[*SLOW_ROBOTS, "mixed"])
def geometry(request):
    return mixed() if request.param == "mixed" else dynamics.load_robot(request.param).geometry


def drawn_deviations(geometry, seed=0):
    units = np.array([OFF_M if unit == "m" else OFF_RAD for unit in geometry.number_units])
    return units * np.random.default_rng(seed).standard_normal(len(units))


def joints_and_start(geometry, rows=5):
    rng = np.random.default_rng(1)
    joints = 0.4 * geometry.travel_limit * rng.uniform(-1, 1, (rows, len(geometry.legs)))
    return joints, np.tile(geometry.home_pose, (rows, 1))


def inverse_kinematics(geometry, poses):
    """Joint coordinates (N, n) in closed form, of any geometry, without compiling it."""
    pose = ca.SX.sym("pose", 6)
    closed_form = ca.Function("joints", [pose], [joint_coordinates(geometry, pose)])
    return np.array([np.array(closed_form(one)).ravel() for one in poses])


def test_numbers_are_moved_by_what_their_deviations_say(geometry):
    off = drawn_deviations(geometry)
    moved = geometry.moved(off)
    np.testing.assert_allclose(moved.deviations_from(geometry), off, rtol=0, atol=1e-15)
    assert (
        len(geometry.number_names)
        == len(geometry.number_units)
        == len(set(geometry.number_names))
        == len(off)
    )
    places = [k for k, name in enumerate(geometry.number_names) if name.endswith("base_joint.x")]
    np.testing.assert_array_equal(moved.base_joints[:, 0] - geometry.base_joints[:, 0], (geometry.numbers + off)[places]
                                  - geometry.numbers[places])  # fmt: skip
    for leg, nominal in zip(moved.legs, geometry.legs, strict=True):
        if leg.turned:
            turned = np.arccos(
                np.clip(getattr(leg, leg.turned[0]) @ getattr(nominal, leg.turned[0]), -1, 1)
            )
            own = dict(zip(leg.numbers, off[: len(leg.numbers)], strict=True))
            off = off[len(leg.numbers) :]
            tilt = np.hypot(own.get(f"{leg.turned[0]}.u", 0), own.get(f"{leg.turned[0]}.v", 0))
            assert turned == pytest.approx(tilt, abs=1e-7)


def test_a_shifted_robot_reads_that_much_less_everywhere(geometry):
    by = np.linspace(-0.01, 0.02, len(geometry.legs))
    _, start = joints_and_start(geometry)
    poses = start + 1e-3 * geometry.chart.lifted(np.ones((5, len(geometry.chart.freedoms))))
    read = inverse_kinematics(geometry, poses), inverse_kinematics(geometry.shifted(by), poses)
    np.testing.assert_allclose(read[0] - read[1], np.tile(by, (5, 1)), rtol=0, atol=1e-12)


def test_loops_close_where_the_inverse_kinematics_of_the_moved_robot_says(geometry):
    off, (joints, start) = drawn_deviations(geometry), joints_and_start(geometry)
    poses = Closure(geometry).poses(joints, off, start)
    np.testing.assert_allclose(
        inverse_kinematics(geometry.moved(off), poses), joints, rtol=0, atol=1e-11
    )
    np.testing.assert_array_equal(geometry.chart.forbidden(poses), 0)


def test_derivatives_of_closed_loops_are_those_of_differences(geometry):
    closure, off, (joints, start) = (
        Closure(geometry),
        drawn_deviations(geometry),
        joints_and_start(geometry),
    )
    poses = closure.poses(joints, off, start)
    by_numbers, by_joints = closure.derivatives(poses, joints, off)
    coordinates = geometry.chart.coordinates
    moved = np.stack(
        [
            derivative(lambda h, e=e: coordinates(closure.poses(joints, off + h * e, poses)), 1e-4)
            for e in np.eye(len(off))
        ],
        axis=2,
    )
    np.testing.assert_allclose(by_numbers, moved, rtol=0, atol=1e-9 * np.abs(moved).max())
    turned = np.stack(
        [
            derivative(lambda h, e=e: coordinates(closure.poses(joints + h * e, off, poses)), 1e-4)
            for e in np.eye(len(geometry.legs))
        ],
        axis=2,
    )
    np.testing.assert_allclose(by_joints, turned, rtol=0, atol=1e-9 * np.abs(turned).max())


def test_joint_coordinates_without_a_pose_are_refused_by_the_number_of_the_pose():
    geometry = dynamics.load_robot("ups6").geometry
    joints, start = joints_and_start(geometry)
    joints[3, 0] = 5.0  # m, between neighbours of 0.3 m
    with pytest.raises(ConvergenceError, match="of pose 4"):
        Closure(geometry).poses(joints, np.zeros(42), start)
