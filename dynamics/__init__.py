"""Dynamics of parallel robots: kinematics, virtual-work dynamics, joint PID, visual servo and closed loop.

Robots
    load_robot(name_or_path) -> Robot           built in (`built_in_robots() -> list[str]`), or a TOML file
    Robot                                       kinematics and dynamics, one pose or a batch
    fast_forward_dynamics(robot, parameters)    forward dynamics for inner loops, as a function without checks
    workspace.check_motion(robot, pose, times)  may it move so? travel, reach and singularities

The closed loop
    closed_loop.simulate(robot, parameters, reference, settings, sensor) -> ClosedLoopRun
    simulate_batch(robot, parameters, references, settings) -> list[ClosedLoopRun]   many runs, on all cores

Every error that a user can cause is a DynamicsError.

Conventions: SI units and rad; pose [x y z alpha beta gamma] with R = Rx(alpha) Ry(beta) Rz(gamma); twist [h_dot, omega]
in base-frame axes. The crank is what the paper calls the wrench.
"""

from dynamics import closed_loop
from dynamics.closed_loop.simulate import simulate_batch
from dynamics.errors import DynamicsError
from dynamics.fast_dynamics import fast_forward_dynamics
from dynamics.robot import Robot, load_robot
from dynamics.robot_file import built_in_robots

__all__ = [
    "DynamicsError",
    "Robot",
    "built_in_robots",
    "closed_loop",
    "fast_forward_dynamics",
    "load_robot",
    "simulate_batch",
]
