"""The compiled functions of a robot's geometry: one set for all robots that share it, or that are near it."""

from dataclasses import replace
from functools import lru_cache

from dynamics.compiled.machine_code import MachineFunction, compiled_functions
from dynamics.geometry import MovableGeometry, RobotGeometry
from dynamics.rigid_body.equation_of_motion import motion_functions
from dynamics.rigid_body.virtual_work import robot_functions

HOT = (
    *("equation_of_motion", "free_acceleration", "response", "motion_derivatives", "rate_map_derivative"),
    *("stage_derivatives", "stop_derivatives", "slope_derivative", "forward_dynamics", "motion_in_lanes"),
    *("acceleration_in_lanes", "servo_jacobian"),
)
"""What inner loops evaluate."""


@lru_cache(maxsize=16)
def own_functions(geometry: RobotGeometry) -> dict[str, MachineFunction]:
    """One set for all robots of a geometry; not kept in the robot, so that robots can be pickled."""
    return compiled_functions(geometry.digest, lambda: robot_functions(geometry) + motion_functions(geometry), HOT)


@lru_cache(maxsize=4)
def _movable_functions(nominal: RobotGeometry) -> dict[str, MachineFunction]:
    """One set for all geometries near a nominal one, with deviations from it as the last argument."""
    movable, key = MovableGeometry(nominal), b"movable" + nominal.digest
    return compiled_functions(key, lambda: robot_functions(movable) + motion_functions(movable), HOT)


@lru_cache(maxsize=64)
def nearby_functions(nominal: RobotGeometry, geometry: RobotGeometry) -> dict[str, MachineFunction]:
    """Those of a geometry, of the set for all that are near a nominal one."""
    deviations = geometry.deviations_from(nominal)
    return {name: replace(one, constants=deviations) for name, one in _movable_functions(nominal).items()}
