"""What goes into a closed-loop run: settings, reference, parameters, and the state it starts from, by default rest."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from dynamics.checks import Shape, check_choice, check_type, floats, real, whole
from dynamics.closed_loop.drives import ABOVE_ZERO, PID, READS, DriveName, Drives
from dynamics.closed_loop.joints import FrictionLaw, JointElasticity
from dynamics.errors import SimulationError
from dynamics.legs.numbers import MOST_NUMBERS
from dynamics.parameters import RigidGroups
from dynamics.robot import Robot

MAX_DELAY_FRAMES = 60
MAX_STEPS_PER_FRAME = 10_000

Hold = Literal["zero", "linear"]

# (frame index, time s, true pose (6,)) -> measured pose (6,), or None when the measurement is lost.
PoseSensor = Callable[[int, float, np.ndarray], np.ndarray | None]

# (frame index, time s, measured pose (6,), desired pose (6,), desired pose rate (6,)) -> joint command (n,), rad or m.
Controller = Callable[[int, float, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RateSensor:
    """A pose sensor that depends on the motion too: measure(frame, time s, true pose (6,), true pose rate (6,))."""

    measure: Callable[[int, float, np.ndarray, np.ndarray], np.ndarray | None]


@dataclass(frozen=True)
class EveryFrame:
    """A controller that is asked where the measurement is lost, too: command(frame, time s, measured pose (6,) or None)
    -> joint command (n,)."""

    command: Callable[[int, float, np.ndarray | None], np.ndarray]


@dataclass(frozen=True)
class ServoGains:
    """Visual servo gains of eq. 30: kp (1), kd (s), ki (1/s)."""

    kp: float
    kd: float
    ki: float

    def __post_init__(self) -> None:
        for name in ("kp", "kd", "ki"):
            real(f"servo gain {name}", getattr(self, name), SimulationError, least=0)


@dataclass(frozen=True)
class FrameTiming:
    """Frame rate (Hz), latency from exposure to command (s), and the hold of the joint command after its arrival.

    hold "zero": the command jumps to its new value; "linear": it ramps there over one frame. In both the joint PID
    takes the difference of the last two commands over the frame period for U_dot.
    """

    frame_rate_hz: float
    latency_s: float = 0.0
    hold: Hold = "zero"

    def __post_init__(self) -> None:
        real("frame rate", self.frame_rate_hz, SimulationError, above=0, unit=" Hz")
        real("latency", self.latency_s, SimulationError, unit=" s")
        self.check_latency("latency", self.latency_s)
        check_choice("hold", self.hold, get_args(Hold), SimulationError)

    def check_latency(self, name: str, latency_s: float) -> None:
        """Raise SimulationError for a latency that is negative or too many frames."""
        if not 0 <= latency_s * self.frame_rate_hz <= MAX_DELAY_FRAMES:
            limit = f"{MAX_DELAY_FRAMES} frames ({MAX_DELAY_FRAMES / self.frame_rate_hz:.3g} s)"
            raise SimulationError(f"{name} is {latency_s} s, must be >= 0 and at most {limit}")


@dataclass(frozen=True)
class LoopSettings:
    """What the loop is made of besides the robot: servo, timing, friction law, Runge-Kutta steps per frame, the
    elasticity of the joints (None: rigid), and the drives."""

    servo: ServoGains
    timing: FrameTiming
    friction: FrictionLaw = field(default_factory=FrictionLaw)
    steps_per_frame: int = 4
    elasticity: JointElasticity | None = None
    drives: Drives = PID

    def __post_init__(self) -> None:
        kinds = {"servo": ServoGains, "timing": FrameTiming, "friction": FrictionLaw, "drives": Drives}
        for name, kind in kinds.items():
            check_type(name, getattr(self, name), kind, SimulationError)
        if self.elasticity is not None:
            check_type("elasticity", self.elasticity, JointElasticity, SimulationError)
        steps = whole("steps_per_frame", self.steps_per_frame, SimulationError, least=1, most=MAX_STEPS_PER_FRAME)
        object.__setattr__(self, "steps_per_frame", steps)


@dataclass(frozen=True, eq=False)
class Reference:
    """Desired motion at the frame times: poses (frames, 6) and pose rates (frames, 6), copied and frozen."""

    poses: np.ndarray
    rates: np.ndarray

    def __post_init__(self) -> None:
        for name in ("poses", "rates"):
            array = floats(f"reference {name}", getattr(self, name), ("N", 6), error=SimulationError)
            if len(array) < 2:
                raise SimulationError(f"reference {name} must have at least 2 frames, got {len(array)}")
            frozen = np.array(array, order="C")
            frozen.setflags(write=False)
            object.__setattr__(self, name, frozen)
        if self.poses.shape != self.rates.shape:
            raise SimulationError(f"reference poses {self.poses.shape} and rates {self.rates.shape} differ in shape")

    def __repr__(self) -> str:
        return f"Reference({len(self.poses)} frames)"


OPTIONAL = (
    *("joint_integral_sensitivity", "command_sensitivity", "motor_angle", "motor_rate", "filtered_rate"),
    "latencies",
)


@dataclass(frozen=True)
class StartState:
    """State of the loop at the first frame, before that frame is measured; of n joints, m coordinates, p parameters.

    pose (6,) and pose rate (6,); joint PID integral (n,), rad s or m s; servo integral (m,), m s and rad s. These,
    poses by their coordinates, in this order, are what start_sensitivity differentiates by (24 in all for rss6).
    commands (k, n): the commands issued before, rad or m, oldest first (the first one also acted before), and
    last_measured (6,): the pose measured one frame before; both are records.
    joint_integral_sensitivity, command_sensitivity (n, p): how the joint PID integral and the commands before, with the
    servo integral that makes them, follow the parameters; None where they are just given.
    motor_angle (n,) and motor_rate (n,): of elastic joints only. filtered_rate (n,): of the errors, in drives that
    filter it; None: none. latencies (k,): after which the commands before act, s; None: that of the timing.
    Raises SimulationError for a wrong shape or a number that is not finite; the sizes of a robot are asked for when a
    run begins.
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
        shapes = poses | dict.fromkeys(("commands", "joint_integral_sensitivity", "command_sensitivity"), ("N", "N"))
        for name in self.__dataclass_fields__:
            if getattr(self, name) is None and name in OPTIONAL:
                continue
            array = floats(f"start {name}", getattr(self, name), shapes.get(name, ("N",)), error=SimulationError)
            object.__setattr__(self, name, np.ascontiguousarray(array))
        if not len(self.commands):
            raise SimulationError("start commands must have at least 1 row, got 0")

    def check_sizes(self, robot: Robot) -> None:
        """Raise SimulationError, naming the part, where this is no state of a robot."""
        joints, parameters = robot.layout.joints, len(robot.layout.names)
        wanted: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("joint_integral", "motor_angle", "motor_rate", "filtered_rate"), (joints,)
        )
        wanted |= {"servo_integral": (len(robot.coordinate_names),), "commands": (len(self.commands), joints)}
        wanted |= dict.fromkeys(("joint_integral_sensitivity", "command_sensitivity"), (joints, parameters))
        wanted |= {"latencies": (len(self.commands),)}
        for name, shape in wanted.items():
            found = getattr(self, name)
            if found is not None and found.shape != shape:
                raise SimulationError(f"start {name} of {robot.name} must have shape {shape}, got {found.shape}")


