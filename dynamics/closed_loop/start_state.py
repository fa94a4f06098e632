"""Start state of a closed-loop run, and the state of rest."""

from dataclasses import dataclass

import numpy as np

from dynamics.checks import Shape, check_type, floats, real
from dynamics.closed_loop.drives import ABOVE_ZERO, PID, READS, DriveName, Drives
from dynamics.closed_loop.joints import JointElasticity
from dynamics.closed_loop.loop_settings import ServoGains
from dynamics.errors import SimulationError
from dynamics.robot import Robot


@dataclass(frozen=True)
class StartState:
    """State of the loop at the first frame, before that frame is measured.

    The robot has n joints, m coordinates and p parameters. `ClosedLoopRun.start_sensitivity` has
    derivatives with respect to the first four parameters below, with coordinates in place of poses.

    Parameters
    ----------
    pose, pose_rate : array_like, shape (6,)
        Pose of the platform, m and rad, and its time derivative.
    joint_integral : array_like, shape (n,)
        Integral of the error of each drive, rad s or m s.
    servo_integral : array_like, shape (m,)
        Integral of the servo's error, m s and rad s.
    commands : array_like, shape (k, n)
        Commands issued before this frame, the oldest first. They are in rad or m, or in N m or N if
        the drives take torques. The oldest also stands for all earlier commands.
    last_measured : array_like, shape (6,)
        Pose measured one frame before, m and rad.
    joint_integral_sensitivity, command_sensitivity : array_like, shape (n, p), optional
        Derivatives of the joint integral and of every command with respect to the parameters, the
        same for all commands. The default is zero. The derivatives of the servo integral follow
        from those of the commands.
    motor_angle, motor_rate : array_like, shape (n,), optional
        Coordinate of the motors of elastic joints, rad or m, and its rate.
    filtered_rate : array_like, shape (n,), optional
        Filtered rate of the error of each drive, rad/s or m/s. The default is zero.
    latencies : array_like, shape (k,), optional
        Latencies of `commands`, s. The default is that of `FrameTiming`.

    Raises
    ------
    SimulationError
        If an array has another shape, or entries that are not finite. Whether n, m and p are those
        of the robot is checked when a run begins.

    Examples
    --------
    >>> rest = np.zeros(6)
    >>> home = robot.home_pose
    >>> start = closed_loop.StartState(home, rest, rest, rest, np.zeros((1, 6)), home)
    """

    pose: np.ndarray
    pose_rate: np.ndarray
    joint_integral: np.ndarray
    servo_integral: np.ndarray
    commands: np.ndarray
    last_measured: np.ndarray
    joint_integral_sensitivity: np.ndarray | None = None
    command_sensitivity: np.ndarray | None = None
    motor_angle: np.ndarray | None = None
    motor_rate: np.ndarray | None = None
    filtered_rate: np.ndarray | None = None
    latencies: np.ndarray | None = None

    def __post_init__(self) -> None:
        poses: dict[str, Shape] = dict.fromkeys(("pose", "pose_rate", "last_measured"), (6,))
        shapes = poses | dict.fromkeys(
            ("commands", "joint_integral_sensitivity", "command_sensitivity"), ("N", "N")
        )
        for name, field in self.__dataclass_fields__.items():
            if getattr(self, name) is None and field.default is None:
                continue
            array = floats(
                f"start {name}",
                getattr(self, name),
                shapes.get(name, ("N",)),
                error=SimulationError,
            )
            object.__setattr__(self, name, np.ascontiguousarray(array))
        if not len(self.commands):
            raise SimulationError("start commands must have at least 1 row, got 0")

    def check_sizes(self, robot: Robot) -> None:
        """Raise SimulationError, with the name of the array, if a shape does not fit the robot."""
        joints = robot.layout.joints
        parameters = len(robot.layout.names)
        wanted: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("joint_integral", "motor_angle", "motor_rate", "filtered_rate"), (joints,)
        )
        wanted |= {
            "servo_integral": (len(robot.coordinate_names),),
            "commands": (len(self.commands), joints),
        }
        wanted |= dict.fromkeys(
            ("joint_integral_sensitivity", "command_sensitivity"), (joints, parameters)
        )
        wanted |= {"latencies": (len(self.commands),)}
        for name, shape in wanted.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise SimulationError(
                    f"start {name} of {robot.name} must have shape {shape}, got {array.shape}"
                )


