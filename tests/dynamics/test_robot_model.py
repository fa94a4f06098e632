"""A robot's model with its numbers: in joint coordinates, in CasADi, and by what Pinocchio reads of
the URDF.
"""

from xml.etree import ElementTree as Xml

import numpy as np
import pytest
import yaml
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from dynamics import RobotModel, load_robot
from dynamics.errors import SingularPoseError
from dynamics.inertia import physical_inertias, travel_states

ROBOTS = ["rrr3", "rss6", "ups6", "delta3", "pus6"]


def physical(name):
    """A robot with the set `truth`, and with bodies that can exist."""
    robot = load_robot(name)
    chosen = robot.parameter_sets["truth"]
    values = chosen.vector.copy()
    bodies = physical_inertias(robot.layout, chosen.dynamic, allow_changes=True).values
    values[robot.layout.rigid] = robot.layout.rigid_of(bodies)
    return robot.with_parameters(values)


def motion(robot, count=5):
    pose, twist, _ = travel_states(robot, robot.nominal_parameters)
    basis = robot.geometry.chart.basis
    rng = np.random.default_rng(3)
    gain = rng.standard_normal((count, basis.shape[1])) @ basis.T
    return pose[:count], twist[:count], gain


def test_all_numbers_of_an_identification_are_taken_as_dynamic_parameters():
    robot = load_robot("rrr3")
    found = robot.parameter_sets["truth"]
    pose, twist, gain = motion(robot)
    torque = robot.inverse_dynamics(pose, twist, gain, found.dynamic)
    np.testing.assert_array_equal(robot.inverse_dynamics(pose, twist, gain, found.vector), torque)
    model = RobotModel(robot.with_parameters(found.vector))
    np.testing.assert_array_equal(model.tau(pose, twist, gain), torque)
    one = model.casadi("inverse_dynamics")
    assert (one.name_in(), one.name_out()) == (["pose", "twist", "twist_dot"], ["torque"])
    np.testing.assert_allclose(one(pose.T, twist.T, gain.T).full().T, torque, rtol=1e-9, atol=1e-9)
    assert model.casadi("pose_jacobian").name_in() == ["pose"]


def test_a_motion_of_the_joints_at_a_singular_pose_is_refused(monkeypatch):
    robot = load_robot("rrr3")

    def turned(gamma):
        return np.array([*robot.home_pose[:5], gamma])

    singular = brentq(lambda g: np.linalg.det(robot.coordinate_jacobian(turned(g))), -0.7, -0.4)
    monkeypatch.setattr(type(robot), "forward_kinematics", lambda *_: turned(singular))
    with pytest.raises(SingularPoseError, match="the robot is singular at pose"):
        RobotModel(robot).platform_motion(*np.zeros((3, 3)))


