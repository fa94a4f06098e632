"""A robot in MuJoCo, put into any state of the closed chain and stepped. The only module that imports MuJoCo."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.checks import check_type, floats, real
from dynamics.engines.mjcf import body_frames, quaternion
from dynamics.errors import DynamicsError
from dynamics.legs.rss_geometry import LEGS
from dynamics.robot import Robot


class MujocoMissingError(DynamicsError):
    """MuJoCo is an optional extra, and it is not installed."""


class MujocoError(DynamicsError):
    """A model that MuJoCo refuses, or a state at which it gave up."""


def import_mujoco() -> Any:
    """The module mujoco. Raises MujocoMissingError with the way to install it, MujocoError where it does not load.

    MuJoCo sets up its renderer when imported; with MUJOCO_GL=egl that fails on the PyOpenGL that pyrender asks for.
    """
    try:
        import mujoco
    except ImportError as error:
        raise MujocoMissingError(f"MuJoCo is not installed ({error}): pip install '.[mujoco]' in a checkout") from None
    except AttributeError as error:
        raise MujocoError(f"MuJoCo does not load ({error}): unset MUJOCO_GL, no picture is needed here") from error
    return mujoco


class MujocoRobot:
    """A robot exported by `mjcf_text`, loaded. Poses, twists and crank angles are those of `Robot`."""

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
            joints = [self.model.joint(f"joint{leg}") for leg in range(1, LEGS + 1)]
            self._ends = [self.model.site(f"link_end{leg}").id for leg in range(1, LEGS + 1)]
            self._joints = [self.model.site(f"platform_joint{leg}").id for leg in range(1, LEGS + 1)]
        except KeyError as error:
            raise MujocoError(f"the model is no export of {robot.name}: {error.args[0]}") from None
        self._angle = np.array([joint.qposadr[0] for joint in joints])
        self._rate = np.array([joint.dofadr[0] for joint in joints])

    @property
    def timestep(self) -> float:
        """Step in s."""
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
    def crank_angle(self) -> np.ndarray:
        """Crank angles (6,), rad."""
        return self.data.qpos[self._angle]

    @property
    def crank_rate(self) -> np.ndarray:
        """Crank rates (6,), rad/s."""
        return self.data.qvel[self._rate]

    @property
    def closure_error(self) -> float:
        """Largest distance between a link's end and its platform joint, m."""
        self._mujoco.mj_kinematics(self.model, self.data)
        gaps = self.data.site_xpos[self._ends] - self.data.site_xpos[self._joints]
        return float(np.linalg.norm(gaps, axis=1).max())

    @property
    def link_spin(self) -> float:
        """Largest angular velocity of a link about its own axis, rad/s."""
        spins = []
        for leg in range(1, LEGS + 1):
            body = self.model.body(f"link{leg}").id
            turn = np.zeros(6)
            self._mujoco.mj_objectVelocity(self.model, self.data, self._mujoco.mjtObj.mjOBJ_XBODY, body, turn, 1)
            spins.append(abs(turn[2]))
        return max(spins)

    def put(self, pose: np.ndarray, twist: np.ndarray) -> None:
        """Put all bodies where the robot has them at a pose (6,) with a twist (6,), no link spinning (eq. 12)."""
        pose, twist = floats("pose", pose, (6,)), floats("twist", twist, (6,))
        frames = body_frames(self._robot, pose)
        rate = self._robot.joint_jacobian(pose) @ twist
        data, axis, link = self.data, self._robot.geometry.crank_axes, frames.joint - frames.tip
        tip_rate = rate[:, None] * np.cross(axis, self._robot.geometry.crank_length * frames.crank[:, :, 0])
        link_rate = twist[:3] + np.cross(twist[3:], frames.joint - pose[:3]) - tip_rate
        link_omega = np.cross(link, link_rate) / np.sum(link**2, axis=1, keepdims=True)
        self._mujoco.mj_resetData(self.model, data)
        data.qpos[:7] = [*pose[:3], *quaternion(frames.platform)]
        data.qvel[:6] = [*twist[:3], *(frames.platform.T @ twist[3:])]
        data.qpos[self._angle], data.qvel[self._rate] = frames.angle, rate
        for leg in range(LEGS):
            body, joint = self.model.body(f"link{leg + 1}"), self.model.joint(f"tip{leg + 1}")
            rest = Rotation.from_quat(body.quat, scalar_first=True).as_matrix()
            turned = rest.T @ frames.crank[leg].T @ frames.link[leg]
            data.qpos[joint.qposadr[0] : joint.qposadr[0] + 4] = quaternion(turned)
            relative = link_omega[leg] - rate[leg] * axis[leg]
            data.qvel[joint.dofadr[0] : joint.dofadr[0] + 3] = frames.link[leg].T @ relative
        self._mujoco.mj_forward(self.model, data)

    def twist_dot(self, torque: np.ndarray) -> np.ndarray:
        """Acceleration [h_ddot, omega_dot] (6,), base axes, under crank torques (6,) in the present state."""
        self.data.ctrl[:] = floats("torque", torque, (LEGS,))
        self._mujoco.mj_forward(self.model, self.data)
        platform = Rotation.from_quat(self.data.qpos[3:7], scalar_first=True).as_matrix()
        return np.concatenate([self.data.qacc[:3], platform @ self.data.qacc[3:6]])

    def feed_back(self, stiffness: float, damping: float) -> None:
        """Let every motor add -stiffness angle - damping rate to its control, evaluated inside MuJoCo's integrator."""
        self.model.actuator_biastype[:] = self._mujoco.mjtBias.mjBIAS_AFFINE
        stiffness = real("stiffness", stiffness, MujocoError, least=0)
        damping = real("damping", damping, MujocoError, least=0)
        self.model.actuator_biasprm[:, :3] = [0.0, -stiffness, -damping]

    def step(self, control: np.ndarray) -> None:
        """One step under a control (6,), N m."""
        self.data.ctrl[:] = floats("control", control, (LEGS,))
        self._mujoco.mj_step(self.model, self.data)