def checked_loop_parameters(
    robot: Robot, parameters: object, drive: DriveName = "pid"
) -> np.ndarray:
    """Dynamic parameters of a robot, then its gains, checked for the law of its drives.

    Raises ParameterError for an invalid dynamic parameter, and SimulationError for an invalid gain
    or a wrong shape. A gain that the law does not use can have any finite value.
    """
    layout = robot.layout
    values = floats(
        "loop parameters", parameters, (len(layout.names),), error=SimulationError, finite=False
    )
    layout.check(values[layout.dynamic])
    for name, value in zip(layout.joint_pid_names, values[layout.joint_pid], strict=True):
        gain = name.split(".")[1]
        least, above = (None, 0) if gain in ABOVE_ZERO[drive] else (0, None)
        if gain not in READS[drive]:
            least = None
        real(name, value, SimulationError, least=least, above=above)
    return values


def check_start_pose(robot: Robot, parameters: np.ndarray, pose: np.ndarray) -> None:
    """Raise UnreachablePoseError or SingularPoseError for a pose (6,) at which no run can start."""
    # both calls can raise an error, the second one for singular Euler angles
    robot.static_torque(pose, parameters[robot.layout.dynamic])
    robot.pose_rate(pose, np.zeros(6))


def equilibrium(
    robot: Robot,
    parameters: np.ndarray,
    pose: np.ndarray,
    servo: ServoGains,
    servo_robot: Robot | None = None,
    elasticity: JointElasticity | None = None,
    fed_forward: bool = False,
    drives: Drives = PID,
) -> StartState:
    """State of rest at a pose, without friction torques.

    The state includes its derivatives with respect to the parameters. The torque that holds the
    robot does not include an offset of friction, because friction at rest can be zero.

    Parameters
    ----------
    robot : Robot
        Robot at rest.
    parameters : ndarray, shape (p,)
        Dynamic parameters of the robot, then the gains of its drives.
    pose : array_like, shape (6,)
        Pose of the platform.
    servo : ServoGains
        Gains of the servo. Its integral gives the command at rest. If ki is 0, this integral is 0,
        and the first command of the servo moves the robot.
    servo_robot : Robot, optional
        Robot whose kinematics the servo uses. The default is `robot`.
    elasticity : JointElasticity, optional
        Springs of the joints.
    fed_forward : bool
        True if a feedforward gives the command at rest, so that the integral of the servo is 0.
    drives : Drives
        Law of the drives.

    Returns
    -------
    StartState
        State of rest.

    Raises
    ------
    ShapeError
        If `pose` is not six finite numbers.
    UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `simulate_servo`.

    Examples
    --------
    >>> parameters = robot.parameter_sets["truth"].vector
    >>> servo = closed_loop.ServoGains(kp=0.3, kd=0.001, ki=2.4)
    >>> start = closed_loop.equilibrium(robot, parameters, robot.home_pose, servo)
    >>> start.commands.shape
    (1, 6)
    """
    check_type("robot", robot, Robot, SimulationError)
    check_type("servo", servo, ServoGains, SimulationError)
    parameters = checked_loop_parameters(robot, parameters, drives.law)
    pose = floats("pose", pose, (6,))
    rest = np.zeros(6)
    chart = robot.geometry.chart
    law = drives.joint_law(robot.layout.split(parameters)[3])
    check_start_pose(robot, parameters, pose)
    angles = robot.inverse_kinematics(pose)
    regressor = robot.regressor(pose, rest, rest)
    torque_map = np.linalg.solve(
        (robot.joint_jacobian(pose) @ chart.basis).T, chart.projected(regressor)
    )
    torque = torque_map @ parameters[robot.layout.dynamic]
    motors = {}
    # the springs of elastic joints are deflected by the torque
    if elasticity is not None:
        angles = angles + torque / elasticity.stiffness
        motors = {"motor_angle": angles, "motor_rate": np.zeros(len(angles))}
    # Friction c + o in one direction and -(c - o) in the other has the same effect as c and -c, if
    # o is subtracted from the torque.
    net = torque - drives.offsets(len(angles))
    received, integral = law.held(net, angles)
    command = drives.sent(received)
    drives.check_limits(command)
    by_command, by_integral = law.held_by_parameters(
        net, angles, torque_map, robot.layout.own_gains
    )
    kinematics = servo_robot or robot
    servo_integral = np.zeros(len(chart.freedoms))
    # the command comes from the servo's integral, unless it comes from a feedforward
    if servo.ki and not fed_forward:
        servo_integral = np.linalg.solve(kinematics.coordinate_jacobian(pose), command) / servo.ki
    by_parameters = by_command / drives.command_scale if by_command.any() else None
    return StartState(
        pose,
        rest,
        integral,
        servo_integral,
        command[None],
        pose,
        by_integral,
        by_parameters,
        **motors,
    )