@pytest.mark.parametrize("name", ROBOTS)
def test_torques_of_a_motion_in_joint_coordinates_are_those_of_the_platform(name):
    """The motion of the joints is differenced from poses along a smooth path."""
    robot = physical(name)
    model, free = RobotModel(robot), robot.geometry.chart.basis
    rng = np.random.default_rng(4)
    rate, bend = 0.02 * rng.standard_normal((2, free.shape[1])) @ free.T
    step = 1e-3
    t = step * np.arange(-3, 4)[:, None]
    path = robot.home_pose + t * rate + t**2 / 2 * bend
    joints = robot.inverse_kinematics(path)
    weights = np.array([[-1, 9, -45, 0, 45, -9, 1], [2, -27, 270, -490, 270, -27, 2]])
    first, second = weights[0] @ joints / (60 * step), weights[1] @ joints / (180 * step**2)
    pose, twist, gain = model.platform_motion(joints[3], first, second)
    turned = Rotation.from_euler("XYZ", path[:, 3:])
    spins = (turned[1:] * turned[:-1].inv()).as_rotvec() / step
    moved = np.hstack([np.diff(path[:, :3], axis=0) / step, spins])
    np.testing.assert_allclose(pose, path[3], atol=1e-9)
    np.testing.assert_allclose(twist, moved[2:4].mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(gain, (moved[3] - moved[2]) / step, atol=1e-5)
    whole = model.tau_of_joints(
        np.tile(joints[3], (2, 1)), np.tile(first, (2, 1)), np.tile(second, (2, 1))
    )
    np.testing.assert_allclose(whole[1], model.tau(pose, twist, gain), rtol=1e-9)


@pytest.mark.parametrize("name", ["rrr3", "ups6", "pus6", "rus6"])
def test_pinocchio_reads_the_urdf_and_finds_the_same_torques(name):
    """By the bodies and the frames to close alone: M a + h = S tau + J^T f, with J a + J_dot v = 0.

    Robots whose links cannot spin: for the others the import of the same files is the proof.
    """
    pin = pytest.importorskip("pinocchio")
    robot = physical(name)
    values = robot.parameter_sets["guess"].vector.copy()
    values[robot.layout.coulomb] = values[robot.layout.viscous] = 0
    robot = robot.with_parameters(values)
    urdf, closures = RobotModel(robot).urdf()
    stated = yaml.safe_load(closures)
    model = pin.buildModelFromXML(in_three_hinges(urdf, stated["joint_name"]))
    data = model.createData()
    pairs = [[model.getFrameId(name) for name in pair] for pair in stated["closed_loop"]]
    floating = model.joints[model.getJointId("platform")]
    assert floating.shortname() == "JointModelFreeFlyer"
    free = np.arange(floating.idx_v, floating.idx_v + 6)
    legs = np.setdiff1d(np.arange(model.nv), free)
    driven = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    home = pin.SE3(Rotation.from_euler("XYZ", robot.home_pose[3:]).as_matrix(), robot.home_pose[:3])

    def gaps(q):
        pin.forwardKinematics(model, data, q)
        pin.updateFramePlacements(model, data)
        return np.concatenate(
            [data.oMf[end].translation - data.oMf[seat].translation for end, seat in pairs]
        )

    def rows(q):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        frame = pin.LOCAL_WORLD_ALIGNED
        return np.vstack(
            [
                np.subtract(*(pin.getFrameJacobian(model, data, one, frame)[:3] for one in pair))
                for pair in pairs
            ]
        )

    for pose, twist, gain in zip(*motion(robot, 3), strict=True):
        turn = Rotation.from_euler("XYZ", pose[3:]).as_matrix()
        q = pin.neutral(model)
        q[floating.idx_q : floating.idx_q + 7] = pin.SE3ToXYZQUAT(
            home.inverse() * pin.SE3(turn, pose[:3])
        )
        for _ in range(12):
            step = np.zeros(model.nv)
            step[legs] = -np.linalg.lstsq(rows(q)[:, legs], gaps(q), rcond=None)[0]
            q = pin.integrate(model, q, step)
        assert np.abs(gaps(q)).max() < 1e-10
        matrix = rows(q)
        v, a = np.zeros((2, model.nv))
        v[free] = np.concatenate([turn.T @ twist[:3], turn.T @ twist[3:]])
        v[legs] = -np.linalg.lstsq(matrix[:, legs], matrix[:, free] @ v[free], rcond=None)[0]
        a[free] = np.concatenate(
            [turn.T @ gain[:3] - np.cross(v[free[3:]], v[free[:3]]), turn.T @ gain[3:]]
        )
        pin.forwardKinematics(model, data, q, v, 0 * a)
        pin.updateFramePlacements(model, data)
        frame = pin.LOCAL_WORLD_ALIGNED
        bend = np.concatenate(
            [
                np.subtract(
                    *(
                        pin.getFrameClassicalAcceleration(model, data, one, frame).linear
                        for one in pair
                    )
                )
                for pair in pairs
            ]
        )
        a[legs] = -np.linalg.lstsq(matrix[:, legs], matrix[:, free] @ a[free] + bend, rcond=None)[0]
        inertial = pin.rnea(model, data, q, v, a)
        unknown = np.hstack([np.eye(model.nv)[:, driven], matrix.T])
        solved = np.linalg.lstsq(unknown, inertial, rcond=None)[0]
        assert np.abs(unknown @ solved - inertial).max() < 1e-6 * np.abs(inertial).max()
        torque = RobotModel(robot).tau(pose, twist, gain)
        np.testing.assert_allclose(solved[: len(driven)], torque, rtol=1e-6)


def in_three_hinges(urdf, balls):
    """The URDF with each spherical joint as three revolute joints in a row."""
    root = Xml.fromstring(urdf)
    for joint in [one for one in root.iter("joint") if one.get("name") in balls]:
        name, child = joint.get("name"), joint.find("child").get("link")
        joint.find("axis").set("xyz", "1 0 0")
        before = f"{name}_1"
        joint.find("child").set("link", before)
        for number, axis in ((2, "0 1 0"), (3, "0 0 1")):
            after = child if number == 3 else f"{name}_2"
            Xml.SubElement(root, "link", name=before)
            more = Xml.SubElement(root, "joint", name=f"{name}_{number}", type="revolute")
            Xml.SubElement(more, "parent", link=before)
            Xml.SubElement(more, "child", link=after)
            Xml.SubElement(more, "axis", xyz=axis)
            before = after
    for joint in root.iter("joint"):
        if joint.get("type") == "revolute" and joint.find("limit") is None:
            joint.set("type", "revolute")
            Xml.SubElement(joint, "limit", lower="-9", upper="9", effort="1", velocity="1")
    return Xml.tostring(root, encoding="unicode")


def test_a_urdf_has_no_limits_that_the_robot_file_does_not_state():
    urdf, _ = RobotModel(physical("ups6")).urdf()
    limits = [limit for limit in Xml.fromstring(urdf).iter("limit") if "effort" in limit.attrib]
    assert len(limits) == 6
    assert all(float(limit.get(key)) >= 1e6 for limit in limits for key in ("effort", "velocity"))
    assert "the robot file states no limits" in urdf


def test_inertias_that_an_export_changes_are_warned_of():
    with pytest.warns(UserWarning, match=r"changed platform: Ixx .* 4\.4 %"):
        RobotModel(
            load_robot("rss6").with_parameters(load_robot("rss6").parameter_sets["truth"].vector)
        ).mjcf(allow_unphysical_inertia=True)


def test_parameters_of_a_robot_can_be_given_a_name():
    robot = load_robot("ups6")
    values = robot.parameter_sets["truth"].vector
    named = robot.with_parameters(values, "identified")
    assert "sets: guess, identified" in repr(named)
    np.testing.assert_array_equal(named.parameter_sets["identified"].vector, values)
