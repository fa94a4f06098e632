"""Dynamics of parallel robots: kinematics, virtual work, joint controllers and closed loops.

Robots

    load_robot(name_or_path)                    built-in robot, or robot of a TOML file
    built_in_robots()                           names of the built-in robots
    Robot                                       kinematics and dynamics, one pose or a batch
    RobotModel(robot)                           torques, CasADi, MJCF and URDF, parameters fixed
    fast_forward_dynamics(robot, parameters)    forward dynamics for inner loops
    workspace.check_motion(robot, pose, times)  travel, reach and singularities along a motion

Closed loops

    closed_loop.simulate_servo(robot, parameters, reference, settings)   one run
    simulate_batch(robot, parameters, references, settings)              many runs on all cores

Every error that a user can cause is a DynamicsError. Names are imported at their first use: CasADi
and Numba take a second to load, and the help of the command line does not need them.

Conventions: SI units and rad. A pose is [x y z alpha beta gamma] with
R = Rx(alpha) Ry(beta) Rz(gamma). A twist is [h_dot, omega] in the axes of the base. A wrench is
[force, moment]. "Eq." and "the paper" refer to Electronics 8(8), 836 (2019), doi
10.3390/electronics8080836. In that paper, the word wrench means the crank.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dynamics.errors import DynamicsError as DynamicsError

if TYPE_CHECKING:
    from dynamics import closed_loop as closed_loop
    from dynamics.closed_loop import simulate_batch as simulate_batch
    from dynamics.forward_dynamics import fast_forward_dynamics as fast_forward_dynamics
    from dynamics.robot import Robot as Robot
    from dynamics.robot import load_robot as load_robot
    from dynamics.robot_file import built_in_robots as built_in_robots
    from dynamics.robot_model import RobotModel as RobotModel

_HOME = {
    **dict.fromkeys(("Robot", "load_robot"), "dynamics.robot"),
    "fast_forward_dynamics": "dynamics.forward_dynamics",
    "built_in_robots": "dynamics.robot_file",
    "RobotModel": "dynamics.robot_model",
    "simulate_batch": "dynamics.closed_loop",
}

__all__ = ["DynamicsError", "closed_loop", *_HOME]

if not TYPE_CHECKING:  # otherwise, a type checker would accept every name

    def __getattr__(name: str) -> Any:
        if name == "closed_loop":
            return import_module("dynamics.closed_loop")
        if name not in _HOME:
            message = f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}"
            raise AttributeError(message)
        return getattr(import_module(_HOME[name]), name)

    def __dir__() -> list[str]:
        return [*__all__, *(name for name in globals() if name.startswith("__"))]
