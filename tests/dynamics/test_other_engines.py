"""The robot in MuJoCo by the exported MJCF; inertias that no body has."""

import sys
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dynamics.engines.mjcf import MjcfSolver, mjcf_text
from dynamics.engines.mujoco_engine import MujocoMissingError, MujocoRobot
from dynamics.inertia import physical_inertias, travel_states
from dynamics.robot import load_robot
from tests.dynamics.conftest import SLOW_ROBOTS


@pytest.fixture
def mujoco():
    return pytest.importorskip("mujoco")


def exported(robot, parameters=None, **options):
    return MujocoRobot(
        robot, mjcf_text(robot, parameters, allow_unphysical_inertia=True, **options)
    )


def as_exported(robot, values):
    """Parameters (p,) with the inertias that the export writes."""
    changed = values.copy()
    bodies = physical_inertias(robot.layout, values, allow_changes=True).values
    changed[robot.layout.rigid] = robot.layout.rigid_of(bodies)
    return changed


def test_model_has_exactly_the_parameters_and_closed_loops_at_home(mujoco, robot, identified):
    """Those of Table 2 with other numbers in every body, all of which rigid bodies can have."""
    physical = identified[:64].copy()
    bodies = physical[robot.layout.rigid].reshape(13, 4)
    bodies[:, 1:] = bodies[:, 3:] * np.random.default_rng(2).uniform(0.6, 1.0, (13, 3))
    engine = MujocoRobot(robot, mjcf_text(robot, physical))
    model = engine.model
    for body, row in zip(robot.layout.bodies, bodies, strict=True):
        assert model.body(body).mass[0] == row[0]
        np.testing.assert_array_equal(model.body(body).inertia, row[1:])
    for leg in range(6):
        joint = model.joint(f"joint{leg + 1}")
        assert joint.damping[0] == physical[robot.layout.viscous][leg]
        assert joint.frictionloss[0] == physical[robot.layout.coulomb][leg]
    np.testing.assert_array_equal(model.opt.gravity, robot.geometry.gravity)
    assert not model.geom_contype.any()
    assert (model.nv, model.nu, model.neq) == (30, 6, 6)
    mujoco.mj_resetDataKeyframe(model, engine.data, model.key("home").id)
    np.testing.assert_allclose(engine.pose, robot.home_pose, atol=1e-15)
    np.testing.assert_allclose(engine.joints, robot.inverse_kinematics(robot.home_pose), atol=1e-15)
    assert engine.closure_error < 1e-14
    without = MujocoRobot(robot, mjcf_text(robot, physical, coulomb=False)).model
    assert not without.dof_frictionloss.any()
    assert without.joint("joint1").damping[0] == physical[robot.layout.viscous][0]


@pytest.mark.parametrize("name", ["guess", "truth"])
def test_accelerations_differ_by_the_softness_of_the_loops_alone(mujoco, robot, states, name):
    """At rest, under random torques: 1 - impedance is the share of the loop forces that MuJoCo
    leaves out.
    """
    values = as_exported(robot, robot.parameter_sets[name].dynamic)
    values[robot.layout.coulomb] = 0.0
    torques = 5 * np.random.default_rng(5).standard_normal((30, 6))
    ours = robot.forward_dynamics(states.pose[:30], np.zeros((30, 6)), torques, values)
    worst = {}
    for impedance in (0.999, 0.9999):
        engine, errors = exported(robot, values, solver=MjcfSolver(impedance=impedance)), []
        for pose, torque, acceleration in zip(states.pose[:30], torques, ours, strict=True):
            engine.put(pose, np.zeros(6))
            assert engine.closure_error < 1e-14
            errors.append(
                np.abs(engine.twist_dot(torque) - acceleration).max() / np.abs(acceleration).max()
            )
        worst[impedance] = max(errors)
    assert worst[0.9999] < 3e-4
    assert worst[0.999] / worst[0.9999] == pytest.approx(10, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW_ROBOTS)
