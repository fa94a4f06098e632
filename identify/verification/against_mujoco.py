"""Comparison of this model with MuJoCo, as in the paper's model validation (section 4.1).

The control loop is the loop of the paper's figure 7, and the result is drawn like its figure 8. In
both engines, the same joint PID (eq. 31) follows the joint coordinates of the same exciting
trajectory (eq. 37). In each engine the torques follow from its own motion. This model runs in the
closed loop of the experiments, driven by commands. MuJoCo runs `mj_step` on the exported MJCF.

MuJoCo integrates by RK4, with the stiffness and damping of the PID inside its integrator, so that
its discretisation error is far below the differences of interest. Only the integral part is
constant over a step of 0.25 ms, with its value in the middle of the step.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dynamics import Robot, closed_loop
from dynamics.engines.mjcf import MjcfSolver, mjcf_text
from dynamics.engines.mujoco_engine import MujocoRobot, import_mujoco
from dynamics.inertia import acceleration_changes, grouped, physical_inertias
from dynamics.parameters import JOINT_PID
from identify.arrays import Array
from identify.excitation.design import admissible_trajectories
from identify.progress import Progress, SilentProgress
from identify.reporting.figures import COMPONENTS
from identify.reporting.goal_causes import Advice
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory
from identify.verification.robot_check import NEGLIGIBLE_CHANGE

PARAMETER_SET = "guess"
DURATION_S = 10.0  # duration of the run
# Time after which transients from the start of the run have decayed.
STEADY_FROM_S = 2.0
COMMAND_RATE_HZ = 200.0
STEPS_PER_COMMAND = 4
SOLVER = MjcfSolver(timestep_s=2.5e-4, integrator="RK4")

# The paper's excitation (section 4.2) in the box of the reference experiment.
EXCITATION = Excitation(
    fundamental_hz=0.1, harmonics=5, position_amplitude_m=0.010, orientation_amplitude_rad=0.040
)

GOAL_UM = 10.0  # largest allowed difference of positions after STEADY_FROM_S
GOAL_URAD = 20.0  # largest allowed difference of angles after STEADY_FROM_S

# Differences in the paper's figure 8.
PAPER = {
    "position_max_um": 1250.0,
    "angle_max_urad": 3250.0,
    "position_steady_um": 100.0,
    "angle_steady_urad": 250.0,
}


@dataclass(frozen=True)
class EngineRuns:
    """Motion of both engines over time (N,) [s].

    Poses (N, 6) [m, rad] are given for this model, MuJoCo and the reference. Actuator torques or
    forces (N, n) [N m, N] are given for this model and MuJoCo. ``closure`` (N,) [m] is the closure
    error of MuJoCo's loops, and ``spin`` (N,) [rad/s] the spin of its links.
    """

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
        """MuJoCo's pose minus this model's, (N, 6) [m, rad]."""
        return self.mujoco_pose - self.model_pose


def verify(robot: Robot, progress: Progress | None = None) -> EngineRuns:
    """Run both engines with the parameter set `guess`, without its friction.

    The paper's table 1 has no friction either. Raises the errors of `compare_engines`.
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
    """Run both engines on the exciting trajectory, each with its own parameters.

    The parameters are the dynamic parameters and the gains.

    Raises DynamicsError if MuJoCo is missing or refuses the model, or the loop is unstable. Raises
    TrajectoryError if no exciting trajectory of this amplitude stays inside the robot's travel.
    """
    # MuJoCo is optional. If it is missing, this raises an error before anything runs.
    import_mujoco()
    progress = progress or SilentProgress()
    time = np.arange(round(duration_s * COMMAND_RATE_HZ) + 1) / COMMAND_RATE_HZ
    with progress.stage("this model", 2) as advance:
        closed_loop.prepare(robot)
        advance()
        trajectory = exciting_trajectory(robot)
        reference = closed_loop.Reference(trajectory.pose(time), trajectory.pose_rate(time))
        commands = robot.inverse_kinematics(reference.poses)
        # With zero gains of the servo, only the commands drive the joints.
        settings = closed_loop.LoopSettings(
            closed_loop.ServoGains(0.0, 0.0, 0.0),
            closed_loop.FrameTiming(COMMAND_RATE_HZ, hold="linear"),
            steps_per_frame=STEPS_PER_COMMAND,
        )
        model = closed_loop.simulate_commands(
            robot, model_parameters, reference, settings, commands
        )
        advance()
    # Inertias of table 1 violate the triangle inequality, without an effect on the motion.
    chosen = mujoco_parameters[robot.layout.dynamic]
    joints = robot.layout.joints
    mjcf = mjcf_text(robot, chosen, allow_unphysical_inertia=True, solver=SOLVER)
    engine = MujocoRobot(robot, mjcf)
    rows = np.empty((len(time), 8 + joints))
    with progress.stage("MuJoCo", len(time)) as advance:
        steps = _mujoco_rows(robot, engine, mujoco_parameters, reference, commands)
        for frame, row in enumerate(steps):
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
    """Return the first random trajectory of eq. 37 inside the travel, by a fixed seed."""
    period_s = 1 / EXCITATION.fundamental_hz
    return admissible_trajectories(robot, EXCITATION, period_s, 1, np.random.SeedSequence(0))[0]


