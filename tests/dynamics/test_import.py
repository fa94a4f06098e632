"""Files of other programs as robots: every robot there and back, hand-written ones, and what is no
robot of a kind.
"""

import re
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dynamics.engines.mjcf import mjcf_text
from dynamics.engines.mjcf_import import robot_of_mjcf
from dynamics.engines.urdf import urdf_texts
from dynamics.engines.urdf_import import robot_of_urdf
from dynamics.errors import RobotFileError
from dynamics.inertia import physical_inertias
from dynamics.pseudo_inertia import full_body
from dynamics.rigid_body.jacobians import joint_coordinates, joint_jacobian
from dynamics.rigid_body.virtual_work import inertial_wrench
from dynamics.robot import Robot, load_robot
from dynamics.robot_file import RobotDescription
from dynamics.robot_text import robot_text
from tests.dynamics.conftest import BOX, SLOW_ROBOTS
from tests.identify.commands import refusal


def with_bodies(robot):
    """Parameters (p,) of the set `truth` with inertias that bodies can have."""
    values = robot.parameter_sets["truth"].dynamic.copy()
    bodies = physical_inertias(robot.layout, values, allow_changes=True).values
    values[robot.layout.rigid] = robot.layout.rigid_of(bodies)
    return values


@cache
def legs_of(geometry):
    """CasADi function of pose, twist, its rate and inertial parameters: joint coordinates, joint
    Jacobian and wrench without friction of the actuators.
    """
    pose, twist, twist_dot = (ca.SX.sym(name, 6) for name in ("pose", "twist", "twist_dot"))
    rigid = ca.SX.sym("rigid", geometry.layout.rigid.stop)
    found = [
        joint_coordinates(geometry, pose),
        joint_jacobian(geometry, pose),
        inertial_wrench(geometry, pose, twist, twist_dot, rigid),
    ]
    return ca.Function("legs", [pose, twist, twist_dot, rigid], found)


def assert_same_dynamics(robot, values, description, folder):
    """The same joint coordinates, Jacobians and wrenches at random states, and the same friction,
    of the robot and of what its file holds. Accelerations follow from these.
    """
    (folder / "robot.toml").write_text(robot_text(description, ["a\nnote"]), encoding="utf-8")
    other = load_robot(folder / "robot.toml")
    assert other.geometry == description.geometry
    assert other.layout == robot.layout
    assert other.travel_limit == robot.travel_limit
    layout, basis = robot.layout, robot.geometry.chart.basis
    drawn = np.random.default_rng(0).uniform(-1, 1, (20, 3, 6)) @ basis @ basis.T
    for away, twist, twist_dot in drawn:
        state = robot.home_pose + BOX * away, twist, 10 * twist_dot
        ours, theirs = (
            legs_of(one.geometry)(*state, parameters[layout.rigid])
            for one, parameters in ((robot, values), (other, other.nominal_parameters))
        )
        for one, same in zip(ours, theirs, strict=True):
            one = np.array(one)
            np.testing.assert_allclose(one, same, rtol=0, atol=1e-9 * max(1, np.abs(one).max()))
    friction = slice(layout.rigid.stop, None)
    np.testing.assert_allclose(other.nominal_parameters[friction], values[friction], rtol=1e-12)
    return other


@pytest.mark.parametrize("name", SLOW_ROBOTS)
def test_a_robot_written_as_toml_is_the_same_to_the_last_digit(name, tmp_path):
    robot = load_robot(name)
    description = RobotDescription(robot.name, robot.geometry, robot.parameter_sets)
    (tmp_path / "robot.toml").write_text(robot_text(description), encoding="utf-8")
    again = load_robot(tmp_path / "robot.toml")
    assert again.geometry == robot.geometry
    assert list(again.parameter_sets) == list(robot.parameter_sets)
    for key, values in robot.parameter_sets.items():
        np.testing.assert_array_equal(again.parameter_sets[key].vector, values.vector)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW_ROBOTS)