@dataclass(frozen=True)
class Sizes:
    """Numbers of joints, of coordinates of the platform, of parameters of the rigid bodies, and room for so many
    geometric numbers, the last arguments of functions (see `Robot.moved`): the same for most robots, as kernels are
    compiled for sizes; filters: joints whose drives filter a rate."""

    joints: int
    coordinates: int
    rigid: int
    geometry: int = 0
    filters: int = 0

    @property
    def parameters(self) -> int:
        """Rigid bodies, Coulomb and viscous friction of every joint, and the joint PID."""
        return self.rigid + 2 * self.joints + 3

    @property
    def start(self) -> int:
        """Entries of the start state: pose, pose rate, joint PID integral, servo integral."""
        return 3 * self.coordinates + self.joints


@dataclass(frozen=True)
class LoopProblem:
    """One run to be done, checked: what `closed_loop.simulate` was given, and the state it starts from."""

    robot: Robot
    parameters: np.ndarray
    reference: Reference
    settings: LoopSettings
    start: StartState
    sensor: PoseSensor | RateSensor | None
    sensitivities: bool
    start_sensitivities: bool
    commands: np.ndarray | None
    lost: np.ndarray | None
    noise: np.ndarray | None
    latencies: np.ndarray | None
    servo_robot: Robot
    controller: Controller | EveryFrame | None = None
    feedforward: np.ndarray | None = None
    groups: RigidGroups | None = None

    @property
    def columns(self) -> np.ndarray:
        """The parameters (k,) whose derivatives stand for those of all."""
        rigid = np.arange(self.sizes.rigid) if self.groups is None else self.groups.pivots
        return np.concatenate([rigid, np.arange(self.sizes.rigid, self.sizes.parameters)])

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.reference.poses)

    @property
    def period(self) -> float:
        """Time between two frames, s."""
        return 1.0 / self.settings.timing.frame_rate_hz

    @property
    def asked(self) -> bool:
        """Whether a user's own sensor or controller is asked at every frame."""
        return self.sensor is not None or self.controller is not None

    @cached_property
    def sizes(self) -> Sizes:
        """Those of the robot's equation of motion."""
        motion, known = (robot.functions["equation_of_motion"] for robot in (self.robot, self.servo_robot))
        return Sizes(
            joints=motion.outputs[2][0],
            coordinates=motion.inputs[0],
            rigid=motion.inputs[2],
            filters=motion.outputs[2][0] if self.settings.drives.filter_time else 0,
            geometry=max(MOST_NUMBERS * motion.outputs[2][0], len(motion.constants), len(known.constants)),
        )


