"""The paper's model validation (section 4.1): this model against MuJoCo in the loop of its figure
7, and its figure 8.

The same joint PID (eq. 31) on both engines follows the joint coordinates of the same exciting
trajectory (eq. 37); torques come from each engine's own motion. This model goes through the closed
loop of the experiments, driven by commands; MuJoCo through `mj_step` on the exported MJCF.

MuJoCo runs with RK4 and with the PID's stiffness and damping inside its integrator, so that its
discretisation stays far below what is to be seen; only the integral part is held over a step of
0.25 ms, at its value in mid-step.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dynamics import Robot, closed_loop
from dynamics.engines.mjcf import MjcfSolver, mjcf_text
from dynamics.engines.mujoco_engine import MujocoRobot, import_mujoco
from dynamics.inertia import grouped, physical_inertias
from identify.arrays import Array
from identify.excitation.design import admissible_trajectories
from identify.progress import Progress, SilentProgress
from identify.reporting.figures import COMPONENTS
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory

PARAMETER_SET = "initial"
DURATION_S = 10.0
STEADY_FROM_S = 2.0
COMMAND_RATE_HZ = 200.0
STEPS_PER_COMMAND = 4
SOLVER = MjcfSolver(timestep_s=2.5e-4, integrator="RK4")

# The paper's excitation (section 4.2) in the box of the reference experiment.
EXCITATION = Excitation(
    fundamental_hz=0.1,
    harmonics=5,
    position_amplitude_m=0.010,
    orientation_amplitude_rad=0.040,
)

GOAL_UM = 10.0
GOAL_URAD = 20.0
PAPER = {
    "position_max_um": 1250.0,
    "angle_max_urad": 3250.0,
    "position_steady_um": 100.0,
    "angle_steady_urad": 250.0,
}


@dataclass(frozen=True)
class EngineRuns:
    """Both engines over time (N,) [s]: poses (N, 6) [m, rad] of this model, of MuJoCo and of the
    reference; actuator torques or forces (N, n) [N m, N] of this model and of MuJoCo; MuJoCo's
    closure error (N,) [m] and link spin (N,) [rad/s]."""

    time: Array
    reference: Array
    model_pose: Array
    mujoco_pose: Array
    model_torque: Array
    mujoco_torque: Array
    closure: Array
    spin: Array
    mujoco_version: str

    @property
    def difference(self) -> Array:
        """MuJoCo's pose less this model's, (N, 6) [m, rad]."""
        return self.mujoco_pose - self.model_pose


def verify(robot: Robot, progress: Progress | None = None) -> EngineRuns:
    """Run both engines with the set `initial` less its friction (the paper's Table 1 has none).

    Raises DynamicsError, TrajectoryError: see `compare_engines`.
    """
    values = robot.parameter_sets[PARAMETER_SET].vector.copy()
    values[robot.layout.coulomb] = 0.0
    values[robot.layout.viscous] = 0.0
    return compare_engines(robot, values, values, DURATION_S, progress)


def compare_engines(
    robot: Robot,
    model_parameters: Array,
    mujoco_parameters: Array,
    duration_s: float,
    progress: Progress | None = None,
) -> EngineRuns:
    """Both engines on the exciting trajectory, each with its own parameters: the dynamic ones (p,),
    lp, li, ld.

    Raises DynamicsError: MuJoCo is missing or refuses the model, or the loop is unstable. Raises
    TrajectoryError: no exciting trajectory of this amplitude stays inside the robot's travel.
    """
    import_mujoco()
    progress = progress or SilentProgress()
    time = np.arange(round(duration_s * COMMAND_RATE_HZ) + 1) / COMMAND_RATE_HZ
    with progress.stage("this model", 2) as advance:
        closed_loop.prepare(robot)
        advance()
        trajectory = exciting_trajectory(robot)
        reference = closed_loop.Reference(trajectory.pose(time), trajectory.pose_rate(time))
        commands = robot.inverse_kinematics(reference.poses)
        settings = closed_loop.LoopSettings(  # driven by commands that ramp from one to the next
            closed_loop.ServoGains(0.0, 0.0, 0.0),
            closed_loop.FrameTiming(COMMAND_RATE_HZ, hold="linear"),
            steps_per_frame=STEPS_PER_COMMAND,
        )
        model = closed_loop.simulate_commands(
            robot, model_parameters, reference, settings, commands
        )
        advance()
    # Table 1's inertias break the triangle inequality in ways that the motion does not feel
    chosen = mujoco_parameters[robot.layout.dynamic]
    joints = robot.layout.joints
    mjcf = mjcf_text(robot, chosen, allow_unphysical_inertia=True, solver=SOLVER)
    engine = MujocoRobot(robot, mjcf)
    rows = np.empty((len(time), 8 + joints))
    with progress.stage("MuJoCo", len(time)) as advance:
        for frame, row in enumerate(
            _mujoco_rows(robot, engine, mujoco_parameters, reference, commands)
        ):
            rows[frame] = row
            advance()
    pose = rows[:, :6]
    torque = rows[:, 6:-2]
    closure = rows[:, -2]
    spin = rows[:, -1]
    return EngineRuns(
        time,
        reference.poses,
        model.pose,
        pose,
        model.torque,
        torque,
        closure,
        spin,
        mujoco_version=engine.version,
    )


def exciting_trajectory(robot: Robot) -> FourierTrajectory:
    """The first random trajectory of eq. 37 that stays inside the travel; always the same for a
    robot.
    """
    period_s = 1 / EXCITATION.fundamental_hz
    return admissible_trajectories(robot, EXCITATION, period_s, 1, np.random.SeedSequence(0))[0]


def _mujoco_rows(
    robot: Robot,
    engine: MujocoRobot,
    parameters: Array,
    reference: closed_loop.Reference,
    commands: Array,
) -> Iterator[Array]:
    """Pose (6,), torques (n,), closure error and link spin at every command, in a row; the command
    ramps from the one before to the present one, as in the closed loop with linear hold."""
    lp, li, ld = parameters[robot.layout.joint_pid]
    steps = round(1 / (COMMAND_RATE_HZ * engine.timestep))
    dt = 1 / (COMMAND_RATE_HZ * steps)
    integral = robot.static_torque(reference.poses[0], parameters[robot.layout.dynamic]) / li
    engine.put(reference.poses[0], np.zeros(6))
    engine.feed_back(lp, ld)
    before = commands[0]
    for command in commands:
        rate = (command - before) * COMMAND_RATE_HZ
        torque = lp * (before - engine.joints) + ld * (rate - engine.joint_rates) + li * integral
        yield np.concatenate([engine.pose, torque, [engine.closure_error, engine.link_spin]])
        for step in range(steps):
            wanted = before + rate * (step + 0.5) * dt
            start = engine.joints
            engine.step(lp * wanted + ld * rate + li * (integral + dt / 2 * (wanted - start)))
            integral = integral + dt * (wanted - (start + engine.joints) / 2)
        before = command


@dataclass(frozen=True)
class Verdict:
    """Largest differences between the engines, of the whole run and from STEADY_FROM_S on:
    distances of the platform [um], lengths of the vector of Euler angle differences [urad],
    actuator torque or force [N m, N]; MuJoCo's loop closure error [um] and link spin [rad/s]; how
    far this model is from its reference [um, urad], which is what the PID leaves to see."""

    position_max_um: float
    position_steady_um: float
    angle_max_urad: float
    angle_steady_urad: float
    torque_max: float
    closure_max_um: float
    spin_max_rad_s: float
    tracking_max_um: float
    tracking_max_urad: float

    @property
    def met(self) -> bool:
        """Whether the steady differences are within the goals."""
        return self.position_steady_um <= GOAL_UM and self.angle_steady_urad <= GOAL_URAD


def judge(runs: EngineRuns) -> Verdict:
    """Figures of a comparison."""
    position, angle = _lengths(runs.difference)
    tracking = _lengths(runs.model_pose - runs.reference)
    steady = runs.time >= STEADY_FROM_S
    return Verdict(
        position_max_um=1e6 * position.max(),
        position_steady_um=1e6 * position[steady].max(),
        angle_max_urad=1e6 * angle.max(),
        angle_steady_urad=1e6 * angle[steady].max(),
        torque_max=float(np.abs(runs.mujoco_torque - runs.model_torque).max()),
        closure_max_um=1e6 * runs.closure.max(),
        spin_max_rad_s=float(runs.spin.max()),
        tracking_max_um=1e6 * tracking[0].max(),
        tracking_max_urad=1e6 * tracking[1].max(),
    )


def _lengths(difference: Array) -> tuple[Array, Array]:
    """Lengths (N,) of the position part and of the angle part of pose differences (N, 6)."""
    return np.linalg.norm(difference[:, :3], axis=1), np.linalg.norm(difference[:, 3:], axis=1)


def verification_entry(robot: Robot, runs: EngineRuns) -> dict[str, Any]:
    """What `verification.json` holds."""
    verdict = judge(runs)
    chosen = robot.parameter_sets[PARAMETER_SET]
    return {
        "robot": robot.name,
        "parameters": f"{PARAMETER_SET}, friction zero",
        "joint_pid": dict(zip(("lp", "li", "ld"), chosen.joint_pid.tolist(), strict=True)),
        "duration_s": float(runs.time[-1]),
        "steady_from_s": STEADY_FROM_S,
        "mujoco": {
            "version": runs.mujoco_version,
            **asdict(SOLVER),
            "inertias_changed": grouped(
                physical_inertias(robot.layout, chosen.dynamic, allow_changes=True).changes
            ),
        },
        "difference": asdict(verdict),
        "torque_unit": robot.layout.unit("joint1.coulomb"),
        "goal": {"position_steady_um": GOAL_UM, "angle_steady_urad": GOAL_URAD},
        "met": verdict.met,
        "paper": PAPER,
    }


def figure_8(runs: EngineRuns) -> Figure:
    """Differences of MuJoCo and this model, and how far MuJoCo's loops are open, over time."""
    figure = Figure(figsize=(9, 9), layout="constrained")
    position, angle, closure = figure.subplots(3, 1, sharex=True)
    verdict = judge(runs)
    difference = 1e6 * runs.difference
    for i in range(3):
        position.plot(runs.time, difference[:, i], linewidth=1, label=COMPONENTS[i])
        angle.plot(runs.time, difference[:, 3 + i], linewidth=1, label=COMPONENTS[3 + i])
    closure.plot(runs.time, 1e6 * runs.closure, linewidth=1, color="black")
    position.set_title(
        f"(a) position: largest {verdict.position_max_um:.2g} um, steady "
        f"{verdict.position_steady_um:.2g} um "
        f"(goal {GOAL_UM:g} um; paper 1250 and 100 um)"
    )
    angle.set_title(
        f"(b) angle: largest {verdict.angle_max_urad:.2g} urad, steady "
        f"{verdict.angle_steady_urad:.2g} urad "
        f"(goal {GOAL_URAD:g} urad; paper 3250 and 250 urad)"
    )
    closure.set_title(f"(c) MuJoCo's loop closure error: largest {verdict.closure_max_um:.2g} um")
    for axes, label in (
        (position, "position error [um]"),
        (angle, "angle error [urad]"),
        (closure, "gap [um]"),
    ):
        axes.set_ylabel(label)
        axes.axvline(STEADY_FROM_S, color="grey", linewidth=1, linestyle="--")
        axes.grid(alpha=0.3)
    for axes in (position, angle):
        axes.legend(loc="upper right", fontsize="small")
    closure.set_xlabel("time [s] (dashes: steady from here)")
    figure.suptitle(f"MuJoCo {runs.mujoco_version} − this model, same PID and exciting trajectory")
    return figure
