"""Simulation of a robot in MuJoCo, from any state of its closed chain.

This is the only module that imports MuJoCo.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dynamics.bodies import parts_of
from dynamics.checks import check_type, floats, real
from dynamics.engines.mjcf import end_names, part_axis, quaternion
from dynamics.errors import DynamicsError
from dynamics.kinematics.platform import base_from_platform
from dynamics.robot import Robot

X = np.array([1.0, 0.0, 0.0])


class MujocoMissingError(DynamicsError):
    """MuJoCo, an optional dependency, is not installed."""


class MujocoError(DynamicsError):
    """MuJoCo does not load, or refuses a model or a value."""


def import_mujoco() -> Any:
    """Import MuJoCo and return the module.

    MuJoCo sets up its renderer at import, which can fail with MUJOCO_GL=egl: pyrender requires a
    version of PyOpenGL that does not support EGL.

    Raises MujocoMissingError, with the command that installs MuJoCo, or MujocoError if it does not
    load.
    """
    try:
        import mujoco
    except ImportError as error:
        raise MujocoMissingError(
            f"MuJoCo is not installed ({error}): pip install '.[mujoco]' in a checkout"
        ) from None
    except AttributeError as error:
        raise MujocoError(
            f"MuJoCo does not load ({error}): unset MUJOCO_GL, because nothing is rendered here"
        ) from error
    return mujoco


class MujocoRobot:
    """Robot in MuJoCo, loaded from the text of `mjcf_text`.

    Poses, twists and joint coordinates are those of `Robot`. Raises MujocoMissingError without
    MuJoCo, and MujocoError for a text that MuJoCo refuses or that is no export of the robot.
    """

    def __init__(self, robot: Robot, text: str) -> None:
        check_type("robot", robot, Robot, MujocoError)
        check_type("text", text, str, MujocoError)
        self._mujoco = import_mujoco()
        self._robot = robot
        try:
            self.model = self._mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            raise MujocoError(f"MuJoCo refuses the model of {robot.name}: {error}") from error
        self.data = self._mujoco.MjData(self.model)
        try:
            joints = [self.model.joint(name) for name in robot.joint_names]
            self._parts = parts_of(robot.geometry)
            ends = [end_names(part) for part in self._parts.all if part.last]
            self._ends = np.array(
                [[self.model.site(names[key]).id for names in ends] for key in ("site1", "site2")]
            )
            self._bodies = [self.model.body(part.name) for part in self._parts.all]
        except KeyError as error:
            raise MujocoError(f"the model is no export of {robot.name}: {error.args[0]}") from None
        # indices of the actuated joints in the coordinates and in the rates of MuJoCo
        self._coordinate_places = np.array([joint.qposadr[0] for joint in joints])
        self._rate_places = np.array([joint.dofadr[0] for joint in joints])

    @property
    def timestep(self) -> float:
        """Time step, s."""
        return float(self.model.opt.timestep)

    @property
    def version(self) -> str:
        """Version of MuJoCo."""
        return str(self._mujoco.__version__)

    @property
    def pose(self) -> np.ndarray:
        """Pose (6,) of the platform."""
        angles = Rotation.from_quat(self.data.qpos[3:7], scalar_first=True).as_euler("XYZ")
        return np.concatenate([self.data.qpos[:3], angles])

    @property
    def joints(self) -> np.ndarray:
        """Joint coordinates (n,), rad or m."""
        return self.data.qpos[self._coordinate_places]

    @property
    def joint_rates(self) -> np.ndarray:
        """Rates of the joint coordinates (n,), rad/s or m/s."""
        return self.data.qvel[self._rate_places]

    @property
    def closure_error(self) -> float:
        """Largest distance between the end of a leg and its joint on the platform, m."""
        self._mujoco.mj_kinematics(self.model, self.data)
        gaps = self.data.site_xpos[self._ends[0]] - self.data.site_xpos[self._ends[1]]
        return float(np.linalg.norm(gaps, axis=1).max())

    @property
    def link_spin(self) -> float:
        """Largest angular speed, about its own z axis, of a body on a ball joint, rad/s.

        It is zero if the robot has no such body.
        """
        spins = [0.0]
        for part, body in zip(self._parts.all, self._bodies, strict=True):
            if part.segment.joint == "ball":
                turn = np.zeros(6)
                kind = self._mujoco.mjtObj.mjOBJ_XBODY
                self._mujoco.mj_objectVelocity(self.model, self.data, kind, body.id, turn, 1)
                spins.append(abs(turn[2]))
        return max(spins)

    def put(self, pose: np.ndarray, twist: np.ndarray) -> None:
        """Set the state of all bodies from a pose (6,) and a twist (6,) of the platform.

        Links on ball joints do not spin about their own axes (eq. 12).
        """
        pose = floats("pose", pose, (6,))
        twist = floats("twist", twist, (6,))
        frames = self._parts.frames(self._robot, pose, twist)
        platform = base_from_platform(pose)
        data = self.data
        self._mujoco.mj_resetData(self.model, data)
        data.qpos[:7] = [*pose[:3], *quaternion(platform)]
        data.qvel[:6] = [*twist[:3], *(platform.T @ twist[3:])]
        data.qpos[self._coordinate_places] = self._robot.inverse_kinematics(pose)
        data.qvel[self._rate_places] = self._robot.joint_jacobian(pose) @ twist
        for number, (part, body) in enumerate(zip(self._parts.all, self._bodies, strict=True)):
            if part.segment.actuated:
                continue
            qpos_index = int(self.model.jnt_qposadr[int(body.jntadr[0])])
            qvel_index = int(body.dofadr[0])
            axes = frames.axes[number]
            before = frames.axes[part.before]
            parent_from_body = Rotation.from_quat(body.quat, scalar_first=True).as_matrix()
            turned = parent_from_body.T @ before.T @ axes
            spin = axes.T @ (frames.spin[number] - frames.spin[part.before])
            if part.segment.joint == "ball":
                data.qpos[qpos_index : qpos_index + 4] = quaternion(turned)
                data.qvel[qvel_index : qvel_index + 3] = spin
                continue
            axis = part_axis(part, frames, number)
            axis_at_rest = parent_from_body.T @ part.segment.axis
            if part.segment.joint == "hinge":
                data.qpos[qpos_index] = Rotation.from_matrix(turned).as_rotvec() @ axis_at_rest
                data.qvel[qvel_index] = spin @ axis
                continue
            # a universal joint turns about an axis of the part before it, then about its own x
            x_axis = turned[:, 0]
            angle = np.arctan2(np.cross(axis_at_rest, X) @ x_axis, x_axis[0])
            about_x = Rotation.from_rotvec(-angle * axis_at_rest).as_matrix() @ turned
            data.qpos[qpos_index : qpos_index + 2] = angle, np.arctan2(about_x[2, 1], about_x[1, 1])
            data.qvel[qvel_index : qvel_index + 2] = spin @ axis, spin[0]
        self._mujoco.mj_forward(self.model, data)

    def twist_dot(self, torque: np.ndarray) -> np.ndarray:
        """Acceleration [h_ddot, omega_dot] (6,) of the present state under torques or forces (n,).

        It is in the axes of the base, m/s^2 and rad/s^2.
        """
        self.data.ctrl[:] = floats("torque", torque, (self.model.nu,))
        self._mujoco.mj_forward(self.model, self.data)
        platform = Rotation.from_quat(self.data.qpos[3:7], scalar_first=True).as_matrix()
        return np.concatenate([self.data.qacc[:3], platform @ self.data.qacc[3:6]])

    def feed_back(self, stiffness: ArrayLike, damping: ArrayLike) -> None:
        """Add -stiffness * coordinate - damping * rate to every control, in MuJoCo's integrator.

        Stiffness and damping are one number, or one number (n,) per joint. They replace those of an
        earlier call.
        """
        self.model.actuator_biastype[:] = self._mujoco.mjtBias.mjBIAS_AFFINE
        self.model.actuator_biasprm[:, 0] = 0.0
        for column, (name, coefficients) in enumerate(
            (("stiffness", stiffness), ("damping", damping)), start=1
        ):
            values = floats(
                name, coefficients, (), (self.model.nu,), error=MujocoError, finite=False
            )
            for value in values.ravel().tolist():
                real(name, value, MujocoError, least=0)
            self.model.actuator_biasprm[:, column] = -values

    def step(self, control: np.ndarray) -> None:
        """Do one time step under a control (n,), N m or N."""
        self.data.ctrl[:] = floats("control", control, (self.model.nu,))
        self._mujoco.mj_step(self.model, self.data)