def _mujoco_rows(
    robot: Robot,
    engine: MujocoRobot,
    parameters: Array,
    reference: closed_loop.Reference,
    commands: Array,
) -> Iterator[Array]:
    """Yield a row with pose (6,), torques (n,), closure error and link spin at every command.

    Between two commands the command is interpolated linearly, as in the closed loop with linear
    hold.
    """
    lp, li, ld = robot.layout.split(parameters)[3].T
    # The number of steps per command is an integer.
    steps = round(1 / (COMMAND_RATE_HZ * engine.timestep))
    dt = 1 / (COMMAND_RATE_HZ * steps)
    # The run starts at rest, where the integral part holds the weight.
    integral = robot.static_torque(reference.poses[0], parameters[robot.layout.dynamic]) / li
    engine.put(reference.poses[0], np.zeros(6))
    engine.feed_back(lp, ld)
    before = commands[0]
    for command in commands:
        rate = (command - before) * COMMAND_RATE_HZ
        torque = lp * (before - engine.joints) + ld * (rate - engine.joint_rates) + li * integral
        yield np.concatenate([engine.pose, torque, [engine.closure_error, engine.link_spin]])
        for step in range(steps):
            # MuJoCo subtracts lp * joints and ld * rates itself, so only the rest is applied.
            wanted = before + rate * (step + 0.5) * dt
            start = engine.joints
            engine.step(lp * wanted + ld * rate + li * (integral + dt / 2 * (wanted - start)))
            integral = integral + dt * (wanted - (start + engine.joints) / 2)
        before = command


@dataclass(frozen=True)
class Verdict:
    """Largest differences between the engines.

    Entries with "steady" are for the time from STEADY_FROM_S on, and all others for the whole run.
    They are distances of the platform [µm], norms of the vector of Euler angle differences [µrad]
    and differences of actuator torque or force [N m, N]. Closure error [µm] and link spin [rad/s]
    are those of MuJoCo. The tracking errors [µm, µrad] are the differences of this model from its
    reference.
    """

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
        """True if the steady differences are within the goals."""
        return self.position_steady_um <= GOAL_UM and self.angle_steady_urad <= GOAL_URAD


def judge(runs: EngineRuns) -> Verdict:
    """Return the largest differences in a comparison."""
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
    """Return the lengths (N,) of the position and angle parts of pose differences (N, 6)."""
    return np.linalg.norm(difference[:, :3], axis=1), np.linalg.norm(difference[:, 3:], axis=1)


def verification_entry(robot: Robot, typed: str, runs: EngineRuns) -> dict[str, Any]:
    """Return the content of `verification.json`. `typed`: the robot's name or file as typed."""
    verdict = judge(runs)
    chosen = robot.parameter_sets[PARAMETER_SET]
    return {
        "robot": robot.name,
        "parameters": f"{PARAMETER_SET}, friction zero",
        "joint_pid": _gains_entry(robot, chosen.joint_pid),
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
        "advice": None if verdict.met else asdict(_why_different(robot, typed, verdict)),
        "paper": PAPER,
    }


def _why_different(robot: Robot, typed: str, verdict: Verdict) -> Advice:
    """Return the likeliest cause of a missed goal, and the command to type next."""
    dynamic = robot.parameter_sets[PARAMETER_SET].dynamic
    inertias = physical_inertias(robot.layout, dynamic, allow_changes=True)
    effects = acceleration_changes(robot, dynamic, inertias.values) if inertias.changes else {}
    body = max(effects, key=lambda one: effects[one], default="")
    if effects.get(body, 0.0) > NEGLIGIBLE_CHANGE:
        return Advice(
            f"No rigid body has the inertia of {body}. MuJoCo runs with the nearest possible one, "
            f"which changes accelerations by up to {100 * effects[body]:.2g} %.",
            f"cmmsim check {typed} --parameters {PARAMETER_SET}",
        )
    if verdict.closure_max_um > verdict.position_steady_um / 2:
        return Advice(
            f"The loops of legs open by {verdict.closure_max_um:.2g} um in MuJoCo, which holds "
            "them by stiff springs: the robot is near a singularity.",
            f"cmmsim workspace {typed}",
        )
    return Advice(
        "The engines do not move the same robot: an export of its geometry, bodies or drives is "
        "wrong.",
        f"cmmsim export mjcf {typed} --allow-unphysical-inertia",
    )


def _gains_entry(robot: Robot, gains: Array) -> dict[str, float | list[float]]:
    """Return the gains by name: one number if all joints share a gain, else a list over joints."""
    columns = robot.layout.each_gains(gains).T.tolist()
    own = robot.layout.own_gains
    return {
        name: column if own else column[0] for name, column in zip(JOINT_PID, columns, strict=True)
    }


def figure_8(runs: EngineRuns) -> Figure:
    """Draw the differences between MuJoCo and this model over time.

    A third panel shows the closure error of MuJoCo's loops.
    """
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
        f"{verdict.position_steady_um:.2g} um (goal {GOAL_UM:g} um; paper 1250 and 100 um)"
    )
    angle.set_title(
        f"(b) angle: largest {verdict.angle_max_urad:.2g} urad, steady "
        f"{verdict.angle_steady_urad:.2g} urad (goal {GOAL_URAD:g} urad; paper 3250 and 250 urad)"
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
