"""Sampled closed loop: visual servo (eq. 30), joint PID (eq. 31) and robot (eq. 40).

A sensor measures the pose at every frame. The servo, a controller or a log then issues a joint
command. The command arrives after the latency, and acts until the next one arrives. A run begins at
rest at the first reference pose, unless a start state is given.

Functions

    simulate_servo, simulate_commands, simulate_controller   one run
    differentiate_servo, differentiate_commands              one run with derivatives
    repeat_servo, repeat_commands                            runs that differ only in their noise
    simulate_batch                                           many runs of the servo on all cores
    equilibrium                                              start state at rest
    most_directions                                          limit of directions for derivatives
    prepare                                                  compilation before the first run

The loop is implemented once, in modules named `*_kernels`. Numba compiles them, and they also run
as plain Python. The simulated plant and the identified model use the same code.
"""

from dynamics.closed_loop.checked_arguments import most_directions
from dynamics.closed_loop.drives import DriveName, Drives
from dynamics.closed_loop.joints import FrictionLaw, JointElasticity
from dynamics.closed_loop.loop_settings import (
    IDEAL,
    Controller,
    EveryFrame,
    FrameTiming,
    IdealSensor,
    LoopSettings,
    PoseSensor,
    RateSensor,
    Reference,
    Sensor,
    ServoGains,
)
from dynamics.closed_loop.many_runs import prepare, repeat_commands, repeat_servo, simulate_batch
from dynamics.closed_loop.run import ClosedLoopRun, LoopFailure
from dynamics.closed_loop.simulate import (
    differentiate_commands,
    differentiate_servo,
    simulate_commands,
    simulate_controller,
    simulate_servo,
)
from dynamics.closed_loop.start_state import StartState, equilibrium

__all__ = [
    "IDEAL",
    "ClosedLoopRun",
    "Controller",
    "DriveName",
    "Drives",
    "EveryFrame",
    "FrameTiming",
    "FrictionLaw",
    "IdealSensor",
    "JointElasticity",
    "LoopFailure",
    "LoopSettings",
    "PoseSensor",
    "RateSensor",
    "Reference",
    "Sensor",
    "ServoGains",
    "StartState",
    "differentiate_commands",
    "differentiate_servo",
    "equilibrium",
    "most_directions",
    "prepare",
    "repeat_commands",
    "repeat_servo",
    "simulate_batch",
    "simulate_commands",
    "simulate_controller",
    "simulate_servo",
]