def test_a_robot_exported_as_mjcf_and_imported_has_the_same_dynamics(name, tmp_path):
    pytest.importorskip("mujoco")
    robot = load_robot(name)
    values = with_bodies(robot)
    (tmp_path / "robot.xml").write_text(mjcf_text(robot, values), encoding="utf-8")
    description, notes = robot_of_mjcf(tmp_path / "robot.xml")
    assert notes == []
    other = assert_same_dynamics(robot, values, description, tmp_path)
    np.testing.assert_allclose(other.home_pose, robot.home_pose, atol=1e-15)
    for leg, same in zip(robot.geometry.legs, other.geometry.legs, strict=True):
        drawn = [name for name in type(leg).model_fields if name.endswith("_radius")]
        assert [getattr(leg, name) for name in drawn] == [getattr(same, name) for name in drawn]
    gains = robot.parameter_sets["guess"].joint_pid
    np.testing.assert_array_equal(other.parameter_sets["guess"].joint_pid, gains)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("rus6", marks=pytest.mark.thorough),
        pytest.param("delta3", marks=pytest.mark.slow),
    ],
)
def test_full_bodies_of_legs_exported_and_imported_have_the_same_dynamics(name, tmp_path):
    """By MJCF, and by URDF in its own writer; a link that can spin is remarked on."""
    pytest.importorskip("mujoco")
    robot = load_robot(name).with_full_bodies(["crank", "link"])
    rng = np.random.default_rng(7)
    bodies = robot.layout.bodies_of(with_bodies(robot))
    for row in bodies[1:]:
        second = np.diag(row[4:7].mean() * rng.uniform(0.3, 0.7, 3))
        axes = Rotation.random(random_state=rng).as_matrix()
        inertia = axes @ (np.trace(second) * np.eye(3) - second) @ axes.T
        row[:] = full_body(row[0], 0.005 * rng.standard_normal(3), inertia)
    values = with_bodies(robot)
    values[robot.layout.rigid] = robot.layout.rigid_of(bodies)
    (tmp_path / "robot.xml").write_text(mjcf_text(robot, values), encoding="utf-8")
    spin = [] if name == "rus6" else ["can spin about their length between two ball joints"]
    for description, notes in (
        robot_of_mjcf(tmp_path / "robot.xml"),
        robot_of(tmp_path, *urdf_texts(robot, values)),
    ):
        assert_same_dynamics(robot, values, description, tmp_path)
        assert [text for text in spin if not any(text in note for note in notes)] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "platform_on_a_leg"),
    [
        ("rss6", False),
        ("delta3", True),
        *[
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("rss6", True),
                ("rus6", True),
                ("ups6", False),
                ("pus6", True),
                ("rrr3", False),
            )
        ],
    ],
)
def test_a_robot_written_as_urdf_with_closures_has_the_same_dynamics(
    name, platform_on_a_leg, tmp_path
):
    robot = load_robot(name)
    values = with_bodies(robot)
    description, notes = robot_of(
        tmp_path, *urdf_texts(robot, values, platform_on_a_leg=platform_on_a_leg)
    )
    assert_same_dynamics(robot, values, description, tmp_path)
    assert ["joint PID" in note for note in notes] == [True]
    assert (description.parameter_sets["guess"].joint_pid > 0).all()


def test_meshes_of_a_urdf_come_with_its_bodies(tmp_path):
    """The frames of the links that are written are those of the bodies."""
    robot = load_robot("rss6")
    urdf, closures = urdf_texts(robot, with_bodies(robot))
    visual = (
        '<visual><origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/><geometry>'
        '<mesh filename="package://arm/meshes/{}.stl" scale="0.001 0.001 0.001"/>'
        "</geometry></visual>"
    )
    for name in ("crank2", "link3"):
        urdf = urdf.replace(f'<link name="{name}">', f'<link name="{name}">{visual.format(name)}')
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "link3.stl").touch()
    found, _ = robot_of(tmp_path, urdf, closures)
    assert [mesh.body for mesh in found.geometry.meshes] == ["crank2", "link3"]
    assert [mesh.scale for mesh in found.geometry.meshes] == [0.001, 0.001]
    assert found.geometry.meshes[1].file == str(tmp_path / "meshes" / "link3.stl")
    turn = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_euler("XYZ")
    for mesh in found.geometry.meshes:
        np.testing.assert_allclose(mesh.pose, [0.01, 0.02, 0.03, *turn], atol=1e-9)