def checked_loop_parameters(robot: Robot, parameters: object, drive: DriveName = "pid") -> np.ndarray:
    """The dynamic parameters of a robot and lp, li, ld, as the law of its drives needs them. Raises SimulationError, or
    ParameterError for a dynamic one."""
    layout = robot.layout
    values = floats("loop parameters", parameters, (len(layout.names),), error=SimulationError, finite=False)
    layout.check(values[layout.dynamic])
    for name, value in zip(layout.joint_pid_names, values[layout.joint_pid], strict=True):
        gain = name.split(".")[1]
        least, above = (None, 0) if gain in ABOVE_ZERO[drive] else (0, None)
        if gain not in READS[drive]:
            least = None
        real(name, value, SimulationError, least=least, above=above)
    return values


def check_start_pose(robot: Robot, parameters: np.ndarray, pose: np.ndarray) -> None:
    """Raise UnreachablePoseError or SingularPoseError for a pose (6,) from which no run can start."""
    # Refuses a pose out of reach or singular, with the evidence.
    robot.static_torque(pose, parameters[robot.layout.dynamic])
    robot.pose_rate(pose, np.zeros(6))  # refuses Euler angles at their singularity


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
    """State of rest at a pose (6,), friction unloaded, for all parameters; servo_robot as in `closed_loop.simulate`.
    fed_forward: whether a feedforward commands the joints where they are, so that the servo's part is none.

    The holding torque is linear in the dynamic parameters. Raises what that raises before a run.
    """
    check_type("robot", robot, Robot, SimulationError)
    check_type("servo", servo, ServoGains, SimulationError)
    parameters, pose = checked_loop_parameters(robot, parameters, drives.law), floats("pose", pose, (6,))
    rest, chart, law = np.zeros(6), robot.geometry.chart, drives.joint_law(parameters[robot.layout.joint_pid])
    check_start_pose(robot, parameters, pose)
    angles, regressor = robot.inverse_kinematics(pose), robot.regressor(pose, rest, rest)
    torque_map = np.linalg.solve((robot.joint_jacobian(pose) @ chart.basis).T, chart.projected(regressor))
    torque, motors = torque_map @ parameters[robot.layout.dynamic], {}
    if elasticity is not None:
        angles = angles + torque / elasticity.stiffness
        motors = {"motor_angle": angles, "motor_rate": np.zeros(len(angles))}
    command, integral = law.held(torque, angles)
    by_command, by_integral = law.held_by_parameters(torque, angles, torque_map)
    known = servo_robot or robot
    servo_integral = np.zeros(len(chart.freedoms))
    if servo.ki and not fed_forward:
        servo_integral = np.linalg.solve(known.coordinate_jacobian(pose), command) / servo.ki
    moving = by_command if by_command.any() else None
    return StartState(pose, rest, integral, servo_integral, command[None], pose, by_integral, moving, **motors)
