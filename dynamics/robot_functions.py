"""Functions of a robot's geometry: compiled functions, and CasADi functions for users."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca

from dynamics.compiled.machine_code import MachineFunction, compiled_functions
from dynamics.geometry import MovableGeometry, RobotGeometry
from dynamics.rigid_body.equation_of_motion import motion_functions
from dynamics.rigid_body.virtual_work import robot_functions

# Names of the functions that inner loops evaluate, and that are therefore optimised.
HOT = (
    "equation_of_motion",
    "free_acceleration",
    "response",
    "motion_derivatives",
    "rate_map_derivative",
    "stage_derivatives",
    "stop_derivatives",
    "slope_derivative",
    "forward_dynamics",
    "motion_in_lanes",
    "acceleration_in_lanes",
    "servo_jacobian",
)

# Names of the inputs and of the outputs of the functions that `Robot.casadi` returns.
CASADI = {
    "inverse_kinematics": ("pose", "theta reach_margin"),
    "joint_jacobian": ("pose", "jacobian"),
    "pose_jacobian": ("pose", "jacobian"),
    "mass_matrix": ("pose parameters", "mass_matrix"),
    "coriolis_matrix": ("pose twist parameters", "coriolis_matrix"),
    "gravity_wrench": ("pose parameters", "wrench"),
    "friction_wrench": ("pose twist parameters", "wrench"),
    "regressor": ("pose twist twist_dot", "regressor"),
    "inverse_dynamics": ("pose twist twist_dot parameters", "torque"),
    "forward_dynamics": ("pose twist torque parameters", "twist_dot"),
}


@lru_cache(maxsize=16)
def own_functions(geometry: RobotGeometry) -> dict[str, MachineFunction]:
    """Compiled functions of a geometry, shared by all robots with this geometry.

    Robots do not store these functions, and can thus be pickled.
    """
    return compiled_functions(
        geometry.digest, lambda: robot_functions(geometry) + motion_functions(geometry), HOT
    )


@lru_cache(maxsize=4)
def _movable_functions(nominal: RobotGeometry) -> dict[str, MachineFunction]:
    """Compiled functions for all geometries near a nominal one, with deviations as last input."""
    movable = MovableGeometry(nominal)
    key = b"movable" + nominal.digest
    return compiled_functions(
        key, lambda: robot_functions(movable) + motion_functions(movable), HOT
    )


@lru_cache(maxsize=64)
def nearby_functions(nominal: RobotGeometry, geometry: RobotGeometry) -> dict[str, MachineFunction]:
    """Compiled functions of a geometry near a nominal one. Their machine code is shared."""
    deviations = geometry.deviations_from(nominal)
    return {
        name: replace(compiled, constants=deviations)
        for name, compiled in _movable_functions(nominal).items()
    }


@lru_cache(maxsize=4)
def _functions_by_name(geometry: RobotGeometry) -> dict[str, ca.Function]:
    """CasADi functions of a geometry. They are built together, which takes a second or two."""
    return {function.name(): function for function in robot_functions(geometry)}


@lru_cache(maxsize=64)
def casadi_function(geometry: RobotGeometry, name: str) -> ca.Function:
    """CasADi function of a geometry, with named inputs and outputs as in `CASADI`."""
    function = _functions_by_name(geometry)[name]
    inputs, outputs = (names.split() for names in CASADI[name])
    symbols = [ca.SX.sym(symbol_name, function.size1_in(k)) for k, symbol_name in enumerate(inputs)]
    return ca.Function(name, symbols, function.call(symbols), inputs, outputs)