def test_loops_that_are_open_where_all_coordinates_are_zero_are_closed_first(tmp_path):
    """By cranks that stand up to 0.2 rad from home at zero: the home that is found is another, the
    robot is not.
    """
    robot, turned = load_robot("rrr3"), []
    for leg, angle in zip(robot.geometry.legs, (0.1, -0.15, 0.2), strict=True):
        zero = Rotation.from_rotvec([0, 0, angle]).apply(np.array(leg.crank_zero_direction))
        turned.append(leg.model_copy(update={"crank_zero_direction": zero}))
    geometry = replace(robot.geometry, legs=tuple(turned), travel_limit=0.5)
    robot = Robot(RobotDescription("turned", geometry, robot.parameter_sets))
    values = with_bodies(robot)
    description, _ = robot_of(tmp_path, *urdf_texts(robot, values))
    assert np.abs(np.subtract(description.geometry.chart.home, robot.home_pose)).max() > 1e-3
    assert_same_dynamics(robot, values, description, tmp_path)


def robot_of(folder, urdf, closures):
    (folder / "robot.urdf").write_text(urdf, encoding="utf-8")
    (folder / "robot.yaml").write_text(closures, encoding="utf-8")
    return robot_of_urdf(folder / "robot.urdf", folder / "robot.yaml")


def hand_written():
    """A planar robot as people write it: degrees, geoms that give the masses, frames that are
    welded to the world, loops between bodies, and a platform that hangs on the first leg and has
    its mass beside its origin."""
    turn = np.radians([125, 65])
    end = np.array([0.4, 0]) + sum(
        length * np.array([np.cos(angle), np.sin(angle)])
        for length, angle in zip((0.2, 0.25), (turn[0], turn.sum()), strict=True)
    )
    back = turn.sum()
    centre = (
        np.array([[np.cos(back), np.sin(back)], [-np.sin(back), np.cos(back)]]) @ -end
    ).tolist()
    disc = f'<geom type="cylinder" size="0.1 0.01" pos="{centre[0]!r} {centre[1]!r} 0"/>'
    platform = f'<body name="plate" pos="0.25 0 0"><joint name="tip" axis="0 0 1"/>{disc}</body>'
    legs = [
        f"""<body euler="0 0 {120 * k}"><body name="arm{k}" pos="0.4 0 0" euler="0 0 125">
          <joint name="motor{k}" axis="0 0 1" damping="0.2" range="-60 45"/><geom fromto="0 0 0 0.2
          0 0"/> <body name="rod{k}" pos="0.2 0 0" euler="0 0 65"><joint axis="0 0 -1"/><geom
          fromto="0 0 0 0.25 0 0"/> {platform if k == 0 else ""}</body></body></body>"""
        for k in range(3)
    ]
    loops = [f'<connect body1="rod{k}" body2="plate" anchor="0.25 0 0"/>' for k in (1, 2)]
    motors = [f'<motor joint="motor{k}"/>' for k in range(3)]
    return f"""<mujoco model="hand"><compiler autolimits="true"/>
      <default><geom type="capsule" size="0.01" density="2700" contype="0"/></default>
      <worldbody>{"".join(legs)}</worldbody>
      <equality>{"".join(loops)}</equality><actuator>{"".join(motors)}</actuator></mujoco>"""


