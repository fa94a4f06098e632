"""Dynamics of parallel robots: kinematics, virtual-work dynamics, joint PID, visual servo and closed loop.

Conventions: SI units and rad; pose [x y z alpha beta gamma] with R = Rx(alpha) Ry(beta) Rz(gamma); twist [h_dot, omega]
in base-frame axes. The crank is what the paper calls the wrench.
"""

from cmmsim_command import warn_of_foreign_identify
from dynamics import closed_loop
from dynamics.closed_loop.simulate import simulate_batch
from dynamics.errors import DynamicsError
from dynamics.robot import Robot, fast_forward_dynamics, load_robot
from dynamics.robot_file import built_in_robots

warn_of_foreign_identify()

__all__ = [
    "DynamicsError",
    "Robot",
    "built_in_robots",
    "closed_loop",
    "fast_forward_dynamics",
    "load_robot",
    "simulate_batch",
]