def test_reloaded_bodies_accelerate_as_the_robot_with_the_changed_parameters(mujoco, name):
    """With MuJoCo's bodies in loops that are closed exactly (not by its springs), moving, with
    friction: to 1e-9 in the first of the random states.
    """
    robot = load_robot(name)
    for chosen in robot.parameter_sets.values():
        values = as_exported(robot, chosen.dynamic)
        engine = exported(robot, chosen.dynamic)
        pose, twist, holding = (drawn[:6] for drawn in travel_states(robot, values))
        usual = 0.1 * chosen.joint_pid[0] * robot.travel_limit
        torques = holding + usual * np.random.default_rng(8).standard_normal(holding.shape)
        ours = robot.forward_dynamics(pose, twist, torques, values)
        for *state, torque, acceleration in zip(pose, twist, torques, ours, strict=True):
            theirs = acceleration_in_rigid_loops(mujoco, engine, *state, torque)
            assert np.abs(theirs - acceleration).max() <= 1e-9 * np.abs(acceleration).max()


def acceleration_in_rigid_loops(mujoco, engine, pose, twist, torque):
    """twist_dot of MuJoCo's bodies with the loop equations solved as they stand: M a - J^T f = Q, J
    a = -J_dot v.
    """
    engine.put(pose, twist)
    model, data = engine.model, engine.data
    size, count = model.nv, 3 * model.neq
    mass, loops, drift = np.zeros((size, size)), np.zeros((count, size)), np.zeros((count, size))
    mujoco.mj_fullM(model, data, mass)
    for loop in range(model.neq):
        rows = slice(3 * loop, 3 * loop + 3)
        for sign, site in ((1, model.eq_obj1id[loop]), (-1, model.eq_obj2id[loop])):
            part, rate = np.zeros((3, size)), np.zeros((3, size))
            at, body = data.site_xpos[site], model.site_bodyid[site]
            mujoco.mj_jac(model, data, part, None, at, body)
            mujoco.mj_jacDot(model, data, rate, None, at, body)
            loops[rows] += sign * part
            drift[rows] += sign * rate
    assert np.abs(loops @ data.qvel).max() < 1e-10, "the loops stay closed"
    force = data.qfrc_passive - data.qfrc_bias - model.dof_frictionloss * np.sign(data.qvel)
    force[model.jnt_dofadr[model.actuator_trnid[:, 0]]] += torque
    system = np.block([[mass, -loops.T], [loops, np.zeros((count, count))]])
    a = np.linalg.solve(system, np.concatenate([force, -drift @ data.qvel]))
    platform = Rotation.from_quat(data.qpos[3:7], scalar_first=True).as_matrix()
    return np.concatenate([a[:3], platform @ a[3:6]])


def test_resting_robot_stays_in_its_dry_friction(mujoco, robot):
    """Half the breakaway torque on every crank for 1 s: MuJoCo's stiff dry friction creeps by less
    than 0.1 um.
    """
    values = robot.parameter_sets["truth"].dynamic
    engine = exported(robot, values)
    engine.put(robot.home_pose, np.zeros(6))
    torque = robot.static_torque(robot.home_pose, values) + 0.5 * values[robot.layout.coulomb]
    for _ in range(round(1 / engine.timestep)):
        engine.step(torque)
    assert np.abs(engine.pose - robot.home_pose)[:3].max() < 1e-7


def test_mujoco_accepts_what_was_changed(mujoco, robot):
    rng = np.random.default_rng(4)
    values = robot.nominal_parameters.copy()
    for _ in range(20):
        values[robot.layout.rigid] = rng.uniform(0, 1, 52) * rng.integers(0, 2, 52)
        values[0] = 24.0
        exported(robot, values)


def test_file_is_valid_xml_whatever_the_source_and_the_robot_are_called(robot, tmp_path):
    for source, written in (
        ("a--b---c & <d>-", "a- -b- - -c & <d>-"),
        ("nul\0 escape\x1b half\udc80 none\uffff", "nul? escape? half? none?"),
        ("Gr\u00f6\u00dfe \U0001f600\ttab", "Gr\u00f6\u00dfe \U0001f600\ttab"),
    ):
        text = mjcf_text(robot, allow_unphysical_inertia=True, source=source)
        (tmp_path / "model.xml").write_text(text, encoding="utf-8")
        root = Xml.parse(
            tmp_path / "model.xml", Xml.XMLParser(target=Xml.TreeBuilder(insert_comments=True))
        ).getroot()
        assert written in root[0].text
        assert len(list(root.iter("body"))) == 13


def test_without_mujoco_one_line_names_the_extra(robot, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MujocoMissingError, match=r"pip install '\.\[mujoco\]' in a checkout"):
        exported(robot)