def test_a_hand_written_model_accelerates_as_mujocos_bodies_in_closed_loops(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "hand.xml").write_text(hand_written(), encoding="utf-8")
    description, notes = robot_of_mjcf(tmp_path / "hand.xml")
    robot = Robot(description)
    assert robot.geometry.chart.name == "planar"
    assert [leg.type for leg in robot.geometry.legs] == ["rrr"] * 3
    assert robot.travel_limit == pytest.approx(np.pi / 4)
    np.testing.assert_allclose(robot.home_pose[:3], 0, atol=1e-12)
    torque = np.array([0.3, -0.5, 0.4])
    ours = robot.joint_jacobian(robot.home_pose) @ robot.forward_dynamics(
        robot.home_pose, np.zeros(6), torque
    )

    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hand.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass, loops = np.zeros((model.nv, model.nv)), np.zeros((6, model.nv))
    mujoco.mj_fullM(model, data, mass)
    for loop in range(2):
        for sign, body in ((1, model.eq_obj1id[loop]), (-1, model.eq_obj2id[loop])):
            part, at = np.zeros((3, model.nv)), data.body("rod1" if loop == 0 else "rod2")
            mujoco.mj_jac(
                model, data, part, None, at.xpos + at.xmat.reshape(3, 3) @ [0.25, 0, 0], body
            )
            loops[3 * loop : 3 * loop + 3] += sign * part
    driven = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    force = -data.qfrc_bias
    force[driven] += torque
    flat = loops[[0, 1, 3, 4]]
    system = np.block([[mass, -flat.T], [flat, np.zeros((4, 4))]])
    theirs = np.linalg.solve(system, np.concatenate([force, np.zeros(4)]))[driven]
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    assert any("joint PID" in note for note in notes)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            '<joint name="link3" type="ball" />',
            "",
            r"leg 3 \(crank3\+link3\): its joints, hinge\* ball, make no kind of leg",
        ),
        (
            '<motor name="motor3" joint="joint3" />',
            "",
            r"leg 3 \(crank3, link3\): it has 0 actuated joints",
        ),
        (
            '<connect site1="link_end3" site2="platform_joint3" name="loop3" />',
            "",
            r"leg 3 .* 0 paths from the base",
        ),
        (
            'name="link2" type="ball"',
            'name="link2" type="ball" damping="0.1"',
            r"leg 2 .* link2 has friction 0\.1",
        ),
        ('name="joint1" />', 'name="joint1" armature="0.01" />', r"joint1 has armature 0\.01"),
        (
            'site1="link_end2" site2="platform_joint2"',
            'site1="link_end2" site2="platform_joint3"',
            r"loop2 is open by",
        ),
        (
            '<connect site1="link_end3" site2="platform_joint3" name="loop3" />',
            '<weld body1="link3" body2="platform" relpose="0 0 9 1 0 0 0" name="loop3" />',
            r"loop3 is open by",
        ),
        (
            '<connect site1="link_end3" site2="platform_joint3" name="loop3" />',
            '<weld site1="link_end3" site2="platform_joint3" name="loop3" />',
            r"loop3 is turned by",
        ),
        (
            "<equality>",
            '<include file="a.xml"/><include file="a.xml"/><equality>',
            r"includes 'a\.xml'; it may only include .* at most 50, and each of them once",
        ),
        (
            "<equality>",
            '<equality><joint joint1="joint1" joint2="joint2"/>',
            r"equality 0 is of the kind joint",
        ),
        (
            'name="link4" type="ball"',
            'name="link4" type="hinge"',
            r"leg 4 .* the axis of its joint 2 is 48\.4 deg from",
        ),
        ("</mujoco>", "", r"cannot read .*robot\.xml"),
    ],
)
def test_a_model_of_no_known_kind_is_refused_in_one_line(robot, old, new, words, tmp_path):
    pytest.importorskip("mujoco")
    text = re.sub(
        "<keyframe>.*</keyframe>", "", mjcf_text(robot, with_bodies(robot)), flags=re.DOTALL
    )
    assert old in text
    (tmp_path / "robot.xml").write_text(text.replace(old, new, 1), encoding="utf-8")
    (tmp_path / "a.xml").write_text("<mujocoinclude/>", encoding="utf-8")
    assert re.search(words, refusal(RobotFileError, robot_of_mjcf, tmp_path / "robot.xml"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("which", "old", "new", "words"),
    [
        (
            "urdf",
            'joint name="link2" type="revolute"',
            'joint name="link2" type="planar"',
            "joint link2 is of type planar",
        ),
        (
            "urdf",
            '<parent link="crank2"/>',
            '<parent link="nowhere"/>',
            "no tree: .* unknown links nowhere",
        ),
        (
            "urdf",
            'mass value="1.32"',
            'mass value="heavy"',
            "mass value is 'heavy', must be a finite number",
        ),
        ("yaml", "'3d'", "'4d'", "type '4d' of closed_loop"),
        (
            "yaml",
            "'link2', ",
            "'link9', ",
            "leg 2 .* its joints, hinge\\* hinge ball, make no kind|leg 2",
        ),
        ("yaml", "name_mot: ['joint1', ", "name_mot: [", "leg 1 .* it has 0 actuated joints"),
        ("yaml", "'seat_link3'", "'nothing'", "must be two names of links or joints"),
        (
            "urdf",
            'name="joint1" type="revolute"><origin xyz="0.',
            'name="joint1" type="revolute"><origin xyz="9.',
            "the loops do not close: a gap of .* remains",
        ),
        ("yaml", "closed_loop", "loops", "needs closed_loop and name_mot"),
    ],
)
def test_a_urdf_of_no_known_kind_is_refused_in_one_line(robot, which, old, new, words, tmp_path):
    texts = dict(zip(("urdf", "yaml"), urdf_texts(robot, with_bodies(robot)), strict=True))
    assert old in texts[which]
    texts[which] = texts[which].replace(old, new, 1)
    assert re.search(
        words, refusal(RobotFileError, robot_of, tmp_path, texts["urdf"], texts["yaml"])
    )
