"""The sampled closed loop: visual servo (eq. 30) around joint PID (eq. 31) around the robot (eq. 40).

Every frame the pose is measured, by the sensor that the caller passes or by an ideal one; the servo turns it into a
command after the latency, and the command is held until the next. Unless a start is given the run starts at rest at the
first reference pose, in equilibrium: integrators hold what keeps the robot there. One function serves plant and model.

Written once, in the `*_kernels`, which numba compiles and which also run as the Python that they are; `execution` puts
a run before them.
"""

from dynamics.closed_loop.drives import DriveName, Drives
from dynamics.closed_loop.joints import FrictionLaw, JointElasticity
from dynamics.closed_loop.problem import (
    Controller,
    EveryFrame,
    FrameTiming,
    LoopSettings,
    PoseSensor,
    RateSensor,
    Reference,
    ServoGains,
    StartState,
    equilibrium,
)
from dynamics.closed_loop.run import ClosedLoopRun, LoopFailure
from dynamics.closed_loop.simulate import prepare, simulate, simulate_batch, simulate_repeats

__all__ = [
    "ClosedLoopRun",
    "Controller",
    "DriveName",
    "Drives",
    "EveryFrame",
    "FrameTiming",
    "FrictionLaw",
    "JointElasticity",
    "LoopFailure",
    "LoopSettings",
    "PoseSensor",
    "RateSensor",
    "Reference",
    "ServoGains",
    "StartState",
    "equilibrium",
    "prepare",
    "simulate",
    "simulate_batch",
    "simulate_repeats",
]
